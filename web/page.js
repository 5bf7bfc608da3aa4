// Begins the page: what is pressed, the link, a file that has its scene in it.
const ready = (act) => () => state.camera && act();

// Turns a switch of the state, and the button that shows it.
function press(id, name) {
  state[name] = !state[name];
  $(id).setAttribute('aria-pressed', String(state[name]));
  if (name === 'measuring') {
    state.marks = [];
    told(state.measuring ? t('measure.first') : '');
  }
  invalidate();
}

function bindTools() {
  $('kind').onchange = () => {
    state.kind = Number($('kind').value);
    remember();
    invalidate();
  };
  $('frusta').onclick = ready(() => press('frusta', 'frusta'));
  $('ground').onclick = ready(() => press('ground', 'ground'));
  $('measure').onclick = ready(() => press('measure', 'measuring'));
  $('save').onclick = ready(() => {
    state.kept.push(state.camera);
    showKept();
  });
  $('before').onclick = () => versions.show($('before').getAttribute('aria-pressed') !== 'true');
  $('share').onclick = ready(() => {
    remember();
    return copy(location.href, t('share.done'), t('share.link', { link: location.href }));
  });
  $('shot').onclick = ready(takePicture);
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
  offerVr();
  $('film-stop').onclick = () => state.filming?.abort();
  $('export').onchange = ready(() => {
    const { value: format, dataset } = $('export').selectedOptions[0];
    $('export').value = '';
    if (format) exportAs(format, 'lines' in dataset && textsShown().join('\n')).catch(failed);
  });
  $('embed').onclick = ready(askEmbedding);
  $('embedding-copy').onclick = () => {
    $('embedding-text').select();
    copy($('embedding-text').value, t('embed.done'), t('embed.how'));
  };
  $('cut').oninput = () => {
    const cut = Number($('cut').value);
    $('cut-says').textContent = cut.toFixed(2);
    for (const word of state.words) word.cut = cut;
    invalidate();
  };
}

function bindWays() {
  $('files').onchange = $('folder').onchange = (e) => {
    const files = [...e.target.files].map((file) => ({
      path: file.webkitRelativePath || file.name,
      file,
    }));
    upload(files).catch(failed);
    e.target.value = '';
  };
  $('sample').onclick = () => trySample().catch(failed);
  $('join').onchange = () => mayJoin(true);
  $('leave').onclick = askLeaving;
  addEventListener('dragover', (e) => {
    e.preventDefault();
    document.body.classList.add('over');
  });
  addEventListener('dragleave', (e) => {
    if (!e.relatedTarget) document.body.classList.remove('over');
  });
  addEventListener('drop', (e) => {
    e.preventDefault();
    document.body.classList.remove('over');
    if (!state.alone) dropped(e.dataTransfer).then(upload).catch(failed);
  });
  $('key-form').onsubmit = (e) => {
    e.preventDefault();
    server.key = $('key').value;
    $('key-form').hidden = true;
    list()
      .then(() => say(t('choose')))
      .catch(failed);
  };
}

function bind() {
  bindView();
  bindTools();
  bindEdits();
  bindWays();
  for (const id of ['side', 'tools']) $(`${id}-fold`).onclick = () => fold(id);
  $('ask').onsubmit = (e) => {
    e.preventDefault();
    find($('text').value)
      .then(() => {
        $('text').value = '';
      })
      .catch(failed);
  };
  $('name').onchange = ready(() => {
    names.give(state.scene.id, $('name').value.trim());
    remember();
    list().catch(failed);
  });
  $('theme').onclick = () => {
    const root = document.documentElement,
      dark = matchMedia('(prefers-color-scheme: dark)').matches;
    root.dataset.theme =
      (root.dataset.theme || (dark ? 'dark' : 'light')) === 'dark' ? 'light' : 'dark';
  };
  // Where nothing is written, "/" goes to the question and "?" to the help.
  addEventListener('keydown', (e) => {
    if (e.target.matches('input, textarea, select') || !state.camera) return;
    if (e.key === '/') {
      e.preventDefault();
      $('text').focus();
    }
    if (e.key === '?') {
      fold('tools', true);
      $('help-box').open = true;
      $('help-box').firstElementChild.focus();
    }
  });
  addEventListener('hashchange', () => follow().catch(failed));
}

async function follow() {
  const { scene, name, metre, camera, words, kind, embedded } = fromLink();
  state.embedded = embedded;
  document.body.classList.toggle('embedded', embedded);
  state.kind = kind;
  $('kind').value = String(kind);
  if (state.alone) {
    if (camera) look(camera, true);
    return;
  }
  if (scene && name && !names.of(scene)) names.give(scene, name);
  if (scene && metre && !metres.of(scene)) metres.give(scene, metre);
  if (scene) await open(scene, camera, words);
}

async function startDrawing() {
  drawing = new Drawing($('view'), invalidate, (gone) => {
    $('view').dataset.state = 'busy';
    if (gone) say(t('device.gone'));
    else if (state.alone) own(state.camera).catch(failed);
    else if (state.scene) load(state.scene.id, state.camera).catch(failed);
  });
  colour();
  const changed = new MutationObserver(colour);
  changed.observe(document.documentElement, { attributeFilter: ['data-theme'] });
  matchMedia('(prefers-color-scheme: dark)').onchange = colour;
}

// The colour of the page, to which the scene fades; after a change of the theme too.
function colour() {
  drawing.fog = getComputedStyle($('stage'))
    .backgroundColor.match(/[\d.]+/g)
    .slice(0, 3)
    .map((v) => v / 255);
  invalidate();
}

async function begin() {
  translate();
  bind();
  for (const id of ['side', 'tools']) fold(id, innerWidth >= (id === 'side' ? 1200 : 721));
  if (!$('packed')) {
    say(t('choose'));
    // The server answers while the device compiles.
    await Promise.all([follow(), state.embedded || list(), startDrawing()]);
    return;
  }
  state.alone = true;
  document.body.classList.add('alone');
  const answer = JSON.parse($('texts').textContent),
    link = fromLink();
  state.known = answer ? answer.results : [];
  state.floor = answer ? answer.scoring.coverage_floor : 0;
  $('known').append(...state.known.map(({ text }) => make('option', { value: text })));
  await startDrawing();
  await own(link.camera);
  await follow();
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
  const words = state.known.map((one) => one.text).join(', ');
  say(`${shown()}. ${words && t('alone.words', { words })}`);
}

// For other pages' scripts and for tests: the camera, and one frame as it is drawn now.
globalThis.segsplat = {
  state,
  look,
  find,
  cameraOf,
  matrixOf,
  focalOf,
  onPath,
  step,
  TABLE,
  get drawing() {
    return drawing;
  },
  pixels() {
    drawing.draw(state.camera, state.kind);
    return $('view').toDataURL('image/png');
  },
};
begin().catch(failed);
