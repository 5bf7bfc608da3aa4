// What was dropped: photos and their cameras, and what is wrong with each, before it is sent.
const PHOTO = /\.(jpe?g|png|webp)$/i,
  ARCHIVE = /\.(zip|tar)$/i,
  // Files of cameras that the server knows by their paths (docs/captures.md).
  CAMERAS = /(\.(json|txt|bin|npy|traj|pincam)|(^|\/)metadata)$/i,
  HIDDEN = /(^|\/)\./,
  UNREAD_FILE = /(^|\/)(points3D|rigs|frames|project)\.[^/]*$/i,
  UNREAD_FOLDER = /(^|\/)((lowres_|highres_)?depth|confidence)\//i,
  unread = (path) => UNREAD_FILE.test(path) || UNREAD_FOLDER.test(path);
// The formats of Gaussians stand in the list of exports.
const isSplats = (path) =>
  [...$('export').options].some(
    ({ dataset }) => dataset.splats && path.toLowerCase().endsWith('.' + dataset.splats),
  );
const fileName = (path) => path.split('/').pop();

// All files of a drop, with the paths that they have in dropped folders.
async function dropped(transfer) {
  const entries = [...transfer.items].map(
    (item) => item.webkitGetAsEntry && item.webkitGetAsEntry(),
  );
  if (entries.some((entry) => !entry)) {
    return [...transfer.files].map((file) => ({ path: file.name, file }));
  }
  const files = [];
  const walk = async (entry, folder) => {
    const path = folder + entry.name;
    if (entry.isFile) {
      files.push({ path, file: await new Promise((ok, no) => entry.file(ok, no)) });
      return;
    }
    const reader = entry.createReader();
    for (;;) {
      const some = await new Promise((ok, no) => reader.readEntries(ok, no));
      if (!some.length) return;
      for (const one of some) await walk(one, path + '/');
    }
  };
  for (const entry of entries) await walk(entry, '');
  return files;
}

// The form to send, a row for each photo with what is wrong with it, and faults of the whole.
async function readCapture(files) {
  files = files.filter(({ path }) => !HIDDEN.test(path));
  const form = new FormData(),
    rows = [],
    faults = [];
  const archive = files.find(({ path }) => ARCHIVE.test(path));
  if (archive) {
    form.append('archive', archive.file, fileName(archive.path));
    rows.push({ name: archive.path, faults: [] });
    return { form, rows, faults };
  }
  const photos = files.filter(({ path }) => PHOTO.test(path));
  const splats = files.find(({ path }) => isSplats(path));
  // COLMAP's points beside photos are no scene.
  if (splats && !photos.length) {
    form.append('splats', splats.file, fileName(splats.path));
    rows.push({ name: splats.path, faults: [] });
    return { form, rows, faults };
  }
  const find = (test) => files.find(({ path }) => test.test(fileName(path)));
  const described = files.filter(({ path }) => CAMERAS.test(path) && !unread(path));
  const json =
    find(/^(transforms|cameras)\.json$/i) ||
    find(/^transforms.*\.json$/i) ||
    (described.length === 1 && /\.json$/i.test(described[0].path) && described[0]);
  if (!json && described.length) {
    // The server reads it, and says what is wrong with it.
    const shown = photos.filter(({ path }) => !unread(path));
    for (const { path, file } of [...shown, ...described]) form.append(path, file, path);
    for (const { path } of shown) rows.push({ name: path, faults: [] });
    if (!shown.length) faults.push('No photos: add PNG, JPEG or WebP files.');
    return { form, rows, faults };
  }
  let list = [],
    part = 'cameras',
    body = null;
  try {
    if (json) {
      const text = await json.file.text(),
        read = JSON.parse(text);
      part = Array.isArray(read.cameras) ? 'cameras' : 'transforms';
      list = read.frames || read.cameras;
      body = text;
      if (!Array.isArray(list) || !list.length) throw new Error('it has no list "frames"');
      list = list.map((entry) => ({
        file: String(entry.file_path ?? entry.file ?? ''),
        pose: entry.transform_matrix ?? entry.camera_to_world,
      }));
    } else {
      faults.push(
        'No cameras: add a transforms.json, a cameras.json, or the folder of a capture with them.',
      );
    }
  } catch (error) {
    faults.push(`${json.path}: ${error.message}`);
    list = [];
  }
  const taken = new Set();
  const stem = (path) => path.replace(/\.[^./]*$/, '');
  for (const { file, pose } of list) {
    const wanted = file.replace(/^(\.\.?\/)+/, '');
    const fits = [
      (path) => path === wanted || path.endsWith('/' + wanted),
      (path) => fileName(path) === fileName(wanted),
      (path) => stem(fileName(path)) === fileName(wanted),
    ];
    const photo = fits
      .map((fit) => photos.find(({ path }) => !taken.has(path) && fit(path)))
      .find((found) => found);
    const row = { name: file || '(no name)', faults: [] };
    rows.push(row);
    const numbers = pose && pose.flat ? pose.flat(2) : [];
    if (![12, 16].includes(numbers.length) || !numbers.every(Number.isFinite)) {
      row.faults.push('its pose is not a 4 by 4 matrix of numbers');
    }
    if (!photo) {
      row.faults.push('the photo is missing');
      continue;
    }
    taken.add(photo.path);
    try {
      (await createImageBitmap(photo.file)).close();
    } catch {
      row.faults.push('it cannot be read as a picture');
    }
    form.append(file, photo.file, file);
  }
  for (const { path } of photos) {
    if (!taken.has(path) && list.length) {
      rows.push({ name: path, faults: [], note: 'no camera; it is left out' });
    }
  }
  if (!photos.length) faults.push('No photos: add PNG, JPEG or WebP files.');
  if (body) form.append(part, new Blob([body], { type: 'application/json' }), `${part}.json`);
  return { form, rows, faults };
}
