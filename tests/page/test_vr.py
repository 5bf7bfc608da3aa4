"""The scene in a headset: a small fake of WebXR stands for one, with two eyes side by side."""

from __future__ import annotations

import numpy as np
from acts import Camera, look, settled, until
from playwright.sync_api import Page, expect

# The fake draws into the canvas: its left half is the left eye. `fakeXr.frame(views)` is a frame.
SIDE = 240
FAKE = """(() => {
  const side = %d, fake = (globalThis.fakeXr = { ended: false });
  class Layer {
    constructor(session, gl) {
      const framebuffer = gl.createFramebuffer(), texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, 2 * side, side);
      gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
      Object.assign(this, { gl, framebuffer });
      fake.layer = this;
    }
    getViewport({ eye }) {
      return { x: eye === 'left' ? 0 : side, y: 0, width: side, height: side };
    }
  }
  globalThis.XRWebGLLayer = Layer;
  WebGL2RenderingContext.prototype.makeXRCompatible = async () => {};
  const session = {
    renderState: {},
    updateRenderState(state) { Object.assign(this.renderState, state); },
    requestReferenceSpace: async (kind) => ({ kind }),
    requestAnimationFrame(call) { fake.call = call; },
    async end() { fake.ended = true; session.onend?.(); },
  };
  // Draws one frame from these views, and gives both eyes, rows from the top.
  fake.frame = (views) => {
    fake.call(0, { getViewerPose: () => ({ views }) });
    const { gl, framebuffer } = fake.layer, bytes = new Uint8Array(8 * side * side);
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.readPixels(0, 0, 2 * side, side, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return [...bytes];
  };
  Object.defineProperty(navigator, 'xr', { value: {
    isSessionSupported: async (kind) => kind === 'immersive-vr',
    requestSession: async () => { fake.ended = false; return session; },
  } });
})()""" % SIDE

# Tangents of the left, right, lower and upper edge of each eye, as a headset's: not in the middle.
EDGES = {"left": (-0.7, 0.5, -0.55, 0.65), "right": (-0.5, 0.7, -0.55, 0.65)}
APART_M = 0.064


def projection(eye: str) -> list[float]:
    """As WebXR gives it: of OpenGL, a column after the other."""
    left, right, low, high = EDGES[eye]
    near, far = 0.1, 1000.0
    rows = np.zeros((4, 4))
    rows[0, 0], rows[0, 2] = 2 / (right - left), (right + left) / (right - left)
    rows[1, 1], rows[1, 2] = 2 / (high - low), (high + low) / (high - low)
    rows[2, 2], rows[2, 3] = (far + near) / (near - far), 2 * far * near / (near - far)
    rows[3, 2] = -1
    return rows.T.ravel().tolist()


def view(eye: str, place: np.ndarray, turn: np.ndarray) -> dict:
    """An eye of a head that is at this place, turned so; axes are right, up and back."""
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = place + turn[:, 0] * (APART_M / 2) * (1 if eye == "right" else -1)
    return {"eye": eye, "projectionMatrix": projection(eye),
            "transform": {"matrix": pose.T.ravel().tolist()}}


def eyes_of(page: Page, views: list[dict]) -> list[np.ndarray]:
    """What both eyes see, once the order is that of the head."""
    for _ in range(40):
        page.evaluate("(views) => fakeXr.frame(views).length", views)
        page.wait_for_timeout(50)
        if page.evaluate("segsplat.drawing.settled"):
            break
    data = page.evaluate("(views) => fakeXr.frame(views)", views)
    both = np.array(data, np.uint8).reshape(SIDE, 2 * SIDE, 4)[::-1, :, :3].astype(float)
    return [both[:, :SIDE], both[:, SIDE:]]


def truth(page: Page, eye: np.ndarray, axes: np.ndarray, name: str) -> np.ndarray:
    """The same by a larger picture of the page whose middle is ahead: cut out."""
    left, right, low, high = EDGES[name]
    per = SIDE / (right - left)  # pixels for a tangent of 1, across
    tall = SIDE / (high - low)
    far = max(-left, right, -low, high)
    size = 2 * int(np.ceil(far * max(per, tall)))
    data = page.evaluate(
        """([eye, ahead, up, size, lens, corner, side]) => {
          const { drawing, state } = segsplat, { gl } = drawing;
          drawing.resize(size, size);
          const target = eye.map((v, i) => v + ahead[i]);
          drawing.draw({ eye, target, up, fov: 60 }, 0, { lens });
          const bytes = new Uint8Array(4 * side * side);
          gl.readPixels(...corner, side, side, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
          return [...bytes];
        }""",
        [eye.tolist(), axes[2].tolist(), (-axes[1]).tolist(), size,
         [per, tall, size / 2, size / 2],
         [round(size / 2 + left * per), round(size / 2 + low * tall)], SIDE])
    return np.array(data, np.uint8).reshape(SIDE, SIDE, 4)[::-1, :, :3].astype(float)


def test_without_a_headset_there_is_no_button(page: Page, url: str, splats: str) -> None:
    page.goto(f"{url}/#scene={splats}")
    settled(page)
    expect(page.locator("#vr")).to_be_hidden()


def test_both_eyes_are_drawn_from_where_the_headset_is(page: Page, url: str, splats: str) -> None:
    page.add_init_script(FAKE)
    page.set_viewport_size({"width": 1280, "height": 800})
    page.goto(f"{url}/#scene={splats}")
    settled(page)
    look(page, 0, [0, 0, 0])
    settled(page)
    # A unit is half a metre here: the scene has been measured.
    page.evaluate("segsplat.state.scale = { ...segsplat.state.scale, metres_per_unit: 0.5 }")
    base = Camera(page)
    up = np.array(page.evaluate("segsplat.state.upright || segsplat.state.camera.up"))
    up /= np.linalg.norm(up)
    expect(page.locator("#vr")).to_be_visible()
    page.click("#vr")
    expect(page.locator("#vr")).to_have_attribute("aria-pressed", "true")
    until(page, "fakeXr.call")
    ahead = base.axes[2] - up * (up @ base.axes[2])
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, up)
    world = np.stack([right, up, -ahead], axis=1)  # of the headset's axes
    angle = np.radians(12)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0],
                     [-np.sin(angle), 0, np.cos(angle)]])
    poses = [(np.zeros(3), np.eye(3)), (np.array([0.1, -0.05, 0.15]), turn)]
    seen = []
    for place, of in poses:
        views = [view(name, place, of) for name in ("left", "right")]
        got = eyes_of(page, views)
        for name, picture, one in zip(("left", "right"), got, views, strict=True):
            pose = np.array(one["transform"]["matrix"]).reshape(4, 4).T
            eye = base.eye + 2 * world @ pose[:3, 3]
            axes = world @ pose[:3, :3]
            want = truth(page, eye, np.stack([axes[:, 0], -axes[:, 1], -axes[:, 2]]), name)
            off = float(np.abs(picture - want).mean())
            print(f"{name} at {place}: {off:.2f} levels off, spread {want.std():.1f}")
            assert want.std() > 15, "the eye sees nothing"
            assert off < 0.5, f"{name} at {place} is {off} levels off"
        seen.append(got)
        # Each eye from its own place.
        assert np.abs(got[0] - got[1]).mean() > 3
    assert np.abs(seen[0][0] - seen[1][0]).mean() > 3, "the head moved and nothing else"
    page.click("#vr")
    expect(page.locator("#vr")).to_have_attribute("aria-pressed", "false")
    assert page.evaluate("fakeXr.ended")
    settled(page)
    assert page.evaluate("segsplat.drawing.canvas.clientWidth") > SIDE
