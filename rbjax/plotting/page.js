"use strict";
const film = JSON.parse(document.getElementById("data").textContent);
const $ = id => document.getElementById(id);
const canvas = $("view"), gl = canvas.getContext("webgl2", { antialias: true });
const FIELD = 28 * Math.PI / 180, SUN = [0.38, -0.5, 0.78], WIDTH = 2048;
const reach = Math.max(...film.size);
let azimuth = film.azimuth, elevation = film.elevation, zoom = 1, moved = [0, 0, 0];
let clock = 0, playing = true, last = null, rate = film.speed, dirty = true;

// Arrays are compressed by zlib, in base64.
async function unpack(text, Kind) {
  if (!text) return new Kind(0);
  const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Kind(await new Response(stream).arrayBuffer());
}

// Solids: a vertex follows its body, whose pose is between two frames. One instance a sample.
const SOLID = `
layout(location = 0) in vec3 point;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec4 color;
layout(location = 3) in uint body;
uniform highp sampler2D before, after;
uniform mat4 view;
uniform vec3 sun;
uniform float share, jump, ground, spread, fade;
uniform int bodies, first, samples;
uniform bool shadow;
out vec3 n;
out vec4 paint;
vec4 texel(highp sampler2D t, int i) { return texelFetch(t, ivec2(i & ${WIDTH - 1}, i / ${WIDTH}), 0); }
vec3 turned(vec4 q, vec3 v) { vec3 t = 2.0 * cross(q.yzw, v); return v + q.x * t + cross(q.yzw, t); }
vec2 cell(int i, int columns) { return vec2(i % columns, i / columns); }
void main() {
  vec3 x = point;
  n = normal;
  if (body != 65535u) {
    int k = 2 * (gl_InstanceID * bodies + int(body));
    vec3 p = texel(before, k).xyz, p1 = texel(after, k).xyz;
    vec4 q = texel(before, k + 1), q1 = texel(after, k + 1);
    float s = distance(p, p1) > jump ? 0.0 : share;  // a reset is not a motion
    q = normalize(mix(q, dot(q, q1) < 0.0 ? -q1 : q1, s));
    x = mix(p, p1, s) + turned(q, point);
    n = turned(q, normal);
    int one = first + gl_InstanceID, columns = int(ceil(sqrt(float(samples))));
    int middle = (samples / columns / 2) * columns + columns / 2;
    int place = one == 0 ? middle : one <= middle ? one - 1 : one;
    x.xy += spread * (cell(place, columns) - cell(middle, columns));
  }
  if (shadow) { x -= sun * ((x.z - ground) / sun.z); x.z = ground; }
  gl_Position = view * vec4(x, 1.0);
  paint = vec4(mix(color.rgb, vec3(1.0), fade), color.a);
}`;
const LIT = `
in vec3 n;
in vec4 paint;
uniform vec3 sun, eye;
uniform bool shadow;
out vec4 pixel;
void main() {
  if (shadow) { pixel = vec4(0.86, 0.88, 0.9, 1.0); return; }
  vec3 N = normalize(n);
  float light = 0.42 + 0.13 * N.z + 0.5 * max(dot(N, sun), 0.0);
  float shine = pow(max(dot(N, normalize(sun + eye)), 0.0), 40.0);
  pixel = vec4(paint.rgb * light + 0.12 * shine, paint.a);
}`;
// Arrows from start to end, and lines without heads. ring: cosine, sine, and which ring.
const ARROW = `
layout(location = 0) in vec3 ring;
layout(location = 1) in vec3 start;
layout(location = 2) in vec3 end;
uniform mat4 view;
uniform vec4 tint;
uniform float radius;
uniform bool head;
out vec3 n;
out vec4 paint;
void main() {
  vec3 d = end - start;
  float size = max(length(d), 1e-9), neck = size - (head ? min(7.0 * radius, 0.4 * size) : 0.0);
  d /= size;
  vec3 side = normalize(cross(d, abs(d.z) < 0.9 ? vec3(0, 0, 1) : vec3(1, 0, 0)));
  vec3 out_ = ring.x * side + ring.y * cross(d, side);
  float along = ring.z < 0.5 ? 0.0 : ring.z < 2.5 ? neck : size;
  float wide = ring.z < 1.5 ? 1.0 : ring.z < 2.5 ? (head ? 2.6 : 1.0) : 0.0;
  gl_Position = view * vec4(start + along * d + wide * radius * out_, 1.0);
  n = out_;
  paint = tint;
}`;
const GROUND = `
layout(location = 0) in vec2 corner;
uniform mat4 view;
uniform vec3 middle;
uniform float wide;
out vec2 at;
void main() { at = middle.xy + wide * corner; gl_Position = view * vec4(at, middle.z, 1.0); }`;
const GRID = `
in vec2 at;
uniform vec3 middle;
uniform float wide, space;
out vec4 pixel;
void main() {
  vec2 g = abs(fract(at / space - 0.5) - 0.5) / fwidth(at / space);
  float line = 1.0 - min(min(g.x, g.y), 1.0);
  float far = smoothstep(0.25, 0.95, distance(at, middle.xy) / wide);
  vec3 color = mix(vec3(0.957, 0.965, 0.973), vec3(0.83, 0.855, 0.88), line);
  pixel = vec4(mix(color, vec3(1.0), far), 1.0);
}`;

