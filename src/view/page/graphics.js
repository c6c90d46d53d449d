// Graphics: what the page is sent, drawn with WebGL2. Positions arrive in the state frame (the hips),
// quantised; the vertex shader places them. Nothing is done per vertex outside the graphics card.

const DECODE_NORMAL = `
vec3 unfold(vec2 f) {
  vec3 n = vec3(f, 1.0 - abs(f.x) - abs(f.y));
  float t = max(-n.z, 0.0);
  n.xy -= vec2(n.x < 0.0 ? -t : t, n.y < 0.0 ? -t : t);
  return dot(n, n) > 0.0 ? normalize(n) : vec3(0.0, 1.0, 0.0);
}
vec3 turned(vec4 q, vec3 v) { return v + 2.0 * cross(q.xyz, cross(q.xyz, v) + q.w * v); }`;

const CLOTH = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec2 folded;
layout(location = 2) in float share;
uniform mat4 camera;
uniform vec4 turn;
uniform vec3 shift;
uniform float scale;
out vec3 world;
out vec3 normal;
out float distant;
${DECODE_NORMAL}
void main() {
  world = turned(turn, position * scale) + shift;
  normal = turned(turn, unfold(folded));
  distant = share;
  gl_Position = camera * vec4(world, 1.0);
}`;

// The body is drawn a few millimetres behind where it is: merging and lossy coding move cloth by more
// than the gap that contact keeps, and skin that pokes through by a hair is seen at once.
const BODY = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 rest;
layout(location = 2) in vec4 weights;
layout(location = 3) in uvec4 joints;
uniform mat4 camera;
uniform vec3 eye;
uniform highp sampler2D bones;
out vec3 world;
out vec3 normal;
out float distant;
mat3x4 bone(uint joint) {
  int at = int(joint) * 3;
  return mat3x4(texelFetch(bones, ivec2(at, 0), 0), texelFetch(bones, ivec2(at + 1, 0), 0),
    texelFetch(bones, ivec2(at + 2, 0), 0));
}
void main() {
  mat3x4 moved = weights.x * bone(joints.x) + weights.y * bone(joints.y)
    + weights.z * bone(joints.z) + weights.w * bone(joints.w);
  world = vec4(position, 1.0) * moved;
  normal = vec4(rest, 0.0) * moved;
  distant = 0.0;
  vec3 away = world - eye;
  gl_Position = camera * vec4(world + away * (0.008 / max(length(away), 0.1)), 1.0);
}`;

const SURFACE = `#version 300 es
precision highp float;
in vec3 world;
in vec3 normal;
in float distant;
uniform vec3 eye;
uniform vec3 colour;
uniform vec3 lining;
uniform float tinted;
out vec4 shown;
vec3 heat(float t) {
  vec3 cold = vec3(0.16, 0.22, 0.42), warm = vec3(0.93, 0.66, 0.25), hot = vec3(0.86, 0.16, 0.2);
  return t < 0.5 ? mix(cold, warm, t * 2.0) : mix(warm, hot, t * 2.0 - 1.0);
}
void main() {
  vec3 n = normalize(normal) * (gl_FrontFacing ? 1.0 : -1.0);
  vec3 look = normalize(eye - world);
  vec3 base = gl_FrontFacing ? colour : lining;
  base = mix(base, heat(distant), tinted);
  float key = max(dot(n, normalize(vec3(0.45, 0.8, 0.4))), 0.0);
  float fill = max(dot(n, normalize(vec3(-0.7, 0.25, -0.1))), 0.0);
  float sky = 0.5 + 0.5 * n.y;
  float rim = pow(1.0 - max(dot(n, look), 0.0), 3.0);
  vec3 light = vec3(1.0, 0.95, 0.88) * key * 0.85 + vec3(0.5, 0.6, 0.8) * fill * 0.25
    + mix(vec3(0.16, 0.14, 0.13), vec3(0.34, 0.37, 0.43), sky);
  shown = vec4(pow(base * light + rim * 0.07, vec3(0.85)), 1.0);
}`;

