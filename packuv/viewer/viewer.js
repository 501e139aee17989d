// The page's own work: playback, controls, and the traffic between the worker, the camera and the GPU.

import { DEPTH_STOPS, MODES, SplatView } from "./splats.js";
import { Navigation, frusta, worldOf } from "./navigation.js";
import { Recorder, momentOf } from "./film.js";

const VIEW_SECONDS = 2; // of a camera path, from view to view at least
const RESUME_SECONDS = 0.5; // after a stall, play on once this much is there
const STALL_NOTICE_MS = 250;
const LOOK_MS = 5000, IDLE_MS = 10000; // between looks at whether there is more of what grows; without a touch
const HERE = 1, LOST = 2; // what the worker says of a frame; 0 is on its way
const APART_SECONDS = 0.15, NEAR_SECONDS = 0.02; // of sound and frames: sound jumps, goes on a little faster or slower
const GAMMA = 2.4; // a factor on light is its power of 1 / 2.4 on sRGB + 0.055

const at = (id) => document.getElementById(id);
const canvas = at("picture");
const wish = new URLSearchParams(location.hash.slice(1)); // frame, camera, mode, play=0, scale, background, bare=1

const look = { mode: "colour", bands: 15, arrived: 15, scale: 1, background: [0, 0, 0], range: [1, 2], light: [1, 1, 1], lines: false };
const player = {
  frame: 0, step: 1, ends: "loop", shown: -1, playing: wish.get("play") !== "0", speed: 1, due: 0,
  stalled: false, stalledAt: 0, stalls: 0, overtaken: 0, // frames whose time was over before they were drawn
};
const ENDS = { loop: "Loop", bounce: "Ping-pong", stop: "Once" }; // what happens at the last frame
const TRUTHS = ["", "beside", "over", "minus"];
const truth = { mode: "", loading: "", shown: "" }; // addresses of pictures
const path = []; // views of a camera path, as packuv.film reads them
const filming = { on: false, stopped: false, told: null }; // told: hears that a picture has come
const sound = { voice: new Audio(), asked: false, on: true };
const layered = { shown: -1, asked: -1 }; // segments
const ruler = { on: false, points: [] }; // world
const buffer = { map: new Uint8Array(0), ahead: 1, trouble: "", closed: false }; // closed: the user knows of the trouble
const meter = { drawn: 0, frames: 0, since: performance.now(), sort_ms: 0, count: 0, moving: 0, seen: new Set() };
let scene = null, world = null, frameCount = 0, rate = 30, keyframes = new Set();
let touched = -IDLE_MS; // when somebody last did something
let waiting = false, stale = true, dirty = true, spare = null, previous = performance.now();

let splats;
const navigation = new Navigation(canvas, () => { stale = dirty = true; });
const worker = new Worker("worker.js");
worker.onmessage = ({ data }) => receive[data.type](data);
worker.onerror = (event) => notice(`The worker stopped: ${event.message}`, true);

for (const kind of ["pointerdown", "pointermove", "wheel", "keydown"]) {
  addEventListener(kind, () => { touched = performance.now(); }, { passive: true });
}

// ---- messages

