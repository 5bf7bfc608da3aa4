// A film of the scene: WebCodecs encodes the frames (VP9, or else VP8), and WebM holds them. Where
// there is no WebCodecs (plain http from another machine), the browser records what it draws.
const FPS = 30,
  KEY_FRAMES = 2 * FPS, // one so often: a player jumps to these
  SWING = Math.PI / 12;

// The camera at a share of the film, 0 to 1: turned about an axis through its target, once around,
// or to both sides and back.
function onTurntable({ eye, target, up, fov }, axis, motion, share) {
  const angle = motion === 'swing' ? SWING * Math.sin(2 * Math.PI * share) : 2 * Math.PI * share;
  const turn = (v) => turned(v, axis, angle);
  return { eye: add(target, turn(add(eye, target, -1))), target, up: turn(up), fov };
}

// The camera at a share of the way past some views: a curve through their places (Catmull and Rom)
// that is at each of them for a moment.
function onPath(views, share) {
  const at = share * (views.length - 1),
    i = Math.min(Math.floor(at), views.length - 2),
    s = at - i,
    [a, b, c, d] = [-1, 0, 1, 2].map((k) => views[Math.min(views.length - 1, Math.max(0, i + k))]);
  const through = (name) =>
    b[name].map((from, k) => {
      const [p, q, r] = [a[name][k], c[name][k], d[name][k]];
      const [bend, twist] = [2 * p - 5 * from + 4 * q - r, 3 * from - p - 3 * q + r];
      return from + 0.5 * s * (q - p + s * (bend + s * twist));
    });
  return {
    eye: through('eye'),
    target: through('target'),
    up: unit(mix(b.up, c.up, s)),
    fov: b.fov + s * (c.fov - b.fov),
  };
}

// The picture of the stage with the longer side given; even, because colours have half the pixels.
function filmSize(box, side) {
  const scale = side / Math.max(box.width, box.height);
  return [box.width, box.height].map((v) => Math.max(16, 2 * Math.round((v * scale) / 2)));
}

const bitrateOf = (width, height) => Math.round(0.12 * width * height * FPS);

// The first codec that can encode this; null: none can.
async function filmCodec(width, height) {
  if (!globalThis.VideoEncoder) return null;
  for (const [codec, name] of [
    ['vp09.00.51.08', 'V_VP9'],
    ['vp8', 'V_VP8'],
  ]) {
    const config = { codec, width, height, bitrate: bitrateOf(width, height), framerate: FPS };
    if ((await VideoEncoder.isConfigSupported(config)).supported) return { config, name };
  }
  return null;
}

// The file, as a Blob. Each frame is drawn on the canvas of the drawing; cameraAt(share) is where
// from.
async function makeFilm(drawing, cameraAt, plan) {
  const { width, height, frames, kind, signal, progress } = plan;
  const found = await filmCodec(width, height);
  if (!found) return recordFilm(drawing, cameraAt, plan);
  const { config, name } = found;
  const chunks = [];
  let broken = null;
  const encoder = new VideoEncoder({
    output(chunk) {
      const data = new Uint8Array(chunk.byteLength);
      chunk.copyTo(data);
      chunks.push({ data, key: chunk.type === 'key', ms: Math.round(chunk.timestamp / 1000) });
    },
    error(error) {
      broken = error;
    },
  });
  encoder.configure(config);
  try {
    for (let i = 0; i < frames; i++) {
      await drawing.still(cameraAt(i / frames), width, height, kind);
      const frame = new VideoFrame(drawing.canvas, {
        timestamp: Math.round((i * 1e6) / FPS),
        duration: Math.round(1e6 / FPS),
      });
      if (!broken) encoder.encode(frame, { keyFrame: i % KEY_FRAMES === 0 });
      frame.close();
      // A few frames wait for the encoder, not all of them; and the page hears a press of Cancel.
      do await new Promise((ok) => setTimeout(ok, 0));
      while (encoder.encodeQueueSize > 4);
      signal.throwIfAborted();
      if (broken) throw broken;
      progress((i + 1) / frames);
    }
    await encoder.flush();
  } finally {
    if (encoder.state !== 'closed') encoder.close();
  }
  if (broken) throw broken;
  return webm({ chunks, name, width, height, ms: (frames * 1000) / FPS });
}

