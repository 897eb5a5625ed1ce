"""The pair in space, drawn by viser: both nodes, the line of sight, the trail, the uncertainty."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import NodeInfo
from buddyline.tools.monitor.picture import KEPT_NS, NodePicture, PairPicture
from buddyline.tools.monitor.scene import Floats, age_colours, ellipsoid, fields_of_view, fit, holds, wxyz

if TYPE_CHECKING:
    import viser

A_COLOUR: Final = (235, 235, 240)
B_COLOUR: Final = (255, 170, 60)
STALE_COLOUR: Final = (95, 98, 105)
LEFT_COLOUR: Final = (255, 92, 92)
RIGHT_COLOUR: Final = (75, 227, 122)
WHITE: Final = (255, 255, 255)
NORTH_COLOUR: Final = (230, 80, 80)
DOWN_COLOUR: Final = (90, 160, 255)
SURFACE_COLOUR: Final = (70, 150, 190)
FRUSTUM_M: Final = 0.35
LIGHT_RADIUS_M: Final = 0.035
# If the eye is further from the page's own view than this share of its distance, the viewer has moved it.
CHOSEN: Final = 0.02
# The view follows the pair only if the better eye is further away than this share of its distance.
WORTH_A_TURN: Final = 0.2
# Trail segments longer than this in time are not drawn: they would hide a gap of the track.
TRAIL_BREAK_NS: Final = 3 * S_NS // 2


Colour = tuple[int, int, int]


class NodeDrawing:
    """One node to scale: camera frustum, bar, both lights, name."""

    def __init__(self, server: viser.ViserServer, path: str, colour: Colour) -> None:
        self._scene = server.scene
        self._path = path
        self._colour = colour
        self._rig: tuple[object, ...] | None = None
        self._parts: list[Any] = []
        self._frame = self._scene.add_frame(path, show_axes=False, visible=False)
        self._label = self._scene.add_label(f"{path}/name", "", position=(0.0, -0.25, 0.0), visible=False)
        self._stale = False

    def show(self, node: NodePicture | None, R_s_c: Floats, t_m: Floats, text: str, stale: bool) -> None:
        """Draw the node at t_m, turned by R_s_c."""
        if node is not None and node.info is not None:
            self._build(node.info)
        self._frame.position = t_m
        self._frame.wxyz = wxyz(R_s_c)
        self._frame.visible = self._label.visible = True
        if self._label.text != text:
            self._label.text = text
        if stale != self._stale:
            self._stale = stale
            self._tint()

    def hide(self) -> None:
        """Hide the node."""
        self._frame.visible = self._label.visible = False

    def _build(self, info: NodeInfo) -> None:
        rig = (info.camera, info.width_px, info.height_px, info.light_left_m, info.light_right_m)
        if rig == self._rig:
            return
        self._rig = rig
        fov_rad, aspect = fields_of_view(info)
        lights_m = np.array([info.light_left_m, info.light_right_m])
        frustum: dict[str, Any] = {"scale": FRUSTUM_M, "thickness": 0.012, "cast_shadow": False}
        ball: dict[str, Any] = {"subdivisions": 2, "cast_shadow": False, "receive_shadow": False}
        self._parts = [
            self._scene.add_camera_frustum(f"{self._path}/camera", fov_rad, aspect, **frustum),
            self._scene.add_line_segments(f"{self._path}/bar", _segments(*lights_m), self._colour, thickness=0.02),
        ] + [
            self._scene.add_icosphere(f"{self._path}/{name}", LIGHT_RADIUS_M, position=light_m, **ball)
            for name, light_m in zip(("left", "right"), lights_m, strict=True)
        ]
        self._tint()

    def _tint(self) -> None:
        if self._parts:
            colours = (self._colour, self._colour, LEFT_COLOUR, RIGHT_COLOUR)
            camera, bar, *lights = self._parts
            camera.color, bar_colour, *light_colours = (STALE_COLOUR,) * 4 if self._stale else colours
            bar.colors = np.array(bar_colour, np.uint8)
            for light, colour in zip(lights, light_colours, strict=True):
                light.color = colour


def _segments(*points: Any) -> Any:
    """Return line segments (n / 2, 2, 3) of pairs of points."""
    return np.array(points, np.float32).reshape(-1, 2, 3)


class SceneDrawing:
    """Both nodes, the line of sight, the trail, the poses, the uncertainty, and the marks of up and north."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        scene = server.scene
        self._a = NodeDrawing(server, "/a", A_COLOUR)
        self._b = NodeDrawing(server, "/b", B_COLOUR)
        hidden: dict[str, Any] = {"visible": False}
        nothing = np.zeros((1, 2, 3), np.float32)
        self._sight = scene.add_line_segments("/sight", nothing, WHITE, thickness=0.008, **hidden)
        self._plumb = scene.add_line_segments("/plumb", nothing, DOWN_COLOUR, thickness=0.006, **hidden)
        no_shadow: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
        self._ellipsoid = scene.add_icosphere(
            "/uncertainty", 1.0, B_COLOUR, opacity=0.35, subdivisions=3, **no_shadow, **hidden
        )
        grid: dict[str, Any] = {"plane": "xy", "section_size": 5.0, "shadow_opacity": 0.0}
        cells: dict[str, Any] = {"cell_color": (62, 78, 92), "section_color": (84, 108, 128), "fade_distance": 60.0}
        scene.add_grid("/grid", 60.0, 60.0, cell_size=1.0, **grid, **cells)
        cells = {"cell_color": SURFACE_COLOUR, "section_color": SURFACE_COLOUR, "plane_color": (60, 150, 200)}
        self._surface = scene.add_grid(
            "/surface", 60.0, 60.0, cell_size=5.0, plane_opacity=0.06, **grid, **cells, **hidden
        )
        self._surface_name = scene.add_label("/surface/name", "surface", **hidden)
        down = _segments((0, 0, 0), (0, 0, 1), (0, 0, 1), (0.06, 0, 0.88), (0, 0, 1), (-0.06, 0, 0.88))
        scene.add_line_segments("/down", down, DOWN_COLOUR, thickness=0.012)
        scene.add_label("/down/name", "gravity", position=(0.0, 0.0, 1.05))
        north = _segments((0, 0, 0), (1.5, 0, 0), (1.5, 0, 0), (1.35, 0.08, 0), (1.5, 0, 0), (1.35, -0.08, 0))
        self._north = scene.add_line_segments("/north", north, NORTH_COLOUR, thickness=0.012, **hidden)
        scene.add_label("/north/name", "north", position=(1.6, 0.0, 0.0))
        self._trail_key: tuple[int, int] | None = None
        self._fitted = False
        self._t_m = np.array([3.0, 0.0, 0.0])
        self._eyes: dict[int, tuple[Floats, Floats, bool]] = {}  # eye, target and upright, as the page has set them
        server.on_client_connect(self.fit)
        server.on_client_disconnect(lambda client: self._eyes.pop(client.client_id, None) and None)

    def fit(self, client: viser.ClientHandle) -> None:
        """Turn one viewer's view to the pair."""
        eye, target = fit(self._t_m, client.camera.aspect)
        self._eyes[client.client_id] = eye, target, client.camera.aspect < 1.0
        with client.atomic():
            client.camera.up_direction = (0.0, 0.0, -1.0)
            client.camera.position = eye
            client.camera.look_at = target

    def fit_all(self) -> None:
        """Turn every viewer's view to the pair."""
        for client in list(self._server.get_clients().values()):
            self.fit(client)

    def _follow(self) -> None:
        """Turn the views that the pair has left, unless the viewer has chosen the view."""
        for client in list(self._server.get_clients().values()):
            put = self._eyes.get(client.client_id)
            if put is None:
                continue
            eye, target, upright = put
            if np.linalg.norm(client.camera.position - eye) > CHOSEN * np.linalg.norm(eye):
                continue
            if upright != (client.camera.aspect < 1.0):
                self.fit(client)
            elif not holds(eye, target, client.camera.fov, np.array((np.zeros(3), self._t_m))):
                better, _ = fit(self._t_m, client.camera.aspect)
                if np.linalg.norm(better - eye) > WORTH_A_TURN * np.linalg.norm(better):
                    self.fit(client)

    def draw(self, picture: PairPicture, now_ns: int) -> None:
        """Draw everything at its present place."""
        (name_a, name_b), (node_a, node_b) = picture.ends(), picture.end_nodes()
        frame, shown = picture.frame(), picture.shown(now_ns)
        with self._server.atomic():
            self._north.visible = frame.levelled
            if name_a is not None:
                text = f"{name_a}{_depth_words(node_a)}{'' if frame.levelled else ', attitude unknown: drawn level'}"
                silent = node_a is None or now_ns - node_a.alive_ns() > S_NS
                self._a.show(node_a, frame.R_s_a, np.zeros(3), text, silent)
            depth_m = node_a.depth.depth_m if node_a is not None and node_a.depth is not None else None
            self._surface.visible = self._surface_name.visible = depth_m is not None
            if depth_m is not None:
                self._surface.position = (0.0, 0.0, -depth_m)
            if shown is None or name_b is None:
                self._b.hide()
                return
            estimate, stale = shown.estimate, shown.stale
            t_m = np.array(frame.place(estimate))
            text = f"{name_b}{_depth_words(node_b)}{f', {shown.note}' if shown.note else ''}"
            self._b.show(node_b, frame.turn_b(estimate), t_m, text, stale)
            self._sight.points = _segments(np.zeros(3), t_m)
            self._sight.colors = np.array(STALE_COLOUR if stale else WHITE, np.uint8)
            self._plumb.points = _segments(t_m, (t_m[0], t_m[1], 0.0))
            self._sight.visible = self._plumb.visible = True
            half_m, R_s_axes = ellipsoid(estimate, frame)
            self._ellipsoid.visible = not stale
            self._ellipsoid.position = tuple(t_m.tolist())
            self._ellipsoid.wxyz = wxyz(R_s_axes)
            self._ellipsoid.scale = tuple(half_m.tolist())
        self._t_m = t_m
        if self._fitted:
            self._follow()
        else:
            self._fitted = True
            self.fit_all()

    def draw_trail(self, picture: PairPicture, now_ns: int) -> None:
        """Draw B's past places, coloured by age: the track as a line, poses as dots, joined if there is no track.

        At most once a second, because the whole trail is sent each time.
        """
        key = (len(picture.points), now_ns // S_NS)
        if key == self._trail_key:
            return
        self._trail_key = key
        poses = [point for point in picture.points if not point.tracked]
        track = [point for point in picture.points if point.tracked] or poses
        segments = [
            (one, other)
            for one, other in pairwise(track)
            if other.at_ns - one.at_ns <= TRAIL_BREAK_NS and one.frame.levelled == other.frame.levelled
        ]
        scene = self._server.scene
        # Drawn again under the same name: colours cannot be updated alone while the number of points changes.
        if poses:
            spots_m = np.array([point.t_m for point in poses], np.float32)
            colours = age_colours(np.array([now_ns - point.at_ns for point in poses]) / S_NS, KEPT_NS / S_NS)
            scene.add_point_cloud("/poses", spots_m, colours, point_size=0.03, point_shape="circle")
        else:
            scene.remove_by_name("/poses")
        if not segments:
            scene.remove_by_name("/trail")
            return
        ends_m = np.array([[one.t_m, other.t_m] for one, other in segments], np.float32)
        ages_s = np.array([[now_ns - one.at_ns, now_ns - other.at_ns] for one, other in segments]) / S_NS
        colours = age_colours(ages_s.ravel(), KEPT_NS / S_NS).reshape(-1, 2, 3)
        scene.add_line_segments("/trail", ends_m, colours, thickness=0.015)


def _depth_words(node: NodePicture | None) -> str:
    return "" if node is None or node.depth is None else f", {node.depth.depth_m:.1f} m deep"
