// Edits of the scene: what is done to what is chosen, and the list that the server keeps. Views,
// answers and files of the server have them too, so a link shows them.
const edits = {
  list: [],
  counts: [], // Gaussians that each took
  uncovered: 0, // share of the photos that shows nothing now
  past: [], // lists before this one, and those that were undone
  future: [],
  turn: 0, // pictures of the scene before it are old
  work: Promise.resolve(),
  forget() {
    Object.assign(this, { list: [], counts: [], uncovered: 0, past: [], future: [] });
    Object.assign(holes, { of: '', picture: null });
    choose(null);
    showEdits();
  },
};
const HOLE = 0.001; // share of the photos from which a hole is said
// What an edit would take: { name, select, boxes, parts }, boxes as parts of words have them.
let chosen = null;

// ---- the list -----------------------------------------------------------------------------------
async function readEdits(id) {
  const kept = await server.json(`/v1/scenes/${id}/edits`);
  if (state.scene?.id === id) takeEdits(kept);
}

// Takes what the server says of its list, and the lists before and after it.
function takeEdits({ edits: list, counts, uncovered }, around = {}) {
  Object.assign(edits, around, { list, counts, uncovered });
  showEdits();
}

// Does one piece of work on the edits after the other, of the scene that is shown.
function inTurn(work) {
  const { id } = state.scene;
  edits.work = edits.work.then(() => state.scene?.id === id && work(id)).catch(failed);
  return edits.work;
}

// Puts what `change` makes of the list that is kept: the list, and the lists before and after it.
// Null changes nothing.
const changeEdits = (change) =>
  inTurn(async (id) => {
    const changed = change(edits);
    if (!changed) return;
    say(t('edits.doing'));
    const body = JSON.stringify({ edits: changed.list });
    const kept = await server.json(`/v1/scenes/${id}/edits`, { method: 'PUT', body });
    if (state.scene?.id !== id) return;
    takeEdits(kept, changed);
    await showEdited(id);
  });

// Shows what others made of the list meanwhile.
const lookAgain = () =>
  inTurn(async (id) => {
    const kept = await server.json(`/v1/scenes/${id}/edits`);
    const same = JSON.stringify(kept.edits) === JSON.stringify(edits.list);
    if (same || state.scene?.id !== id) return;
    takeEdits(kept, { past: [], future: [] });
    await showEdited(id);
  });

// A change that can be undone.
const edit = (change) =>
  changeEdits(({ list, past }) => ({ list: change(list), past: [...past, list], future: [] }));

// Back to the list before the last change; of a scene that was opened with edits, without the last.
const undo = () =>
  changeEdits(({ list, past, future }) => {
    if (!past.length && !list.length) return null;
    const before = past.length ? past.at(-1) : list.slice(0, -1);
    return { list: before, past: past.slice(0, -1), future: [...future, list] };
  });
const redo = () =>
  changeEdits(({ list, past, future }) => {
    if (!future.length) return null;
    return { list: future.at(-1), past: [...past, list], future: future.slice(0, -1) };
  });

async function showEdited(id) {
  edits.turn += 1;
  if (!(await takeChanged(id))) return;
  const last = edits.list.length - 1;
  const what = last < 0 ? t('edits.whole') : said(edits.list[last], edits.counts[last]);
  const share = (100 * edits.uncovered).toFixed(1);
  say([what, ...(edits.uncovered < HOLE ? [] : [t('edits.hole', { share })]), shown()].join('\n'));
}

// What an edit does, in words, and how many Gaussians it took.
const said = (one, n) => `${deedOf(one)} (${t('gaussians', { n: count(n) })})`;
function deedOf({ op, select }) {
  const kind = ['text', 'point', 'pick', 'box', 'sphere', 'floaters'].find((key) => select[key]);
  let what = kind === 'text' ? select.text : t(`edit.of.${kind}`);
  if (select.parts) what += ` ${select.parts.map((part) => part + 1).join(', ')}`;
  return t(`edit.${op}`, { what });
}

function showEdits() {
  const { list, counts } = edits,
    focused = document.activeElement?.closest('#edits button'),
    at = focused && [...$('edits').children].indexOf(focused.closest('li'));
  const button = (act, text, can, press, name) => {
    const node = make('button', { type: 'button', textContent: text, onclick: press });
    node.dataset.act = act;
    node.disabled = !can;
    return labelled(node, name);
  };
  const rows = list.map((one, i) => {
    const n = i + 1,
      took = t('gaussians', { n: count(counts[i]) });
    const swapped = (j) => () => {
      focusOn = j;
      edit((now) => now.map((_, k) => now[k === i ? j : k === j ? i : k]));
    };
    const away = () => edit((now) => now.filter((_, k) => k !== i));
    return make(
      'li',
      {},
      make('span', {}, deedOf(one), make('span', { className: 'soft', textContent: took })),
      button('up', '↑', i > 0, swapped(i - 1), t('edits.up', { n })),
      button('down', '↓', n < list.length, swapped(n), t('edits.down', { n })),
      button('away', '×', true, away, t('edits.away', { n })),
    );
  });
  $('edits').replaceChildren(...rows);
  $('edits-none').hidden = list.length > 0;
  $('edits-count').textContent = list.length ? count(list.length) : '';
  $('holes').hidden = edits.uncovered < HOLE;
  $('undo').disabled = !list.length && !edits.past.length;
  $('redo').disabled = !edits.future.length;
  if (!focused) return;
  // What was pressed is another node now: the same button of the edit, else the panel.
  const row = $('edits').children[focusOn ?? Math.min(at, list.length - 1)];
  const same = row?.querySelector(`[data-act=${focused.dataset.act}]:enabled`);
  (same || row?.lastChild || $('edits-panel').firstElementChild).focus();
  focusOn = null;
}
let focusOn = null; // the row to which the pressed one goes

