"""A dive as Foxglove's own messages, which Foxglove, Lichtblick and rerun draw without any set-up.

World is east, north, up with its origin on the surface above A, or at A where no depth is known. A stands in it by
its attitude and depth, and B in A's camera frame by the track, or by the poses where there is no track. A track takes
north from both compasses: A is then turned so that B is where the track says, north-east-down. Nodes of a net
stand in the net's frame (`net_main`, here east, north, up), which is as deep in the world as a node of it says. A
node's path is a line: of its places in the net, or of the track's in north-east-down, as seen from A. All rigs are a
scene; what nodes and solver report, and why a trigger gave no pose, is a log. For plots the log's own messages follow,
byte for byte (JSON with schema), under their own keys. Beside OUTPUT lies OUTPUT.layout.json: import it as a layout,
and all of it is in place.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.divelog import CHUNK_NS
from buddyline.protocol.envelope import Envelope
from buddyline.protocol.messages import (
    Attitude,
    Blob,
    Candidates,
    CompressedImage,
    Depth,
    Message,
    NodeInfo,
    NodePose,
    RelativePose,
    Track,
)
from buddyline.protocol.schemas import json_schema
from buddyline.protocol.topics import NET_POSE, TRACK, TRACK_LAG
from buddyline.solver_service.geometry.rotation import matrix_to_quat, quat_to_matrix
from buddyline.tools.dives import Dive
from buddyline.tools.export.enu import R_ENU_NED, BaseCamera, FrameTree, NetDepths, net_enu
from buddyline.tools.export.formats import check_shows
from buddyline.tools.export.foxglove_layout import LOG, TRANSFORMS, WORLD, layout
from buddyline.tools.extras import needed
from buddyline.tools.health.words import Sayings
from buddyline.tools.monitor.frames import rig_outline
from buddyline.tools.newfile import check_new, new_file, write_new
from msgspec import UNSET

KEPT_FRAMES: Final = 256
DISTORTION_MODELS: Final = {"pinhole": "plumb_bob", "fisheye": "kannala_brandt"}
# A's attitude until it is known: level, looking north.
R_ENU_LEVEL: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
# The path is written in pieces of this length, so that it can be watched as it grows.
PATH_NS: Final = S_NS
LAMP_M: Final = 0.07
# What is passed on as it is, for plots. Candidates and inertial samples are many, and no viewer plots them.
SERIES: Final = (
    *("pose", "track", "track_lag", "rejected", "truth", "attitude", "depth", "node_status", "solver_status"),
    *("info", "net_pose", "net_truth"),
)
NO_NETS: Final[Mapping[str, str]] = {}
LEFT, RIGHT, OTHER = (1.0, 0.25, 0.25), (0.54, 1.0, 0.76), (1.0, 0.83, 0.3)


class FoxgloveTranslation:
    """Translates a dive's messages into Foxglove's, one by one.

    tracked: pairs whose track, not poses, places B. nets: the net of each node that a net places, and nothing else.
    """

    def __init__(
        self, schemas: Any, tracked: Collection[tuple[str, ...]] = (), nets: Mapping[str, str] = NO_NETS
    ) -> None:
        self._fox = schemas
        self._tracked = set(tracked)
        self._nets = nets
        self._depths = NetDepths()
        self._paths: dict[tuple[str, str], list[tuple[Track, Any]]] = {}
        self._net_paths: dict[tuple[str, str], list[NodePose]] = {}
        self._frames: dict[str, deque[Candidates]] = {}
        self._camera = BaseCamera()
        self._tree = FrameTree()
        self._sayings = Sayings()

    def start(self, infos: dict[str, NodeInfo], base: str | None, at_ns: int) -> Iterator[tuple[str, int, Any]]:
        """Yield the messages before the dive's first: A level at the origin, or the net. base: A's id."""
        self._camera.infos.update(infos)
        self._camera.base = base
        for net in sorted(set(self._nets.values())):
            yield TRANSFORMS, at_ns, self._transform(WORLD, f"net_{net}", np.zeros(3), np.eye(3), at_ns)
        if base is not None and base not in self._nets:
            yield TRANSFORMS, at_ns, self._transform(WORLD, f"{base}_camera", np.zeros(3), R_ENU_LEVEL, at_ns)

    def messages(self, envelope: Envelope) -> Iterator[tuple[str, int, Any]]:
        """Yield (topic, stamp_ns, Foxglove message) for one of ours."""
        message = envelope.message
        if isinstance(message, NodeInfo):
            self._camera.take(message)
            yield f"/{message.node}/rig", message.stamp_ns, self._rig(message)
        elif isinstance(message, Depth):
            self._camera.take(message)
        elif isinstance(message, Attitude):
            yield from self._attitude(message)
        elif isinstance(message, CompressedImage):
            yield from self._image(envelope.node, message)
        elif isinstance(message, Candidates):
            self._frames.setdefault(message.node, deque(maxlen=KEPT_FRAMES)).append(message)
            yield f"/{message.node}/camera/candidates", message.stamp_ns, self._candidates(message)
        elif isinstance(message, RelativePose):
            yield from self._pose(message)
        elif isinstance(message, Track):
            yield from self._track(message)
        elif isinstance(message, NodePose) and envelope.topic is NET_POSE:
            yield from self._node_pose(message)
        for name, level, text in self._sayings.new(message):
            fox, at = self._fox, self._time(envelope.stamp_ns)
            line = fox.Log(timestamp=at, level=getattr(fox.LogLevel, level), name=name, message=text)
            yield LOG, envelope.stamp_ns, line

    def _rig(self, info: NodeInfo) -> Any:
        """Return a node as a scene that moves with its camera: the bar, both lamps, and the edges of its view."""
        fox, outline = self._fox, rig_outline(info)
        width_m, height_m, depth_m = outline["corners"]
        rim = [(x * width_m, y * height_m, depth_m) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))]
        view = [point for corner in rim for point in ((0.0, 0.0, 0.0), corner)]
        at_rest = self._quaternion(np.eye(3))
        lines = [
            fox.LinePrimitive(
                type=fox.LinePrimitiveLineType.LineStrip,
                pose=fox.Pose(position=self._vector(np.zeros(3)), orientation=at_rest),
                thickness=2.0,
                scale_invariant=True,
                points=[fox.Point3(x=x, y=y, z=z) for x, y, z in points],
                color=fox.Color(r=0.8, g=0.8, b=0.8, a=1.0),
            )
            for points in (view, rim, outline["lights"])
        ]
        spheres = [
            fox.SpherePrimitive(
                pose=fox.Pose(position=self._vector(np.array(light)), orientation=at_rest),
                size=fox.Vector3(x=LAMP_M, y=LAMP_M, z=LAMP_M),
                color=fox.Color(r=colour[0], g=colour[1], b=colour[2], a=1.0),
            )
            for light, colour in zip(outline["lights"], (LEFT, RIGHT), strict=True)
        ]
        entity = fox.SceneEntity(
            timestamp=self._time(info.stamp_ns),
            frame_id=f"{info.node}_camera",
            id=f"rig {info.node}",
            frame_locked=True,
            lines=lines,
            spheres=spheres,
        )
        return fox.SceneUpdate(entities=[entity])

    def _attitude(self, attitude: Attitude) -> Iterator[tuple[str, int, Any]]:
        yield from self._base(attitude.node, attitude.stamp_ns, self._camera.orientation(attitude))

    def _base(self, node: str, stamp_ns: int, R_enu_camera: Any) -> Iterator[tuple[str, int, Any]]:
        """Yield the transform of the node that stands in the world; R_enu_camera: None for none."""
        if R_enu_camera is not None and node not in self._nets:
            position_m = self._camera.position_m(node, stamp_ns)
            yield TRANSFORMS, stamp_ns, self._transform(WORLD, f"{node}_camera", position_m, R_enu_camera, stamp_ns)

    def _image(self, node: str, image: CompressedImage) -> Iterator[tuple[str, int, Any]]:
        stamp_ns = image.stamp_ns
        info = self._camera.infos.get(node)
        if info is not None:
            yield f"/{node}/camera/calibration", stamp_ns, self._calibration(info, stamp_ns)
        picture = self._fox.CompressedImage(
            timestamp=self._time(stamp_ns), frame_id=f"{node}_camera", data=image.data, format=image.format
        )
        yield f"/{node}/camera/image", stamp_ns, picture

    def _calibration(self, info: NodeInfo, stamp_ns: int) -> Any:
        camera = info.camera
        K = [camera.fx_px, 0.0, camera.cx_px, 0.0, camera.fy_px, camera.cy_px, 0.0, 0.0, 1.0]
        return self._fox.CameraCalibration(
            timestamp=self._time(stamp_ns),
            frame_id=f"{info.node}_camera",
            width=info.width_px,
            height=info.height_px,
            distortion_model=DISTORTION_MODELS[camera.model],
            D=camera.distortion,
            K=K,
            R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            P=[*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0],
        )

    def _candidates(self, frame: Candidates) -> Any:
        circles = [self._ring(frame, blob, OTHER, 2.6) for blob in frame.blobs]
        return self._fox.ImageAnnotations(timestamp=self._time(frame.stamp_ns), circles=circles)

    def _ring(self, frame: Candidates, blob: Blob, colour: tuple[float, float, float], per_cent: float) -> Any:
        fox, unit_px = self._fox, frame.width_px / 100
        return fox.CircleAnnotation(
            timestamp=self._time(frame.stamp_ns),
            position=fox.Point2(x=blob.u_px, y=blob.v_px),
            diameter=per_cent * unit_px,
            thickness=0.4 * unit_px,
            outline_color=fox.Color(r=colour[0], g=colour[1], b=colour[2], a=1.0),
        )

    def _pose(self, pose: RelativePose) -> Iterator[tuple[str, int, Any]]:
        fox, stamp_ns = self._fox, pose.stamp_ns
        base, child = f"{pose.node_a}_camera", f"{pose.node_b}_camera"
        t_m, R = np.array(pose.t_a_b_m), quat_to_matrix(np.array(pose.q_a_b_xyzw))
        if (pose.node_a, pose.node_b) not in self._tracked and self._places(pose):
            yield TRANSFORMS, stamp_ns, self._transform(base, child, t_m, R, stamp_ns)
        placed = fox.PoseInFrame(
            timestamp=self._time(stamp_ns),
            frame_id=base,
            pose=fox.Pose(position=self._vector(t_m), orientation=self._quaternion(R)),
        )
        yield f"/pair/{pose.node_a}/{pose.node_b}/pose", stamp_ns, placed
        for node, chosen in ((pose.node_a, pose.blobs_a), (pose.node_b, pose.blobs_b)):
            frame = next((f for f in reversed(self._frames.get(node, ())) if f.trigger == pose.trigger), None)
            if frame is not None and max(chosen) < len(frame.blobs):
                yield f"/{node}/camera/chosen", frame.stamp_ns, self._chosen(frame, chosen)

    def _places(self, estimate: Track | RelativePose) -> bool:
        """Return whether it places B: not where a net or another pair does, nor the node that stands in the world."""
        a, b = estimate.node_a, estimate.node_b
        return b != self._camera.base and b not in self._nets and self._tree.place(a, b, estimate.stamp_ns)

    def _track(self, track: Track) -> Iterator[tuple[str, int, Any]]:
        base, child = f"{track.node_a}_camera", f"{track.node_b}_camera"
        t_m, R = np.array(track.t_a_b_m), quat_to_matrix(np.array(track.q_a_b_xyzw))
        if self._places(track):
            yield TRANSFORMS, track.stamp_ns, self._transform(base, child, t_m, R, track.stamp_ns)
            yield from self._base(track.node_a, track.stamp_ns, self._camera.tracked(track))
        piece = self._paths.setdefault((track.node_a, track.node_b), [])
        piece.append((track, self._camera.position_m(track.node_a, track.stamp_ns)))
        if track.stamp_ns - piece[0][0].stamp_ns >= PATH_NS:
            yield self._path(piece)
            del piece[:-1]

    def _node_pose(self, pose: NodePose) -> Iterator[tuple[str, int, Any]]:
        """Yield a node's pose in its net's frame, the transform, and how deep the net's frame is."""
        fox, stamp_ns, frame = self._fox, pose.stamp_ns, f"net_{pose.net}"
        at_m, R = net_enu(pose)
        yield TRANSFORMS, stamp_ns, self._transform(frame, f"{pose.node}_camera", at_m, R, stamp_ns)
        placed = fox.PoseInFrame(
            timestamp=self._time(stamp_ns),
            frame_id=frame,
            pose=fox.Pose(position=self._vector(at_m), orientation=self._quaternion(R)),
        )
        yield f"/net/{pose.net}/{pose.node}/pose", stamp_ns, placed
        up_m = self._depths.up_m(pose, self._camera)
        if up_m is not None:
            net_m = np.array([0.0, 0.0, up_m])
            yield TRANSFORMS, stamp_ns, self._transform(WORLD, frame, net_m, np.eye(3), stamp_ns)
        piece = self._net_paths.setdefault((pose.net, pose.node), [])
        piece.append(pose)
        if stamp_ns - piece[0].stamp_ns >= PATH_NS:
            yield self._net_path(piece)
            piece[:] = [pose]

    def paths(self) -> Iterator[tuple[str, int, Any]]:
        """Yield the unfinished pieces of the paths, at the end of the dive."""
        for piece in self._paths.values():
            if len(piece) > 1:
                yield self._path(piece)
        for in_net in self._net_paths.values():
            if len(in_net) > 1:
                yield self._net_path(in_net)

    def _path(self, piece: list[tuple[Track, Any]]) -> tuple[str, int, Any]:
        """Return a piece of B's path: in the world if A's attitude is known, else in A's camera frame.

        piece: rows of the track, each with A's place.
        """
        first, last = piece[0][0], piece[-1][0]
        known = [R_ENU_NED @ np.array(one.t_ned_m) + at_m for one, at_m in piece if one.t_ned_m is not UNSET]
        if len(known) == len(piece):
            frame, points_m = WORLD, np.array(known)
        else:
            frame, points_m = f"{first.node_a}_camera", np.array([one.t_a_b_m for one, _ in piece])
        scene = self._line(frame, f"path {first.stamp_ns}", first.stamp_ns, points_m)
        return f"/pair/{first.node_a}/{first.node_b}/path", last.stamp_ns, scene

    def _net_path(self, piece: list[NodePose]) -> tuple[str, int, Any]:
        """Return a piece of a node's path in its net's frame."""
        first, points_m = piece[0], np.array([pose.p_m for pose in piece]) @ R_ENU_NED.T
        scene = self._line(f"net_{first.net}", f"path {first.node} {first.stamp_ns}", first.stamp_ns, points_m)
        return f"/net/{first.net}/{first.node}/path", piece[-1].stamp_ns, scene

    def _line(self, frame: str, name: str, stamp_ns: int, points_m: Any) -> Any:
        """Return points (n, 3) of a frame as a line of the scene. name: its own."""
        fox = self._fox
        line = fox.LinePrimitive(
            type=fox.LinePrimitiveLineType.LineStrip,
            pose=fox.Pose(position=self._vector(np.zeros(3)), orientation=self._quaternion(np.eye(3))),
            thickness=2.0,
            scale_invariant=True,
            points=[fox.Point3(x=x, y=y, z=z) for x, y, z in points_m.tolist()],
            color=fox.Color(r=OTHER[0], g=OTHER[1], b=OTHER[2], a=1.0),
        )
        entity = fox.SceneEntity(timestamp=self._time(stamp_ns), frame_id=frame, id=name, lines=[line])
        return fox.SceneUpdate(entities=[entity])

    def _chosen(self, frame: Candidates, chosen: tuple[int, int]) -> Any:
        fox = self._fox
        circles, texts = [], []
        for index, name, colour in zip(chosen, "LR", (LEFT, RIGHT), strict=True):
            if index < 0:
                continue
            blob = frame.blobs[index]
            circles.append(self._ring(frame, blob, colour, 4.4))
            texts.append(
                fox.TextAnnotation(
                    timestamp=self._time(frame.stamp_ns),
                    position=fox.Point2(x=blob.u_px, y=blob.v_px - 0.03 * frame.width_px),
                    text=name,
                    font_size=0.03 * frame.width_px,
                    text_color=fox.Color(r=colour[0], g=colour[1], b=colour[2], a=1.0),
                )
            )
        return fox.ImageAnnotations(timestamp=self._time(frame.stamp_ns), circles=circles, texts=texts)

    def _transform(self, parent: str, child: str, t_m: Any, R: Any, stamp_ns: int) -> Any:
        fox = self._fox
        x, y, z = (float(value) for value in t_m)
        return fox.FrameTransforms(
            transforms=[
                fox.FrameTransform(
                    timestamp=self._time(stamp_ns),
                    parent_frame_id=parent,
                    child_frame_id=child,
                    translation=fox.Vector3(x=x, y=y, z=z),
                    rotation=self._quaternion(R),
                )
            ]
        )

    def _time(self, stamp_ns: int) -> Any:
        return self._fox.Timestamp(sec=stamp_ns // S_NS, nsec=stamp_ns % S_NS)

    def _vector(self, t_m: Any) -> Any:
        x, y, z = (float(value) for value in t_m)
        return self._fox.Vector3(x=x, y=y, z=z)

    def _quaternion(self, R: Any) -> Any:
        x, y, z, w = (float(value) for value in matrix_to_quat(R))
        return self._fox.Quaternion(x=x, y=y, z=z, w=w)


def export(dive: Dive, output: Path, what: str | None = None) -> int:
    """Write a dive as Foxglove messages into output, which must not exist; return how many there are.

    what: "poses" leaves the track out, "track" asks for one; None: with the track if there is one.
    """
    from mcap.writer import CompressionType, Writer

    fox = needed("foxglove.messages", "--format foxglove", "foxglove", "foxglove-sdk")

    layout_path = output.with_name(f"{output.name}.layout.json")
    check_new(layout_path)
    track = track_of(dive, what)
    nets = nets_of(dive)
    translation = FoxgloveTranslation(fox, dive.ids(track) if track else (), nets)
    cut_ns = 0
    with new_file(output) as part, open(part, "xb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="", library="buddyline")
        channels = _Channels(writer)
        for topic, stamp_ns, message in _translated(dive, translation, track):
            if stamp_ns - cut_ns >= CHUNK_NS:
                writer.flush()
                cut_ns = stamp_ns
            if isinstance(message, Envelope):
                channels.add_ours(message, stamp_ns)
            else:
                channels.add(topic, stamp_ns, message)
        writer.finish()
        check_shows(dive, channels.count)
    pair = next((ids for ids in dive.ids("pose", "track", "track_lag")), None)
    # A net is looked at from outside, a pair from A.
    base = None if nets else base_of(dive)
    write_new(layout_path, layout(channels.topics, None if pair is None else (pair[0], pair[1]), base))
    return channels.count


class _Channels:
    """The channels of the file that is written. topics: by name, with the number of messages."""

    def __init__(self, writer: Any) -> None:
        self.topics: dict[str, int] = {}
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._ids: dict[str, int] = {}

    @property
    def count(self) -> int:
        """Number of messages."""
        return sum(self.topics.values())

    def add(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Write one of Foxglove's messages."""
        if topic not in self._ids:
            schema = message.get_schema()
            self._open(topic, "protobuf", schema.name, schema.encoding, schema.data)
        self._write(topic, stamp_ns, message.encode())

    def add_ours(self, envelope: Envelope, stamp_ns: int) -> None:
        """Write one of our messages as it is in the log."""
        if envelope.key not in self._ids:
            kind: type[Message] = type(envelope.message)
            self._open(envelope.key, "json", envelope.topic.schema_name, "jsonschema", json_schema(kind))
        self._write(envelope.key, stamp_ns, envelope.payload)

    def _open(self, topic: str, encoding: str, name: str, schema_encoding: str, schema: bytes) -> None:
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, schema_encoding, schema)
        self._ids[topic] = self._writer.register_channel(topic, encoding, self._schemas[name])

    def _write(self, topic: str, stamp_ns: int, data: bytes) -> None:
        count = self.topics.get(topic, 0)
        self._writer.add_message(self._ids[topic], stamp_ns, data, stamp_ns, count & 0xFFFFFFFF)
        self.topics[topic] = count + 1


def track_of(dive: Dive, what: str | None) -> str | None:
    """Return the topic of the best track in a dive: for a live dive, the one that is a second late.

    None without a track, or if what is "poses".
    """
    track = next((topic.name for topic in (TRACK_LAG, TRACK) if dive.ids(topic.name)), None)
    return None if what == "poses" else track


def _translated(dive: Dive, translation: FoxgloveTranslation, track: str | None) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, stamp_ns and message: one of Foxglove's, or an Envelope that is passed on as it is."""
    left_out = () if track else ("track", "track_lag")
    topics = ["candidates", "image", *(topic for topic in SERIES if topic not in left_out)]
    yield from translation.start(dive.infos(), base_of(dive), dive.start_ns)
    for envelope in dive.messages(*topics, doing="export"):
        name = envelope.topic.name
        if name in SERIES:
            yield envelope.key, envelope.stamp_ns, envelope
        # Of two tracks one places B.
        if name == track or name not in ("track", "track_lag"):
            yield from translation.messages(envelope)
    yield from translation.paths()


def base_of(dive: Dive) -> str | None:
    """Return A's id: of the first pair with poses or a track, else the first node."""
    for ids in dive.ids("pose", "track", "track_lag"):
        return ids[0]
    return next(iter(dive.nodes("info", "candidates", "image")), None)


def nets_of(dive: Dive) -> dict[str, str]:
    """Return the net of each node that a net places."""
    return {node: net for net, node in dive.ids(NET_POSE.name)}
