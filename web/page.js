// The page: what is shown, and what hands do to it. All text from outside goes into text nodes.
const $ = (id) => document.getElementById(id);
const make = (tag, fields = {}, ...children) => {
  const node = Object.assign(document.createElement(tag), fields);
  node.append(...children);
  return node;
};
const say = (text) => {
  $('says').textContent = text;
};
const failed = (error) => {
  if (error.name === 'AbortError') return; // something else was opened
  $('key-form').hidden = error.status !== 401 && error.status !== 403;
  say(error.message);
};
const count = (n) => n.toLocaleString('en');
const SHORT = { dateStyle: 'medium', timeStyle: 'short' };
// What the server is at, for people.
const STAGES = {
  photos: 'reading the photos',
  cameras: 'finding the cameras',
  capture: 'checking the cameras',
  geometry: 'finding the shapes',
  lift: 'making Gaussians',
  store: 'storing',
  masks: 'finding things',
  embed: 'finding out what they are',
  bank: 'joining what is alike',
  assign: 'marking the Gaussians',
};
// What is known of a word, for people.
const TRUST = {
  good: 'known well',
  fair: 'known fairly',
  poor: 'known poorly',
  unmeasured: 'not measured',
};
const BOXES = 24; // of a word
const KINDS = ['colour', 'depth', 'alpha', 'mask'];
const NAMES = [
  'chair',
  'table',
  'cup',
  'box',
  'book',
  'plant',
  'flower',
  'person',
  'animal',
  'toy',
  'lamp',
  'screen',
  'bottle',
  'bag',
  'shoe',
  'ball',
  'car',
  'bicycle',
  'building',
  'tree',
  'grass',
  'sky',
  'wall',
  'floor',
  'door',
  'window',
  'picture',
  'bed',
  'sofa',
  'shelf',
  'food',
  'fruit',
  'tool',
  'stone',
];

const state = {
  scene: null,
  camera: null,
  home: null,
  kind: 0,
  words: [],
  known: [],
  kept: [],
  marks: [],
  things: 0,
  frusta: false,
  measuring: false,
  scale: 1,
  moving: 0,
  alone: false,
  understood: false,
  upright: null,
  filming: null,
};
let drawing = null,
  loading = null,
  asked = false,
  watching = null;

// ---- drawing --------------------------------------------------------------------------------
function invalidate() {
  $('view').dataset.state = 'busy'; // until a frame has shown what is asked for
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => {
    asked = false;
    frame();
  });
}

