// The canvas: frames, the lines over them, the camera, and what hands do to it.
let asked = false,
  lastFrame = 0;
function invalidate() {
  $('view').dataset.state = 'busy'; // until a frame has shown what is asked for
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => {
    asked = false;
    frame();
  });
}

function frame() {
  // A device that is lost, or came back without its scene, shows nothing and is not settled.
  if (!drawing?.header || drawing.lost || !state.camera || state.filming || state.vr) return;
  const box = $('stage').getBoundingClientRect(),
    dense = Math.min(devicePixelRatio, 2);
  const moving = performance.now() - state.moving < 250;
  // While it moves, slow frames are drawn smaller; at rest the frame is whole.
  const taken = performance.now() - lastFrame;
  if (moving && taken < 2000)
    state.sharpness = Math.min(
      1,
      Math.max(0.25, state.sharpness * (taken > 90 ? 0.8 : taken < 30 ? 1.1 : 1)),
    );
  lastFrame = performance.now();
  const scale = dense * (moving ? state.sharpness : 1);
  drawing.resize(
    Math.max(1, Math.round(box.width * scale)),
    Math.max(1, Math.round(box.height * scale)),
  );
  if (drawing.sort(state.camera, moving)) drawing.draw(state.camera, state.kind);
  if (moving) Object.assign(holes, { of: '', picture: null });
  over(box.width, box.height);
  const settled =
    drawing.settled &&
    !moving &&
    drawing.loaded === drawing.count &&
    drawing.sortKnown === drawing.count;
  $('view').dataset.state = settled ? 'settled' : 'busy';
  if (settled && state.holes && !$('holes').hidden)
    seeHoles(Math.round(box.width), Math.round(box.height)).catch(failed);
  if (moving) invalidate();
}

