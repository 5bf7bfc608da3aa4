// What is asked of a scene: words, clicks, lengths.
const BOXES = 24, // of a word
  DOTS = 12, // parts that a word offers to fly to
  ASKED = 100; // names of what was clicked that one call asks

// ---- what is there, measuring -----------------------------------------------------------------
const told = (text) => {
  $('picked').textContent = text;
};

// What the server is asked of the view.
const viewQuery = (width, height, more) =>
  new URLSearchParams({
    camera_to_world: matrixOf(state.camera),
    fx: focalOf(state.camera, height),
    width,
    height,
    ...more,
  });

async function clicked(event) {
  const box = $('view').getBoundingClientRect(),
    [width, height] = drawing.size;
  const x = ((event.clientX - box.left) / box.width) * width,
    y = ((event.clientY - box.top) / box.height) * height,
    more = event.shiftKey;
  if (state.alone) {
    const local = drawing.pointAt(x, y);
    if (!local) return told(t('pick.nothing'));
    if (state.measuring) return mark(local);
    const depth = dot(add(local, state.camera.eye, -1), axesOf(state.camera)[2]);
    told(t('pick.far', { depth: lengthOf(depth) }));
    if (state.understood) await select(local, null, more);
    return;
  }
  const query = viewQuery(width, height, { x, y });
  const names = state.understood && !state.measuring ? await namesOffered() : [];
  if (!state.measuring) told(t('looking'));
  const found = await namedAt(query, names);
  if (!found.point) return told(t('pick.nothing'));
  if (state.measuring) return mark(found.point);
  const fits = found.labels.filter(({ relevancy }) => relevancy >= 0.5).slice(0, 3);
  const nameless = state.understood ? t('pick.nameless') : t('pick.later');
  told(
    [t('pick.far', { depth: lengthOf(found.depth) }), ...(fits.length ? [] : [nameless])].join(' '),
  );
  if (found.entry) await select(found.point, found.entry, more);
  if (fits.length) $('picked').append(t('pick.like'), ...fits.map(offer));
  const measure = make('button', { type: 'button', textContent: t('measure.here') });
  measure.onclick = () => {
    press('measure', 'measuring');
    mark(found.point);
  };
  $('picked').append(measure);
}

// What is at a point, and how well each of the names fits it, the best first: in as many calls as
// the names need.
async function namedAt(query, names) {
  const rest = [...names],
    calls = [];
  do {
    const asked = new URLSearchParams(query);
    rest.splice(0, ASKED).forEach((name) => asked.append('label', name));
    calls.push(server.json(`/v1/scenes/${state.scene.id}/pick?${asked}`));
  } while (rest.length);
  const found = await Promise.all(calls),
    labels = found.flatMap((one) => one.labels);
  return { ...found[0], labels: labels.sort((a, b) => b.relevancy - a.relevancy) };
}

// The words that a click may be named by: those that are shown, and those that are known well.
async function namesOffered() {
  const { words } = await server.models(),
    known = words.filter(({ trust }) => trust === 'good' || trust === 'fair');
  return new Set([...textsShown(), ...known.map(({ word }) => word)]);
}

// A word that fits what was clicked: pressed, all of its kind are found.
function offer({ text, relevancy }) {
  const button = make('button', { type: 'button' }, `${text} ${relevancy.toFixed(2)}`);
  button.onclick = () => find(text).catch(failed);
  return labelled(button, t('pick.all', { text }));
}

// Shows what is at a point as words are shown: all that the scene takes for the same, and a box
// around what touches the point, with its size. It takes the place of the thing before it, unless
// `more` things are wanted.
async function select(point, entry, more) {
  const up = axisOf(state.camera),
    right = unit(cross(up, axesOf(state.camera)[2]));
  const scene = state.scene,
    found = await drawing.thingAt(point, entry, [right, cross(right, up), up]);
  if (!found || state.scene !== scene) return;
  const scores = Array.from({ length: found.bank }, (_, m) => Number(m + 1 === found.entry));
  if (!more) state.words = state.words.filter((word) => !word.isThing);
  if (!state.words.some((word) => word.isThing)) state.things = 0;
  state.things += 1;
  show({
    text: t('thing', { n: state.things }),
    isThing: true,
    point,
    scores,
    entries: [found.entry],
    gaussians: found.gaussians,
    parts: [{ ...found, score: 1 }],
    score: 1,
  });
  if (!state.alone) chooseWord(state.words.at(-1));
  const [wide, deep, high] = found.size.map(lengthOf);
  $('picked').append(' ', t('pick.size', { wide, high, deep }), ' ');
}

