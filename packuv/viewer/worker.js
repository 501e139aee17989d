// Streams a scene and sorts it: fetches integers ahead of the playhead, packs them as the GPU reads them, orders the
// Gaussians by depth. docs/viewer.md describes the bytes.
"use strict";

const WIDTH = 1024; // slots per texture row, as in splats.js
const FETCHES = 3;
const AHEAD_SECONDS = 3;
const BUDGET_BYTES = 384 * 2 ** 20;
const KEPT_KEYS = 4;
const BINS = 65536;
const RETRY_MS = [300, 1000, 3000, 10000];
const NEVER = new Set([404, 410, 416, 422, 500]); // answers that stay: what is damaged or missing; others are tried again

let scene = null;
let tables = null; // Float32Array: positions [3, 65536], then attributes [A, 256]
let layers = 1; // 16-byte texels per Gaussian
let owners = []; // segment of every frame
const keys = new Map(); // segment -> Promise of a key
const frames = new Map(); // frame -> {segment, packed, bytes}
const fetching = new Map(); // frame -> AbortController
const lost = new Set(); // frames that are damaged or missing; the rest plays on without them
let playhead = { frame: 0, step: 1, ends: "loop" };
let failures = 0;
let resumeAt = 0; // no fetch before this time after a failure
let sent = { segment: -1, frame: -1 }; // what the page holds
const counts = new Uint32Array(BINS + 1);
const depths = { values: new Float32Array(0), bits: null, slots: null, bins: null }; // room for the sort

onmessage = (event) => {
  const message = event.data;
  if (message.type === "open") open().catch(complain);
  if (message.type === "show") show(message).catch((error) => { complain(error); postMessage({ type: "miss" }); });
  if (message.type === "layers") tellLayers().catch(complain);
  if (message.type === "playhead") { playhead = message; prefetch(); }
};

function complain(error) { postMessage({ type: "problem", text: String(error.message ?? error) }); }

async function open() {
  scene = await (await get("scene.json")).json();
  tables = new Float32Array(await (await get("tables.bin")).arrayBuffer());
  layers = Math.ceil((6 + scene.columns) / 16);
  scene.segments.forEach(({ length }, number) => owners.push(...new Array(length).fill(number)));
  postMessage({ type: "scene", scene, tables, layers });
  prefetch();
}

// Where something lies; of what grows, in the state that this page knows.
function addressOf(path) { return scene?.made === undefined ? path : `${path}?made=${scene.made}`; }

async function get(path, signal) {
  const answer = await fetch(addressOf(path), { signal });
  if (answer.ok) return answer;
  const text = (await answer.text()).trim() || `${path}: ${answer.status}`;
  throw NEVER.has(answer.status) ? new LostError(text) : new Error(text);
}

class LostError extends Error {}

// ---- fetching

const traffic = { bytes: 0, decode_ms: 0, unpack_ms: 0 }; // since the page was opened; of the last frame

// What a body took on its way, by the browser's own record, and the server by its word.
function tally(path) {
  const record = performance.getEntriesByName(new URL(addressOf(path), location.href).href).at(-1);
  traffic.bytes += record?.transferSize ?? 0;
  traffic.decode_ms = record?.serverTiming?.find(({ name }) => name === "decode")?.duration ?? 0;
  performance.clearResourceTimings();
}

function ahead() {
  const frame = frames.values().next().value;
  const affordable = frame ? Math.floor((0.75 * BUDGET_BYTES) / Math.max(1, frame.bytes)) : 8;
  const wanted = Math.ceil((AHEAD_SECONDS * scene.rate[0]) / scene.rate[1]);
  return Math.max(2, Math.min(wanted, affordable, owners.length));
}

function upcoming() {
  const list = [], count = owners.length;
  let { frame, step } = playhead;
  for (let left = ahead(); left > 0 && frame >= 0 && frame < count; left--) {
    list.push(frame);
    if (playhead.ends === "bounce" && (frame + step < 0 || frame + step >= count)) step = -step;
    frame += step;
    if (playhead.ends === "loop") frame %= count;
  }
  return list;
}

function prefetch() {
  if (!scene) return;
  const wanted = upcoming();
  const near = new Set(wanted);
  for (const [frame, control] of fetching) if (!near.has(frame)) control.abort();
  if (performance.now() < resumeAt) return;
  for (const frame of wanted) {
    if (fetching.size >= FETCHES) break;
    if (!frames.has(frame) && !fetching.has(frame) && !lost.has(frame)) load(frame);
  }
}

async function load(frame) {
  const control = new AbortController();
  fetching.set(frame, control);
  try {
    const path = `frames/${frame}.bin`;
    const [bytes, key] = await Promise.all([
      get(path, control.signal).then((answer) => answer.arrayBuffer()),
      keyOf(owners[frame]),
    ]);
    tally(path);
    const started = performance.now();
    if (!control.signal.aborted) keep(frame, unpackFrame(bytes, key));
    traffic.unpack_ms = performance.now() - started;
    if (failures) postMessage({ type: "problem", text: "" });
    failures = 0;
  } catch (error) {
    if (error instanceof LostError) lose([frame], error);
    else if (!control.signal.aborted) fail(error);
  } finally {
    fetching.delete(frame);
    prefetch();
  }
}

