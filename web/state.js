// What is shown, how it is said, and the link to it. All text from outside goes into text nodes.
const $ = (id) => document.getElementById(id);
const make = (tag, fields = {}, ...children) => {
  const node = Object.assign(document.createElement(tag), fields);
  node.append(...children);
  return node;
};
const labelled = (node, label) => {
  node.setAttribute('aria-label', label);
  node.title = label;
  return node;
};
const say = (text) => {
  $('says').textContent = text;
};
const failed = (error) => {
  if (error.name === 'AbortError') return; // something else was opened
  $('key-form').hidden = error.status !== 401 && error.status !== 403;
  if (!$('key-form').hidden) fold('side', true);
  say(error.message);
};
const count = (n) => n.toLocaleString(language);
const KINDS = ['colour', 'depth', 'alpha', 'mask'];

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
  sharpness: 1,
  moving: 0,
  alone: false,
  embedded: false,
  version: 0,
  understood: false,
  // What the server says of metres, up and ground; whether the ground is shown.
  scale: null,
  ground: false,
  holes: false,
  upright: null,
  filming: null,
  vr: null,
};
let drawing = null;

// ---- long steps -------------------------------------------------------------------------------
// The step at work: its name, and when it had which share. The time left is by its own speed.
const step = {
  name: '',
  begun: 0,
  from: 0,
  at(name, share) {
    const now = performance.now();
    if (this.name !== name || share < this.from)
      Object.assign(this, { name, begun: now, from: share });
    $('progress').hidden = false;
    $('progress').value = share;
    const done = share - this.from,
      taken = (now - this.begun) / 1000;
    const left = done > 0.02 && taken > 1 ? ((1 - share) * taken) / done : null;
    $('left').textContent = left === null ? '' : t('left', { time: timeOf(left) });
  },
  end() {
    this.name = '';
    $('progress').hidden = true;
    $('left').textContent = '';
  },
};

// A time to wait, coarse: nobody knows it to the second.
function timeOf(seconds) {
  if (seconds < 60) return t('seconds', { n: Math.max(1, Math.round(seconds)) });
  return t('minutes', { n: Math.round(seconds / 60) });
}

// ---- panels -----------------------------------------------------------------------------------
// Opens or folds one of the two side panels; where there is no room for both, the other folds.
function fold(id, open = !document.body.classList.contains(`${id}-open`)) {
  document.body.classList.toggle(`${id}-open`, open);
  $(`${id}-fold`).setAttribute('aria-expanded', String(open));
  const other = id === 'side' ? 'tools' : 'side';
  if (open && innerWidth < 760 && document.body.classList.contains(`${other}-open`)) fold(other);
  refit();
}

// ---- what this browser keeps --------------------------------------------------------------------
// A value for each scene, by its id.
class Kept {
  constructor(key) {
    this.key = key;
    this.all = {};
    try {
      this.all = JSON.parse(localStorage.getItem(key)) || {};
    } catch {
      /* a page from the disk may have no storage */
    }
  }
  of(id) {
    return this.all[id] || '';
  }
  give(id, value) {
    if (value) this.all[id] = value;
    else delete this.all[id];
    try {
      localStorage.setItem(this.key, JSON.stringify(this.all));
    } catch {
      /* then it is known until the page is closed */
    }
  }
}
// Names, given by hand or by what was dropped, and metres a unit of the capture. A link carries
// both.
const names = new Kept('names'),
  metres = new Kept('metres');

// Metres a unit, by the server or by this browser; 0 where no true length is known.
const metresKnown = () =>
  state.scale?.metres_per_unit || Number(metres.of(state.scene.id)) || 0;
const metre = () => metresKnown() || 1;
// A length of the scene as it is said: in metres where a true length is known. An area likewise.
const lengthOf = (units) => `${(units * metre()).toPrecision(3)}${metresKnown() ? ' m' : ''}`;
const areaText = (units) => `${(units * metre() ** 2).toPrecision(3)}${metresKnown() ? ' m' : ''}²`;
// How far over the ground a point is, in units; null where no ground is known.
const heightOf = (point) => {
  const ground = state.scale?.ground;
  return ground ? dot(ground.normal, add(point, ground.point, -1)) : null;
};

// ---- the link ---------------------------------------------------------------------------------
// The scene, its name, the pose, the words and the picture are in the fragment, which no server
// sees.
function fragment() {
  const { eye, target, up, fov } = state.camera,
    parts = new URLSearchParams();
  if (!state.alone) {
    parts.set('scene', state.scene.id);
    if (names.of(state.scene.id)) parts.set('name', names.of(state.scene.id));
    if (metresKnown()) parts.set('metre', metre().toPrecision(6));
  }
  parts.set('pose', [...eye, ...target, ...up, fov].map((v) => Number(v.toPrecision(9))).join(','));
  for (const text of textsShown()) parts.append('text', text);
  if (state.kind) parts.set('kind', KINDS[state.kind]);
  if (state.embedded) parts.set('embed', '1');
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
  return {
    scene: parts.get('scene'),
    name: parts.get('name') || '',
    metre: Math.max(0, Number(parts.get('metre'))) || 0,
    camera,
    words: parts.getAll('text').slice(0, TINTS.length),
    kind: Math.max(0, KINDS.indexOf(parts.get('kind'))),
    embedded: parts.has('embed'),
  };
}
