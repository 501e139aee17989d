// A film along a camera path, as packuv.film makes it: where the camera is at a moment, and pictures as an MP4 (H.264).

const OPTICS = ["fx", "fy", "cx", "cy"];
const BITS_PER_PIXEL = 0.2;
const KEY_SECONDS = 2; // from one picture that stands alone to the next
const LEVELS = [["avc1.640028", 2 ** 21], ["avc1.640033", 9 * 2 ** 20]]; // high profile, pixels up to which

const rowsOf = (matrix) => matrix.slice(0, 3).map((row) => row.slice(0, 3));
const times = (a, b) => a.map((row) => b[0].map((_, k) => row.reduce((sum, value, i) => sum + value * b[i][k], 0)));
const transposed = (a) => a.map((_, k) => a.map((row) => row[k]));
const eyeOf = (pose) => [0, 1, 2].map((k) => -[0, 1, 2].reduce((sum, i) => sum + pose[i][k] * pose[i][3], 0));

// Frame of the scene and camera at a moment of a path; before and after it, of its ends.
export function momentOf(views, seconds) {
  let place = 0;
  while (place + 2 < views.length && views[place + 1].seconds <= seconds) place++;
  const next = Math.min(place + 1, views.length - 1), [before, after] = [views[place], views[next]];
  const span = after.seconds - before.seconds, share = Math.min(1, Math.max(0, (seconds - before.seconds) / (span || 1)));
  const axes = turned(rowsOf(before.camera.camera_from_world), rowsOf(after.camera.camera_from_world), share);
  const eye = eyeAt(views, place, next, share);
  const pose = axes.map((axis) => [...axis, -axis.reduce((sum, value, k) => sum + value * eye[k], 0)]);
  const { width, height } = before.camera, other = fitted(after.camera, width, height);
  const optics = Object.fromEntries(OPTICS.map((name) =>
    [name, before.camera[name] + share * (other[name] - before.camera[name])]));
  const frame = Math.round(before.frame + share * (after.frame - before.frame));
  return { frame, camera: { width, height, ...optics, camera_from_world: [...pose, [0, 0, 0, 1]] } };
}

// On a cubic through all eyes: as fast at a view as the line from the one before to the one after it.
function eyeAt(views, place, next, s) {
  const eyes = views.map(({ camera }) => eyeOf(camera.camera_from_world)), span = views[next].seconds - views[place].seconds;
  const speed = (index, k) => {
    const low = Math.max(index - 1, 0), high = Math.min(index + 1, views.length - 1);
    return ((eyes[high][k] - eyes[low][k]) / (views[high].seconds - views[low].seconds || 1)) * span;
  };
  return [0, 1, 2].map((k) => (2 * s ** 3 - 3 * s ** 2 + 1) * eyes[place][k] + (s ** 3 - 2 * s ** 2 + s) * speed(place, k)
    + (3 * s ** 2 - 2 * s ** 3) * eyes[next][k] + (s ** 3 - s ** 2) * speed(next, k));
}

// The rotation a share of the way from one to another, about one axis.
function turned(a, b, share) {
  const between = times(b, transposed(a)), trace = between[0][0] + between[1][1] + between[2][2];
  const angle = Math.acos(Math.min(1, Math.max(-1, (trace - 1) / 2)));
  if (angle < 1e-9) return a;
  const axis = [[2, 1], [0, 2], [1, 0]].map(([i, j]) => (between[i][j] - between[j][i]) / (2 * Math.sin(angle)));
  const [x, y, z] = axis, c = Math.cos(share * angle), s = Math.sin(share * angle), d = 1 - c;
  return times([
    [c + x * x * d, x * y * d - z * s, x * z * d + y * s],
    [y * x * d + z * s, c + y * y * d, y * z * d - x * s],
    [z * x * d - y * s, z * y * d + x * s, c + z * z * d],
  ], a);
}

function fitted(camera, width, height) { // the whole of its picture, in the middle
  const s = Math.min(width / camera.width, height / camera.height);
  const [left, top] = [(width - s * camera.width) / 2, (height - s * camera.height) / 2];
  return { fx: s * camera.fx, fy: s * camera.fy, cx: s * camera.cx + left, cy: s * camera.cy + top };
}

// Codes pictures of a canvas, one after the other, into an MP4. `rate` is [numerator, denominator], pictures a second.
export class Recorder {
  static async open(width, height, rate) {
    if (!globalThis.VideoEncoder) {
      throw new Error("This browser codes no video here (it may on https or localhost): save the path, packuv film draws it.");
    }
    const [codec] = LEVELS.find(([, pixels]) => width * height <= pixels) ?? LEVELS.at(-1), perSecond = rate[0] / rate[1];
    const settings = {
      codec, width, height, framerate: perSecond, bitrate: Math.round(width * height * perSecond * BITS_PER_PIXEL),
      latencyMode: "realtime", avc: { format: "avc" }, // no picture comes out before an earlier one
    };
    const { supported } = await VideoEncoder.isConfigSupported(settings);
    if (!supported) throw new Error("This browser does not code H.264: save the path, packuv film draws it.");
    return new Recorder(settings, rate);
  }