// The same in real time: a device that draws slowly gives fewer frames, over the same seconds.
async function recordFilm(drawing, cameraAt, { width, height, frames, kind, signal, progress }) {
  const types = ['video/webm;codecs=vp9', 'video/webm', 'video/mp4'];
  const mimeType = types.find((type) => globalThis.MediaRecorder?.isTypeSupported(type));
  if (!mimeType || !drawing.canvas.captureStream) throw new Error(t('film.cannot'));
  const long = (frames * 1000) / FPS,
    shown = () => new Promise((ok) => requestAnimationFrame(ok));
  await drawing.still(cameraAt(0), width, height, kind);
  const stream = drawing.canvas.captureStream(FPS),
    bits = { videoBitsPerSecond: bitrateOf(width, height) },
    recorder = new MediaRecorder(stream, { mimeType, ...bits });
  const parts = [],
    stopped = new Promise((ok) => (recorder.onstop = ok));
  recorder.ondataavailable = ({ data }) => parts.push(data);
  recorder.start();
  try {
    for (let share = 0, begun = performance.now(); share < 1; ) {
      share = Math.min(1, (performance.now() - begun) / long);
      await drawing.still(cameraAt(share), width, height, kind);
      await shown();
      signal.throwIfAborted();
      progress(share);
    }
  } finally {
    recorder.stop();
    for (const track of stream.getTracks()) track.stop();
  }
  await stopped;
  return new Blob(parts, { type: mimeType });
}

// WebM (RFC 8794 and 9559): one track, a cluster from each key frame, and an index of the clusters.
function webm({ chunks, name, width, height, ms }) {
  const big = (value, size) =>
    Uint8Array.from({ length: size }, (_, i) => Math.floor(value / 256 ** (size - 1 - i)) % 256);
  const sizeOf = (parts) => parts.reduce((sum, part) => sum + part.length, 0);
  const element = (id, ...children) => {
    const parts = children.flat();
    const size = [Uint8Array.of(1), big(sizeOf(parts), 7)];
    return [big(id, Math.ceil(Math.log2(id) / 8)), ...size, ...parts];
  };
  // Six bytes, so that the size of the index does not depend on what is in it.
  const number = (id, value) => element(id, big(value, 6));
  const text = (id, value) => element(id, new TextEncoder().encode(value));
  const float = (id, value) => {
    const bytes = new DataView(new ArrayBuffer(8));
    bytes.setFloat64(0, value);
    return element(id, new Uint8Array(bytes.buffer));
  };
  const groups = [];
  for (const chunk of chunks) {
    if (chunk.key) groups.push([]);
    groups.at(-1).push(chunk);
  }
  const clusters = groups.map((group) => {
    const blocks = group.map(({ data, key, ms: at }) =>
      element(0xa3, Uint8Array.of(0x81), big(at - group[0].ms, 2), big(key ? 0x80 : 0, 1), data),
    );
    return element(0x1f43b675, number(0xe7, group[0].ms), ...blocks);
  });
  const track = element(
    0xae,
    ...[number(0xd7, 1), number(0x73c5, 1), number(0x9c, 0), number(0x83, 1), text(0x86, name)],
    number(0x23e383, Math.round(1e9 / FPS)),
    element(0xe0, number(0xb0, width), number(0xba, height)),
  );
  const info = element(
    0x1549a966,
    ...[number(0x2ad7b1, 1e6), float(0x4489, ms)],
    ...[text(0x4d80, 'SegSplat'), text(0x5741, 'SegSplat')],
  );
  const index = (places) =>
    element(
      0x1c53bb6b,
      ...places.map((place, i) =>
        element(
          0xbb,
          number(0xb3, groups[i][0].ms),
          element(0xb7, number(0xf7, 1), number(0xf1, place)),
        ),
      ),
    );
  const start = [...info, ...element(0x1654ae6b, track)];
  let place = sizeOf(start) + sizeOf(index(clusters.map(() => 0)));
  const places = clusters.map((cluster) => {
    const at = place;
    place += sizeOf(cluster);
    return at;
  });
  const head = element(
    0x1a45dfa3,
    ...[number(0x4286, 1), number(0x42f7, 1), number(0x42f2, 4), number(0x42f3, 8)],
    ...[text(0x4282, 'webm'), number(0x4287, 2), number(0x4285, 2)],
  );
  const segment = element(0x18538067, start, index(places), ...clusters);
  return new Blob([...head, ...segment], { type: 'video/webm' });
}
