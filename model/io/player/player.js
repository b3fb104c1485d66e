// SPDX-License-Identifier: GPL-3.0-or-later
// Plays a 4D Gaussian asset: the .ply that the page holds is taken apart here once; place, rotation and opacity at a time
// are computed in the vertex shader from its numbers, and splatted as model/rasterize does (reference.py is the text of
// it): EWA, the covariance on the screen widened by BLUR, drawn from ALPHA_MIN on, blended back to front in sRGB.

const SH_C0 = 0.28209479177387814, SLACK = 1e-4;  // as in model/io/asset.py and paths.py
const NEAR = 0.01, BLUR = 0.1, SLOPE_MARGIN = 0.3, ALPHA_MIN = 1 / 255, ALPHA_MAX = 0.999;  // model/rasterize/constants.py
const TEXELS = 5, WIDTH = 4000; // that a Gaussian takes; in a row of a texture
const BINS = 1 << 16;  // of depth

// ---------------------------------------------------------------- the asset

async function unpack(text) {
  const packed = Uint8Array.from(atob(text), c => c.charCodeAt(0));
  return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

/** {element: {count, column(name): index -> number}} of a binary little-endian .ply as model/io/ply.py writes it. */
function tables(buffer) {
  const head = new TextDecoder().decode(buffer.slice(0, 1 << 16)).split("end_header\n")[0];
  const views = {float: Float32Array, int: Int32Array, short: Int16Array}, found = {};
  let at = head.length + "end_header\n".length, table;
  for (const line of head.split("\n")) {
    const [word, a, b] = line.split(" ");
    if (word === "element") found[a] = table = {count: +b, stride: 0, columns: {}};
    if (word === "property") {
      table.columns[b] = [views[a], table.stride];
      table.stride += views[a].BYTES_PER_ELEMENT;
    }
  }
  for (const table of Object.values(found)) {
    const bytes = buffer.slice(at, at += table.count * table.stride);
    table.column = name => {
      const [View, offset] = table.columns[name], data = new View(bytes), size = View.BYTES_PER_ELEMENT;
      const first = offset / size, step = table.stride / size;
      return i => data[first + i * step];
    };
  }
  return found;
}

/** Float32Arrays: `gaussians`, TEXELS x 4 each (offset on the path or place, own time; scale, lifetime; rotation x y z w;
 *  velocity, path or -1; rgb, opacity), `paths` (start, end, knots, first knot), `knots` (place, 0; rotation x y z w). */
function decode(buffer) {
  const {vertex, path, knot} = tables(buffer), n = vertex.count, gaussians = new Float32Array(n * TEXELS * 4);
  const put = (to, step, at, from, names, f = x => x) => names.forEach((name, k) => {
    const get = from.column(name);
    for (let i = 0; i < from.count; i++) to[i * step + at + k] = f(get(i));
  });
  const step = TEXELS * 4;
  put(gaussians, step, 0, vertex, ["x", "y", "z", "t"]);
  put(gaussians, step, 4, vertex, ["scale_0", "scale_1", "scale_2", "scale_t"], Math.exp);
  put(gaussians, step, 8, vertex, ["rot_1", "rot_2", "rot_3", "rot_0"]);
  if (!path) put(gaussians, step, 12, vertex, ["vx", "vy", "vz"]);
  put(gaussians, step, 16, vertex, ["f_dc_0", "f_dc_1", "f_dc_2"], x => 0.5 + SH_C0 * x);
  put(gaussians, step, 19, vertex, ["opacity"], x => 1 / (1 + Math.exp(-x)));
  if (!path) {
    for (let i = 0; i < n; i++) gaussians[i * step + 15] = -1;
    return {n, gaussians, paths: new Float32Array(0), knots: new Float32Array(0)};
  }
  put(gaussians, step, 15, vertex, ["path"]);
  const paths = new Float32Array(path.count * 4), knots = new Float32Array(knot.count * 8);
  put(paths, 4, 0, path, ["start", "end", "knots"]);
  put(knots, 8, 0, knot, ["x", "y", "z"]);
  put(knots, 8, 4, knot, ["rot_1", "rot_2", "rot_3", "rot_0"]);
  const [x, y, z, size] = ["x", "y", "z", "size"].map(path.column);
  for (let p = 0, k = 0; p < path.count; p++) {
    paths[p * 4 + 3] = k;
    for (const end = k + paths[p * 4 + 2]; k < end; k++)
      [x(p), y(p), z(p)].forEach((middle, j) => { knots[k * 8 + j] = middle + size(p) * knots[k * 8 + j] / 32767; });
  }
  const then = new Float64Array(7);
  for (let i = 0; i < n; i++) {  // what was there at the Gaussian's own time becomes what rides on the path
    const g = gaussians.subarray(i * step, i * step + step);
    pose(paths, knots, g[15], g[3], then);
    const back = [-then[3], -then[4], -then[5], then[6]];
    g.set(turned(back, [g[0] - then[0], g[1] - then[1], g[2] - then[2]]));
    g.set(product(back, g.subarray(8, 12)), 8);
  }
  return {n, gaussians, paths, knots};
}

/** Place and unit quaternion x y z w of a path at a model time, into `out`; the vertex shader's `pose` is the same. */
function pose(paths, knots, p, time, out) {
  const start = paths[p * 4], end = paths[p * 4 + 1], count = paths[p * 4 + 2], first = paths[p * 4 + 3];
  const along = Math.min(Math.max((time - start) / Math.max(end - start, 1e-9), 0), 1) * (count - 1);
  const whole = Math.min(Math.floor(along), Math.max(count - 2, 0)), part = along - whole;
  const a = (first + whole) * 8, b = Math.min(first + whole + 1, first + count - 1) * 8;
  for (let k = 0, j = 0; j < 7; k++) if (k !== 3) out[j++] = knots[a + k] + part * (knots[b + k] - knots[a + k]);
  const length = Math.sqrt(out[3] * out[3] + out[4] * out[4] + out[5] * out[5] + out[6] * out[6]);
  for (let j = 3; j < 7; j++) out[j] /= length;
}

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const turned = (q, v) => {
  const s = cross(q, v).map(c => 2 * c), w = cross(q, s);
  return [0, 1, 2].map(k => v[k] + q[3] * s[k] + w[k]);
};
const product = (a, b) => {
  const c = cross(a, b);
  return [...[0, 1, 2].map(k => a[3] * b[k] + b[3] * a[k] + c[k]), a[3] * b[3] - dot(a, b)];
};

// ---------------------------------------------------------------- which are drawn, in which order

/** By depth, far to near, those that reach the opacity `cut` at a time; a counting sort. */
class Order {
  constructor(asset) {
    this.asset = asset;
    this.ids = new Uint32Array(asset.n);
    this.sorted = new Uint32Array(asset.n);
    this.depths = new Float32Array(asset.n);
    this.counts = new Uint32Array(BINS + 1);
    this.planes = new Float64Array(asset.paths.length);  // of a path's frame: depth = n·offset + d
    this.from = new Float32Array(asset.n);  // when a Gaussian reaches the cut
    this.until = new Float32Array(asset.n);
  }

  set cut(cut) {
    const {n, gaussians, paths} = this.asset, least = Math.max(cut, ALPHA_MIN);
    for (let i = 0, g = 0; i < n; i++, g += TEXELS * 4) {
      const own = gaussians[g + 3], p = gaussians[g + 15] * 4, opacity = gaussians[g + 19];
      const reach = opacity < least ? -1e9 : gaussians[g + 7] * Math.sqrt(2 * Math.log(opacity / least));
      this.from[i] = own - reach;
      this.until[i] = own + reach;
      if (p < 0) continue;
      this.from[i] = Math.max(this.from[i], paths[p] - SLACK);
      this.until[i] = Math.min(this.until[i], paths[p + 1] + SLACK);
    }
  }

  /** Indices from far to near; axis: where the camera at `eye` looks. */
  at(time, eye, axis) {
    const {n, gaussians, paths, knots} = this.asset, {ids, depths, counts, planes, sorted} = this;
    const onPaths = paths.length > 0, shift = -dot(axis, eye);
    const [ax, ay, az] = axis, now = new Float64Array(7);
    for (let p = 0; p < paths.length / 4; p++) {
      pose(paths, knots, p, time, now);
      const [x, y, z, qx, qy, qz, qw] = now;  // the axis turned back by it
      const sx = 2 * (ay * qz - az * qy), sy = 2 * (az * qx - ax * qz), sz = 2 * (ax * qy - ay * qx);
      planes[p * 4] = ax + qw * sx - qy * sz + qz * sy;
      planes[p * 4 + 1] = ay + qw * sy - qz * sx + qx * sz;
      planes[p * 4 + 2] = az + qw * sz - qx * sy + qy * sx;
      planes[p * 4 + 3] = ax * x + ay * y + az * z + shift;
    }
    let count = 0, low = Infinity, high = -Infinity;
    for (let i = 0, g = 0; i < n; i++, g += TEXELS * 4) {
      if (time < this.from[i] || time > this.until[i]) continue;
      let depth;
      if (onPaths) {
        const p = gaussians[g + 15] * 4;
        depth = planes[p] * gaussians[g] + planes[p + 1] * gaussians[g + 1] + planes[p + 2] * gaussians[g + 2] + planes[p + 3];
      } else {
        const dt = time - gaussians[g + 3];
        depth = axis[0] * (gaussians[g] + gaussians[g + 12] * dt) + axis[1] * (gaussians[g + 1] + gaussians[g + 13] * dt)
          + axis[2] * (gaussians[g + 2] + gaussians[g + 14] * dt) + shift;
      }
      if (!(depth >= NEAR)) continue;
      if (depth < low) low = depth;
      if (depth > high) high = depth;
      depths[count] = depth;
      ids[count++] = i;
    }
    counts.fill(0);
    const scale = (BINS - 1) / Math.max(high - low, 1e-12), bin = i => ((high - depths[i]) * scale) | 0;
    for (let i = 0; i < count; i++) counts[bin(i) + 1]++;
    for (let b = 1; b <= BINS; b++) counts[b] += counts[b - 1];
    for (let i = 0; i < count; i++) sorted[counts[bin(i)]++] = ids[i];
    return sorted.subarray(0, count);
  }
}

// ---------------------------------------------------------------- drawing

const VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D;
uniform sampler2D gaussians, paths, knots;
uniform mat3 axes;      // columns: right, down, into the picture
uniform vec3 eye;
uniform vec2 size;      // pixels
uniform float focal, time, pixel;
in uint id;
out vec2 u;             // in standard deviations
flat out vec4 look;

vec4 texel(sampler2D s, int i) { return texelFetch(s, ivec2(i % ${WIDTH}, i / ${WIDTH}), 0); }
vec3 turned(vec4 q, vec3 v) { vec3 s = 2.0 * cross(q.xyz, v); return v + q.w * s + cross(q.xyz, s); }
vec4 product(vec4 a, vec4 b) {
  return vec4(a.w * b.xyz + b.w * a.xyz + cross(a.xyz, b.xyz), a.w * b.w - dot(a.xyz, b.xyz));
}
void pose(int path, out vec3 place, out vec4 turn) {
  vec4 p = texel(paths, path);
  float along = clamp((time - p.x) / max(p.y - p.x, 1e-9), 0.0, 1.0) * (p.z - 1.0);
  float whole = min(floor(along), max(p.z - 2.0, 0.0)), part = along - whole;
  int a = int(p.w + whole), b = int(min(p.w + whole + 1.0, p.w + p.z - 1.0));
  place = mix(texel(knots, 2 * a).xyz, texel(knots, 2 * b).xyz, part);
  turn = normalize(mix(texel(knots, 2 * a + 1), texel(knots, 2 * b + 1), part));
}
void main() {
  int at = int(id) * ${TEXELS};
  vec4 own = texel(gaussians, at), scale = texel(gaussians, at + 1), q = texel(gaussians, at + 2);
  vec4 moves = texel(gaussians, at + 3);
  look = texel(gaussians, at + 4);
  float age = time - own.w;
  look.a *= exp(-0.5 * age * age / (scale.w * scale.w));
  vec3 centre = own.xyz + moves.xyz * age;
  if (moves.w >= 0.0) {
    vec3 place; vec4 turn;
    pose(int(moves.w), place, turn);
    centre = place + turned(turn, own.xyz);
    q = product(turn, q);
  }
  q = normalize(q);
  vec3 p = (centre - eye) * axes;
  vec2 bound = ${0.5 * (1 + SLOPE_MARGIN)} * size / focal, slope = clamp(p.xy / p.z, -bound, bound);
  float near = focal / p.z;
  vec3 j = near * (axes[0] - slope.x * axes[2]), k = near * (axes[1] - slope.y * axes[2]);
  vec4 back = vec4(-q.xyz, q.w);
  j = turned(back, j) * scale.xyz;
  k = turned(back, k) * scale.xyz;
  // As it looked in the pictures it was made from where one of their pixels is wider than ours, else as one of ours
  float blur = ${BLUR} * max(1.0, pixel * pixel * near * near);
  float a = dot(j, j) + blur, b = dot(j, k), c = dot(k, k) + blur;
  u = vec2((gl_VertexID & 1) * 2 - 1, (gl_VertexID & 2) - 1) * sqrt(2.0 * log(max(look.a / ${ALPHA_MIN}, 1.0)));
  float d = inversesqrt(a);  // the square root of the covariance by Cholesky
  vec2 offset = vec2(u.x / d, b * d * u.x + sqrt(max(c - b * b * d * d, blur)) * u.y);
  vec2 to = (near * p.xy + offset) * 2.0 / size;
  gl_Position = p.z < ${NEAR} ? vec4(2.0, 2.0, 2.0, 1.0) : vec4(to.x, -to.y, 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 u;
flat in vec4 look;
out vec4 colour;
void main() {
  float alpha = look.a * exp(-0.5 * dot(u, u));
  if (alpha < ${ALPHA_MIN}) discard;
  alpha = min(alpha, ${ALPHA_MAX});
  colour = vec4(look.rgb * alpha, alpha);
}`;

const WHOLE = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }`;

const OVER = `#version 300 es
precision highp float; precision highp sampler2D;
uniform sampler2D drawn;
uniform vec3 background;
out vec4 colour;
void main() {
  vec4 c = texelFetch(drawn, ivec2(gl_FragCoord.xy), 0);
  colour = vec4(c.rgb + (1.0 - c.a) * background, 1.0);
}`;

class Renderer {
  constructor(canvas, asset) {
    const gl = canvas.getContext("webgl2", {alpha: false, antialias: false, depth: false, powerPreference: "high-performance"});
    if (!gl) throw Error("This browser has no WebGL 2, which the page draws with.");
    this.gl = gl;
    this.order = new Order(asset);
    const precise = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    this.format = precise ? [gl.RGBA16F, gl.HALF_FLOAT] : [gl.RGBA8, gl.UNSIGNED_BYTE];
    this.splat = this.program(VERTEX, FRAGMENT);
    this.over = this.program(WHOLE, OVER);
    ["gaussians", "paths", "knots"].forEach((name, unit) => this.upload(unit, asset[name]));
    this.drawn = gl.createTexture();
    this.target = gl.createFramebuffer();
    this.nothing = gl.createVertexArray();
    this.instances = gl.createVertexArray();
    gl.bindVertexArray(this.instances);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, asset.n * 4, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  program(...sources) {
    const gl = this.gl, program = gl.createProgram(), uniforms = {program};
    sources.forEach((source, i) => {
      const shader = gl.createShader(i ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    });
    gl.bindAttribLocation(program, 0, "id");
    gl.linkProgram(program);
    for (let i = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i--;) {
      const {name} = gl.getActiveUniform(program, i);
      uniforms[name] = gl.getUniformLocation(program, name);
    }
    return uniforms;
  }

  upload(unit, data) {
    const gl = this.gl, rows = Math.max(Math.ceil(data.length / 4 / WIDTH), 1);
    if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw Error("This asset is larger than this device's graphics can hold.");
    const whole = new Float32Array(rows * WIDTH * 4);
    whole.set(data);
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    this.nearest();
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, WIDTH, rows, 0, gl.RGBA, gl.FLOAT, whole);
  }

  nearest() {
    const gl = this.gl;
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
  }

  resize(width, height) {
    const gl = this.gl, canvas = gl.canvas;
    if (canvas.width === width && canvas.height === height && this.sized) return;
    [canvas.width, canvas.height, this.sized] = [width, height, true];
    gl.activeTexture(gl.TEXTURE3);
    gl.bindTexture(gl.TEXTURE_2D, this.drawn);
    this.nearest();
    gl.texImage2D(gl.TEXTURE_2D, 0, this.format[0], width, height, 0, gl.RGBA, this.format[1], null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.drawn, 0);
  }

  /** camera: `eye`, and the axes `right`, `down`, `ahead`; fov in radians, of the shorter side. */
  draw({eye, right, down, ahead}, fov, time, background) {
    const gl = this.gl, {width, height} = gl.canvas, {splat, over} = this;
    const order = this.order.at(time, eye, ahead);
    gl.viewport(0, 0, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.useProgram(splat.program);
    gl.bindVertexArray(this.instances);
    ["gaussians", "paths", "knots"].forEach((name, unit) => gl.uniform1i(splat[name], unit));
    gl.uniformMatrix3fv(splat.axes, false, [...right, ...down, ...ahead]);
    gl.uniform3fv(splat.eye, eye);
    gl.uniform2f(splat.size, width, height);
    gl.uniform1f(splat.focal, 0.5 * Math.min(width, height) / Math.tan(fov / 2));
    gl.uniform1f(splat.time, time);
    gl.uniform1f(splat.pixel, ABOUT.pixel);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, order);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, order.length);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.useProgram(over.program);
    gl.bindVertexArray(this.nothing);
    gl.uniform1i(over.drawn, 3);
    gl.uniform3fv(over.background, background);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}

// ---------------------------------------------------------------- the page

const $ = id => document.getElementById(id);
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const told = new URLSearchParams(location.hash.slice(1));  // see docs/pipelines.md
const numbers = name => (told.get(name) || "").split(/[,x]/).filter(Boolean).map(Number);
const one = (name, otherwise) => Number.isFinite(numbers(name)[0]) ? numbers(name)[0] : otherwise;
const size = numbers("size"), moves = ABOUT.end > ABOUT.start;
const state = {
  frame: clamp(one("t", ABOUT.start), ABOUT.start, ABOUT.end), speed: 1, loop: true,
  playing: moves && told.has("play"), cut: one("cut", ABOUT.cut), background: `#${told.get("background") || "ffffff"}`,
};
const home = () => {  // azimuth, elevation in degrees; distance; target
  const [azimuth = 30, elevation = 15, distance = ABOUT.distance, x, y, z] = numbers("camera");
  return {azimuth, elevation, distance, target: z === undefined ? [...ABOUT.target] : [x, y, z]};
};
let view = home(), renderer, dirty = true, before = 0, slow = 0, detail = 1;

/** Where the camera stands: as datagen/rigs.py `spherical` around the target, in OpenCV axes. */
function camera() {
  const a = view.azimuth * Math.PI / 180, e = view.elevation * Math.PI / 180;
  const from = [-Math.sin(a) * Math.cos(e), -Math.cos(a) * Math.cos(e), Math.sin(e)];
  const right = [Math.cos(a), -Math.sin(a), 0], ahead = from.map(c => -c);
  return {eye: from.map((c, k) => view.target[k] + view.distance * c), right, down: cross(ahead, right), ahead};
}

function tick(now) {
  const passed = Math.min((now - before) / 1000, 0.25);
  before = now;
  if (state.playing) {
    state.frame += passed * ABOUT.fps * state.speed;
    if (state.frame > ABOUT.end) {
      if (state.loop) state.frame = ABOUT.start + (state.frame - ABOUT.start) % (ABOUT.end - ABOUT.start);
      else { state.frame = ABOUT.end; play(false); }
    }
    dirty = true;
  }
  // A device that cannot keep up draws fewer pixels while something moves, and all of them when it rests
  slow = dirty ? 0.9 * slow + 0.1 * passed : 0;
  const wanted = size.length || !dirty ? 1 : slow > 0.05 ? Math.max(detail * 0.8, 0.4) : detail;
  if (wanted !== detail) [detail, slow, dirty] = [wanted, 0.03, true];
  if (dirty) show();
  requestAnimationFrame(tick);
}

function show() {
  dirty = false;
  const canvas = $("view"), dots = size.length ? 1 : Math.min(devicePixelRatio || 1, 2) * detail;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight].map(c => Math.max(Math.round(c * dots), 1));
  renderer.resize(width, height);
  const time = moves ? 2 * (state.frame - ABOUT.start) / (ABOUT.end - ABOUT.start) - 1 : 0;
  const background = [1, 3, 5].map(k => parseInt(state.background.slice(k, k + 2), 16) / 255);
  renderer.draw(camera(), ABOUT.fov * Math.PI / 180, time, background);
  $("time").value = state.frame;
  const text = state.frame.toFixed(1);
  if ($("frame").dataset.text !== text) $("frame").innerHTML = `${$("frame").dataset.text = text} <i>/ ${ABOUT.end}</i>`;
}

function play(on) {
  state.playing = on;
  if (on && state.frame >= ABOUT.end) state.frame = ABOUT.start;
  $("play").setAttribute("aria-label", on ? "Pause" : "Play");
  $("play").querySelector("path").setAttribute("d", on ? "M5 4h3.5v12H5zM11.5 4H15v12h-3.5z" : "M6 3.5v13l11-6.5z");
}

function seek(frame) {
  play(false);
  state.frame = clamp(frame, ABOUT.start, ABOUT.end);
  dirty = true;
}

function settings() {
  renderer.order.cut = state.cut;
  const [r, g, b] = [1, 3, 5].map(k => parseInt(state.background.slice(k, k + 2), 16));
  document.documentElement.classList.toggle("dark", 0.3 * r + 0.59 * g + 0.11 * b < 140);
  document.body.style.background = $("background").value = state.background;
  $("cut").nextElementSibling.value = (+$("cut").value).toFixed(2);
  dirty = true;
}

function controls() {
  const on = (target, kind, f, options) => (typeof target === "string" ? $(target) : target).addEventListener(kind, f, options);
  [$("time").min, $("time").max, $("cut").value] = [ABOUT.start, ABOUT.end, state.cut];
  on("play", "click", () => play(!state.playing));
  on("time", "input", () => seek(+$("time").value));
  on("speed", "change", () => { state.speed = +$("speed").value; });
  on("loop", "change", () => { state.loop = $("loop").checked; });
  on("cut", "input", () => { state.cut = +$("cut").value; settings(); });
  on("background", "input", () => { state.background = $("background").value; settings(); });
  for (const swatch of document.querySelectorAll(".swatch"))
    on(swatch, "click", () => { state.background = swatch.dataset.colour; settings(); });
  on("home", "click", () => { view = home(); dirty = true; });
  const more = open => { $("more").hidden = !open; $("open").setAttribute("aria-expanded", open); };
  on("open", "click", () => more($("more").hidden));
  on(window, "resize", () => { dirty = true; });
  on(window, "keydown", event => {
    if (event.ctrlKey || event.metaKey || event.altKey || /SELECT/.test(event.target.tagName)) return;
    if (event.target.type === "range" && event.key.startsWith("Arrow") && event.target.id !== "time") return;
    const steps = {ArrowLeft: -1, ArrowRight: 1, ",": -0.1, ".": 0.1};
    if (event.key === " " && event.target.tagName !== "BUTTON" && event.target.type !== "checkbox") play(moves && !state.playing);
    else if (event.key in steps) seek(state.frame + steps[event.key]);
    else if (event.key === "Home") { view = home(); dirty = true; }
    else if (event.key === "Escape") more(false);
    else return;
    event.preventDefault();
  });

  const canvas = $("view"), fingers = new Map();
  const zoom = by => { view.distance = clamp(view.distance * by, 0.02 * ABOUT.distance, 20 * ABOUT.distance); dirty = true; };
  const pan = (x, y) => {  // so that the target stays under the finger
    const {right, down} = camera();
    const step = 2 * view.distance * Math.tan(ABOUT.fov * Math.PI / 360) / Math.min(canvas.clientWidth, canvas.clientHeight);
    view.target = view.target.map((c, k) => c - step * (x * right[k] + y * down[k]));
    dirty = true;
  };
  on(canvas, "pointerdown", event => {
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    more(false);
    canvas.setPointerCapture(event.pointerId);
  });
  on(canvas, "pointermove", event => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const next = [event.clientX, event.clientY], [x, y] = [next[0] - last[0], next[1] - last[1]];
    fingers.set(event.pointerId, next);
    if (fingers.size > 1) {
      const [other] = [...fingers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      const apart = at => Math.max(Math.hypot(at[0] - other[0], at[1] - other[1]), 1);
      zoom(apart(last) / apart(next));
      pan(x / 2, y / 2);
    } else if (event.buttons & 6 || event.shiftKey) {
      pan(x, y);
    } else {
      view.azimuth += 0.35 * x;
      view.elevation = clamp(view.elevation + 0.35 * y, -89.9, 89.9);
      dirty = true;
    }
  });
  for (const kind of ["pointerup", "pointercancel"]) on(canvas, kind, event => fingers.delete(event.pointerId));
  on(canvas, "contextmenu", event => event.preventDefault());
  on(canvas, "wheel", event => {
    event.preventDefault();
    zoom(Math.exp(clamp(event.deltaY * (event.deltaMode ? 30 : 1), -300, 300) * (event.ctrlKey ? 0.01 : 0.0015)));
  }, {passive: false});
  on(canvas, "webglcontextlost", () => { $("title").textContent = "The graphics were lost; load the page again."; });
}

async function begin() {
  const asset = decode(await unpack($("asset").textContent));
  $("asset").remove();
  if (size.length) Object.assign($("view").style, {width: `${size[0]}px`, height: `${size[1] || size[0]}px`});
  renderer = new Renderer($("view"), asset);
  controls();
  settings();
  play(state.playing);
  const seconds = (ABOUT.end - ABOUT.start + 1) / ABOUT.fps;
  $("facts").textContent = `${asset.n.toLocaleString("en")} Gaussians` + (moves ? ` · ${seconds.toFixed(1)} s` : "");
  $("bar").classList.toggle("still", !moves);
  $("more").classList.toggle("still", !moves);
  $("bar").hidden = $("title").hidden = told.get("ui") === "0";
  show();
  $("said").remove();
  requestAnimationFrame(now => { before = now; tick(now); });
}

begin().catch(error => { $("view").hidden = true; $("said").textContent = error.message || String(error); });
