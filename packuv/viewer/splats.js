// Draws Gaussians with WebGL2 in three passes: project (one fragment per Gaussian: codes -> tables -> ellipse on
// screen), splat (one quad each, far to near, into half floats), show (background, depth colours).
// The conventions are the rasterizer's: EWA with a 0.3 px^2 low-pass, alpha in [1/255, 0.99].

const WIDTH = 1024; // slots per texture row, as in worker.js
const BATCH = 2048; // quads per instance: one quad each would leave most of a GPU idle
export const MODES = ["colour", "depth", "dynamic", "opacity", "map", "layer"];
export const DEPTH_STOPS = [ // near to far, of even steps in lightness
  [253, 231, 37], [122, 209, 81], [34, 168, 132], [42, 120, 142], [65, 68, 135], [46, 16, 62],
];

const SCREEN = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

const PROJECT = `#version 300 es
precision highp float;
precision highp int;
uniform highp usampler2DArray codes;
uniform highp usampler2D atlas; // layer of the UV map, 0 where none takes the Gaussian
uniform highp sampler2D tables; // rows of 256: 3 x 256 rows of positions, then a row per attribute
uniform mat3 cameraFromWorld;
uniform vec3 eye;
uniform vec4 lens; // fx fy cx cy, px
uniform vec2 size;
uniform float near, scale;
uniform vec3 centre; // of the UV map
uniform int layers, degree, bands, mode, moving; // bands: bit l draws band l
layout(location = 0) out uvec4 shape; // centre and longer axis, px
layout(location = 1) out uvec4 look;  // shorter axis, red green, blue alpha, depth

uvec4 texels[4];

float position(int axis, uint code) {
  return texelFetch(tables, ivec2(int(code & 255u), axis * 256 + int(code >> 8)), 0).r;
}
float value(int column) {
  int octet = 6 + column;
  uint word = texels[octet >> 4][(octet >> 2) & 3];
  return texelFetch(tables, ivec2(int((word >> uint(8 * (octet & 3))) & 255u), 768 + column), 0).r;
}
vec3 coefficient(int k) { return vec3(value(7 + 3 * k), value(8 + 3 * k), value(9 + 3 * k)); }

vec3 colour(vec3 d) {
  vec3 c = vec3(0.5);
  if ((bands & 1) != 0) c += 0.28209479177387814 * coefficient(0);
  if (degree > 0 && (bands & 2) != 0) {
    c += 0.4886025119029199 * (-d.y * coefficient(1) + d.z * coefficient(2) - d.x * coefficient(3));
  }
  if (degree > 1 && (bands & 12) != 0) {
    float xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z;
    if ((bands & 4) != 0) c += 1.0925484305920792 * (d.x * d.y * coefficient(4) - d.y * d.z * coefficient(5) - d.x * d.z * coefficient(7))
       + 0.31539156525252005 * (2.0 * zz - xx - yy) * coefficient(6)
       + 0.5462742152960396 * (xx - yy) * coefficient(8);
    if (degree > 2 && (bands & 8) != 0) {
      c += -0.5900435899266435 * (d.y * (3.0 * xx - yy) * coefficient(9) + d.x * (xx - 3.0 * yy) * coefficient(15))
         + 2.890611442640554 * d.x * d.y * d.z * coefficient(10)
         - 0.4570457994644658 * (4.0 * zz - xx - yy) * (d.y * coefficient(11) + d.x * coefficient(13))
         + 0.3731763325901154 * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(12)
         + 1.445305721320277 * d.z * (xx - yy) * coefficient(14);
    }
  }
  return max(c, 0.0);
}

// Where in the UV map: hue along u, from bright to dark along v, and every sixteenth of either set off.
vec3 mapped(vec3 p) {
  vec2 uv = vec2(atan(p.y, p.x) / 6.283185307179586 + 0.5, acos(clamp(p.z / length(p), -1.0, 1.0)) / 3.141592653589793);
  vec3 hue = clamp(abs(mod(6.0 * uv.x + vec3(0.0, 4.0, 2.0), 6.0) - 3.0) - 1.0, 0.0, 1.0);
  vec2 cell = floor(uv * vec2(16.0));
  return mix(vec3(1.0), hue, 0.75) * (1.0 - 0.7 * uv.y) * (mod(cell.x + cell.y, 2.0) < 0.5 ? 1.0 : 0.82);
}

mat3 turned(vec3 v) {
  float w = sqrt(max(0.0, 1.0 - dot(v, v)));
  vec4 q = normalize(vec4(v, w));
  float x = q.x, y = q.y, z = q.z;
  w = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
              2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
              2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

void main() {
  shape = look = uvec4(0);
  ivec2 at = ivec2(gl_FragCoord.xy);
  for (int layer = 0; layer < layers; layer++) texels[layer] = texelFetch(codes, ivec3(at, layer), 0);
  uvec4 first = texels[0];
  float alpha = 1.0 / (1.0 + exp(-value(6)));
  vec3 world = vec3(position(0, first.x & 65535u), position(1, first.x >> 16), position(2, first.y & 65535u));
  vec3 local = cameraFromWorld * (world - eye);
  if (alpha < 1.0 / 255.0 || local.z <= near) return;

  vec2 ratio = local.xy / local.z;
  vec2 low = (-0.15 * size - lens.zw) / lens.xy, high = (1.15 * size - lens.zw) / lens.xy;
  vec2 held = clamp(ratio, low, high); // keeps the linearisation sane beside the picture
  vec2 f = lens.xy / local.z;
  mat3 jacobian = mat3(f.x, 0.0, 0.0, 0.0, f.y, 0.0, -f.x * held.x, -f.y * held.y, 0.0);
  mat3 m = jacobian * cameraFromWorld * turned(vec3(value(3), value(4), value(5)));
  vec3 sigma = scale * exp(vec3(value(0), value(1), value(2)));
  m = mat3(m[0] * sigma.x, m[1] * sigma.y, m[2] * sigma.z);
  float a = m[0].x * m[0].x + m[1].x * m[1].x + m[2].x * m[2].x + 0.3;
  float b = m[0].x * m[0].y + m[1].x * m[1].y + m[2].x * m[2].y;
  float c = m[0].y * m[0].y + m[1].y * m[1].y + m[2].y * m[2].y + 0.3;

  float middle = 0.5 * (a + c), radius = length(vec2(0.5 * (a - c), b));
  float longer = sqrt(middle + radius), shorter = sqrt(max(middle - radius, 0.3));
  vec2 axis = abs(b) > 1e-6 * middle ? normalize(vec2(b, middle + radius - a)) : (a >= c ? vec2(1, 0) : vec2(0, 1));
  vec3 rgb = colour(normalize(world - eye));
  if (mode == 2) {
    float grey = dot(rgb, vec3(0.3, 0.59, 0.11));
    bool moves = at.y * ${WIDTH} + at.x < moving;
    rgb = moves ? vec3(1.0, 0.45, 0.08) * (0.35 + 0.65 * grey) : vec3(0.06 + 0.3 * grey);
  }
  if (mode == 3) rgb = vec3(alpha);
  if (mode == 4) rgb = mapped(world - centre);
  if (mode == 5) {
    uint seat = texelFetch(atlas, at, 0).r;
    float t = clamp(float(seat) - 1.0, 0.0, 7.0) / 7.0;
    rgb = seat == 0u ? vec3(1.0, 0.0, 1.0) : mix(vec3(0.95, 0.95, 0.85), vec3(0.05, 0.15, 0.6), t);
  }
  shape = floatBitsToUint(vec4(lens.xy * ratio + lens.zw, longer * axis));
  uint blueAlpha = packHalf2x16(vec2(rgb.z, alpha));
  look = uvec4(floatBitsToUint(shorter), packHalf2x16(rgb.xy), blueAlpha, floatBitsToUint(local.z));
}`;

