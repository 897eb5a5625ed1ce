"""The demo's text about more than two nodes."""

import re
from dataclasses import asdict
from itertools import pairwise

import pytest
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.codec import encode
from buddyline.protocol.envelope import open_envelope
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.topics import key_of
from buddyline.tools.cli import main
from buddyline.tools.demo.team_dashboard import TeamDashboard, team_summary_text
from buddyline.tools.health.words import reason_words
from msgspec.structs import replace

from tests.tools.evaluated import pose, rejection
from tests.tools.watched import START_NS, at

SCENARIO = Scenario(environment="cavern", seed=1, start_ns=START_NS, more_nodes=("c",), fixed_nodes=("a",))
WORLD = World(SCENARIO)
COVARIANCE = [1e-4 if i % 7 == 0 else 0.0 for i in range(36)]


class WatchedTeam:
    """A dashboard of three nodes, and a clock that stands still."""

    def __init__(self, scenario=SCENARIO):
        self.now_s = 0.0
        self.world = World(scenario)
        self.dashboard = TeamDashboard(scenario, 10.0, lambda: self.now_s)

    def take(self, message):
        self.dashboard.take(open_envelope(key_of(message), encode(message), message.stamp_ns))

    def tell(self, node, k, east_m=0.0, origin=None):
        true = self.world.node_truth(node, at(k), "main")
        zero = self.world.node_truth(origin, at(k), "main").p_m if origin else (0.0, 0.0, 0.0)
        x, y, z = (a - b for a, b in zip(true.p_m, zero, strict=True))
        covariance = [0.0] * 36 if node == origin else COVARIANCE
        self.take(replace(true, p_m=(x, y + east_m, z), covariance=covariance, mode="filter"))


def test_the_line_shows_each_node_and_how_far_it_is_off():
    watch = WatchedTeam()
    watch.tell("a", 0)
    watch.tell("b", 0, east_m=0.02)
    line = watch.dashboard.line()
    assert "off 20 mm" in line
    assert "c not known" in line
    watch.now_s = 3.0
    assert "b lost" in watch.dashboard.line()


def test_the_screen_fits_the_terminal_and_counts_pairs():
    watch = WatchedTeam()
    watch.tell("b", 0)
    for k in range(4):
        watch.take(pose(k) if k else rejection(k))
    screen = watch.dashboard.screen(40, 12)
    assert len(screen.splitlines()) <= 12
    assert max(map(len, re.sub(r"\x1b\[[0-9;]*[A-Z]", "", screen).splitlines())) <= 40
    assert "a/b" in screen


@pytest.mark.parametrize("size", [(1, 1), (2, 1), (3, 2), (10, 3), (1, 60), (300, 1)])
def test_a_tiny_terminal_gets_what_fits(size):
    watch = WatchedTeam()
    watch.tell("a", 0)
    watch.take(pose(1))
    screen = re.sub(r"\x1b\[[0-9;]*[A-Z]", "", watch.dashboard.screen(*size))
    assert len(screen.split("\n")) <= size[1]
    assert max(map(len, screen.split("\n"))) <= size[0]


def test_the_summary_has_each_nodes_errors():
    watch = WatchedTeam()
    for k in range(0, 20, 2):
        watch.tell("a", k)
        watch.tell("b", k, east_m=0.01)
        watch.tell("c", k, east_m=0.5 if k == 8 else 0.0)
    watch.take(pose(3))
    watch.now_s = 2.0
    summary = watch.dashboard.summary({"solver": 1.0})
    assert {node: one["fixed"] for node, one in summary["network"].items()} == {"a": True, "b": False, "c": False}
    assert summary["network"]["b"]["position_error_m"] == pytest.approx(0.01)
    assert summary["network"]["c"]["wrong"] == 1
    assert summary["cpu_share"] == {"solver": 0.5}
    text = team_summary_text(summary)
    assert "a (fixed)" in text
    assert "solver 50%" in text
    assert "compasses" not in text
    assert summary["network"]["b"]["stated_position_sigma_m"] == pytest.approx(0.03**0.5 / 10)


def test_the_summary_says_which_pairs_had_poses_and_why_others_had_none():
    watch = WatchedTeam(Scenario(**(asdict(SCENARIO) | {"fixed_nodes": ()})))
    watch.tell("a", 0, origin="a")
    watch.tell("b", 0, origin="a")
    first = START_NS // 100_000_000
    for k in range(10):
        outcome = replace(pose(k) if k < 8 else rejection(k), trigger=first + k)
        watch.take(outcome)
        watch.take(replace(rejection(k), node_a="a", node_b="c", trigger=first + k, reason="too_few_candidates"))
    summary = watch.dashboard.summary({})
    assert summary["pairs"]["a/b"]["triggers_in_view"] >= 8
    text = team_summary_text(summary)
    assert "a/b 8 of 10 (80%; " in text
    assert "a/c 0 of 10 (0%; never in view)" in text
    assert f"without a pose: {reason_words('too_few_candidates')} 83%, {reason_words('ambiguous')} 17%" in text
    assert re.search(r"^c +0 +- ", text, re.MULTILINE), "a node that was never told is told"
    assert "compasses" in text
    assert "--rate" not in text


def test_a_machine_that_does_not_keep_up_is_said():
    watch = WatchedTeam()
    first = START_NS // 100_000_000
    for k in range(0, 40, 4):
        watch.take(replace(pose(k), trigger=first + k))
    assert "too slow for the demo; a lower --rate takes fewer" in team_summary_text(watch.dashboard.summary({}))


def test_the_screen_shows_all_nodes_from_above():
    watch = WatchedTeam()
    for node in "abc":
        watch.tell(node, 0)
    screen = watch.dashboard.screen(80, 40)
    assert "from above, north up" in screen
    assert len(screen.splitlines()) <= 40
    above = screen.partition("from above")[0]
    for node in "abc":
        assert re.search(rf"{node}[↑↗→↘↓↙←↖]", above)


def test_without_a_fixed_node_places_count_from_the_origin():
    watch = WatchedTeam(Scenario(**(asdict(SCENARIO) | {"fixed_nodes": ()})))
    watch.tell("a", 0, origin="a")
    watch.tell("b", 0, origin="a")
    assert watch.dashboard.line().count("off 0 mm") == 2


def test_the_truth_is_of_all_pairs_and_nodes():
    stamped = list(WatchedTeam().dashboard.truth(at(3)))
    assert {key for _, key, _ in stamped} == {
        *(f"buddyline/pair/{pair}/truth" for pair in ("a/b", "a/c", "b/c")),
        *(f"buddyline/net/main/truth/{node}" for node in "abc"),
    }
    assert all(one[0] <= other[0] for one, other in pairwise(stamped))


def test_a_demo_of_one_node_is_refused(capsys):
    assert main(["demo", "--nodes", "1"]) == 2
    assert "--nodes 1" in capsys.readouterr().err


@pytest.mark.parametrize(("option", "value"), [("--rate", "0"), ("--rate", "nan"), ("--seconds", "-1")])
def test_a_demo_without_time_or_rate_is_refused(option: str, value: str, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["demo", option, value])
    assert ended.value.code == 2
    assert f"argument {option}: {value}: give a number above 0" in capsys.readouterr().err


def test_a_fixed_node_is_one_of_the_nodes():
    with pytest.raises(BuddylineError, match="fixed_nodes: 'z'"):
        Scenario(fixed_nodes=("z",))