function program(vertex, fragment) {
  const made = gl.createProgram(), head = "#version 300 es\nprecision highp float;\nprecision highp int;\n";
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, head + text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw Error(gl.getProgramInfoLog(made));
  const at = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(made, i);
    at[name] = gl.getUniformLocation(made, name);
  }
  return { made, at };
}

function buffer(data, target = gl.ARRAY_BUFFER) {
  const made = gl.createBuffer();
  gl.bindBuffer(target, made);
  gl.bufferData(target, data, gl.STATIC_DRAW);
  return made;
}

async function mesh(given) {
  const array = gl.createVertexArray(), groups = {};
  gl.bindVertexArray(array);
  buffer(await unpack(given.vertices, Float32Array));
  gl.bindVertexArray(array);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 24, 0);
  gl.enableVertexAttribArray(1);
  gl.vertexAttribPointer(1, 3, gl.FLOAT, false, 24, 12);
  buffer(await unpack(given.colors, Uint8Array));
  gl.enableVertexAttribArray(2);
  gl.vertexAttribPointer(2, 4, gl.UNSIGNED_BYTE, true, 0, 0);
  buffer(await unpack(given.bodies, Uint16Array));
  gl.enableVertexAttribArray(3);
  gl.vertexAttribIPointer(3, 1, gl.UNSIGNED_SHORT, 0, 0);
  const parts = [];
  let count = 0;
  for (const [name, text] of Object.entries(given.triangles)) {
    const part = await unpack(text, Uint32Array);
    groups[name] = [4 * count, part.length];
    count += part.length;
    parts.push(part);
  }
  const all = new Uint32Array(count);
  parts.reduce((at, part) => { all.set(part, at); return at + part.length; }, 0);
  buffer(all, gl.ELEMENT_ARRAY_BUFFER);
  gl.bindVertexArray(null);
  return { array, groups };
}

// Poses of all bodies of some samples at two successive frames, as textures of two texels a body.
class Poses {
  constructor(samples, frames, read) {
    Object.assign(this, { samples, frames, read, at: [-1, -1], pair: [null, null] });
    this.rows = Math.max(1, Math.ceil(2 * samples * film.bodies / WIDTH));
    this.texels = new Float32Array(4 * WIDTH * this.rows);
  }
  bind(position) {
    const k = Math.min(this.frames - 1, Math.floor(position + 1e-6));
    [k, Math.min(this.frames - 1, k + 1)].forEach((frame, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      if (!this.pair[unit]) {
        gl.bindTexture(gl.TEXTURE_2D, this.pair[unit] = gl.createTexture());
        gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, WIDTH, this.rows);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      }
      gl.bindTexture(gl.TEXTURE_2D, this.pair[unit]);
      if (this.at[unit] === frame) return;
      this.read(frame, this.texels);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, this.rows, gl.RGBA, gl.FLOAT, this.texels);
      this.at[unit] = frame;
    });
    return Math.max(0, Math.min(1, position - k));
  }
}

function first(poses) {
  return new Poses(1, film.frames, (frame, out) => {
    for (let i = 0, k = 7 * frame * film.bodies; i < film.bodies; i++, k += 7) {
      out.set(poses.subarray(k, k + 3), 8 * i);
      out.set(poses.subarray(k + 3, k + 7), 8 * i + 4);
    }
  });
}

