"""How likely each light is within a picture, and found there: as it was just before, and as the prediction says."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.association import Association
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.lights import SMALL_PX, Sight, light_positions, pixel_of

# A light nearer to the picture's edge need not be found: part of its spot is outside. A light should be found whose
# probability to be further inside is above INSIDE.
EDGE_PX: Final = 2.0
INSIDE: Final = 0.9
# A lamp stays hidden, or in view, for about so long. It is found in a share of its pictures between the next two.
# One that is found most often is hidden as rarely as it is missed while it is in view.
HIDDEN_S: Final = 1.0
MOST_FOUND: Final = 0.97
LEAST_FOUND: Final = 0.02
FOUND_IN_VIEW: Final = math.sqrt(MOST_FOUND)


def share_within(camera: Camera, at: Floats, X: Floats, D: Floats, P: Floats, margin_px: float) -> Floats:
    """Give how likely each light (..., L) lies within the picture, margin_px from its edges.

    at (..., L, 2): its pixel, by `pixels_of`. X (..., L, 3), D (..., L, 3, C): the lights and how errors of covariance
    P (..., C, C) move them, as `light_positions` gives them. The errors of u and v are taken to be independent.
    """
    shares = np.zeros(X.size // 3)
    lights = np.flatnonzero(np.isfinite(at[..., 0]))
    if len(lights):
        pixels, of_all = at.reshape(-1, 2)[lights], X.reshape(-1, 3)[lights]
        _, tangents = camera.rays(pixels)
        J = tangents @ D.reshape(-1, *D.shape[-2:])[lights] / np.sqrt((of_all**2).sum(axis=1))[:, None, None]
        P_of_each = P.reshape(-1, *P.shape[-2:])[lights // X.shape[-2]]
        found = np.array(_shares(camera, pixels, (J @ P_of_each * J).sum(axis=2), margin_px))
        # The model of a distorted lens ends outside of the picture.
        shares[lights] = np.where(found > 0.0, found, 0.0)
    return shares.reshape(X.shape[:-1])


def share_before(
    camera: Camera, X: Floats, D: Floats, P: Floats, margin_px: float, y: Floats, H: Floats, sigma_px: Floats
) -> tuple[float, Floats]:
    """Give how likely a light (3,), D (3, C), was within an earlier picture, and the same if it is each candidate now.

    X, D: at that picture's time. y (K, 2), H (K, 2, C), sigma_px (K,): of the candidates, as `residuals` gives them.
    """
    at = pixel_of(camera, X)
    if at is None:
        return 0.0, np.zeros(len(y))
    J = camera.rays(at[None])[1][0] @ D / np.linalg.norm(X)
    across, of_all = P @ H.swapaxes(1, 2), P @ J.T
    S = H @ across + sigma_px[:, None, None] ** 2 * np.eye(2)
    gain = np.swapaxes(np.linalg.solve(S, H @ of_all), 1, 2)
    moved = (gain @ np.where(np.isfinite(y), y, 0.0)[..., None])[..., 0]
    first = (J * of_all.T).sum(axis=1)
    less = (gain * (J @ across)).sum(axis=2)
    before, *if_now = _shares(camera, np.vstack((at, at + moved)), np.vstack((first, first - less)), margin_px)
    return before, np.array(if_now)


def _shares(camera: Camera, at: Floats, variances_px2: Floats, margin_px: float) -> list[float]:
    """Give how likely pixels (N, 2), whose variances (N, 2) are independent, lie in the picture."""
    size_px = np.array((camera.width_px, camera.height_px))
    reach_px = np.sqrt(2.0 * np.maximum(variances_px2, SMALL_PX))
    near, far = (margin_px - 0.5 - at) / reach_px, (size_px - 0.5 - margin_px - at) / reach_px
    return [
        math.prod(0.5 * (math.erf(b) - math.erf(a)) for a, b in zip(below, above, strict=True))
        for below, above in zip(near.tolist(), far.tolist(), strict=True)
    ]


def found_now(estimate: Estimate, observer: int, t_s: float) -> Floats:
    """Give how likely each light (2,) in an observer's picture at t_s is found: as just before, or as it is on average.

    A lamp that is known not to be lit is not found. Starts compete by how often each has a lamp found, not by its being
    missing for long: a wrong one would have its missing lamp explained.
    """
    share: Floats = estimate.detection[observer]
    if not estimate.confirmed:
        return share.copy()
    kept = math.exp(-max(t_s - estimate.shown_s[observer], 0.0) / HIDDEN_S)
    both = zip(share.tolist(), estimate.shown[observer].tolist(), strict=True)
    return np.array(
        [min(max(lit + kept * (now - lit), LEAST_FOUND), MOST_FOUND) if lit > 0.0 else 0.0 for lit, now in both]
    )


def learn_found(
    estimate: Estimate, observer: int, t_s: float, found: Floats, within: Floats, association: Association
) -> None:
    """Take into an estimate whether each light that should be in a picture was seen there (2,).

    found (2,): how likely that was, by `found_now`. A lamp that is not seen may be in view and missed, too. A picture
    with a candidate that may be either light teaches nothing: the next ones would repeat what it says of the two.
    """
    estimate.shown[observer], estimate.shown_s[observer] = found, t_s
    missing = (found * (1.0 - association.seen)).tolist()
    for _, light, _ in association.chosen:
        missing[light] = 0.0
    estimate.missing[observer] = missing
    if association.ambiguous:
        return
    shares = estimate.detection[observer].tolist()
    of_each = zip(shares, found.tolist(), within.tolist(), association.seen.tolist(), strict=True)
    for light, (share, likely, inside, seen) in enumerate(of_each):
        if share > 0.0:
            if inside > INSIDE:
                followed = share + 0.05 * (seen - share)
                estimate.detection[observer, light] = min(max(followed, LEAST_FOUND), MOST_FOUND)
            unseen = likely * (1.0 - FOUND_IN_VIEW * inside) / (1.0 - likely * inside)
            estimate.shown[observer, light] = FOUND_IN_VIEW * seen + (1.0 - seen) * unseen


def by_last_picture(
    estimate: Estimate, sight: Sight, rigs: tuple[Rig, Rig], within: Floats, y: Floats, H: Floats, P: Floats
) -> tuple[Floats, Floats | None]:
    """Give how likely each light is within a picture, and log odds (K, 2) of its candidates, by the observer's last.

    A light that was not seen there, and was in view, was outside. So it has come in since, or is outside still: it is
    hardly a candidate that stands where it would have been in the last picture, too. No odds where all were seen.
    rigs: the observer's, the other's. within (2,): by the prediction alone. y (K, 2, 2), H (K, 2, 2, C): of the
    candidates, as `residuals` gives them; P (C, C): covariance of the errors.
    """
    missing = estimate.missing[sight.node].tolist()
    if not estimate.confirmed or not any(missing):
        return within, None
    own, other = rigs
    then_s = np.array((estimate.shown_s[sight.node] - estimate.t_s,))
    X, D = light_positions(estimate.state, sight.node, other.lights_m, estimate.rates_radps, then_s)
    now, logs = within.copy(), np.zeros(y.shape[:2])
    for light, c in enumerate(missing):
        of_all = y[:, light], H[:, light], sight.sigma_px
        before, if_now = share_before(own.camera, X[0, light], D[0, light], P, EDGE_PX, *of_all)
        logs[:, light] = np.log((1.0 - c * if_now) / (1.0 - c * before))
        now[light] = max(within[light] - c * min(within[light], before), 0.0) / (1.0 - c * before)
    return now, logs
