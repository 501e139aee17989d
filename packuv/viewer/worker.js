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
const SPAN = 8; // frames from one that is predicted from the key alone to the next
const NO_REFERENCE = 2 ** 32 - 1;
const OPACITY = 6, COLOURS = 7, REST = 10; // columns: opacity, the first colour, the first that depends on the view
const ROW_BEFORE = 1, GREEN = 2; // what was taken from a plane

let scene = null;
let tables = null; // Float32Array: positions [3, 65536], then attributes [A, 256]
let layers = 1; // 16-byte texels per Gaussian
let owners = []; // segment of every frame
const keys = new Map(); // segment -> {key, whole: Promise of the key}
const frames = new Map(); // frame -> {segment, packed, bytes}
const fetching = new Map(); // frame -> {control: AbortController, arrival: Promise}
const lost = new Set(); // frames that are damaged or missing; the rest plays on without them
let playhead = { frame: 0, step: 1, ends: "loop" };
let failures = 0;
let resumeAt = 0; // no fetch before this time after a failure
let sent = { segment: -1, frame: -1, version: 0 }; // what the page holds; of a key that is not whole, frame is -1
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
  let time = 0;
  scene.times_ns = [0, ...scene.steps_ns.map((step) => (time += step))];
  tables = tablesOf(scene.tables);
  layers = Math.ceil((6 + scene.columns) / 16);
  scene.segments.forEach(({ length }, number) => { for (let k = 0; k < length; k++) owners.push(number); });
  postMessage({ type: "scene", scene, tables, layers });
  prefetch();
}

// Where something lies; of what grows, in the state that this page knows.
function addressOf(path) { return scene?.made === undefined ? path : `${path}?made=${scene.made}`; }
// Products and sums alone, which are the same everywhere to the last bit; what they miss is told.
function tablesOf({ unit, growth, except, low, step }) {
  const values = new Float32Array(3 * 65536 + 256 * low.length);
  growth.forEach((half, axis) => {
    const grown = half * half, middle = 65536 * axis + 32768;
    for (let k = 0, power = half; k < 32768; k++, power *= grown) {
      const away = unit * (power - 1);
      values[middle + k] = scene.centre[axis] + away;
      values[middle - 1 - k] = scene.centre[axis] - away;
    }
  });
  for (const [axis, code, value] of except) values[65536 * axis + code] = value;
  for (let column = 0, at = 3 * 65536; column < low.length; column++) {
    for (let code = 0; code < 256; code++) values[at++] = low[column] + code * step[column];
  }
  return values;
}

async function get(path, signal) {
  const answer = await fetch(addressOf(path), { signal });
  if (answer.ok) return answer;
  const text = (await answer.text()).trim() || `${path}: ${answer.status}`;
  throw NEVER.has(answer.status) ? new LostError(text) : new Error(text);
}

