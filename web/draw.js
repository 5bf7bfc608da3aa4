// Draws a scene by WebGL2, by the model of docs/conventions.md: quads, farthest first, into
// half-float buffers, then one pass that puts the backdrop, the words' colours or a depth picture
// on the canvas.
const ROW = 2048; // Gaussians a row of the texture
const TINTS = [
  [0.96, 0.36, 0.1],
  [0.1, 0.55, 0.98],
  [0.35, 0.75, 0.2],
  [0.85, 0.3, 0.85],
];

// Each Gaussian on the picture, once a frame: centre; the longer axis of its ellipse, one standard
// deviation long, the length of the other one, and opacity.
const PROJECT = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D; precision highp sampler2D;
uniform usampler2D packed; uniform sampler2D photos;
uniform mat3 turn; uniform vec3 eye; uniform vec4 lens; uniform vec2 size;
uniform float near, extent; uniform bool antialiased;
layout(location = 0) out vec4 place; layout(location = 1) out vec4 shape;
float half15(uint q) { return (float(q & 0x7fffu) / 32767. - .5) * 1.41421356; }
void main() {
  place = shape = vec4(0.);
  ivec2 cell = ivec2(gl_FragCoord.xy) * ivec2(2, 1);
  uvec4 a = texelFetch(packed, cell, 0), b = texelFetch(packed, cell + ivec2(1, 0), 0);
  vec3 mean = uintBitsToFloat(a.xyz), t = turn * (mean - eye);
  if (t.z < near) return;
  float opacity = float(a.w >> 24) / 255.;
  // Scales and rotation.
  vec3 s = exp(vec3(b.x & 0xffffu, b.x >> 16, b.y & 0xffffu) / 65535. * 20. - 16.) * extent;
  uint q0 = b.y >> 16, q1 = b.z & 0xffffu, left = (q0 >> 15) | (q1 >> 15) << 1;
  vec3 v = vec3(half15(q0), half15(q1), half15(b.z >> 16));
  float w = sqrt(max(0., 1. - dot(v, v)));
  vec4 q = left == 0u ? vec4(w, v) : left == 1u ? vec4(v.x, w, v.yz)
    : left == 2u ? vec4(v.xy, w, v.z) : vec4(v, w);
  mat3 r = mat3(
    1. - 2. * (q.z * q.z + q.w * q.w), 2. * (q.y * q.z + q.x * q.w), 2. * (q.y * q.w - q.x * q.z),
    2. * (q.y * q.z - q.x * q.w), 1. - 2. * (q.y * q.y + q.w * q.w), 2. * (q.z * q.w + q.x * q.y),
    2. * (q.y * q.w + q.x * q.z), 2. * (q.z * q.w - q.x * q.y), 1. - 2. * (q.y * q.y + q.z * q.z));
  // What the blur lost where the view magnifies the photo, or the blur where it shows it smaller.
  int photo = int(b.w & 0xffffu);
  vec4 p0 = texelFetch(photos, ivec2(0, photo), 0), p1 = texelFetch(photos, ivec2(1, photo), 0);
  float wide = max(dot(mean - p0.xyz, p1.xyz), 0.) * p0.w;
  float p = wide * max(lens.x, lens.y) / t.z / 1.25;
  if (p > 1.) s = sqrt(s * s + .3 * wide * wide * (1. - 1. / (p * p)));
  float seen = wide > 0. && !antialiased ? min(p * 1.5625, 1.) : 1.;
  float learnt = .3 * seen * seen, blur = learnt + (1. - seen * seen) / 12.;
  // The Jacobian at the centre, clamped to the widened frustum.
  vec2 margin = .15 * size / lens.xy;
  vec2 c = clamp(t.xy / t.z, -lens.zw / lens.xy - margin, (size - lens.zw) / lens.xy + margin);
  mat3 m = turn * r;
  mat3 scaled = mat3(m[0] * s.x, m[1] * s.y, m[2] * s.z);
  vec2 f = lens.xy / t.z;
  vec3 row0 = vec3(f.x, 0., -f.x * c.x) * scaled, row1 = vec3(0., f.y, -f.y * c.y) * scaled;
  float xx = dot(row0, row0) + blur, xy = dot(row0, row1), yy = dot(row1, row1) + blur;
  float middle = .5 * (xx + yy), apart = length(vec2(.5 * (xx - yy), xy));
  float angle = .5 * atan(2. * xy, xx - yy);
  if (apart == 0.) angle = 0.;
  vec2 axis = vec2(cos(angle), sin(angle));
  // The smaller one as a product over the larger: it stays exact for needles.
  float large = middle + apart;
  vec3 area = cross(row0, row1);
  float sharp = dot(area, area), wides = xx + yy - 2. * blur;
  float small = (sharp + blur * (wides + blur)) / large;
  // What the blur adds to small ones, taken off again.
  if (antialiased) opacity *= sqrt(sharp / (large * small));
  else if (seen < 1.) {
    float share = sqrt((sharp + learnt * (wides + learnt)) / (large * small));
    opacity -= (1. - share) * (opacity - 1. / 255.);
  }
  place.xy = f * t.xy + lens.zw;
  vec2 sides = min(sqrt(vec2(large, small)), 6e4); // as halves hold
  shape = vec4(axis * sides.x, sides.y, opacity);
}`;

// Four corners of a quad around the ellipse where alpha is 1/255.
const QUADS = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D; precision highp sampler2D;
uniform usampler2D packed, order; uniform sampler2D places, shapes, scores;
uniform vec2 size; uniform vec3 eye, ahead;
out vec2 at; flat out vec4 tint; flat out vec4 score; flat out vec2 more;
void main() {
  gl_Position = vec4(2., 2., 2., 1.);
  int quad = gl_VertexID / 6, k = gl_VertexID % 6;
  uint gaussian = texelFetch(order, ivec2(quad & 2047, quad >> 11), 0).x;
  ivec2 cell = ivec2(gaussian & 2047u, gaussian >> 11);
  vec4 shape = texelFetch(shapes, cell, 0);
  if (shape.w < 1. / 255.) return;
  if (k > 2) k -= 2; // two triangles: 0 1 2 and 1 2 3
  vec2 corner = vec2(k & 1, k >> 1) * 2. - 1.;
  at = corner * sqrt(2. * log(shape.w * 255.) + 2e-4);
  vec2 across = normalize(vec2(-shape.y, shape.x)) * shape.z;
  vec2 spot = texelFetch(places, cell, 0).xy + shape.xy * at.x + across * at.y;
  gl_Position = vec4(spot / size * vec2(2., -2.) + vec2(-1., 1.), 0., 1.);
  uvec4 a = texelFetch(packed, cell * ivec2(2, 1), 0);
  tint = vec4(vec3(uvec3(a.w) >> uvec3(0, 8, 16) & 255u) / 255., shape.w);
  score = vec4(0.);
  more = vec2(dot(ahead, uintBitsToFloat(a.xyz) - eye), 0.);
#ifdef MORE
  int entry = int(texelFetch(packed, cell * ivec2(2, 1) + ivec2(1, 0), 0).w >> 16);
  score = texelFetch(scores, ivec2(entry & 255, entry >> 8), 0);
  more.y = entry > 0 ? 1. : 0.;
#endif
}`;