function others(given, bytes) {
  const row = 7 * (film.samples - 1) * film.bodies, n = bytes.length / 2, steps = new Int16Array(n);
  for (let i = 0; i < n; i++) steps[i] = bytes[i] | bytes[n + i] << 8;
  for (let i = row; i < steps.length; i++) steps[i] += steps[i - row];  // sums of 16 bits wrap around
  return new Poses(film.samples - 1, given.frames, (frame, out) => {
    for (let i = 0, k = row * frame; k < row * (frame + 1); i++, k += 7) {
      for (let j = 0; j < 3; j++) out[8 * i + j] = given.origin[j] + given.unit[j] * steps[k + j];
      for (let j = 0; j < 4; j++) out[8 * i + 4 + j] = steps[k + 3 + j] / 2047;
    }
  });
}

// The matrix (by columns) of a perspective view of a target, and the direction to the eye.
function camera(target) {
  const a = azimuth * Math.PI / 180, e = elevation * Math.PI / 180, aspect = canvas.width / canvas.height;
  const ca = Math.cos(a), sa = Math.sin(a), ce = Math.cos(e), se = Math.sin(e);
  const right = [-sa, ca, 0], up = [-se * ca, -se * sa, ce], back = [ce * ca, ce * sa, se];
  const half = 0.55 * Math.max(film.size[1] * 1.2, film.size[0] / aspect);
  const range = (half / Math.tan(FIELD / 2) + 0.35 * reach) / zoom;
  const f = 1 / Math.tan(FIELD / 2), near = 0.02 * range, far = 40 * range + 4 * reach;
  const dot = (u, v) => u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
  const depth = -dot(back, target) - range, A = (far + near) / (near - far), B = 2 * far * near / (near - far);
  const m = new Float32Array(16);
  for (let j = 0; j < 3; j++) {
    m.set([f / aspect * right[j], f * up[j], A * back[j], -back[j]], 4 * j);
  }
  m.set([-f / aspect * dot(right, target), -f * dot(up, target), A * depth + B, -depth], 12);
  return { matrix: m, right, up, back, range };
}

// A length of 1, 2 or 5 times a power of ten, not above the given one.
function even(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return power * [5, 2, 1].find(k => k * power <= length * 1.0000001);
}

const position = () => Math.min(film.frames - 1, clock / film.speed * film.fps);

function draw(scene) {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = Math.round(canvas.clientWidth * ratio);
  canvas.height = Math.round(canvas.clientHeight * ratio);
  const at = position(), frame = Math.floor(at + 1e-6), next = Math.min(film.frames - 1, frame + 1);
  const m = scene.middle, target = [0, 1, 2].map(j => scene.centre[j] + moved[j] +
    ($("follow").checked ? m[3 * frame + j] + (at - frame) * (m[3 * next + j] - m[3 * frame + j]) - m[j] : 0));
  const eye = camera(target), below = eye.back[2] < 0;
  const crowd = scene.ghosts && $("ghosts").checked;
  const spread = crowd ? 2 * reach * (+$("spread").value) ** 2 : 0;
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.clearColor(1, 1, 1, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  gl.disable(gl.BLEND);
  gl.depthMask(false);
  gl.disable(gl.DEPTH_TEST);
  const P = scene.grid;
  gl.useProgram(P.made);
  gl.uniformMatrix4fv(P.at.view, false, eye.matrix);
  gl.uniform3f(P.at.middle, target[0], target[1], film.floor);
  gl.uniform1f(P.at.wide, 2.2 * eye.range + spread * Math.sqrt(film.samples));
  gl.uniform1f(P.at.space, even(eye.range / 8));
  gl.bindVertexArray(scene.square);
  if (!below) gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);

  const S = scene.solid;
  gl.useProgram(S.made);
  gl.uniformMatrix4fv(S.at.view, false, eye.matrix);
  gl.uniform3fv(S.at.sun, SUN);
  gl.uniform3fv(S.at.eye, eye.back);
  gl.uniform1f(S.at.ground, film.floor);
  gl.uniform1f(S.at.jump, 0.5 * reach);
  gl.uniform1f(S.at.spread, spread);
  gl.uniform1i(S.at.bodies, film.bodies);
  gl.uniform1i(S.at.samples, film.samples);
  gl.uniform1i(S.at.after, 1);
  const paint = (who, groups, shadow) => {
    gl.uniform1f(S.at.share, who.poses.bind(who.first ? at / scene.every : at));
    gl.uniform1i(S.at.first, who.first);
    gl.uniform1f(S.at.fade, who.first && !spread ? 0.55 : 0);
    gl.uniform1i(S.at.shadow, shadow);
    gl.bindVertexArray(who.mesh.array);
    for (const name of groups) {
      const [start, count] = who.mesh.groups[name];
      const copies = name === "world" || name === "glass" ? 1 : who.poses.samples;
      if (name === "robot" && film.crowd && who.first) gl.enable(gl.CULL_FACE);  // closed hulls
      if (count) gl.drawElementsInstanced(gl.TRIANGLES, count, gl.UNSIGNED_INT, start, copies);
      gl.disable(gl.CULL_FACE);
    }
  };
  if (!below) {
    if (spread) paint(scene.ghosts, ["robot", "clear"], true);
    paint(scene.robot, ["robot", "clear"], true);
  }
  gl.depthMask(true);
  gl.enable(gl.DEPTH_TEST);
  paint(scene.robot, ["world"], false);
  if (crowd) paint(scene.ghosts, ["robot", "clear"], false);
  if (crowd && !spread) {  // the first sample is over the ghosts, but behind the world
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.colorMask(false, false, false, false);
    paint(scene.robot, ["world"], false);
    gl.colorMask(true, true, true, true);
  }
  paint(scene.robot, ["robot"], false);
  arrows(scene, frame, eye);
  gl.useProgram(S.made);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  gl.depthMask(false);
  paint(scene.robot, ["clear", "glass"], false);
  gl.depthMask(true);
  dirty = false;
  $("at").value = frame;
  $("time").textContent = `t = ${(film.start + at * film.speed / film.fps).toFixed(2)} s`;
}

