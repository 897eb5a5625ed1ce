"""The codes by which lamps blink."""

from itertools import combinations

import pytest
from buddyline.protocol.blinking import DARK_SLOTS, PERIOD, lit, next_slot_ns
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Blink

SLOT_NS = S_NS // 10


def test_a_lamp_is_dark_in_three_slots_of_ten_and_never_in_two_on_end():
    for code in DARK_SLOTS:
        assert len(set(code)) == 3
        assert all((slot + 1) % PERIOD not in code for slot in code)


def test_codes_differ_in_two_slots_at_least_and_the_first_three_in_all():
    assert all(len(set(one) & set(two)) <= 1 for one, two in combinations(DARK_SLOTS, 2))
    assert all(not set(one) & set(two) for one, two in combinations(DARK_SLOTS[:3], 2))


@pytest.mark.parametrize(
    ("lamp", "dark"), [("left", (False, True)), ("right", (True, False)), ("both", (False, False))]
)
def test_the_lamp_that_is_switched_is_dark(lamp, dark):
    blink = Blink(code=1, lamp=lamp, slot_ns=SLOT_NS)
    seen = [lit(blink, k * SLOT_NS) for k in range(20)]
    assert [k for k, one in enumerate(seen) if one == dark] == [1, 4, 7, 11, 14, 17]
    assert all(one in (dark, (True, True)) for one in seen)


@pytest.mark.parametrize("slot_ns", [SLOT_NS, 33_333_333, 7])
def test_a_trigger_is_in_the_middle_of_its_slot(slot_ns):
    blink = Blink(code=0, lamp="both", slot_ns=slot_ns)
    base = 1_764_000_000 * S_NS // slot_ns // PERIOD * PERIOD
    for k in range(base, base + PERIOD):
        end_ns = next_slot_ns(blink, k * slot_ns)
        assert 2 * end_ns - (2 * k + 1) * slot_ns in (0, 1)
        assert lit(blink, end_ns - 1) == lit(blink, k * slot_ns)
        assert lit(blink, end_ns) == lit(blink, (k + 1) * slot_ns)
