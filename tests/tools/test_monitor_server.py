"""The page's server: its files, who may look, what each viewer is told."""

from __future__ import annotations

import gzip
import json
import math
import re
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from buddyline.protocol.clock import S_NS, ManualClock
from buddyline.protocol.codec import encode
from buddyline.protocol.envelope import open_envelope
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Message, NodePose
from buddyline.protocol.topics import key_of
from buddyline.tools.monitor.coverage import Coverage
from buddyline.tools.monitor.frames import PageContents, Viewer, fields, numbers, scene
from buddyline.tools.monitor.live import LiveSession
from buddyline.tools.monitor.overview import Overview
from buddyline.tools.monitor.playback import Playback, cover
from buddyline.tools.monitor.server import FILES, PageServer, open_listener
from buddyline.tools.monitor.view import DiveSession
from buddyline.tools.pairs import Pair
from msgspec.structs import replace

from tests.processes import REPOSITORY
from tests.tools.evaluated import INFOS, RIGHT, info, pose, rejection, track, write_log
from tests.tools.watched import at, attitude, depth, image, tick

pytest.importorskip("websockets", reason="websockets is not installed")

from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

WEB = REPOSITORY / "tools" / "monitor" / "web"


def take(overview: Overview, message: Message, at_ns: int) -> None:
    overview.take(open_envelope(key_of(message), encode(message), at_ns))


def filled(ticks: int = 30) -> Overview:
    overview = Overview()
    for node in "ab":
        take(overview, INFOS[node], at(0))
    for k in range(ticks):
        for message in tick(k):
            take(overview, message, at(k))
    return overview


@contextmanager
def serving(overview: Overview, token: str = "", now_ns: int = at(29)) -> Iterator[tuple[PageServer, LiveSession]]:
    session, stop = LiveSession(overview, ManualClock(now_ns)), threading.Event()
    page = PageServer(open_listener("127.0.0.1", 0), "Buddyline", token, lambda: session, live=True)
    thread = threading.Thread(target=page.run, args=(stop,))
    thread.start()
    try:
        yield page, session
    finally:
        stop.set()
        thread.join(60)
        page.close()


def fetch(page: PageServer, path: str, **headers: str) -> tuple[bytes, Any]:
    request = urllib.request.Request(f"http://127.0.0.1:{page.port}{path}", headers=headers)
    with urllib.request.urlopen(request, timeout=60) as response:
        return response.read(), response.headers


def joined(page: PageServer, query: str = "", **how: Any) -> ClientConnection:
    return connect(f"ws://127.0.0.1:{page.port}/ws{query}", open_timeout=60, max_size=None, **how)


def told(connection: ClientConnection, name: str) -> dict[str, Any]:
    """Return the next frame that has something."""
    while True:
        said: dict[str, Any] = json.loads(connection.recv(timeout=60))
        if name in said:
            return said


class TestFiles:
    def test_the_whole_page_is_small_and_asks_for_nothing_else(self) -> None:
        with serving(filled()) as (page, _):
            wire = 0
            for path in FILES:
                packed, headers = fetch(page, path, **{"Accept-Encoding": "gzip"})
                plain, _ = fetch(page, path)
                assert gzip.decompress(packed) == plain
                assert headers["Content-Security-Policy"].startswith("default-src 'none'")
                wire += len(packed)
        assert wire < 100_000
        html = (WEB / "index.html").read_text()
        named = set(re.findall(r'(?:src|href)="([^"]+)"', html)) - {"data:,"}
        assert {f"/{name}" for name in named} == set(FILES) - {"/"}
        own = html + "".join((WEB / name).read_text() for name in ("style.css", "scene.js", "app.js"))
        assert "http://" not in own.replace("http://www.w3.org", "")
        assert "https:" not in own.replace('"https:"', "")

    def test_what_is_not_there_is_not_found(self) -> None:
        with serving(filled(1)) as (page, _), pytest.raises(urllib.error.HTTPError, match="404"):
            fetch(page, "/../server.py")

    def test_the_kept_library_has_its_licence_beside_it(self) -> None:
        assert "MIT" in (WEB / "uPlot.LICENSE").read_text()