// Lines over the scene: cameras, boxes of parts, measured points.
function over(width, height) {
  // Not on the graphics device: there the lines stayed where a frame only clears.
  const canvas = $('over'),
    dense = Math.min(devicePixelRatio, 2),
    pen = canvas.getContext('2d', { willReadFrequently: true });
  canvas.width = width * dense;
  canvas.height = height * dense;
  pen.clearRect(0, 0, canvas.width, canvas.height); // not every device clears by the size alone
  pen.scale(dense, dense);
  if (state.holes && !$('holes').hidden && holes.picture)
    pen.drawImage(holes.picture, 0, 0, width, height);
  const { camera, scene } = state,
    [x, y, z] = axesOf(camera),
    focal = focalOf(camera, height);
  const near = 1e-3 * length(add(camera.target, camera.eye, -1));
  const seen = (p) => {
    const d = add(p, camera.eye, -1);
    return [dot(d, x), dot(d, y), dot(d, z)];
  };
  const flat = ([a, b, c]) => [width / 2 + (focal * a) / c, height / 2 + (focal * b) / c];
  const line = (p, q) => {
    let [a, b] = [seen(p), seen(q)];
    if (a[2] < near && b[2] < near) return;
    if (a[2] < near) a = mix(a, b, (near - a[2]) / (b[2] - a[2]));
    if (b[2] < near) b = mix(b, a, (near - b[2]) / (a[2] - b[2]));
    pen.moveTo(...flat(a));
    pen.lineTo(...flat(b));
  };
  const draw = (color, lines) => {
    for (const [style, wide] of [
      ['#000a', 4],
      [color, 2],
    ]) {
      pen.strokeStyle = style;
      pen.lineWidth = wide;
      pen.beginPath();
      for (const [p, q] of lines) line(p, q);
      pen.stroke();
    }
  };
  if (state.frusta) {
    for (const { camera_to_world: m, intrinsics: k } of scene.cameras) {
      const deep = 0.12 * scene.unit,
        eye = [m[3], m[7], m[11]];
      const corners = [
        [0, 0],
        [k.width, 0],
        [k.width, k.height],
        [0, k.height],
      ].map(([u, v]) => {
        const ray = [((u - k.cx) / k.fx) * deep, ((v - k.cy) / k.fy) * deep, deep];
        return eye.map(
          (e, i) => e + m[4 * i] * ray[0] + m[4 * i + 1] * ray[1] + m[4 * i + 2] * ray[2],
        );
      });
      draw(
        '#fff',
        corners.flatMap((c, i) => [
          [eye, c],
          [c, corners[(i + 1) % 4]],
        ]),
      );
    }
  }
  state.words.forEach((word, k) => {
    for (const part of word.parts.slice(0, BOXES)) {
      pen.globalAlpha = strengthOf(part, word);
      draw(css(k), edgesOf(part));
    }
  });
  pen.globalAlpha = 1;
  for (const [color, boxes] of outlines()) draw(color, boxes.flatMap(edgesOf));
  if (state.ground && state.scale?.ground) draw('#6cf', groundLines());
  if (state.marks.length) {
    if (state.marks.length > 1) {
      const next = (i) => state.marks[(i + 1) % state.marks.length];
      const legs = state.marks.map((mark, i) => [mark, next(i)]);
      draw('#ff0', state.marks.length > 2 ? legs : [state.marks]);
    }
    for (const mark of state.marks) {
      const at = seen(mark);
      if (at[2] < near) continue;
      pen.beginPath();
      pen.arc(...flat(at), 5, 0, 7);
      pen.fillStyle = '#ff0';
      pen.fill();
      pen.strokeStyle = '#000';
      pen.stroke();
    }
  }
}
// Lines of squares on the ground around its middle: of a metre where metres are known.
function groundLines() {
  const { normal, point } = state.scale.ground,
    ahead = axesOf(state.camera)[2],
    x = unit(cross(normal, Math.abs(dot(normal, ahead)) < 0.99 ? ahead : axesOf(state.camera)[1])),
    z = cross(x, normal),
    // Squares of 1, 2 or 5 times a power of ten, about a quarter of the scene's extent.
    wanted = 0.25 * state.scene.unit * metre(),
    ten = 10 ** Math.floor(Math.log10(wanted)),
    side = ([5, 2, 1].find((k) => k * ten <= wanted) * ten) / metre(),
    at = (i, j) => add(add(point, x, i * side), z, j * side);
  return Array.from({ length: 9 }, (_, i) => i - 4).flatMap((i) => [
    [at(i, -4), at(i, 4)],
    [at(-4, i), at(4, i)],
  ]);
}
// The eight corners of a box, and its twelve edges.
const cornersOf = ({ center, axes, size }) =>
  Array.from({ length: 8 }, (_, i) =>
    axes.reduce((p, axis, j) => add(p, axis, ((i >> j) & 1 ? 0.5 : -0.5) * size[j]), center),
  );
function edgesOf(box) {
  const corners = cornersOf(box);
  return corners.flatMap((corner, i) =>
    [1, 2, 4].filter((bit) => !(i & bit)).map((bit) => [corner, corners[i | bit]]),
  );
}
// How strongly a part is drawn: those that fit less than the best one are dimmer.
const strengthOf = (part, word) => {
  const best = word.parts[0].score - 0.5;
  return best > 0 ? 0.25 + 0.75 * Math.max(0, Math.min(1, (part.score - 0.5) / best)) : 1;
};
const css = (k) => `rgb(${TINTS[k].map((v) => Math.round(255 * v))})`;

// ---- the camera -------------------------------------------------------------------------------
function look(camera, still) {
  state.camera = camera;
  markStop(frames.get(camera));
  if (!still) {
    state.moving = performance.now();
    clearTimeout(look.timer);
    look.timer = setTimeout(() => {
      remember();
      invalidate();
    }, 300);
  }
  invalidate();
}

// How far from the middle of the canvas nothing floats over it: across and down, pixels. A panel
// that takes much of the canvas is looked past.
function free() {
  const { width, height } = $('stage').getBoundingClientRect();
  let [across, down] = [width / 2, height / 2];
  for (const id of ['side', 'tools', 'top', 'strip']) {
    const box = $(id).getBoundingClientRect();
    if (!box.width || state.embedded) continue;
    if (id === 'top' || id === 'strip') {
      const edge = id === 'top' ? height / 2 - box.bottom : box.top - height / 2;
      down = Math.min(down, Math.max(edge, 0.3 * height));
    } else if (box.width < 0.3 * width) {
      const edge = id === 'side' ? width / 2 - box.right : box.left - width / 2;
      across = Math.min(across, edge);
    }
  }
  return [across || 1, down || 1];
}

