// For a scene in a folder of static files (`packuv web`), put before worker.js: what the worker fetches lies in few large
// files, deflated; index.json says where. Parts are fetched by HTTP range; a server that knows no ranges sends the whole
// file, of which the last few are kept. docs/viewer.md describes the folder.
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
    const place = (await index).bodies[path];
    if (!place) return plain(path, options);
    try {
      const bytes = await part(place, options.signal);
      return await inflated(bytes, path);
    } catch (error) {
      if (!error.status) throw error;
      return new Response(error.message, { status: error.status });
    }
  };

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
