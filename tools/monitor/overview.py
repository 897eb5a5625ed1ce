"""Everything that is watched: all nodes, and a picture of each pair of them."""

from __future__ import annotations

from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.envelope import Envelope
from buddyline.protocol.messages import NodePose
from buddyline.tools.monitor.picture import MAX_NODES, NodePicture, PairPicture, node_in, passed
from buddyline.tools.pairs import Pair

# A client that invents pairs must not fill the memory.
MAX_PAIRS: Final = 128
MAX_KEYS: Final = 1024


class Overview:
    """Sorts messages to nodes, pairs and nets. pair: the one that is shown first; None: the first that comes.

    last: the newest message of each key. net: the newest pose of each node in a common frame.
    """

    def __init__(self, pair: Pair | None = None) -> None:
        self.nodes: dict[str, NodePicture] = {}
        self.last: dict[str, Envelope] = {}
        self.net: dict[str, tuple[NodePose, int]] = {}
        self._first = PairPicture(pair, self.nodes)
        self._others: dict[Pair, PairPicture] = {}

    def take(self, envelope: Envelope) -> None:
        """Take one message, received at its time_ns."""
        if envelope.key in self.last or len(self.last) < MAX_KEYS:
            self.last[envelope.key] = envelope
        message, at_ns = envelope.message, envelope.time_ns
        if isinstance(message, NodePose):
            if message.mode != "truth" and (message.node in self.net or len(self.net) < MAX_NODES):
                self.net[message.node] = message, at_ns
        elif len(envelope.ids) == 1:
            node = node_in(self.nodes, envelope.node)
            if node is not None:
                node.take(envelope)
        else:
            pair = envelope.node, envelope.ids[1]
            picture = self._first if self._first.pair in (None, pair) else self._others.get(pair)
            if picture is None and len(self._others) < MAX_PAIRS:
                picture = self._others[pair] = PairPicture(pair, self.nodes)
                picture.heard(self._first.first_ns or at_ns)
            if picture is not None:
                picture.take(envelope)
        for picture in (self._first, *self._others.values()):
            picture.heard(at_ns)

    def look_at_clock(self, now_ns: int) -> None:
        """Notice a clock that was set back: what came before must not stay fresh for as long."""
        last_ns = self._first.last_ns
        if last_ns is None or now_ns >= last_ns - S_NS:
            return
        self.last = {key: one for key, one in self.last.items() if one.time_ns <= now_ns}
        self.net = {node: (pose, passed(at_ns, now_ns)) for node, (pose, at_ns) in self.net.items()}
        for node in self.nodes.values():
            node.set_back(now_ns)
        for picture in (self._first, *self._others.values()):
            picture.set_back(now_ns)

    def alive(self, name: str, alive: bool, at_ns: int) -> None:
        """Take a change of the names that are alive."""
        for picture in (self._first, *self._others.values()):
            picture.alive(name, alive, at_ns)

    def pairs(self) -> list[Pair]:
        """Return all pairs that have been heard of, the one that is shown first at the head."""
        first = [self._first.pair] if self._first.pair is not None else []
        return [*first, *sorted(self._others)]

    def picture(self, pair: Pair | None = None) -> PairPicture:
        """Return a pair's picture; None, or a pair that is not known: the first one's."""
        return self._first if pair is None else self._others.get(pair, self._first)
