// The scenes of the server: their list, small pictures, opening, better versions, deletion.
const MOMENT = { dateStyle: 'medium', timeStyle: 'short' },
  SMALL = 200, // pixels across of a small picture
  AGAIN_MS = 5000, // until a server that ended its events is asked again
  COMPARED = 1 << 20; // Gaussians of a version that is kept to be compared with
let loading = null,
  watching = null,
  following = null;

// ---- the list ---------------------------------------------------------------------------------
async function list(after) {
  const page = await server.json(
    '/v1/scenes' + (after ? `?after=${encodeURIComponent(after)}` : ''),
  );
  if (!after) $('scenes').replaceChildren();
  $('none').hidden = Boolean(after) || page.scenes.length > 0;
  $('scenes').append(...page.scenes.map(row));
  $('more').hidden = !page.next;
  $('more').onclick = () => list(page.next).catch(failed);
}

// A scene of the list: picture, name, date and size.
function row(item) {
  const { id, report } = item,
    size = item.state === 'done' ? t('gaussians', { n: count(report.gaussians) }) : t(item.state);
  const button = make(
    'button',
    {
      type: 'button',
      onclick: () => {
        if (innerWidth < 760) fold('side', false);
        open(id).catch(failed);
      },
    },
    make('span', { className: 'small' }),
    make('span', { className: 'name', textContent: titleOf(item) }),
    make('span', {
      className: 'soft',
      textContent: new Date(item.created_ms).toLocaleString(language, MOMENT),
    }),
    make('span', { className: 'soft', textContent: size }),
  );
  button.dataset.id = id;
  button.setAttribute('aria-current', String(state.scene?.id === id));
  if (item.state === 'done') pictures.of(button.firstChild, id, `${item.version}.${edits.turn}`, 0);
  const remove = make('button', {
    type: 'button',
    textContent: '×',
    onclick: () => askDeletion(id),
  });
  return make('li', {}, button, labelled(remove, t('delete', { name: nameOf(id) })));
}

const nameOf = (id) => names.of(id) || id.slice(0, 8);

// The name of a scene, or what it was made of.
function titleOf({ id, report }) {
  if (names.of(id)) return names.of(id);
  if (!report) return id.slice(0, 8);
  const { file_format: format, photos } = report;
  return format ? t('title.file', { format }) : t('title.photos', { n: photos });
}

// Small pictures of what is on the screen: the server draws them, one at a time.
const pictures = {
  known: new Map(),
  wanted: new Map(), // nodes and the paths of their pictures
  busy: false,
  seen: new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) {
      target.toggleAttribute('data-seen', isIntersecting);
    }
    pictures.next();
  }),
  of(node, id, version, photo) {
    this.wanted.set(
      node,
      `/v1/scenes/${id}/view?from=${photo}&width=${SMALL}&format=jpeg#${version}`,
    );
    this.seen.observe(node);
  },
  async next() {
    if (this.busy) return;
    for (const node of this.wanted.keys()) if (!node.isConnected) this.forget(node);
    const found = [...this.wanted].find(([node]) => node.hasAttribute('data-seen'));
    if (!found) return;
    const [node, path] = found;
    this.busy = true;
    this.forget(node);
    try {
      if (!this.known.has(path)) {
        const answer = await server.call(path);
        this.known.set(path, URL.createObjectURL(await answer.blob()));
      }
      node.style.backgroundImage = `url(${this.known.get(path)})`;
    } catch {
      /* it has a number or a name beside it */
    }
    this.busy = false;
    this.next();
  },
  forget(node) {
    this.wanted.delete(node);
    this.seen.unobserve(node);
  },
};

// The photos to fly to.
function strip({ id, cameras }) {
  const stops = cameras.map((photo, i) => {
    const small = make('span', { className: 'small', textContent: i + 1 });
    const button = make('button', { type: 'button', onclick: () => flyTo(framing(photo)) }, small);
    if (!state.alone) pictures.of(small, id, `${state.version}.${edits.turn}`, i);
    return make('li', {}, labelled(button, photo.file));
  });
  $('stops').replaceChildren(...stops);
}

// Its place among the photos, whichever version of the scene it is of; -1: none is looked through.
const placeOf = (photo) =>
  photo ? state.scene.cameras.findIndex(({ file }) => file === photo.file) : -1;

// Marks the photo that is looked through.
function markStop(photo) {
  const at = placeOf(photo);
  for (const [i, { firstChild: button }] of [...$('stops').children].entries()) {
    if (button.getAttribute('aria-current') === String(i === at)) continue;
    button.setAttribute('aria-current', String(i === at));
    if (i === at) button.scrollIntoView({ block: 'nearest', inline: 'nearest' });
  }
  $('leave').disabled = at < 0;
}

