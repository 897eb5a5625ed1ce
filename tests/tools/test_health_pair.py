"""What is said of a pair: its findings in words, with what to do."""

from __future__ import annotations

import math

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import RelativePose, SolverStatus
from buddyline.solver_service.coach import UNSEEN
from buddyline.solver_service.geometry.rotation import matrix_to_quat, quat_to_matrix, rotation_exp
from buddyline.tools.health.finding import Finding
from buddyline.tools.health.pair import findings
from buddyline.tools.health.words import REASONS, sentence
from buddyline.tools.monitor import panel
from buddyline.tools.monitor.picture import PairPicture
from msgspec import UNSET, UnsetType
from msgspec.structs import replace

from tests.tools.evaluated import FACING, INFOS, frame, pose, rejection, track
from tests.tools.watched import at, feed, solver_status, status, take, tick, unsolved, watched, words


class TestHealth:
    def test_a_healthy_pair_is_said_to_be_well(self) -> None:
        assert "All is well" in words(watched(), at(29) + S_NS // 10)

    def test_slow_triggers_are_neither_silent_nor_stale_between_two(self) -> None:
        picture = PairPicture()
        for node in "ab":
            take(picture, replace(INFOS[node], trigger_period_ns=4 * S_NS), at(0))
            take(picture, frame(node, 0), at(0))
        take(picture, pose(0), at(0))
        for k in range(0, 39, 10):
            take(picture, solver_status(at(k)), at(k))
        assert "All is well" not in words(watched(1), at(0) + 38 * S_NS // 10)
        said = words(picture, at(0) + 38 * S_NS // 10)
        assert "silent" not in said
        assert not picture.is_stale(at(0) + 38 * S_NS // 10)
        assert picture.is_stale(at(0) + 12 * S_NS)

    @pytest.mark.parametrize("silent", ["a", "solver", "poses"])
    def test_green_needs_facts_younger_than_two_seconds_from_everyone(self, silent: str) -> None:
        """One falls silent; whatever else is said of it, nobody says that all is well two seconds later."""
        picture = watched()
        for k in range(30, 48):
            for message in tick(k):
                is_solver = isinstance(message, RelativePose | SolverStatus)
                left_out = {
                    "solver": is_solver,
                    "poses": isinstance(message, RelativePose),
                    "a": getattr(message, "node", "") == "a",
                }
                if not left_out[silent]:
                    take(picture, message, at(k))
        assert "All is well" in words(picture, at(30))
        for k in (48, 49):
            assert "All is well" not in words(picture, at(k))

    def test_that_nothing_is_wrong_does_not_make_it_well(self) -> None:
        picture = watched(50)
        picture.solver_heard_ns = at(30)
        (said,) = findings(picture, at(49))
        assert (said.level, said.text) == ("warning", "Not known to be well: nothing new from the solver.")

    def test_fresh_words_about_the_past_are_not_well(self) -> None:
        """A solver that is overloaded answers all the time, about what was seconds ago."""
        picture = watched()
        for k in range(30, 60):
            for message in tick(k):
                if not isinstance(message, RelativePose):
                    take(picture, message, at(k))
            take(picture, pose(k - 25), at(k))
        (said,) = findings(picture, at(59))
        assert said.text == "Not known to be well: what the solver says is 2 s behind the nodes."

    def test_clocks_that_are_apart_are_not_well(self) -> None:
        picture = watched()
        take(picture, replace(solver_status(at(29)), clock_skew_s=0.02), at(29))
        assert "clocks are 20 ms apart" in words(picture, at(29))

    def test_without_messages_the_advice_is_to_start_everything(self) -> None:
        assert "start hub, nodes and solver" in words(PairPicture(), 5)

    def test_a_killed_node_is_named_with_what_to_do(self) -> None:
        picture = watched()
        picture.alive("node/b", False, at(30))
        feed(picture, 31, "a")
        said = findings(picture, at(31))[0]
        assert (said.level, said.name, said.since_ns) == ("problem", "node b", at(30))
        assert "power" in said.advice

    def test_a_node_that_came_back_is_not_gone(self) -> None:
        picture = watched()
        picture.alive("node/b", False, at(30))
        for k in range(50, 70):
            feed(picture, k)
        assert "All is well" in words(picture, at(69))

    def test_a_frozen_node_is_silent_though_nobody_saw_it_leave(self) -> None:
        picture = watched()
        for k in range(30, 50):
            feed(picture, k, "a")
        assert sentence(findings(picture, at(50))[0], at(50)) == "Node b is silent, for 2.1 s."

    def test_a_dead_hub_is_distinguished_from_dead_nodes(self) -> None:
        picture = watched()
        said = findings(picture, at(29) + 5 * S_NS)
        assert [finding.name for finding in said] == ["bus"]
        assert said[0].since_ns == at(29)

    def test_a_missing_solver_is_named(self) -> None:
        picture = watched()
        picture.alive("solver/any", False, at(29))
        assert "The solver has left the bus" in words(picture, at(30))
        picture.alive("solver/any", True, at(30))
        assert "The solver is silent" in words(watched(1), at(0) + S_NS) + words(unsolved(), at(60))

    def test_a_nodes_reported_problem_is_shown_with_its_begin(self) -> None:
        picture = watched()
        for k, figure in ((30, "2.1"), (40, "3.1"), (50, "4.1")):
            take(picture, status("a", at(k), f"camera: nothing for {figure} s"), at(k))
            feed(picture, k + 1)
        said = [finding for finding in findings(picture, at(51)) if "reports" in finding.text]
        assert [finding.since_ns for finding in said] == [at(30)]

    @pytest.mark.parametrize("reason", sorted(REASONS))
    def test_each_rejection_reason_has_plain_words_and_advice(self, reason: str) -> None:
        picture = watched()
        for k in range(30, 60):
            for message in (frame("a", k), frame("b", k), rejection(k, reason)):
                take(picture, message, at(k))
            take(picture, solver_status(at(k)), at(k))
        said = next(finding for finding in findings(picture, at(60)) if finding.name == "pair")
        assert said.text == f"No pose: {REASONS[reason][0]}."
        # The nodes are 3 m apart and look at each other: where lights are not found there is more to say.
        assert said.advice == ("come 1.0 m closer" if reason in UNSEEN else REASONS[reason][1])

    def test_a_log_without_poses_says_how_to_get_them(self) -> None:
        picture = PairPicture()
        for k in range(40):
            take(picture, frame("a", k), at(k))
            take(picture, frame("b", k), at(k))
        assert "buddyline solve" in words(picture, at(39), live=False)


class TestCoach:
    """What to do: in the solver's words, else by the newest estimate."""

    @staticmethod
    def lost(advice: list[str] | UnsetType) -> Finding:
        """A pair that lost its fix four seconds ago, when a had turned 40 degrees to the right."""
        picture, R_a = PairPicture(), rotation_exp(np.array((0.0, math.radians(40.0), 0.0)))
        for node in "ab":
            take(picture, INFOS[node], at(0))
        qx, qy, qz, qw = matrix_to_quat(R_a.T @ quat_to_matrix(np.array(FACING))).tolist()
        x, y, z = (R_a.T @ (0.0, 0.0, 4.0)).tolist()
        take(picture, track(0, (x, y, z), 0.01, q_a_b_xyzw=(qx, qy, qz, qw)), at(0))
        for k in range(1, 41):
            for message in (frame("a", k, ()), frame("b", k), rejection(k, "too_few_candidates")):
                take(picture, message, at(k))
            if k % 10 == 0:
                take(picture, solver_status(at(k), advice=advice), at(k))
        (said,) = [finding for finding in findings(picture, at(40)) if finding.name == "pair"]
        return said

    def test_the_solver_s_words_are_the_advice(self) -> None:
        words = ["left lamp of b is dark", "come 1.5 m closer"]
        assert self.lost(words).advice == "left lamp of b is dark, come 1.5 m closer"

    def test_of_a_solver_that_says_nothing_the_newest_estimate_tells(self) -> None:
        assert self.lost(UNSET).advice == "turn a 40 deg left"

    def test_what_would_make_a_fix_better_is_said_where_all_is_well(self) -> None:
        picture = watched()
        take(picture, solver_status(at(29), advice=["come 1.5 m closer"]), at(29))
        (said,) = findings(picture, at(29))
        assert (said.level, said.advice) == ("ok", "come 1.5 m closer")


class TestMachines:
    """What a node's status says of leak, trigger and load, on the page."""

    @pytest.mark.parametrize(
        ("changes", "name", "level", "word"),
        [
            ({"leak": True}, "leak", "problem", "Water in the housing of node a."),
            ({"trigger_residual_s": -0.0123}, "trigger", "warning", "-12 ms from their instants"),
            ({"detect_s": 0.085}, "load", "warning", "Node a needs 85 of 100 ms"),
        ],
    )
    def test_what_is_out_of_bounds_is_said_and_takes_the_green_away(
        self, changes: dict[str, float], name: str, level: str, word: str
    ) -> None:
        picture = watched()
        take(picture, replace(status("a", at(29)), **changes), at(29))
        first = findings(picture, at(29))[0]
        assert (first.name, first.level) == (name, level)
        assert word in first.text
        assert word.rsplit(maxsplit=1)[-1] in words(picture, at(29))

    def test_what_is_within_bounds_is_shown_and_no_finding(self) -> None:
        picture = watched()
        inside = {"leak": False, "trigger_residual_s": 0.001, "detect_s": 0.02}
        take(picture, replace(status("a", at(29)), **inside), at(29))
        assert [finding.level for finding in findings(picture, at(29))] == ["ok"]
        page = panel.health(picture, at(29))
        for fact in ("exposure +1.0 ms from its instant", "detector 20 ms", "dry"):
            assert fact in page