let lastFrame = 0;
function frame() {
  // A device that is lost, or came back without its scene, shows nothing and is not settled.
  if (!drawing?.header || drawing.lost || !state.camera || state.filming) return;
  const box = $('stage').getBoundingClientRect(),
    dense = Math.min(devicePixelRatio, 2);
  const moving = performance.now() - state.moving < 250;
  // While it moves, slow frames are drawn smaller; at rest the frame is whole.
  const taken = performance.now() - lastFrame;
  if (moving && taken < 2000)
    state.scale = Math.min(
      1,
      Math.max(0.25, state.scale * (taken > 90 ? 0.8 : taken < 30 ? 1.1 : 1)),
    );
  lastFrame = performance.now();
  const scale = dense * (moving ? state.scale : 1);
  drawing.resize(
    Math.max(1, Math.round(box.width * scale)),
    Math.max(1, Math.round(box.height * scale)),
  );
  if (drawing.sort(state.camera, moving)) drawing.draw(state.camera, state.kind);
  over(box.width, box.height);
  const settled =
    drawing.settled &&
    !moving &&
    drawing.loaded === drawing.count &&
    drawing.sortKnown === drawing.count;
  $('view').dataset.state = settled ? 'settled' : 'busy';
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
  const { camera, scene } = state,
    [x, y, z] = axesOf(camera),
    focal = focalOf(camera, height);
  const framed = frames.get(camera);
  if (framed) {
    const { width: w, height: h, fx, fy } = framed.intrinsics,
      [across, down] = [(focal * w) / fx, (focal * h) / fy];
    pen.beginPath();
    pen.rect(0, 0, width, height);
    pen.rect((width - across) / 2, (height - down) / 2, across, down);
    pen.fillStyle = '#000b';
    pen.fill('evenodd');
  }
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
      const { center, axes, size } = part;
      pen.globalAlpha = strengthOf(part, word);
      const corner = (i) =>
        axes.reduce((p, axis, j) => add(p, axis, ((i >> j) & 1 ? 0.5 : -0.5) * size[j]), center);
      const edges = [];
      for (let i = 0; i < 8; i++)
        for (let j = 0; j < 3; j++)
          if (!((i >> j) & 1)) edges.push([corner(i), corner(i | (1 << j))]);
      draw(css(k), edges);
    }
  });
  pen.globalAlpha = 1;
  if (state.marks.length) {
    if (state.marks.length > 1) draw('#ff0', [state.marks]);
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
// How strongly a part is drawn: those that fit less than the best one are dimmer.
const strengthOf = (part, word) => {
  const best = word.parts[0].score - 0.5;
  return best > 0 ? 0.25 + 0.75 * Math.max(0, Math.min(1, (part.score - 0.5) / best)) : 1;
};
const css = (k) => `rgb(${WORDS[k].map((v) => Math.round(255 * v))})`;

// ---- the camera -----------------------------------------------------------------------------
function look(camera, still) {
  state.camera = camera;
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

// The camera of a photo, with so wide a field of view that the whole photo is in the canvas.
function framing(photo) {
  const { width, height, fx, fy } = photo.intrinsics,
    { clientWidth, clientHeight } = $('stage'),
    sides = clientWidth ? ((width / fx) * clientHeight) / clientWidth : 0,
    fov = (2 * Math.atan(Math.max(height / fy, sides) / 2) * 180) / Math.PI;
  const camera = { ...cameraOf(photo, state.scene.unit), fov };
  frames.set(camera, photo);
  return camera;
}
// The photos of cameras: while one is looked through, what its photo does not show is dark.
const frames = new WeakMap();

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
// Two fingers: both have moved when the next frame is drawn, and are read together.
function gesture() {
  const [before, now] = [held, [...touches.values()]];
  held = null;
  if (!before || now.length !== 2) return;
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
      if (!held) requestAnimationFrame(gesture);
      held ||= before;
    } else if (!pressed || Math.hypot(e.clientX - pressed[0], e.clientY - pressed[1]) > 4) {
      pressed = null;
      const how = $('drag').selectedIndex;
      if (e.shiftKey || how === 1 || e.buttons & 2) hands.pan(dx / high, dy / high);
      else if (e.ctrlKey || how === 2) hands.turn(dx / 400, dy / 400);
      else hands.orbit(dx / 300, dy / 300);
    }
  });
  const end = (e) => {
    gesture(); // the last movement before a finger goes
    touches.delete(e.pointerId);
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
    };
    const act = keys[e.key] || keys[e.key.toLowerCase()];
    if (act) {
      e.preventDefault();
      act();
    }
  });
  new ResizeObserver(invalidate).observe($('stage'));
}

// ---- what is there, measuring ---------------------------------------------------------------
async function clicked(event) {
  const box = $('view').getBoundingClientRect(),
    [width, height] = drawing.size;
  const x = ((event.clientX - box.left) / box.width) * width,
    y = ((event.clientY - box.top) / box.height) * height;
  if (state.alone) {
    const local = drawing.pointAt(x, y);
    if (!local) {
      $('picked').textContent = 'Nothing is there.';
      return;
    }
    if (state.measuring) return mark(local);
    const depth = dot(add(local, state.camera.eye, -1), axesOf(state.camera)[2]);
    $('picked').textContent = `${depth.toPrecision(3)} from the camera`;
    if (state.understood) offer(local);
    return;
  }
  const query = new URLSearchParams({
    camera_to_world: matrixOf(state.camera),
    fx: focalOf(state.camera, height),
    width,
    height,
    x,
    y,
  });
  if (state.understood && !state.measuring) {
    for (const name of new Set([...textsShown(), ...NAMES]))
      query.append('label', name);
  }
  if (!state.measuring) $('picked').textContent = 'looking …';
  const found = await server.json(`/v1/scenes/${state.scene.id}/pick?${query}`);
  if (!found.point) {
    $('picked').textContent = 'Nothing is there.';
    return;
  }
  if (state.measuring) return mark(found.point);
  const names = found.labels
    .filter(({ relevancy }) => relevancy >= 0.5)
    .slice(0, 3)
    .map(({ text, relevancy }) => `${text} (${relevancy.toFixed(2)})`);
  const what = names.length
    ? `This looks like: ${names.join(', ')}.`
    : state.understood
      ? 'No name of the list fits.'
      : 'Names are known after the first word.';
  $('picked').textContent =
    `${what} ${found.depth.toPrecision(3)} from the camera, at ` +
    `${found.point.map((v) => v.toPrecision(4)).join(', ')}.`;
  if (found.entry) offer(found.point, found.entry);
}