const BLEND = `#version 300 es
precision highp float;
in vec2 at; flat in vec4 tint; flat in vec4 score; flat in vec2 more;
layout(location = 0) out vec4 color;
#ifdef MORE
layout(location = 1) out vec4 first; layout(location = 2) out vec4 second;
#endif
void main() {
  float a = min(.999, tint.a * exp(-.5 * dot(at, at)));
  if (a < 1. / 255.) discard;
  color = vec4(tint.rgb * a, a);
#ifdef MORE
  first = vec4(score.xyz * a, a);
  second = vec4(more.x * a, more.y * a, score.w * a, a);
#endif
}`;

const WHOLE = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4. - 1., 0., 1.); }`;

const SHOW = `#version 300 es
precision highp float; precision highp sampler2D;
uniform sampler2D blended, first, second, backdrop;
uniform mat3 turn; uniform vec4 lens; uniform vec2 size; uniform int kind, words;
uniform ivec2 corner; uniform vec4 margins; uniform float floorOf;
uniform vec3 colors[4], fog; uniform bool sky;
out vec4 shown;
void main() {
  ivec2 cell = ivec2(gl_FragCoord.xy) - corner;
  vec2 place = vec2(cell.x, int(size.y) - 1 - cell.y) + .5;
  vec4 sum = texelFetch(blended, cell, 0);
  vec4 more = texelFetch(second, cell, 0), scores = vec4(texelFetch(first, cell, 0).xyz, more.z);
  vec3 behind = vec3(0.);
  if (sky) {
    vec3 ray = vec3((place - lens.zw) / lens.xy, 1.) * turn;
    vec2 uv = vec2(atan(ray.x, ray.z) / 6.2831853, atan(ray.y, length(ray.xz)) / 3.14159265) + .5;
    vec4 far = textureLod(backdrop, uv, 0.);
    behind = mix(fog, far.rgb, far.a); // what no photo saw fades
  }
  vec3 c = sum.rgb + (1. - sum.a) * behind;
  int best = -1;
  float most = 0.;
  for (int k = 0; k < words; k++) {
    float over = scores[k] - margins[k] * more.y;
    if (more.y >= floorOf && over >= 0. && (over > most || best < 0)
      && (over > 0. || margins[k] != 0.)) { best = k; most = over; }
  }
  if (kind == 1) c = vec3(sum.a > 0. ? 1. / (1. + .6 * more.x / sum.a) : 0.);
  if (kind == 2) c = vec3(sum.a);
  if (kind == 3) c = vec3(best >= 0 ? 1. : 0.);
  else if (best >= 0) c = mix(c, colors[best], .55);
  else if (words > 0) c = mix(fog, c, .5);
  shown = vec4(c, 1.);
}`;

class Drawing {
  // changed() asks for a frame. lost(true) says that the device dropped all that was on it, and
  // lost(false) that it is back, with nothing on it.
  constructor(canvas, changed, lost) {
    this.canvas = canvas;
    this.changed = changed;
    this.lost = false;
    this.sent = this.done = this.stale = 0; // numbers of sorts
    this.waiting = [];
    this.asking = []; // who waits for what the worker measures, in turn
    this.fog = [0, 0, 0]; // what a direction fades to that no photo saw
    this.gl = canvas.getContext('webgl2', { alpha: false, antialias: false });
    canvas.addEventListener('webglcontextlost', (e) => {
      e.preventDefault();
      this.lost = true;
      lost(true);
    });
    canvas.addEventListener('webglcontextrestored', () => {
      this.lost = false;
      this.setup();
      lost(false);
    });
    this.worker = startSorter();
    this.worker.onmessage = ({ data }) =>
      'measured' in data ? this.asking.shift()(data.measured) : this.sorted(data);
    this.setup();
  }

  // What is on the device, without a scene.
  setup() {
    const gl = this.gl;
    if (!gl || !gl.getExtension('EXT_color_buffer_float')) {
      throw new Error(t('device.old'));
    }
    const more = (text) => text.replace('es\n', 'es\n#define MORE\n');
    this.project = this.program(WHOLE, PROJECT);
    this.plain = this.program(QUADS, BLEND);
    this.full = this.program(more(QUADS), more(BLEND));
    this.show = this.program(WHOLE, SHOW);
    this.none = gl.createVertexArray();
    this.backdrop = this.texture();
    this.photos = this.texture();
    this.scores = this.texture();
    this.buffers = [0, 1, 2].map(() => this.texture());
    this.frame = gl.createFramebuffer();
    this.spots = gl.createFramebuffer();
    this.size = [0, 0];
    this.held = []; // textures of all Gaussians: packed, places, shapes, order
    this.empty();
  }

  empty() {
    this.header = null;
    this.count = this.loaded = this.drawn = 0;
    this.stale = this.sent; // the order of another scene may still come
    this.asked = this.shown = '';
    this.words = [];
    this.floor = 0;
  }

  program(vertex, fragment) {
    const gl = this.gl,
      program = gl.createProgram();
    for (const [type, text] of [
      [gl.VERTEX_SHADER, vertex],
      [gl.FRAGMENT_SHADER, fragment],
    ]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
        throw new Error(gl.getShaderInfoLog(shader));
      }
    }
    gl.linkProgram(program);
    const at = {};
    const n = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) || 0;
    for (let i = 0; i < n; i++) {
      const name = gl.getActiveUniform(program, i).name.replace('[0]', '');
      at[name] = gl.getUniformLocation(program, name);
    }
    return { program, at };
  }

  texture() {
    const gl = this.gl,
      texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
      gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    }
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    return texture;
  }

  fill(texture, format, width, height, type, data) {
    const gl = this.gl;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, gl.RGBA, type, data);
  }

  // Makes room for that many Gaussians, 52 bytes each on the device: half as many as long as the
  // device has no memory for them. The number that there is room for.
  room(count) {
    const gl = this.gl;
    count = Math.min(count, ROW * (gl.getParameter(gl.MAX_TEXTURE_SIZE) || ROW));
    for (;;) {
      this.rows = Math.max(1, Math.ceil(count / ROW));
      while (![gl.NO_ERROR, gl.CONTEXT_LOST_WEBGL].includes(gl.getError()));
      this.held.forEach((texture) => gl.deleteTexture(texture));
      this.held = [gl.RGBA32UI, gl.RG32F, gl.RGBA16F, gl.R32UI].map((format, k) => {
        const texture = this.texture();
        gl.texStorage2D(gl.TEXTURE_2D, 1, format, k ? ROW : 2 * ROW, this.rows);
        return texture;
      });
      if (gl.getError() !== gl.OUT_OF_MEMORY) return count;
      if (count <= ROW) throw new Error(t('device.full'));
      count >>= 1;
    }
  }

  // A new scene of so many Gaussians, none of which is there yet. How many of them it will take.
  begin(header, cells, count) {
    const gl = this.gl;
    this.empty();
    this.header = header;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.spots);
    this.count = count = this.room(count);
    this.rest = new Uint32Array(0);
    this.held.slice(1, 3).forEach((texture, k) => {
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, gl.TEXTURE_2D, texture, 0);
    });
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
    this.fill(this.backdrop, gl.RGBA8, ...CELLS, gl.UNSIGNED_BYTE, fading(cells, header));
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
      gl.texParameteri(gl.TEXTURE_2D, side, gl.LINEAR);
    }
    const cameras = header.cameras,
      rowsOf = new Float32Array(8 * Math.max(1, cameras.length));
    cameras.forEach(({ camera_to_world: m }, i) => {
      const focal = header.network_focal_px[i];
      const scale = header.magnify && focal > 0 ? 1 / focal : 0;
      const center = add([m[3], m[7], m[11]], header.origin, -1);
      rowsOf.set([...center, scale, m[2], m[6], m[10], 0], 8 * i);
    });
    this.fill(this.photos, gl.RGBA32F, 2, rowsOf.length / 8, gl.FLOAT, rowsOf);
    this.ask([], 0);
    this.worker.postMessage({ count, coarse: header.coarse });
    return count;
  }

  // More Gaussians; the last row of the texture may be filled twice.
  append(first, words) {
    const gl = this.gl,
      n = (this.rest.length + words.length) / 8,
      rows = Math.ceil(n / ROW),
      at = [0, Math.floor(first / ROW), 2 * ROW, rows],
      padded = new Uint32Array(8 * ROW * rows);
    padded.set(this.rest);
    padded.set(words, this.rest.length);
    gl.bindTexture(gl.TEXTURE_2D, this.held[0]);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, ...at, gl.RGBA_INTEGER, gl.UNSIGNED_INT, padded);
    this.rest = padded.slice(8 * (n - (n % ROW)), 8 * n);
    this.loaded = first + words.length / 8;
    this.worker.postMessage({ first, words }, [words.buffer]);
    this.asked = '';
    this.changed();
  }

  // Up to four words, each { scores: [M] relevancies, cut }; a look-up by entry, no new download.
  ask(words, floor) {
    const gl = this.gl,
      entries = 1 + Math.max(0, ...words.map((word) => word.scores.length));
    const table = new Float32Array(4 * 256 * Math.max(1, Math.ceil(entries / 256)));
    words.forEach(({ scores }, k) =>
      scores.forEach((r, m) => {
        // The difference of cosines times tau; its sign is the mask.
        table[4 * (m + 1) + k] = Math.max(-16, Math.min(16, Math.log(r / (1 - r))));
      }),
    );
    this.fill(this.scores, gl.RGBA32F, 256, table.length / 1024, gl.FLOAT, table);
    this.words = words;
    this.floor = floor;
    this.changed();
  }

  // The thing at a point of the world: its entry, of how many, its Gaussians, and a box along these
  // axes; null where nothing has an entry.
  async thingAt(point, entry, axes) {
    const { origin, unit } = this.header;
    const place = add(point, origin, -1);
    this.worker.postMessage({ place, entry, axes, reach: 0.02 * unit });
    const found = await new Promise((go) => this.asking.push(go));
    if (!found) return null;
    const { ends, ...rest } = found,
      size = ends.map(([low, high]) => high - low),
      center = axes.reduce(
        (at, axis, k) => add(at, axis, 0.5 * (ends[k][0] + ends[k][1])),
        origin,
      );
    return { ...rest, center, size, axes };
  }

  sorted({ order, drawn, number, known, ms }) {
    const gl = this.gl;
    this.done = number;
    this.waiting.splice(0).forEach((go) => go());
    if (number <= this.stale) return this.changed();
    this.sortMs = ms;
    this.sortKnown = known;
    const rows = order.length / ROW;
    gl.bindTexture(gl.TEXTURE_2D, this.held[3]);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, rows, gl.RED_INTEGER, gl.UNSIGNED_INT, order);
    this.drawn = drawn;
    this.fresh = true;
    this.changed();
  }

  // Whether the order on the device is that of the last camera and of all that has come.
  get settled() {
    return this.asked === this.shown && this.sent === this.done;
  }

  resize(width, height) {
    if (this.size[0] === width && this.size[1] === height) return;
    const gl = this.gl;
    this.size = [width, height];
    this.canvas.width = width;
    this.canvas.height = height;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    this.buffers.forEach((texture, k) => {
      this.fill(texture, gl.RGBA16F, width, height, gl.HALF_FLOAT, null);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, gl.TEXTURE_2D, texture, 0);
    });
  }

  // Has the worker sort for this camera, where it is free. Whether a frame is worth its time: at
  // rest the last order is waited for.
  sort(camera, moving) {
    const header = this.header;
    if (!header) return false;
    const axis = axesOf(camera)[2],
      eye = add(camera.eye, header.origin, -1);
    // While it loads, there is a new order and a frame each time that half as much again has come.
    const come = this.loaded < this.count && Math.floor(Math.log(this.loaded) / Math.log(1.5));
    this.asked = `${camera.eye} ${axis} ${come}`;
    if (this.asked !== this.shown && this.sent === this.done) {
      this.shown = this.asked;
      this.sent += 1;
      const behind = behindOf(header, camera),
        near = header.near;
      this.worker.postMessage({ eye, axis, near, behind, number: this.sent });
    }
    const worth = moving || this.fresh || this.settled;
    this.fresh = false;
    return worth;
  }

  // One frame of this size on the canvas, when its order is there.
  async still(camera, width, height, kind) {
    this.resize(width, height);
    for (this.sort(camera); !this.settled; this.sort(camera))
      await new Promise((go) => this.waiting.push(go));
    if (this.lost) throw new Error(t('device.lost'));
    this.draw(camera, kind);
  }

  // One frame from a camera. kind: 0 colour, 1 depth, 2 alpha, 3 mask. `to` is where it goes in
  // place of the canvas: a frame, its corner there, and a lens that need not look ahead.
  draw(camera, kind, to = {}) {
    const gl = this.gl,
      header = this.header,
      [width, height] = this.size;
    if (!header || this.lost || !width) return;
    const [x, y, z] = axesOf(camera),
      eye = add(camera.eye, header.origin, -1);
    const focal = focalOf(camera, height);
    const more = kind === 1 || this.words.length > 0;
    const { program, at } = more ? this.full : this.plain;
    const turn = [x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]];
    const lens = to.lens || [focal, focal, width / 2, height / 2],
      corner = to.at || [0, 0];
    const bind = (texture, k, place) => {
      gl.activeTexture(gl.TEXTURE0 + k);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(place, k);
    };
    const project = this.project.at;
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.spots);
    gl.viewport(0, 0, ROW, this.rows);
    gl.useProgram(this.project.program);
    bind(this.held[0], 0, project.packed);
    bind(this.photos, 1, project.photos);
    gl.uniformMatrix3fv(project.turn, false, turn);
    gl.uniform3fv(project.eye, eye);
    gl.uniform4fv(project.lens, lens);
    gl.uniform2f(project.size, width, height);
    gl.uniform1f(project.near, header.near);
    gl.uniform1f(project.extent, header.unit);
    gl.uniform1i(project.antialiased, header.antialiased ? 1 : 0);
    gl.bindVertexArray(this.none);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.viewport(0, 0, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.drawBuffers([0, 1, 2].map((k) => (more || k === 0 ? gl.COLOR_ATTACHMENT0 + k : gl.NONE)));
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(program);
    ['packed', 'places', 'shapes', 'order'].forEach((name, k) => bind(this.held[k], k, at[name]));
    if (more) bind(this.scores, 4, at.scores);
    gl.uniform2f(at.size, width, height);
    gl.uniform3fv(at.eye, eye);
    gl.uniform3fv(at.ahead, z.map((v) => v / header.unit));
    // Not instances: software draws each one by itself.
    gl.drawArrays(gl.TRIANGLES, 0, 6 * this.drawn);
    gl.bindFramebuffer(gl.FRAMEBUFFER, to.frame || null);
    gl.viewport(...corner, width, height);
    gl.disable(gl.BLEND);
    const show = this.show.at;
    gl.useProgram(this.show.program);
    ['blended', 'first', 'second'].forEach((name, k) => bind(this.buffers[k], k, show[name]));
    bind(this.backdrop, 3, show.backdrop);
    gl.uniformMatrix3fv(show.turn, false, turn);
    gl.uniform4fv(show.lens, lens);
    gl.uniform2f(show.size, width, height);
    gl.uniform2iv(show.corner, corner);
    gl.uniform1i(show.kind, kind);
    gl.uniform1i(show.words, this.words.length);
    gl.uniform1f(show.floorOf, this.floor);
    const margin = ({ cut }) => (cut === 0.5 ? 0 : Math.log(cut / (1 - cut)));
    gl.uniform4fv(
      show.margins,
      [0, 1, 2, 3].map((k) => (this.words[k] ? margin(this.words[k]) : 0)),
    );
    gl.uniform3fv(show.colors, TINTS.flat());
    gl.uniform3fv(show.fog, this.fog);
    gl.uniform1i(show.sky, header.backdrop ? 1 : 0);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    this.camera = camera;
  }

  // World point under a pixel of the frame drawn last, by its blended depth; null where nothing is.
  pointAt(px, py) {
    const gl = this.gl,
      [width, height] = this.size,
      camera = this.camera;
    if (!camera) return null;
    if (!this.words.length) this.draw(camera, 1);
    const pixel = new Float32Array(4);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.readBuffer(gl.COLOR_ATTACHMENT2);
    gl.readPixels(Math.floor(px), height - 1 - Math.floor(py), 1, 1, gl.RGBA, gl.FLOAT, pixel);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    this.changed();
    if (!(pixel[3] > 0.05)) return null;
    const depth = (pixel[0] / pixel[3]) * this.header.unit,
      focal = focalOf(camera, height);
    const [x, y, z] = axesOf(camera);
    const u = (Math.floor(px) + 0.5 - width / 2) / focal,
      v = (Math.floor(py) + 0.5 - height / 2) / focal;
    return add(add(add(camera.eye, z, depth), x, u * depth), y, v * depth);
  }
}
