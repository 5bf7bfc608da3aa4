// Small vectors, the camera of the page, and what of a scene is behind in a view. World and camera
// are OpenCV: x right, y down, z forward (docs/conventions.md).
'use strict';
const add = (a, b, k = 1) => a.map((v, i) => v + k * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
const length = (a) => Math.hypot(...a);
const unit = (a) => {
  const n = length(a) || 1;
  return a.map((v) => v / n);
};
const mix = (a, b, t) => a.map((v, i) => v + t * (b[i] - v));
// Rodrigues: v turned about a unit axis.
const turned = (v, axis, angle) => {
  const c = Math.cos(angle),
    s = Math.sin(angle),
    k = cross(axis, v),
    d = dot(axis, v) * (1 - c);
  return v.map((x, i) => x * c + k[i] * s + axis[i] * d);
};

// A camera is { eye, target, up, fov }: fov is vertical, in degrees, the principal point central.
const axesOf = ({ eye, target, up }) => {
  const z = unit(add(target, eye, -1)),
    x = unit(cross(z, up));
  return [x, cross(z, x), z];
};
const focalOf = ({ fov }, height) => height / 2 / Math.tan((fov * Math.PI) / 360);
// Row-major camera to world, 16 numbers.
const matrixOf = (camera) => {
  const [x, y, z] = axesOf(camera),
    e = camera.eye;
  return [x[0], y[0], z[0], e[0], x[1], y[1], z[1], e[1], x[2], y[2], z[2], e[2], 0, 0, 0, 1];
};
// The camera that took a photo, as far as the page's camera can be it.
const cameraOf = ({ camera_to_world: m, intrinsics: k }, depth) => {
  const eye = [m[3], m[7], m[11]];
  return {
    eye,
    target: add(eye, [m[2], m[6], m[10]], depth),
    up: [-m[1], -m[5], -m[9]],
    fov: (2 * Math.atan(k.height / 2 / k.fy) * 180) / Math.PI,
  };
};

// What is up in a scene, as far as its photos tell: their mean. Null where they disagree.
const uprightOf = (cameras) => {
  const ups = cameras.map(({ camera_to_world: m }) => unit([-m[1], -m[5], -m[9]]));
  const sum = ups.reduce((a, b) => add(a, b), [0, 0, 0]);
  return length(sum) > 0.2 * ups.length ? unit(sum) : null;
};

// Whether each photo is behind, as crates/render/src/plan.rs: all but the nearest few.
function behindOf(header, camera) {
  const axis = axesOf(camera)[2],
    depth = header.unit;
  const costs = header.cameras
    .map(({ camera_to_world: m }, i) => {
      const step = length(add([m[3], m[7], m[11]], camera.eye, -1)) / depth;
      const facing = Math.acos(Math.min(1, Math.max(-1, dot(axis, [m[2], m[6], m[10]]))));
      return [i, step + 0.5 * facing];
    })
    .filter(([i]) => header.network_focal_px[i] > 0);
  const front = header.front_photos,
    layered = front > 0 && costs.length > front;
  const behind = new Uint8Array(Math.max(1, header.cameras.length)).fill(layered ? 1 : 0);
  costs.sort((a, b) => a[1] - b[1] || a[0] - b[0]);
  for (const [i] of costs.slice(0, front)) behind[i] = 0;
  return behind;
}

// The cells of the backdrop with a fourth number: how surely a photo saw what is far away in that
// direction. All of a photo counts and a little beyond it; from there it falls off. Without photos,
// as a file of Gaussians is, the backdrop stays.
const SEEN_TO = 0.02, // beyond the edge of a photo, as the tangent of an angle
  FADED_AT = 0.16;
function fading(cells, header) {
  const [across, down] = CELLS,
    faded = new Uint8Array((cells.length / 3) * 4);
  const lenses = header.cameras
    .filter((_, i) => header.network_focal_px[i] > 0)
    .map(({ camera_to_world: m, intrinsics: k }) => ({
      axes: [0, 1, 2].map((j) => [m[j], m[4 + j], m[8 + j]]),
      low: [-k.cx / k.fx, -k.cy / k.fy],
      high: [(k.width - k.cx) / k.fx, (k.height - k.cy) / k.fy],
    }));
  for (let cell = 0; cell < faded.length / 4; cell++) {
    const side = 2 * Math.PI * (((cell % across) + 0.5) / across - 0.5),
      rise = Math.PI * ((Math.floor(cell / across) + 0.5) / down - 0.5),
      ray = [Math.sin(side) * Math.cos(rise), Math.sin(rise), Math.cos(side) * Math.cos(rise)];
    let beyond = lenses.length ? Infinity : 0;
    for (const { axes, low, high } of lenses) {
      const z = dot(axes[2], ray);
      if (z <= 0.01) continue;
      const off = [0, 1].map((j) => {
        const at = dot(axes[j], ray) / z;
        return Math.max(low[j] - at, at - high[j]);
      });
      beyond = Math.min(beyond, Math.max(...off));
    }
    const t = Math.min(1, Math.max(0, (FADED_AT - beyond) / (FADED_AT - SEEN_TO)));
    faded.set(cells.subarray(3 * cell, 3 * cell + 3), 4 * cell);
    faded[4 * cell + 3] = Math.round(255 * t * t * (3 - 2 * t));
  }
  return faded;
}