const SPLAT = `#version 300 es
precision highp float;
precision highp int;
uniform highp usampler2D shapes, looks, order;
uniform vec2 size;
uniform int mode, visible;
out vec2 corner;
flat out vec4 paint;
void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0); // outside the volume
  corner = vec2(0.0);
  paint = vec4(0.0);
  int rank = gl_InstanceID * ${BATCH} + (gl_VertexID >> 2);
  if (rank >= visible) return;
  uint slot = texelFetch(order, ivec2(rank % ${WIDTH}, rank / ${WIDTH}), 0).r;
  ivec2 at = ivec2(slot % ${WIDTH}u, slot / ${WIDTH}u);
  uvec4 rawLook = texelFetch(looks, at, 0);
  vec4 shape = uintBitsToFloat(texelFetch(shapes, at, 0));
  vec2 redGreen = unpackHalf2x16(rawLook.y), blueAlpha = unpackHalf2x16(rawLook.z);
  if (blueAlpha.y < 1.0 / 255.0) return;
  float reach = sqrt(2.0 * log(255.0 * blueAlpha.y)); // where alpha falls below 1/255
  corner = (vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0) * reach;
  vec2 along = shape.zw, across = normalize(vec2(-along.y, along.x)) * uintBitsToFloat(rawLook.x);
  vec2 px = shape.xy + corner.x * along + corner.y * across;
  gl_Position = vec4(px.x / size.x * 2.0 - 1.0, 1.0 - px.y / size.y * 2.0, 0.0, 1.0);
  paint = vec4(mode == 1 ? vec3(uintBitsToFloat(rawLook.w)) : vec3(redGreen, blueAlpha.x), blueAlpha.y);
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
in vec2 corner;
flat in vec4 paint;
out vec4 result;
void main() {
  float alpha = min(0.99, paint.a * exp(-0.5 * dot(corner, corner)));
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(paint.rgb * alpha, alpha);
}`;

