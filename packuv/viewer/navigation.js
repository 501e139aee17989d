// The viewer's camera: orbit, pan, dolly and fly by mouse, touch and keyboard; jumps to capture cameras.
// Axes are OpenCV's, x right, y down, z forward, as in the scene's own cameras.

const add = (a, b, s = 1) => a.map((value, k) => value + s * b[k]);
const dot = (a, b) => a.reduce((sum, value, k) => sum + value * b[k], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((value) => value / (Math.hypot(...a) || 1));
const mix = (a, b, t) => a.map((value, k) => value + t * (b[k] - value));

function turn(v, axis, angle) { // Rodrigues
  const c = Math.cos(angle), s = Math.sin(angle), side = cross(axis, v), along = dot(axis, v) * (1 - c);
  return v.map((value, k) => c * value + s * side[k] + along * axis[k]);
}

const OPTICS = ["fx", "fy", "cx", "cy", "width", "height"];
const JUMP_MS = 400;
const POLE = 0.06; // closest the view comes to straight up or down, radians
const FLY_KEYS = { KeyW: [2, 1], KeyS: [2, -1], KeyD: [0, 1], KeyA: [0, -1], KeyQ: ["up", -1], KeyE: ["up", 1] };

export class Navigation {
  // world: {centre, up, radius, near}; onChange is called whenever the view moves.
  constructor(element, onChange) {
    this.element = element;
    this.onChange = onChange;
    this.flying = false;
    this.held = new Set();
    this.pointers = new Map();
    this.jump = null;
    this.exact = null; // name of the capture camera whose very view this is
    this.listen();
  }

  setWorld(world) {
    this.world = world;
    const { centre, up, radius } = world;
    const side = unit(cross(up, Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]));
    const forward = unit(add(cross(up, side), up, -0.35));
    this.home = {
      axes: facing(forward, up.map((value) => -value)),
      eye: add(centre, forward, -2.5 * radius),
      distance: 2.5 * radius,
      optics: { fx: 900, fy: 900, cx: 800, cy: 450, width: 1600, height: 900 },
    };
    this.state = this.home;
  }

  // The very view of a capture camera; where it is to be the view that R comes back to, `isHome`.
  lookFrom(camera, { animate = true, isHome = false } = {}) {
    const target = this.stateOf(camera);
    if (isHome) this.home = target;
    this.exact = camera.name;
    this.moveTo(target, animate);
  }

  // The very view of a camera that is none of the capture, at once.
  show(camera) {
    this.exact = null;
    this.moveTo(this.stateOf(camera), false);
  }

  stateOf({ camera_from_world: pose, ...camera }) {
    const optics = Object.fromEntries(OPTICS.map((name) => [name, camera[name]]));
    const axes = pose.slice(0, 3).map((row) => row.slice(0, 3));
    const eye = [0, 1, 2].map((k) => -(axes[0][k] * pose[0][3] + axes[1][k] * pose[1][3] + axes[2][k] * pose[2][3]));
    const ahead = dot(axes[2], add(this.world.centre, eye, -1)); // turn about the point of the gaze nearest the centre
    return { axes, eye, distance: Math.max(ahead, 0.2 * this.world.radius), optics };
  }

  reset() {
    this.exact = null;
    this.moveTo(this.home, true);
  }

  // The view in numbers, for links: eye, forward, down, distance of what it turns about, optics.
  numbers() {
    const { eye, axes, distance, optics } = this.state;
    return [...eye, ...axes[2], ...axes[1], distance, ...OPTICS.map((name) => optics[name])];
  }

  // The view that `numbers` tells; false for numbers that tell none.
  recall(numbers) {
    const [forward, down, distance, optics] = [numbers.slice(3, 6), numbers.slice(6, 9), numbers[9], numbers.slice(10)];
    const sound = numbers.length === 16 && numbers.every(Number.isFinite) && Math.hypot(...cross(down, forward)) > 0
      && distance > 0 && [0, 1, 4, 5].every((k) => optics[k] > 0);
    if (!sound) return false;
    this.exact = null;
    const named = Object.fromEntries(OPTICS.map((name, k) => [name, optics[k]]));
    this.moveTo({ eye: numbers.slice(0, 3), axes: facing(unit(forward), down), distance, optics: named }, false);
    return true;
  }

  // The view as a camera of the scene's own form.
  camera() {
    const { axes, eye, optics } = this.state;
    const pose = axes.map((axis) => [...axis, -dot(axis, eye)]);
    return { ...optics, camera_from_world: [...pose, [0, 0, 0, 1]] };
  }

  // The point that lies `depth` ahead under a pixel of the canvas, and the other way about.
  pointAt(x, y, depth) {
    const { lens } = this.view();
    const { axes, eye } = this.state;
    const local = [((x - lens[2]) / lens[0]) * depth, ((y - lens[3]) / lens[1]) * depth, depth];
    return local.reduce((sum, value, k) => add(sum, axes[k], value), eye);
  }

  pixelOf(point) { // null behind the near plane
    const { lens, near } = this.view();
    const local = this.state.axes.map((axis) => dot(axis, add(point, this.state.eye, -1)));
    if (local[2] <= near) return null;
    return [(lens[0] * local[0]) / local[2] + lens[2], (lens[1] * local[1]) / local[2] + lens[3]];
  }

  // Look at the point that lies `depth` ahead under a pixel.
  focus(x, y, depth) {
    const { axes, eye } = this.state;
    const point = this.pointAt(x, y, depth);
    const forward = unit(add(point, eye, -1));
    this.exact = null;
    this.moveTo({ ...this.state, axes: facing(forward, axes[1]), distance: Math.hypot(...add(point, eye, -1)) }, true);
  }

  moveTo(target, animate) {
    const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    if (!animate || calm) { this.state = target; this.jump = null; this.onChange(); return; }
    this.jump = { from: this.state, to: target, start: performance.now() };
    this.onChange();
  }

  // Advance jumps and keys; call once per animation frame.
  step(now, seconds) {
    if (this.jump) {
      const linear = Math.min(1, (now - this.jump.start) / JUMP_MS), t = linear * linear * (3 - 2 * linear);
      this.state = linear < 1 ? between(this.jump.from, this.jump.to, t) : this.jump.to;
      if (linear >= 1) this.jump = null;
      this.onChange();
    }
    if (this.held.size && this.world) this.fly(seconds);
  }

  fly(seconds) {
    const speed = (this.fast ? 4 : 1) * 0.6 * this.world.radius * seconds;
    let { eye } = this.state;
    for (const code of this.held) {
      const [axis, sign] = FLY_KEYS[code];
      eye = add(eye, axis === "up" ? this.world.up : this.state.axes[axis], sign * speed);
    }
    this.change({ eye });
  }

  change(part) {
    this.exact = null;
    this.jump = null;
    this.state = { ...this.state, ...part };
    this.onChange();
  }

  // Turn about the point looked at, or about the eye when flying: `yaw` about the world's up, `pitch` upwards, radians.
  rotate(yaw, pitch) {
    const { axes, eye, distance } = this.state;
    const { up } = this.world;
    const steepness = (angle) => Math.abs(dot(turn(axes[2], axes[0], angle), up));
    const atPole = steepness(pitch) > Math.cos(POLE) && steepness(pitch) > steepness(0);
    const turned = axes.map((axis) => turn(turn(axis, axes[0], atPole ? 0 : pitch), up, yaw));
    const pivot = add(eye, axes[2], distance);
    this.change({ axes: turned, eye: this.flying ? eye : add(pivot, turned[2], -distance) });
  }

  pan(dx, dy) {
    const { lens } = this.view();
    const { axes, eye, distance } = this.state;
    this.change({ eye: add(add(eye, axes[0], (-dx / lens[0]) * distance), axes[1], (-dy / lens[1]) * distance) });
  }

  dolly(factor) {
    const { axes, eye, distance } = this.state;
    const next = Math.max(distance * factor, 2 * this.world.near);
    this.change({ eye: add(eye, axes[2], distance - next), distance: next });
  }

  // What SplatView draws from; the whole picture of the optics fits into the canvas.
  view() {
    const { width, height } = this.element;
    const { axes, eye, optics } = this.state;
    const s = Math.min(width / optics.width, height / optics.height);
    const left = (width - s * optics.width) / 2, top = (height - s * optics.height) / 2;
    return {
      rotation: axes.flat(), eye, forward: axes[2], near: this.world.near,
      lens: [s * optics.fx, s * optics.fy, s * optics.cx + left, s * optics.cy + top],
      frame: [left, top, s * optics.width, s * optics.height],
    };
  }

  listen() {
    const { element } = this;
    element.addEventListener("pointerdown", (event) => {
      element.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, event);
    });
    element.addEventListener("pointermove", (event) => this.drag(event));
    for (const end of ["pointerup", "pointercancel"]) {
      element.addEventListener(end, (event) => this.pointers.delete(event.pointerId));
    }
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    element.addEventListener("wheel", (event) => {
      event.preventDefault();
      if (this.world) this.dolly(Math.exp(event.deltaY * (event.deltaMode ? 0.03 : 0.0012)));
    }, { passive: false });
    addEventListener("keydown", (event) => {
      this.fast = event.shiftKey;
      const elsewhere = event.ctrlKey || event.metaKey || event.altKey || event.target.closest?.("select, dialog");
      if (FLY_KEYS[event.code] && !elsewhere) this.held.add(event.code);
    });
    addEventListener("keyup", (event) => { this.fast = event.shiftKey; this.held.delete(event.code); });
    addEventListener("blur", () => this.held.clear());
  }

  drag(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before || !this.world) return;
    this.pointers.set(event.pointerId, event);
    const density = this.element.width / this.element.clientWidth;
    const dx = (event.clientX - before.clientX) * density, dy = (event.clientY - before.clientY) * density;
    if (this.pointers.size === 2) return this.pinch(event, before, dx, dy);
    if (this.pointers.size > 2) return;
    if (event.buttons & 6 || event.shiftKey) return this.pan(dx, dy);
    const radians = (this.flying ? 2 : 4) / this.element.height;
    const upright = dot(this.state.axes[1], this.world.up) < 0 ? 1 : -1; // left stays left in a picture upside down
    this.rotate(-dx * radians * upright, -dy * radians);
  }

  pinch(event, before, dx, dy) {
    const other = [...this.pointers.values()].find(({ pointerId }) => pointerId !== event.pointerId);
    const span = (pointer) => Math.hypot(pointer.clientX - other.clientX, pointer.clientY - other.clientY) || 1;
    this.dolly(span(before) / span(event));
    this.pan(dx / 2, dy / 2);
  }
}