// Nothing is selected or measured any more; words stay.
function letGo() {
  state.words = state.words.filter((word) => !word.isThing);
  if (state.measuring) press('measure', 'measuring');
  told('');
  choose(null);
  showWords();
}

// The texts of the words that are shown; things that were clicked have none.
const textsShown = () => state.words.filter((word) => !word.isThing).map((word) => word.text);

function mark(point) {
  state.marks = [...state.marks, point];
  measured();
  invalidate();
}

// Says the lengths, area and height of the points that are marked, and asks for the true length
// between two.
function measured() {
  const { marks } = state,
    legs = marks.slice(1).map((mark, i) => length(add(mark, marks[i], -1))),
    units = legs.reduce((sum, leg) => sum + leg, 0),
    high = heightOf(marks.at(-1)),
    says = [];
  if (marks.length === 1) says.push(t('measure.second'));
  else if (marks.length > 2) {
    says.push(t('measure.path', { length: lengthOf(units), area: areaText(areaOf(marks)) }));
  } else {
    says.push(t(metresKnown() ? 'measure.is' : 'measure.units', { length: lengthOf(units) }));
  }
  if (high !== null) says.push(t('measure.high', { height: lengthOf(high) }));
  told(says.join(' '));
  if (marks.length !== 2) return;
  const truth = make('input', { type: 'number', min: 0, step: 'any' });
  truth.onchange = () => giveLength(Number(truth.value), units).catch(failed);
  $('picked').append(' ', make('label', {}, t('measure.truth'), ' ', truth, ' m'));
}

// Keeps that so many units of the scene are a length in metres: with the scene, and in this browser
// where the scene is a file or its server takes no changes.
async function giveLength(truth, units) {
  const { id } = state.scene,
    here = () => metres.give(id, truth / units);
  if (state.alone) here();
  else {
    const body = JSON.stringify(truth ? { metres: truth, points: state.marks } : {}),
      put = server.json(`/v1/scenes/${id}/scale`, { method: 'PUT', body });
    const kept = await put.catch((error) => {
      if (error.status !== 403) throw error;
      here();
    });
    if (kept && state.scene.id === id) takeScale(kept);
  }
  measured();
  remember();
}

// Area of the polygon of some points, squared units.
function areaOf(marks) {
  const sides = marks.map((mark, i) => {
    const next = marks[(i + 1) % marks.length];
    return cross(add(mark, marks[0], -1), add(next, marks[0], -1));
  });
  return 0.5 * length(sides.reduce((sum, side) => add(sum, side)));
}

// What the server knows of the size of the scene and of its ground.
async function readScale(id) {
  const scale = await server.json(`/v1/scenes/${id}/scale`).catch(() => null);
  if (state.scene?.id === id) takeScale(scale);
}

function takeScale(scale) {
  state.scale = scale;
  if (scale) state.upright = scale.up;
  $('ground').hidden = !scale?.ground;
  const says = {
    none: t('scale.none'),
    capture: t('scale.capture'),
    given: t('scale.given'),
  };
  $('scale-says').textContent = says[scale?.source || 'none'];
  invalidate();
}

// ---- words ------------------------------------------------------------------------------------
async function find(text) {
  text = text.trim();
  if (!text || !state.scene) return;
  if (state.words.some((word) => word.text === text)) return;
  const scene = state.scene.id;
  let result = state.known.find((one) => one.text === text);
  if (!result) {
    if (state.alone) {
      const words = state.known.map((one) => one.text).join(', ');
      throw new Error(t('alone.knows', { words: words || t('alone.nothing') }));
    }
    say(t('looking'));
    const id = scene,
      stop = new AbortController();
    if (!state.understood) watchUnderstanding(id, stop.signal);
    try {
      const body = JSON.stringify({ texts: [text] });
      const answer = await server.json(`/v1/scenes/${id}/query`, { method: 'POST', body });
      if (state.scene.id !== id) return; // another scene was opened meanwhile
      result = answer.results[0];
      state.floor = answer.scoring.coverage_floor;
    } finally {
      stop.abort();
      step.end();
    }
    state.known.push(result);
    // Entries of the Gaussians are new: once.
    if (!state.understood) await load(id, state.camera);
  }
  const known = await knownWord(result);
  if (state.scene?.id !== scene) return;
  const score = Math.max(0, ...result.scores);
  show({ ...result, score, known });
  const where = { gaussians: count(result.gaussians), n: result.parts.length };
  say(
    [
      `${text}: ${result.found ? t('found', where) : t('found.not', { score: score.toFixed(2) })}`,
      ...doubtsOf(text, known),
      ...result.warnings.map((warning) => warning.message),
    ].join('\n'),
  );
}

