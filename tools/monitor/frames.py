"""What a viewer's page is told at an instant, as JSON: only what has changed since it was last told.

A frame has the page's time (`now`, ms) and, as far as they are new: `scene`, `points` and `misses` (for trail and
plots), `banner`, `figures`, `health`, `cameras` (HTML whose text is escaped), `rigs`, `pairs`, `probes`, `playback`.
"""

from __future__ import annotations

import math
import sys
from typing import Any, Final

import msgspec
import numpy as np
from buddyline.protocol.clock import MS_NS, S_NS
from buddyline.protocol.envelope import Envelope
from buddyline.protocol.messages import NodeInfo
from buddyline.solver_service.geometry.rotation import quat_to_matrix
from buddyline.tools.estimate import Estimate
from buddyline.tools.health.pair import findings
from buddyline.tools.health.words import sentence
from buddyline.tools.monitor import panel
from buddyline.tools.monitor.overview import Overview
from buddyline.tools.monitor.picture import QUANTITIES, NodePicture, PairPicture, Point
from buddyline.tools.monitor.scene import SceneFrame, ellipsoid, fields_of_view
from buddyline.tools.pairs import Pair

# The page's rate. Texts are made anew in every so many frames, so that they can be read; the banner more often.
RATE_HZ: Final = 30.0
TEXTS_EVERY: Final = 9
BANNER_EVERY: Final = 3
# Numbers can be plotted: of a list the first 36 (a covariance has 36), of a list of objects those of the first four.
MAX_ELEMENTS: Final = 36
MAX_OBJECTS: Final = 4
MAX_FIELDS: Final = 4000
# As many as a page has plots.
MAX_PROBES: Final = 3
FRUSTUM_M: Final = 0.35

# The columns of a point after its time and whether it is the track's; the page names and plots them.
Row = list[float | int | None]


class PageContents:
    """What is shown of a pair beside trail and plots: made once at an instant, for all who look at it then."""

    def __init__(self, *, live: bool) -> None:
        self.parts: dict[str, Any] = {}
        self._live = live
        self._now_ns = -1
        self._tick = 0

    def update(self, overview: Overview, picture: PairPicture, now_ns: int, *, anew: bool) -> None:
        """Go on to an instant, if it is another one. anew: make the texts too, although they are not yet due."""
        if now_ns == self._now_ns and not anew:
            return
        self._now_ns = now_ns
        self._tick = 0 if anew else self._tick + 1
        self._make("scene", scene(overview, picture, now_ns))
        texts = self._tick % TEXTS_EVERY == 0
        if self._tick % BANNER_EVERY == 0:
            first = findings(picture, now_ns, live=self._live)[0]
            # Deck mode has no other sign that this is not now.
            text = f"{'' if self._live else 'Stored dive. '}{sentence(first, now_ns)}"
            banner = {"level": first.level, "text": text, "advice": first.advice}
            # Below a banner that is green no longer nothing else may say that all is well.
            texts |= self.parts.get("banner", banner)["level"] != first.level
            self._make("banner", banner)
        if texts:
            self._make("figures", panel.figures(picture, now_ns))
            self._make("health", panel.health(picture, now_ns, live=self._live))
            ends = picture.end_nodes()
            self._make("cameras", [panel.camera(picture, node, now_ns) if node else "" for node in ends])
            self._make("rigs", {name: rig_outline(node.info) for name, node in picture.nodes.items()})
            shown = [name or "" for name in picture.ends()]
            self._make("pairs", {"all": ["/".join(pair) for pair in overview.pairs()], "shown": shown})

    def _make(self, name: str, part: Any) -> None:
        """Take a part; one that says the same as before stays the same object, which needs not be told again."""
        if self.parts.get(name) != part:
            self.parts[name] = part