function arrows(scene, frame, eye) {
  const P = scene.arrow, width = 6 * film.pushes, row = scene.arrows.subarray(frame * width, (frame + 1) * width);
  gl.useProgram(P.made);
  gl.uniformMatrix4fv(P.at.view, false, eye.matrix);
  gl.uniform3fv(P.at.sun, SUN);
  gl.uniform3fv(P.at.eye, eye.back);
  gl.bindVertexArray(scene.rods);
  const rods = (data, stride, radius, head, tint) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, scene.ends);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    gl.vertexAttribPointer(1, 3, gl.FLOAT, false, stride, 0);
    gl.vertexAttribPointer(2, 3, gl.FLOAT, false, stride, 12);
    gl.uniform1f(P.at.radius, radius);
    gl.uniform1i(P.at.head, head);
    gl.uniform4fv(P.at.tint, tint);
    const count = head ? data.length / 6 : data.length / 3 - 1;
    if (count > 0) gl.drawArraysInstanced(gl.TRIANGLES, 0, scene.corners, count);
  };
  if ($("forces").checked) {
    const real = [];
    for (let k = 0; k < row.length; k += 6) if (!Number.isNaN(row[k])) real.push(...row.subarray(k, k + 6));
    rods(new Float32Array(real), 24, 0.006 * reach, true, [...film.force.map(c => c / 255), 1]);
  }
  scene.paths.forEach((path, k) => {
    const tint = film.strong[k] ? [0.16, 0.44, 0.69, 1] : [0.81, 0.87, 0.93, 1];
    rods(path.subarray(0, 3 * (frame + 1)), 12, 0.003 * reach, false, tint);
  });
}

// A shaft and a head: three bands between four rings.
function rings() {
  const out = [], n = 14, at = (i, ring) => [Math.cos(2 * Math.PI * i / n), Math.sin(2 * Math.PI * i / n), ring];
  for (let ring = 0; ring < 3; ring++) for (let i = 0; i < n; i++) {
    for (const [j, r] of [[i, ring], [i + 1, ring], [i + 1, ring + 1], [i, ring], [i + 1, ring + 1], [i, ring + 1]]) {
      out.push(...at(j, r));
    }
  }
  return new Float32Array(out);
}

