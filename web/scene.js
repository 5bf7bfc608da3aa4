// Reads a packed scene (crates/formats/src/packed.rs) as it comes, and sorts it in a worker.
const RECORD = 32,
  PART = 1 << 15, // records at a time: each time costs a copy
  // Most records: fewer where a finger points, on phones and tablets.
  MOST = matchMedia('(pointer: coarse)').matches ? 1 << 20 : 4 << 20,
  CELLS = [128, 64];

// Records of a scene: its coarser forms, then its Gaussians.
const recordsOf = ({ coarse, gaussians }) =>
  coarse.reduce((sum, form) => sum + form.gaussians, gaussians);

// Calls head(header, backdrop, count) once, which answers how many of them it takes, then
// part(first, words) for whole records as they come. Of a scene over MOST records the last ones are
// left out: the smallest Gaussians, or the fine form of what is farthest.
async function readPacked(stream, head, part) {
  const reader = stream.getReader();
  let kept = new Uint8Array(0),
    header = null,
    done = 0,
    count = 0;
  const backdrop = 3 * CELLS[0] * CELLS[1];
  for (;;) {
    const { value, done: end } = await reader.read();
    if (value) {
      const joined = new Uint8Array(kept.length + value.length);
      joined.set(kept);
      joined.set(value, kept.length);
      kept = joined;
    }
    if (!header && kept.length >= 4) {
      const size = new DataView(kept.buffer).getUint32(0, true),
        start = 4 + size + backdrop;
      if (kept.length >= start) {
        header = JSON.parse(new TextDecoder().decode(kept.subarray(4, 4 + size)));
        count = head(header, kept.slice(4 + size, start), Math.min(recordsOf(header), MOST));
        kept = kept.slice(start);
      }
    }
    // At first the coarsest form, where that is smaller.
    const whole = header ? Math.min(Math.floor(kept.length / RECORD), count - done) : 0;
    const least = Math.min(PART, (!done && header?.coarse[0]?.gaussians) || PART);
    if (whole > 0 && (end || done + whole === count || whole >= least)) {
      const bytes = kept.slice(0, whole * RECORD);
      part(done, new Uint32Array(bytes.buffer));
      done += whole;
      kept = kept.slice(whole * RECORD);
    }
    if (header && done === count) {
      reader.cancel();
      return header;
    }
    if (end) throw new Error(t('scene.short'));
  }
}