// ---- holes --------------------------------------------------------------------------------------
// Stripes over what edits uncovered and no photo saw, as the server says of the view at rest.
const holes = { of: '', picture: null };
async function seeHoles(width, height) {
  const asked = viewQuery(width, height, { kind: 'holes', format: 'png' });
  const of = `${state.scene.id}/view?${asked}#${edits.turn}`;
  if (of === holes.of) return;
  Object.assign(holes, { of, picture: null });
  const answer = await server.call(`/v1/scenes/${of}`).catch((error) => {
    if (of === holes.of) holes.of = '';
    throw error;
  });
  const seen = await createImageBitmap(await answer.blob()),
    picture = make('canvas', { width, height }),
    pen = picture.getContext('2d');
  pen.drawImage(seen, 0, 0);
  const cells = pen.getImageData(0, 0, width, height),
    { data } = cells;
  for (let i = 0; i < data.length / 4; i++) {
    const striped = ((i % width) + Math.floor(i / width)) & 8;
    data.set([255, 0, 255, striped ? data[4 * i] : 0], 4 * i);
  }
  pen.putImageData(cells, 0, 0);
  if (of !== holes.of) return;
  holes.picture = picture;
  invalidate();
}

// ---- what is chosen -----------------------------------------------------------------------------
// A word, all of it or one of its parts, or the thing that was clicked.
const CUT = 0.5; // relevancy from which a text selects, where no other is given
function chooseWord({ text, point, cut, parts }) {
  const boxes = parts.slice(0, BOXES);
  if (point) return choose({ name: text, select: { point }, boxes });
  const select = { text, ...(cut === CUT ? {} : { cut }) };
  choose({ name: text, select, boxes, parts });
}

// A box around what is chosen, or in front of the camera; its sides go with the scene's up.
function chooseBox() {
  const axes = frameOf(state.camera),
    { unit } = state.scene;
  let center = state.camera.target,
    size = [0.3, 0.3, 0.3].map((side) => side * unit);
  if (chosen?.boxes.length === 1) {
    // Around all corners of the box that is there.
    const corners = cornersOf(chosen.boxes[0]);
    const ends = axes.map((axis) => {
      const along = corners.map((corner) => dot(corner, axis));
      return [Math.min(...along), Math.max(...along)];
    });
    size = ends.map(([low, high]) => high - low);
    center = axes.reduce((p, axis, k) => add(p, axis, (ends[k][0] + ends[k][1]) / 2), [0, 0, 0]);
  }
  choose({ name: t('edit.of.box'), boxes: [{ center, size, axes }], start: center });
  for (const [k, name] of ['box-wide', 'box-high', 'box-deep'].entries()) {
    $(name).value = Number((size[k] * metre()).toPrecision(3));
    $(name).step = Number((size[k] * metre() * 0.1).toPrecision(1));
  }
  for (const name of ['box-right', 'box-up', 'box-away']) {
    $(name).value = 0;
    $(name).step = Number((unit * metre() * 0.02).toPrecision(1));
  }
  boxChanged();
}

// The box by its fields: lengths, and how far it is from where it began.
function boxChanged() {
  const { boxes, start } = chosen,
    { axes } = boxes[0];
  const [right, up, away] = ['right', 'up', 'away'].map((n) => numberIn(`box-${n}`, 0) / metre());
  const center = [right, up, away].reduce((p, far, k) => add(p, axes[k], far), start);
  const size = ['wide', 'high', 'deep'].map((n) =>
    Math.max(0, numberIn(`box-${n}`, 0) / metre()),
  );
  chosen.boxes = [{ center, size, axes }];
  chosen.select = { box: { center, size, axes } };
  invalidate();
}

// Offers what can be done to it; null: to nothing.
function choose(what) {
  chosen = what;
  $('act').hidden = !what;
  invalidate();
  if (!what) return;
  $('act-on').textContent = what.name;
  for (const form of ['move', 'recolor']) opened(form, false);
  $('box-form').hidden = !what.start;
  const parts = what.parts || [];
  $('act-part').hidden = parts.length < 2;
  $('act-part').replaceChildren(
    make('option', { value: '', textContent: t('act.all') }),
    ...parts.map((_, i) => make('option', { value: i, textContent: t('act.part', { n: i + 1 }) })),
  );
  for (const name of ['right', 'up', 'away', 'turn']) $(`move-${name}`).value = 0;
  $('move-times').value = 1;
  for (const name of ['right', 'up', 'away']) {
    $(`move-${name}`).step = Number((0.02 * state.scene.unit * metre()).toPrecision(1));
  }
  for (const node of document.querySelectorAll('.of-length'))
    node.textContent = metresKnown() ? 'm' : t('units');
}