class TestWhoMayLook:
    @pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "192.168.1.1", ""])
    def test_another_name_for_this_machine_is_refused(self, host: str) -> None:
        with serving(filled(1)) as (page, _), pytest.raises(urllib.error.HTTPError, match="403"):
            fetch(page, "/", Host=host)

    @pytest.mark.parametrize(("path", "host"), [("/", "[::1"), ("//[::1", "localhost")])
    def test_what_is_no_address_is_refused_as_such(self, path: str, host: str) -> None:
        with serving(filled(1)) as (page, _), pytest.raises(urllib.error.HTTPError, match="400"):
            fetch(page, path, Host=host)

    def test_an_origin_that_is_no_address_gets_no_socket(self) -> None:
        with serving(filled(1)) as (page, _), pytest.raises(InvalidStatus, match="400"):
            joined(page, origin="http://[")

    @pytest.mark.parametrize("host", ["localhost", "127.0.0.1:9", "[::1]:80"])
    def test_this_machine_s_own_names_are_not(self, host: str) -> None:
        with serving(filled(1)) as (page, _):
            assert fetch(page, "/", Host=host)[0]

    @pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1", "http://localhost:{port}"])
    def test_a_page_of_another_site_gets_no_socket(self, origin: str) -> None:
        with serving(filled(1)) as (page, _):
            with pytest.raises(InvalidStatus, match="403"):
                joined(page, origin=origin.format(port=page.port))
            with joined(page, origin=f"http://127.0.0.1:{page.port}") as own:
                assert json.loads(own.recv(timeout=60))["title"] == "Buddyline"

    @pytest.mark.parametrize("query", ["", "?token=", "?token=secret2", "?token=%F0%9F%98%80"])
    def test_beyond_this_machine_the_link_s_token_is_needed(self, query: str) -> None:
        with serving(filled(1), token="secret") as (page, _):
            with pytest.raises(InvalidStatus, match="401"):
                joined(page, query)
            with joined(page, "?token=secret") as own:
                assert json.loads(own.recv(timeout=60))["live"] is True
            # The files hold nothing of the dive.
            assert fetch(page, "/", Host="boat.local:8080")[0]

    def test_a_port_in_use_moves_the_page_on(self) -> None:
        with open_listener("127.0.0.1", 0) as first:
            port = first.getsockname()[1]
            with open_listener("127.0.0.1", port) as second:
                assert second.getsockname()[1] != port