// Behind what is said of a click: the thing that was clicked can be shown without a word.
function offer(point, entry) {
  const button = make('button', { type: 'button', textContent: 'Select this thing' });
  button.onclick = () => select(point, entry).catch(failed);
  $('picked').append(' ', button);
}

// Shows what is at a point as words are shown: all that the scene takes for the same, and a box
// around what touches the point.
async function select(point, entry) {
  const up = axisOf(state.camera),
    right = unit(cross(up, axesOf(state.camera)[2]));
  const scene = state.scene,
    found = await drawing.thingAt(point, entry, [right, cross(right, up), up]);
  if (!found || state.scene !== scene) return;
  const scores = Array.from({ length: found.bank }, (_, m) => Number(m + 1 === found.entry));
  state.things += 1;
  if (state.words.length === WORDS.length) state.words.shift();
  state.words.push({
    text: `thing ${state.things}`,
    isThing: true,
    scores,
    entries: [found.entry],
    gaussians: found.gaussians,
    parts: [{ ...found, score: 1 }],
    score: 1,
    cut: Number($('cut').value),
  });
  showWords();
  say(`Thing ${state.things}: ${count(found.gaussians)} Gaussians in one piece.`);
}

// The texts of the words that are shown; things that were clicked have none.
const textsShown = () => state.words.filter((word) => !word.isThing).map((word) => word.text);

function mark(point) {
  state.marks = state.marks.length === 1 ? [...state.marks, point] : [point];
  const [a, b] = state.marks;
  $('picked').textContent = b
    ? `${length(add(a, b, -1)).toPrecision(4)} units of the capture between the two points.`
    : 'Now click the second point.';
  invalidate();
}

// ---- words ----------------------------------------------------------------------------------
async function find(text) {
  text = text.trim();
  if (!text || !state.scene) return;
  if (state.words.some((word) => word.text === text)) return;
  const scene = state.scene.id;
  let result = state.known.find((one) => one.text === text),
    floor = state.floor || 0;
  if (!result) {
    if (state.alone)
      throw new Error(
        `This file knows: ${state.known.map((one) => one.text).join(', ') || 'no words'}.`,
      );
    say('looking …');
    const id = scene,
      stop = new AbortController();
    if (!state.understood) watchUnderstanding(id, stop.signal);
    try {
      const body = JSON.stringify({ texts: [text] });
      const answer = await server.json(`/v1/scenes/${id}/query`, { method: 'POST', body });
      if (state.scene.id !== id) return; // another scene was opened meanwhile
      result = answer.results[0];
      floor = state.floor = answer.scoring.coverage_floor;
    } finally {
      stop.abort();
      $('progress').hidden = true;
    }
    state.known.push(result);
    // Entries of the Gaussians are new: once.
    if (!state.understood) await load(id, state.camera);
  }
  const known = await knownWord(result);
  if (state.scene?.id !== scene) return;
  if (state.words.length === WORDS.length) state.words.shift();
  const score = Math.max(0, ...result.scores);
  state.words.push({ ...result, score, known, cut: Number($('cut').value) });
  showWords();
  const n = result.parts.length,
    where = `${count(result.gaussians)} Gaussians in ${n} part${n === 1 ? '' : 's'}`;
  say(
    [
      `${text}: ${result.found ? where : `not found, the best score is ${score.toFixed(2)}`}`,
      ...doubtsOf(text, known),
      ...result.warnings.map((warning) => warning.message),
    ].join('\n'),
  );
}

// The first text has the semantics made, and their stages come as events. The events of a finished
// scene end at once, which it is until the question has come: they are asked for again until it is
// answered.
async function watchUnderstanding(id, signal) {
  while (!signal.aborted) {
    await server.watch(id, progress, signal).catch(() => {});
    await new Promise((go) => setTimeout(go, 200));
  }
}

// What was measured of the word of an answer: { trust, word, words } with how many words were. Null
// where the server does not say, trust null of a text about no word that was measured.
async function knownWord({ word, trust }) {
  if (trust) return { trust, word };
  if (state.alone) return null;
  const words = await server.models().then(
    (models) => models.words.length,
    () => 0,
  );
  return words ? { trust: null, words } : null;
}

