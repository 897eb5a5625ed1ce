// The nodes in space on a plain canvas. Places are north, east, down in metres; R is a camera's rotation, row by row.
"use strict";

const times = (R, v) => [0, 1, 2].map((r) => R[3 * r] * v[0] + R[3 * r + 1] * v[1] + R[3 * r + 2] * v[2]);
const plus = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];

class Scene {
  // changed: called when the viewer has turned the view, to draw it again.
  constructor(canvas, changed) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
    this.turn = 2.4;
    this.tilt = 0.45;
    this.distance = 7;
    this.target = [1.5, 0, 0];
    this.chosen = this.above = false;
    this.width = this.height = 0;
    const held = new Map();
    canvas.addEventListener("pointerdown", (e) => { held.set(e.pointerId, e); canvas.setPointerCapture(e.pointerId); });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => held.delete(e.pointerId));
    canvas.addEventListener("pointermove", (e) => {
      const was = held.get(e.pointerId);
      if (!was) return;
      if (held.size === 1) {
        this.look(-(e.clientX - was.clientX) / 200, (e.clientY - was.clientY) / 200, 1);
      } else {
        const other = [...held.values()].find((o) => o.pointerId !== e.pointerId);
        const gap = (o) => Math.hypot(o.clientX - other.clientX, o.clientY - other.clientY) + 1;
        this.look(0, 0, gap(was) / gap(e));
      }
      held.set(e.pointerId, e);
      changed();
    });
    canvas.addEventListener("wheel", (e) => { e.preventDefault(); this.look(0, 0, Math.exp(e.deltaY / 600)); changed(); },
      { passive: false });
    canvas.addEventListener("keydown", (e) => {
      const by = { ArrowLeft: [0.1, 0, 1], ArrowRight: [-0.1, 0, 1], ArrowUp: [0, 0.1, 1], ArrowDown: [0, -0.1, 1],
        "+": [0, 0, 0.9], "-": [0, 0, 1.1] }[e.key];
      if (by) { e.preventDefault(); e.stopPropagation(); this.look(...by); changed(); }
    });
  }

  look(turn, tilt, nearer) {
    this.turn += turn;
    this.tilt = Math.min(Math.max(this.tilt + tilt, -1.5), 1.5);
    this.distance = Math.min(Math.max(this.distance * nearer, 1), 400);
    this.chosen = true;
  }

  // Turn the view to these places, the pair's first, unless the viewer has chosen it or they are still well inside.
  fit(places, again) {
    if (again) this.chosen = false;
    if (this.chosen || !places.length) return;
    const far = places.slice(0, 2).reduce((a, b) => (Math.hypot(...b) > Math.hypot(...a) ? b : a));
    const ends = [Math.min, Math.max].map((most) => [0, 1, 2].map((k) => most(...places.map((place) => place[k]))));
    const range = Math.hypot(...minus(ends[1], ends[0]));
    const middle = plus(ends[0], ends[1]).map((x) => x / 2);
    const wanted = (this.above ? 1.6 : 1.15) * range + 2;
    if (!again && this.fitted && Math.hypot(...minus(middle, this.target)) < 0.15 * this.distance &&
      Math.abs(wanted - this.distance) < 0.25 * this.distance) return;
    this.fitted = true;
    this.target = middle;
    this.distance = wanted;
    if (this.above) this.turn = Math.PI;
    else if (range > 0.2) this.turn = Math.atan2(far[1], far[0]) + 2.0;
  }

  // From above, north up; or from the side again.
  lookDown(above) {
    this.above = above;
    this.tilt = above ? 1.5 : 0.45;
  }

  project(p) {
    const d = minus(p, this.target);
    const c = Math.cos(this.turn), s = Math.sin(this.turn), ct = Math.cos(this.tilt), st = Math.sin(this.tilt);
    const right = -s * d[0] + c * d[1], ahead = -(c * d[0] + s * d[1]), up = -d[2];
    const z = this.distance + ahead * ct - up * st, y = up * ct + ahead * st;
    const f = 1.1 * Math.min(this.width, this.height * 1.4);
    return z > 0.05 ? [this.width / 2 - f * right / z, this.height / 2 - f * y / z, f / z] : null;
  }

  line(a, b, colour, wide, dash) {
    const p = this.project(a), q = this.project(b), pen = this.pen;
    if (!p || !q) return;
    pen.strokeStyle = colour;
    pen.lineWidth = wide * this.ratio;
    pen.setLineDash(dash ? dash.map((x) => x * this.ratio) : []);
    pen.beginPath();
    pen.moveTo(p[0], p[1]);
    pen.lineTo(q[0], q[1]);
    pen.stroke();
  }

  ball(a, colour, r) {
    const p = this.project(a);
    if (!p) return;
    this.pen.fillStyle = colour;
    this.pen.beginPath();
    this.pen.arc(p[0], p[1], Math.max(r * p[2], 2 * this.ratio), 0, 7);
    this.pen.fill();
  }

  // clear: move it up until it is clear of the others that are.
  text(a, words, colour, size = 12, clear = false) {
    const p = this.project(a);
    if (!p) return;
    this.pen.fillStyle = colour;
    this.pen.font = `${size * this.ratio}px system-ui, sans-serif`;
    const wide = this.pen.measureText(words).width, high = 1.25 * size * this.ratio;
    const x = Math.min(p[0] + 6 * this.ratio, this.width - wide - 4 * this.ratio);
    let y = p[1] - 6 * this.ratio;
    if (clear) {
      const hit = () => this.labels.find((one) => x < one.x + one.wide && one.x < x + wide && Math.abs(y - one.y) < high);
      for (let one = hit(); one; one = hit()) y = one.y - high;
      this.labels.push({ x, y, wide });
    }
    this.pen.fillText(words, x, y);
  }

  // The outline of an ellipsoid: its three principal ellipses.
  ellipsoid(t, half, axes, colour) {
    const pen = this.pen, column = (k) => [axes[k], axes[3 + k], axes[6 + k]].map((x) => x * half[k]);
    const [x, y, z] = [0, 1, 2].map(column);
    pen.strokeStyle = pen.fillStyle = colour;
    pen.lineWidth = this.ratio;
    pen.setLineDash([]);
    for (const [u, v] of [[x, y], [y, z], [x, z]]) {
      pen.beginPath();
      for (let i = 0; i < 33; i++) {
        const c = Math.cos(i * Math.PI / 16), s = Math.sin(i * Math.PI / 16);
        const p = this.project([0, 1, 2].map((k) => t[k] + c * u[k] + s * v[k]));
        if (!p) return;
        if (i) pen.lineTo(p[0], p[1]); else pen.moveTo(p[0], p[1]);
      }
      pen.globalAlpha = 0.12;
      pen.fill();
      pen.globalAlpha = 0.8;
      pen.stroke();
    }
    pen.globalAlpha = 1;
  }

  node(node, rig, colour, colours) {
    const put = (v) => plus(times(node.R, v), node.t), [w, h, d] = rig.corners;
    const corners = [[-w, -h, d], [w, -h, d], [w, h, d], [-w, h, d]].map(put);
    for (let i = 0; i < 4; i++) {
      this.line(node.t, corners[i], colour, 1.2);
      this.line(corners[i], corners[(i + 1) % 4], colour, 1.2);
    }
    this.line(put(rig.lights[0]), put(rig.lights[1]), colour, 3);
    this.ball(put(rig.lights[0]), node.stale ? colour : colours.left, 0.035);
    this.ball(put(rig.lights[1]), node.stale ? colour : colours.right, 0.035);
    this.text(plus(node.t, [0, 0, -0.25]), node.label, colour, 13, true);
  }

  // what: nodes (A first), rigs by id, trail [{t, age 0..1, joined, tracked}], levelled, depth (of A, m), origin
  // (what stands still), seen (which of B's lights A sees, of A's lights B sees). colours: by their names in style.css.
  draw(what, colours) {
    const box = this.canvas.getBoundingClientRect();
    this.ratio = window.devicePixelRatio || 1;
    this.width = this.canvas.width = Math.max(1, Math.round(box.width * this.ratio));
    this.height = this.canvas.height = Math.max(1, Math.round(box.height * this.ratio));
    this.pen.fillStyle = colours.back;
    this.pen.fillRect(0, 0, this.width, this.height);
    this.labels = [];
    const origin = what.origin || [0, 0, 0];
    const nodes = what.nodes.map((node) => ({ ...node, t: minus(node.t, origin) }));
    const floor = -origin[2];
    this.grid(colours, floor);
    if (what.depth != null && what.depth < 60) this.surface(floor - what.depth, colours);
    const base = [0, 0, 0];
    if (what.levelled) {
      this.line(base, [1.5, 0, 0], colours.north, 2);
      this.text([1.5, 0, 0], "north", colours.north);
    }
    this.line(base, [0, 0, 1], colours.down, 2);
    this.text([0, 0, 1], "down", colours.down);
    let before = null;
    for (const spot of what.trail) {
      const t = minus(spot.t, what.follows ? what.follows(spot) : origin);
      this.pen.globalAlpha = 1 - 0.8 * Math.sqrt(spot.age);
      if (spot.tracked) {
        if (before && spot.joined) this.line(before, t, colours.track, 2);
        before = t;
      } else {
        this.ball(t, colours.pose, 0.012);
      }
    }
    this.pen.globalAlpha = 1;
    const [a, b] = nodes;
    if (a && b) {
      this.line(a.t, b.t, b.stale ? colours.stale : colours.text, 1, b.stale ? [4, 4] : null);
      this.line(b.t, [b.t[0], b.t[1], a.t[2]], colours.down, 1, [2, 3]);
      this.rays(a, b, what, colours);
    }
    nodes.forEach((node, k) => {
      const rig = what.rigs[node.id] || { lights: [[-0.5, 0, 0], [0.5, 0, 0]], corners: [0.25, 0.2, 0.35] };
      const colour = node.stale ? colours.stale : k === 0 ? colours.a : colours.b;
      if (node.half && !node.stale) this.ellipsoid(node.t, node.half, node.axes, colours.b);
      this.node(node, rig, colour, colours);
    });
  }

  // From each eye to the lights that it saw at the newest pose.
  rays(a, b, what, colours) {
    if (!what.seen || b.stale) return;
    for (const [eye, other, first] of [[a, b, 0], [b, a, 2]]) {
      const rig = what.rigs[other.id];
      for (const side of rig ? [0, 1] : []) {
        if (!what.seen[first + side]) continue;
        this.pen.globalAlpha = 0.45;
        this.line(eye.t, plus(times(other.R, rig.lights[side]), other.t), side ? colours.right : colours.left, 1);
        this.pen.globalAlpha = 1;
      }
    }
  }

  grid(colours, floor) {
    const n = Math.min(Math.ceil(this.distance / 1.5), 60), every = this.distance < 12 ? 1 : this.distance < 40 ? 5 : 10;
    for (let i = -n; i <= n; i++) {
      if (n > 30 && i % 5) continue;
      const colour = i % 5 ? colours.grid : colours.grid5;
      this.line([i, -n, floor], [i, n, floor], colour, 1);
      this.line([-n, i, floor], [n, i, floor], colour, 1);
      if (i && i % every === 0) {
        this.text([i, 0, floor], `${Math.abs(i)} m ${i > 0 ? "N" : "S"}`, colours.dim, 10);
        this.text([0, i, floor], `${Math.abs(i)} m ${i > 0 ? "E" : "W"}`, colours.dim, 10);
      }
    }
  }

  surface(z, colours) {
    this.pen.globalAlpha = 0.5;
    for (let i = -20; i <= 20; i += 5) {
      this.line([i, -20, z], [i, 20, z], colours.surface, 1);
      this.line([-20, i, z], [20, i, z], colours.surface, 1);
    }
    this.pen.globalAlpha = 1;
    this.text([0, 0, z], "surface", colours.surface);
  }
}