// One part of the word that is chosen, or all of it.
function choosePart() {
  const { value } = $('act-part'),
    { parts, select } = chosen;
  delete select.parts;
  if (value !== '') select.parts = [Number(value)];
  chosen.boxes = value === '' ? parts.slice(0, BOXES) : [parts[Number(value)]];
  invalidate();
}

function opened(form, is) {
  $(`${form}-form`).hidden = !is;
  $(`act-${form}`).setAttribute('aria-expanded', String(is));
  invalidate();
}

// What a field says, or another number where it says none.
const numberIn = (id, other) => {
  const value = Number($(id).value);
  return $(id).value !== '' && Number.isFinite(value) ? value : other;
};

// Right, up and away from the camera, level.
function frameOf(camera) {
  const up = axisOf(camera),
    right = unit(cross(axesOf(camera)[2], up));
  return [right, up, cross(up, right)];
}

// Where what is chosen goes, by the fields: a translation, an angle about up, a scale, and their
// centre.
function wayOfChosen() {
  const axes = frameOf(state.camera),
    { boxes } = chosen;
  const far = ['right', 'up', 'away'].map((name) => numberIn(`move-${name}`, 0) / metre());
  return {
    translation: far.reduce((sum, way, k) => add(sum, axes[k], way), [0, 0, 0]),
    angle: (numberIn('move-turn', 0) * Math.PI) / 180,
    up: axes[1],
    scale: numberIn('move-times', 1),
    center: boxes.reduce((sum, box) => add(sum, box.center, 1 / boxes.length), [0, 0, 0]),
  };
}

// The same as an edit has it.
function placement() {
  const { translation, angle, up, scale, center } = wayOfChosen(),
    sine = Math.sin(angle / 2);
  const rotation = [Math.cos(angle / 2), ...up.map((v) => v * sine)];
  return { translation, rotation, scale, center };
}

// The boxes that are drawn of what is chosen, and where it would go.
function outlines() {
  if (!chosen) return [];
  const lines = chosen.start ? [['#fff', chosen.boxes]] : [];
  if ($('move-form').hidden) return lines;
  const { translation, angle, up, scale, center } = wayOfChosen();
  const goes = (box) => ({
    center: add(add(center, translation), turned(add(box.center, center, -1), up, angle), scale),
    size: box.size.map((side) => side * scale),
    axes: box.axes.map((axis) => turned(axis, up, angle)),
  });
  return [...lines, ['#ff0', chosen.boxes.map(goes)]];
}

// Does it to what is chosen.
function act(op, more = {}) {
  if (!chosen) return;
  const one = { op, select: chosen.select, ...more };
  edit((list) => [...list, one]);
}
function actNoMore() {
  choose(null);
  $('view').focus();
}

function bindEdits() {
  $('undo').onclick = ready(undo);
  $('redo').onclick = ready(redo);
  $('holes').onclick = ready(() => press('holes', 'holes'));
  $('edit-box').onclick = ready(chooseBox);
  $('edit-floaters').onclick = ready(() =>
    edit((now) => [...now, { op: 'delete', select: { floaters: true } }]),
  );
  $('act-delete').onclick = () => act('delete');
  $('act-keep').onclick = () => act('keep');
  $('act-close').onclick = actNoMore;
  $('act').onkeydown = (e) => e.key === 'Escape' && actNoMore();
  $('act-part').onchange = choosePart;
  for (const form of ['move', 'recolor'])
    $(`act-${form}`).onclick = () => {
      const is = $(`${form}-form`).hidden;
      for (const one of ['move', 'recolor']) opened(one, is && one === form);
    };
  $('box-form').oninput = boxChanged;
  $('move-form').oninput = invalidate;
  $('box-form').onsubmit = (e) => e.preventDefault();
  $('move-form').onsubmit = (e) => {
    e.preventDefault();
    act(e.submitter?.value || 'move', placement());
  };
  $('recolor-form').onsubmit = (e) => {
    e.preventDefault();
    const color = [1, 3, 5].map((at) => parseInt($('color').value.slice(at, at + 2), 16) / 255);
    act('recolor', { color, amount: Number($('amount').value) });
  };
  document.addEventListener('visibilitychange', () => {
    if (state.scene) keepUp();
  });
  addEventListener('keydown', (e) => {
    if (e.target.matches('input, textarea, select') || !state.scene || state.alone) return;
    const key = e.key.toLowerCase(),
      control = e.ctrlKey || e.metaKey;
    const keys = control
      ? { z: e.shiftKey ? redo : undo, y: redo }
      : { delete: chosen && (() => act('delete')) };
    if (!keys[key] || state.embedded) return;
    e.preventDefault();
    keys[key]();
  });
}
