// What was dropped: photos and their cameras, what is wrong with each, and what is made smaller,
// before it is sent.
const PHOTO = /\.(jpe?g|jfif|png|webp|tiff?|bmp)$/i,
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
// Photos of formats that are not read.
const OTHER_PHOTO = /\.(hei[cf]|avif|dng|jxl)$/i;
// Photos that the server reads and browsers do not.
const ONLY_SERVER = /\.tiff?$/i;
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

// The form to send, a row for each photo with what is wrong with it, faults of the whole, which
// stop it, and notes, which do not. `at` is told what is done meanwhile.
async function readCapture(files, at) {
  files = files.filter(({ path }) => !HIDDEN.test(path));
  const capture = { form: new FormData(), rows: [], faults: [], notes: [] },
    { form, rows, faults, notes } = capture;
  const video = files.find(({ path }) => VIDEO.test(path));
  if (video && !files.some(({ path }) => PHOTO.test(path) || ARCHIVE.test(path))) {
    try {
      files = await framesOf(video, at);
      notes.push(t('video.taken', { n: files.length, name: video.path }));
    } catch (error) {
      faults.push(error.message);
      return capture;
    }
  }
  const alone = (field, { path, file }) => {
    form.append(field, file, fileName(path));
    rows.push({ name: path, faults: [] });
    return capture;
  };
  const archive = files.find(({ path }) => ARCHIVE.test(path));
  if (archive) return alone('archive', archive);
  const photos = files.filter(({ path }) => PHOTO.test(path));
  const splats = files.find(({ path }) => isSplats(path));
  // COLMAP's points beside photos are no scene.
  if (splats && !photos.length) return alone('splats', splats);
  const others = files.filter(({ path }) => OTHER_PHOTO.test(path) && !unread(path));
  if (others.length) {
    const first = others[0].path,
      kind = first.split('.').pop().toUpperCase(),
      rest = others.length > 1 ? ` ${t('and.more', { count: others.length - 1 })}` : '';
    (photos.length ? notes : faults).push(t('unread', { files: first + rest, kind }));
  } else if (!photos.length) faults.push(t('photos.none'));
  const find = (test) => files.find(({ path }) => test.test(fileName(path)));
  const described = files.filter(({ path }) => CAMERAS.test(path) && !unread(path));
  const json =
    find(/^(transforms|cameras)\.json$/i) ||
    find(/^transforms.*\.json$/i) ||
    (described.length === 1 && /\.json$/i.test(described[0].path) && described[0]);
  if (!json && described.length) {
    // The server reads it, and says what is wrong with it.
    const shown = photos.filter(({ path }) => !unread(path));
    for (const { path } of shown) rows.push({ name: path, faults: [] });
    // COLMAP says the size of its photos, so they may be made smaller. Not all layouts do.
    const isColmap = described.some(({ path }) => /(^|\/)cameras\.(bin|txt)$/.test(path));
    const sent = await fit(shown, isColmap, notes, at);
    for (const { path, file } of [...sent, ...described]) form.append(path, file, path);
    return capture;
  }
  if (!json) {
    // The server finds their cameras.
    const shown = photos.filter(({ path }) => !unread(path));
    for (const { path } of shown) rows.push({ name: path, faults: [] });
    if (shown.length === 1) faults.push(t('photos.one'));
    if (shown.length > 1) notes.push(t('cameras.none'));
    for (const { path, file } of await fit(shown, true, notes, at)) form.append(path, file, path);
    return capture;
  }
  let read, list, part;
  try {
    read = JSON.parse(await json.file.text());
    part = Array.isArray(read.cameras) ? 'cameras' : 'transforms';
    list = read.frames || read.cameras;
    if (!Array.isArray(list) || !list.length) throw new Error(t('frames.none'));
  } catch (error) {
    faults.unshift(`${json.path}: ${error.message}`);
    return capture;
  }
  const [found, lost] = await paired(list, photos, rows);
  if (lost.length) {
    const which = { lost: lost.length, all: list.length, first: lost[0] };
    if (found.length) notes.push(t('cameras.left', which));
    else if (photos.length) faults.push(t('cameras.lost', which));
  }
  for (const { path, file, entry, size } of await fit(found, true, notes, at)) {
    // The lens is of the size that the photo had; cameras.json always says it.
    if (size && part === 'transforms') {
      entry.w ??= read.w ?? size[0];
      entry.h ??= read.h ?? size[1];
    }
    form.append(path, file, path);
  }
  for (const [path, file] of masksOf(list, files)) form.append(path, file, path);
  form.append(part, new Blob([JSON.stringify(read)], { type: 'application/json' }), `${part}.json`);
  return capture;
}

const MASK = /(^|\/)masks?\/.+$/i;

// The masks that cameras name: the server knows whose they are.
function masksOf(list, files) {
  const masks = new Map();
  for (const entry of list) {
    const name = String(entry.mask_path ?? '').replace(/^(\.\.?\/)+/, ''),
      found = name && files.find(({ path }) => `/${path}`.endsWith(`/${name}`));
    if (found) masks.set(name, found.file);
  }
  return masks;
}

