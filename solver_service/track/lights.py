"""Where the lights of one node stand in the other's picture, and how the state's errors move them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.observation import STAMP_SIGMA_S
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, skew
from buddyline.solver_service.track.inputs import FrameSeen
from buddyline.solver_service.track.state import CLOCK, NAV, State
from numpy.typing import NDArray

# The errors that move a light in a picture: NAV of them, and the clock's; and their part of a covariance.
COLUMNS: Final = np.array((*range(NAV), CLOCK))
BLOCK: Final = np.ix_(COLUMNS, COLUMNS)
# Newton's method ends with a step below this: the next would be its square.
SMALL_PX: Final = 1e-4
# No camera takes its pictures faster.
LEAST_APART_S: Final = 1e-3
_NOWHERE: Final = np.full(2, math.nan)


def light_positions(
    state: State, observer: int, lights_m: Floats, rates_radps: Floats, dt_s: Floats
) -> tuple[Floats, Floats]:
    """Give the other node's lights (L, 3) in the observer's camera frame at times dt_s (K,) after the state's.

    Returns X (K, L, 3) and D (K, L, 3, NAV + 2): dX by the errors of COLUMNS, and by the picture's own time.
    rates_radps (2, 3): turn rates. Where all times are one, or there is none, K is 1. A batch of states has leading
    axes, and so have rates, times, X and D.
    Seen by A:  X = R_A^T (r + R_B l)
                dX = R_A^T (dr + dt dv - [r + R_B l]x (phi_B - phi_A)) + R_A^T (v + R_B (w_B x l)) dclock
    Seen by B:  X = R_B^T d, d = R_A l - r
                dX = R_B^T (-dr - dt dv - [r + d]x (phi_A - phi_B)) - R_B^T R_A (w_A x l) dclock
    With B's clock ahead by dclock more than believed, what is called B's state at t was true dclock earlier. The
    displacement that A's own unknown velocity adds is counted to r. Between two times of one picture
                dX/dt = R_A^T (v + R_B (w_B x l)) - w_A x X,    seen by B:  R_B^T (-v + R_A (w_A x l)) - w_B x X
    """
    other = 1 - observer
    # Without a rolling shutter all candidates are of one time.
    alike = bool((dt_s == dt_s[..., :1]).all())
    times = dt_s if not alike else dt_s[..., :1] if dt_s.shape[-1] else np.zeros((*dt_s.shape[:-1], 1))
    r_m, v_mps = state.r_m[..., None, :], state.v_mps[..., None, :]
    # What the other node has turned on, or has yet to turn, by its own clock.
    late_s = np.asarray(state.clock_s if observer == 0 else -state.clock_s)[..., None]
    R_observer = state.R[..., observer, None, :, :] @ turns_over(rates_radps[..., observer, :], times)
    R_other = state.R[..., other, None, :, :] @ turns_over(rates_radps[..., other, :], times + late_s)
    arms = np.swapaxes(R_other @ lights_m.T, -1, -2)  # (T, L, 3)
    across = skew(rates_radps[..., other, :]) @ lights_m.T
    swept = np.swapaxes(R_other @ across[..., None, :, :], -1, -2)
    ahead_s = times + late_s if observer == 0 else times
    r = (r_m + ahead_s[..., None] * v_mps)[..., None, :]
    sign = 1.0 if observer == 0 else -1.0
    d = sign * r + arms
    toward = R_observer.swapaxes(-1, -2)[..., None, :, :]  # (T, 1, 3, 3)
    X = (toward @ d[..., None])[..., 0]
    D = np.zeros((*X.shape, NAV + 2))
    D[..., 0:3] = sign * toward
    D[..., 3:6] = D[..., 0:3] * ahead_s[..., None, None, None]
    turn = toward @ skew((arms if observer == 0 else d) + r_m[..., None, :])
    D[..., 6:9] = turn if observer == 0 else -turn
    D[..., 9:12] = -D[..., 6:9]
    clock = v_mps[..., None, :] + swept if observer == 0 else -swept
    D[..., NAV] = (toward @ clock[..., None])[..., 0]
    moving = (toward @ (sign * v_mps[..., None, :] + swept)[..., None])[..., 0]
    D[..., NAV + 1] = moving + X @ skew(rates_radps[..., observer, None, :])
    return X, D


def with_stamp(P: Floats) -> Floats:
    """Give the covariance (..., C + 1, C + 1) of errors of covariance P (..., C, C), and of a picture's stamp."""
    both = np.zeros((*P.shape[:-2], P.shape[-1] + 1, P.shape[-1] + 1))
    both[..., :-1, :-1], both[..., -1, -1] = P, STAMP_SIGMA_S**2
    return both


def turns_over(rate_radps: Floats, times_s: Floats) -> Floats:
    """Give the turns (..., T, 3, 3) at a rate (..., 3) over times (..., T)."""
    return rotation_exp(rate_radps[..., None, :] * times_s[..., None])


