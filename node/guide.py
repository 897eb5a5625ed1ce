"""Where to look in the next picture: where the solver expects the lights, else where the last pictures had them.

A guided search looks at regions around these places only. The whole picture is searched wherever regions may hide
something: at least once a second; when an expected light is not in its region; when an expectation is too wide; when
the last picture did not show the expected light; when there are too many lamps. A wrong expectation costs one search.
A lamp that is dark by its code is not looked for, and is followed through its dark pictures.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import msgspec
from buddyline.node.detect.detection import LIKELY, Detection, Region, is_likely, score_of
from buddyline.protocol.blinking import lit
from buddyline.protocol.clock import S_NS
from buddyline.protocol.envelope import Refusals
from buddyline.protocol.messages import Expect
from buddyline.protocol.topics import EXPECT
from msgspec import UNSET

if TYPE_CHECKING:
    from buddyline.protocol.bus import Received

# The whole picture is searched again after this time; at 10 Hz, with jitter, that is before a second is over.
WHOLE_EVERY_NS: Final = 9 * S_NS // 10
# An expectation may be for a time this much later than the picture's.
AHEAD_NS: Final = S_NS // 2
# The expectations of so many other nodes are kept.
MAX_SEEN: Final = 4
# Lengths as shares of the picture's width. A candidate may be so far from its light, however sure the expectation is.
FLOOR: Final = 0.012
# Regions of a larger radius do not guide: in a wide one, another lamp may be taken for the light of an uncertain track.
WIDEST: Final = 0.08
# How much a lamp's speed in the picture may change in a second, and the speed before it is known (widths, 1 sd).
CHANGE_PER_S2: Final = 0.55
UNKNOWN_PER_S: Final = 0.1
FASTEST_PER_S: Final = 20.0
SIGMAS: Final = 3.0
# More regions cost as much as the whole picture.
MAX_REGIONS: Final = 5
# An expected light is found where a candidate is at least this likely, or has this share of its last score.
FAINTEST: Final = 0.1
FADED: Final = 0.5
# Without a solver, at least STEADY_LAMPS lamps must each be in STEADY pictures in a row.
STEADY: Final = 3
STEADY_LAMPS: Final = 2


@dataclass(frozen=True, slots=True)
class Followed:
    """A candidate of the last picture. rate_pxps: (u, v), None before it has been in two. pictures: in a row."""

    u_px: float
    v_px: float
    light_px: float
    score: float
    rate_pxps: tuple[float, float] | None = None
    pictures: int = 1


@dataclass(frozen=True, slots=True)
class Foretold:
    """Where the solver expects a light: sigma_px at the picture's time. dark: its lamp is switched off then."""

    u_px: float
    v_px: float
    sigma_px: float
    radius_px: float
    dark: bool = False


@dataclass(frozen=True, slots=True)
class SearchPlan:
    """What to do with a picture. foretold: where lights are expected. regions: to search; None for the whole picture.

    anchors: of the first regions, the score that a candidate needs in each; without one the light is lost. dark: where
    lamps are that are switched off.
    """

    foretold: tuple[Foretold, ...]
    regions: tuple[Region, ...] | None = None
    anchors: tuple[float, ...] = ()
    dark: tuple[Foretold, ...] = ()

    def is_lost(self, found: Sequence[Detection]) -> bool:
        """Return whether a light that should be in its region is in none of its candidates."""
        regions = self.regions or ()
        return any(
            not any(score_of(d.blob) >= least and _within(d, region) for d in found)
            for region, least in zip(regions, self.anchors, strict=False)
        )


