"""The limits of health for node, solver, doctor, monitor and demo. The topics' own limits are in topics.py."""

from __future__ import annotations

import math
from typing import Final

from buddyline.protocol.topics import NODE_STATUS, Topic

# A stream is stale after this many of its periods, or after its topic's stale_s, whichever is longer.
STALE_PERIODS: Final = 3
# A node sends at least its status. After this time without any message, the node or the link is down.
SILENT_S: Final = 1.5 / NODE_STATUS.rate_hz
# All is said to be well only if each node and the solver have said something within this time. A page then shows a cut
# within two seconds.
WELL_S: Final = 1.6
# An estimate of an instant this long before the newest that its nodes have said is of the past, however new it is here.
BEHIND_S: Final = 2.0
# When healthy nodes give no pose for NO_POSE_S, the reasons of the last REASONS_S are shown.
NO_POSE_S: Final = 2.0
REASONS_S: Final = 10.0
# A track covers an instant if the sigma of its position is below this share of the range; else it is uncertain.
TRACK_SIGMA_SHARE: Final = 0.05
# After this time without a light, several triggers, a track is reported to be without lights.
NO_LIGHT_S: Final = 0.5
# Frames of one trigger arrive within the matching window. If their stamps differ by more, two nodes never match.
FRAMES_APART_S: Final = 1.0
# Between the clocks of two nodes. At 1 m/s, 5 ms are 5 mm.
CLOCKS_APART_S: Final = 0.005
# A solver's status has the clocks' offset when its sigma is below this.
REPORTED_OFFSET_SIGMA_S: Final = 0.003
# Between one node's clock and its time server, by chrony's estimate: two nodes then stay within CLOCKS_APART_S.
CLOCK_OFF_S: Final = 0.002
# Between two compasses: several times the sigma of calibrated compasses away from steel.
HEADINGS_APART_RAD: Final = math.radians(20.0)
# Exposures this far from their instant: the other node's are then matched with other places of both.
TRIGGER_OFF_S: Final = 0.01
# A detector that takes this share of a trigger's period is about to lose pictures.
DETECT_SHARE: Final = 0.8
# A Raspberry Pi slows down at 80 degrees.
HOT_DEGC: Final = 70.0
TOO_HOT_DEGC: Final = 80.0
# Bits of a Pi's firmware (vcgencmd get_throttled): now, and since the start. NodeStatus.throttled_bits has them all.
UNDERVOLTAGE_NOW: Final = 1 << 0
SLOWED_NOW: Final = 1 << 1 | 1 << 2 | 1 << 3  # frequency capped, throttled, soft limit of temperature
UNDERVOLTAGE_SINCE_START: Final = UNDERVOLTAGE_NOW << 16
SLOWED_SINCE_START: Final = SLOWED_NOW << 16
POWER_NOW: Final = UNDERVOLTAGE_NOW | SLOWED_NOW
# Of a lithium-ion cell under load: a quarter is left, and the steep end of the curve, where the dive is over.
BATTERY_LOW_CELL_V: Final = 3.5
BATTERY_EMPTY_CELL_V: Final = 3.2
# The disk should have room for a dive with reserve.
DIVE_H: Final = 4.0


def stale_after_s(topic: Topic, period_s: float = 0.0) -> float:
    """Return the age, s, from which a stream is stale. period_s: the trigger period for topics of a frame, 0: none."""
    return max(topic.stale_s, STALE_PERIODS * period_s)