// Seen from above, what is near the ground darkens it.
const SHADE = `#version 300 es
precision highp float;
in vec3 world;
in vec3 normal;
in float distant;
out vec4 shown;
void main() { shown = vec4(exp(-2.2 * max(world.y, 0.0))); }`;

const GROUND = `#version 300 es
layout(location = 0) in vec2 corner;
uniform mat4 camera;
uniform vec3 centre;
out vec3 world;
void main() {
  world = vec3(centre.x + corner.x * 30.0, 0.0, centre.z + corner.y * 30.0);
  gl_Position = camera * vec4(world, 1.0);
}`;

const FLOOR = `#version 300 es
precision highp float;
in vec3 world;
uniform vec3 centre;
uniform vec3 back;
uniform float reach;
uniform sampler2D shade;
out vec4 shown;
void main() {
  vec2 at = (world.xz - centre.xz) / (2.0 * reach) + 0.5;
  float dark = 0.0;
  if (all(greaterThan(at, vec2(0.0))) && all(lessThan(at, vec2(1.0)))) {
    for (int i = 0; i < 9; i++) {
      vec2 tap = vec2(float(i % 3 - 1), float(i / 3 - 1)) * 0.011;
      dark += texture(shade, at + tap).r * (i == 4 ? 0.2 : 0.1);
    }
  }
  vec2 line = abs(fract(world.xz - 0.5) - 0.5) / max(fwidth(world.xz), vec2(1e-4));
  float grid = 1.0 - min(min(line.x, line.y), 1.0);
  float far = length(world.xz - centre.xz);
  vec3 ground = vec3(0.215, 0.22, 0.25) + grid * 0.05;
  ground *= 1.0 - 0.62 * dark;
  shown = vec4(mix(ground, back, smoothstep(2.0 + reach, 9.0 + 2.0 * reach, far)), 1.0);
}`;

const BACK = [0.09, 0.094, 0.114];
const CLOTH_COLOURS = [[0.33, 0.47, 0.74], [0.7, 0.42, 0.36], [0.36, 0.6, 0.5], [0.66, 0.58, 0.36]];

function compile(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
    const logs = gl.getAttachedShaders(program).map(s => gl.getShaderInfoLog(s)).join("\n");
    throw new Error(`a shader does not compile: ${logs}`);
  }
  const at = {};
  const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS);
  for (let i = 0; i < count; i++) {
    const { name } = gl.getActiveUniform(program, i);
    at[name] = gl.getUniformLocation(program, name);
  }
  return { program, at };
}

// Column-major 4 x 4 matrices, as WebGL takes them.
function product(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++) {
    for (let r = 0; r < 4; r++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) sum += a[k * 4 + r] * b[c * 4 + k];
      out[c * 4 + r] = sum;
    }
  }
  return out;
}

function perspective(height, aspect, near, far) {
  const f = 1 / Math.tan(height / 2);
  const z = 1 / (near - far);
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) * z, -1, 0, 0, 2 * far * near * z, 0];
}

function looking(eye, at) {
  const unit = v => { const l = Math.hypot(...v) || 1; return v.map(x => x / l); };
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const z = unit([0, 1, 2].map(i => eye[i] - at[i]));
  const x = unit(cross([0, 1, 0], z));
  const y = cross(z, x);
  return [x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0,
    -dot(x, eye), -dot(y, eye), -dot(z, eye), 1];
}

// From above, `reach` metres around the middle.
function above(centre, reach) {
  const s = 1 / reach;
  return new Float32Array([s, 0, 0, 0, 0, 0, 0.1, 0, 0, s, 0, 0, -s * centre[0], -s * centre[2], -0.5, 1]);
}

const SHADE_SIZE = 256;

