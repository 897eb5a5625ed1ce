"""The load: lowered in time, one step after the other, and raised with patience."""

from itertools import pairwise

import pytest
from buddyline.node.power.load import BACK_DEGC, LEVELS, LOWER_AFTER_S, RAISE_AFTER_S, STEPS_DEGC, NodeLoad, next_load
from buddyline.protocol.health import HOT_DEGC, SLOWED_NOW, SLOWED_SINCE_START, TOO_HOT_DEGC, UNDERVOLTAGE_NOW


def follow(degc, seconds, bits=0, load=None, start_s=0.0):
    """The load after each second of a course of temperatures: a number, or a function of the time."""
    load, passed = load or NodeLoad(), []
    for i in range(seconds):
        load = next_load(load, degc(i) if callable(degc) else degc, bits, start_s + i)
        passed.append(load)
    return passed


def levels(passed):
    """The levels in the order in which they came."""
    return list(dict.fromkeys(load.level for load in passed))


def test_the_load_is_lowered_before_the_processor_is_slowed_down_and_after_the_warning():
    assert HOT_DEGC < STEPS_DEGC[0] < STEPS_DEGC[1] < TOO_HOT_DEGC


def test_a_node_that_heats_up_leaves_out_pictures_first_then_every_second_trigger():
    passed = follow(lambda t: 60.0 + t / 10, 200)
    assert levels(passed) == ["full", "no_pictures", "half_rate"]
    first = [[load.level for load in passed].index(level) for level in LEVELS[1:]]
    assert [60.0 + t / 10 for t in first] == pytest.approx(STEPS_DEGC)


def test_each_step_gets_time_to_help():
    passed = [load.level for load in follow(90.0, 40)]
    assert passed.index("half_rate") - passed.index("no_pictures") == LOWER_AFTER_S


def test_it_comes_back_one_step_at_a_time_only_after_it_was_calm_for_long():
    hot = NodeLoad("half_rate", 0.0)
    passed = [load.level for load in follow(50.0, 400, load=hot)]
    assert passed.index("no_pictures") == RAISE_AFTER_S
    # The next calm begins anew with the next look.
    assert passed.index("full") == 2 * RAISE_AFTER_S + 1


def test_a_temperature_that_sways_about_a_step_changes_the_load_once():
    passed = follow(lambda t: STEPS_DEGC[0] + (1.0 if t // 30 % 2 else 1.0 - BACK_DEGC), 2000)
    changes = sum(a.level != b.level for a, b in pairwise(passed))
    assert changes == 1


def test_a_short_calm_does_not_add_up():
    passed = follow(lambda t: 40.0 if t % 100 else 73.0, 1000, load=NodeLoad("no_pictures", 0.0))
    assert levels(passed) == ["no_pictures"]


@pytest.mark.parametrize("bits", [1 << 1, 1 << 2, 1 << 3, UNDERVOLTAGE_NOW | 1 << 2])
def test_a_processor_that_is_slowed_down_lowers_it_too_and_keeps_it_there(bits):
    assert levels(follow(40.0, 60, bits=bits)) == ["no_pictures", "half_rate"]
    assert levels(follow(40.0, 600, bits=bits, load=NodeLoad("half_rate", 0.0))) == ["half_rate"]


def test_undervoltage_alone_costs_pictures_and_no_triggers():
    assert levels(follow(40.0, 600, bits=UNDERVOLTAGE_NOW)) == ["no_pictures"]
    assert levels(follow(40.0, 600, bits=UNDERVOLTAGE_NOW, load=NodeLoad("half_rate", 0.0))) == [
        "half_rate",
        "no_pictures",
    ]


@pytest.mark.parametrize("bits", [None, 0, SLOWED_SINCE_START])
def test_the_past_and_the_unknown_lower_nothing(bits):
    assert levels(follow(40.0, 60, bits=bits)) == ["full"]
    assert levels(follow(None, 60, bits=bits)) == ["full"]
    assert SLOWED_NOW & SLOWED_SINCE_START == 0