// The camera of a photo, with so wide a field of view that the whole photo is in what is free.
function framing(photo) {
  const { width, height, fx, fy } = photo.intrinsics,
    [across, down] = free(),
    high = $('stage').clientHeight / 2,
    tan = Math.max((height / 2 / fy) * (high / down), (width / 2 / fx) * (high / across));
  const fov = (2 * Math.atan(tan || 1) * 180) / Math.PI,
    camera = { ...cameraOf(photo, state.scene.unit), fov };
  frames.set(camera, photo);
  return camera;
}
// The photos of cameras that look through them.
const frames = new WeakMap();

// After the room of the canvas changed.
function refit() {
  const photo = state.camera && frames.get(state.camera);
  if (photo) state.camera = framing(photo);
  if (state.home) state.home = framing(frames.get(state.home));
  invalidate();
}

// Flies to the photo so many places after the one that is looked through, or to the first.
function nextPhoto(places) {
  const { cameras } = state.scene,
    at = placeOf(frames.get(state.camera));
  flyTo(framing(cameras[at < 0 ? 0 : (at + places + cameras.length) % cameras.length]));
}

// The axis of a turn to the side, and of a turntable: the scene's up. A level horizon stays level.
const axisOf = (camera) => state.upright || unit(camera.up);
// An arm and the camera's up, turned about the axis, then about the picture's right.
function swung(camera, arm, aside, over) {
  const axis = axisOf(camera),
    angle = dot(camera.up, axis) < 0 ? -aside : aside;
  const right = turned(axesOf(camera)[0], axis, angle);
  return [arm, camera.up].map((v) => turned(turned(v, axis, angle), right, over));
}

// What is near goes where a drag goes: an orbit turns the scene, a look turns the head.
const hands = {
  orbit(dx, dy) {
    const { eye, target } = state.camera;
    const [arm, up] = swung(state.camera, add(eye, target, -1), -dx, -dy);
    look({ ...state.camera, eye: add(target, arm), up });
  },
  // dx and dy are in heights of the picture, at the depth of the target.
  pan(dx, dy) {
    const { eye, target, fov } = state.camera,
      [x, y] = axesOf(state.camera);
    const high = 2 * length(add(target, eye, -1)) * Math.tan((fov * Math.PI) / 360);
    const shift = add(
      x.map((v) => -v * dx * high),
      y,
      -dy * high,
    );
    look({ ...state.camera, eye: add(eye, shift), target: add(target, shift) });
  },
  turn(dx, dy) {
    const { eye, target } = state.camera;
    const [arm, up] = swung(state.camera, add(target, eye, -1), dx, dy);
    look({ ...state.camera, target: add(eye, arm), up });
  },
  zoom(factor) {
    const { eye, target } = state.camera;
    look({ ...state.camera, eye: add(target, add(eye, target, -1), factor) });
  },
  fly(right, down, ahead) {
    const { eye, target } = state.camera,
      [x, y, z] = axesOf(state.camera);
    const step = 0.05 * (state.scene.unit || 1);
    const shift = add(
      add(
        x.map((v) => v * right * step),
        y,
        down * step,
      ),
      z,
      ahead * step,
    );
    look({ ...state.camera, eye: add(eye, shift), target: add(target, shift) });
  },
};

// Flies there in steps that show the way; at once for those who asked for less motion.
function flyTo(goal) {
  const from = state.camera,
    still = matchMedia('(prefers-reduced-motion: reduce)').matches;
  const flight = (flyTo.now = {});
  const begun = performance.now();
  const step = () => {
    if (flyTo.now !== flight) return;
    const t = still ? 1 : Math.min(1, (performance.now() - begun) / 700),
      s = t * t * (3 - 2 * t);
    const between = {
      eye: mix(from.eye, goal.eye, s),
      target: mix(from.target, goal.target, s),
      up: unit(mix(from.up, goal.up, s)),
      fov: from.fov + s * (goal.fov - from.fov),
    };
    look(t < 1 ? between : goal);
    if (t < 1) requestAnimationFrame(step);
  };
  step();
}