// ---- deletion ---------------------------------------------------------------------------------
function askDeletion(id) {
  const title = t('delete.ask', { name: nameOf(id) }),
    texts = { what: t('delete.what'), ever: t('delete.ever'), yes: t('delete.yes') };
  askFirst({ title, ...texts }, () => deleteScene(id));
}

// The dialog closes with what is chosen; Escape chooses nothing.
function askFirst(texts, act) {
  for (const [part, text] of Object.entries(texts)) $(`deletion-${part}`).textContent = text;
  $('deletion').returnValue = '';
  $('deletion').onclose = () => {
    if ($('deletion').returnValue) act().catch(failed);
  };
  $('deletion').showModal();
}

async function deleteScene(id) {
  await server.call(`/v1/scenes/${id}`, { method: 'DELETE' });
  if (state.scene?.id === id) close();
  await list();
  say(t('deleted', { name: nameOf(id) }));
  names.give(id, '');
  $('scenes-title').focus(); // what was pressed is gone
}

// Shows no scene.
function close() {
  for (const work of [watching, loading, following, state.filming]) work?.abort();
  forget();
  Object.assign(state, { scene: null, camera: null, home: null });
  mayJoin(false);
  document.body.classList.remove('shown');
  history.replaceState(null, '', location.pathname);
}

// ---- opening ----------------------------------------------------------------------------------
function progress(event) {
  if (event.event === 'queued') say(t('ahead', { n: event.ahead }));
  if (event.event !== 'running') return;
  const stage = t(`stage.${event.stage}`);
  say(`${stage}: ${Math.round(100 * event.fraction)} %`);
  step.at('making', event.fraction);
}

// Opens a scene: waits for one that is being made, then loads and shows it.
async function open(id, camera, words = []) {
  following?.abort();
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
  step.end();
  if (scene.state !== 'done') {
    const why = scene.error ? scene.error.message : t('scene.is', { state: t(scene.state) });
    blame(why);
    throw new Error(why);
  }
  if (state.scene?.id !== id) forget();
  for (const warning of scene.report.warnings) blame(warning.message);
  state.version = scene.version;
  const isGrowing = scene.refinement.state === 'running';
  await load(id, camera, isGrowing && scene.report.gaussians <= COMPARED);
  about(scene);
  await readEdits(id);
  readScale(id);
  keepUp();
  for (const b of $('scenes').querySelectorAll('button[data-id]'))
    b.setAttribute('aria-current', String(b.dataset.id === id));
  for (const word of words) await find(word);
}

// Nothing of the scene before stays beside another one.
function forget() {
  Object.assign(state, { words: [], known: [], kept: [], marks: [], things: 0 });
  versions.forget();
  edits.forget();
  takeScale(null);
  for (const id of ['words', 'picked', 'stops']) $(id).replaceChildren();
  showKept();
}

// Loads the scene, the coarsest form or the largest Gaussians first, and shows it as it comes.
async function load(id, camera, isCompared = false) {
  loading?.abort();
  state.filming?.abort();
  loading = new AbortController();
  const { signal } = loading,
    begun = performance.now();
  versions.forget();
  say(t('loading'));
  try {
    const answer = await server.call(`/v1/scenes/${id}/export?format=packed`, { signal });
    await take(answer.body, camera, isCompared);
  } finally {
    if (!signal.aborted) step.end();
  }
  say(`${shown()}, ${((performance.now() - begun) / 1000).toFixed(1)} s`);
}

async function take(stream, camera, isCompared) {
  const first = { head: null, parts: [] };
  await readPacked(
    stream,
    (header, backdrop, most) => {
      state.scene = header;
      state.understood = header.understood;
      document.body.classList.add('shown');
      const taken = drawing.begin(header, backdrop, most);
      if (isCompared) first.head = [header, backdrop, most];
      state.upright = uprightOf(header.cameras);
      $('name').value = names.of(header.id);
      strip(header);
      state.home = framing(header.cameras[0]);
      if (state.words.length) showWords();
      look(camera || state.home, true);
      proposeFilm(header.cameras);
      return taken;
    },
    (at, words) => {
      if (isCompared) first.parts.push([at, words.slice()]);
      drawing.append(at, words);
      step.at('loading', drawing.loaded / drawing.count);
    },
  );
  if (isCompared) versions.before = first;
  remember();
}

