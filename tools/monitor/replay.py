"""The report's 3-D replay: the page's scene on a canvas, without any network access."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib import resources
from typing import Final

import msgspec
from buddyline.protocol.clock import S_NS
from buddyline.tools.monitor.frames import rig_outline
from buddyline.tools.monitor.picture import PairPicture, Point


class Keyframe(msgspec.Struct, frozen=True, array_like=True):
    """One instant of the replay. s: from the start; t: B in the scene (m); a, b: R_s_a and R_s_b, row by row."""

    s: float
    t: list[float]
    a: list[float]
    b: list[float]
    joined: bool


def keyframes(points: Sequence[Point], begin_ns: int, joined_ns: int) -> list[Keyframe]:
    """Return the replay's instants; joined_ns: points further apart than this are not joined by the trail."""
    found = []
    before_ns: int | None = None
    for point in points:
        joined = before_ns is not None and point.at_ns - before_ns <= joined_ns
        R_s_a, R_s_b = point.frame.R_s_a, point.frame.turn_b(point.estimate)
        t, a, b = (
            [round(x, 4) for x in numbers] for numbers in (point.t_m, R_s_a.ravel().tolist(), R_s_b.ravel().tolist())
        )
        found.append(Keyframe(round((point.at_ns - begin_ns) / S_NS, 3), t, a, b, joined))
        before_ns = point.at_ns
    return found


def replay_html(frames: Sequence[Keyframe], picture: PairPicture, *, levelled: bool, what: str, stale_s: float) -> str:
    """Return the replay as an HTML fragment; what: "track" or "pose"; B is grey if it has had none for stale_s."""
    names = [name or default for name, default in zip(picture.ends(), "AB", strict=True)]
    rigs = [rig_outline(node.info if node else None) for node in picture.end_nodes()]
    # Inside a script only `</` could end it early.
    head = json.dumps({"names": names, "rigs": rigs, "levelled": levelled, "what": what, "stale_s": stale_s}).replace(
        "</", "<\\/"
    )
    encoded = msgspec.json.encode(list(frames)).decode("ascii")
    scene = (resources.files("buddyline.tools.monitor") / "web" / "scene.js").read_text("utf-8")
    data = f"const PAIR={head},FRAMES={encoded};"
    return f"{_HTML.replace('WHAT', what)}<script>{scene}\n{data}\n{_SCRIPT}</script>"


_HTML: Final = """<div class="replay"><canvas id="replay" aria-label="3-D replay of the dive"></canvas>
<div class="bar"><button id="play">Play</button><input id="at" type="range" min="0" max="1000" value="0"
aria-label="time"><select id="speed" aria-label="speed"><option value="0.25">0.25x</option><option value="1">1x</option>
<option value="4" selected>4x</option><option value="16">16x</option></select><output id="said"></output></div>
<p class="dim">Drag to turn, wheel or pinch to come closer. Grid of 1 m at A's depth; red arrow: north; light balls:
red left, green right. B is grey where there was no WHAT.</p></div>"""

# The scene is the page's own (web/scene.js), which is put before this.
_SCRIPT: Final = r"""
(() => {
const COLOURS = {back: "#0b1016", text: "#ffffff", dim: "#a9b4c0", grid: "#1d2a35", grid5: "#35495c", a: "#ebebf0",
  b: "#ffaa3c", stale: "#7d848d", track: "#ffbe3c", pose: "#f2a93b", north: "#ff7b74", down: "#6cb0ff",
  left: "#ff4040", right: "#8affc1", surface: "#4696be"};
const canvas = document.getElementById("replay"), scene = new Scene(canvas, draw);
const slider = document.getElementById("at"), said = document.getElementById("said");
const button = document.getElementById("play"), speed = document.getElementById("speed");
const last = FRAMES.length ? FRAMES[FRAMES.length - 1][0] : 0, first = FRAMES.length ? FRAMES[0][0] : 0;
const [A, B] = PAIR.names, rigs = {[A]: PAIR.rigs[0], [B]: PAIR.rigs[1]}, LEVEL = [0, 0, 1, 1, 0, 0, 0, 1, 0];
let at = first, playing = false, before = 0;
function index() {
  let low = 0, high = FRAMES.length - 1;
  while (low < high) { const m = (low + high + 1) >> 1; if (FRAMES[m][0] <= at) low = m; else high = m - 1; }
  return low;
}
function draw() {
  const nodes = [{id: A, label: A, t: [0, 0, 0], R: LEVEL, stale: false}], trail = [];
  let stale = true, range = 0;
  if (FRAMES.length) {
    const k = index(), f = FRAMES[k], whole = Math.max((last - first) / 3, 20);
    stale = at - f[0] > PAIR.stale_s;
    range = Math.hypot(...f[1]);
    nodes[0].R = f[2];
    nodes.push({id: B, label: B + (stale ? ` (no ${PAIR.what})` : ""), t: f[1], R: f[3], stale});
    for (let i = 0; i <= k; i++) {
      trail.push({t: FRAMES[i][1], age: Math.min((at - FRAMES[i][0]) / whole, 1), tracked: 1, joined: FRAMES[i][4]});
    }
    scene.fit([[0, 0, 0], f[1]]);
  }
  scene.draw({nodes, rigs, trail, levelled: PAIR.levelled, depth: null}, COLOURS);
  const min = Math.floor(at / 60), sec = (at - 60 * min).toFixed(1).padStart(4, "0");
  said.value = FRAMES.length ? `${min}:${sec}  range ${range.toFixed(2)} m${stale ? ", no " + PAIR.what : ""}` :
    `no ${PAIR.what}`;
  slider.value = last > first ? Math.round(1000 * (at - first) / (last - first)) : 0;
}
function tick(now) {
  if (!playing) return;
  at += Math.min((now - before) / 1000, 0.2) * Number(speed.value); before = now;
  if (at >= last) { at = last; toggle(); }
  draw();
  requestAnimationFrame(tick);
}
function toggle() {
  playing = !playing; button.textContent = playing ? "Pause" : "Play";
  if (playing) { if (at >= last) at = first; before = performance.now(); requestAnimationFrame(tick); }
}
button.onclick = toggle;
slider.oninput = () => { at = first + slider.value / 1000 * (last - first); draw(); };
addEventListener("resize", draw);
draw();
})();
"""