class Guide:
    """Plans the search of one node's pictures. Expectations come from another thread than pictures.

    guided, whole: number of pictures searched in each way. refused: number of expectations that could not be used.
    """

    def __init__(self, node: str) -> None:
        self.node = node
        self.guided = self.whole = self.refused = 0
        self.refusals = Refusals(f"node {node}")
        self._lock = threading.Lock()
        self._expected: dict[str, Expect] = {}
        self._followed: list[Followed] = []
        self._stamp_ns = 0
        self._whole_ns: int | None = None
        self._elsewhere = 0
        self._solvers: set[str] = set()

    def saw_process(self, name: str, alive: bool) -> None:
        """Note that a process has joined or left the bus; without a solver the last pictures alone guide."""
        with self._lock:
            if name.startswith("solver/"):
                (self._solvers.add if alive else self._solvers.discard)(name)

    def hear(self, received: Received) -> None:
        """Take an expectation from the bus; count and report any other payload."""
        envelope = self.refusals.open(received)
        if envelope is not None and isinstance(envelope.message, Expect):
            self.expect(envelope.message)

    def expect(self, message: Expect) -> None:
        """Take an expectation of the solver; one for another node is refused."""
        with self._lock:
            if message.node != self.node:
                self.refused += 1
                return
            self._expected.pop(message.seen, None)
            self._expected[message.seen] = message
            while len(self._expected) > MAX_SEEN:
                self._expected.pop(next(iter(self._expected)))

    def plan(self, stamp_ns: int, width_px: int, height_px: int, *, whole: bool = False) -> SearchPlan:
        """Return how to search the picture taken at stamp_ns. whole: search the whole picture in any case."""
        places = self._foretell(stamp_ns, width_px, height_px)
        foretold = tuple(place for place in places or () if not place.dark)
        dark = tuple(place for place in places or () if place.dark)
        since_ns = math.inf if self._whole_ns is None else stamp_ns - self._whole_ns
        step_s = (stamp_ns - self._stamp_ns) / S_NS
        if whole or places is None or not 0 <= since_ns < WHOLE_EVERY_NS or step_s <= 0.0:
            return SearchPlan(foretold, dark=dark)
        lamps = [_moved(one, step_s, width_px) for one in self._followed]
        # A solver that expects nothing has no track, and needs whole pictures to start one.
        planned = None if self._solvers else _around_steady(lamps)
        if foretold:
            planned = _around_expected(foretold, lamps)
        if planned is None or len(planned[0]) > MAX_REGIONS:
            return SearchPlan(foretold, dark=dark)
        regions, anchors = planned
        if any(region.radius_px > WIDEST * width_px for region in regions):
            return SearchPlan(foretold, dark=dark)
        return SearchPlan(foretold, tuple(regions), tuple(anchors), dark)

    def learn(
        self,
        stamp_ns: int,
        found: Sequence[Detection],
        width_px: int,
        *,
        whole: bool,
        sized: bool = True,
        dark: Sequence[Foretold] = (),
    ) -> None:
        """Follow the candidates of the picture taken at stamp_ns, and the lamps that were dark in it.

        whole: whether all of it was searched. sized: whether the lights have the size that they have in the next
        picture. A picture with another exposure shows another size, and does not count as the last whole picture.
        """
        step_s = (stamp_ns - self._stamp_ns) / S_NS
        before = [_moved(one, step_s, width_px) for one in self._followed] if 0.0 < step_s < 1.0 else []
        hidden = [
            lamp
            for lamp, radius_px in before
            if any(math.hypot(lamp.u_px - at.u_px, lamp.v_px - at.v_px) <= at.radius_px for at in dark)
            and not any(_away(d, lamp.u_px, lamp.v_px) <= radius_px for d in found)
        ]
        self._followed = [_follow(d, before, self._followed, step_s, sized=sized) for d in found] + hidden
        self._stamp_ns = stamp_ns
        if whole:
            self.whole += 1
            if sized:
                self._whole_ns, self._elsewhere = stamp_ns, len(found)
        else:
            self.guided += 1

    def elsewhere(self, found: int) -> int:
        """Return how many candidates more than `found`, those of a guided picture, the last whole picture had."""
        return max(self._elsewhere - found, 0)

    def _foretell(self, stamp_ns: int, width_px: int, height_px: int) -> list[Foretold] | None:
        """Return where lights are expected in a picture; [] if the solver says nothing, None if nothing useful."""
        with self._lock:
            expected = list(self._expected.values())
        found = []
        for message in expected:
            ahead_ns = stamp_ns - message.stamp_ns
            if not -AHEAD_NS <= ahead_ns <= min(message.valid_ns, EXPECT.stale_s * S_NS):
                continue
            ahead_s = ahead_ns / S_NS
            shines = (True, True) if message.blink is UNSET else lit(message.blink, stamp_ns)
            for light in message.lights:
                dark = not shines[0 if light.side == "left" else 1]
                uu, uv, vv = light.covariance_px2
                widest_px2 = 0.5 * (uu + vv) + math.hypot(0.5 * (uu - vv), uv)
                sigma_px = math.sqrt(widest_px2) + light.sigma_rate_pxps * abs(ahead_s)
                u = light.u_px + light.rate_pxps[0] * ahead_s
                v = light.v_px + light.rate_pxps[1] * ahead_s
                radius_px = SIGMAS * sigma_px + FLOOR * width_px
                if math.hypot(*light.rate_pxps) > FASTEST_PER_S * width_px or radius_px > WIDEST * width_px:
                    self.refused += 1
                    return None
                if -0.5 <= u <= width_px - 0.5 and -0.5 <= v <= height_px - 0.5:
                    found.append(Foretold(u, v, max(sigma_px, 0.1 * FLOOR * width_px), radius_px, dark))
        return found