// Runs in the worker, which has all places. A counting sort of 16 bits, farthest first: a key is
// the upper bits of the f32 depth; what is behind has the top bit. And the thing at a place.
function sorter() {
  const OUTSIDE = 0.02; // share of Gaussians beyond each side of a box
  const ROW = 2048; // records of a coarser form that are replaced together
  // The records that are drawn, in runs from one to before the other: of a coarser form those
  // whose members have not all come, and the members of the others.
  const drawn = () => {
    const found = [];
    let start = 0,
      end = Infinity; // of what is drawn of this form
    for (const { gaussians, ends } of coarse) {
      const next = start + gaussians;
      let row = 0;
      while (row < ends.length && next + ends[row] <= known) row++;
      found.push([start + row * ROW, Math.min(end, next, known)]);
      end = row ? next + ends[row - 1] : next;
      start = next;
    }
    found.push([start, Math.min(end, known)]);
    return found.filter(([from, to]) => from < to);
  };
  // The Gaussians of an entry that touch each other around a place, as far as `reach` from one to
  // the next: how many they are, and the two ends along each axis of where nearly all of them are.
  // Without an entry it is that of the Gaussian nearest to the place.
  const thing = ({ place, entry, axes, reach }) => {
    let nearest = -1,
      least = Infinity,
      bank = 0;
    const runs = drawn();
    for (const [from, to] of runs)
      for (let i = from; i < to; i++) {
        bank = Math.max(bank, entries[i]);
        if (!entries[i] || (entry && entries[i] !== entry)) continue;
        let away = 0;
        for (let k = 0; k < 3; k++) away += (places[3 * i + k] - place[k]) ** 2;
        if (away < least) [nearest, least] = [i, away];
      }
    if (nearest < 0) return null;
    const of = entries[nearest],
      cellOf = (i) => [0, 1, 2].map((k) => Math.floor(places[3 * i + k] / reach)),
      cells = new Map();
    for (const [from, to] of runs)
      for (let i = from; i < to; i++) {
        if (entries[i] !== of) continue;
        const key = cellOf(i).join();
        if (cells.has(key)) cells.get(key).push(i);
        else cells.set(key, [i]);
      }
    const open = [cellOf(nearest)],
      found = [];
    while (open.length) {
      const at = open.pop(),
        here = cells.get(at.join());
      if (!here) continue;
      cells.delete(at.join());
      for (const i of here) found.push(i);
      for (let n = 0; n < 27; n++) {
        const step = [n % 3, Math.floor(n / 3) % 3, Math.floor(n / 9)];
        open.push(at.map((cell, k) => cell + step[k] - 1));
      }
    }
    const ends = axes.map((axis) => {
      const along = Float32Array.from(found, (i) =>
        axis.reduce((sum, a, k) => sum + a * places[3 * i + k], 0),
      ).sort();
      const out = Math.floor(OUTSIDE * along.length);
      return [along[out], along[along.length - 1 - out]];
    });
    return { entry: of, bank, gaussians: found.length, ends };
  };
  let places = new Float32Array(0),
    photos = new Uint16Array(0),
    entries = new Uint16Array(0),
    known = 0,
    coarse = [];
  let depths = new Float32Array(0);
  onmessage = ({ data }) => {
    if (data.place) {
      postMessage({ measured: thing(data) });
    } else if (data.count !== undefined) {
      places = new Float32Array(3 * data.count);
      photos = new Uint16Array(data.count);
      entries = new Uint16Array(data.count);
      depths = new Float32Array(data.count);
      known = 0;
      coarse = data.coarse;
    } else if (data.words) {
      const floats = new Float32Array(data.words.buffer),
        n = data.words.length / 8;
      for (let i = 0; i < n; i++) {
        places.set(floats.subarray(8 * i, 8 * i + 3), 3 * (data.first + i));
        photos[data.first + i] = data.words[8 * i + 7] & 0xffff;
        entries[data.first + i] = data.words[8 * i + 7] >>> 16;
      }
      known = data.first + n;
    } else {
      const begun = performance.now();
      const {
        eye,
        axis: [ax, ay, az],
        near,
        behind,
      } = data;
      const bits = new Uint32Array(depths.buffer),
        shift0 = ax * eye[0] + ay * eye[1] + az * eye[2];
      let low = 0xffffffff,
        high = 0,
        n = 0;
      const runs = drawn();
      for (const [from, to] of runs)
        for (let i = from; i < to; i++) {
          const z = ax * places[3 * i] + ay * places[3 * i + 1] + az * places[3 * i + 2] - shift0;
          depths[i] = z;
          if (!(z >= near)) {
            depths[i] = 0;
            continue;
          }
          n++;
          const b = bits[i];
          if (b < low) low = b;
          if (b > high) high = b;
        }
      let shift = 0;
      while (high > low && (high - low) >>> shift > 0x7fff) shift++;
      const starts = new Uint32Array(0x10001);
      // Whole rows of a texture.
      const order = new Uint32Array(2048 * Math.max(1, Math.ceil(n / 2048)));
      const key = (i) => 0xffff - (((bits[i] - low) >>> shift) | (behind[photos[i]] ? 0x8000 : 0));
      for (const [from, to] of runs)
        for (let i = from; i < to; i++) if (bits[i]) starts[key(i) + 1]++;
      for (let k = 0; k < 0x10000; k++) starts[k + 1] += starts[k];
      for (const [from, to] of runs)
        for (let i = from; i < to; i++) if (bits[i]) order[starts[key(i)]++] = i;
      const ms = performance.now() - begun;
      postMessage({ order, drawn: n, number: data.number, known, ms }, [order.buffer]);
    }
  };
}

// A worker of this page's own text: the policy allows workers of blobs alone.
function startSorter() {
  const url = URL.createObjectURL(new Blob([`(${sorter})()`], { type: 'text/javascript' }));
  const worker = new Worker(url);
  URL.revokeObjectURL(url);
  return worker;
}
