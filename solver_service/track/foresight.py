"""Where the track expects the other node's lights in a picture that is still to be taken."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.forecasts import Forecast, StateNow
from buddyline.solver_service.track.inputs import TrackNode
from buddyline.solver_service.track.lights import in_picture, light_positions, pixel_of, with_stamp
from buddyline.solver_service.track.moving import HOLD_S
from buddyline.solver_service.track.state import State

# How the nodes may move otherwise than at their last rates, 1 sd: a diver who turns his head, and who swims off.
TURN_RADPS2: Final = 0.12
PUSH_MPS2: Final = 0.1
# A picture further ahead of the track than this is not foretold.
FURTHEST_S: Final = 0.5
# A light whose place is worse known than this share of the picture's width is not foretold.
WORST_SHARE: Final = 0.04
STEP_S: Final = 0.01


@dataclass(frozen=True, eq=False)
class ForeseenLight:
    """A light of the other node, 0 left or 1 right, in a coming picture: pixel_px (2,), covariance_px2 (2, 2).

    rate_pxps (2,): how the place moves. sigma_rate_pxps: by how much its sigma grows with each second.
    """

    light: int
    pixel_px: Floats
    covariance_px2: Floats
    rate_pxps: Floats
    sigma_rate_pxps: float


@dataclass(frozen=True, eq=False)
class Foresight:
    """A track at present, when each observer's next picture is due, and which lights are dark (node, light)."""

    nodes: Sequence[TrackNode]
    present: Forecast
    at_s: Mapping[int, float]
    dark: frozenset[tuple[int, int]]

    def lights(self) -> dict[int, list[ForeseenLight]]:
        """Return, by observer, the other node's lights that should be in its picture at its stamp, on its own clock.

        A light that is dark, outside of the picture, or whose place is poorly known is left out.
        """
        return {observer: self._seen_by(observer, t_s - self.present.t_s) for observer, t_s in self.at_s.items()}

    def _seen_by(self, observer: int, ahead_s: float) -> list[ForeseenLight]:
        other, rigs = 1 - observer, [node.rig for node in self.nodes]
        lit = [light for light in (0, 1) if (other, light) not in self.dark]
        return _foreseen(rigs[observer].camera, rigs[other].lights_m, observer, lit, ahead_s, self.present.now)


def foresee(track: TrackFilter, known_ns: int, stamps_ns: Mapping[int, int]) -> Foresight | None:
    """Return what foretells the pictures of these stamps, by observer and of its own clock; None where nothing does.

    known_ns: up to which the track has been given everything.
    """
    now_s = track.seconds(0, known_ns) - HOLD_S
    at_s = {observer: track.seconds(observer, stamp_ns) for observer, stamp_ns in stamps_ns.items()}
    near = {observer: t_s for observer, t_s in at_s.items() if now_s < t_s <= now_s + FURTHEST_S}
    present = track.present(now_s) if near else None
    if present is None:
        return None
    dark = frozenset((node, light) for node, light, _ in track.lamps.dark())
    return Foresight(track.nodes, present, near, dark)


def _foreseen(
    camera: Camera, lights_m: Floats, observer: int, lit: Sequence[int], ahead_s: float, present: StateNow
) -> list[ForeseenLight]:
    P, times_s = with_stamp(present.covariance), np.array((ahead_s, ahead_s + STEP_S))
    X, D = light_positions(State(present.row), observer, lights_m, present.rates_radps, times_s)
    found = []
    for light in lit:
        at, later = (pixel_of(camera, X[k, light]) for k in (0, 1))
        if at is None or later is None or not in_picture(camera, at):
            continue
        bearing, tangents = (values[0] for values in camera.rays(at[None]))
        J = tangents @ D[0, light] / float(bearing @ X[0, light])
        px_per_rad = math.hypot(*tangents[0].tolist())
        range_m = math.hypot(*X[0, light].tolist())
        # Twice the integral of an unknown acceleration: of the turn, and of the way seen from so far.
        growth = px_per_rad * math.hypot(TURN_RADPS2, PUSH_MPS2 / range_m)
        covariance = J @ P @ J.T + (0.5 * growth * ahead_s**2) ** 2 * np.eye(2)
        (uu, uv), (_, vv) = covariance.tolist()
        # The larger eigenvalue.
        worst_px2 = 0.5 * (uu + vv) + math.hypot(0.5 * (uu - vv), uv)
        if not 0.0 < worst_px2 < (WORST_SHARE * camera.width_px) ** 2:
            continue
        rate_pxps = (later - at) / STEP_S
        found.append(ForeseenLight(light, at, covariance, rate_pxps, growth * ahead_s))
    return found