class Graphics {
  constructor(canvas) {
    this.canvas = canvas;
    const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL2, which the page needs to draw");
    this.gl = gl;
    this.programs = {
      cloth: compile(gl, CLOTH, SURFACE), body: compile(gl, BODY, SURFACE),
      clothShade: compile(gl, CLOTH, SHADE), bodyShade: compile(gl, BODY, SHADE),
      floor: compile(gl, GROUND, FLOOR),
    };
    this.shade = this.makeShade();
    this.plane = gl.createVertexArray();
    gl.bindVertexArray(this.plane);
    this.fill(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]));
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    gl.bindVertexArray(null);
    this.meshes = null;
    this.buffers = [];
    this.figures = [];
    this.slots = [];
    this.orbit = { yaw: 0.5, pitch: 0.14, distance: 3.6 };
    this.middles = [];
  }

  fill(target, data, usage = this.gl.STATIC_DRAW) {
    const buffer = this.gl.createBuffer();
    this.gl.bindBuffer(target, buffer);
    this.gl.bufferData(target, data, usage);
    return buffer;
  }

  makeShade() {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, SHADE_SIZE, SHADE_SIZE);
    for (const [key, value] of [[gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
      [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE]]) {
      gl.texParameteri(gl.TEXTURE_2D, key, value);
    }
    const frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return { texture, frame };
  }

  // Meshes come once, and again with another garment.
  takeMeshes(bytes) {
    const { gl } = this;
    const [, vertices, triangles, bodyVertices, bodyTriangles, joints] = new Uint32Array(bytes, 0, 6);
    let at = 24;
    const take = (kind, count) => {
      const part = new kind(bytes, at, count);
      at += part.byteLength;
      return part;
    };
    for (const slot of this.slots) this.drop(slot);
    this.slots = [];
    this.figures = [];
    gl.bindVertexArray(null);
    for (const buffer of this.buffers) gl.deleteBuffer(buffer);
    if (this.meshes) gl.deleteVertexArray(this.meshes.body);
    const indices = this.fill(gl.ELEMENT_ARRAY_BUFFER, take(Uint32Array, 3 * triangles));
    this.buffers = [indices];
    const body = gl.createVertexArray();
    if (bodyVertices > 0) {
      const positions = take(Float32Array, 3 * bodyVertices);
      const weights = take(Float32Array, 4 * bodyVertices);
      const bones = take(Uint16Array, 4 * bodyVertices);
      const faces = take(Uint32Array, 3 * bodyTriangles);
      gl.bindVertexArray(body);
      const floats = [[positions, 3], [restNormals(positions, faces), 3], [weights, 4]];
      floats.forEach(([data, size], index) => {
        this.buffers.push(this.fill(gl.ARRAY_BUFFER, data));
        gl.enableVertexAttribArray(index);
        gl.vertexAttribPointer(index, size, gl.FLOAT, false, 0, 0);
      });
      this.buffers.push(this.fill(gl.ARRAY_BUFFER, bones));
      gl.enableVertexAttribArray(3);
      gl.vertexAttribIPointer(3, 4, gl.UNSIGNED_SHORT, 0, 0);
      this.buffers.push(this.fill(gl.ELEMENT_ARRAY_BUFFER, faces));
      gl.bindVertexArray(null);
    }
    this.meshes = { vertices, triangles, indices, body, bodyTriangles, joints };
  }

  // Buffers of one character.
  slot(index) {
    const { gl, meshes } = this;
    if (this.slots[index]) return this.slots[index];
    const vertices = gl.createVertexArray();
    gl.bindVertexArray(vertices);
    const cloth = this.fill(gl.ARRAY_BUFFER, 8 * meshes.vertices, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.SHORT, true, 8, 0);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribPointer(1, 2, gl.BYTE, true, 8, 6);
    const shares = this.fill(gl.ARRAY_BUFFER, meshes.vertices, gl.DYNAMIC_DRAW);
    gl.vertexAttribPointer(2, 1, gl.UNSIGNED_BYTE, true, 1, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, meshes.indices);
    gl.bindVertexArray(null);
    const bones = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, bones);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, Math.max(3 * meshes.joints, 1), 1);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    this.slots[index] = { vertices, cloth, shares, bones };
    return this.slots[index];
  }

  drop(slot) {
    this.gl.deleteVertexArray(slot.vertices);
    this.gl.deleteBuffer(slot.cloth);
    this.gl.deleteBuffer(slot.shares);
    this.gl.deleteTexture(slot.bones);
  }

  takeFrame(bytes) {
    const { gl, meshes } = this;
    if (!meshes) return;
    const [, count] = new Uint32Array(bytes, 0, 2);
    let at = 8;
    this.figures = [];
    for (let index = 0; index < count; index++) {
      const [pane, vertices, flags] = new Uint32Array(bytes, at, 3);
      const [scale, ...placed] = new Float32Array(bytes, at + 12, 8);
      at += 44;
      if (vertices !== meshes.vertices) return;
      const slot = this.slot(index);
      const hasBody = (flags & 1) !== 0;
      if (hasBody) {
        const bones = new Float32Array(bytes, at, 12 * meshes.joints);
        at += bones.byteLength;
        gl.bindTexture(gl.TEXTURE_2D, slot.bones);
        gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 3 * meshes.joints, 1, gl.RGBA, gl.FLOAT, bones);
      }
      gl.bindBuffer(gl.ARRAY_BUFFER, slot.cloth);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, new Uint8Array(bytes, at, 8 * vertices));
      at += 8 * vertices;
      const tinted = (flags & 2) !== 0;
      if (tinted) {
        gl.bindBuffer(gl.ARRAY_BUFFER, slot.shares);
        gl.bufferSubData(gl.ARRAY_BUFFER, 0, new Uint8Array(bytes, at, vertices));
        at += Math.ceil(vertices / 4) * 4;
      }
      this.figures.push({ pane, scale, turn: placed.slice(0, 4), shift: placed.slice(4), hasBody, tinted, slot });
    }
  }

  // Where a pane's camera looks: after its characters, gently, and as fast as they go, so that they stay in the middle.
  middle(pane, figures) {
    const sum = [0, 0, 0];
    for (const { shift } of figures) shift.forEach((x, i) => { sum[i] += x / figures.length; });
    const now = this.middles[pane];
    if (!now || Math.hypot(now[0] - sum[0], now[2] - sum[2]) > 2) {
      this.middles[pane] = Object.assign(sum.slice(), { sum, speed: [0, 0, 0] });
    } else if (this.seconds > 0) {
      // As gentle at 10 frames a second as at 100.
      const near = speed => 1 - Math.exp(-speed * this.seconds);
      for (const i of [0, 1, 2]) {
        const goes = i === 1 ? 0 : (sum[i] - now.sum[i]) / this.seconds;
        now.speed[i] += (goes - now.speed[i]) * near(6);
        now[i] += now.speed[i] * this.seconds;
        now[i] += (sum[i] - now[i]) * near(i === 1 ? 2 : 8);
      }
      now.sum = sum;
    }
    return this.middles[pane];
  }

  draw() {
    const { gl, canvas } = this;
    const time = performance.now();
    this.seconds = Math.min((time - (this.drawnAt || time)) / 1000, 1);
    this.drawnAt = time;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map(x => Math.max(1, Math.round(x * ratio)));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(...BACK, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const panes = 1 + Math.max(0, ...this.figures.map(f => f.pane));
    for (let pane = 0; pane < panes; pane++) {
      const figures = this.figures.filter(f => f.pane === pane);
      if (!figures.length) continue;
      const left = Math.round(width * pane / panes);
      const right = Math.round(width * (pane + 1) / panes);
      this.drawPane(figures, this.middle(pane, figures), [left, 0, right - left, height]);
    }
    return panes;
  }

  drawPane(figures, middle, [left, bottom, width, height]) {
    const { gl, orbit } = this;
    const spread = Math.max(0, ...figures.map(f => Math.hypot(f.shift[0] - middle[0], f.shift[2] - middle[2])));
    const reach = 1.5 + spread;
    this.drawShade(figures, middle, reach);
    gl.enable(gl.SCISSOR_TEST);
    gl.enable(gl.DEPTH_TEST);
    gl.viewport(left, bottom, width, height);
    gl.scissor(left, bottom, width, height);
    // Narrow panes see as much from further away.
    const distance = orbit.distance * (1 + 0.75 * spread) * Math.max(1, 0.62 * height / width);
    const at = [middle[0], Math.max(0.78, middle[1] - 0.12), middle[2]];
    const eye = [at[0] + distance * Math.cos(orbit.pitch) * Math.sin(orbit.yaw),
      Math.max(0.05, at[1] + distance * Math.sin(orbit.pitch)),
      at[2] + distance * Math.cos(orbit.pitch) * Math.cos(orbit.yaw)];
    const camera = product(perspective(0.62, width / height, 0.1, 80), looking(eye, at));
    this.drawFloor(camera, middle, reach);
    this.drawFigures(figures, camera, eye, this.programs.body, this.programs.cloth);
    gl.disable(gl.SCISSOR_TEST);
  }

  drawShade(figures, middle, reach) {
    const { gl, shade } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, shade.frame);
    gl.viewport(0, 0, SHADE_SIZE, SHADE_SIZE);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendEquation(gl.MAX);
    const eye = [middle[0], 50, middle[2]];
    this.drawFigures(figures, above(middle, reach), eye, this.programs.bodyShade, this.programs.clothShade);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  drawFloor(camera, middle, reach) {
    const { gl } = this;
    const { program, at } = this.programs.floor;
    gl.useProgram(program);
    gl.uniformMatrix4fv(at.camera, false, camera);
    gl.uniform3f(at.centre, ...middle);
    gl.uniform3f(at.back, ...BACK);
    gl.uniform1f(at.reach, reach);
    gl.bindTexture(gl.TEXTURE_2D, this.shade.texture);
    gl.bindVertexArray(this.plane);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }

  drawFigures(figures, camera, eye, bodies, cloths) {
    const { gl, meshes } = this;
    const begin = ({ program, at }) => {
      gl.useProgram(program);
      gl.uniformMatrix4fv(at.camera, false, camera);
      if (at.eye) gl.uniform3f(at.eye, ...eye);
    };
    begin(bodies);
    if (bodies.at.colour) {
      gl.uniform3f(bodies.at.colour, 0.8, 0.67, 0.58);
      gl.uniform3f(bodies.at.lining, 0.5, 0.4, 0.36);
      gl.uniform1f(bodies.at.tinted, 0);
    }
    gl.bindVertexArray(meshes.body);
    for (const figure of figures.filter(f => f.hasBody)) {
      gl.bindTexture(gl.TEXTURE_2D, figure.slot.bones);
      gl.drawElements(gl.TRIANGLES, 3 * meshes.bodyTriangles, gl.UNSIGNED_INT, 0);
    }
    begin(cloths);
    figures.forEach((figure, index) => {
      gl.uniform4f(cloths.at.turn, ...figure.turn);
      gl.uniform3f(cloths.at.shift, ...figure.shift);
      gl.uniform1f(cloths.at.scale, figure.scale);
      if (cloths.at.colour) {
        const colour = CLOTH_COLOURS[figures.length > 1 ? index % CLOTH_COLOURS.length : 0];
        gl.uniform3f(cloths.at.colour, ...colour);
        gl.uniform3f(cloths.at.lining, ...colour.map(x => x * 0.55));
        gl.uniform1f(cloths.at.tinted, figure.tinted ? 1 : 0);
      }
      gl.bindVertexArray(figure.slot.vertices);
      if (figure.tinted) gl.enableVertexAttribArray(2);
      else gl.disableVertexAttribArray(2);
      gl.drawElements(gl.TRIANGLES, 3 * meshes.triangles, gl.UNSIGNED_INT, 0);
    });
    gl.bindVertexArray(null);
  }
}

// Of the body as it was bound, by area; skinning turns them with it.
function restNormals(positions, faces) {
  const normals = new Float32Array(positions.length);
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [faces[f] * 3, faces[f + 1] * 3, faces[f + 2] * 3];
    const [ux, uy, uz] = [0, 1, 2].map(i => positions[b + i] - positions[a + i]);
    const [vx, vy, vz] = [0, 1, 2].map(i => positions[c + i] - positions[a + i]);
    const n = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
    for (const v of [a, b, c]) n.forEach((x, i) => { normals[v + i] += x; });
  }
  for (let v = 0; v < normals.length; v += 3) {
    const length = Math.hypot(normals[v], normals[v + 1], normals[v + 2]) || 1;
    for (let i = 0; i < 3; i++) normals[v + i] /= length;
  }
  return normals;
}