const receive = {
  scene(message) {
    scene = message.scene;
    rate = scene.rate[0] / scene.rate[1];
    frameCount = scene.segments.reduce((sum, { length }) => sum + length, 0);
    keyframes = new Set(scene.segments.map(({ first }) => first));
    splats.setTables(message.tables, message.layers, scene);
    world = worldOf(scene);
    navigation.setWorld(world);
    splats.setLines(frusta(scene, world));
    fillPage();
    if (scene.made !== undefined) setTimeout(lookForMore, LOOK_MS);
    document.documentElement.dataset.stalls = 0; // for automation
    requestAnimationFrame(tick);
  },
  buffered({ map, ahead }) {
    Object.assign(buffer, { map, ahead, fresh: true });
  },
  layers({ segment, layers }) {
    if (segment !== layered.shown) return;
    splats.setLayers(layers);
    document.documentElement.dataset.layers = segment; // for automation
    dirty = true;
  },
  part() { // of a key; the page asks for it as long as nothing whole is on screen
    if (player.shown < 0) stale = true;
  },
  miss() { waiting = false; stale = false; filming.told?.(); },
  picture(message) {
    waiting = false;
    if (message.key) splats.setKey(message.key.packed, message.key.slotCount, message.moving);
    if (message.frame_codes) splats.setFrame(message.frame_codes.packed, message.frame_codes.rows);
    splats.setOrder(message.order, message.visible);
    spare = message.order.buffer;
    layered.shown = message.segment;
    if (look.mode === "layer") askLayers();
    settleRange(message.range, message.frame !== player.shown && player.shown >= 0);
    if (message.frame !== player.shown) meter.frames++;
    player.shown = message.frame;
    look.arrived = message.bands;
    const lit = message.frame < 0 ? scene.segments[message.segment].first : message.frame;
    look.light = (scene.light?.[lit] ?? [0, 0, 0]).map((log) => Math.exp(log / GAMMA));
    const { count, moving, sort_ms, visible, traffic } = message;
    if (visible) document.documentElement.dataset.first ??= performance.now(); // for automation: ms to a picture
    if (visible && !sound.asked) fetchSound();
    Object.assign(meter, { count, moving, sort_ms, visible, traffic });
    dirty = true;
    filming.told?.();
  },
  lost({ count, text }) {
    at("lost").hidden = false;
    at("lost").textContent = `${count} of ${frameCount} frames skipped`;
    at("lost").title = `They are damaged or missing: ${text}`;
    document.documentElement.dataset.lost = count; // for automation
  },
  problem({ text }) {
    buffer.trouble = text;
    if (!text) buffer.closed = false;
    notice("");
  },
};

function ask() {
  const { eye, forward, near } = navigation.view();
  worker.postMessage({ type: "show", frame: player.frame, eye, forward, near, spare }, spare ? [spare] : []);
  spare = null;
  waiting = true;
  stale = false;
}

// Layers of the UV map are told once for each segment on screen, and only to who looks at them.
function askLayers() {
  if (layered.asked === layered.shown || layered.shown < 0) return;
  layered.asked = layered.shown;
  worker.postMessage({ type: "layers" });
}

function tellPlayhead() {
  const { frame, step, ends } = player;
  worker.postMessage({ type: "playhead", frame, step, ends });
}

// Depth colours follow the view, but slowly while it plays, or they would flicker.
function settleRange([near, far], slowly) {
  const next = [near, Math.max(far, near * 1.05)];
  look.range = slowly ? look.range.map((value, k) => value * (next[k] / value) ** 0.1) : next;
}

// ---- playback

// The playhead goes forward only onto frames that have arrived: at the end of the buffer it stands still. A lost frame
// takes its time, and the picture before it stays.
function advance(seconds) {
  if (player.stalled && !mayResume()) return;
  if (player.stalled) { player.stalled = false; notice(""); }
  player.due += seconds * player.speed;
  let moved = 0;
  for (; moved < frameCount; moved++) {
    const next = following(player);
    if (next === null) return pause();
    if (player.due < shownFor(player.frame)) break;
    if (!buffer.map[next.frame]) { stall(); break; }
    player.due -= shownFor(player.frame);
    if (player.frame !== player.shown && buffer.map[player.frame] === HERE) player.overtaken++;
    Object.assign(player, next);
  }
  if (moved) { stale = true; tellPlayhead(); showClock(); }
  document.documentElement.dataset.overtaken = player.overtaken; // for automation
}

function shownFor(frame) { // seconds; frames need not be evenly spaced
  const next = frame + 1 < frameCount ? scene.times_ns[frame + 1] : scene.times_ns[frame] + 1e9 / rate;
  return (next - scene.times_ns[frame]) / 1e9;
}

function following({ frame, step }) { // frame and direction; null at the end
  const there = (number) => number >= 0 && number < frameCount;
  if (frameCount < 2) return null;
  if (player.ends === "bounce" && !there(frame + step)) step = -step;
  if (there(frame + step)) return { frame: frame + step, step };
  return player.ends === "loop" ? { frame: 0, step } : null;
}

function stall() {
  player.stalled = true;
  document.documentElement.dataset.stalls = ++player.stalls; // for automation
  player.stalledAt = performance.now();
  player.due = 0;
  tellPlayhead();
}

function mayResume() {
  const long = performance.now() - player.stalledAt > STALL_NOTICE_MS;
  if (long && at("wait").hidden && !buffer.closed) notice("Loading frames…"); // who closed the trouble knows
  const enough = buffer.trouble ? 1 : Math.min(buffer.ahead - 1, Math.ceil(RESUME_SECONDS * rate * player.speed));
  let next = player;
  for (let left = enough; left > 0; left--) {
    next = following(next);
    if (next === null) return true;
    if (!buffer.map[next.frame]) return false;
  }
  return true;
}