def residuals(bearings: Floats, tangents: Floats, X: Floats, D: Floats) -> tuple[Floats, Floats]:
    """Give how far each candidate (K) stands off each light (L), in px (K, L, 2), and the light's Jacobian.

    bearings (K, 3), tangents (K, 2, 3): of the candidates, as Camera.rays gives them. X (K or 1, L, 3), D (K or 1, L,
    3, C): the lights, as `light_positions` gives them; all with leading axes for a batch of pictures. The picture near
    a candidate is its tangent plane: h = T X / (b . X), dh = (T - h b^T) dX / (b . X); y = -h. Infinite behind the
    camera.
    """
    depth = (X @ bearings[..., None])[..., 0]
    ahead = depth > 1e-3 * np.sqrt((X * X).sum(-1))
    safe = np.where(ahead, depth, 1.0)
    h = X @ tangents.swapaxes(-1, -2) / safe[..., None]
    slope = (tangents[..., None, :, :] - h[..., None] * bearings[..., None, None, :]) / safe[..., None, None]
    H = slope @ D
    y = np.where(ahead[..., None], -h, np.inf)
    return y, H


def in_picture(camera: Camera, at: Floats, margin_px: float = 0.0) -> NDArray[np.bool_]:
    """Whether pixels (..., 2) lie in the picture (...), margin_px from its edges; what is not a number does not."""
    size_px = np.array((camera.width_px, camera.height_px))
    return np.asarray(((at >= margin_px - 0.5) & (at <= size_px - 0.5 - margin_px)).all(axis=-1))


def pixels_of(camera: Camera, X: Floats) -> Floats:
    """Give where points (..., 3) are imaged (..., 2), as `pixel_of` does; not a number where the camera cannot."""
    pixels = [pixel_of(camera, each) for each in X.reshape(-1, 3)]
    return np.array([_NOWHERE if at is None else at for at in pixels]).reshape(*X.shape[:-1], 2)


def pixel_of(camera: Camera, X: Floats) -> Floats | None:
    """Return where a point (3,) of the camera frame is imaged (2,): Newton's method on the inverse model.

    None where the camera cannot image it; the pixel may be outside of the picture.
    """
    x, y, z = X.tolist()
    if camera.model == "pinhole":
        if not z > 0.0:
            return None
        pixel = np.array((camera.cx_px + camera.fx_px * x / z, camera.cy_px + camera.fy_px * y / z))
        if not any(camera.distortion):
            return pixel if math.isfinite(pixel[0]) and math.isfinite(pixel[1]) else None
    else:
        flat = math.hypot(x, y)
        stretch = math.atan2(flat, z) / max(flat, 1e-9)
        pixel = np.array((camera.cx_px + camera.fx_px * x * stretch, camera.cy_px + camera.fy_px * y * stretch))
    with np.errstate(all="ignore"):
        for _ in range(6):
            bearings, tangents = camera.rays(pixel[None])
            depth = float(bearings[0] @ X)
            if not math.isfinite(depth) or depth <= 0.0:
                return None
            step = tangents[0] @ X / depth
            pixel = pixel + step
            if abs(step[0]) + abs(step[1]) < SMALL_PX:
                break
    return pixel


@dataclass(frozen=True, eq=False)
class Sight:
    """One picture as the track uses it: bearings and tangents of its sound candidates.

    t_s: on A's clock as believed; dt_s (K,): of each candidate after it. elsewhere, lasting_s (K,): as in FrameSeen.
    """

    stamp_ns: int
    t_s: float
    node: int
    bearings: Floats
    tangents: Floats
    sigma_px: Floats
    dt_s: Floats
    lasting_s: Floats
    elsewhere: int = 0

    @property
    def clutter(self) -> float:
        """How many candidates chance may have put into the whole picture: all but one, and never none."""
        return max(len(self.bearings) + self.elsewhere - 1.0, 1.0)


def lasting_factor(lasting_s: float, apart_s: float) -> float:
    """Give how many pictures tell as much as one of a light whose errors last, apart_s after it was last used."""
    return 1.0 + lasting_s / max(apart_s, LEAST_APART_S)


def sights_of(rig: Rig, node: int, times_s: Sequence[float], frames: Sequence[FrameSeen]) -> list[Sight]:
    """Prepare the candidates of pictures at these times; those that the camera model does not reach are left out."""
    if not frames:
        return []
    counts = [len(frame.pixels) for frame in frames]
    with np.errstate(all="ignore"):
        bearings, tangents = rig.camera.rays(np.concatenate([frame.pixels.reshape(-1, 2) for frame in frames]))
    sigma_px = np.concatenate([frame.sigma_px for frame in frames])
    sound = np.isfinite(bearings).all(1) & np.isfinite(tangents).all((1, 2)) & np.isfinite(sigma_px) & (sigma_px > 0.0)
    found, first = [], 0
    for t_s, frame, count in zip(times_s, frames, counts, strict=True):
        of, well = slice(first, first + count), sound[first : first + count]
        first += count
        dt_s = np.asarray(frame.dt_ns * 1e-9) if len(frame.dt_ns) else np.zeros(count)
        lasting_s = frame.lasting_s if len(frame.lasting_s) else np.zeros(count)
        bearing, tangent, sigma = bearings[of], tangents[of], sigma_px[of]
        if not well.all():
            bearing, tangent, sigma, dt_s, lasting_s = (
                column[well] for column in (bearing, tangent, sigma, dt_s, lasting_s)
            )
        found.append(Sight(frame.stamp_ns, t_s, node, bearing, tangent, sigma, dt_s, lasting_s, frame.elsewhere))
    return found