// What makes an answer doubtful, as far as was measured.
function doubtsOf(text, known) {
  if (!known || known.trust === 'good' || known.trust === 'fair') return [];
  if (!known.trust)
    return [
      `Warning: "${text}" is not in the list of ${known.words} words that the server was ` +
        'measured with: what is shown may be something else.',
    ];
  return known.trust === 'poor'
    ? [`Warning: "${known.word}" is known poorly: much of it is missed, or much else is shown.`]
    : [`How well "${known.word}" is known was not measured.`];
}

function showWords() {
  drawing.ask(state.words, state.floor || 0);
  $('words').replaceChildren(
    ...state.words.map((word, k) => {
      const swatch = make('span', { className: 'swatch' });
      swatch.style.background = css(k);
      const remove = make('button', { textContent: '×', title: `Remove ${word.text}` });
      remove.setAttribute('aria-label', `Remove ${word.text}`);
      remove.onclick = () => {
        state.words.splice(k, 1);
        showWords();
        say(shown());
      };
      const parts = make(
        'div',
        { className: 'parts' },
        ...word.parts.slice(0, 8).map((part, i) => {
          const score = part.score.toFixed(2),
            go = make('button', { textContent: `part ${i + 1}: ${score}` });
          go.classList.toggle('weak', strengthOf(part, word) < 0.6);
          go.setAttribute(
            'aria-label',
            `Fly to part ${i + 1}: ${score} of ${word.text}, ${part.gaussians} Gaussians`,
          );
          go.onclick = () => {
            const away = Math.max(1.2 * length(part.size), 0.1 * state.scene.unit);
            const back = unit(add(state.camera.eye, part.center, -1));
            flyTo({ ...state.camera, target: part.center, eye: add(part.center, back, away) });
          };
          return go;
        }),
      );
      const trust = word.known && (TRUST[word.known.trust] || 'not in the list');
      const told = word.isThing ? 'clicked' : word.score.toFixed(2);
      const score = make('span', {
        className: 'score',
        textContent: word.gaussians ? told : 'not found',
        title: 'The best relevancy of anything in the scene; from 0.5 on it is found',
      });
      if (trust) score.append(`, ${trust}`);
      const name = make('strong', { textContent: word.text });
      return make('li', {}, swatch, name, ' ', score, ' ', remove, parts);
    }),
  );
  remember();
}

// ---- scenes ---------------------------------------------------------------------------------
async function list(after) {
  const page = await server.json(
    '/v1/scenes' + (after ? `?after=${encodeURIComponent(after)}` : ''),
  );
  if (!after) $('scenes').replaceChildren();
  $('none').hidden = Boolean(after) || page.scenes.length > 0;
  for (const item of page.scenes) {
    const when = new Date(item.created_ms).toLocaleString('en-GB', SHORT);
    const rest = item.state === 'done' ? '' : ` · ${item.state}`;
    const button = make('button', {
      textContent: `${when} · ${item.id.slice(0, 8)}${rest}`,
      onclick: () => {
        $('work').scrollIntoView({ block: 'nearest' });
        open(item.id).catch(failed);
      },
    });
    button.dataset.id = item.id;
    button.setAttribute('aria-current', String(state.scene?.id === item.id));
    const remove = make('button', {
      textContent: '×',
      title: 'Delete this scene',
      onclick: () => askDeletion(item.id),
    });
    remove.setAttribute('aria-label', `Delete scene ${item.id.slice(0, 8)}`);
    $('scenes').append(make('li', {}, button, remove));
  }
  $('more').hidden = !page.next;
  $('more').onclick = () => list(page.next).catch(failed);
}

// The dialog closes with what is chosen; Escape chooses nothing.
function askDeletion(id) {
  $('deletion-title').textContent = `Delete scene ${id.slice(0, 8)}?`;
  $('deletion').returnValue = '';
  $('deletion').onclose = () => {
    if ($('deletion').returnValue) deleteScene(id).catch(failed);
  };
  $('deletion').showModal();
}

async function deleteScene(id) {
  await server.call(`/v1/scenes/${id}`, { method: 'DELETE' });
  if (state.scene?.id === id) close();
  await list();
  say(`Scene ${id.slice(0, 8)} is deleted.`);
  $('scenes-title').focus(); // what was pressed is gone
}

