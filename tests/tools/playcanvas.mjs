// What PlayCanvas' engine makes of our levels of detail, in a browser: its own asset `gsplat` of
// `lod-meta.json`, its own component, WebGL 2.
import * as pc from 'playcanvas';

// A picture of the levels `from` to `to` as the engine draws them, how many Gaussians it drew, how
// many the asset has, and its bounds.
// `pose`: camera-to-world, row by row, of a camera that looks along -z with y up. `fov`: degrees.
window.shown = async (url, pose, fov, width, height, from, to, antiAlias) => {
  const canvas = document.createElement('canvas');
  document.body.append(canvas);
  const app = new pc.Application(canvas, {
    graphicsDeviceOptions: { antialias: false, preserveDrawingBuffer: true },
  });
  app.setCanvasFillMode(pc.FILLMODE_NONE, width, height);
  app.setCanvasResolution(pc.RESOLUTION_FIXED, width, height);
  // By default it leaves small and faint ones out, and all over a million.
  Object.assign(app.scene.gsplat, {
    antiAlias, minPixelSize: 0, minContribution: 0, splatBudget: 1e7,
  });
  const asset = new pc.Asset('scene', 'gsplat', { url });
  app.assets.add(asset);
  await new Promise((done, fail) => {
    asset.ready(done);
    asset.once('error', (error) => fail(new Error(String(error))));
    app.assets.load(asset);
  });
  const splats = new pc.Entity();
  splats.addComponent('gsplat', { asset, lodRangeMin: from, lodRangeMax: to });
  app.root.addChild(splats);
  const camera = new pc.Entity(), at = new pc.Mat4();
  at.data.set([0, 1, 2, 3].flatMap((i) => [0, 1, 2, 3].map((j) => pose[4 * j + i])));
  camera.addComponent('camera', { fov, clearColor: pc.Color.BLACK, nearClip: 0.01 });
  camera.setPosition(at.getTranslation());
  camera.setRotation(new pc.Quat().setFromMat4(at));
  app.root.addChild(camera);
  // Ready twice, one after the other: what it sorts in a worker is there.
  const settled = new Promise((done, fail) => {
    let ready = 0;
    setTimeout(() => fail(new Error('no frame was ready in five minutes')), 300_000);
    app.systems.gsplat.on('frame:ready', (_camera, _layer, is, loading) => {
      ready = is && loading === 0 ? ready + 1 : 0;
      if (ready === 2) done();
    });
  });
  app.start();
  await settled;
  const { aabb, numSplats } = asset.resource;
  const bounds = [aabb.getMin(), aabb.getMax()].map(({ x, y, z }) => [x, y, z]);
  const drawn = app.stats.frame.gsplats, png = canvas.toDataURL('image/png');
  app.destroy();
  canvas.remove();
  return { bounds, count: numSplats, drawn, png };
};