// Asks for the words that are shown again, of a scene that was edited; what was clicked is let go.
async function askAgain() {
  letGo();
  state.known = [];
  const { id } = state.scene,
    texts = textsShown();
  if (!texts.length) return;
  const body = JSON.stringify({ texts });
  const answer = await server.json(`/v1/scenes/${id}/query`, { method: 'POST', body });
  if (state.scene?.id !== id) return;
  state.known = answer.results;
  state.words = state.words
    .map((word) => {
      const found = answer.results.find((one) => one.text === word.text);
      return found ? { ...word, ...found, score: Math.max(0, ...found.scores) } : word;
    })
    // What an edit took away dims the scene no more.
    .filter((word) => word.gaussians);
  showWords();
}

// One more word; the oldest goes where there is no colour left.
function show(word) {
  if (state.words.length === TINTS.length) state.words.shift();
  state.words.push({ ...word, cut: Number($('cut').value) });
  showWords();
}

// The first text has the semantics made, and their stages come as events.
function watchUnderstanding(id, signal) {
  server.watch(id, progress, signal, { semantics: true }).catch(() => {});
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
  if (!known.trust) return [t('doubt.unlisted', { text, n: known.words })];
  return [t(known.trust === 'poor' ? 'doubt.poor' : 'doubt.unmeasured', { text: known.word })];
}

function showWords() {
  drawing.ask(state.words, state.floor || 0);
  $('cut-row').hidden = !state.words.length;
  $('words').replaceChildren(...state.words.map(chip));
  remember();
}

// A word with its colour, its score, how well it is known, and its parts to fly to.
function chip(word, k) {
  const swatch = make('span', { className: 'swatch' });
  swatch.style.background = css(k);
  const score = make('span', {
    className: 'score',
    textContent: word.isThing
      ? t('clicked')
      : word.gaussians
        ? word.score.toFixed(2)
        : t('found.nothing'),
    title: t('score.title'),
  });
  if (word.known) {
    const trust = word.known.trust || 'unlisted';
    score.append(', ', make('span', { className: `trust ${trust}`, textContent: t(trust) }));
  }
  const parts = word.parts.slice(0, DOTS).map((part, i) => {
    const go = make('button', { type: 'button', textContent: i + 1 });
    go.classList.toggle('weak', strengthOf(part, word) < 0.6);
    go.onclick = () => flyToPart(part);
    const fits = { n: i + 1, text: word.text, score: part.score.toFixed(2) };
    return labelled(go, t('part', { ...fits, gaussians: count(part.gaussians) }));
  });
  const more = word.parts.length - DOTS;
  const take = make('button', { type: 'button', className: 'server', textContent: '↓' });
  take.onclick = () => exportAs('ply', word.text).catch(failed);
  const change = make('button', { type: 'button', className: 'server', textContent: '✎' });
  change.onclick = () => chooseWord(word);
  const remove = make('button', { type: 'button', textContent: '×' });
  remove.onclick = () => {
    state.words.splice(k, 1);
    if (chosen?.name === word.text) choose(null);
    if (word.isThing) told('');
    showWords();
    say(shown());
  };
  const item = make(
    'li',
    {},
    swatch,
    make('strong', { textContent: word.text }),
    ' ',
    score,
    make('span', { className: 'parts' }, ...parts, more > 0 ? `+${more}` : ''),
    labelled(remove, t('remove', { text: word.text })),
  );
  if (word.gaussians)
    item.lastChild.before(labelled(change, t('act.on', { text: word.text })));
  if (word.found) item.lastChild.before(labelled(take, t('word.take', { text: word.text })));
  item.classList.toggle('missing', !word.gaussians);
  return item;
}

function flyToPart(part) {
  const away = Math.max(1.2 * length(part.size), 0.1 * state.scene.unit);
  const back = unit(add(state.camera.eye, part.center, -1));
  flyTo({ ...state.camera, target: part.center, eye: add(part.center, back, away) });
}