function facing(forward, down) {
  const right = unit(cross(down, forward));
  return [right, cross(forward, right), forward];
}

function between(a, b, t) {
  const forward = unit(mix(a.axes[2], b.axes[2], t));
  const blend = (key) => a.optics[key] + t * (b.optics[key] - a.optics[key]);
  const optics = Object.fromEntries(Object.keys(a.optics).map((key) => [key, blend(key)]));
  return {
    axes: facing(forward, mix(a.axes[1], b.axes[1], t)),
    eye: mix(a.eye, b.eye, t),
    distance: a.distance + t * (b.distance - a.distance),
    optics,
  };
}

// Where the capture happens, judged by its cameras: the point nearest all gazes, the mean up unless the scene says where
// up is, the typical distance.
export function worldOf(scene) {
  const { cameras, centre, near } = scene;
  if (!cameras.length) return { centre, up: scene.up ?? [0, 0, 1], radius: 1, near };
  const axes = cameras.map(({ camera_from_world: m }) => m.slice(0, 3).map((row) => row.slice(0, 3)));
  const eyes = cameras.map(({ camera_from_world: m }, c) =>
    [0, 1, 2].map((k) => -(axes[c][0][k] * m[0][3] + axes[c][1][k] * m[1][3] + axes[c][2][k] * m[2][3])));
  const up = scene.up ?? unit(axes.reduce((sum, axis) => add(sum, axis[1], -1), [0, 0, 0]));
  const middle = meeting(eyes, axes.map((axis) => axis[2])) ?? centre;
  const spans = eyes.map((eye) => Math.hypot(...add(eye, middle, -1))).sort((a, b) => a - b);
  return { centre: middle, up, radius: spans[spans.length >> 1] || 1, near };
}

