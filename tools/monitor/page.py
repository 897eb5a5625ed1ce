"""The page itself, drawn by viser: the pair in space, and the panel beside it. The only module that knows viser."""

from __future__ import annotations

import io
import logging
from contextlib import redirect_stdout
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import NodeInfo
from buddyline.tools.monitor import panel
from buddyline.tools.monitor.picture import KEPT_NS, PairPicture, Point
from buddyline.tools.monitor.scene import Floats, age_colours, ellipsoid, fields_of_view, fit, holds, wxyz

if TYPE_CHECKING:
    import viser

log = logging.getLogger(__name__)

DEFAULT_HOST: Final = "127.0.0.1"
DEFAULT_PORT: Final = 8080

A_COLOUR: Final = (235, 235, 240)
B_COLOUR: Final = (255, 170, 60)
STALE_COLOUR: Final = (95, 98, 105)
LEFT_COLOUR: Final = (255, 92, 92)
RIGHT_COLOUR: Final = (75, 227, 122)
NORTH_COLOUR: Final = (230, 80, 80)
DOWN_COLOUR: Final = (90, 160, 255)
FRUSTUM_M: Final = 0.35
LIGHT_RADIUS_M: Final = 0.035
# An eye this far, by its distance, from where the page put it is its owner's; a new place is taken from so far on.
CHOSEN: Final = 0.02
WORTH_A_TURN: Final = 0.2
# Trail segments longer than this in time are not drawn: between the poses nothing is known.
TRAIL_BREAK_NS: Final = 3 * S_NS // 2


def open_server(host: str, port: int, title: str) -> viser.ViserServer:
    """Serve the page on host and port; raise BuddylineError where viser or the port cannot be had."""
    try:
        import viser
    except ImportError as error:
        raise BuddylineError(
            f"the page needs viser, which is not installed ({error.name}): pip install 'buddyline[monitor]'"
        ) from error
    logging.getLogger("websockets").setLevel(logging.WARNING)
    try:
        # Its banner would go to standard output, which is for data.
        with redirect_stdout(io.StringIO()):
            server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    except (OSError, RuntimeError, OverflowError) as error:
        raise BuddylineError(f"--host {host} --port {port}: cannot be served: {error}") from error
    if port not in (0, server.get_port()):
        taken = server.get_port()
        log.warning("port %d is in use: the page is on port %d", port, taken)
    server.gui.configure_theme(
        dark_mode=True, show_logo=False, show_share_button=False, control_layout="collapsible", control_width="large"
    )
    server.gui.set_panel_label(title)
    server.scene.set_up_direction("-z")
    return server


class NodeDrawing:
    """One node to scale: camera frustum, bar, both lights, name."""

    def __init__(self, server: viser.ViserServer, path: str, colour: tuple[int, int, int]) -> None:
        self._scene = server.scene
        self._path = path
        self._colour = colour
        self._rig: tuple[object, ...] | None = None
        self._parts: list[Any] = []
        self._frame = self._scene.add_frame(path, show_axes=False, visible=False)
        self._label = self._scene.add_label(f"{path}/name", "", position=(0.0, -0.25, 0.0), visible=False)
        self._stale = False

    def show(self, info: NodeInfo | None, R_s_c: Floats, t_m: Floats, text: str, stale: bool) -> None:
        """Draw it at t_m, turned by R_s_c."""
        if info is not None:
            self._build(info)
        self._frame.position = t_m
        self._frame.wxyz = wxyz(R_s_c)
        self._frame.visible = self._label.visible = True
        if self._label.text != text:
            self._label.text = text
        if stale != self._stale:
            self._stale = stale
            self._tint()

    def hide(self) -> None:
        """Draw it not at all."""
        self._frame.visible = self._label.visible = False

    def _build(self, info: NodeInfo) -> None:
        rig = (info.camera, info.width_px, info.height_px, info.light_left_m, info.light_right_m)
        if rig == self._rig:
            return
        self._rig = rig
        fov_rad, aspect = fields_of_view(info)
        lights_m = np.array([info.light_left_m, info.light_right_m])
        add = self._scene
        self._parts = [
            add.add_camera_frustum(
                f"{self._path}/camera", fov_rad, aspect, scale=FRUSTUM_M, thickness=0.012, cast_shadow=False
            ),
            add.add_line_segments(f"{self._path}/bar", lights_m[None].astype(np.float32), self._colour, thickness=0.02),
            *(
                add.add_icosphere(
                    f"{self._path}/{name}",
                    LIGHT_RADIUS_M,
                    subdivisions=2,
                    position=light_m,
                    cast_shadow=False,
                    receive_shadow=False,
                )
                for name, light_m in zip(("left", "right"), lights_m, strict=True)
            ),
        ]
        self._tint()

    def _tint(self) -> None:
        if not self._parts:
            return
        camera, bar, left, right = self._parts
        camera.color = STALE_COLOUR if self._stale else self._colour
        bar.colors = np.array(STALE_COLOUR if self._stale else self._colour, np.uint8)
        left.color = STALE_COLOUR if self._stale else LEFT_COLOUR
        right.color = STALE_COLOUR if self._stale else RIGHT_COLOUR


