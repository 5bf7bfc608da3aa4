// What three.js makes of a file of Gaussians, in a browser: its loaders of `examples/jsm` as they
// are, drawn by its WebGPURenderer over WebGL 2.
import * as THREE from 'three/webgpu';
import { GLTFGaussianSplatLoaderExtension } from
  'three/addons/loaders/GLTFGaussianSplatLoaderExtension.js';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';

// What the file holds: a scene of three.js and the splats in it.
async function opened(url) {
  const loader = new GLTFLoader();
  loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
  const { scene } = await loader.loadAsync(url);
  let splats = null;
  scene.traverse((one) => { if (one.isGaussianSplat) splats = one; });
  return { scene, splats };
}

// Number of splats, bounds of their centres in the world, and a picture as three.js draws it.
// `pose`: camera-to-world, row by row, of a camera that looks along -z with y up. `fov`: degrees.
window.shown = async (url, pose, fov, width, height) => {
  const { scene, splats } = await opened(url);
  scene.updateMatrixWorld(true);
  const box = splats.splatGeometry.boundingBox.clone().applyMatrix4(splats.matrixWorld);
  const renderer = new THREE.WebGPURenderer({ forceWebGL: true });
  // Colours are those of the screen, as the file says. By default they would be encoded once more.
  renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  renderer.setPixelRatio(1);
  renderer.setSize(width, height);
  renderer.setClearColor(0x000000, 1);
  await renderer.init();
  const camera = new THREE.PerspectiveCamera(fov, width / height, 0.01, 1000);
  new THREE.Matrix4().set(...pose).decompose(camera.position, camera.quaternion, camera.scale);
  document.body.append(renderer.domElement);
  await renderer.renderAsync(scene, camera);
  const to = document.createElement('canvas');
  Object.assign(to, { width, height });
  to.getContext('2d').drawImage(renderer.domElement, 0, 0);
  return {
    count: splats.splatGeometry.getAttribute('position').count,
    bounds: [box.min.toArray(), box.max.toArray()],
    extras: splats.userData,
    png: to.toDataURL('image/png'),
  };
};
