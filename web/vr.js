// The scene in a headset, where the browser has WebXR: both eyes are drawn by the page's renderer,
// from where the headset is. The session begins where the page looks from, the horizon level.
const ROOM_M = 3; // how far the middle of a scene is whose lengths nobody knows

// A view of a headset (x right, y up, z back, metres from where it began) as a camera of the page,
// seen from `base`; and its lens for a picture of this size, whose middle is not that of the eye.
function eyeOf({ projectionMatrix: p, transform }, base, { width, height }) {
  const m = transform.matrix,
    [x, , z] = axesOf({ ...base, target: add(base.eye, base.ahead) }),
    inWorld = (v) => add(add(x.map((k) => k * v[0]), base.up, v[1]), z, -v[2]),
    eye = add(base.eye, inWorld([m[12], m[13], m[14]]), base.perMetre);
  const ahead = inWorld([-m[8], -m[9], -m[10]]),
    camera = {
      eye,
      target: add(eye, ahead, base.reach),
      up: inWorld([m[4], m[5], m[6]]),
      fov: (2 * Math.atan(1 / p[5]) * 180) / Math.PI,
    };
  const [w, h] = [width / 2, height / 2];
  return { camera, lens: [p[0] * w, p[5] * h, w * (1 - p[8]), h * (1 + p[9])] };
}

// Where a headset begins: at the page's camera, upright.
function baseOf(camera, unitOf) {
  const up = axisOf(camera),
    z = axesOf(camera)[2],
    level = add(z, up, -dot(z, up)),
    flat = length(level) > 0.1 ? level : axesOf(camera)[1];
  return {
    eye: camera.eye,
    up,
    ahead: unit(add(flat, up, -dot(flat, up))),
    perMetre: metresKnown() ? 1 / metresKnown() : unitOf / ROOM_M,
    reach: length(add(camera.target, camera.eye, -1)),
  };
}

async function enterVr() {
  if (state.vr || state.filming) return;
  const gl = drawing.gl,
    session = await navigator.xr.requestSession('immersive-vr');
  session.onend = () => {
    state.vr = null;
    $('vr').setAttribute('aria-pressed', 'false');
    invalidate();
  };
  state.vr = session;
  try {
    await gl.makeXRCompatible();
    session.updateRenderState({ baseLayer: new XRWebGLLayer(session, gl, { antialias: false }) });
    const space = await session.requestReferenceSpace('local'),
      base = baseOf(state.camera, state.scene.unit);
    const show = (_, frame) => {
      if (state.vr !== session) return;
      session.requestAnimationFrame(show);
      const pose = frame.getViewerPose(space);
      if (pose && drawing.header && !drawing.lost)
        bothEyes(pose, session.renderState.baseLayer, base);
    };
    session.requestAnimationFrame(show);
    $('vr').setAttribute('aria-pressed', 'true');
  } catch (error) {
    await session.end();
    throw error;
  }
}

// One frame: the order is that of the head, for both eyes.
function bothEyes({ views }, layer, base) {
  const spots = views.map((view) => {
    view.requestViewportScale?.(view.recommendedViewportScale);
    const spot = layer.getViewport(view);
    return { spot, ...eyeOf(view, base, spot) };
  });
  const [{ camera }] = spots,
    middle = spots.reduce((sum, one) => add(sum, one.camera.eye, 1 / spots.length), [0, 0, 0]);
  flyTo.now = null;
  drawing.sort({ ...camera, eye: middle, target: add(middle, add(camera.target, camera.eye, -1)) },
    true);
  for (const { spot, camera, lens } of spots) {
    drawing.resize(spot.width, spot.height);
    drawing.draw(camera, state.kind, { lens, frame: layer.framebuffer, at: [spot.x, spot.y] });
  }
}

// The button is there where a headset can be.
async function offerVr() {
  const may = await navigator.xr?.isSessionSupported('immersive-vr').catch(() => false);
  $('vr').hidden = !may;
  $('vr').onclick = ready(() =>
    (state.vr ? state.vr.end() : enterVr()).catch((error) =>
      say(t('vr.failed', { why: error.message })),
    ),
  );
}