function seek(frame) {
  player.frame = Math.max(0, Math.min(frameCount - 1, frame));
  player.due = 0;
  stale = true;
  tellPlayhead();
  showClock();
}

function pause() { setPlaying(false); }

function setPlaying(playing) {
  if (playing && following(player) === null) seek(0);
  Object.assign(player, { playing, due: 0, stalled: false });
  notice("");
  at("play").textContent = playing ? "Pause" : "Play";
}

// ---- sound

// All of it, once there is a picture: servers that know no ranges would let nobody seek in it.
async function fetchSound() {
  sound.asked = true;
  const answer = scene.sound && await fetch("sound.flac").catch(() => null);
  if (!answer?.ok) return;
  sound.voice.src = URL.createObjectURL(await answer.blob());
  at("sound").title += `: what ${scene.sound} heard`;
  at("sound").hidden = false;
}

// Frames lead. What is heard is what was filmed, so only as fast and forth; a browser plays nothing before it is touched.
function hear() {
  const { voice } = sound, told = document.documentElement.dataset, now = scene.times_ns[player.frame] / 1e9 + player.due;
  const goesOn = player.playing && !player.stalled && !scrubbing && !filming.on && !document.hidden;
  const asFilmed = player.speed === 1 && player.ends !== "bounce" && now < voice.duration - (voice.ended ? APART_SECONDS : 0);
  if (!goesOn || !asFilmed || !sound.on || !(navigator.userActivation?.hasBeenActive ?? true)) {
    voice.pause();
    delete told.apart;
    return;
  }
  const apart = voice.currentTime - now;
  if (Math.abs(apart) > APART_SECONDS) voice.currentTime = now;
  voice.playbackRate = Math.abs(apart) < NEAR_SECONDS ? 1 : 1 - Math.max(-0.1, Math.min(0.1, apart));
  if (voice.paused) voice.play().catch(() => {}); // paused again before it began
  told.apart = apart; // for automation
}

function setSound(on) {
  sound.on = on;
  press("sound", on);
}

// ---- drawing

function tick(now) {
  requestAnimationFrame(tick);
  const seconds = Math.min(sound.voice.paused ? 0.25 : 2, (now - previous) / 1000); // sound goes on between pictures
  previous = now;
  hear();
  if (filming.on) return;
  fitCanvas();
  navigation.step(now, seconds);
  if (player.playing && !scrubbing) advance(seconds);
  if (!waiting && (stale || player.frame !== player.shown && buffer.map[player.frame] === HERE)) ask();
  if (dirty) drawPicture();
  if (buffer.fresh) drawMarks();
  if (now - meter.since > 1000) showSpeeds(now);
}

function drawPicture() {
  dirty = false;
  const view = navigation.view();
  const started = performance.now();
  splats.draw(view, { ...look, bands: look.bands & look.arrived });
  meter.submit_ms = performance.now() - started;
  meter.drawn++;
  drawRuler();
  outline(view.frame);
  placeTruth(view.frame);
  showLegend();
  if (player.shown >= 0) document.documentElement.dataset.frame = player.shown; // for automation
}

function fitCanvas() {
  const density = Math.min(2, devicePixelRatio) * Number(at("resolution").value);
  const pixels = (size) => Math.max(1, Math.round(size * density));
  const [width, height] = [pixels(canvas.clientWidth), pixels(canvas.clientHeight)];
  if (canvas.width === width && canvas.height === height) return;
  Object.assign(canvas, { width, height });
  dirty = true;
}

function outline([left, top, width, height]) {
  const box = at("frame-outline"), density = canvas.width / canvas.clientWidth;
  box.hidden = !navigation.exact || navigation.jump !== null;
  const sides = { left, top, width, height };
  for (const [side, value] of Object.entries(sides)) box.style[side] = `${value / density}px`;
  for (const button of at("cameras").children) {
    button.setAttribute("aria-current", String(button.dataset.camera === navigation.exact));
  }
}

// ---- what was filmed