class TestFrames:
    def test_a_new_viewer_is_told_all_and_then_what_is_new(self) -> None:
        overview = filled()
        with serving(overview) as (page, session), joined(page) as one:
            first = told(one, "figures")
            assert first["reset"] is True
            assert first["banner"]["level"] == "ok"
            assert first["banner"]["text"].startswith("All is well")
            assert "3.00 m" in first["figures"]
            assert {node["id"] for node in first["scene"]["nodes"]} == {"a", "b"}
            assert len(first["points"]) == 15
            second = json.loads(one.recv(timeout=60))
            assert set(second) <= {"now", "scene"}
            with session.lock:
                take(overview, pose(30), at(31))
            assert [point[0] for point in told(one, "points")["points"]] == [at(31) / 1e6]

    def test_a_question_is_answered_with_itself_whatever_else_comes(self) -> None:
        with serving(filled()) as (page, _), joined(page) as one:
            for nonsense in ("", "[]", "{", '{"pair": 3}', '{"probe": null}', '{"pair": "x/y/z"}', '{"seek": "far"}'):
                one.send(nonsense)
            one.send('{"ping": 12.5}')
            assert told(one, "pong")["pong"] == 12.5

    def test_another_pair_is_shown_to_who_asks_for_it_alone(self) -> None:
        overview = filled()
        for k in range(10):
            take(overview, pose(k, (0.0, 0.0, 7.0), node_b="c"), at(k + 20))
        take(overview, info("c"), at(28))
        with serving(overview) as (page, _), joined(page) as one, joined(page) as other:
            assert told(one, "pairs")["pairs"] == {"all": ["a/b", "a/c"], "shown": ["a", "b"]}
            one.send('{"pair": "a/c"}')
            changed = told(one, "reset")
            while "pairs" not in changed or changed["pairs"]["shown"] != ["a", "c"]:
                changed = told(one, "pairs")
            assert "7.00 m" in changed["figures"]
            assert "3.00 m" in told(other, "figures")["figures"]

    def test_after_this_machine_s_clock_was_set_back_nothing_from_before_counts_as_fresh(self) -> None:
        hour = 3600 * S_NS
        overview, clock = Overview(), ManualClock(at(29) + hour)
        session, viewer = LiveSession(overview, clock), Viewer(live=True)

        def shown() -> dict[str, Any]:
            return viewer.frame(*session.step([])[:2])

        for node in "ab":
            take(overview, INFOS[node], at(0) + hour)
        for k in range(30):
            for message in tick(k):
                take(overview, message, at(k) + hour)
        viewer.choose_fields(["buddyline/node/a/depth depth_m"])
        assert shown()["banner"]["level"] == "ok"
        clock.set_ns(at(29))
        assert shown()["banner"]["level"] != "ok"
        # Trail, plots and health go on with what comes now.
        said: dict[str, Any] = {}
        points, probed = 0, 0
        for k in range(30, 60):
            for message in tick(k):
                take(overview, message, at(k))
            clock.set_ns(at(k))
            frame = shown()
            points += len(frame.get("points", []))
            probed += "probes" in frame
            said |= frame
        assert said["banner"]["level"] == "ok"
        assert points >= 10
        assert probed == 30

    def test_no_text_says_that_all_is_well_once_the_banner_does_not(self) -> None:
        overview, viewer = filled(), Viewer(live=True)
        health = ""
        for step in range(60):
            frame = viewer.frame(overview, at(29) + step * 100_000_000)
            health = frame.get("health", health)
            if (banner := frame.get("banner")) is not None:
                assert (banner["level"] == "ok") == ("All is well" in health), (step, banner)

    def test_what_is_shown_at_an_instant_is_made_once_for_all_who_look(self, monkeypatch: pytest.MonkeyPatch) -> None:
        overview, contents = filled(), dict[Pair | None, PageContents]()
        made: list[int] = []
        monkeypatch.setattr("buddyline.tools.monitor.frames.scene", lambda *args: made.append(args[-1]) or scene(*args))
        viewers = [Viewer(live=True, contents=contents) for _ in range(5)]
        # Each is told all at first, and each makes all anew.
        first = [viewer.frame(overview, at(29)) for viewer in viewers]
        assert all(set(frame) == set(first[0]) >= {"scene", "banner", "health", "points"} for frame in first)
        made.clear()
        for step in range(1, 31):
            frames = [viewer.frame(overview, at(29) + step * 33_333_333) for viewer in viewers]
            assert all(frame == frames[0] for frame in frames)
        assert len(made) == 30

    def test_a_chosen_pair_that_comes_later_is_told_from_its_start(self) -> None:
        overview, viewer = filled(), Viewer(live=True)
        viewer.pair = "a", "c"
        assert len(viewer.frame(overview, at(29))["points"]) == 15
        take(overview, pose(30, (0.0, 0.0, 7.0), node_b="c"), at(30))
        frame = viewer.frame(overview, at(30))
        assert frame["reset"] is True
        assert [point[0] for point in frame["points"]] == [at(30) / 1e6]
        assert frame["pairs"]["shown"] == ["a", "c"]

    def test_who_comes_later_is_told_nothing_old(self) -> None:
        overview, contents = filled(), dict[Pair | None, PageContents]()
        left = Viewer(live=True, contents=contents)
        assert left.frame(overview, at(29))["banner"]["level"] == "ok"
        left.frame(overview, at(29) + 33_333_333)
        frame = Viewer(live=True, contents=contents).frame(overview, at(29) + 60 * S_NS)
        assert frame["banner"]["level"] == "problem"
        assert "All is well" not in frame["health"]
        assert "STALE" in frame["cameras"][0]

    def test_all_nodes_that_a_sees_are_in_the_scene(self) -> None:
        overview = filled()
        take(overview, pose(29, (0.0, 0.0, 7.0), node_b="c"), at(29))
        for node, north_m in (("a", 1.0), ("d", 5.0)):
            place = NodePose(
                net="main", node=node, stamp_ns=at(29), p_m=(north_m, 0.0, 0.0), q_xyzw=(0.0, 0.0, 0.0, 1.0),
                v_mps=(0.0, 0.0, 0.0), covariance=[0.0] * 36, fixed=False, mode="filter", age_s=0.0,
            )  # fmt: skip
            take(overview, place, at(29))
        take(overview, depth("d", at(29), 13.0), at(29))
        nodes = {node["id"]: node for node in Viewer(live=True).frame(overview, at(29))["scene"]["nodes"]}
        assert set(nodes) == {"a", "b", "c", "d"}
        assert nodes["d"]["t"] == [4.0, 0.0, 0.0]
        assert nodes["d"]["label"] == "d, 13.0 m deep"

    def test_a_node_stands_where_the_net_knows_it_when_the_pairs_pose_is_old(self) -> None:
        """A's attitude is not known: A is drawn level, and the others as it sees them, whatever the net's axes are."""
        overview = Overview(("a", "b"))
        take(overview, INFOS["a"], at(0))
        take(overview, pose(0, (0.0, 0.0, 7.0), node_b="c"), at(0))
        half = math.sqrt(0.5)
        for node, y_m in (("a", 1.0), ("c", 5.0)):
            # Their cameras look along the net's y axis.
            place = NodePose(
                net="main", node=node, stamp_ns=at(29), p_m=(0.0, y_m, 0.0), q_xyzw=(0.0, half, half, 0.0),
                v_mps=(0.0, 0.0, 0.0), covariance=[0.0] * 36, fixed=False, mode="filter", age_s=0.0,
            )  # fmt: skip
            take(overview, place, at(29))
        frame = Viewer(live=True).frame(overview, at(29))["scene"]
        assert not frame["levelled"]
        nodes = {node["id"]: node for node in frame["nodes"]}
        assert set(nodes) == {"a", "c"}
        assert nodes["c"]["t"] == pytest.approx([4.0, 0.0, 0.0], abs=1e-3)
        assert not nodes["c"]["stale"]

    def test_a_team_is_well_when_all_its_nodes_send(self) -> None:
        overview = filled()
        assert "both nodes send" in Viewer(live=False).frame(overview, at(29))["banner"]["text"]
        take(overview, replace(INFOS["b"], node="c"), at(0))
        for k in range(30):
            for message in tick(k):
                if getattr(message, "node", "") == "b":
                    take(overview, replace(message, node="c"), at(k))
        assert "all nodes send" in Viewer(live=False).frame(overview, at(29))["banner"]["text"]

    def test_an_integer_that_no_float_holds_is_no_number_to_plot(self) -> None:
        assert numbers({"seq": 10**400, "trigger": -(10**400), "gain": 2}) == {"gain": 2.0}

    def test_any_number_of_any_message_can_be_plotted(self) -> None:
        overview, viewer = filled(), Viewer(live=True)
        names = fields(overview)
        assert {"buddyline/node/a/depth depth_m", "buddyline/pair/a/b/pose t_a_b_m[2]"} <= set(names)
        assert "buddyline/node/a/status rates_hz.candidates" in names
        depth_a, sigma, blob = (
            "buddyline/node/a/depth depth_m",
            "buddyline/pair/a/b/pose covariance[35]",
            "buddyline/node/b/candidates blobs[1].u_px",
        )
        assert {depth_a, sigma, blob} <= set(fields(overview))
        viewer.choose_fields([depth_a, sigma, blob])
        probes = viewer.frame(overview, at(29))["probes"]
        assert probes == {
            depth_a: [at(29) / 1e6, 12.5],
            sigma: [at(29) / 1e6, 4e-6],
            blob: [at(29) / 1e6, pytest.approx(RIGHT[0])],
        }
        assert "probes" not in viewer.frame(overview, at(29))
        take(overview, depth("a", at(30), 13.0), at(30))
        assert viewer.frame(overview, at(30))["probes"] == {depth_a: [at(30) / 1e6, 13.0]}
        viewer.choose_fields(["no such field"])
        assert "probes" not in viewer.frame(overview, at(30))

    def test_memory_is_bounded_whatever_is_said(self) -> None:
        overview = Overview()
        for k in range(3000):
            take(overview, pose(0, node_a=f"a{k}", node_b=f"b{k}"), at(0))
            take(overview, depth(f"c{k}", at(0)), at(0))
            overview.alive(f"node/d{k}", alive=True, at_ns=at(0))
        assert len(overview.pairs()) <= 129
        assert len(overview.last) <= 1024
        assert len(overview.nodes) == 64
        # Those that were there before stay.
        take(overview, depth("c0", at(1), 3.0), at(1))
        held = overview.nodes["c0"].depth
        assert held is not None
        assert held.depth_m == 3.0