function fail(error) {
  const pause = RETRY_MS[Math.min(failures++, RETRY_MS.length - 1)];
  resumeAt = performance.now() + pause;
  setTimeout(prefetch, pause + 1);
  const unreachable = error instanceof TypeError; // so fetch reports a connection that failed
  postMessage({ type: "problem", text: unreachable ? "The server does not answer; trying again." : error.message });
}

function lose(gone, error) {
  for (const frame of gone) lost.add(frame);
  postMessage({ type: "lost", count: lost.size, text: error.message });
  reportBuffer();
}

function keep(frame, entry) {
  frames.set(frame, entry);
  let bytes = 0;
  for (const kept of frames.values()) bytes += kept.bytes;
  const near = new Set(upcoming());
  for (const [old, kept] of frames) { // in order of arrival
    if (bytes <= BUDGET_BYTES) break;
    if (near.has(old)) continue;
    frames.delete(old);
    bytes -= kept.bytes;
  }
  reportBuffer();
}

function reportBuffer() {
  const map = new Uint8Array(owners.length);
  for (const frame of frames.keys()) map[frame] = 1;
  for (const frame of lost) map[frame] = 2;
  postMessage({ type: "buffered", map, ahead: ahead() }, [map.buffer]);
}

function keyOf(segment) {
  const known = keys.get(segment);
  if (known) { keys.delete(segment); keys.set(segment, known); return known; } // youngest last
  const path = `segments/${segment}.bin`;
  const bytes = get(path).then((answer) => answer.arrayBuffer()).finally(() => tally(path));
  const promise = bytes.then((body) => unpackKey(body, segment));
  promise.catch((error) => {
    keys.delete(segment);
    if (error instanceof LostError) lose([...owners.keys()].filter((frame) => owners[frame] === segment), error);
  });
  keys.set(segment, promise);
  const needed = new Set([...upcoming().map((frame) => owners[frame]), sent.segment]);
  for (const old of [...keys.keys()]) if (keys.size > KEPT_KEYS && !needed.has(old)) keys.delete(old);
  return promise;
}

// Layers of the UV map, by slot, of the segment that the page shows.
async function tellLayers() {
  const { segment } = sent;
  if (segment < 0) return;
  const [key, body] = await Promise.all([
    keyOf(segment), get(`layers/${segment}.bin`).then((answer) => answer.arrayBuffer()),
  ]);
  const layers = new Uint8Array(key.slotCount);
  new Uint8Array(body).forEach((layer, row) => { layers[key.slots[row]] = layer; });
  postMessage({ type: "layers", segment, layers }, [layers.buffer]);
}

// ---- unpacking: Gaussians go into slots, the dynamic ones first, so that a frame is one upload

function unpackKey(bytes, segment) {
  const [count, moving, columns] = new Uint32Array(bytes, 0, 3);
  const xyz = new Uint16Array(bytes, 16, 3 * count);
  const attributes = new Uint8Array(bytes, 16 + 6 * count, columns * count);
  const dynamic = new Uint8Array(bytes, 16 + (6 + columns) * count, count);
  const rows = Math.ceil(moving / WIDTH);
  const slotCount = WIDTH * (rows + Math.ceil((count - moving) / WIDTH));
  const slots = new Uint32Array(count);
  let first = 0, second = WIDTH * rows;
  for (let row = 0; row < count; row++) slots[row] = dynamic[row] ? first++ : second++;
  const packed = new ArrayBuffer(16 * layers * slotCount);
  const [x, y, z] = [0, 1, 2].map(() => new Float32Array(slotCount));
  const key = { segment, count, moving, rows, slotCount, slots, packed, x, y, z, alive: new Uint8Array(slotCount) };
  const shorts = new Uint16Array(packed), octets = new Uint8Array(packed);
  for (let axis = 0; axis < 3; axis++) {
    for (let row = 0; row < count; row++) shorts[8 * slots[row] + axis] = xyz[axis * count + row];
  }
  for (let column = 0; column < columns; column++) {
    const at = place(column, slotCount), from = column * count;
    for (let row = 0; row < count; row++) octets[at + 16 * slots[row]] = attributes[from + row];
  }
  decode(key, packed, slotCount, slotCount);
  return key;
}

function unpackFrame(bytes, key) {
  const [segment, moving, columns] = new Uint32Array(bytes, 0, 3);
  if (segment !== key.segment || moving !== key.moving) throw new Error("the scene changed on disk; reload the page");
  const xyz = new Uint16Array(bytes, 16, 3 * moving);
  const attributes = new Uint8Array(bytes, 16 + 6 * moving, columns * moving);
  const slotCount = WIDTH * key.rows;
  const packed = new ArrayBuffer(16 * layers * slotCount);
  const shorts = new Uint16Array(packed), octets = new Uint8Array(packed); // both wrap as the codes do
  const keyShorts = new Uint16Array(key.packed), keyOctets = new Uint8Array(key.packed);
  for (let axis = 0; axis < 3; axis++) {
    const from = axis * moving;
    for (let row = 0; row < moving; row++) shorts[8 * row + axis] = keyShorts[8 * row + axis] + xyz[from + row];
  }
  for (let column = 0; column < columns; column++) {
    const at = place(column, slotCount), keyAt = place(column, key.slotCount), from = column * moving;
    for (let row = 0; row < moving; row++) octets[at + 16 * row] = keyOctets[keyAt + 16 * row] + attributes[from + row];
  }
  return { segment, packed, bytes: packed.byteLength };
}