async function bytesOf(path, signal) {
  const bytes = await (await get(path, signal)).arrayBuffer();
  tally(path);
  return bytes;
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

// Frames from which one is predicted; none of the key of its segment.
function parentsOf(frame) {
  const { first, length } = scene.segments[owners[frame]], offset = frame - first;
  let low = offset - (offset % SPAN), high = Math.min(low + SPAN, length - 1);
  if (offset === low || offset === high) return offset ? [first] : [];
  for (let middle; (middle = (low + high) >> 1) !== offset;) [low, high] = offset < middle ? [low, middle] : [middle, high];
  return [first + low, first + high];
}

// What is coming up, each frame after those from which it is predicted; if what is to be shown now has not arrived, no
// more than that.
function needed() {
  const list = new Set(), { frame: now } = playhead;
  const add = (frame) => {
    if (list.has(frame)) return;
    if (!frames.has(frame)) parentsOf(frame).forEach(add);
    list.add(frame);
  };
  (frames.has(now) || lost.has(now) ? upcoming() : [now]).forEach(add);
  return list;
}

function prefetch() {
  if (!scene) return;
  const wanted = needed();
  for (const [frame, { control }] of fetching) {
    if (wanted.has(frame)) continue;
    control.abort();
    fetching.delete(frame);
  }
  forgetKeys(wanted);
  if (performance.now() < resumeAt) return;
  for (const frame of wanted) {
    if (fetching.size >= FETCHES) break;
    if (!frames.has(frame) && !fetching.has(frame) && !lost.has(frame)) load(frame);
  }
}

async function load(frame) {
  const control = new AbortController(), arrival = arrive(frame, control.signal);
  fetching.set(frame, { control, arrival });
  try {
    keep(frame, await arrival);
    if (failures) postMessage({ type: "problem", text: "" });
    failures = 0;
  } catch (error) {
    if (error instanceof LostError) lose([frame], error);
    else if (!control.signal.aborted) fail(error);
  } finally {
    if (fetching.get(frame)?.control === control) fetching.delete(frame);
    prefetch();
  }
}

async function arrive(frame, signal) {
  const key = await keyOf(owners[frame]), parents = parentsOf(frame);
  signal.throwIfAborted();
  if (!parents.length) return keyFrame(key);
  const bytes = await bytesOf(`frames/${frame}.bin`, signal);
  const [, , , from] = new Uint32Array(bytes, 0, 4); // how many: one is the key, where a parent cannot be read
  const known = from === 1 ? [keyFrame(key)] : await Promise.all(parents.map(arrived));
  const started = performance.now(), entry = unpackFrame(bytes, key, known);
  traffic.unpack_ms = performance.now() - started;
  return entry;
}

async function arrived(frame) {
  if (lost.has(frame)) throw new LostError(`frame ${frame}, from which others are predicted, is lost`);
  const entry = frames.get(frame) ?? (await fetching.get(frame)?.arrival);
  if (!entry) throw new Error(`frame ${frame}, from which others are predicted, is gone`);
  return entry;
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
  const near = needed();
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

// The whole key of a segment. It is told to the page as its parts arrive; those that have arrived stay.
function keyOf(segment) {
  const entry = keys.get(segment) ?? { key: null, whole: null, control: null };
  keys.delete(segment);
  keys.set(segment, entry); // youngest last
  if (!entry.whole) begin(entry, segment);
  return entry.whole;
}

function begin(entry, segment) {
  entry.control = new AbortController();
  const whole = entry.whole = complete(entry, segment, entry.control.signal).catch((error) => {
    const { first, length } = scene.segments[segment];
    if (error instanceof LostError) lose(Array.from({ length }, (_, k) => first + k), error);
    else if (entry.whole === whole) entry.whole = null;
    throw error;
  });
}

function forgetKeys(wanted) {
  const needed = new Set();
  const need = (segment) => {
    if (needed.has(segment)) return;
    needed.add(segment);
    const reference = keys.get(segment)?.key?.reference ?? null;
    if (reference !== null) need(reference);
  };
  for (const frame of wanted) need(owners[frame]);
  need(sent.segment);
  for (const [old, entry] of [...keys]) {
    if (needed.has(old)) continue;
    if (!entry.key?.base && entry.whole) { entry.control.abort(); entry.whole = null; } // its parts stay
    if (keys.size > KEPT_KEYS) keys.delete(old);
  }
}

async function complete(entry, segment, signal) {
  const part = (number) => bytesOf(`segments/${segment}/${number}.bin`, signal);
  const key = entry.key ?? (entry.key = beginKey(await part(0), segment));
  grow(key);
  if (key.reference !== null && !key.taken) {
    takeRows(key, await keyOf(key.reference));
    grow(key);
  }
  for (let number = key.arrived; number < key.parts; number++) {
    fillPart(key, number, await part(number));
    key.arrived = number + 1;
    grow(key);
  }
  key.base = keyFrame(key);
  return key;
}

function grow(key) {
  key.version++;
  postMessage({ type: "part", segment: key.segment });
}

// Layers of the UV map, by slot, of the segment that the page shows.
async function tellLayers() {
  const { segment } = sent;
  if (segment < 0) return;
  const [key, body] = await Promise.all([keyOf(segment), bytesOf(`layers/${segment}.bin`)]);
  const layers = new Uint8Array(key.slotCount), rows = new Uint8Array(body);
  layers.set(rows.subarray(0, key.moving));
  layers.set(rows.subarray(key.moving), WIDTH * key.rows);
  postMessage({ type: "layers", segment, layers }, [layers.buffer]);
}

// ---- unpacking: Gaussians go into slots, the dynamic ones first, so that a frame is one upload

// Columns of `count` rows from a body: positions, if there are any, and attributes, without their filters.
function readColumns(bytes, offset, count, columns, { positions = true, colours = COLOURS } = {}) {
  const axes = positions ? 3 : 0, filters = new Uint8Array(bytes, offset, axes + columns);
  let at = offset + axes + columns;
  const plane = () => new Uint8Array(bytes, (at += count) - count, count);
  const xyz = Array.from({ length: axes }, (_, axis) => unfold(plane(), plane(), filters[axis] & ROW_BEFORE));
  const attributes = Array.from({ length: columns }, plane);
  attributes.forEach((values, column) => {
    if (filters[axes + column] & ROW_BEFORE) for (let row = 1; row < count; row++) values[row] += values[row - 1];
  });
  attributes.forEach((values, column) => {
    if (!(filters[axes + column] & GREEN)) return;
    const green = attributes[column - ((column - colours) % 3) + 1];
    for (let row = 0; row < count; row++) values[row] += green[row];
  });
  return { xyz, attributes };
}

function unfold(high, low, differences) {
  const values = new Uint16Array(high.length);
  for (let row = 0, last = 0; row < values.length; row++) {
    const folded = (high[row] << 8) | low[row], value = (folded >> 1) ^ -(folded & 1);
    values[row] = last = differences ? last + value : value;
  }
  return values;
}

// Of a key that has just begun, what is not there yet is absent: opacity code 0.
function beginKey(bytes, segment) {
  const [count, moving, columns, reference, known, partRows, parts] = new Uint32Array(bytes, 0, 8);
  const fates = new Uint8Array(bytes, 32, known);
  const rows = Math.ceil(moving / WIDTH);
  const slotCount = WIDTH * (rows + Math.ceil((count - moving) / WIDTH));
  const packed = new ArrayBuffer(16 * layers * slotCount);
  const [x, y, z] = [0, 1, 2].map(() => new Float32Array(slotCount));
  const taken = [1, 2].map((fate) => fates.reduce((sum, value) => sum + (value === fate), 0)); // still, moving
  const key = {
    segment, count, moving, rows, slotCount, packed, x, y, z, alive: new Uint8Array(slotCount), fates, partRows, parts,
    reference: reference === NO_REFERENCE ? null : reference, taken: false, arrived: 1, version: 0, base: null,
    bands: 1, own: { moving: taken[1], still: WIDTH * rows + taken[0], stillEnd: WIDTH * rows + count - moving },
  };
  key.turns = turnsOf(key);
  const [start, end] = key.turns[0];
  fill(key, start, readColumns(bytes, 32 + known, end - start, REST));
  return key;
}

// Slots of the rows that each part brings, bands aside: those that move, at least one part, and those that stand still.
function turnsOf({ own, moving, partRows }) {
  const cut = (start, end) => Array.from({ length: Math.ceil((end - start) / partRows) },
    (_, k) => [start + k * partRows, Math.min(start + (k + 1) * partRows, end)]);
  const movers = cut(own.moving, moving);
  return [...(movers.length ? movers : [[moving, moving]]), ...cut(own.still, own.stillEnd)];
}

function takeRows(key, from) {
  const { fates } = key;
  let moving = 0, still = WIDTH * key.rows;
  const texels = new Uint32Array(key.packed), others = new Uint32Array(from.packed);
  for (let row = 0; row < fates.length; row++) {
    if (!fates[row]) continue;
    const slot = fates[row] === 2 ? moving++ : still++, other = row < from.moving ? row : WIDTH * from.rows + row - from.moving;
    for (let layer = 0; layer < layers; layer++) {
      const to = 4 * (layer * key.slotCount + slot), at = 4 * (layer * from.slotCount + other);
      for (let word = 0; word < 4; word++) texels[to + word] = others[at + word];
    }
  }
  decode(key, key.packed, key.slotCount, 0, moving);
  decode(key, key.packed, key.slotCount, WIDTH * key.rows, still);
  key.taken = true;
}

function fillPart(key, number, bytes) {
  if (number >= key.turns.length) return fillBand(key, number - key.turns.length + 1, bytes);
  const [start, end] = key.turns[number];
  fill(key, start, readColumns(bytes, 0, end - start, REST));
}

function fillBand(key, band, bytes) {
  const { own, moving } = key, first = REST + 3 * (band ** 2 - 1), columns = 3 * (2 * band + 1);
  const movers = moving - own.moving, stills = own.stillEnd - own.still;
  const { attributes } = readColumns(bytes, 0, movers + stills, columns, { positions: false, colours: 0 });
  const octets = new Uint8Array(key.packed);
  attributes.forEach((values, column) => {
    const at = place(first + column, key.slotCount);
    for (let row = 0; row < movers; row++) octets[at + 16 * (own.moving + row)] = values[row];
    for (let row = 0; row < stills; row++) octets[at + 16 * (own.still + row)] = values[movers + row];
  });
  key.bands |= 1 << band;
}

// Puts rows into slots from `start` on.
function fill(key, start, { xyz, attributes }) {
  const shorts = new Uint16Array(key.packed), octets = new Uint8Array(key.packed), count = attributes[0].length;
  xyz.forEach((values, axis) => {
    for (let row = 0; row < count; row++) shorts[8 * (start + row) + axis] = values[row];
  });
  attributes.forEach((values, column) => {
    const at = place(column, key.slotCount);
    for (let row = 0; row < count; row++) octets[at + 16 * (start + row)] = values[row];
  });
  decode(key, key.packed, key.slotCount, start, start + count);
}

// The moving rows of a key, laid out as those of a frame.
function keyFrame(key) {
  if (key.base) return key.base;
  const size = 16 * WIDTH * key.rows, packed = new Uint8Array(size * layers);
  for (let layer = 0; layer < layers; layer++) {
    packed.set(new Uint8Array(key.packed, 16 * layer * key.slotCount, size), layer * size);
  }
  return { segment: key.segment, packed: packed.buffer, bytes: packed.byteLength };
}

// What a frame's parents foretell, and what they do not; both wrap as the codes do.
function unpackFrame(bytes, key, [before, after]) {
  const [segment, moving, columns] = new Uint32Array(bytes, 0, 3);
  if (segment !== key.segment || moving !== key.moving) throw new Error("the scene changed on disk; reload the page");
  const { xyz, attributes } = readColumns(bytes, 16, moving, columns);
  const slotCount = WIDTH * key.rows, packed = before.packed.slice(0);
  const shorts = new Uint16Array(packed), octets = new Uint8Array(packed);
  const nextShorts = after && new Uint16Array(after.packed), nextOctets = after && new Uint8Array(after.packed);
  for (let start = 0; start < moving; start += WIDTH) { // a texture row at a time stays in the processor's cache
    const end = Math.min(start + WIDTH, moving);
    xyz.forEach((values, axis) => addPositions(shorts, nextShorts, axis, values, start, end));
    attributes.forEach((values, column) => {
      addAttributes(octets, nextOctets, place(column, slotCount), values, start, end);
    });
  }
  return { segment, packed, bytes: packed.byteLength };
}

function addPositions(shorts, next, axis, values, start, end) {
  for (let row = start, at = 8 * start + axis; row < end; row++, at += 8) {
    const way = next ? ((((next[at] - shorts[at]) << 16) >> 16) + 1) >> 1 : 0;
    shorts[at] += way + values[row];
  }
}

function addAttributes(octets, next, first, values, start, end) {
  for (let row = start, at = first + 16 * start; row < end; row++, at += 16) {
    octets[at] = (next ? (octets[at] + next[at] + 1) >> 1 : octets[at]) + values[row];
  }
}

// First byte of a column: a Gaussian has 6 bytes of position and one per column, 16 to a layer.
function place(column, slotCount) {
  const byte = 6 + column;
  return 16 * slotCount * (byte >> 4) + (byte & 15);
}

// World positions of slots from `start` to `end`, for the sort. Opacity code 0 marks an absent Gaussian.
function decode(key, packed, slotCount, start, end) {
  const shorts = new Uint16Array(packed), octets = new Uint8Array(packed), opacity = place(OPACITY, slotCount);
  for (let slot = start; slot < end; slot++) {
    key.x[slot] = tables[shorts[8 * slot]];
    key.y[slot] = tables[65536 + shorts[8 * slot + 1]];
    key.z[slot] = tables[131072 + shorts[8 * slot + 2]];
    key.alive[slot] = octets[opacity + 16 * slot] > 0 ? 1 : 0;
  }
}

// ---- showing

// Answers with the draw order for a view, and with the codes that the page does not hold yet. A frame that has not
// arrived leaves the one on screen; as long as there is none, what has arrived of the key of its segment is shown.
async function show({ frame, eye, forward, near, spare }) {
  let entry = frames.get(frame);
  if (!entry && sent.frame < 0) return showPart(keys.get(owners[frame])?.key, { eye, forward, near, spare });
  if (!entry) { frame = sent.frame; entry = frames.get(frame); }
  const segment = entry ? entry.segment : sent.segment;
  const key = await keyOf(segment);
  const codes = [];
  if (segment !== sent.segment || key.version !== sent.version) codes.push(keyCodes(key));
  if (entry && (codes.length || frame !== sent.frame)) {
    decode(key, entry.packed, WIDTH * key.rows, 0, key.moving);
    codes.push({ frame_codes: { packed: entry.packed.slice(0), rows: key.rows } });
  }
  sent = { segment, frame, version: key.version };
  answer(key, Object.assign({ frame }, ...codes), { eye, forward, near, spare });
}

function showPart(key, view) {
  if (!key) return postMessage({ type: "miss" });
  const codes = key.segment !== sent.segment || key.version !== sent.version ? keyCodes(key) : {};
  sent = { segment: key.segment, frame: -1, version: key.version };
  answer(key, { ...codes, frame: -1 }, view);
}

function keyCodes(key) { return { key: { packed: key.packed.slice(0), slotCount: key.slotCount } }; }

function answer(key, told, { eye, forward, near, spare }) {
  const { segment, count, moving, bands } = key, started = performance.now();
  const picture = { type: "picture", segment, count, moving, bands, ...told, ...order(key, eye, forward, near, spare) };
  picture.sort_ms = performance.now() - started;
  picture.traffic = { ...traffic };
  const codes = [told.key, told.frame_codes].filter(Boolean).map(({ packed }) => packed);
  postMessage(picture, [...codes, picture.order.buffer]);
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
