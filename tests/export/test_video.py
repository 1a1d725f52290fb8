import os

import imageio.v3 as iio
import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from nimpostor_jax.export import video
from nimpostor_jax.export.video import write_gif, write_mp4, write_video


def gradients(count, height, width):
    """Smooth frames, which both codecs keep well; every frame differs."""
    y, x = np.mgrid[:height, :width] / max(height, width)
    return np.stack(
        [
            np.stack([0.2 + 0.6 * x, 0.2 + 0.6 * y, np.full_like(x, i / count)], -1)
            for i in range(count)
        ]
    )


@pytest.fixture
def read_mp4(monkeypatch):
    """A reader of frames and frame rate, kept from forking under jax's threads."""

    def read(path):
        with monkeypatch.context() as patch:
            patch.setenv("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
            return iio.imread(path, plugin="FFMPEG"), iio.immeta(path, plugin="FFMPEG")["fps"]

    return read


@pytest.mark.parametrize("as_bytes", [False, True])
def test_gif_round_trip(tmp_path, as_bytes):
    frames = gradients(5, 20, 31)
    pixels = np.rint(frames * 255).astype(np.uint8)
    write_gif(tmp_path / "new" / "a.gif", pixels if as_bytes else frames, fps=10)
    stored = iio.imread(tmp_path / "new" / "a.gif")[..., :3]
    assert stored.shape == (5, 20, 31, 3)
    # 256 colours a frame out of a two-dimensional gradient, dithered.
    assert np.abs(stored.astype(float) - pixels).mean() < 6
    with Image.open(tmp_path / "new" / "a.gif") as picture:
        assert picture.info["duration"] == 100 and picture.info["loop"] == 0
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a.gif"]


@pytest.mark.parametrize("height, width", [(32, 48), (33, 47), (20, 31), (1, 1)])
def test_mp4_round_trip(tmp_path, read_mp4, height, width):
    frames = gradients(6, height, width)
    write_mp4(tmp_path / "a.mp4", frames, fps=24)
    stored, fps = read_mp4(tmp_path / "a.mp4")
    even_height, even_width = height + height % 2, width + width % 2
    assert stored.shape == (6, even_height, even_width, 3)
    inner = stored[:, :height, :width] / 255.0
    assert np.abs(inner - frames).mean() < 0.03  # lossy, half-resolution chroma
    assert fps == 24


def test_mp4_pads_by_repeating_the_edge(tmp_path, read_mp4):
    write_mp4(tmp_path / "a.mp4", np.full((2, 17, 17, 3), 0.8), fps=5)
    stored, _ = read_mp4(tmp_path / "a.mp4")
    assert_allclose(stored / 255.0, 0.8, atol=0.02)  # no dark line; limited-range YUV rounding


def test_frames_may_be_a_list(tmp_path):
    frames = list(gradients(3, 16, 16).astype(np.float32))
    write_video(tmp_path / "a.GIF", frames, fps=20)
    assert iio.imread(tmp_path / "a.GIF").shape[0] == 3


def test_mp4_does_not_fork_under_jax(tmp_path, recwarn):
    jax.block_until_ready(jax.numpy.ones(3))  # jax warns of a fork once it runs
    before = dict(os.environ)
    write_mp4(tmp_path / "a.mp4", gradients(2, 16, 16), 10)
    assert [str(w.message) for w in recwarn if "fork" in str(w.message)] == []
    assert dict(os.environ) == before


def test_write_video_chooses_by_suffix(tmp_path):
    frames = gradients(2, 16, 16)
    write_video(tmp_path / "a.gif", frames, 10)
    write_video(tmp_path / "a.mp4", frames, 10)
    assert (tmp_path / "a.gif").read_bytes()[:6] in (b"GIF87a", b"GIF89a")
    assert (tmp_path / "a.mp4").read_bytes()[4:8] == b"ftyp"
    with pytest.raises(ValueError, match=r"a\.avi: the suffix must be one of \.gif, \.mp4"):
        write_video(tmp_path / "a.avi", frames, 10)


@pytest.mark.parametrize(
    "frames, message",
    [
        ([], "no frames"),
        (np.zeros((0, 4, 4, 3)), "no frames"),
        (np.zeros((2, 4, 4)), r"frame 0 must be \[H, W, 3\], got \(4, 4\)"),
        (np.zeros((2, 4, 4, 4)), r"frame 0 must be \[H, W, 3\], got \(4, 4, 4\)"),
        (
            [np.zeros((4, 4, 3)), np.zeros((4, 5, 3))],
            r"frame 1 is \(4, 5, 3\), frame 0 is \(4, 4, 3\)",
        ),
        ([np.zeros((4, 4, 3)), np.full((4, 4, 3), np.inf)], "frame 1: 48 non-finite"),
        (np.zeros((2, 4, 4, 3), np.int32), "frame 0: .*int32"),
    ],
)
@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_bad_frames(tmp_path, name, frames, message):
    with pytest.raises(ValueError, match=message) as caught:
        write_video(tmp_path / name, frames, 10)
    assert name in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "name, fps", [("a.gif", 0), ("a.gif", 51), ("a.gif", float("nan")), ("a.mp4", 0), ("a.mp4", -1)]
)
def test_bad_fps(tmp_path, name, fps):
    with pytest.raises(ValueError, match="fps"):
        write_video(tmp_path / name, gradients(2, 8, 8), fps)


@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_a_failing_writer_keeps_the_old_file(tmp_path, monkeypatch, name):
    write_video(tmp_path / name, gradients(2, 16, 16), 10)
    before = (tmp_path / name).read_bytes()

    def fail(path, *_, **__):
        path.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(video.iio, "imwrite", fail)
    with pytest.raises(OSError, match="disk full"):
        write_video(tmp_path / name, gradients(3, 16, 16), 10)
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert_array_equal((tmp_path / name).read_bytes(), before)
