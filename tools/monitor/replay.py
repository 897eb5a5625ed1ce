"""The report's 3-D replay: one canvas and a hundred lines of script, without any network access."""

from __future__ import annotations

import json
from collections.abc import Sequence
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
    return _HTML.replace("WHAT", what) + f"<script>const PAIR={head},FRAMES={encoded};\n{_SCRIPT}</script>"


_HTML: Final = """<div class="replay"><canvas id="replay" aria-label="3-D replay of the dive"></canvas>
<div class="bar"><button id="play">Play</button><input id="at" type="range" min="0" max="1000" value="0"
aria-label="time"><select id="speed" aria-label="speed"><option value="0.25">0.25x</option><option value="1">1x</option>
<option value="4" selected>4x</option><option value="16">16x</option></select><output id="said"></output></div>
<p class="dim">Drag to turn, wheel or pinch to come closer. Grid of 1 m at A's depth; red arrow: north; light balls:
red left, green right. B is grey where there was no WHAT.</p></div>"""

_SCRIPT: Final = r"""
(() => {
const canvas = document.getElementById("replay"), pen = canvas.getContext("2d");
const slider = document.getElementById("at"), said = document.getElementById("said");
const button = document.getElementById("play"), speed = document.getElementById("speed");
const last = FRAMES.length ? FRAMES[FRAMES.length - 1][0] : 0, first = FRAMES.length ? FRAMES[0][0] : 0;
let at = first, playing = false, before = 0, turn = 0.6, tilt = 0.5, distance = 6, target = [0, 0, 0];
for (const f of FRAMES) distance = Math.max(distance, 1.5 * Math.hypot(...f[1]));
if (FRAMES.length) target = FRAMES[0][1].map(x => x / 2);
if (FRAMES.length) turn = Math.atan2(FRAMES[0][1][1], FRAMES[0][1][0]) + 2.0;
const times = (R, v) => [0, 1, 2].map(r => R[3*r]*v[0] + R[3*r+1]*v[1] + R[3*r+2]*v[2]);
const plus = (a, b) => [a[0]+b[0], a[1]+b[1], a[2]+b[2]];
function project(p) {
  const d = [p[0]-target[0], p[1]-target[1], p[2]-target[2]];
  const c = Math.cos(turn), s = Math.sin(turn), ct = Math.cos(tilt), st = Math.sin(tilt);
  const right = -s*d[0] + c*d[1], ahead = -(c*d[0] + s*d[1]), up = -d[2];
  const z = distance + ahead*ct - up*st, y = up*ct + ahead*st;
  const f = 1.1 * Math.min(canvas.width, canvas.height * 1.4);
  return z > 0.05 ? [canvas.width/2 - f*right/z, canvas.height/2 - f*y/z, f/z] : null;
}
function line(a, b, colour, wide) {
  const p = project(a), q = project(b);
  if (!p || !q) return;
  pen.strokeStyle = colour; pen.lineWidth = wide * devicePixelRatio;
  pen.beginPath(); pen.moveTo(p[0], p[1]); pen.lineTo(q[0], q[1]); pen.stroke();
}
function ball(a, colour, r) {
  const p = project(a);
  if (!p) return;
  pen.fillStyle = colour; pen.beginPath(); pen.arc(p[0], p[1], Math.max(r*p[2], 2*devicePixelRatio), 0, 7); pen.fill();
}
function text(a, words, colour) {
  const p = project(a);
  if (!p) return;
  pen.fillStyle = colour; pen.font = 12*devicePixelRatio + "px system-ui,sans-serif";
  pen.fillText(words, p[0]+6, p[1]-6);
}
function node(rig, R, t, colour, name, grey) {
  const put = v => plus(times(R, v), t), [w, h, d] = rig.corners;
  const c = [[-w,-h,d],[w,-h,d],[w,h,d],[-w,h,d]].map(put);
  for (let i = 0; i < 4; i++) { line(put([0,0,0]), c[i], colour, 1); line(c[i], c[(i+1)%4], colour, 1); }
  line(put(rig.lights[0]), put(rig.lights[1]), colour, 3);
  ball(put(rig.lights[0]), grey ? colour : "#ff5c5c", 0.035);
  ball(put(rig.lights[1]), grey ? colour : "#4be37a", 0.035);
  text(put([0,-0.25,0]), name, colour);
}
function index() {
  let low = 0, high = FRAMES.length - 1;
  while (low < high) { const m = (low + high + 1) >> 1; if (FRAMES[m][0] <= at) low = m; else high = m - 1; }
  return low;
}
function draw() {
  const box = canvas.getBoundingClientRect();
  canvas.width = Math.round(box.width * devicePixelRatio); canvas.height = Math.round(box.height * devicePixelRatio);
  pen.fillStyle = "#0b1016"; pen.fillRect(0, 0, canvas.width, canvas.height);
  const n = Math.min(Math.ceil(distance / 1.5), 40);
  for (let i = -n; i <= n; i++) {
    const colour = i % 5 ? "#1d2a35" : "#31475a";
    line([i,-n,0], [i,n,0], colour, 1); line([-n,i,0], [n,i,0], colour, 1);
  }
  if (!FRAMES.length) { text(target, "no " + PAIR.what, "#fff"); return; }
  const k = index(), f = FRAMES[k], stale = at - f[0] > PAIR.stale_s;
  for (let i = 1; i <= k; i++) {
    if (!FRAMES[i][4]) continue;
    const age = Math.min((at - FRAMES[i][0]) / Math.max((last-first)/3, 20), 1), fade = Math.sqrt(age);
    const c = [255+(38-255)*fade, 190+(70-190)*fade, 60+(120-60)*fade].map(Math.round);
    line(FRAMES[i-1][1], FRAMES[i][1], `rgb(${c})`, 2);
  }
  if (PAIR.levelled) { line([0,0,0],[1.5,0,0],"#e65050",2); text([1.5,0,0],"north","#e65050"); }
  line([0,0,0],[0,0,1],"#5aa0ff",2); text([0,0,1],"down","#5aa0ff");
  line([0,0,0], f[1], stale ? "#5f6269" : "#ffffff", 1);
  line(f[1], [f[1][0],f[1][1],0], "#5aa0ff", 1);
  node(PAIR.rigs[0], f[2], [0,0,0], "#ebebf0", PAIR.names[0], false);
  const name = PAIR.names[1] + (stale ? ` (no ${PAIR.what})` : "");
  node(PAIR.rigs[1], f[3], f[1], stale ? "#5f6269" : "#ffaa3c", name, stale);
  const min = Math.floor(at/60), sec = (at - 60*min).toFixed(1).padStart(4, "0");
  said.value = `${min}:${sec}  range ${Math.hypot(...f[1]).toFixed(2)} m${stale ? ", no " + PAIR.what : ""}`;
  slider.value = last > first ? Math.round(1000*(at-first)/(last-first)) : 0;
}
function tick(now) {
  if (!playing) return;
  at += Math.min((now - before)/1000, 0.2) * Number(speed.value); before = now;
  if (at >= last) { at = last; toggle(); }
  draw();
  requestAnimationFrame(tick);
}
function toggle() {
  playing = !playing; button.textContent = playing ? "Pause" : "Play";
  if (playing) { if (at >= last) at = first; before = performance.now(); requestAnimationFrame(tick); }
}
button.onclick = toggle;
slider.oninput = () => { at = first + slider.value/1000*(last-first); draw(); };
const held = new Map();
canvas.onpointerdown = e => { held.set(e.pointerId, e); canvas.setPointerCapture(e.pointerId); };
canvas.onpointerup = canvas.onpointercancel = e => held.delete(e.pointerId);
canvas.onpointermove = e => {
  const was = held.get(e.pointerId);
  if (!was) return;
  if (held.size === 1) {
    turn -= (e.clientX - was.clientX)/200; tilt = Math.min(Math.max(tilt + (e.clientY - was.clientY)/200, -1.5), 1.5);
  } else {
    const other = [...held.values()].find(o => o.pointerId !== e.pointerId);
    const gap = o => Math.hypot(o.clientX - other.clientX, o.clientY - other.clientY) + 1;
    distance = Math.min(Math.max(distance * gap(was)/gap(e), 1), 200);
  }
  held.set(e.pointerId, e); draw();
};
canvas.onwheel = e => {
  e.preventDefault();
  distance = Math.min(Math.max(distance*Math.exp(e.deltaY/600), 1), 200); draw();
};
addEventListener("resize", draw);
draw();
})();
"""
