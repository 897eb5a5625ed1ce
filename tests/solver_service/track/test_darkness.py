"""What a track tells where no light is seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from buddyline.solver_service.track.dive import smooth
from buddyline.solver_service.track.lag import KEPT_S, TrackLag
from buddyline.solver_service.track.output import WORST_SHARE, TrackRow

from tests.solver_service.track.dives import EPOCH_NS, KnownDive, Setting, filter_of, make

LIT_S = 10.0
DARK_S = 8.0


def dive_that_drifts(*, dark_first: bool) -> KnownDive:
    """Near nodes with light for ten seconds, and none for eight, in which B's unit is off by 1 m/s^2."""
    dark_s = (0.0, DARK_S) if dark_first else (LIT_S, LIT_S + DARK_S)
    dive = make(2, Setting(seconds=LIT_S + DARK_S, poor=True, near_m=1.2, far_m=2.0, dark_s=dark_s))
    a, b = dive.records
    times_s = (b.imu_stamps_ns - EPOCH_NS) / 1e9
    off = ((times_s >= dark_s[0]) & (times_s < dark_s[1]))[:, None] * np.array((1.0, 0.0, 0.0))
    return replace(dive, records=(a, replace(b, accel_mps2=b.accel_mps2 + off)))


def told(dive: KnownDive, mode: str) -> list[TrackRow]:
    if mode == "smooth":
        return list(smooth(dive.records, dive.fixes, dive.stamps_ns).rows)
    track = filter_of(dive.records, dive.fixes, keep_s=KEPT_S)
    lag, late, live = TrackLag(track), [], []
    for k in range(0, len(dive.stamps_ns), 10):
        due = dive.stamps_ns[k : k + 10]
        live += track.advance(due[-1] + 60_000_000, due)
        lag.ask(due)
        late += lag.rows()
    return late if mode == "lag" else live


@pytest.mark.parametrize(("mode", "dark_first"), [("filter", False), ("lag", False), ("smooth", True)])
def test_what_has_drifted_away_in_darkness_is_told_no_longer(mode: str, *, dark_first: bool) -> None:
    """The farther an estimate drifts, the larger is its own range; its sigma is judged by that at the nearest light."""
    dive = dive_that_drifts(dark_first=dark_first)
    rows = told(dive, mode)
    times_s = np.array([(row.stamp_ns - EPOCH_NS) / 1e9 for row in rows])
    dark = times_s < DARK_S if dark_first else times_s > LIT_S
    light = dive.stamps_ns.index(EPOCH_NS + round((DARK_S if dark_first else LIT_S) * 1e9))
    lit_m = np.linalg.norm(dive.t_a_b_m[light])
    sigmas_m = np.sqrt([np.trace(row.covariance[:3, :3]) for row in rows])
    assert dark.sum() > 20
    assert (~dark).sum() > 100
    assert sigmas_m[dark].max() < 1.1 * WORST_SHARE * lit_m