// The picture of the capture camera whose very view this is, over the outline of its picture or beside it.
function placeTruth([left, top, width, height]) {
  const camera = navigation.jump ? null : navigation.exact, picture = at("truth");
  const filmed = truth.mode && player.shown >= 0 && scene.truth?.includes(camera);
  picture.hidden = !filmed || !truth.shown.startsWith(`truth/${encodeURIComponent(camera)}/`);
  if (!filmed) return;
  const density = canvas.width / canvas.clientWidth, aside = truth.mode === "beside" ? canvas.clientWidth : 0;
  const sides = { left: left / density + aside, top: top / density, width: width / density, height: height / density };
  for (const [side, value] of Object.entries(sides)) picture.style[side] = `${value}px`;
  picture.style.opacity = truth.mode === "over" ? at("share").value : 1;
  const state = scene.made === undefined ? "" : `?made=${scene.made}`; // of what grows, whose frames get other numbers
  fetchTruth(`truth/${encodeURIComponent(camera)}/${player.shown}.png${state}`);
}

function fetchTruth(address) { // one at a time; what plays on meanwhile is shown next
  if (truth.loading || truth.shown === address) return;
  truth.loading = address;
  const next = new Image();
  next.src = address;
  const settle = (found) => {
    truth.loading = "";
    truth.shown = found ? address : `${address} is not there`;
    if (found) at("truth").src = next.src;
    else at("truth").removeAttribute("src");
    document.documentElement.dataset.truth = truth.shown; // for automation
    dirty = true;
  };
  next.decode().then(() => settle(true), () => settle(false));
}

function setTruth(mode) {
  truth.mode = scene.truth ? mode : "";
  at("compare").value = truth.mode;
  for (const name of TRUTHS.filter(Boolean)) document.body.classList.toggle(name, name === truth.mode);
  at("share-row").hidden = truth.mode !== "over";
  dirty = true;
}

function drawMarks() {
  const marks = at("marks"), pen = marks.getContext("2d");
  buffer.fresh = false;
  marks.width = Math.max(1, marks.clientWidth);
  const step = marks.width / frameCount;
  pen.fillStyle = "#ffffff1c";
  pen.fillRect(0, 0, marks.width, 10);
  pen.fillStyle = "#6cb2ff66";
  for (let frame = 0; frame < frameCount; frame++) { // runs: single frames would leave seams
    if (!buffer.map[frame]) continue;
    const first = frame;
    while (buffer.map[frame]) frame++;
    pen.fillRect(first * step, 0, (frame - first) * step, 10);
  }
  pen.fillStyle = "#ff6b6b";
  for (let frame = 0; frame < frameCount; frame++) {
    if (buffer.map[frame] === LOST) pen.fillRect(frame * step, 0, Math.max(1.5, step), 10);
  }
  pen.fillStyle = "#ffffffb0";
  for (const frame of keyframes) pen.fillRect(Math.min(frame * step, marks.width - 1.5), 0, 1.5, 10);
  if (scene.worst === undefined) return;
  pen.fillStyle = "#ff9d3b";
  pen.fillRect(Math.min(scene.worst * step, marks.width - 3), 0, 3, 10);
}

// ---- words

function showClock() {
  const { frame } = player;
  const said = [[buffer.map[frame] === LOST, "lost"], [keyframes.has(frame), "keyframe"], [frame === scene.worst, "worst"]];
  const key = said.filter(([is]) => is).map(([, word]) => ` · ${word}`).join("");
  const seconds = (scene.times_ns[player.frame] / 1e9).toFixed(3);
  at("clock").innerHTML = `<b>${player.frame}</b> / ${frameCount - 1} · ${seconds} s${key}`;
  at("scrub").value = player.frame;
}

function showSpeeds(now) {
  const seconds = (now - meter.since) / 1000;
  const [count, moving] = [meter.count, meter.moving].map((number) => number.toLocaleString("en"));
  at("counts").textContent = `${count} Gaussians, ${moving} dynamic`;
  const drawn = meter.drawn ? `${(meter.drawn / seconds).toFixed(meter.drawn < 5 ? 1 : 0)} fps` : "still";
  const played = player.playing ? ` · ${(meter.frames / seconds).toFixed(1)} of ${rate.toFixed(0)} frames/s` : "";
  at("speeds").textContent = `${drawn}${played} · sort ${meter.sort_ms.toFixed(1)} ms`;
  showStats(drawn, seconds);
  Object.assign(meter, { drawn: 0, frames: 0, since: now });
}