// The photos that cameras name, each with its row, and the names of those that are not there.
async function paired(list, photos, rows) {
  const taken = new Set(),
    found = [],
    lost = [],
    stem = (path) => path.replace(/\.[^./]*$/, '');
  const names = list.map((entry) => String(entry.file_path ?? entry.file ?? '')),
    photoOf = names.map(() => null);
  // Whole paths are settled first for all, so that a shared file name never takes a photo.
  for (const fits of [
    (path, wanted) => path === wanted || path.endsWith('/' + wanted),
    (path, wanted) => fileName(path) === fileName(wanted),
    (path, wanted) => stem(fileName(path)) === fileName(wanted),
  ]) {
    for (const [i, name] of names.entries()) {
      const wanted = name.replace(/^(\.\.?\/)+/, '');
      photoOf[i] ||= photos.find(({ path }) => !taken.has(path) && fits(path, wanted));
      if (photoOf[i]) taken.add(photoOf[i].path);
    }
  }
  for (const [i, entry] of list.entries()) {
    const name = names[i],
      photo = photoOf[i],
      pose = entry.transform_matrix ?? entry.camera_to_world;
    const row = { name: name || t('nameless'), faults: [] };
    rows.push(row);
    if (!photo) {
      row.note = t('row.photo');
      lost.push(row.name);
      continue;
    }
    const numbers = pose && pose.flat ? pose.flat(2) : [];
    if (![12, 16].includes(numbers.length) || !numbers.every(Number.isFinite)) {
      row.faults.push(t('row.pose'));
    }
    found.push({ path: name.replace(/^(\.\.?\/)+/, ''), file: photo.file, entry, row });
    try {
      if (!ONLY_SERVER.test(photo.path)) (await createImageBitmap(photo.file)).close();
    } catch {
      row.faults.push(t('row.picture'));
    }
  }
  for (const { path } of photos) {
    if (taken.has(path) || MASK.test(path)) continue;
    rows.push({ name: path, faults: [], note: t('row.camera') });
  }
  return [found, lost];
}

// Photos of more bytes than these are made smaller before they are sent, though the server takes
// more: its networks look no closer.
const WHOLE_MAX = 256 * 2 ** 20;

// The photos as they are sent. An upload over the limit has some of them, evenly, and where that is
// not enough all are made smaller; so are photos of too many pixels. None gets smaller than the
// server keeps it.
async function fit(photos, mayShrink, notes, at = () => {}) {
  const bytes = (some) => some.reduce((sum, { file }) => sum + file.size, 0),
    mb = (n) => `${(n / 1e6).toPrecision(2 + (n > 1e8))} MB`,
    before = bytes(photos),
    { limits } = await server.models(),
    room = Math.min(limits.upload_bytes_max, WHOLE_MAX),
    most = limits.photos_max;
  let sent = photos;
  if (before > room && photos.length > most) {
    const step = (photos.length - 1) / Math.max(most - 1, 1);
    sent = Array.from({ length: most }, (_, i) => photos[Math.round(i * step)]);
    notes.push(t('photos.chosen', { all: photos.length, size: mb(before), sent: sent.length }));
  }
  if (!mayShrink) return sent;
  const all = bytes(sent) > room,
    // What the server keeps of those that networks see, and what fits: half a byte a pixel.
    kept = Math.min(
      limits.photos_pixels_kept_max / Math.min(sent.length, limits.network_photos_max),
      all ? (2 * room) / sent.length : Infinity,
    ),
    fitted = [];
  let made = 0;
  for (const [i, photo] of sent.entries()) {
    if (all) at(t('shrinking', { i: i + 1, all: sent.length }));
    const small = await smaller(photo.file, limits, all, kept).catch(() => null);
    if (small) made++;
    fitted.push({ ...photo, ...small });
  }
  if (made) {
    notes.push(t('shrunk', { n: made, before: mb(bytes(sent)), after: mb(bytes(fitted)) }));
  }
  return fitted;
}

// A photo as small as the server keeps one, with so many pixels at most, and its size before; null
// where it may go as it is.
async function smaller(file, limits, always, kept) {
  // A photo of fewer bytes a pixel than this is a plain area.
  const isPlain = file.size < limits.photo_pixels_max / 50;
  if (ONLY_SERVER.test(file.name) || (!always && isPlain)) return null;
  const [plain, exif] = await asStored(file),
    whole = await createImageBitmap(plain),
    { width, height } = whole,
    pixels = width * height,
    side = limits.photo_side_kept_max / Math.max(width, height),
    scale = Math.min(1, side, Math.sqrt(kept / pixels));
  if (scale === 1 || (!always && pixels <= limits.photo_pixels_max)) {
    whole.close();
    return null;
  }
  const canvas = new OffscreenCanvas(Math.round(width * scale), Math.round(height * scale)),
    pen = canvas.getContext('2d');
  pen.imageSmoothingQuality = 'high';
  pen.drawImage(whole, 0, 0, canvas.width, canvas.height);
  whole.close();
  const type = plain.type || 'image/jpeg',
    coded = await canvas.convertToBlob({ type, quality: 0.95 });
  const parts = exif ? [coded.slice(0, 2), exif, coded.slice(2)] : [coded];
  return { file: new Blob(parts, { type }), size: [width, height] };
}

// A JPEG without its EXIF block, and the block: the browser turns a picture by it, and cameras are
// of the picture as stored.
async function asStored(file) {
  const head = new DataView(await file.slice(0, 1 << 18).arrayBuffer()),
    is = (at, word) => at + 4 <= head.byteLength && head.getUint32(at) === word;
  if (head.byteLength < 4 || head.getUint16(0) !== 0xffd8) return [file, null];
  for (let at = 2; at + 4 <= head.byteLength && head.getUint8(at) === 0xff; ) {
    const mark = head.getUint8(at + 1),
      end = at + 2 + head.getUint16(at + 2);
    if (mark === 0xda) break;
    if (mark === 0xe1 && is(at + 4, 0x45786966))
      return [
        new Blob([file.slice(0, at), file.slice(end)], { type: 'image/jpeg' }),
        file.slice(at, end),
      ];
    at = end;
  }
  return [file, null];
}
