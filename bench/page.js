// CPU time of the viewer's worker in V8, for bench/page.py: node page.js WORKER FOLDER, with a scene's bodies inflated.
"use strict";
const fs = require("fs"), path = require("path"), vm = require("vm"), zlib = require("zlib");

const RUNS = 15;
const [worker, folder] = process.argv.slice(2);
Object.assign(globalThis, { postMessage() {}, onmessage: null });
vm.runInThisContext(`${fs.readFileSync(worker, "utf8")}
globalThis.page = { beginKey, fillPart, keyFrame, unpackFrame, order, decode, WIDTH, look(told) {
  scene = told; tables = tablesOf(told.tables); layers = Math.ceil((6 + told.columns) / 16); } };`);

const inflated = (name) => {
  const bytes = zlib.inflateSync(fs.readFileSync(path.join(folder, name)));
  return bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length);
};

function median_ms(work) {
  const spent = Array.from({ length: RUNS }, () => {
    const before = process.cpuUsage();
    work();
    const { user, system } = process.cpuUsage(before);
    return (user + system) / 1000;
  });
  return spent.sort((a, b) => a - b)[RUNS >> 1];
}

page.look(JSON.parse(fs.readFileSync(path.join(folder, "scene.json"))));
const names = fs.readdirSync(folder).filter((name) => name.startsWith("part"));
let key;
const unpackKey = (parts) => {
  key = page.beginKey(parts[0], 0);
  for (let number = 1; number < parts.length; number++) page.fillPart(key, number, parts[number]);
  key.base = page.keyFrame(key);
};
const bodies = names.map((_, number) => inflated(`part${number}`));
const told = { unpack_key: median_ms(() => unpackKey(bodies.map((body) => body.slice(0)))) };
const last = page.unpackFrame(inflated("frame8"), key, [key.base]), middle = inflated("frame4");
let frame;
told.inflate_frame = median_ms(() => inflated("frame4"));
told.unpack_frame = median_ms(() => { frame = page.unpackFrame(middle.slice(0), key, [key.base, last]); });
told.positions = median_ms(() => page.decode(key, frame.packed, page.WIDTH * key.rows, 0, key.moving));
told.sort = median_ms(() => page.order(key, [0, 0, -3], [0, 0, 1], 0.05, null));
console.log(JSON.stringify(told));