// First byte of a column: a Gaussian has 6 bytes of position and one per column, 16 to a layer.
function place(column, slotCount) {
  const byte = 6 + column;
  return 16 * slotCount * (byte >> 4) + (byte & 15);
}

const OPACITY = 6;

// World positions of the first `slotCount` slots, for the sort. Opacity code 0 marks an absent Gaussian.
function decode(key, packed, slotCount, used) {
  const shorts = new Uint16Array(packed), octets = new Uint8Array(packed), opacity = place(OPACITY, slotCount);
  for (let slot = 0; slot < used; slot++) {
    key.x[slot] = tables[shorts[8 * slot]];
    key.y[slot] = tables[65536 + shorts[8 * slot + 1]];
    key.z[slot] = tables[131072 + shorts[8 * slot + 2]];
    key.alive[slot] = octets[opacity + 16 * slot] > 0 ? 1 : 0;
  }
}

// ---- showing

// Answers with the draw order for a view, and with the codes that the page does not hold yet. A frame that has not
// arrived leaves the one on screen.
async function show({ frame, eye, forward, near, spare }) {
  let entry = frames.get(frame);
  if (!entry && sent.frame >= 0) { frame = sent.frame; entry = frames.get(frame); }
  const segment = entry ? entry.segment : sent.segment;
  if (segment < 0) return postMessage({ type: "miss" });
  const key = await keyOf(segment);
  const transfer = [], answer = { type: "picture", frame, segment, count: key.count, moving: key.moving };
  if (segment !== sent.segment) {
    answer.key = { packed: key.packed.slice(0), slotCount: key.slotCount };
    transfer.push(answer.key.packed);
  }
  if (entry && (segment !== sent.segment || frame !== sent.frame)) {
    decode(key, entry.packed, WIDTH * key.rows, key.moving);
    answer.frame_codes = { packed: entry.packed.slice(0), rows: key.rows };
    transfer.push(answer.frame_codes.packed);
  }
  sent = { segment, frame };
  const started = performance.now();
  Object.assign(answer, order(key, eye, forward, near, spare));
  answer.sort_ms = performance.now() - started;
  answer.traffic = { ...traffic };
  postMessage(answer, [...transfer, answer.order.buffer]);
}

// Far to near by a counting sort. The bin is the top of the float's own bits: 4096 steps per octave of depth, 16
// octaves from the near plane on, so that a distant outlier does not cost the foreground its order.
function order(key, eye, forward, near, spare) {
  const { x, y, z, alive, slotCount } = key;
  room(slotCount);
  const { values, bits, slots, bins } = depths;
  const [a, b, c] = forward, d = a * eye[0] + b * eye[1] + c * eye[2];
  values[0] = near;
  const base = bits[0] >>> 11;
  counts.fill(0);
  let visible = 0;
  for (let slot = 0; slot < slotCount; slot++) {
    const depth = a * x[slot] + b * y[slot] + c * z[slot] - d;
    if (!alive[slot] || !(depth > near)) continue;
    values[visible] = depth;
    const bin = BINS - 1 - Math.min(BINS - 1, (bits[visible] >>> 11) - base);
    bins[visible] = bin;
    slots[visible++] = slot;
    counts[bin + 1]++;
  }
  for (let bin = 0; bin < BINS; bin++) counts[bin + 1] += counts[bin];
  const range = [depthAt(0.98 * visible, base), depthAt(0.02 * visible, base)];
  const sorted = new Uint32Array(spare && spare.byteLength === 4 * slotCount ? spare : new ArrayBuffer(4 * slotCount));
  for (let index = 0; index < visible; index++) sorted[counts[bins[index]]++] = slots[index];
  return { order: sorted, visible, range };
}

// Depth that `rank` Gaussians lie beyond; reads the running sums, which the final pass of the sort destroys.
function depthAt(rank, base) {
  let low = 0, high = BINS - 1;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (counts[middle + 1] < rank) low = middle + 1;
    else high = middle;
  }
  const scratch = new Uint32Array([((BINS - 1 - low) + base) << 11]);
  return new Float32Array(scratch.buffer)[0];
}

function room(slotCount) {
  if (depths.values.length >= slotCount + 1) return;
  depths.values = new Float32Array(slotCount + 1);
  depths.bits = new Uint32Array(depths.values.buffer);
  depths.slots = new Uint32Array(slotCount + 1);
  depths.bins = new Uint16Array(slotCount + 1);
}