def expected_first(found: list[Detection], foretold: Sequence[Foretold]) -> tuple[list[Detection], int]:
    """Return the candidates with the expected ones first, and how many these are.

    An expected candidate is a likely one near an expected place. It gets the picture's best score: all likely lamps
    have nearly the same one, the other node's and strange ones. Of two near one place, the likelier by score and by
    distance in sigmas is the expected one.
    """
    first: list[int] = []
    for place in foretold:
        near = [
            (_log_odds(d) - 0.5 * (_away(d, place.u_px, place.v_px) / place.sigma_px) ** 2, i)
            for i, d in enumerate(found)
            if i not in first and is_likely(d.blob) and _away(d, place.u_px, place.v_px) <= place.radius_px
        ]
        if near:
            first.append(max(near)[1])
    if not first:
        return found, 0
    best = max(score_of(d.blob) for d in found)
    chosen = [replace(found[i], blob=msgspec.structs.replace(found[i].blob, score=best)) for i in sorted(first)]
    return chosen + [d for i, d in enumerate(found) if i not in first], len(first)


Planned = tuple[list[Region], list[float]]


def _around_expected(foretold: Sequence[Foretold], lamps: Sequence[tuple[Followed, float]]) -> Planned | None:
    """Return regions around expected lights, then around the other lamps; None where a light's size is not known."""
    regions, anchors = [], []
    for place in foretold:
        near = [
            (lamp.score, i)
            for i, (lamp, _) in enumerate(lamps)
            if math.hypot(lamp.u_px - place.u_px, lamp.v_px - place.v_px) <= place.radius_px
        ]
        if not near:
            return None
        lamp, _ = lamps[max(near)[1]]
        regions.append(Region((place.u_px, place.v_px), place.radius_px, lamp.light_px))
        anchors.append(max(FAINTEST, min(FADED * lamp.score, LIKELY)))
    expected = tuple(regions)
    for lamp, radius_px in lamps:
        covered = any(
            math.hypot(lamp.u_px - r.centre_px[0], lamp.v_px - r.centre_px[1]) <= r.radius_px for r in expected
        )
        if lamp.score >= LIKELY and not covered:
            regions.append(_region(lamp, radius_px))
    return regions, anchors


def _around_steady(lamps: Sequence[tuple[Followed, float]]) -> Planned | None:
    """Return regions around the lamps of the last pictures, the steady ones first; None where there are too few."""
    likely = [(lamp, sigma) for lamp, sigma in lamps if lamp.score >= LIKELY]
    steady = [one for one in likely if one[0].pictures >= STEADY]
    if len(steady) < STEADY_LAMPS:
        return None
    ordered = steady + [one for one in likely if one[0].pictures < STEADY]
    return [_region(lamp, sigma) for lamp, sigma in ordered], [FADED * LIKELY] * len(steady)


def _moved(one: Followed, step_s: float, width_px: int) -> tuple[Followed, float]:
    """Return a candidate as it should be step_s later, and the radius, px, within which it should be then."""
    if one.rate_pxps is None:
        return one, (FLOOR + SIGMAS * UNKNOWN_PER_S * step_s) * width_px
    moved = replace(one, u_px=one.u_px + one.rate_pxps[0] * step_s, v_px=one.v_px + one.rate_pxps[1] * step_s)
    return moved, (FLOOR + SIGMAS * 0.5 * CHANGE_PER_S2 * step_s**2) * width_px


def _follow(
    d: Detection,
    moved: Sequence[tuple[Followed, float]],
    before: Sequence[Followed],
    step_s: float,
    *,
    sized: bool,
) -> Followed:
    """Return a candidate, with its speed if the last picture had it. moved, before: those of the last picture."""
    blob = d.blob
    light_px = math.sqrt(blob.area_px / math.pi)
    near = [
        (_away(d, one.u_px, one.v_px), i)
        for i, (one, radius_px) in enumerate(moved)
        if _away(d, one.u_px, one.v_px) <= radius_px
    ]
    if not near:
        return Followed(blob.u_px, blob.v_px, light_px, score_of(blob))
    last = before[min(near)[1]]
    rate_pxps = (blob.u_px - last.u_px) / step_s, (blob.v_px - last.v_px) / step_s
    light_px = light_px if sized else last.light_px
    return Followed(blob.u_px, blob.v_px, light_px, score_of(blob), rate_pxps, last.pictures + 1)


def _region(lamp: Followed, radius_px: float) -> Region:
    return Region((lamp.u_px, lamp.v_px), radius_px, lamp.light_px)


def _log_odds(d: Detection) -> float:
    score = min(max(score_of(d.blob), 1e-6), 1.0 - 1e-6)
    return math.log(score / (1.0 - score))


def _away(d: Detection, u_px: float, v_px: float) -> float:
    return math.hypot(d.blob.u_px - u_px, d.blob.v_px - v_px)


def _within(d: Detection, region: Region) -> bool:
    return _away(d, *region.centre_px) <= region.radius_px + region.light_px
