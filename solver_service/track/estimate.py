"""One hypothesis of a track."""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.compasses import north_doubt
from buddyline.solver_service.geometry.rotation import Floats, rotation_log
from buddyline.solver_service.track.scale import ScaleGap
from buddyline.solver_service.track.shaking import Shaking
from buddyline.solver_service.track.state import MOVING, PHI, SIZE, State
from buddyline.solver_service.track.trail import Chosen, EstimateStatus, Trail
from buddyline.solver_service.track.vibration import SHARES, Shares
from buddyline.solver_service.track.walking import Walking

# A lamp and its reflection look like a bar for no longer than this.
REFLECTED_S: Final = 4.5
# A challenger that has not replaced the track after so long is dropped.
CHALLENGE_S: Final = 4.0


@dataclass(eq=False)
class Estimate:
    """One hypothesis of where the nodes are, and how well it has explained the pictures since its start.

    The filter: rates_radps (2, 3): the turn rates at t_s. shaking: how much the units are shaken in their mounts, as
    learned from the lights' residuals; shaken (3, MOVING, MOVING), by_shaking (MOVING, 3): derivatives of the
    covariance and of the state by the logs of its variances. walking: how much the units' biases walk, or the nodes
    themselves, learned once the track is confirmed and the clocks' offset known; follows_walk: since then. learns:
    whether walks and shares are learned. wide: whether the place was poorly known at the last picture. without: which
    nodes have no inertial unit now. turning_off: of each, the lasting part (3,) of what its attitudes are off their
    prediction, in sigmas. by_shares (SIZE, 4): how the state would be moved by a share of 1 of the samples' fast parts;
    shares: what the lights tell of them (vibration.py). by_scale (SIZE,), scale: the same of a gap between both bars
    (scale.py). attitude_s, depth_s: when attitudes and depths were last used. compasses: each node's heading as its
    last attitude had it, minus the track's, rad, and the variance that it stated, rad^2. north_doubt: the variance,
    rad^2, that north has beside the covariance, as the compasses contradict each other.

    The lights: detection (2, 2): by observer and light, how often a light in the picture is found; shown (2, 2): how
    likely it was to be found at shown_s, by observer, after the last picture had told; missing (2, 2): how likely it
    would have been seen there if it was within that picture, 0 where it was seen. last_seen (2,): the probability
    that each light is among the last picture's candidates, None where not both should be in it. lit_s (2, 2): when each
    was last used. light_s: when any was, at first the start, which is made of lights; lit_m: the range then.
    trigger_lights: time, observer and light of those of the last trigger. pictures: how many it has taken since it is
    confirmed; bare: of these, how many while a node had no inertial unit. lit_pictures: in how many of each node any
    light was used. bars: how many pictures showed both lights, bar_s: when one last did; late_bars: how many did from
    REFLECTED_S after the start on. missed: in how many of each node's last pictures, on end, a light should be and none
    was used. looks_away: whether each node's last picture has shown none, wherever they should be. unseen_by: a node
    that has shown no light yet.

    How well it fits: evidence: log odds over clutter; evidence_by: of each node's pictures. baseline: the main
    estimate's at the start. chi2: of the lights used; chi2_dof: of how many residuals; lasting_dof: of how many with
    errors that last. agreed_s: when a fix last agreed with it, inf where none did; agreed: how many did;
    contradicted: how many since then did not; gap_chi2: the running mean of the fixes' chi^2.

    Its life: searched: it started without a fix; lone: from single lamps. skip_s: pictures within this after start_s
    made it, or a fix that it took in their place, and tell nothing new. patience_s: how long it may stay unconfirmed.
    end_s: later pictures are not its own. While it is not confirmed, of each picture: evidence_history: its time and
    the evidence then; used: its lights, by node and stamp; seen_history: node of the lamps, time and last_seen. given:
    the lights to use where that is decided.
    """

    t_s: float
    state: State
    covariance: Floats
    start_s: float
    evidence: float = 0.0
    evidence_by: list[float] = field(default_factory=lambda: [0.0, 0.0])
    baseline: float = 0.0
    detection: Floats = field(default_factory=lambda: np.full((2, 2), 0.8))
    rates_radps: Floats = field(default_factory=lambda: np.zeros((2, 3)))
    shown: Floats = field(default_factory=lambda: np.full((2, 2), 0.8))
    shown_s: list[float] = field(default_factory=lambda: [-np.inf, -np.inf])
    missing: Floats = field(default_factory=lambda: np.zeros((2, 2)))
    lit_s: Floats = field(default_factory=lambda: np.full((2, 2), -np.inf))
    light_s: float = -np.inf
    lit_m: float = math.nan
    trigger_lights: list[tuple[float, int, int]] = field(default_factory=list)
    attitude_s: list[float] = field(default_factory=lambda: [-np.inf, -np.inf])
    depth_s: float = -np.inf
    compasses: list[tuple[float, float]] = field(default_factory=lambda: [(0.0, np.inf), (0.0, np.inf)])
    north_doubt: float = 0.0
    steps: Trail = field(default_factory=Trail)
    confirmed: bool = False
    shaking: Shaking = field(default_factory=Shaking)
    shaken: Floats = field(default_factory=lambda: np.zeros((3, MOVING, MOVING)))
    by_shaking: Floats = field(default_factory=lambda: np.zeros((MOVING, 3)))
    walking: Walking = field(default_factory=Walking)
    learns: bool = True
    follows_walk: bool = False
    wide: bool = False
    chi2: float = 0.0
    chi2_dof: int = 0
    lasting_dof: int = 0
    end_s: float = np.inf
    skip_s: float = 0.02
    patience_s: float = CHALLENGE_S
    looks_away: list[bool] = field(default_factory=lambda: [False, False])
    unseen_by: int | None = None
    searched: bool = False
    lone: bool = False
    pictures: int = 0
    bare: int = 0
    bars: int = 0
    late_bars: int = 0
    bar_s: float = -np.inf
    lit_pictures: list[int] = field(default_factory=lambda: [0, 0])
    missed: list[int] = field(default_factory=lambda: [0, 0])
    without: list[bool] = field(default_factory=lambda: [False, False])
    by_shares: Floats = field(default_factory=lambda: np.zeros((SIZE, SHARES)))
    shares: Shares = field(default_factory=Shares)
    by_scale: Floats = field(default_factory=lambda: np.zeros(SIZE))
    scale: ScaleGap = field(default_factory=ScaleGap)
    turning_off: list[Floats] = field(default_factory=lambda: [np.zeros(3), np.zeros(3)])
    agreed_s: float = np.inf
    agreed: int = 0
    contradicted: int = 0
    gap_chi2: float = 0.0
    used: dict[tuple[int, int], Chosen] = field(default_factory=dict)
    given: dict[tuple[int, int], Chosen] = field(default_factory=dict)
    evidence_history: list[tuple[float, float]] = field(default_factory=list)
    last_seen: Floats | None = None
    seen_history: list[tuple[int, float, Floats]] = field(default_factory=list)

    def __post_init__(self) -> None:
        """No light is older than the start."""
        self.light_s = max(self.light_s, self.start_s)
        if math.isnan(self.lit_m):
            self.lit_m = float(self.state.range_m)

    def take_compass(self, node: int, off_rad: float, variance: float) -> None:
        """Note by how much a node's compass is off the track's heading, and the variance that it states."""
        self.compasses[node] = off_rad, variance
        off, stated = np.array(self.compasses).T
        if np.isfinite(stated).all():
            about_down = [phi.stop - 1 for phi in PHI]
            self.north_doubt = north_doubt(off, stated, self.covariance[np.ix_(about_down, about_down)])

    @property
    def lights(self) -> int:
        """Give how many lights the last trigger's pictures told."""
        return len({(observer, light) for _, observer, light in self.trigger_lights})

    @property
    def status(self) -> EstimateStatus:
        """What rows tell of it now, beside its state."""
        return EstimateStatus(self.light_s, self.lit_m, self.lights, self.north_doubt)

    def copied(self, **changes: object) -> Estimate:
        """Give an estimate that goes its own way from here."""
        of_nodes = (
            "evidence_by",
            "attitude_s",
            "compasses",
            "lit_pictures",
            "missed",
            "looks_away",
            "without",
            "turning_off",
            "shown_s",
        )
        lists = *of_nodes, "trigger_lights", "evidence_history", "seen_history"
        own: dict[str, object] = {name: list(getattr(self, name)) for name in lists}
        own |= {
            "detection": self.detection.copy(),
            "shown": self.shown.copy(),
            "lit_s": self.lit_s.copy(),
            "missing": self.missing.copy(),
        }
        own |= {"steps": self.steps.copy(), "used": dict(self.used)}
        return replace(self, **(own | changes))  # type: ignore[arg-type]

    def gained_since(self, t_s: float) -> float:
        """Give the evidence gained after t_s."""
        at = bisect.bisect_right(self.evidence_history, t_s, key=_first)
        return self.evidence - (self.evidence_history[at - 1][1] if at else 0.0)


def lead(one: Estimate, other: Estimate) -> float:
    """Give by how much one has explained the pictures better since both exist."""
    since_s = max(one.start_s, other.start_s)
    return one.gained_since(since_s) - other.gained_since(since_s)


def _first(item: tuple[float, float]) -> float:
    return item[0]


def same_pose(one: Estimate, other: Estimate) -> bool:
    """Whether two estimates are of one pose: a twentieth of the range and 0.06 rad."""
    if one.unseen_by != other.unseen_by:
        return False
    range_m = float(np.linalg.norm(other.state.r_m))
    first, second = (e.state.R[0].T @ e.state.r_m for e in (one, other))
    if np.linalg.norm(first - second) > 0.05 * range_m:
        return False
    turned, meant = (e.state.R[0].T @ e.state.R[1] for e in (one, other))
    return float(np.linalg.norm(rotation_log(turned @ meant.T))) < 0.06