class Viewer:
    """What one viewer has been told, and what he has chosen: a pair, and fields to plot.

    contents: by pair, of all who look at the same overview; None: of this viewer alone.
    """

    def __init__(self, *, live: bool, contents: dict[Pair | None, PageContents] | None = None) -> None:
        self.pair: Pair | None = None
        # The time of the last value told, by chosen field (`key field`).
        self._probed_ns: dict[str, int] = {}
        self._live = live
        self._contents = {} if contents is None else contents
        self._shown: Pair | None = None
        self._told: dict[str, Any] = {}
        self._point_ns = self._miss_ns = self._now_ns = -1
        self._reset = True

    def restart(self) -> None:
        """Tell everything again: another pair, or another instant of a dive."""
        self._told.clear()
        self._point_ns = self._miss_ns = -1
        self._probed_ns = dict.fromkeys(self._probed_ns, -1)
        self._reset = True

    def choose_fields(self, names: list[str]) -> None:
        """Choose the fields to plot, `key field` each."""
        self._probed_ns = {name: self._probed_ns.get(name, -1) for name in names[:MAX_PROBES]}

    def frame(self, overview: Overview, now_ns: int) -> dict[str, Any]:
        """Return what is new for this viewer."""
        picture = overview.picture(self.pair)
        # Also where the clock was set back.
        if picture.pair != self._shown or now_ns < self._now_ns - S_NS:
            self._shown = picture.pair
            self.restart()
        self._now_ns = now_ns
        contents = self._contents.setdefault(picture.pair, PageContents(live=self._live))
        contents.update(overview, picture, now_ns, anew=self._reset)
        said: dict[str, Any] = {"now": now_ns / MS_NS}
        if self._reset:
            said["reset"] = True
            self._reset = False
        said |= {name: part for name, part in contents.parts.items() if self._told.get(name) is not part}
        self._told |= contents.parts
        said |= self._new_points(picture)
        probes = self._probes(overview)
        if probes:
            said["probes"] = probes
        return said

    def _new_points(self, picture: PairPicture) -> dict[str, Any]:
        points: list[Row] = []
        for point in reversed(picture.points):
            if point.at_ns <= self._point_ns:
                break
            points.append(row(point))
        misses = []
        for miss in reversed(picture.misses):
            if miss.at_ns <= self._miss_ns:
                break
            misses.append(miss.at_ns / MS_NS)
        if picture.points:
            self._point_ns = max(self._point_ns, picture.points[-1].at_ns)
        if picture.misses:
            self._miss_ns = max(self._miss_ns, picture.misses[-1].at_ns)
        said = {"points": points[::-1], "misses": misses[::-1]}
        return {name: new for name, new in said.items() if new}

    def _probes(self, overview: Overview) -> dict[str, list[float]]:
        """Return the chosen fields' newest values with their times (ms), as far as they are new."""
        found = {}
        for name, told_ns in self._probed_ns.items():
            key, _, path = name.partition(" ")
            envelope = overview.last.get(key)
            if envelope is None or envelope.time_ns <= told_ns:
                continue
            self._probed_ns[name] = envelope.time_ns
            value = numbers(_plain(envelope)).get(path)
            if value is not None:
                found[name] = [envelope.time_ns / MS_NS, value]
        return found


def _plain(envelope: Envelope) -> Any:
    """Return a message as plain values; bytes stay bytes, which is quicker and has no number."""
    return msgspec.to_builtins(envelope.message, builtin_types=(bytes,))


def fields(overview: Overview) -> list[str]:
    """Return all fields that can be plotted, as `key field`."""
    found = []
    for key, envelope in sorted(overview.last.items()):
        found += [f"{key} {path}" for path in numbers(_plain(envelope))]
    return found[:MAX_FIELDS]


def numbers(value: Any, path: str = "") -> dict[str, float]:
    """Return the numbers within a message by their path: `depth_m`, `t_a_b_m[2]`, `rates_hz.imu`."""
    if isinstance(value, bool):
        return {path: float(value)}
    if isinstance(value, int | float):
        # JSON has integers that no float can hold; infinity cannot be drawn.
        return {} if abs(value) > sys.float_info.max else {path: float(value)}
    if isinstance(value, dict):
        parts = [(f"{path}.{name}" if path else str(name), part) for name, part in value.items()]
    elif isinstance(value, list | tuple):
        most = MAX_OBJECTS if any(isinstance(part, dict) for part in value) else MAX_ELEMENTS
        parts = [(f"{path}[{index}]", part) for index, part in enumerate(value[:most])]
    else:
        return {}
    return {name: number for each, part in parts for name, number in numbers(part, each).items()}


def row(point: Point) -> Row:
    """Return a point of trail and plots: time (ms), 1 for the track, north, east, down, then the plotted quantities.

    They are those of QUANTITIES; None where one is not known.
    """
    values = (*point.t_m, *(quantity(point) for _, quantity in QUANTITIES))
    rounded = [None if math.isnan(value) else round(value, 4) for value in values]
    return [point.at_ns / MS_NS, int(point.tracked), *rounded]


