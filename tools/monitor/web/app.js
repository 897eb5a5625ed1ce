// The page: shows what the server says, and judges by its own clock how old that is.
"use strict";

// Green needs an answer to a question that was asked at most this long ago, by this page's clock.
const PROOF_MS = 2000, ASK_MS = 250, SILENT_MS = 1500, DEAD_MS = 6000, KEPT_MS = 150e3, SHOWN_S = 120;
const byId = (id) => document.getElementById(id);
const QUANTITIES = ["Range, m", "Azimuth, deg from north, clockwise", "Inclination, deg, up positive",
  "Position's 1 sd, mm", "Gap between both nodes' ranges, mm", "Latency from exposure to here, ms"];
const FIRST = 5, NED = ["North, m", "East, m", "Down, m"], MISSES = "Triggers without a pose, a second";
const state = { scene: { nodes: [], seen: null }, rigs: {}, points: [], misses: [], probes: {}, now: 0, playback: null,
  live: true, banner: null };
let socket = null, heardMs = -1e9, provenMs = -1e9, triedMs = 0, wait = 250, drawn = false, tone = null, soundFor = "";

const commands = (command) => { if (socket && socket.readyState === 1) socket.send(JSON.stringify(command)); };
const token = decodeURIComponent(location.hash.slice(1));

function connect() {
  const scheme = location.protocol === "https:" ? "wss:" : "ws:";
  socket = new WebSocket(`${scheme}//${location.host}/ws?token=${encodeURIComponent(token)}`);
  socket.onopen = () => { wait = 250; ask(); if (byId("pair").value) commands({ pair: byId("pair").value }); probe(); };
  socket.onmessage = (event) => take(JSON.parse(event.data));
  socket.onclose = again;
  triedMs = performance.now();
}
function again() { setTimeout(connect, wait); wait = Math.min(wait * 2, 4000); judge(); }
// A link that is dead without a word stays open for minutes: leave it, and try anew.
function leave() {
  if (performance.now() - Math.max(heardMs, triedMs) < DEAD_MS) return;
  socket.onclose = socket.onmessage = null;
  socket.close();
  triedMs = performance.now();
  again();
}
function ask() { commands({ ping: performance.now() }); }

function take(said) {
  heardMs = performance.now();
  if (said.title !== undefined) { state.live = said.live; document.title = said.title; return; }
  if (said.reset) { state.points = []; state.misses = []; for (const name in state.probes) state.probes[name] = []; }
  if (said.pong !== undefined) provenMs = said.pong;
  state.now = said.now;
  for (const name of ["scene", "rigs", "banner"]) if (said[name] !== undefined) state[name] = said[name];
  if (said.points) state.points.push(...said.points);
  if (said.misses) state.misses.push(...said.misses);
  for (const [name, value] of Object.entries(said.probes || {})) if (state.probes[name]) state.probes[name].push(value);
  for (const list of [state.points, ...Object.values(state.probes)]) {
    while (list.length && list[0][0] < state.now - KEPT_MS) list.shift();
  }
  while (state.misses.length && state.misses[0] < state.now - KEPT_MS) state.misses.shift();
  for (const name of ["figures", "health"]) if (said[name] !== undefined) byId(name).innerHTML = said[name];
  if (said.cameras) said.cameras.forEach((html, k) => { byId(`cam${k}`).innerHTML = html; });
  if (said.pairs) showPairs(said.pairs);
  if (said.fields) showFields(said.fields);
  if (said.playback) showPlayback(said.playback);
  judge();
  drawn = false;
}