class SceneDrawing:
    """Both nodes, the line of sight, the trail, the uncertainty, and what tells where up and north are."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        scene = server.scene
        self._a = NodeDrawing(server, "/a", A_COLOUR)
        self._b = NodeDrawing(server, "/b", B_COLOUR)
        none = np.zeros((1, 2, 3), np.float32)
        self._sight = scene.add_line_segments("/sight", none, (255, 255, 255), thickness=0.008)
        self._plumb = scene.add_line_segments("/plumb", none, DOWN_COLOUR, thickness=0.006)
        self._trail_key: tuple[int, int] | None = None
        self._ellipsoid = scene.add_icosphere(
            "/uncertainty", 1.0, B_COLOUR, opacity=0.35, subdivisions=3, cast_shadow=False, receive_shadow=False
        )
        scene.add_grid(
            "/grid",
            60.0,
            60.0,
            plane="xy",
            cell_size=1.0,
            section_size=5.0,
            cell_color=(62, 78, 92),
            section_color=(84, 108, 128),
            shadow_opacity=0.0,
            fade_distance=60.0,
        )
        self._surface = scene.add_grid(
            "/surface",
            60.0,
            60.0,
            plane="xy",
            cell_size=5.0,
            section_size=5.0,
            cell_color=(70, 150, 190),
            section_color=(70, 150, 190),
            plane_color=(60, 150, 200),
            plane_opacity=0.06,
            shadow_opacity=0.0,
            visible=False,
        )
        self._surface_name = scene.add_label("/surface/name", "surface", visible=False)
        down = np.array([[[0, 0, 0], [0, 0, 1.0]], [[0, 0, 1.0], [0.06, 0, 0.88]], [[0, 0, 1.0], [-0.06, 0, 0.88]]])
        scene.add_line_segments("/down", down.astype(np.float32), DOWN_COLOUR, thickness=0.012)
        scene.add_label("/down/name", "gravity", position=(0.0, 0.0, 1.05))
        north = np.array([[[0, 0, 0], [1.5, 0, 0]], [[1.5, 0, 0], [1.35, 0.08, 0]], [[1.5, 0, 0], [1.35, -0.08, 0]]])
        self._north = scene.add_line_segments("/north", north.astype(np.float32), NORTH_COLOUR, thickness=0.012)
        scene.add_label("/north/name", "north", position=(1.6, 0.0, 0.0))
        self._fitted = False
        self._t_m = np.array([3.0, 0.0, 0.0])
        for handle in (self._sight, self._plumb, self._ellipsoid, self._north):
            handle.visible = False
        self._eyes: dict[int, tuple[Floats, Floats, bool]] = {}  # eye, target, upright, as the page put them
        server.on_client_connect(self.fit)
        server.on_client_disconnect(self._forget)

    def fit(self, client: viser.ClientHandle) -> None:
        """Turn one viewer's eye so that it sees the pair."""
        eye, target = fit(self._t_m, client.camera.aspect)
        self._eyes[client.client_id] = eye, target, client.camera.aspect < 1.0
        with client.atomic():
            client.camera.up_direction = (0.0, 0.0, -1.0)
            client.camera.position = eye
            client.camera.look_at = target

    def _forget(self, client: viser.ClientHandle) -> None:
        self._eyes.pop(client.client_id, None)

    def _follow(self) -> None:
        """Turn the eyes of those whom the pair has left, and who have not chosen their own view."""
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

    def fit_all(self) -> None:
        """Turn every viewer's eye."""
        for client in list(self._server.get_clients().values()):
            self.fit(client)

    def draw(self, picture: PairPicture, now_ns: int) -> None:
        """Move everything to where it is now."""
        name_a, name_b = picture.ends()
        frame, pose, stale = picture.frame(), picture.pose, picture.is_stale(now_ns)
        node_a = picture.nodes.get(name_a) if name_a else None
        node_b = picture.nodes.get(name_b) if name_b else None
        with self._server.atomic():
            self._north.visible = frame.levelled
            depth_a_m = node_a.depth.depth_m if node_a is not None and node_a.depth is not None else None
            level = "" if frame.levelled else ", attitude unknown: drawn level"
            if name_a is not None:
                text = f"{name_a}{_depth_words(depth_a_m)}{level}"
                silent = node_a is None or now_ns - node_a.alive_ns() > S_NS
                self._a.show(node_a.info if node_a else None, frame.R_s_a, np.zeros(3), text, silent)
            self._surface.visible = self._surface_name.visible = depth_a_m is not None
            if depth_a_m is not None:
                self._surface.position = (0.0, 0.0, -depth_a_m)
            if pose is None or name_b is None:
                self._b.hide()
                return
            t_m = np.array(frame.place(pose))
            depth_b_m = node_b.depth.depth_m if node_b is not None and node_b.depth is not None else None
            age_ns = picture.pose_age_ns(now_ns) or 0
            text_b = f"{name_b}{_depth_words(depth_b_m)}{f', STALE {age_ns / S_NS:.0f} s' if stale else ''}"
            self._b.show(node_b.info if node_b else None, frame.turn_b(pose), t_m, text_b, stale)
            self._lines(t_m, stale)
            half_m, R_s_axes = ellipsoid(pose, frame)
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

    def _lines(self, t_m: Floats, stale: bool) -> None:
        foot_m = np.array([t_m[0], t_m[1], 0.0])
        self._sight.points = np.array([[np.zeros(3), t_m]], np.float32)
        self._sight.colors = np.array(STALE_COLOUR if stale else (255, 255, 255), np.uint8)
        self._plumb.points = np.array([[t_m, foot_m]], np.float32)
        self._sight.visible = self._plumb.visible = True

    def draw_trail(self, picture: PairPicture, now_ns: int) -> None:
        """Draw where B was, by age; slower than the rest, since all of it is sent anew."""
        points = list(picture.points)
        key = (len(points), now_ns // S_NS)
        if key == self._trail_key:
            return
        self._trail_key = key
        segments = joined(points)
        if not segments:
            self._server.scene.remove_by_name("/trail")
            return
        ends_m = np.array([[one.t_m, other.t_m] for one, other in segments], np.float32)
        ages_s = np.array([[now_ns - one.at_ns, now_ns - other.at_ns] for one, other in segments]) / S_NS
        colours = age_colours(ages_s.ravel(), KEPT_NS / S_NS).reshape(-1, 2, 3)
        # The same name replaces the one before: colours of points that change in number cannot be set alone.
        self._server.scene.add_line_segments("/trail", ends_m, colours, thickness=0.015)


def joined(points: list[Point]) -> list[tuple[Point, Point]]:
    """Return the pairs of successive points between which the trail is drawn."""
    return [
        (one, other)
        for one, other in pairwise(points)
        if other.at_ns - one.at_ns <= TRAIL_BREAK_NS and one.levelled == other.levelled
    ]


def _depth_words(depth_m: float | None) -> str:
    return "" if depth_m is None else f", {depth_m:.1f} m deep"


class Page:
    """Scene and panel of one server; `live` tells a running pair from a stored dive."""

    def __init__(self, server: viser.ViserServer, *, live: bool) -> None:
        self.server = server
        self._live = live
        gui = server.gui
        self._headline = gui.add_html(panel.block("Starting."))
        self.scene = SceneDrawing(server)
        self._fit = gui.add_button("Show both nodes")
        self._fit.on_click(lambda _: self.scene.fit_all())
        with gui.add_folder("What is going on"):
            self._health = gui.add_html("")
        with gui.add_folder("Cameras"):
            self._cameras: list[viser.GuiHtmlHandle] = [gui.add_html("", visible=False) for _ in range(2)]
        with gui.add_folder("Last two minutes"):
            self._plots = gui.add_html("")
        self._content: dict[int, str] = {}

    def close(self) -> None:
        """Serve no longer."""
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    def viewers(self) -> frozenset[int]:
        """Return the ids of those who look at the page now."""
        return frozenset(self.server.get_clients())

    def draw_scene(self, picture: PairPicture, now_ns: int) -> None:
        """Draw what moves."""
        self.scene.draw(picture, now_ns)

    def draw_texts(self, picture: PairPicture, now_ns: int) -> None:
        """Draw figures, health and pictures, each where it changed; and the trail."""
        self._set(self._headline, panel.headline(picture, now_ns, live=self._live))
        self._set(self._health, panel.health(picture, now_ns, live=self._live))
        for slot, name in zip(self._cameras, picture.ends(), strict=True):
            node = picture.nodes.get(name) if name is not None else None
            slot.visible = node is not None
            if node is not None:
                self._set(slot, panel.camera(picture, node, now_ns))
        self.scene.draw_trail(picture, now_ns)

    def draw_plots(self, picture: PairPicture, now_ns: int) -> None:
        """Draw the plots anew."""
        self._set(self._plots, panel.plots(picture, now_ns))

    def _set(self, handle: viser.GuiHtmlHandle, content: str) -> None:
        # What is sent goes to every viewer: the same thing twice would be load for nothing.
        if self._content.get(id(handle)) != content:
            self._content[id(handle)] = content
            handle.content = content