// Shows no scene.
function close() {
  for (const work of [watching, loading, state.filming]) work?.abort();
  forget();
  Object.assign(state, { scene: null, camera: null });
  document.body.classList.remove('shown');
  history.replaceState(null, '', location.pathname);
}

function progress(event) {
  if (event.event === 'queued') say(`waiting, ${event.ahead} ahead`);
  if (event.event !== 'running') return;
  say(`${STAGES[event.stage] || event.stage}: ${Math.round(100 * event.fraction)} %`);
  $('progress').hidden = false;
  $('progress').value = event.fraction;
}

// Opens a scene: waits for one that is being made, then loads and shows it.
async function open(id, camera, words = []) {
  watching?.abort();
  watching = new AbortController();
  const { signal } = watching;
  if (made !== id) showCapture({ rows: [], faults: [], notes: [] }); // they are of another scene
  const path = `/v1/scenes/${encodeURIComponent(id)}`;
  let scene = await server.json(path);
  if (scene.state === 'queued' || scene.state === 'running') {
    try {
      await server.watch(id, (e) => progress(e), signal);
    } catch (e) {
      if (signal.aborted) return;
      throw e;
    }
    scene = await server.json(path);
    list().catch(failed);
  }
  $('progress').hidden = true;
  if (scene.state !== 'done') {
    const why = scene.error ? scene.error.message : `the scene is ${scene.state}`;
    blame(why);
    throw new Error(why);
  }
  if (state.scene?.id !== id) forget();
  for (const warning of scene.report.warnings) blame(warning.message);
  await load(id, camera);
  about(scene.report);
  if (scene.refinement.state === 'running') {
    followVersions(id, scene.version, signal).catch(() => {});
  }
  for (const b of $('scenes').querySelectorAll('button'))
    b.setAttribute('aria-current', String(b.dataset.id === id));
  for (const word of words) await find(word);
}

// Nothing of the scene before stays beside another one.
function forget() {
  Object.assign(state, { words: [], known: [], kept: [], marks: [], things: 0 });
  for (const id of ['words', 'kept', 'picked']) $(id).replaceChildren();
}

// Loads the Gaussians, the largest first, and shows them as they come.
async function load(id, camera) {
  loading?.abort();
  state.filming?.abort();
  loading = new AbortController();
  const { signal } = loading,
    begun = performance.now();
  say('loading the scene …');
  try {
    const answer = await server.call(`/v1/scenes/${id}/export?format=packed`, { signal });
    await take(answer.body, camera);
  } finally {
    if (!signal.aborted) $('progress').hidden = true;
  }
  say(`${shown()}, ${((performance.now() - begun) / 1000).toFixed(1)} s`);
}

// Shows the better versions of a scene that is refined, after the one of the number `shown`.
async function followVersions(id, shown, signal) {
  let newest = shown,
    taking = false;
  const takeNewest = async () => {
    if (taking) return;
    taking = true;
    while (shown < newest && !signal.aborted) {
      shown = newest;
      await takeVersion(id, signal);
    }
    taking = false;
  };
  const told = ({ event, version }) => {
    if (event !== 'version') return;
    newest = version;
    takeNewest().catch(failed);
  };
  await server.watch(id, told, signal, true);
}

// Takes a version in place of the one that is shown, once it is here whole: camera and words stay.
async function takeVersion(id, signal) {
  const answer = await server.call(`/v1/scenes/${id}/export?format=packed`, { signal });
  const parts = [];
  let head = null;
  const header = await readPacked(
    answer.body,
    (...all) => {
      head = all;
      return all[2];
    },
    (first, words) => parts.push([first, words]),
  );
  if (signal.aborted || state.filming) return;
  state.scene = header;
  const taken = drawing.begin(...head);
  for (const [first, words] of parts) {
    if (first < taken) drawing.append(first, words.slice(0, 8 * (taken - first)));
  }
  if (state.words.length) showWords();
  invalidate();
  say(`A better version: ${shown()}`);
}

// How many Gaussians there are, and which of them where the device has no room for all.
function shown() {
  const all = state.scene.gaussians;
  if (drawing.count === all) return `${count(all)} Gaussians`;
  return `The ${count(drawing.count)} largest of ${count(all)} Gaussians: more have no room here`;
}