async function build() {
  const scene = { solid: program(SOLID, LIT), arrow: program(ARROW, LIT), grid: program(GROUND, GRID), every: 1 };
  scene.middle = await unpack(film.middle, Float32Array);
  scene.centre = await unpack(film.centre, Float32Array);
  scene.arrows = await unpack(film.arrows, Float32Array);
  scene.paths = await Promise.all(film.paths.map(text => unpack(text, Float32Array)));
  const whole = await mesh(film.robot);
  scene.robot = { mesh: whole, first: 0, poses: first(await unpack(film.poses, Float32Array)) };
  if (film.ghosts) {
    const few = film.crowd ? await mesh(film.crowd) : whole;
    scene.every = film.ghosts.every;
    scene.ghosts = { mesh: few, first: 1, poses: others(film.ghosts, await unpack(film.ghosts.poses, Uint8Array)) };
  }
  scene.square = gl.createVertexArray();
  gl.bindVertexArray(scene.square);
  buffer(new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]));
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
  const ring = rings();
  scene.corners = ring.length / 3;
  scene.rods = gl.createVertexArray();
  gl.bindVertexArray(scene.rods);
  buffer(ring);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
  scene.ends = gl.createBuffer();
  for (const k of [1, 2]) {
    gl.enableVertexAttribArray(k);
    gl.vertexAttribDivisor(k, 1);
  }
  return scene;
}

function play(on) {
  playing = on;
  $("play").textContent = on ? "stop" : "play";
}

function controls() {
  const redraw = () => { dirty = true; };
  const seek = frame => {
    play(false);
    clock = Math.max(0, Math.min(film.frames - 1, frame)) * film.speed / film.fps;
    redraw();
  };
  $("at").max = film.frames - 1;
  $("at").oninput = () => seek(+$("at").value);
  $("play").onclick = () => play(!playing);
  for (const k of [0.1, 0.25, 0.5, 1, 2, 4]) {
    const option = document.createElement("option");
    option.value = k * film.speed;
    option.textContent = `${+(k * film.speed).toPrecision(3)} x`;
    option.selected = k === 1;
    $("rate").append(option);
  }
  $("rate").onchange = () => { rate = +$("rate").value; };
  $("follow").checked = film.follow;
  $("withforces").hidden = !film.pushes;
  $("withghosts").hidden = $("withspread").hidden = film.samples < 2;
  $("count").textContent = `${(film.samples - 1).toLocaleString("en")} ghosts`;
  for (const name of ["follow", "forces", "ghosts", "spread"]) $(name).oninput = redraw;
  canvas.onpointerdown = e => canvas.setPointerCapture(e.pointerId);
  canvas.oncontextmenu = e => e.preventDefault();
  canvas.onpointermove = e => {
    if (!e.buttons) return;
    if (e.shiftKey || e.buttons > 1) {
      const eye = camera([0, 0, 0]), unit = 2 * eye.range * Math.tan(FIELD / 2) / canvas.clientHeight;
      moved = moved.map((x, j) => x + unit * (e.movementY * eye.up[j] - e.movementX * eye.right[j]));
    } else {
      azimuth -= 0.4 * e.movementX;
      elevation = Math.max(-89, Math.min(89, elevation + 0.4 * e.movementY));
    }
    redraw();
  };
  canvas.addEventListener("wheel", e => {
    e.preventDefault();
    zoom = Math.max(0.02, Math.min(20, zoom * Math.exp(-0.001 * e.deltaY)));
    redraw();
  }, { passive: false });
  canvas.ondblclick = () => {
    azimuth = film.azimuth; elevation = film.elevation; zoom = 1; moved = [0, 0, 0];
    redraw();
  };
  window.onkeydown = e => {
    if (e.key === " " && e.target.tagName !== "BUTTON") { e.preventDefault(); play(!playing); }
    const by = { ArrowLeft: -1, ArrowRight: 1 }[e.key];
    if (by && e.target.tagName !== "INPUT") seek(Math.round(position()) + by);
  };
  window.onresize = redraw;
}

async function main() {
  if (!gl) throw Error("This page needs WebGL 2, which this browser does not have or has switched off.");
  const scene = await build(), lasts = film.frames / film.fps * film.speed;  // s of motion
  controls();
  const tick = now => {
    if (playing && last !== null && film.frames > 1) {
      clock += rate * (now - last) / 1000;
      if (clock > lasts + 0.7 * rate) clock = 0;  // a rest before it starts again
      dirty = true;
    }
    last = now;
    if (dirty) draw(scene);
    document.body.dataset.ready = "yes";
    requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
}

main().catch(error => {
  $("error").hidden = false;
  $("error").textContent = error.message;
  document.body.dataset.ready = "error";
});
