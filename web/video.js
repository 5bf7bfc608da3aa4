// Photos of a video: sharp frames, spread over the motion of the camera, chosen as the command line
// and the Python client choose them (src/cli/video.rs).
const VIDEO = /\.(mp4|mov|m4v|webm|mkv|avi|mpe?g|3gp)$/i,
  // Frames a second that are looked at, and all of them at most; width, height and the side of the
  // squares that are compared, pixels.
  LOOKED = { rate: 10, most: 600, width: 320, height: 240, square: 16 },
  // Frames that are taken for each second, at least and at most, and their longest side, pixels.
  TAKEN = { rate: 2, least: 16, most: 64, side: 2048 },
  // Motion that a frame has at least, grey levels: one of a camera that stands still counts too.
  MOTION_MIN = 0.05;

// Frames of a video as photos named by their times. `at` is told what is done meanwhile.
async function framesOf({ path, file }, at) {
  const video = make('video', { muted: true, playsInline: true, preload: 'auto' }),
    unread = () => new Error(t('video.unread', { name: path }));
  video.src = URL.createObjectURL(file);
  // The event of this name, or the browser's refusal of the file.
  const comes = (name) =>
    new Promise((ok, no) => {
      video.addEventListener(name, ok, { once: true });
      video.addEventListener('error', () => no(unread()), { once: true });
    });
  const seek = async (seconds) => {
    const there = comes('seeked');
    video.currentTime = seconds;
    await there;
  };
  try {
    await comes('loadeddata');
    // A video that was recorded in a page says how long it is once its end was seen.
    if (!Number.isFinite(video.duration)) await seek(1e9);
    const long = Number.isFinite(video.duration) ? video.duration : video.currentTime;
    if (!long || !video.videoWidth) throw unread();
    const step = Math.max(1 / LOOKED.rate, long / LOOKED.most),
      times = Array.from({ length: Math.ceil(long / step) }, (_, i) => i * step),
      small = canvasOf(LOOKED.width, LOOKED.height),
      looks = [];
    let before = null;
    for (const [i, seconds] of times.entries()) {
      at(t('video.looking', { percent: Math.round((100 * i) / times.length) }));
      await seek(seconds);
      const grey = greyOf(small, video),
        squares = squaresOf(grey),
        apart = before ? squares.map((level, k) => Math.abs(level - before[k])) : [0];
      looks.push({ sharp: sharpnessOf(grey), motion: mean(apart) });
      before = squares;
    }
    const wanted = Math.floor(long * TAKEN.rate),
      taken = chosenOf(looks, Math.min(Math.max(wanted, TAKEN.least), TAKEN.most)),
      scale = Math.min(1, TAKEN.side / Math.max(video.videoWidth, video.videoHeight)),
      whole = canvasOf(
        Math.round(video.videoWidth * scale),
        Math.round(video.videoHeight * scale),
      ),
      frames = [];
    for (const place of taken) {
      at(t('video.taking', { i: frames.length + 1, all: taken.length }));
      await seek(times[place]);
      whole.drawImage(video, 0, 0, whole.canvas.width, whole.canvas.height);
      const name = `${times[place].toFixed(2).padStart(8, '0')}s.jpg`,
        coded = await whole.canvas.convertToBlob({ type: 'image/jpeg', quality: 0.95 });
      frames.push({ path: name, file: new File([coded], name, { type: 'image/jpeg' }) });
    }
    return frames;
  } finally {
    URL.revokeObjectURL(video.src);
  }
}

const canvasOf = (width, height) =>
  new OffscreenCanvas(width, height).getContext('2d', { willReadFrequently: true });
const mean = (all) => all.reduce((sum, one) => sum + one, 0) / all.length;

// Grey levels of the frame that a video shows.
function greyOf(pen, video) {
  const { width, height } = LOOKED;
  pen.drawImage(video, 0, 0, width, height);
  const { data } = pen.getImageData(0, 0, width, height),
    grey = new Float32Array(width * height);
  for (let i = 0; i < grey.length; i++) {
    grey[i] = 0.299 * data[4 * i] + 0.587 * data[4 * i + 1] + 0.114 * data[4 * i + 2];
  }
  return grey;
}

// Mean square of the differences of a pixel to the mean of its four neighbours.
function sharpnessOf(grey) {
  const { width, height } = LOOKED;
  let sum = 0;
  for (let y = 1; y < height - 1; y++) {
    for (let i = y * width + 1; i < (y + 1) * width - 1; i++) {
      const around = grey[i - 1] + grey[i + 1] + grey[i - width] + grey[i + width];
      sum += (grey[i] - around / 4) ** 2;
    }
  }
  return sum / ((width - 2) * (height - 2));
}

// Means of squares less the mean of all: other light is no motion.
function squaresOf(grey) {
  const { width, height, square } = LOOKED,
    across = width / square,
    means = Array(across * (height / square)).fill(0);
  grey.forEach((level, i) => {
    const x = Math.floor((i % width) / square),
      y = Math.floor(i / width / square);
    means[y * across + x] += level / square ** 2;
  });
  const all = mean(means);
  return means.map((level) => level - all);
}

// Places of `count` frames at most: the motion is cut into equal parts, and the sharpest frame of
// each is taken.
function chosenOf(looks, count) {
  const motionOf = ({ motion }) => Math.max(motion, MOTION_MIN),
    total = looks.reduce((sum, look) => sum + motionOf(look), 0),
    best = new Map();
  let moved = 0;
  for (const [place, look] of looks.entries()) {
    // The middle of the frame's own motion says in which part it is.
    const part = Math.floor(((moved + 0.5 * motionOf(look)) / total) * count);
    moved += motionOf(look);
    const other = looks[best.get(part)];
    if (!other || look.sharp > other.sharp) best.set(part, place);
  }
  return [...best.values()];
}
