// The ways in: what was dropped goes to the server, or its faults are shown.
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
      if (row.note) row.node.append(make('div', { className: 'soft', textContent: row.note }));
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
  say(t('reading'));
  const capture = await readCapture(files, say);
  showCapture(capture);
  const wrong = capture.rows.filter((row) => row.faults.length).length;
  if (capture.faults.length || wrong) {
    fold('side', true);
    say(wrong ? t('photos.wrong', { n: wrong }) : t('not.sent'));
    return;
  }
  say(t('sending'));
  const sent = (share) => step.at('sending', share);
  try {
    if ($('join').checked) {
      const { id } = state.scene,
        photos = `/v1/scenes/${encodeURIComponent(id)}/photos`;
      made = id;
      await followChange(await server.send(photos, capture.form, sent));
      return;
    }
    for (const word of $('ignore').value.split(',')) {
      if (word.trim()) capture.form.append('ignore', word.trim());
    }
    made = (await server.send('/v1/scenes', capture.form, sent)).id;
    if (!names.of(made)) names.give(made, nameFrom(files));
    await list();
    await open(made);
  } catch (error) {
    step.end();
    blame(error.message);
    failed(error);
  }
}

// Whether what comes next may join the scene that is shown: one of photos.
function mayJoin(may) {
  $('join-row').hidden = !may;
  if (!may) $('join').checked = false;
  $('ignore-row').hidden = $('join').checked;
}

// Asks, then takes the photo that is looked through out of the scene.
function askLeaving() {
  const { id } = state.scene,
    { file } = frames.get(state.camera);
  const path = `/v1/scenes/${encodeURIComponent(id)}/photos/${encodeURIComponent(file)}`;
  const title = t('leave.ask', { name: file }),
    texts = { what: t('leave.what'), ever: t('leave.ever'), yes: t('leave.yes') };
  askFirst({ title, ...texts }, async () =>
    followChange(await server.json(path, { method: 'DELETE' })),
  );
}

// Waits until the scene is served with the photos that it has now, and shows it: the camera, the
// words and the edits stay. `told` is what the server answered to the change.
async function followChange(told) {
  const { id } = told;
  if (state.scene?.id !== id) return; // another scene was opened while the photos were sent
  const { signal } = watching,
    path = `/v1/scenes/${encodeURIComponent(id)}`,
    before = state.scene.cameras.length;
  while (told.growth.state === 'running') {
    await server.watch(id, progress, signal);
    told = await server.json(path, { signal });
  }
  step.end();
  if (told.growth.error) throw new Error(told.growth.error.message);
  state.version = told.version;
  if (!(await takeChanged(id))) return;
  about(told);
  await readEdits(id);
  const n = Math.abs(state.scene.cameras.length - before),
    key = state.scene.cameras.length < before ? 'left.photos' : 'joined';
  say(t(key, { n, shown: shown() }));
}

// A name by what was dropped: its folder, or the one file. Photos alone tell none.
function nameFrom(files) {
  const [first] = files[0].path.split('/');
  if (files.length === 1) return first.replace(/\.[^.]+$/, '');
  return first !== files[0].path && files.every(({ path }) => path.startsWith(`${first}/`))
    ? first
    : '';
}

// Photos of a room that the server generates, with their cameras.
async function trySample() {
  say(t('sample.comes'));
  const answer = await server.call('/sample.zip');
  const name = t('sample.name');
  await upload([{ path: `${name}.zip`, file: new File([await answer.blob()], `${name}.zip`) }]);
}