const SHOW = `#version 300 es
precision highp float;
uniform highp sampler2D sums;
uniform vec3 background, light; // what light of the frame makes of sRGB + 0.055
uniform vec2 range;
uniform int mode;
uniform vec3 stops[${DEPTH_STOPS.length}];
out vec4 result;
void main() {
  vec4 sum = texelFetch(sums, ivec2(gl_FragCoord.xy), 0);
  vec3 rgb = sum.rgb;
  if (mode == 0) rgb = light * (rgb + 0.055 * sum.a) - 0.055 * sum.a; // the same for each Gaussian's colour
  if (mode == 1 && sum.a > 0.0) {
    float depth = sum.r / sum.a; // mean depth, weighted by what each Gaussian adds to the pixel
    float t = clamp(log(depth / range.x) / log(range.y / range.x), 0.0, 1.0) * float(${DEPTH_STOPS.length - 1});
    int k = min(int(t), ${DEPTH_STOPS.length - 2});
    rgb = mix(stops[k], stops[k + 1], t - float(k)) * sum.a;
  }
  result = vec4(rgb + (1.0 - sum.a) * background, 1.0);
}`;

const LINES = `#version 300 es
precision highp float;
uniform mat3 cameraFromWorld;
uniform vec3 eye;
uniform vec4 lens;
uniform vec2 size;
uniform float near;
in vec3 point;
in vec3 tint;
out vec3 colour;
void main() {
  vec3 p = cameraFromWorld * (point - eye);
  vec2 px = lens.xy * p.xy + lens.zw * p.z; // times depth
  gl_Position = vec4(2.0 * px.x / size.x - p.z, p.z - 2.0 * px.y / size.y, p.z - 2.0 * near, p.z);
  colour = tint;
}`;

const LINES_FRAGMENT = `#version 300 es
precision highp float;
in vec3 colour;
out vec4 result;
void main() { result = vec4(colour, 1.0); }`;