  constructor(settings, rate) {
    Object.assign(this, { settings, rate, chunks: [], described: null, count: 0, failure: null });
    this.encoder = new VideoEncoder({
      output: (chunk, { decoderConfig }) => {
        this.described ??= decoderConfig;
        const data = new Uint8Array(chunk.byteLength);
        chunk.copyTo(data);
        this.chunks.push({ data, isKey: chunk.type === "key" });
      },
      error: (error) => { this.failure = error; },
    });
    this.encoder.configure(settings);
  }

  async add(canvas) {
    const [numerator, denominator] = this.rate, timestamp = Math.round((this.count * 1e6 * denominator) / numerator);
    const picture = new VideoFrame(canvas, { timestamp });
    const keyFrame = this.count % Math.max(1, Math.round((KEY_SECONDS * numerator) / denominator)) === 0;
    this.encoder.encode(picture, { keyFrame });
    picture.close();
    this.count++;
    while (this.encoder.encodeQueueSize > 4) await new Promise((done) => setTimeout(done, 5));
    if (this.failure) throw this.failure;
  }

  async finish() { // the file
    await this.encoder.flush();
    this.encoder.close();
    if (this.failure) throw this.failure;
    return new Blob([mp4(this.chunks, this.described, this.settings, this.rate)], { type: "video/mp4" });
  }
}

// ---- ISO base media file format (ISO/IEC 14496-12, 14496-15)

const text = (letters) => [...letters].map((letter) => letter.charCodeAt(0));
const u16 = (...values) => values.flatMap((value) => [value >> 8 & 255, value & 255]);
const u32 = (...values) => values.flatMap((value) => [value >>> 24, value >> 16 & 255, value >> 8 & 255, value & 255]);
const zeros = (count) => new Array(count).fill(0);
const UNTURNED = u32(65536, 0, 0, 0, 65536, 0, 0, 0, 0x40000000);

function box(name, ...parts) {
  const size = parts.reduce((sum, part) => sum + part.length, 8), bytes = new Uint8Array(size);
  bytes.set([...u32(size), ...text(name)]);
  let at = 8;
  for (const part of parts) { bytes.set(part, at); at += part.length; }
  return bytes;
}

function mp4(chunks, described, { width, height }, [scale, step]) {
  const kind = box("ftyp", text("isom"), u32(512), text("isomiso2avc1mp41"));
  const data = box("mdat", ...chunks.map((chunk) => chunk.data));
  const length = step * chunks.length, sizes = chunks.map((chunk) => chunk.data.length);
  const keys = chunks.flatMap(({ isKey }, number) => (isKey ? [number + 1] : []));
  const entry = box("avc1", zeros(6), u16(1), zeros(16), u16(width, height), u32(0x480000, 0x480000, 0), u16(1), zeros(32),
    u16(24, 65535), box("avcC", new Uint8Array(described.description)), colour(described.colorSpace));
  const table = box("stbl", box("stsd", u32(0, 1), entry), box("stts", u32(0, 1, chunks.length, step)),
    box("stss", u32(0, keys.length, ...keys)), box("stsc", u32(0, 1, 1, chunks.length, 1)),
    box("stsz", u32(0, 0, sizes.length, ...sizes)), box("stco", u32(0, 1, kind.length + 8)));
  const media = box("mdia", box("mdhd", u32(0, 0, 0, scale, length), u16(0x55c4, 0)),
    box("hdlr", u32(0, 0), text("vide"), zeros(12), text("PackUV\0")),
    box("minf", box("vmhd", u32(1), zeros(8)), box("dinf", box("dref", u32(0, 1), box("url ", u32(1)))), table));
  const track = box("trak", box("tkhd", u32(3, 0, 0, 1, 0, length), zeros(8), u16(0, 0, 0, 0), UNTURNED,
    u32(width * 65536, height * 65536)), media);
  const head = box("mvhd", u32(0, 0, 0, scale, length, 65536), u16(256), zeros(10), UNTURNED, zeros(24), u32(2));
  const whole = [kind, data, box("moov", head, track)], bytes = new Uint8Array(whole.reduce((sum, one) => sum + one.length, 0));
  let at = 0;
  for (const one of whole) { bytes.set(one, at); at += one.length; }
  return bytes;
}

// What the numbers of a picture mean (ISO/IEC 23091-2); nothing where the encoder does not tell.
function colour(space) {
  const primaries = { bt709: 1, bt470bg: 5, smpte170m: 6 }[space?.primaries];
  const transfer = { bt709: 1, smpte170m: 6, "iec61966-2-1": 13 }[space?.transfer];
  const matrix = { rgb: 0, bt709: 1, bt470bg: 5, smpte170m: 6 }[space?.matrix];
  if ([primaries, transfer, matrix].includes(undefined)) return [];
  return box("colr", text("nclx"), u16(primaries, transfer, matrix), [space.fullRange ? 128 : 0]);
}
