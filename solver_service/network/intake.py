"""What comes into a network, on one clock: nodes' clocks differ, and what a node tells is moved by its offset.

The state holds an offset of each clock. But two things are right for a few hundredths of a second only: the dynamics in
a frame that moves with a node, and a light that is carried from clock to clock. So a larger offset is taken off the
times of what a node tells, and the state holds what is left.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

from buddyline.solver_service.network.belief import LEFT_S
from buddyline.solver_service.network.clocks import MOST_NUDGED_S, SURE_SIGMAS, is_off
from buddyline.solver_service.network.estimate import NetEstimate, PairFix
from buddyline.solver_service.track.inputs import FixSeen, TrackNode
from buddyline.solver_service.track.intake import TrackIntake, What
from buddyline.solver_service.track.lights import Sight
from buddyline.solver_service.track.moving import KNOWN_CLOCK_S

# A clock that is further off is named.
FAR_S: Final = 0.03
# What may be left of an offset, 1 sd.
LEFT_SHARE: Final = 0.25


class NetIntake(TrackIntake):
    """All that nodes have told, on the net's clock. off_ns: by node, its clock minus the net's, as believed.

    main: the estimate that is followed. challengers: those that may replace it.
    """

    nodes: list[TrackNode]

    def __init__(self) -> None:
        super().__init__([])
        self.off_ns: list[int] = []
        self.main = NetEstimate(self)
        self.challengers: list[NetEstimate] = []
        self._fixes: dict[tuple[int, int], list[tuple[float, PairFix]]] = {}

    def ahead_ns(self, node: int) -> int:
        """Give a node's clock minus the net's, as believed."""
        return self.off_ns[node]

    def put_right(self, more_s: Mapping[int, float]) -> None:
        """Take all that nodes have told, and what waits, by clocks that are ahead by so much more, by node."""
        for node, off_s in more_s.items():
            self.off_ns[node] += round(off_s * 1e9)
            self.samples[node].put_back(off_s)
            if node in self._pictured_s:
                last_s, apart_s = self._pictured_s[node]
                self._pictured_s[node] = last_s - off_s, apart_s
            self.attitudes[node][:] = [(t_s - off_s, seen) for t_s, seen in self.attitudes[node]]
            self.depths[node][:] = [(t_s - off_s, seen) for t_s, seen in self.depths[node]]
        waiting, self._events = sorted(self._events), []
        for t_s, rank, _, what in waiting:
            self._push_again(t_s, rank, what)

    def _push_again(self, t_s: float, rank: int, what: What) -> None:
        if isinstance(what, Sight):
            t_s = self.seconds(what.node, what.stamp_ns)
            self._push(t_s, rank, replace(what, t_s=t_s))
        elif isinstance(what, tuple):
            self.ask_rows(what[0], what[1:], rank)
        elif isinstance(what, FixSeen):
            self._push(self.fix_seconds(what), rank, what)

    def ask_rows(self, stamp_ns: int, nodes: Sequence[int], rank: int) -> None:
        """Have rows told of some nodes, each when its own clock shows a stamp."""
        for off_ns in dict.fromkeys(self.off_ns[node] for node in nodes):
            of_one_time = [node for node in nodes if self.off_ns[node] == off_ns]
            self._push(self.seconds(of_one_time[0], stamp_ns), rank, (stamp_ns, *of_one_time))

    def fix_seconds(self, fix: FixSeen) -> float:
        """Give the time of a pose, which is stamped midway between both nodes' clocks, as s since the epoch."""
        assert isinstance(fix, PairFix)
        return self.since_epoch(fix.stamp_ns - (self.off_ns[fix.node] + self.off_ns[fix.other]) // 2)

    def _put_clocks_right(self) -> bool:
        """Put right the clocks that have proved to be off; return whether one was so far off that nodes leave for it.

        Where the frame moves with a node all leave: all have been placed by that node's motion at the wrong time.
        """
        main, clocks = self.main, self.main.clocks_now
        far = [index for index, clock in enumerate(clocks) if is_off(*clock, MOST_NUDGED_S)]
        leave = range(len(clocks)) if far and main.anchor is not None else far
        for index, clock in reversed([*enumerate(clocks)]):
            node = main.members[index].node
            if is_off(*clock):
                self.put_right({node: clock[0]})
                self.challengers = []
                main.nudge(index, clock[0])
            if index in leave:
                main.remove(index)
        if far:
            self._fixes = {}
            # Another node may be the first one next; and so far off, a clock is estimated poorly.
            most_s = max(abs(clocks[index][0]) for index in far)
            main.clocks |= dict.fromkeys(main.clocks, max(LEFT_S, LEFT_SHARE * most_s))
        return bool(far)

    def _put_right_by(self, estimate: NetEstimate) -> bool:
        """Put right the clocks by what another pass knows of them in the end; return whether any was off."""
        known = {one.node: clock for one, clock in zip(estimate.members, estimate.clocks_now, strict=True)}
        off_s = {node: clock[0] for node, clock in known.items() if is_off(*clock)}
        if off_s:
            self.put_right(off_s)
        left_s = max((LEFT_SHARE * abs(each) for each in off_s.values()), default=0.0)
        clocks = [node for node, (_, sigma_s) in known.items() if sigma_s < KNOWN_CLOCK_S]
        self.main.clocks = dict.fromkeys(clocks, max(LEFT_S, left_s))
        return bool(off_s)

    def _check_clocks(self, t_s: float) -> None:
        """Say whose clock is far off."""
        main, members = self.main, self.main.members
        off_s = [1e-9 * self.off_ns[one.node] + main.clock(index)[0] for index, one in enumerate(members)]
        for index, member in enumerate(members):
            far, apart_s = main.is_far(index), off_s[index] - off_s[0]
            if far or abs(apart_s) > max(FAR_S, SURE_SIGMAS * main.clock(index)[1]):
                name, first = self.nodes[member.node].name, self.nodes[members[0].node].name
                does = "the network does not tell its places" if far else "the network counts with it"
                self._problems.report(f"{name}: its clock is {1e3 * apart_s:+.0f} ms from that of {first}: {does}", t_s)