function showStats(drawn, seconds) {
  const { traffic = {}, visible = 0 } = meter;
  const ms = (value) => `${(value ?? 0).toFixed(1)} ms`;
  const rate_kb = (traffic.bytes - (meter.bytes ?? 0)) / 1000 / seconds;
  meter.bytes = traffic.bytes;
  const rows = {
    "drawn": drawn, "Gaussians drawn": visible.toLocaleString("en"), "decode, server": ms(traffic.decode_ms),
    "unpack": ms(traffic.unpack_ms), "sort": ms(meter.sort_ms), "draw, processor": ms(meter.submit_ms),
    "draw, GPU": splats.gpu_ms === null ? "not told" : ms(splats.gpu_ms), "stalls": player.stalls,
    "too slow to draw": player.overtaken,
    "received": `${((traffic.bytes ?? 0) / 1e6).toFixed(2)} MB`, "network": `${(rate_kb || 0).toFixed(0)} kB/s`,
    "picture": `${canvas.width} × ${canvas.height}`,
  };
  at("stats").replaceChildren(...Object.entries(rows).flatMap(([name, value]) => [
    Object.assign(document.createElement("dt"), { textContent: name }),
    Object.assign(document.createElement("dd"), { textContent: value }),
  ]));
}

function showLegend() {
  at("legend").hidden = look.mode !== "depth";
  at("nearest").textContent = look.range[0].toPrecision(2);
  at("farthest").textContent = look.range[1].toPrecision(2);
}

function notice(text, bad = false) { // what went wrong stays until it is mended
  if (!text && buffer.trouble) [text, bad] = [buffer.trouble, true];
  const box = at("wait");
  box.hidden = !text || (buffer.closed && text === buffer.trouble);
  at("notice").textContent = text;
  box.classList.toggle("bad", bad);
}

function dismiss() {
  buffer.closed = Boolean(buffer.trouble);
  at("wait").hidden = true;
}

function fillPage() {
  document.title = `${scene.name} · PackUV`;
  at("name").textContent = scene.name;
  at("scrub").max = frameCount - 1;
  at("ramp").style.background = `linear-gradient(90deg, ${DEPTH_STOPS.map((stop) => `rgb(${stop})`)})`;
  for (const camera of scene.cameras) {
    const button = document.createElement("button"), dot = document.createElement("i");
    dot.classList.toggle("held", camera.held_out);
    button.append(dot, camera.name);
    if (camera.held_out) button.append(Object.assign(document.createElement("small"), { textContent: "held out" }));
    button.dataset.camera = camera.name;
    button.onclick = () => navigation.lookFrom(camera);
    at("cameras").append(button);
  }
  at("cameras-head").hidden = !scene.cameras.length;
  for (const [name, mask] of bandsOf(scene.sh_degree)) at("bands").append(new Option(name, mask));
  at("bands-row").hidden = !scene.sh_degree;
  at("truth-row").hidden = !scene.truth;
  at("mode-layer").hidden = !scene.layers;
  grantWish();
  setPlaying(player.playing);
  setNear(0);
}

function grantWish() {
  const camera = scene.cameras.find(({ name }) => name === wish.get("camera")) ?? scene.cameras[0];
  if (camera) navigation.lookFrom(camera, { animate: false, isHome: true });
  if (wish.has("view")) navigation.recall(wish.get("view").split(",").map(Number));
  if (wish.has("bands")) setBands(Number(wish.get("bands")) || 0);
  if (ENDS[wish.get("ends")]) setEnds(wish.get("ends"));
  if (TRUTHS.includes(wish.get("truth"))) setTruth(wish.get("truth"));
  if (MODES.includes(wish.get("mode"))) setMode(wish.get("mode"));
  if (wish.has("scale")) setScale(Number(wish.get("scale")) || 1);
  if (wish.has("background")) look.background = wish.get("background").split(",").map(Number);
  if (wish.get("cameras") === "1") at("show-cameras").click();
  document.body.classList.toggle("bare", wish.get("bare") === "1");
  seek(Number(wish.get("frame")) || 0);
}

// ---- controls

let scrubbing = false;

function press(id, pressed) { at(id).setAttribute("aria-pressed", String(pressed)); }

function setMode(mode) {
  if (mode === "layer" && !scene.layers) return; // a folder for the web does not hold them
  look.mode = mode;
  if (mode === "layer") askLayers();
  for (const name of MODES) press(`mode-${name}`, name === mode);
  dirty = true;
}

function setFlying(flying) {
  navigation.flying = flying;
  press("fly", flying);
  press("orbit", !flying);
}

function setScale(scale) {
  look.scale = Math.max(0.05, Math.min(1.5, scale));
  at("scale").value = look.scale;
  at("scale-value").textContent = look.scale.toFixed(2);
  dirty = true;
}

