"""The true places of the other node's lights in a picture, and whether a pose used the right candidates."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from buddyline.protocol.messages import CameraModel, Candidates, LightTruth, NodeInfo, RelativePose
from buddyline.tools.evaluation.rotation import Floats, conjugate, rotate
from buddyline.tools.evaluation.truth import TruthTrack
from msgspec import UNSET
from numpy.typing import NDArray

NAMES: Final = ("left", "right")


def tolerance_px(width_px: int) -> float:
    """Return the greatest distance of a candidate that counts as a light: 3 px or 1 % of the width, the greater."""
    return max(3.0, 0.01 * width_px)


@dataclass(frozen=True, eq=False)
class TrueLights:
    """The other node's left and right light in one picture.

    pixels: (2, 2), NaN for a light without a projection. visible: (2,). marked: from LightTruth; else projected from
    the true pose, without regard to obstacles. range_m: the true range, NaN if unknown.
    """

    pixels: Floats
    visible: NDArray[np.bool_]
    marked: bool
    range_m: float


@dataclass(frozen=True, eq=False)
class Blobs:
    """One picture's candidates: pixels (N, 2) and their sigma_px (N,)."""

    pixels: Floats
    sigma_px: Floats
    tolerance_px: float

    @classmethod
    def of(cls, frame: Candidates) -> Blobs:
        """Return a frame's candidates as arrays."""
        pixels = np.array([(blob.u_px, blob.v_px) for blob in frame.blobs]).reshape(-1, 2)
        sigma_px = np.array([blob.sigma_px for blob in frame.blobs])
        return cls(pixels, sigma_px, tolerance_px(frame.width_px))

    def distances_px(self, lights: TrueLights) -> Floats:
        """Return the distance of each candidate from the left and the right light, (N, 2); inf where unknown."""
        away = np.linalg.norm(self.pixels[:, None, :] - lights.pixels[None, :, :], axis=-1)
        known: Floats = np.where(np.isnan(away), np.inf, away)
        return known


def project(points_c_m: Floats, camera: CameraModel) -> Floats:
    """Project points (N, 3) of the camera frame to distorted pixels (N, 2) by OpenCV's model.

    NaN behind the camera, and beyond the fold, where the distortion polynomial leads back into the picture.
    """
    matrix = np.array([[camera.fx_px, 0.0, camera.cx_px], [0.0, camera.fy_px, camera.cy_px], [0.0, 0.0, 1.0]])
    distortion = np.array(camera.distortion)
    ahead = points_c_m[:, 2] > 1e-6
    normalized = points_c_m[:, :2] / np.where(ahead, points_c_m[:, 2], 1.0)[:, None]
    # Along the line from the centre to a point within the fold, the image moves outward everywhere.
    steps = np.linspace(0.0, 1.0, 33)[1:]
    way = np.ones((len(points_c_m), len(steps), 3))
    way[:, :, :2] = normalized[:, None, :] * steps[:, None]
    flat, zero = way.reshape(-1, 1, 3), np.zeros(3)
    if not len(flat):
        return np.empty((0, 2))
    model = cv2.fisheye.projectPoints if camera.model == "fisheye" else cv2.projectPoints
    imaged: Floats = np.asarray(model(flat, zero, zero, matrix, distortion)[0], dtype=np.float64)
    imaged = imaged.reshape((*way.shape[:2], 2))
    radius = np.linalg.norm((imaged - (camera.cx_px, camera.cy_px)) / (camera.fx_px, camera.fy_px), axis=-1)
    outward = (np.diff(radius, axis=1) >= -1e-9).all(axis=1)
    pixels: Floats = imaged[:, -1].copy()
    pixels[~(ahead & outward)] = np.nan
    return pixels


def _projected(
    frames: Sequence[Candidates], track: TruthTrack, own: NodeInfo, other: NodeInfo, *, is_a: bool
) -> Iterator[tuple[Candidates, TrueLights]]:
    """Yield the frames of one node with a known true pose, with the other node's projected lights."""
    known = [(frame, pose) for frame in frames if (pose := track.at(frame.stamp_ns, frame.trigger)) is not None]
    t = np.array([pose[0] for _, pose in known]).reshape(-1, 1, 3)
    q = np.array([pose[1] for _, pose in known]).reshape(-1, 1, 4)
    if not is_a:
        q = conjugate(q)
        t = -rotate(q, t)
    points_c_m = rotate(q, np.array([[other.light_left_m, other.light_right_m]])) + t
    pixels = project(points_c_m.reshape(-1, 3), own.camera).reshape(-1, 2, 2)
    half = np.array([own.width_px, own.height_px]) / 2.0
    inside = np.asarray((np.abs(pixels - half + 0.5) <= half).all(axis=-1))
    for i, (frame, _) in enumerate(known):
        yield frame, TrueLights(pixels[i], inside[i], marked=False, range_m=float(np.linalg.norm(t[i])))


def _marked(truth: LightTruth, track: TruthTrack, other: str) -> TrueLights:
    """Return the lights of the node `other`; a light that names no node is of it."""
    pixels = np.full((2, 2), np.nan)
    visible = np.zeros(2, dtype=bool)
    for light in truth.lights:
        if light.node is not UNSET and light.node != other:
            continue
        side = NAMES.index(light.name)
        pixels[side] = light.u_px, light.v_px
        visible[side] = light.visible
    known = track.at(truth.stamp_ns, truth.trigger)
    range_m = np.nan if known is None else float(np.linalg.norm(known[0]))
    return TrueLights(pixels, visible, marked=True, range_m=range_m)


def true_lights(
    nodes: tuple[str, str],
    frames: Collection[Candidates],
    light_truths: Iterable[LightTruth],
    infos: Mapping[str, NodeInfo],
    track: TruthTrack,
) -> dict[tuple[str, int], TrueLights]:
    """Return the true lights by node and trigger: from LightTruth, or projected for a node without it."""
    others = {nodes[0]: nodes[1], nodes[1]: nodes[0]}
    lights = {
        (truth.node, truth.trigger): _marked(truth, track, others[truth.node])
        for truth in light_truths
        if truth.node in nodes
    }
    marked = {node for node, _ in lights}
    if not all(node in infos for node in nodes):
        return lights
    for node, other in (nodes, nodes[::-1]):
        if node not in marked:
            own = [frame for frame in frames if frame.node == node]
            for frame, seen in _projected(own, track, infos[node], infos[other], is_a=node == nodes[0]):
                lights[node, frame.trigger] = seen
    return lights


def is_right_pair(
    pose: RelativePose, blobs: Mapping[tuple[str, int], Blobs], lights: Mapping[tuple[str, int], TrueLights]
) -> bool | None:
    """Return whether a pose used the other node's true lights in both pictures, left as left and right as right.

    None if the candidates or the true lights of a picture are not known.
    """
    for node, taken in ((pose.node_a, pose.blobs_a), (pose.node_b, pose.blobs_b)):
        seen, true = blobs.get((node, pose.trigger)), lights.get((node, pose.trigger))
        if seen is None or true is None:
            return None
        away = seen.distances_px(true)
        for side, index in enumerate(taken):
            if not 0 <= index < len(away) or away[index, side] > seen.tolerance_px:
                return False
    return True