def scene(overview: Overview, picture: PairPicture, now_ns: int) -> dict[str, Any]:
    """Return all nodes in north-east-down from A's camera, A first, then B, then those of A's other pairs and net.

    A node: id, label, t (m), R (camera to scene, row by row), stale; half and axes of its 95 % ellipsoid if it has one.
    """
    frame = picture.frame()
    (name_a, name_b), (node_a, _) = picture.ends(), picture.end_nodes()
    nodes: list[dict[str, Any]] = []
    if name_a is not None:
        silent = node_a is None or now_ns - node_a.alive_ns() > S_NS
        label = f"{name_a}{_depth_words(node_a)}{'' if frame.levelled else ', attitude unknown: drawn level'}"
        nodes.append({"id": name_a, "label": label, "t": [0.0, 0.0, 0.0], "R": _flat(frame.R_s_a), "stale": silent})
    for pair in (picture.pair, *(pair for pair in overview.pairs() if pair != picture.pair)):
        if pair is not None and pair[0] == name_a:
            other = overview.picture(pair)
            node = _placed(other, frame, overview.nodes.get(pair[1]), now_ns)
            if node is not None:
                nodes.append(node)
    in_net = {} if name_a is None else _of_net(overview, name_a, frame, now_ns)
    # Another pair's last pose says less than where the net knows that node to be now.
    fresh = {name for name, node in in_net.items() if not node["stale"] and name != name_b}
    nodes = [in_net[node["id"]] if node["stale"] and node["id"] in fresh else node for node in nodes]
    placed = {node["id"] for node in nodes}
    nodes += [node for name, node in in_net.items() if name not in placed]
    depth_m = node_a.depth.depth_m if node_a is not None and node_a.depth is not None else None
    seen: list[int] = [0, 0, 0, 0]
    if picture.pose is not None and picture.pose_ns is not None and now_ns - picture.pose_ns < S_NS:
        seen = [int(index >= 0) for index in (*picture.pose.blobs_a, *picture.pose.blobs_b)]
    return {"nodes": nodes, "levelled": frame.levelled, "depth": depth_m, "pair": [name_a, name_b], "seen": seen}


def _placed(picture: PairPicture, frame: SceneFrame, node: NodePicture | None, now_ns: int) -> dict[str, Any] | None:
    shown = picture.shown(now_ns)
    if shown is None or picture.pair is None:
        return None
    estimate: Estimate = shown.estimate
    half_m, R_s_axes = ellipsoid(estimate, frame)
    return {
        "id": picture.pair[1],
        "label": f"{picture.pair[1]}{_depth_words(node)}{f', {shown.note}' if shown.note else ''}",
        "t": [round(x, 4) for x in frame.place(estimate)],
        "R": _flat(frame.turn_b(estimate)),
        "stale": shown.stale,
        "half": [round(x, 5) for x in half_m.tolist()],
        "axes": _flat(R_s_axes),
    }


def _of_net(overview: Overview, name_a: str, frame: SceneFrame, now_ns: int) -> dict[str, dict[str, Any]]:
    """Return the other nodes of A's net by name, from A's own place in it."""
    base = overview.net.get(name_a)
    if base is None:
        return {}
    # The net's axes are the scene's, unless A is drawn level because its attitude is not known.
    R_s_net = np.eye(3) if frame.levelled else frame.R_s_a @ quat_to_matrix(np.array(base[0].q_xyzw)).T
    found = {}
    for name, (pose, at_ns) in sorted(overview.net.items()):
        if name != name_a and pose.net == base[0].net:
            t_m = R_s_net @ np.subtract(pose.p_m, base[0].p_m)
            R = R_s_net @ quat_to_matrix(np.array(pose.q_xyzw))
            label = f"{name}{_depth_words(overview.nodes.get(name))}"
            t = [round(x, 4) for x in t_m.tolist()]
            found[name] = {"id": name, "label": label, "t": t, "R": _flat(R), "stale": now_ns - at_ns > S_NS}
    return found


def _flat(R: Any) -> list[float]:
    return [round(x, 5) for x in R.ravel().tolist()]


def _depth_words(node: NodePicture | None) -> str:
    return "" if node is None or node.depth is None else f", {node.depth.depth_m:.1f} m deep"


def rig_outline(info: NodeInfo | None) -> dict[str, Any]:
    """Return a node's outline: both lights and the corners of its view, in its camera frame (m)."""
    if info is None:
        return {"lights": [[-0.5, 0, 0], [0.5, 0, 0]], "corners": [0.25, 0.2, FRUSTUM_M]}
    fov_rad, aspect = fields_of_view(info)
    half_m = FRUSTUM_M * math.tan(min(max(fov_rad / 2, 0.1), 1.2))
    return {
        "lights": [list(info.light_left_m), list(info.light_right_m)],
        "corners": [round(half_m * aspect, 4), round(half_m, 4), FRUSTUM_M],
    }