function setNear(octaves) { // the slider counts doublings of the scene's own near plane
  world.near = scene.near * 2 ** octaves;
  at("near-value").textContent = world.near.toPrecision(2);
  stale = dirty = true;
}

function setBackground() {
  look.background = at("background").value.split(" ").map(Number);
  dirty = true;
}

function setEnds(ends) {
  Object.assign(player, { ends, step: 1 });
  at("ends").textContent = ENDS[ends];
  if (scene) tellPlayhead();
}

function cycle(list, now) { return list[(list.indexOf(now) + 1) % list.length]; }

function cycleEnds() { setEnds(cycle(Object.keys(ENDS), player.ends)); }

// Bands of view dependence to draw, as bits: all, none but what is the same from everywhere, up to one, one alone.
function bandsOf(degree) {
  const upTo = Array.from({ length: Math.max(0, degree - 1) }, (_, k) => [`up to ${k + 1}`, 2 ** (k + 2) - 1]);
  const alone = Array.from({ length: degree }, (_, k) => [`${k + 1} alone`, 2 ** (k + 1)]);
  return [["all", 15], ["off", 1], ...upTo, ...alone];
}

function setBands(bands) {
  look.bands = bands;
  at("bands").value = bands;
  dirty = true;
}

function cycleBands() { setBands(cycle(bandsOf(scene.sh_degree).map(([, mask]) => mask), look.bands)); }

function setFolded(folded) {
  document.body.classList.toggle("folded", folded);
  press("more", !folded);
  if (scene) drawMarks();
}

// ---- measuring

function setMeasuring(on) {
  Object.assign(ruler, { on, points: [] });
  press("measure", on);
  document.body.classList.toggle("measuring", on);
  drawRuler();
}

function measureAt(event) {
  const point = pointUnder(event);
  if (point) ruler.points = ruler.points.length === 2 ? [point] : [...ruler.points, point]; // a third begins anew
  drawRuler();
}

function drawRuler() {
  const density = canvas.width / canvas.clientWidth;
  const ends = ruler.points.map((point) => navigation.pixelOf(point)?.map((value) => value / density));
  at("ruler").toggleAttribute("hidden", !ends.length || ends.includes(undefined));
  if (!ends.length || ends.includes(undefined)) return;
  const [line, first, second, text] = at("ruler").children, [a, b = a] = ends;
  const set = (element, values) => Object.entries(values).forEach(([name, value]) => element.setAttribute(name, value));
  set(line, { x1: a[0], y1: a[1], x2: b[0], y2: b[1] });
  set(first, { cx: a[0], cy: a[1] });
  set(second, { cx: b[0], cy: b[1] });
  set(text, { x: (a[0] + b[0]) / 2 + 8, y: (a[1] + b[1]) / 2 - 8 });
  text.textContent = ends.length === 2 ? spanText() : "";
}

function spanText() {
  const [a, b] = ruler.points, span = Math.hypot(...a.map((value, k) => value - b[k]));
  document.documentElement.dataset.span = span; // for automation
  return `${span.toPrecision(4)} ${scene.metric ? "m" : "units"}`;
}

// ---- what grows: a run that is under way

// Ask now and then, but not while somebody is at it, and come back to the same view where there is more.
async function lookForMore() {
  const idle = performance.now() - touched > IDLE_MS;
  const now = idle ? await fetch("scene.json").then((answer) => answer.json()).catch(() => null) : null;
  if (!now || now.made === scene.made) return setTimeout(lookForMore, LOOK_MS);
  putHere(Number(player.playing));
  location.reload();
}

// ---- what is kept

function putHere(play) {
  const now = new URLSearchParams({ frame: player.shown, play, mode: look.mode, scale: look.scale, bands: look.bands });
  const numbers = navigation.numbers().map((value) => Number(value.toPrecision(9)));
  now.set(...(navigation.exact ? ["camera", navigation.exact] : ["view", numbers.join(",")]));
  now.set("background", look.background.join(","));
  if (look.lines) now.set("cameras", 1);
  if (truth.mode) now.set("truth", truth.mode);
  history.replaceState(null, "", `#${now}`);
}

function linkHere() {
  putHere(0);
  const told = () => notice("This page's address now shows this very view.");
  if (!navigator.clipboard) return told();
  navigator.clipboard.writeText(location.href).then(() => notice("The link to this view is copied."), told);
}

