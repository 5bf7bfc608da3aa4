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
  try {
    const answer = await server.send('/v1/scenes', capture.form, (share) =>
      step.at('sending', share),
    );
    made = answer.id;
    if (!names.of(made)) names.give(made, nameFrom(files));
    await list();
    await open(made);
  } catch (error) {
    step.end();
    blame(error.message);
    failed(error);
  }
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