// Whether all is well is judged here too: words that nobody has confirmed for two seconds are no longer green.
function judge() {
  const nowMs = performance.now(), banner = byId("banner"), silent = nowMs - heardMs > SILENT_MS;
  const proven = nowMs - provenMs < PROOF_MS, level = state.banner ? state.banner.level : "unknown";
  const open = socket && socket.readyState === 1;
  document.body.classList.toggle("cut", silent || !open);
  const age = Math.min((nowMs - heardMs) / 1e3, 1e6);
  const lost = heardMs < 0 ? "Connecting." :
    `No news from the monitor for ${age.toFixed(0)} s. What is shown is old: check the program and the network.`;
  let words, look;
  if (silent || !open) { words = lost; look = heardMs < 0 ? "unknown" : "problem"; }
  else if (level === "ok" && !proven) { words = byId("unproven").textContent; look = "unknown"; }
  else { words = state.banner ? state.banner.text : "Connecting."; look = level; }
  byId("unproven").classList.toggle("hidden", look !== "ok");
  if (byId("words").textContent !== words) byId("words").textContent = words;
  // What to do, beside figures that are alone on the page.
  const advice = state.banner && words === state.banner.text && look !== "ok" && state.banner.advice ?
    `What to do: ${state.banner.advice}.` : "";
  if (byId("advice").textContent !== advice) byId("advice").textContent = advice;
  banner.className = look;
  shine(look === "ok", nowMs);
  warn(look === "problem" ? words.replace(/[0-9.]+/g, "") : "");
}
let fading = null;
function shine(well, nowMs) {
  const layer = byId("well");
  if (!well) { if (fading) { fading.cancel(); fading = null; } layer.textContent = ""; return; }
  if (layer.textContent !== state.banner.text) layer.textContent = state.banner.text;
  if (!fading) {
    // The compositor runs it: it ends without any script, in a page that hangs too.
    fading = layer.animate([{ opacity: 1 }, { opacity: 1, offset: 0.9 }, { opacity: 0 }],
      { duration: PROOF_MS, fill: "forwards" });
  }
  fading.currentTime = nowMs - provenMs;
  fading.play();
}
function warn(problem) {
  if (tone && problem && problem !== soundFor) {
    const note = tone.createOscillator(), volume = tone.createGain();
    volume.gain.value = 0.2;
    note.frequency.value = 880;
    note.connect(volume).connect(tone.destination);
    note.start();
    note.stop(tone.currentTime + 0.4);
  }
  soundFor = problem;
}

const scene = new Scene(byId("scene"), () => { drawn = false; });
const COLOURS = ["back", "text", "dim", "line", "grid", "grid5", "a", "b", "stale", "track", "pose", "north", "down", "left",
  "right", "surface"];