// Some seconds from view to view, or what the scene takes between their frames.
function addView() {
  const last = path.at(-1), frame = Math.max(0, player.shown);
  const apart = last && Math.max(VIEW_SECONDS, Math.abs(scene.times_ns[frame] - scene.times_ns[last.frame]) / 1e9);
  const { width, height, ...camera } = navigation.camera();
  const whole = { width: Math.round(width), height: Math.round(height) };
  path.push({ seconds: last ? last.seconds + apart : 0, frame, camera: { ...camera, ...whole } });
  tellPath();
}

function takeBack() {
  path.pop();
  tellPath();
}

function tellPath() {
  const { length } = path;
  at("path-count").textContent = length ? `${length} view${length > 1 ? "s" : ""}, ${path.at(-1).seconds.toFixed(1)} s` : "no view";
  at("path-save").disabled = at("path-film").disabled = !length;
}

function pathText() { return JSON.stringify({ format: "packuv-path", version: 1, scene: scene.name, views: path }, null, 1); }

function savePath() {
  if (!path.length) return notice("The camera path has no view yet; K adds one.");
  document.documentElement.dataset.path = pathText(); // for automation
  save(`${scene.name.replace(/\.\w+$/, "")}_path.json`, new Blob([pathText()], { type: "application/json" }));
}

// Every picture of the path is drawn and coded, however long that takes; a lost frame shows the one before it.
async function film() {
  if (!path.length) return notice("The camera path has no view yet; K adds one.");
  if (filming.on) return;
  const { width, height } = path[0].camera, [even, evenly] = [width, height].map((side) => Math.max(2, side & ~1));
  const count = Math.floor(path.at(-1).seconds * rate + 1e-9) + 1, before = { state: navigation.state, frame: player.frame };
  pause();
  Object.assign(filming, { on: true, stopped: false });
  try {
    const recorder = await Recorder.open(even, evenly, scene.rate);
    Object.assign(canvas, { width: even, height: evenly });
    for (let number = 0; number < count && !filming.stopped; number++) {
      notice(`Filming ${number + 1} of ${count}; Esc ends it here.`);
      const moment = momentOf(path, number / rate);
      navigation.show(moment.camera);
      await showFrame(moment.frame);
      drawPicture();
      await recorder.add(canvas);
    }
    globalThis.filmed = await recorder.finish(); // for automation
    save(`${scene.name.replace(/\.\w+$/, "")}_film.mp4`, globalThis.filmed);
    notice("");
  } catch (error) {
    notice(error.message, true);
  } finally {
    filming.on = false;
    navigation.change(before.state);
    seek(before.frame);
  }
}

async function showFrame(frame) {
  seek(frame);
  do {
    while (waiting || !buffer.map[frame]) await new Promise((done) => setTimeout(done, 5));
    const told = new Promise((done) => { filming.told = done; });
    ask();
    await told;
  } while (player.shown !== frame && buffer.map[frame] === HERE && !filming.stopped);
  filming.told = null;
}

function savePicture() {
  drawPicture();
  const name = `${scene.name.replace(/\.\w+$/, "")}_${String(player.shown).padStart(6, "0")}.png`;
  canvas.toBlob((blob) => save(name, blob));
}