export class SplatView {
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser offers no WebGL2, which the viewer needs.");
    if (!gl.getExtension("EXT_color_buffer_float") && !gl.getExtension("EXT_color_buffer_half_float")) {
      throw new Error("This graphics driver cannot draw into half-float pictures, which the viewer needs.");
    }
    this.gl = gl;
    this.canvas = canvas;
    this.project = program(gl, SCREEN, PROJECT);
    this.splat = program(gl, SPLAT, SPLAT_FRAGMENT);
    this.show = program(gl, SCREEN, SHOW);
    this.lines = program(gl, LINES, LINES_FRAGMENT);
    this.points = gl.createBuffer();
    this.pointCount = 0;
    this.empty = gl.createVertexArray();
    this.quads = gl.createVertexArray();
    this.wires = gl.createVertexArray();
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, quadIndices(), gl.STATIC_DRAW);
    gl.bindVertexArray(this.wires);
    attribute(gl, this.lines, "point", this.points, 0);
    attribute(gl, this.lines, "tint", this.points, 12);
    this.timer = gl.getExtension("EXT_disjoint_timer_query_webgl2"); // which many browsers do not offer
    this.query = null;
    this.gpu_ms = null; // of the last picture whose time is known
    this.frame = gl.createFramebuffer();
    this.projected = gl.createFramebuffer();
    this.slotRows = 0;
    this.moving = 0;
    this.visible = 0;
    this.size = [0, 0];
  }

  setTables(tables, layers, { sh_degree: degree, centre }) {
    const { gl } = this;
    this.centre = centre;
    this.layers = layers;
    this.degree = degree;
    this.tables = texture(gl, gl.TEXTURE_2D);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R32F, 256, tables.length / 256);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 256, tables.length / 256, gl.RED, gl.FLOAT, tables);
  }

  // All Gaussians of a segment: bytes [layers, slotCount, 16].
  setKey(packed, slotCount, moving) {
    const { gl } = this;
    const rows = slotCount / WIDTH;
    if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error(`This GPU cannot hold ${slotCount} Gaussians.`);
    if (rows !== this.slotRows) this.allocate(rows);
    this.moving = moving;
    this.upload(packed, rows);
  }

  // Layer of the UV map of each slot, uint8.
  setLayers(layers) {
    const { gl } = this;
    if (layers.length !== WIDTH * this.slotRows) return; // of a segment that is gone
    bind(gl, 0, gl.TEXTURE_2D, this.atlas);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, this.slotRows, gl.RED_INTEGER, gl.UNSIGNED_BYTE, layers);
  }

  // The dynamic Gaussians of a frame, which fill the first `rows` texture rows.
  setFrame(packed, rows) {
    if (rows) this.upload(packed, rows);
  }

  // Slots in the order to draw them; the array has room for whole texture rows.
  setOrder(slots, visible) {
    const { gl } = this;
    bind(gl, 0, gl.TEXTURE_2D, this.order);
    const rows = Math.ceil(visible / WIDTH);
    if (rows) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, rows, gl.RED_INTEGER, gl.UNSIGNED_INT, slots);
    this.visible = visible;
  }

  // Line segments, [x y z r g b] per end.
  setLines(vertices) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.points);
    gl.bufferData(gl.ARRAY_BUFFER, vertices, gl.STATIC_DRAW);
    this.pointCount = vertices.length / 6;
  }

  // view: {rotation (row-major camera_from_world), eye, lens [fx fy cx cy] px, near}
  // look: {mode, bands, scale, background [3], range [2], light [3], lines}
  draw(view, look) {
    const { gl } = this;
    const timed = this.startTimer();
    this.accumulate(view, look, MODES.indexOf(look.mode));
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(this.show.handle);
    gl.bindVertexArray(this.empty);
    bind(gl, 0, gl.TEXTURE_2D, this.sums);
    const { uniforms } = this.show;
    gl.uniform1i(uniforms.sums, 0);
    gl.uniform3fv(uniforms.background, look.background);
    gl.uniform3fv(uniforms.light, look.light);
    gl.uniform2fv(uniforms.range, look.range);
    gl.uniform1i(uniforms.mode, MODES.indexOf(look.mode));
    gl.uniform3fv(uniforms.stops, DEPTH_STOPS.flat().map((byte) => byte / 255));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    if (look.lines && this.pointCount) this.drawLines(view);
    if (timed) gl.endQuery(this.timer.TIME_ELAPSED_EXT);
  }

  // One query at a time: a new one once the last one has told its time.
  startTimer() {
    const { gl, timer } = this;
    if (!timer) return false;
    if (this.query) {
      if (!gl.getQueryParameter(this.query, gl.QUERY_RESULT_AVAILABLE)) return false;
      const sound = !gl.getParameter(timer.GPU_DISJOINT_EXT);
      if (sound) this.gpu_ms = gl.getQueryParameter(this.query, gl.QUERY_RESULT) / 1e6;
      gl.deleteQuery(this.query);
    }
    this.query = gl.createQuery();
    gl.beginQuery(timer.TIME_ELAPSED_EXT, this.query);
    return true;
  }

  // Mean depth at a canvas pixel, or null where nothing is.
  depthAt(view, look, x, y) {
    const { gl } = this;
    this.accumulate(view, look, MODES.indexOf("depth"));
    const sum = new Float32Array(4);
    gl.readPixels(x, this.size[1] - 1 - y, 1, 1, gl.RGBA, gl.FLOAT, sum);
    return sum[3] > 0.5 ? sum[0] / sum[3] : null;
  }

  accumulate(view, look, mode) {
    const { gl } = this;
    this.resize();
    if (!this.slotRows) return this.clearSums();
    this.runProjection(view, look, mode);
    this.clearSums();
    gl.useProgram(this.splat.handle);
    gl.bindVertexArray(this.quads);
    bind(gl, 0, gl.TEXTURE_2D, this.shapes);
    bind(gl, 1, gl.TEXTURE_2D, this.looks);
    bind(gl, 2, gl.TEXTURE_2D, this.order);
    const { uniforms } = this.splat;
    gl.uniform1i(uniforms.shapes, 0);
    gl.uniform1i(uniforms.looks, 1);
    gl.uniform1i(uniforms.order, 2);
    gl.uniform2fv(uniforms.size, this.size);
    gl.uniform1i(uniforms.mode, mode);
    gl.uniform1i(uniforms.visible, this.visible);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil(this.visible / BATCH));
    gl.disable(gl.BLEND);
  }

  runProjection(view, look, mode) {
    const { gl } = this;
    const { uniforms } = this.project;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.projected);
    gl.viewport(0, 0, WIDTH, this.slotRows);
    gl.useProgram(this.project.handle);
    gl.bindVertexArray(this.empty);
    bind(gl, 0, gl.TEXTURE_2D_ARRAY, this.codes);
    bind(gl, 1, gl.TEXTURE_2D, this.tables);
    gl.uniform1i(uniforms.codes, 0);
    gl.uniform1i(uniforms.tables, 1);
    bind(gl, 2, gl.TEXTURE_2D, this.atlas);
    gl.uniform1i(uniforms.atlas, 2);
    this.setView(uniforms, view);
    gl.uniform1f(uniforms.scale, look.scale);
    gl.uniform1i(uniforms.layers, this.layers);
    gl.uniform1i(uniforms.degree, this.degree);
    gl.uniform1i(uniforms.bands, look.bands);
    gl.uniform3fv(uniforms.centre, this.centre);
    gl.uniform1i(uniforms.mode, mode);
    gl.uniform1i(uniforms.moving, this.moving);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  drawLines(view) {
    const { gl } = this;
    gl.useProgram(this.lines.handle);
    gl.bindVertexArray(this.wires);
    this.setView(this.lines.uniforms, view);
    gl.drawArrays(gl.LINES, 0, this.pointCount);
  }

  setView(uniforms, view) {
    const { gl } = this;
    gl.uniformMatrix3fv(uniforms.cameraFromWorld, true, view.rotation);
    gl.uniform3fv(uniforms.eye, view.eye);
    gl.uniform4fv(uniforms.lens, view.lens);
    gl.uniform2fv(uniforms.size, this.size);
    gl.uniform1f(uniforms.near, view.near);
  }

  clearSums() {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.viewport(0, 0, ...this.size);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }

  resize() {
    const { gl, canvas } = this;
    if (this.size[0] === canvas.width && this.size[1] === canvas.height) return;
    this.size = [canvas.width, canvas.height];
    gl.deleteTexture(this.sums);
    this.sums = texture(gl, gl.TEXTURE_2D);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, ...this.size);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.sums, 0);
  }

  allocate(rows) {
    const { gl } = this;
    this.slotRows = rows;
    for (const old of [this.codes, this.order, this.shapes, this.looks, this.atlas]) gl.deleteTexture(old);
    this.codes = texture(gl, gl.TEXTURE_2D_ARRAY);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA32UI, WIDTH, rows, this.layers);
    this.atlas = texture(gl, gl.TEXTURE_2D);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R8UI, WIDTH, rows);
    this.order = texture(gl, gl.TEXTURE_2D);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R32UI, WIDTH, rows);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.projected);
    [this.shapes, this.looks] = [0, 1].map((index) => {
      const target = texture(gl, gl.TEXTURE_2D);
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, WIDTH, rows);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + index, gl.TEXTURE_2D, target, 0);
      return target;
    });
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
  }

  upload(packed, rows) {
    const { gl } = this;
    bind(gl, 0, gl.TEXTURE_2D_ARRAY, this.codes);
    const words = new Uint32Array(packed);
    gl.texSubImage3D(
      gl.TEXTURE_2D_ARRAY, 0, 0, 0, 0, WIDTH, rows, this.layers, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words,
    );
  }
}