let colours = {};
function readColours() {
  const style = getComputedStyle(document.documentElement);
  colours = Object.fromEntries(COLOURS.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}
function trail() {
  const spots = [];
  let before = null;
  for (const point of state.points) {
    if (point[0] > state.now) continue;
    const joined = before !== null && point[0] - before <= 1500;
    if (point[1]) before = point[0];
    spots.push({ t: point.slice(2, 5), tracked: point[1], joined,
      age: Math.min(Math.max((state.now - point[0]) / KEPT_MS, 0), 1) });
  }
  if (!spots.some((spot) => spot.tracked)) spots.forEach((spot, k) => { spot.tracked = spot.joined = k > 0; });
  return spots;
}
// A's camera stands still: the scene as A sees it, with A level and its picture's up for up.
const WITH_CAMERA = ", with its camera", LEVEL = [0, 0, 1, 1, 0, 0, 0, 1, 0];
const cell = (P, Q, r, c) => P[3 * r] * Q[c] + P[3 * r + 1] * Q[c + 3] + P[3 * r + 2] * Q[c + 6];
const product = (P, Q) => [0, 1, 2].flatMap((r) => [0, 1, 2].map((c) => cell(P, Q, r, c)));
const turned = (R) => [0, 1, 2].flatMap((r) => [0, 1, 2].map((c) => R[3 * c + r]));
function asSeenFrom(told, spots) {
  const M = product(LEVEL, turned(told.nodes[0].R));
  for (const spot of spots) spot.t = times(M, spot.t);
  return { ...told, levelled: false, depth: null, nodes: told.nodes.map((one) => ({ ...one, t: times(M, one.t),
    R: product(M, one.R), ...(one.axes && { axes: product(M, one.axes) }) })) };
}
function drawScene() {
  let told = state.scene;
  const still = byId("still").value.replace(WITH_CAMERA, "");
  const node = told.nodes.find((one) => one.id === still);
  const origin = node ? node.t : [0, 0, 0];
  // Seen from B, the trail is A's: where B was, mirrored, so that B's present place is the origin.
  const isOther = node && told.pair && still !== told.pair[0];
  const spots = trail();
  if (isOther) for (const spot of spots) spot.t = spot.t.map((x) => -x);
  if (byId("still").value.endsWith(WITH_CAMERA) && told.nodes.length) told = asSeenFrom(told, spots);
  scene.fit(told.nodes.filter((one, k) => k < 2 || !one.stale).map((one) => minus(one.t, origin)));
  scene.draw({ ...told, rigs: state.rigs, trail: spots, origin, follows: isOther ? () => [0, 0, 0] : null }, colours);
}

function options(select, names, chosen) {
  const wanted = names.join("\n");
  if (select.dataset.names === wanted) return;
  select.dataset.names = wanted;
  const before = chosen || select.value;
  select.replaceChildren(...names.map((name) => new Option(name, name)));
  if (names.includes(before)) select.value = before;
}
function showPairs(pairs) {
  options(byId("pair"), pairs.all, pairs.shown.join("/"));
  byId("pairbox").classList.toggle("hidden", pairs.all.length < 2);
  const still = byId("still"), ends = pairs.shown.filter((name) => name);
  options(still, [...ends, ...ends.slice(0, 1).map((name) => name + WITH_CAMERA)], still.dataset.chosen || ends[0]);
}

const plots = [...document.querySelectorAll(".plot")].map((box, k) => {
  const select = box.querySelector("select");
  options(select, [...QUANTITIES, ...NED, MISSES, "Another field ..."]);
  select.value = [QUANTITIES[0], QUANTITIES[1], QUANTITIES[3]][k];
  select.addEventListener("pointerdown", () => commands({ fields: true }));
  select.addEventListener("focus", () => commands({ fields: true }));
  select.addEventListener("change", () => { plots[k].remake(); probe(); });
  return { select, holder: box.querySelector("div"), chart: null, remake() { if (this.chart) this.chart.destroy();
    this.chart = null; } };
});
let known = [];
function showFields(found) {
  if (found.join() === known.join()) return;
  known = found;
  for (const plot of plots) if (document.activeElement !== plot.select || plot.select.options.length < 12) {
    const chosen = plot.select.value;
    options(plot.select, [...QUANTITIES, ...NED, MISSES, ...found], chosen);
  }
}
const isField = (name) => name.startsWith("buddyline/");
function probe() {
  const wanted = [...new Set(plots.map((plot) => plot.select.value).filter(isField))];
  state.probes = Object.fromEntries(wanted.map((name) => [name, state.probes[name] || []]));
  commands({ probe: wanted });
}
function series(title) {
  const age = (ms) => (ms - state.now) / 1e3;
  const recent = state.points.filter((p) => p[0] <= state.now && age(p[0]) >= -SHOWN_S);
  if (title === MISSES) {
    const counts = new Array(SHOWN_S).fill(0);
    for (const ms of state.misses) {
      const at = Math.floor(age(ms) + SHOWN_S);
      if (at >= 0 && at < SHOWN_S) counts[at]++;
    }
    return [counts.map((_, k) => k - SHOWN_S + 1), counts.map(() => null), counts];
  }
  if (isField(title)) {
    const found = state.probes[title] || [];
    return [found.map((p) => age(p[0])), found.map(() => null), found.map((p) => p[1])];
  }
  const column = NED.includes(title) ? 2 + NED.indexOf(title) : FIRST + QUANTITIES.indexOf(title);
  const found = recent.filter((p) => p[column] != null).sort((p, q) => p[0] - q[0]);
  let values = found.map((p) => p[column]);
  // No line jumps where north is crossed.
  if (title.startsWith("Azimuth")) {
    for (let k = 1; k < values.length; k++) values[k] -= 360 * Math.round((values[k] - values[k - 1]) / 360);
  }
  return [found.map((p) => age(p[0])), values.map((v, k) => (found[k][1] ? null : v)),
    values.map((v, k) => (found[k][1] ? v : null))];
}
// Limits of an axis, without the few values far beyond the inner 96 %; how many they are is said beside the plot.
function limits(values) {
  const sorted = values.filter((v) => v != null).sort((a, b) => a - b), n = sorted.length;
  if (!n) return null;
  let [low, high] = [sorted[0], sorted[n - 1]], outside = 0;
  const inner = [sorted[Math.floor(0.02 * (n - 1))], sorted[Math.ceil(0.98 * (n - 1))]], span = inner[1] - inner[0];
  if (n > 20 && span > 0 && high - low > 4 * span) {
    [low, high] = [inner[0] - span / 2, inner[1] + span / 2];
    outside = sorted.filter((v) => v < low || v > high).length;
  }
  const pad = 0.08 * (high - low) || Math.max(1e-3 * Math.abs(high), 1e-3);
  return { low: low - pad, high: high + pad, outside };
}
// So many seconds are drawn: what there is, in steps of ten.
function shownSeconds() {
  const first = state.points.reduce((least, p) => Math.min(least, p[0]), state.now);
  return Math.min(SHOWN_S, Math.max(20, 10 * Math.ceil((state.now - first) / 1e4)));
}
function drawPlot(plot) {
  const width = plot.holder.clientWidth, height = plot.holder.clientHeight;
  if (width < 60 || height < 50) return;
  const data = series(plot.select.value), bounds = limits([...data[1], ...data[2]]);
  if (!bounds) { plot.remake(); plot.holder.textContent = "Nothing yet."; return; }
  if (!plot.chart) {
    plot.holder.textContent = "";
    const axis = { stroke: colours.dim, grid: { stroke: colours.grid, width: 1 }, ticks: { stroke: colours.line, width: 1 },
      font: "11px system-ui, sans-serif" };
    plot.chart = new uPlot({
      width, height, legend: { show: false }, cursor: { drag: { x: true, y: false } }, padding: [8, 6, 0, 0],
      scales: { x: { time: false }, y: {} },
      axes: [{ ...axis, size: 24, values: (_, ages) => ages.map((age) => age ? `${age} s` : "0") }, { ...axis, size: 52 }],
      series: [{}, { stroke: colours.pose, paths: () => null, points: { show: true, size: 4, fill: colours.pose } },
        { stroke: colours.track, width: 2, points: { show: false }, spanGaps: true }],
      hooks: { draw: [(u) => {
        if (!u.outside) return;
        u.ctx.fillStyle = colours.text;
        u.ctx.textAlign = "left";
        u.ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
        u.ctx.fillText(`${u.outside} outside`, u.bbox.left + 6, u.bbox.top + 14 * devicePixelRatio);
      }] },
    }, [[], [], []], plot.holder);
  }
  if (plot.chart.width !== width || plot.chart.height !== height) plot.chart.setSize({ width, height });
  plot.chart.outside = bounds.outside;
  // A gap of the track is no line across it.
  const gapped = [[], [], []];
  let last = null;
  data[0].forEach((t, k) => {
    if (data[2][k] != null) {
      if (last !== null && t - last > 1.5) { gapped[0].push((t + last) / 2); gapped[1].push(null); gapped[2].push(NaN); }
      last = t;
    }
    for (const c of [0, 1, 2]) gapped[c].push(data[c][k]);
  });
  plot.chart.batch(() => {
    plot.chart.setData(gapped, false);
    plot.chart.setScale("x", { min: -shownSeconds(), max: 0 });
    plot.chart.setScale("y", { min: bounds.low, max: bounds.high });
  });
}

const clock = (s) => `${Math.floor(s / 60)}:${(s % 60).toFixed(1).padStart(4, "0")}`;
let holding = false;
function showPlayback(playback) {
  state.playback = { ...state.playback, ...playback };
  byId("playback").classList.remove("hidden");
  const at = byId("at");
  at.max = playback.length;
  if (!holding) at.value = playback.at;
  byId("time").value = `${clock(playback.at)} of ${clock(playback.length)}${playback.playing ? "" : ", paused"}`;
  byId("play").textContent = playback.playing ? "Pause" : "Play";
  byId("loop").checked = playback.loop;
  if (playback.strip) { byId("strip").innerHTML = playback.strip; byId("legend").textContent = playback.legend; }
}

const toggles = {
  deck: (on) => {
    document.body.classList.toggle("deck", on);
    // Where large figures do not fit, they are scrolled, by keys too.
    document.querySelector("main").tabIndex = on ? 0 : -1;
    plots.forEach((plot) => plot.remake());
  },
  light: (on) => { document.documentElement.classList.toggle("light", on); readColours();
    plots.forEach((plot) => plot.remake()); drawn = false; },
  above: (on) => { scene.lookDown(on); byId("fit").onclick(); },
  sound: (on) => { tone = on ? new AudioContext() : null; },
};
function toggle(name, on) {
  byId(name).setAttribute("aria-pressed", String(on));
  toggles[name](on);
  if (name !== "sound" && name !== "above") { try { localStorage.setItem(name, on ? "1" : "0"); } catch { /* not kept */ } }
}
const isOn = (name) => byId(name).getAttribute("aria-pressed") === "true";
for (const name of Object.keys(toggles)) byId(name).onclick = () => toggle(name, !isOn(name));
byId("fit").onclick = () => { scene.chosen = false; scene.fitted = false; drawn = false; };
byId("still").onchange = () => { byId("still").dataset.chosen = byId("still").value; byId("fit").onclick(); };
byId("pair").onchange = () => { byId("fit").onclick(); commands({ pair: byId("pair").value }); };
byId("play").onclick = () => commands({ play: !(state.playback && state.playback.playing) });
byId("back").onclick = () => commands({ step: -1 });
byId("step").onclick = () => commands({ step: 1 });
byId("lastgap").onclick = () => commands({ gap: -1 });
byId("nextgap").onclick = () => commands({ gap: 1 });
byId("speed").onchange = () => commands({ speed: Number(byId("speed").value) });
byId("loop").onchange = () => commands({ loop: byId("loop").checked });
byId("at").oninput = () => { holding = true; commands({ seek: Number(byId("at").value) }); };
byId("at").onchange = () => { holding = false; };
const KEYS = { d: "deck", l: "light", s: "sound", f: "fit", a: "above", " ": "play", ArrowLeft: "back", ArrowRight: "step", n: "nextgap",
  p: "lastgap" };
addEventListener("keydown", (event) => {
  const id = KEYS[event.key];
  // A chooser has letters, a slider arrows, and a button the space bar, of its own.
  const own = { SELECT: /./, INPUT: /^(Arrow| )/, BUTTON: /^ $/ }[event.target.tagName];
  if (!id || (own && own.test(event.key)) || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  byId(id).click();
});

let plotsMs = 0;
function paint(nowMs) {
  if (!drawn && !document.body.classList.contains("deck")) {
    drawn = true;
    drawScene();
    if (nowMs - plotsMs > 500) { plotsMs = nowMs; plots.forEach(drawPlot); }
  }
  requestAnimationFrame(paint);
}
addEventListener("resize", () => { drawn = false; plotsMs = 0; });
const light = (() => { try { return localStorage.getItem("light"); } catch { return null; } })();
readColours();
toggle("light", light === null ? matchMedia("(prefers-color-scheme: light)").matches : light === "1");
if (location.search.includes("deck")) toggle("deck", true);
setInterval(ask, ASK_MS);
setInterval(judge, 100);
setInterval(leave, 1000);
connect();
requestAnimationFrame(paint);
