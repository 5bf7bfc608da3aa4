"""The loaders on small folders of the exact layout: `python -m pytest benches/published` (with
torch and scikit-image where they are installed)."""

import io
import json

import numpy as np
import pytest
from PIL import Image

import re10k
import torchfile

torch = pytest.importorskip("torch")


def photo(width, height, seed):
    rows = np.linspace(0, 255, height)[:, None, None] * np.ones((1, width, 3))
    picture = (rows + np.arange(width)[None, :, None] * (seed + 1)) % 256
    file = io.BytesIO()
    Image.fromarray(picture.astype(np.uint8)).save(file, "JPEG", quality=95)
    return torch.from_numpy(np.frombuffer(file.getvalue(), np.uint8).copy())


@pytest.fixture
def data(tmp_path):
    pose = torch.tensor([1.0, 0, 0, 0.5, 0, 1, 0, -0.25, 0, 0, 1, 2])
    lens = torch.tensor([0.5, 0.9, 0.5, 0.5, 0, 0])
    example = {
        "url": "https://example.org/watch",
        "timestamps": torch.arange(3),
        "cameras": torch.cat([lens, pose]).repeat(3, 1),
        "key": "abc",
        "images": [photo(640, 360, seed) for seed in range(3)],
    }
    other = {**example, "key": "left out"}
    torch.save([other, example], tmp_path / "000000.torch")
    files = {"abc": "000000.torch", "left out": "000000.torch"}
    (tmp_path / "index.json").write_text(json.dumps(files))
    return tmp_path


def test_a_chunk_is_read_as_torch_reads_it(data):
    ours, theirs = torchfile.load(data / "000000.torch"), torch.load(data / "000000.torch")
    assert [row["key"] for row in ours] == [row["key"] for row in theirs]
    for name in ("cameras", "timestamps"):
        assert np.array_equal(ours[1][name], theirs[1][name].numpy())
    for a, b in zip(ours[1]["images"], theirs[1]["images"]):
        assert np.array_equal(a, b.numpy())


def test_a_file_that_makes_other_things_is_refused(tmp_path):
    torch.save({"model": torch.nn.Linear(1, 1)}, tmp_path / "x.torch")
    with pytest.raises(Exception, match="is no tensor"):
        torchfile.load(tmp_path / "x.torch")


def test_frames_are_cropped_with_their_cameras(data):
    index = {
        "abc": {"context": [0, 2], "target": [1]},
        "left out": None,
        "elsewhere": {"context": [], "target": []},
    }
    ((name, frames, context, target),) = re10k.sequences(data, index)
    assert (name, context, target) == ("abc", [0, 2], [1])
    assert frames.picture(1).shape == (256, 256, 3)
    lens, pose = frames.camera(1)
    # 640 x 360 becomes 455 x 256, and 99 columns go on the left.
    assert lens == pytest.approx({"fx": 227.5, "fy": 230.4, "cx": 128.5, "cy": 128.0})
    assert np.reshape(pose, (4, 4)) @ [0, 0, 0, 1] == pytest.approx([-0.5, 0.25, -2, 1])


def test_ssim_is_that_of_scikit_image():
    metrics = pytest.importorskip("skimage.metrics")
    rng = np.random.default_rng(0)
    a = rng.random((40, 50, 3))
    b = np.clip(a + rng.normal(0, 0.1, a.shape), 0, 1)
    want = metrics.structural_similarity(
        a, b, win_size=11, gaussian_weights=True, channel_axis=2, data_range=1
    )
    assert re10k.ssim(a, b) == pytest.approx(want, abs=1e-9)
    assert re10k.psnr(np.zeros((2, 2)), np.full((2, 2), 0.1)) == pytest.approx(20)