// Point with the least summed squared distance to all gazes; null where they are all but parallel.
function meeting(eyes, gazes) {
  const m = [[0, 0, 0], [0, 0, 0], [0, 0, 0]];
  let v = [0, 0, 0];
  eyes.forEach((eye, c) => {
    const across = [0, 1, 2].map((i) => [0, 1, 2].map((j) => (i === j) - gazes[c][i] * gazes[c][j]));
    across.forEach((row, i) => { m[i] = add(m[i], row); });
    v = add(v, across.map((row) => dot(row, eye)));
  });
  const determinant = dot(m[0], cross(m[1], m[2]));
  if (Math.abs(determinant) < 1e-4 * eyes.length ** 3) return null;
  return [cross(m[1], m[2]), cross(m[2], m[0]), cross(m[0], m[1])]
    .reduce((sum, column, k) => add(sum, column, v[k] / determinant), [0, 0, 0]);
}

// Wire pyramids of the capture cameras for SplatView.setLines.
export function frusta(scene, world) {
  const size = 0.12 * world.radius, vertices = [];
  for (const { camera_from_world: m, width, height, fx, fy, cx, cy, held_out: heldOut } of scene.cameras) {
    const tint = heldOut ? [1, 0.55, 0.1] : [0.35, 0.7, 1];
    const worldOfLocal = (p) => [0, 1, 2].map((k) => [0, 1, 2].reduce((sum, i) => sum + m[i][k] * (p[i] - m[i][3]), 0));
    const corners = [[0, 0], [width, 0], [width, height], [0, height]]
      .map(([x, y]) => worldOfLocal([((x - cx) / fx) * size, ((y - cy) / fy) * size, size]));
    const eye = worldOfLocal([0, 0, 0]);
    corners.forEach((corner, k) => vertices.push(...eye, ...tint, ...corner, ...tint, ...corner, ...tint,
      ...corners[(k + 1) % 4], ...tint));
  }
  return new Float32Array(vertices);
}
