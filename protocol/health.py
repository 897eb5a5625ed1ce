"""The limits that node, solver, doctor, monitor and demo judge by: one table, beside the topics' own (topics.py)."""

from __future__ import annotations

import math
from typing import Final

from buddyline.protocol.topics import NODE_STATUS, Topic

# A stream is stale once this many of its periods have passed, where that is longer than its topic's stale_s.
STALE_PERIODS: Final = 3
# A node says something with each status. Without anything for this long, node or link is down.
SILENT_S: Final = 1.5 / NODE_STATUS.rate_hz
# A pair whose nodes are well, without a pose for this long, is told why; over these last seconds the reasons count.
NO_POSE_S: Final = 2.0
REASONS_S: Final = 10.0
# A track covers an instant where its position's sigma is below this share of the range; else it is uncertain.
TRACK_SIGMA_SHARE: Final = 0.05
# A track that has used no light for longer than this is told to be without: several triggers.
NO_LIGHT_S: Final = 0.5
# Frames of one instant arrive within the matching window; with stamps further apart nothing of two nodes matches.
FRAMES_APART_S: Final = 1.0
# Two nodes' clocks. At 1 m/s, 5 ms are 5 mm.
CLOCKS_APART_S: Final = 0.005
# One node's clock from its time server, as chrony estimates it: two nodes together stay within the limit above.
CLOCK_OFF_S: Final = 0.002
# Two calibrated compasses away from steel: several times what they say of themselves.
HEADINGS_APART_RAD: Final = math.radians(20.0)
# A Raspberry Pi slows down at 80 degrees.
HOT_DEGC: Final = 70.0
TOO_HOT_DEGC: Final = 80.0
# A dive, with reserve: how long the disk should last.
DIVE_H: Final = 4.0


def stale_after_s(topic: Topic, period_s: float = 0.0) -> float:
    """Return the age from which a stream is stale. period_s: how often a frame's topics are due, where known."""
    return max(topic.stale_s, STALE_PERIODS * period_s)