async function take(stream, camera) {
  await readPacked(
    stream,
    (header, backdrop, most) => {
      state.scene = header;
      state.understood = header.understood;
      document.body.classList.add('shown');
      const taken = drawing.begin(header, backdrop, most);
      state.upright = uprightOf(header.cameras);
      state.home = framing(header.cameras[0]);
      $('photo').replaceChildren(
        make('option', { textContent: 'go to …', value: '' }),
        ...header.cameras.map((one, i) => make('option', { textContent: one.file, value: i })),
      );
      if (state.words.length) showWords();
      look(camera || state.home, true);
      proposeFilm(header.cameras);
      return taken;
    },
    (first, words) => {
      drawing.append(first, words);
      $('progress').value = drawing.loaded / drawing.count;
      $('progress').hidden = drawing.loaded === drawing.count;
    },
  );
  remember();
}

function about(report) {
  const times = report.stages
    .map(({ stage, ms }) => `${stage} ${(ms / 1000).toFixed(1)} s`)
    .join(', ');
  $('about').textContent = [
    report.file_format
      ? `${count(report.gaussians)} Gaussians of a file (${report.file_format})`
      : `${count(report.gaussians)} Gaussians of ${report.views_used} of ${report.photos} photos`,
    times,
    ...report.warnings.map((warning) => `${warning.code}: ${warning.message}`),
  ].join('\n');
}

// ---- the link -------------------------------------------------------------------------------
// The scene, the pose, the words and the picture are in the fragment, which no server sees.
function fragment() {
  const { eye, target, up, fov } = state.camera,
    parts = new URLSearchParams();
  if (!state.alone) parts.set('scene', state.scene.id);
  parts.set('pose', [...eye, ...target, ...up, fov].map((v) => Number(v.toPrecision(9))).join(','));
  for (const text of textsShown()) parts.append('text', text);
  if (state.kind) parts.set('kind', KINDS[state.kind]);
  return `#${parts}`;
}

function remember() {
  if (state.scene && state.camera) history.replaceState(null, '', fragment());
}

function fromLink() {
  const parts = new URLSearchParams(location.hash.slice(1));
  const numbers = (parts.get('pose') || '').split(',').map(Number);
  let camera = null;
  if (numbers.length === 10 && numbers.every(Number.isFinite)) {
    camera = {
      eye: numbers.slice(0, 3),
      target: numbers.slice(3, 6),
      up: numbers.slice(6, 9),
      fov: numbers[9],
    };
  }
  const kind = Math.max(0, KINDS.indexOf(parts.get('kind')));
  return {
    scene: parts.get('scene'),
    camera,
    words: parts.getAll('text').slice(0, WORDS.length),
    kind,
  };
}

// ---- a capture ------------------------------------------------------------------------------
let rows = [],
  made = null; // the scene of these rows
function showCapture(capture) {
  rows = capture.rows;
  $('notes').replaceChildren(...capture.notes.map((text) => make('li', { textContent: text })));
  $('faults').replaceChildren(...capture.faults.map((text) => make('li', { textContent: text })));
  $('photos').replaceChildren(
    ...rows.map((row) => {
      row.node = make('li', {}, make('span', { textContent: row.name }));
      for (const text of row.faults)
        row.node.append(make('div', { className: 'fault', textContent: text }));
      if (row.note) row.node.append(make('div', { textContent: row.note }));
      return row.node;
    }),
  );
}

// Puts what the server says to the photos that it names, or above all of them.
function blame(message) {
  const named = rows.filter((row) => message.includes(fileName(row.name)));
  for (const row of named)
    row.node.append(make('div', { className: 'fault', textContent: message }));
  if (!named.length && rows.length) $('faults').append(make('li', { textContent: message }));
}

async function upload(files) {
  if (!files.length) return;
  say('looking at the files …');
  const capture = await readCapture(files, say);
  showCapture(capture);
  const wrong = capture.rows.filter((row) => row.faults.length).length;
  if (capture.faults.length || wrong) {
    say(
      wrong
        ? `${wrong} photo${wrong === 1 ? ' is' : 's are'} wrong; nothing was sent.`
        : 'Nothing was sent.',
    );
    return;
  }
  say('sending …');
  $('progress').hidden = false;
  try {
    const answer = await server.send('/v1/scenes', capture.form, (share) => {
      $('progress').value = share;
    });
    made = answer.id;
    await list();
    await open(made);
  } catch (error) {
    $('progress').hidden = true;
    blame(error.message);
    failed(error);
  }
}