class TestDive:
    @pytest.fixture
    def session(self, tmp_path: Path) -> Iterator[tuple[DiveSession, ManualClock]]:
        from buddyline.tools.dives import Dive

        messages: list[Any] = list(INFOS.values())
        for k in range(100):
            messages += [m for m in tick(k) if not (40 <= k < 60 and type(m).__name__ == "RelativePose")]
            messages += [rejection(k)] if 40 <= k < 60 else [track(k)]
            messages += [image("a", at(k))] if k % 10 == 0 else []
        path = write_log(tmp_path / "dive.mcap", *messages)
        clock = ManualClock(at(1000))
        with Dive([path]) as dive:
            coverage = Coverage(dive.start_ns, dive.end_ns)
            cover(coverage, [path], None, threading.Event())
            yield DiveSession(Playback(dive, None), coverage, clock, playing=False), clock

    def test_it_plays_steps_jumps_and_loops(self, session: tuple[DiveSession, ManualClock]) -> None:
        dive, clock = session

        def at_s(*commands: dict[str, Any]) -> float:
            dive.step(list(commands))
            return float(round(dive.playback()["at"], 3))

        assert at_s() == 0.0
        assert at_s({"play": True}, {"speed": 4}) == 0.0
        clock.set_ns(clock.now_ns() + S_NS // 10)
        assert at_s() == 0.4
        assert at_s({"step": 1}) == 0.5
        assert dive.playback()["playing"] is False
        assert at_s({"step": -1}) == 0.4
        assert at_s({"gap": 1}) == 3.9
        assert at_s({"gap": 1}) == 3.9  # There is no further one.
        assert at_s({"seek": 1e300}) == 9.9
        assert at_s({"gap": -1}) == 3.9
        assert at_s({"seek": 9.85}) == 9.85
        dive.step([{"play": True}, {"loop": True}, {"speed": 1}])
        clock.set_ns(clock.now_ns() + S_NS // 10)
        overview, _, jumped = dive.step([])
        assert (at_s(), jumped) == (0.0, True)
        assert overview.picture().pose is not None

    def test_a_jump_tells_everything_again(self, session: tuple[DiveSession, ManualClock]) -> None:
        dive, _ = session
        _, now_ns, jumped = dive.step([{"seek": 5.95}])
        assert jumped
        frame = Viewer(live=False).frame(dive.step([])[0], now_ns)
        assert frame["banner"]["level"] == "problem"
        assert frame["banner"]["text"].startswith("Stored dive. No pose: ")
        assert "more than one arrangement fits" in frame["health"]
        assert max(point[0] for point in frame["points"]) <= now_ns / 1e6
        told_once = dive.playback()
        assert "strip" in told_once
        assert "strip" not in dive.playback()


def test_two_viewers_scrub_each_for_himself(tmp_path: Path) -> None:
    from buddyline.protocol.clock import SystemClock
    from buddyline.tools.dives import Dive

    messages: list[Any] = list(INFOS.values()) + [m for k in range(100) for m in (*tick(k), attitude("a", at(k)))]
    path = write_log(tmp_path / "dive.mcap", *messages)
    coverage, stop = Coverage(at(0), at(99)), threading.Event()

    def open_session() -> DiveSession:
        return DiveSession(Playback(Dive([path]), None), coverage, SystemClock(), playing=False)

    page = PageServer(open_listener("127.0.0.1", 0), "Dive", "", open_session, live=False)
    thread = threading.Thread(target=page.run, args=(stop,))
    thread.start()
    try:
        with joined(page) as one, joined(page) as other:
            one.send('{"seek": 5.0}')
            other.send('{"seek": 2.0}')
            for connection, wanted in ((one, 5.0), (other, 2.0)):
                while told(connection, "playback")["playback"]["at"] != wanted:
                    pass
    finally:
        stop.set()
        thread.join(60)
        page.close()


def test_the_states_are_told_apart_by_who_sees_no_green_or_no_red() -> None:
    """CIE76 distance of the banner's colours as deuteranopes and protanopes see them (Vienot et al. 1999)."""
    import numpy as np

    def lab(colour: str, kind: str) -> Any:
        srgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
        linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
        to_lms = np.array([[17.8824, 43.5161, 4.11935], [3.45565, 27.1554, 3.86714], [0.0299566, 0.184309, 1.46709]])
        lms = to_lms @ linear
        if kind == "deuteranope":
            lms[1] = 0.494207 * lms[0] + 1.24827 * lms[2]
        elif kind == "protanope":
            lms[0] = 2.02344 * lms[1] - 2.52581 * lms[2]
        linear = np.clip(np.linalg.solve(to_lms, lms), 0, 1)
        to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
        xyz = to_xyz @ linear / np.array([0.95047, 1.0, 1.08883])
        f = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
        return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])

    css = (WEB / "style.css").read_text()
    rules = ("#well", "#banner.warning", "#banner.problem")
    shown = [re.findall(re.escape(rule) + r" \{ background: (#[0-9a-f]{6})", css)[0] for rule in rules]
    for kind in ("normal", "deuteranope", "protanope"):
        for i, one in enumerate(shown):
            for other in shown[:i]:
                assert np.linalg.norm(lab(one, kind) - lab(other, kind)) >= 40, (kind, one, other)


@pytest.mark.parametrize(
    ("host", "port", "fault"), [("127.0.0.1", 70000, "--port 70000"), ("192.0.2.1", 0, "give another address or port")]
)
def test_an_address_that_cannot_be_is_refused(host: str, port: int, fault: str) -> None:
    with pytest.raises(BuddylineError, match=fault):
        open_listener(host, port)