const touches = new Map();
let pressed = null,
  held = null;
// Two fingers, each time from where they and the camera began: one moves before the other.
function gesture() {
  const [before, camera] = held,
    now = [...touches.values()];
  state.camera = camera;
  const apart = ([a, b]) => Math.hypot(a[0] - b[0], a[1] - b[1]) || 1;
  const high = $('stage').clientHeight,
    [dx, dy] = [0, 1].map((k) => (now[0][k] + now[1][k] - before[0][k] - before[1][k]) / 2);
  hands.zoom(apart(before) / apart(now));
  hands.pan(dx / high, dy / high);
}
function bindView() {
  const view = $('view');
  view.addEventListener('pointerdown', (e) => {
    if (!state.camera) return;
    view.setPointerCapture(e.pointerId);
    touches.set(e.pointerId, [e.clientX, e.clientY]);
    held = null;
    pressed = touches.size === 1 ? [e.clientX, e.clientY] : null;
    flyTo.now = null;
  });
  view.addEventListener('pointermove', (e) => {
    const last = touches.get(e.pointerId);
    if (!last || !state.camera) return;
    const [dx, dy] = [e.clientX - last[0], e.clientY - last[1]];
    const before = [...touches.values()];
    touches.set(e.pointerId, [e.clientX, e.clientY]);
    const high = $('stage').clientHeight;
    if (touches.size === 2) {
      held ||= [before, state.camera];
      gesture();
    } else if (!pressed || Math.hypot(e.clientX - pressed[0], e.clientY - pressed[1]) > 4) {
      pressed = null;
      const how = $('drag').selectedIndex;
      if (e.shiftKey || how === 1 || e.buttons & 2) hands.pan(dx / high, dy / high);
      else if (e.ctrlKey || how === 2) hands.turn(dx / 400, dy / 400);
      else hands.orbit(dx / 300, dy / 300);
    }
  });
  const end = (e) => {
    touches.delete(e.pointerId);
    held = null;
  };
  view.addEventListener('pointerup', (e) => {
    end(e);
    if (pressed && e.button === 0)
      clicked(e).catch((error) => {
        $('picked').textContent = error.message;
      });
    pressed = null;
  });
  view.addEventListener('pointercancel', end);
  view.addEventListener('contextmenu', (e) => e.preventDefault());
  view.addEventListener(
    'wheel',
    (e) => {
      if (!state.camera) return;
      e.preventDefault();
      hands.zoom(Math.exp(e.deltaY / 600));
    },
    { passive: false },
  );
  view.addEventListener('keydown', (e) => {
    if (!state.camera || e.ctrlKey || e.metaKey || e.altKey) return;
    const keys = {
      ArrowLeft: () => (e.shiftKey ? hands.pan : hands.orbit)(-0.08, 0),
      ArrowRight: () => (e.shiftKey ? hands.pan : hands.orbit)(0.08, 0),
      ArrowUp: () => (e.shiftKey ? hands.pan : hands.orbit)(0, -0.08),
      ArrowDown: () => (e.shiftKey ? hands.pan : hands.orbit)(0, 0.08),
      w: () => hands.fly(0, 0, 1),
      s: () => hands.fly(0, 0, -1),
      a: () => hands.fly(-1, 0, 0),
      d: () => hands.fly(1, 0, 0),
      q: () => hands.fly(0, 1, 0),
      e: () => hands.fly(0, -1, 0),
      '+': () => hands.zoom(0.9),
      '-': () => hands.zoom(1.1),
      Home: () => flyTo(state.home),
      n: () => nextPhoto(1),
      p: () => nextPhoto(-1),
      Escape: letGo,
    };
    const act = keys[e.key] || keys[e.key.toLowerCase()];
    if (act) {
      e.preventDefault();
      act();
    }
  });
  new ResizeObserver(refit).observe($('stage'));
}
