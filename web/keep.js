// What leaves the page: pictures, videos, files, links.
function download(blob, name) {
  const url = URL.createObjectURL(blob),
    link = make('a', { href: url, download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 60000);
}

const fileNamed = (ending) => `segsplat-${(state.scene.id || 'scene').slice(0, 8)}.${ending}`;

function takePicture() {
  drawing.draw(state.camera, state.kind);
  $('view').toBlob((blob) => download(blob, fileNamed('png')));
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
  const key = globalThis.VideoEncoder ? 'film.says' : 'film.most';
  $('film-says').textContent = t(key, { frames, width, height, rate: FPS });
  return { width, height, frames, motion: $('film-motion').value };
}

// The views that were kept: buttons to fly there, and the way of a video.
function showKept() {
  const items = state.kept.map((camera, i) => {
    const n = i + 1,
      go = make('button', { type: 'button', textContent: n, onclick: () => flyTo(camera) });
    const drop = make('button', { type: 'button', textContent: '×' });
    drop.onclick = () => {
      state.kept.splice(i, 1);
      showKept();
    };
    return make('li', {}, labelled(go, t('kept.go', { n })), labelled(drop, t('kept.drop', { n })));
  });
  $('kept').replaceChildren(...items);
  const path = $('path-option');
  path.disabled = state.kept.length < 2;
  if (path.disabled && path.selected) proposeFilm(state.scene.cameras);
}

async function makeAndKeepFilm() {
  const { motion, ...plan } = filmPlan(),
    camera = state.camera,
    kept = [...state.kept];
  flyTo.now = null;
  state.filming = new AbortController();
  const running = (is) => {
    $('film-make').disabled = is;
    $('over').hidden = is; // its lines would stand still, and are not in the film
    $('film-stop').hidden = !is;
    if (!is) step.end();
  };
  running(true);
  $('view').dataset.state = 'busy';
  say(t('film.making'));
  const cameraAt =
    motion === 'path'
      ? (share) => onPath(kept, share)
      : (share) => onTurntable(camera, axisOf(camera), motion, share);
  try {
    const blob = await makeFilm(drawing, cameraAt, {
      ...plan,
      kind: state.kind,
      signal: state.filming.signal,
      progress: (share) => step.at('film', share),
    });
    download(blob, fileNamed(blob.type.startsWith('video/mp4') ? 'mp4' : 'webm'));
    say(t('film.done', { size: (blob.size / 1e6).toFixed(1) }));
  } catch (error) {
    if (error.name !== 'AbortError') throw error;
    say(t('film.cancelled'));
  } finally {
    state.filming = null;
    running(false);
    look(state.camera, true);
  }
}

// The scene as a file, or what a text selects of it.
async function exportAs(format, text) {
  const query = new URLSearchParams({ format });
  if (text) query.set('text', text);
  say(t('writing'));
  const answer = await server.call(`/v1/scenes/${state.scene.id}/export?${query}`);
  const name = /filename="([^"]+)"/.exec(answer.headers.get('content-disposition') || '');
  download(await answer.blob(), name ? name[1] : `scene.${format}`);
  say(t('written'));
}

async function copy(text, done, not) {
  try {
    await navigator.clipboard.writeText(text);
    say(done);
  } catch {
    say(not);
  }
}

// The view in another page: this address in a frame, without what stands around the canvas.
function askEmbedding() {
  remember();
  const link = new URL(location);
  link.hash += '&embed=1';
  const title = names.of(state.scene.id) || 'SegSplat';
  const frame = make('iframe', { width: 800, height: 600, title });
  frame.setAttribute('src', link);
  $('embedding-text').value = frame.outerHTML;
  $('embedding').showModal();
}