// ---- better versions --------------------------------------------------------------------------
// The first and the newest version of a scene that was refined before one's eyes; each is
// { head, parts } as the server gave it.
const versions = {
  before: null,
  after: null,
  forget() {
    Object.assign(this, { before: null, after: null });
    $('before').hidden = true;
    $('before').setAttribute('aria-pressed', 'false');
  },
  // Shows the first one, or the newest again.
  show(isBefore) {
    const { head, parts } = isBefore ? this.before : this.after;
    $('before').setAttribute('aria-pressed', String(isBefore));
    state.scene = head[0];
    const taken = drawing.begin(...head);
    for (const [first, words] of parts) {
      if (first < taken) drawing.append(first, words.slice(0, 8 * (taken - first)));
    }
    if (state.words.length) showWords();
    invalidate();
  },
};

// Shows better versions and what others edit, while it is seen: browsers have few connections.
function keepUp() {
  following?.abort();
  if (!state.scene || state.alone || document.hidden) return;
  following = new AbortController();
  keepUpWith(state.scene.id, following.signal).catch(() => {});
}

async function keepUpWith(id, signal) {
  let newest = state.version,
    taking = false;
  const takeNewest = async () => {
    if (taking) return;
    taking = true;
    while (state.version < newest && !signal.aborted) {
      const version = newest;
      await takeVersion(id, signal);
      if (!signal.aborted) state.version = version;
    }
    taking = false;
  };
  const heard = ({ event, version, fraction }) => {
    if (event === 'edited') lookAgain();
    if (event !== 'version') return;
    $('gain').hidden = false;
    if (fraction < 1)
      $('gain-says').textContent = t('refining', { share: Math.round(100 * fraction) });
    newest = version;
    takeNewest().then(learn).catch(failed);
  };
  // Whether it is being refined.
  const learn = async () => {
    const scene = await server.json(`/v1/scenes/${id}`, { signal }),
      refined = scene.refinement.state === 'running';
    newest = Math.max(newest, scene.version);
    if (!refined) about(scene);
    return refined;
  };
  for (;;) {
    if (!(await learn()) && state.embedded) return;
    takeNewest().catch(failed);
    await server.watch(id, heard, signal, { edits: true });
    await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
  }
}

// Takes a version in place of the one that is shown.
async function takeVersion(id, signal) {
  if (await takeScene(id, signal)) say(t('better', { shown: shown() }));
}

// Takes the scene as it is now in place of what is shown, once it is here whole: camera and words
// stay. Gives whether it did.
async function takeScene(id, signal) {
  const answer = await server.call(`/v1/scenes/${id}/export?format=packed`, { signal });
  const taken = { head: null, parts: [] };
  await readPacked(
    answer.body,
    (...head) => {
      taken.head = head;
      return head[2];
    },
    (first, words) => taken.parts.push([first, words]),
  );
  if (signal.aborted || state.filming) return false;
  versions.after = taken;
  versions.show(false);
  if (!versions.before) versions.after = null;
  $('before').hidden = !versions.before;
  return true;
}

// Takes a scene that was changed as it is now, and asks for the words that are shown again. Gives
// whether it is still the one that is shown.
async function takeChanged(id) {
  choose(null);
  versions.forget();
  await takeScene(id, watching.signal);
  if (state.scene?.id !== id) return false;
  strip(state.scene);
  markStop(frames.get(state.camera));
  list().catch(failed);
  await askAgain();
  return true;
}

// How many Gaussians there are, and which of them where there is no room for all.
function shown() {
  const all = state.scene.gaussians;
  if (drawing.count === recordsOf(state.scene)) return t('gaussians', { n: count(all) });
  const some = state.scene.coarse.length ? 'gaussians.coarse' : 'gaussians.some';
  return t(some, { n: count(drawing.count), all: count(all) });
}

// What the report of a scene says, and what refinement gained.
function about(scene) {
  const { report } = scene;
  $('name').placeholder = titleOf(scene);
  mayJoin(!report.file_format);
  const times = report.stages
    .map(({ stage, ms }) => `${stage} ${(ms / 1000).toFixed(1)} s`)
    .join(', ');
  const n = count(report.gaussians),
    of = { n, format: report.file_format, used: report.views_used, photos: report.photos };
  $('about').textContent = [
    t(report.file_format ? 'about.file' : 'about.photos', of),
    times,
    ...report.warnings.map((warning) => `${warning.code}: ${warning.message}`),
  ].join('\n');
  const { psnr_before: from, psnr_after: to } = report.refinement || {};
  $('gain').hidden = !from;
  if (!from) return;
  const gain = { from: from.toFixed(1), to: to.toFixed(1) };
  $('gain-says').textContent = t('gain', gain);
}
