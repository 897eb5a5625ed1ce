"""The golden dives with messages doubled, delayed, reordered and dropped: what the solver promises of its results.

The disturbed messages are written as logs whose log times say in which order they arrive; the solver takes them so.

1. Doubled messages change nothing.
2. Streams (one topic of one node) that come late against one another, by less than the matching window of a second,
   each in its own order, change nothing. This is what a bus does: it keeps the order of a topic. Before its first
   sample has come, a sensor is not waited for: the whole dive is delayed here, not its sensors alone.
3. A frame that the node's next ones overtake changes nothing while the other node's frame waits for it.
4. A lost frame makes its trigger `unmatched`, and nothing before it changes. Later triggers lack what the motion prior
   and the headings would have learnt from it: a few decisions that hang on these change, and a pose moves within its
   sigma.
5. Lost samples of attitude and depth are bridged: every trigger keeps its outcome but for a few in doubt.

Whatever happens, each trigger ends as one outcome.
"""

import random

import pytest

from tests.golden import stages
from tests.golden.dives import CAVERN, LAKE, NIGHT_REEF, SURVEY
from tests.golden.logs import Entry, read_log, write_log
from tests.golden.references import compare_outcomes, differences

MS_NS = 1_000_000
LATE_NS = 900 * MS_NS
DIVES = (CAVERN, LAKE, NIGHT_REEF)
# A decision that hangs on what came before it may change; more of them would mean that the past decides.
DOUBTFUL_SHARE = 0.05
MOVED_SIGMAS = 1.0


@pytest.fixture(scope="module", params=(*DIVES, SURVEY), ids=lambda dive: dive.name)
def whole(request, tmp_path_factory):
    """A dive, its messages as they arrive, and its outcomes."""
    return _solved(request.param, tmp_path_factory)


@pytest.fixture(scope="module", params=DIVES, ids=lambda dive: dive.name)
def fast(request, tmp_path_factory):
    """The same, of those dives whose sensors are so fast that a lost sample can be bridged."""
    return _solved(request.param, tmp_path_factory)


def _solved(dive, tmp_path_factory):
    entries = sorted((entry for log in dive.logs for entry in read_log(log)), key=lambda entry: entry.log_time_ns)
    _, outcomes = stages.solve(dive.logs, tmp_path_factory.mktemp(dive.name) / "whole.mcap", *dive.options)
    return dive, entries, outcomes


def _solve(dive, entries, tmp_path):
    log = write_log(tmp_path / "disturbed.mcap", sorted(entries, key=lambda entry: entry.log_time_ns))
    _, outcomes = stages.solve([log], tmp_path / "solved.mcap", *dive.options)
    triggers = [outcome["trigger"] for outcome in outcomes]
    assert len(triggers) == len(set(triggers)), "a trigger with two outcomes"
    return outcomes


def _same(expected, found):
    assert differences(expected, found, compare_outcomes) == []


def test_doubled_messages_change_nothing(whole, tmp_path):
    dive, entries, outcomes = whole
    again = [entry.at(entry.log_time_ns + 300 * MS_NS) for entry in entries if entry.topic != "info"]
    _same(outcomes, _solve(dive, entries + again, tmp_path))


def test_late_streams_change_nothing(whole, tmp_path):
    dive, entries, outcomes = whole
    rng, newest_ns = random.Random(1), {}

    def arrive(entry: Entry) -> Entry:
        if entry.topic == "info":
            return entry
        late_ns = entry.log_time_ns + rng.randrange(LATE_NS)
        newest_ns[entry.key] = max(newest_ns.get(entry.key, 0), late_ns)
        return entry.at(newest_ns[entry.key])

    _same(outcomes, _solve(dive, [arrive(entry) for entry in entries], tmp_path))


def test_one_late_node_changes_nothing(whole, tmp_path):
    dive, entries, outcomes = whole
    late = [
        entry.at(entry.log_time_ns + LATE_NS) if entry.topic != "info" and entry.node == "b" else entry
        for entry in entries
    ]
    _same(outcomes, _solve(dive, late, tmp_path))


def test_an_overtaken_frame_changes_nothing(fast, tmp_path):
    dive, entries, outcomes = fast
    waiting = {e.message["trigger"] for e in entries if e.topic == "candidates" and e.node == "a"}

    def is_late(entry: Entry) -> bool:
        if entry.topic != "candidates" or entry.node != "b":
            return False
        return entry.message["trigger"] % 10 == 4 and entry.message["trigger"] in waiting

    overtaken = [entry.at(entry.log_time_ns + 350 * MS_NS) if is_late(entry) else entry for entry in entries]
    assert overtaken != entries
    _same(outcomes, _solve(dive, overtaken, tmp_path))


def _doubtful(expected, found):
    """Return the triggers whose decision has changed; refuse poses that moved out of their sigma."""
    of = {outcome["trigger"]: outcome for outcome in found}
    changed = []
    for old in expected:
        new = of[old["trigger"]]
        decision = ("outcome", "reason", "method", "blobs_a", "blobs_b")
        if any(old.get(name) != new.get(name) for name in decision):
            changed.append(old["trigger"])
        elif old["outcome"] == "pose":
            sigma_m = [old["covariance"][index] ** 0.5 for index in (0, 6, 11)]
            moved = [abs(a - b) / s for a, b, s in zip(old["t_a_b_m"], new["t_a_b_m"], sigma_m, strict=True)]
            assert max(moved) < MOVED_SIGMAS, old["trigger"]
    return changed


def test_a_lost_frame_costs_its_own_trigger(whole, tmp_path):
    dive, entries, outcomes = whole

    def is_lost(trigger):
        return trigger % 20 == 17

    kept = [
        entry
        for entry in entries
        if not (entry.topic == "candidates" and entry.node == "b" and is_lost(entry.message["trigger"]))
    ]
    found = _solve(dive, kept, tmp_path)
    seen_by_a = {e.message["trigger"] for e in entries if e.topic == "candidates" and e.node == "a"}
    lost = [one for one in found if is_lost(one["trigger"])]
    assert lost
    assert {one["trigger"] for one in lost} <= seen_by_a
    assert {one.get("reason") for one in lost} == {"unmatched"}
    others = [one for one in outcomes if not is_lost(one["trigger"])]
    first = min(one["trigger"] for one in lost)
    before = [one for one in others if one["trigger"] < first]
    assert before
    _same(before, [one for one in found if one["trigger"] < first])
    assert len(_doubtful(others, found)) <= DOUBTFUL_SHARE * len(others)


@pytest.mark.parametrize("topic", ["attitude", "depth"])
def test_lost_samples_are_bridged(fast, topic, tmp_path):
    dive, entries, outcomes = fast
    rng = random.Random(2)
    kept = [entry for entry in entries if not (entry.topic == topic and rng.random() < 0.1)]
    found = _solve(dive, kept, tmp_path)
    assert len(found) == len(outcomes)
    assert len(_doubtful(outcomes, found)) <= DOUBTFUL_SHARE * len(outcomes)
