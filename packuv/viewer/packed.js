// For a scene in a folder of static files (`packuv web`), put before worker.js: what the worker fetches lies in a file
// for each segment, deflated; index.json has the sizes. Parts of files are fetched by HTTP range; a server that knows no
// ranges sends the whole file, of which the last few are kept. docs/viewer.md describes the folder.
"use strict";

(() => {
  const KEPT_FILES = 3;
  const plain = self.fetch.bind(self);
  const whole = new Map(); // file -> Promise of its bytes, where the server knows no ranges
  let index = null;
  let ranges = null; // Promise of whether the server knows them

  self.fetch = async (path, options = {}) => {
    index ??= open();
    index.catch(() => { index = null; }); // the next request tries again
    const [what, number, inner = "0"] = path.replace(/\.bin$/, "").split("/");
    if (!["segments", "frames", "layers"].includes(what)) return plain(path, options);
    const place = placeOf(await index, what, Number(number), Number(inner));
    if (!place) return new Response(`${path} is not there`, { status: 404 });
    try {
      const bytes = await part(place, options.signal);
      return await inflated(bytes, path);
    } catch (error) {
      if (!error.status) throw error;
      return new Response(error.message, { status: error.status });
    }
  };

  // File, offset and size. In a file: the parts of the key, the layers, the frames after the key.
  function placeOf({ segments }, what, number, inner) {
    let segment = number, at = inner;
    if (what === "frames") {
      segment = 0;
      for (at = number; segment < segments.length && at > segments[segment].frames.length; segment++) {
        at -= segments[segment].frames.length + 1;
      }
    }
    const { file, parts, layers, frames } = segments[segment] ?? { parts: [], frames: [] };
    if (what === "layers") at = parts.length;
    if (what === "frames") at += parts.length;
    const sizes = [...parts, layers, ...frames];
    const sum = (list) => list.reduce((total, size) => total + size, 0);
    return file && at < sizes.length ? [file, sum(sizes.slice(0, at)), sizes[at]] : null;
  }

  async function inflated(bytes, path) {
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    try {
      return new Response(await new Response(stream).arrayBuffer());
    } catch {
      throw refusal(`${path} is damaged`, 422);
    }
  }

  function refusal(text, status) { return Object.assign(new Error(text), { status }); }

  async function open() {
    const answer = await plain("index.json");
    if (!answer.ok) throw new Error(`index.json: ${answer.status}`);
    return answer.json();
  }

  async function part([file, offset, size], signal) {
    ranges ??= probe(file);
    ranges.catch(() => { ranges = null; });
    if (!(await ranges)) return (await all(file)).slice(offset, offset + size);
    const answer = await plain(file, { signal, headers: { Range: `bytes=${offset}-${offset + size - 1}` } });
    if (!answer.ok) throw refusal(`${file}: ${answer.status}`, answer.status);
    const bytes = await answer.arrayBuffer();
    return answer.status === 206 ? bytes : bytes.slice(offset, offset + size);
  }

  async function probe(file) {
    const answer = await plain(file, { headers: { Range: "bytes=0-0" } });
    answer.body?.cancel();
    return answer.status === 206;
  }

  // Without the signal of the frame that asks first: others wait for the same bytes.
  function all(file) {
    if (!whole.has(file)) whole.set(file, fetched(file));
    const bytes = whole.get(file);
    whole.delete(file);
    whole.set(file, bytes); // youngest last
    for (const old of whole.keys()) if (whole.size > KEPT_FILES) whole.delete(old);
    return bytes;
  }

  async function fetched(file) {
    try {
      const answer = await plain(file);
      if (!answer.ok) throw refusal(`${file}: ${answer.status}`, answer.status);
      return await answer.arrayBuffer();
    } catch (error) {
      whole.delete(file); // the next request tries again
      throw error;
    }
  }
})();
