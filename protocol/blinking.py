"""Which of a node's lamps are lit at an instant, where one of them blinks by a code.

Node, simulator and solver all ask here.

Time is cut into slots, each with a trigger of the node in its middle: slot k is about the instant k * slot_ns since
the epoch. A code is a set of dark slots out of PERIOD, by the slot's number modulo PERIOD. All clocks agree far better
than a slot is long, so codes need not differ when shifted in time.
"""

from __future__ import annotations

from typing import Final

from buddyline.protocol.clock import trigger_index
from buddyline.protocol.messages import Blink

PERIOD: Final = 10
# Three dark slots in ten: a steady lamp is hardly missed in just these. Dark slots are never neighbours, so a lamp is
# followed from picture to picture, and two codes share one at most. The first three codes share none: two nodes with
# two of them never have a dark lamp at the same time, and three lights are left for a pose.
DARK_SLOTS: Final = (
    (0, 2, 6),
    (1, 4, 7),
    (3, 5, 9),
    (0, 3, 7),
    (0, 5, 8),
    (1, 3, 8),
    (1, 6, 9),
    (2, 4, 9),
    (2, 5, 7),
    (4, 6, 8),
)


def lit(blink: Blink, stamp_ns: int) -> tuple[bool, bool]:
    """Return whether a node's left and right lamp are lit at an instant."""
    shines = trigger_index(stamp_ns, blink.slot_ns) % PERIOD not in DARK_SLOTS[blink.code]
    return shines or blink.lamp == "right", shines or blink.lamp == "left"


def next_slot_ns(blink: Blink, stamp_ns: int) -> int:
    """Return when the slot of an instant ends, and the next one begins."""
    return (trigger_index(stamp_ns, blink.slot_ns) + 1) * blink.slot_ns - blink.slot_ns // 2