function program(gl, vertex, fragment) {
  const handle = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(handle, shader);
    const failed = !gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost();
    if (failed) throw new Error(gl.getShaderInfoLog(shader));
  }
  gl.linkProgram(handle);
  const failed = !gl.getProgramParameter(handle, gl.LINK_STATUS) && !gl.isContextLost();
  if (failed) throw new Error(gl.getProgramInfoLog(handle));
  const uniforms = {};
  for (let index = gl.getProgramParameter(handle, gl.ACTIVE_UNIFORMS) - 1; index >= 0; index--) {
    const name = gl.getActiveUniform(handle, index).name;
    uniforms[name.replace("[0]", "")] = gl.getUniformLocation(handle, name);
  }
  return { handle, uniforms };
}

function texture(gl, target) {
  const handle = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(target, handle);
  for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(target, filter, gl.NEAREST);
  return handle;
}

function bind(gl, unit, target, handle) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(target, handle);
}

function attribute(gl, { handle }, name, buffer, offset) { // three floats of the six of a vertex
  const location = gl.getAttribLocation(handle, name);
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.enableVertexAttribArray(location);
  gl.vertexAttribPointer(location, 3, gl.FLOAT, false, 24, offset);
}

function quadIndices() { // two triangles a quad, corners numbered like a strip
  return Uint16Array.from({ length: 6 * BATCH }, (_, k) => 4 * Math.floor(k / 6) + [0, 1, 2, 2, 1, 3][k % 6]);
}
