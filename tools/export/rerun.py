"""A dive as a recording of rerun (.rrd): nodes in space, pictures with candidates, the log, all numbers as series.

Entities have the topics' names. A field that is a number, or a list of numbers, is a series below its message
(`pair/a/b/track/t_a_b_m`), with all digits; what is drawn in space has single precision, as rerun draws it. The
timeline `stamp` is the messages' own time.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from buddyline.protocol.messages import (
    Attitude,
    Candidates,
    CompressedImage,
    Depth,
    NodeInfo,
    NodePose,
    RelativePose,
    Track,
)
from buddyline.protocol.topics import NET_POSE
from buddyline.tools.dives import Dive
from buddyline.tools.export.enu import BaseCamera, NetDepths, net_enu
from buddyline.tools.export.formats import check_shows
from buddyline.tools.export.foxglove import LAMP_M, LEFT, OTHER, RIGHT, SERIES, base_of, nets_of, track_of
from buddyline.tools.extras import needed
from buddyline.tools.health.words import Sayings
from buddyline.tools.newfile import new_file


def export(dive: Dive, output: Path, what: str | None = None) -> int:
    """Write a dive into output, which must not exist; return how many of its messages it has.

    what: "poses" leaves the track out; None: with the track if there is one.
    """
    # It only writes a file: no usage is reported.
    os.environ.setdefault("RERUN_ANALYTICS", "0")
    rerun = needed("rerun", "--format rerun", "rerun", "rerun-sdk")
    track = track_of(dive, what)
    count = 0
    with new_file(output) as part:
        recording: Any = rerun.RecordingStream("buddyline")
        recording.save(part)
        drawing = _Drawing(rerun, recording, dive, track)
        left_out = () if track else ("track", "track_lag")
        topics = ("candidates", "image", *(name for name in SERIES if name not in left_out))
        for envelope in dive.messages(*topics, doing="export"):
            entity = envelope.key.removeprefix("buddyline/")
            recording.set_time("stamp", timestamp=np.datetime64(envelope.stamp_ns, "ns"))
            if envelope.topic.name in SERIES:
                for name, values in _series(msgspec.to_builtins(envelope.message)):
                    recording.log(f"{entity}/{name}", rerun.Scalars(values))
            if envelope.topic is NET_POSE and isinstance(envelope.message, NodePose):
                drawing.take_placed(envelope.message)
            else:
                drawing.take(envelope.message, is_track=envelope.topic.name == track)
            count += 1
        recording.disconnect()
        check_shows(dive, count)
    return count


def _series(message: dict[str, Any], path: str = "") -> Iterator[tuple[str, list[float]]]:
    """Yield a message's fields that are numbers or lists of numbers, with those of nested objects."""
    for name, value in message.items():
        if isinstance(value, dict):
            yield from _series(value, f"{path}{name}/")
        elif isinstance(value, list | tuple) and value and all(_is_number(x) for x in value):
            yield f"{path}{name}", [float(x) for x in value]
        elif _is_number(value):
            yield f"{path}{name}", [float(value)]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