// ---- files out ------------------------------------------------------------------------------
function download(blob, name) {
  const url = URL.createObjectURL(blob),
    link = make('a', { href: url, download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 60000);
}

const nameOf = (ending) => `segsplat-${(state.scene.id || 'scene').slice(0, 8)}.${ending}`;

function picture() {
  drawing.draw(state.camera, state.kind);
  $('view').toBlob((blob) => download(blob, nameOf('png')));
  invalidate();
}

// A film of photos that all look one way turns to and fro: nothing is known of what is behind.
function proposeFilm(cameras) {
  const [first, ...others] = cameras.map(({ camera_to_world: m }) => [m[2], m[6], m[10]]);
  const around = !others.length || others.some((axis) => dot(first, axis) < 0);
  $('film-motion').value = around ? 'turn' : 'swing';
}

function filmPlan() {
  const side = Number($('film-side').value),
    [width, height] = filmSize($('stage').getBoundingClientRect(), side);
  const frames = FPS * Number($('film-seconds').value);
  // A recorder takes as many as the device draws.
  const most = globalThis.VideoEncoder ? '' : 'up to ';
  $('film-says').textContent = `${most}${frames} frames of ${width} × ${height}, ${FPS} a second`;
  return { width, height, frames, motion: $('film-motion').value };
}

async function makeAndKeepFilm() {
  const { motion, ...plan } = filmPlan(),
    camera = state.camera;
  flyTo.now = null;
  state.filming = new AbortController();
  const running = (is) => {
    $('film-make').disabled = is;
    $('over').hidden = is; // its lines would stand still, and are not in the film
    $('film-stop').hidden = $('progress').hidden = !is;
  };
  running(true);
  $('view').dataset.state = 'busy';
  say('making the video …');
  $('progress').value = 0;
  try {
    const blob = await makeFilm(
      drawing,
      (share) => onTurntable(camera, axisOf(camera), motion, share),
      {
        ...plan,
        kind: state.kind,
        signal: state.filming.signal,
        progress: (share) => ($('progress').value = share),
      },
    );
    download(blob, nameOf(blob.type.startsWith('video/mp4') ? 'mp4' : 'webm'));
    say(`The video is written: ${(blob.size / 1e6).toFixed(1)} MB.`);
  } catch (error) {
    if (error.name !== 'AbortError') throw error;
    say('The video is cancelled.');
  } finally {
    state.filming = null;
    running(false);
    look(state.camera, true);
  }
}

async function exportAs({ value: format, dataset }) {
  const query = new URLSearchParams({ format });
  const texts = textsShown();
  if ('lines' in dataset && texts.length) query.set('text', texts.join('\n'));
  say('writing the file …');
  const answer = await server.call(`/v1/scenes/${state.scene.id}/export?${query}`);
  const name = /filename="([^"]+)"/.exec(answer.headers.get('content-disposition') || '');
  download(await answer.blob(), name ? name[1] : `scene.${format}`);
  say('the file is written');
}