function save(name, blob) {
  const link = Object.assign(document.createElement("a"), { download: name, href: URL.createObjectURL(blob) });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

function toggleCameras() {
  look.lines = !look.lines;
  press("show-cameras", look.lines);
  dirty = true;
}

function cycleCamera(step) {
  const { cameras } = scene;
  if (!cameras.length) return;
  const now = cameras.findIndex(({ name }) => name === navigation.exact);
  navigation.lookFrom(cameras[(now + step + cameras.length) % cameras.length]);
}

function depthUnder(event) { // with the pixel of the canvas
  const density = canvas.width / canvas.clientWidth;
  const [x, y] = [event.clientX * density, event.clientY * density];
  const depth = splats.depthAt(navigation.view(), look, Math.floor(x), Math.floor(y));
  return depth === null ? null : [x, y, depth];
}

function pointUnder(event) { // world; null where nothing is
  const found = depthUnder(event);
  return found && navigation.pointAt(...found);
}

function focusAt(event) {
  const found = depthUnder(event);
  if (found && !ruler.on) navigation.focus(...found);
}

const KEYS = {
  " ": () => setPlaying(!player.playing),
  ArrowLeft: (event) => { pause(); seek(player.frame - (event.shiftKey ? 10 : 1)); },
  ArrowRight: (event) => { pause(); seek(player.frame + (event.shiftKey ? 10 : 1)); },
  Home: () => seek(0),
  End: () => seek(frameCount - 1),
  1: () => setMode("colour"),
  2: () => setMode("depth"),
  3: () => setMode("dynamic"),
  4: () => setMode("opacity"),
  5: () => setMode("map"),
  6: () => setMode("layer"),
  b: () => { if (scene.sh_degree) cycleBands(); },
  i: () => at("stats").toggleAttribute("hidden"),
  m: () => setMeasuring(!ruler.on),
  n: () => setSound(!sound.on),
  k: addView,
  Backspace: takeBack,
  j: savePath,
  g: film,
  p: savePicture,
  t: () => setTruth(cycle(TRUTHS, truth.mode)),
  u: linkHere,
  v: () => setFolded(!document.body.classList.contains("folded")),
  x: () => { if (scene.worst !== undefined) { pause(); seek(scene.worst); } },
  Escape: () => { filming.stopped = true; dismiss(); setMeasuring(false); },
  f: () => setFlying(!navigation.flying),
  r: () => navigation.reset(),
  c: toggleCameras,
  l: cycleEnds,
  h: () => document.body.classList.toggle("bare"),
  "[": () => cycleCamera(-1),
  "]": () => cycleCamera(1),
  "-": () => setScale(look.scale - 0.05),
  "+": () => setScale(look.scale + 0.05),
  "=": () => setScale(look.scale + 0.05),
  "?": () => at("help").showModal(),
};

function listen() {
  addEventListener("keydown", (event) => {
    const action = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    const typing = event.target.closest?.("select, dialog, label") || event.ctrlKey || event.metaKey || event.altKey;
    if (!action || typing || !scene) return;
    event.preventDefault();
    action(event);
  });
  document.addEventListener("visibilitychange", () => sound.voice.pause()); // ticks end where nobody looks
  canvas.addEventListener("dblclick", focusAt);
  let pressed = null;
  canvas.addEventListener("pointerdown", (event) => { pressed = event; });
  canvas.addEventListener("click", (event) => { // what was dragged turns the view
    const still = pressed && Math.hypot(event.clientX - pressed.clientX, event.clientY - pressed.clientY) < 4;
    if (ruler.on && still && scene) measureAt(event);
  });
  canvas.addEventListener("webglcontextlost", () => notice("The graphics driver gave up this page; reload it.", true));
  addEventListener("resize", () => { if (scene) drawMarks(); });
  for (const mode of MODES) at(`mode-${mode}`).onclick = () => setMode(mode);
  at("orbit").onclick = () => setFlying(false);
  at("fly").onclick = () => setFlying(true);
  at("reset").onclick = () => navigation.reset();
  at("scale").oninput = (event) => setScale(Number(event.target.value));
  at("near").oninput = (event) => setNear(Number(event.target.value));
  at("background").onchange = setBackground;
  at("show-cameras").onclick = toggleCameras;
  at("play").onclick = () => setPlaying(!player.playing);
  at("ends").onclick = cycleEnds;
  at("back").onclick = () => KEYS.ArrowLeft({});
  at("forth").onclick = () => KEYS.ArrowRight({});
  at("bands").onchange = (event) => setBands(Number(event.target.value));
  at("compare").onchange = (event) => setTruth(event.target.value);
  at("share").oninput = (event) => { at("share-value").textContent = Number(event.target.value).toFixed(2); dirty = true; };
  at("path-add").onclick = addView;
  at("path-save").onclick = savePath;
  at("path-film").onclick = film;
  at("measure").onclick = KEYS.m;
  at("sound").onclick = KEYS.n;
  at("link").onclick = linkHere;
  at("shot").onclick = savePicture;
  at("dismiss").onclick = dismiss;
  at("speed").onchange = (event) => { player.speed = Number(event.target.value); };
  at("scrub").oninput = (event) => { scrubbing = true; seek(Number(event.target.value)); };
  at("scrub").onchange = () => { scrubbing = false; };
  at("ask").onclick = () => at("help").showModal();
  at("more").onclick = KEYS.v;
}

try {
  splats = new SplatView(canvas);
  setBackground();
  listen();
  setFolded(matchMedia("(max-width: 640px), (max-height: 480px)").matches);
  worker.postMessage({ type: "open" });
} catch (error) {
  notice(error.message, true);
}