class _Drawing:
    """What is drawn: world is east, north, up; A's camera is in it, B's camera in A's, by the track or by poses.

    Nodes of a net are in the net's frame, and nothing else places them.
    """

    def __init__(self, rerun: Any, recording: Any, dive: Dive, track: str | None) -> None:
        self._rr, self._log, self._track = rerun, recording.log, track
        self._nets = nets_of(dive)
        self._depths = NetDepths()
        self._camera = BaseCamera()
        self._camera.base = base_of(dive)
        self._camera.infos.update(dive.infos())
        self._base = self._camera.base or "a"
        self._sayings = Sayings()
        recording.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for info in dive.infos().values():
            self._rig(info)

    def take(self, message: Any, *, is_track: bool) -> None:
        """Draw one message. is_track: of the track that places B."""
        rr = self._rr
        if isinstance(message, NodeInfo | Depth):
            self._camera.take(message)
        elif isinstance(message, Attitude):
            self._stand(message.node, message.stamp_ns, self._camera.orientation(message))
        elif isinstance(message, CompressedImage):
            node = message.frame_id.removesuffix("_camera")
            picture = rr.EncodedImage(contents=message.data, media_type=f"image/{message.format}")
            self._log(f"{self._eye(node)}/picture", picture)
        elif isinstance(message, Candidates):
            places = [(blob.u_px, blob.v_px) for blob in message.blobs]
            self._log(
                f"{self._eye(message.node)}/picture/candidates", rr.Points2D(places, colors=_rgb(OTHER), radii=4.0)
            )
        elif is_track or (isinstance(message, RelativePose) and self._track is None):
            self._place(message)
        for name, _, text in self._sayings.new(message):
            self._log(f"log/{name.replace(' ', '/')}", rr.TextLog(text))

    def _eye(self, node: str) -> str:
        """Return a camera's entity: in its net; without one A's in the world, the others in A's."""
        if node in self._nets:
            return f"world/net_{self._nets[node]}/{node}"
        return f"world/{node}" if node == self._base else f"{self._eye(self._base)}/{node}"

    def take_placed(self, pose: NodePose) -> None:
        """Draw a node in its net, and how deep the net is."""
        rr, net = self._rr, f"world/net_{pose.net}"
        at_m, R = net_enu(pose)
        self._log(self._eye(pose.node), rr.Transform3D(translation=at_m, mat3x3=R))
        self._log(f"{net}/trail_{pose.node}", rr.Points3D([at_m], colors=_rgb(OTHER), radii=0.02))
        up_m = self._depths.up_m(pose, self._camera)
        if up_m is not None:
            self._log(net, rr.Transform3D(translation=(0.0, 0.0, up_m)))

    def _stand(self, node: str, stamp_ns: int, R_enu_camera: Any) -> None:
        """Draw where A stands in the world; R_enu_camera: None for nothing."""
        if R_enu_camera is not None and node not in self._nets:
            at_m = self._camera.position_m(node, stamp_ns)
            self._log(self._eye(node), self._rr.Transform3D(translation=at_m, mat3x3=R_enu_camera))

    def _place(self, estimate: Track | RelativePose) -> None:
        # An entity has one place in the tree: of other pairs than A's nothing is drawn.
        if estimate.node_a != self._base or estimate.node_b in self._nets:
            return
        rr = self._rr
        turn = rr.Quaternion(xyzw=estimate.q_a_b_xyzw)
        self._log(self._eye(estimate.node_b), rr.Transform3D(translation=estimate.t_a_b_m, quaternion=turn))
        if isinstance(estimate, Track):
            self._stand(estimate.node_a, estimate.stamp_ns, self._camera.tracked(estimate))
        if not isinstance(estimate.t_ned_m, msgspec.UnsetType):
            north_m, east_m, down_m = estimate.t_ned_m
            at_m = self._camera.position_m(estimate.node_a, estimate.stamp_ns) + np.array((east_m, north_m, -down_m))
            self._log(f"world/trail_{estimate.node_b}", rr.Points3D([at_m], colors=_rgb(OTHER), radii=0.02))

    def _rig(self, info: NodeInfo) -> None:
        """Draw a node's bar, its lamps and its camera's view."""
        rr, eye, camera = self._rr, self._eye(info.node), info.camera
        lights = [info.light_left_m, info.light_right_m]
        lamps = rr.Points3D(lights, colors=[*_rgb(LEFT), *_rgb(RIGHT)], radii=LAMP_M / 2)
        self._log(f"{eye}/bar", rr.LineStrips3D([lights]), static=True)
        self._log(f"{eye}/lamps", lamps, static=True)
        pinhole = rr.Pinhole(
            focal_length=(camera.fx_px, camera.fy_px),
            principal_point=(camera.cx_px, camera.cy_px),
            resolution=(info.width_px, info.height_px),
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.35,
        )
        self._log(f"{eye}/picture", pinhole, static=True)


def _rgb(colour: tuple[float, float, float]) -> list[tuple[int, int, int]]:
    red, green, blue = (round(255 * x) for x in colour)
    return [(red, green, blue)]