// ---- begin ----------------------------------------------------------------------------------
function bind() {
  bindView();
  const ready = (act) => () => state.camera && act();
  $('kind').onchange = () => {
    state.kind = Number($('kind').value);
    remember();
    invalidate();
  };
  $('photo').onchange = ready(() => {
    const photo = state.scene.cameras[Number($('photo').value)];
    if ($('photo').value !== '' && photo) flyTo(framing(photo));
  });
  const toggle = (id, name) =>
    ready(() => {
      state[name] = !state[name];
      $(id).setAttribute('aria-pressed', String(state[name]));
      if (name === 'measuring') {
        state.marks = [];
        $('picked').textContent = state.measuring ? 'Click two points.' : '';
      }
      invalidate();
    });
  $('frusta').onclick = toggle('frusta', 'frusta');
  $('measure').onclick = toggle('measure', 'measuring');
  $('save').onclick = ready(() => {
    const camera = state.camera,
      button = make('button', { textContent: `view ${state.kept.length + 1}` });
    state.kept.push(camera);
    button.onclick = () => flyTo(camera);
    $('kept').append(make('li', {}, button));
  });
  $('share').onclick = ready(async () => {
    remember();
    try {
      await navigator.clipboard.writeText(location.href);
      say('The link is copied: it has the scene, the view and the words.');
    } catch {
      say(`The link: ${location.href}`);
    }
  });
  $('shot').onclick = ready(picture);
  $('film').onclick = () => {
    const hidden = ($('film-form').hidden = !$('film-form').hidden);
    $('film').setAttribute('aria-expanded', String(!hidden));
    filmPlan();
  };
  $('film-form').onchange = filmPlan;
  $('film-form').onsubmit = (e) => {
    e.preventDefault();
    if (state.camera && !state.filming) makeAndKeepFilm().catch(failed);
  };
  $('film-stop').onclick = () => state.filming?.abort();
  $('export').onchange = ready(() => {
    const format = $('export').selectedOptions[0];
    $('export').value = '';
    if (format.value) exportAs(format).catch(failed);
  });
  $('ask').onsubmit = (e) => {
    e.preventDefault();
    find($('text').value)
      .then(() => {
        $('text').value = '';
      })
      .catch(failed);
  };
  $('cut').oninput = () => {
    const cut = Number($('cut').value);
    $('cut-says').textContent = cut.toFixed(2);
    for (const word of state.words) word.cut = cut;
    invalidate();
  };
  $('files').onchange = $('folder').onchange = (e) => {
    const files = [...e.target.files].map((file) => ({
      path: file.webkitRelativePath || file.name,
      file,
    }));
    upload(files).catch(failed);
    e.target.value = '';
  };
  addEventListener('dragover', (e) => {
    e.preventDefault();
    $('drop').classList.add('over');
  });
  addEventListener('dragleave', () => $('drop').classList.remove('over'));
  addEventListener('drop', (e) => {
    e.preventDefault();
    $('drop').classList.remove('over');
    if (!state.alone) dropped(e.dataTransfer).then(upload).catch(failed);
  });
  $('key-form').onsubmit = (e) => {
    e.preventDefault();
    server.key = $('key').value;
    $('key-form').hidden = true;
    list()
      .then(() => say('Choose a scene.'))
      .catch(failed);
  };
  $('theme').onclick = () => {
    const dark =
      getComputedStyle(document.documentElement).getPropertyValue('color-scheme').trim() ===
        'dark' ||
      (!document.documentElement.dataset.theme &&
        matchMedia('(prefers-color-scheme: dark)').matches);
    document.documentElement.dataset.theme = dark ? 'light' : 'dark';
  };
  addEventListener('hashchange', () => follow().catch(failed));
}

async function follow() {
  const { scene, camera, words, kind } = fromLink();
  state.kind = kind;
  $('kind').value = String(kind);
  if (state.alone) {
    if (camera) look(camera, true);
    return;
  }
  if (scene) await open(scene, camera, words);
}

async function begin() {
  bind();
  drawing = new Drawing($('view'), invalidate, (gone) => {
    $('view').dataset.state = 'busy';
    if (gone) say('The graphics device dropped the scene; it is loaded again when it is back.');
    else if (state.alone) own(state.camera).catch(failed);
    else if (state.scene) load(state.scene.id, state.camera).catch(failed);
  });
  if (!$('packed')) {
    await Promise.all([list(), follow()]);
    return;
  }
  state.alone = true;
  document.body.classList.add('alone');
  const answer = JSON.parse($('texts').textContent),
    link = fromLink();
  state.known = answer ? answer.results : [];
  state.floor = answer ? answer.scoring.coverage_floor : 0;
  $('known').append(...state.known.map(({ text }) => make('option', { value: text })));
  await own(link.camera);
  state.kind = link.kind;
  const words = link.words.length ? link.words : state.known.slice(0, 1).map((one) => one.text);
  for (const word of words) await find(word);
}

// Shows the scene that this file has in it.
async function own(camera) {
  const coded = $('packed').textContent,
    step = 1 << 20;
  let at = 0;
  await take(
    new ReadableStream({
      pull(to) {
        if (at >= coded.length) return to.close();
        to.enqueue(Uint8Array.from(atob(coded.slice(at, (at += step))), (c) => c.charCodeAt(0)));
      },
    }),
    camera,
  );
  const names = state.known.map((one) => one.text).join(', ');
  say(`${shown()}. ${names && `Words: ${names}`}`);
}

// For other pages' scripts and for tests: the camera, and one frame as it is drawn now.
globalThis.segsplat = {
  state,
  look,
  find,
  cameraOf,
  matrixOf,
  focalOf,
  get drawing() {
    return drawing;
  },
  pixels() {
    drawing.draw(state.camera, state.kind);
    return $('view').toDataURL('image/png');
  },
};
begin().catch(failed);
