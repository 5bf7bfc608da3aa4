// What was dropped: photos and their cameras, and what is wrong with each, before it is sent.
const PHOTO = /\.(jpe?g|png|webp)$/i,
  ARCHIVE = /\.(zip|tar)$/i,
  SPLATS = /\.(ply|spz|sog|glb|splat)$/i;
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
  const splats = files.find(({ path }) => SPLATS.test(path));
  // COLMAP's points beside photos are no scene.
  if (splats && !photos.length) {
    form.append('splats', splats.file, fileName(splats.path));
    rows.push({ name: splats.path, faults: [] });
    return { form, rows, faults };
  }
  const find = (test) => files.find(({ path }) => test.test(fileName(path)));
  const json = find(/^transforms.*\.json$/i) || find(/\.json$/i);
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
    } else if (find(/^images\.(bin|txt)$/i)) {
      const cameras = await readColmap(find);
      body = JSON.stringify({ cameras });
      list = cameras.map(({ file, camera_to_world: pose }) => ({ file, pose }));
    } else {
      faults.push(
        'No cameras: add a transforms.json, a cameras.json, or COLMAP’s cameras and images.',
      );
    }
  } catch (error) {
    faults.push(`${json ? json.path : 'COLMAP'}: ${error.message}`);
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

// COLMAP's cameras and images, text or binary, as the list of a cameras.json.
const MODELS = {
  SIMPLE_PINHOLE: 'f cx cy',
  PINHOLE: 'fx fy cx cy',
  SIMPLE_RADIAL: 'f cx cy k1',
  RADIAL: 'f cx cy k1 k2',
  OPENCV: 'fx fy cx cy k1 k2 p1 p2',
};

async function readColmap(find) {
  const get = async (name) => {
    const binary = find(new RegExp(`^${name}\\.bin$`, 'i')),
      text = find(new RegExp(`^${name}\\.txt$`, 'i'));
    if (!binary && !text) throw new Error(`${name}.bin or ${name}.txt is missing`);
    return binary ? new DataView(await binary.file.arrayBuffer()) : await text.file.text();
  };
  const [cameras, images] = [await get('cameras'), await get('images')];
  const lenses = new Map(),
    found = [];
  const lens = (id, model, width, height, values) => {
    const names = MODELS[model];
    if (!names)
      throw new Error(
        `camera model ${model} is not known; it can be ${Object.keys(MODELS).join(', ')}`,
      );
    const of = { width, height };
    names.split(' ').forEach((name, i) => {
      of[name] = values[i];
    });
    if (of.f) {
      of.fx = of.fy = of.f;
      delete of.f;
    }
    lenses.set(id, of);
  };
  const image = (id, [w, x, y, z], t, file) => {
    const n = Math.hypot(w, x, y, z) || 1;
    [w, x, y, z] = [w / n, x / n, y / n, z / n];
    // Rows of world to camera are columns of camera to world.
    const r = [
      [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
      [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
      [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ];
    const row = (i) => [
      r[0][i],
      r[1][i],
      r[2][i],
      -(r[0][i] * t[0] + r[1][i] * t[1] + r[2][i] * t[2]),
    ];
    if (!lenses.has(id)) throw new Error(`${file}: there is no camera ${id}`);
    found.push({
      file,
      intrinsics: lenses.get(id),
      camera_to_world: [...row(0), ...row(1), ...row(2), 0, 0, 0, 1],
    });
  };
  if (typeof cameras === 'string') {
    for (const line of cameras.split('\n').filter((l) => l.trim() && !l.startsWith('#'))) {
      const [id, model, ...values] = line.trim().split(/\s+/);
      lens(Number(id), model, Number(values[0]), Number(values[1]), values.slice(2).map(Number));
    }
  } else {
    let at = 8;
    for (let n = Number(cameras.getBigUint64(0, true)); n > 0; n--) {
      const model = Object.keys(MODELS)[cameras.getInt32(at + 4, true)];
      const size = (i) => Number(cameras.getBigUint64(at + 8 + 8 * i, true));
      const count = model ? MODELS[model].split(' ').length : 0;
      const values = Array.from({ length: count }, (_, i) =>
        cameras.getFloat64(at + 24 + 8 * i, true),
      );
      lens(
        cameras.getInt32(at, true),
        model || `number ${cameras.getInt32(at + 4, true)}`,
        size(0),
        size(1),
        values,
      );
      at += 24 + 8 * count;
    }
  }
  if (typeof images === 'string') {
    // Each second line has points, and may be empty.
    const lines = images.split('\n').filter((l) => !l.startsWith('#'));
    for (let i = 0; i < lines.length; i += 2) {
      const words = lines[i].trim().split(/\s+/);
      if (words.length < 10) continue;
      const v = words.slice(1, 8).map(Number);
      image(Number(words[8]), v.slice(0, 4), v.slice(4), words.slice(9).join(' '));
    }
  } else {
    let at = 8;
    for (let n = Number(images.getBigUint64(0, true)); n > 0; n--) {
      const v = Array.from({ length: 7 }, (_, i) => images.getFloat64(at + 4 + 8 * i, true));
      const id = images.getInt32(at + 60, true),
        name = [];
      for (at += 64; images.getUint8(at); at++) name.push(images.getUint8(at));
      image(id, v.slice(0, 4), v.slice(4), new TextDecoder().decode(new Uint8Array(name)));
      at += 1;
      at += 8 + 24 * Number(images.getBigUint64(at, true));
    }
  }
  return found;
}
