import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from nimpostor_jax.io.images import (
    area_downsample,
    composite,
    image_header,
    read_image,
    to_uint8,
    unpremultiply,
    write_png,
)

ROUNDING = 1e-6  # a few float32 units in the last place at 1


def test_read_image_premultiplies(tmp_path, rgba):
    pixels = rgba(5, 7)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    image, has_alpha = read_image(tmp_path / "a.png")
    straight = pixels / 255.0
    assert has_alpha and image.dtype == np.float32
    assert_allclose(image[..., :3], straight[..., :3] * straight[..., 3:], atol=ROUNDING)
    assert_allclose(image[..., 3], straight[..., 3], atol=ROUNDING)
    assert image_header(tmp_path / "a.png") == (7, 5, True)


@pytest.mark.parametrize("mode, channels", [("RGB", 3), ("L", 1)])
def test_image_without_alpha_is_opaque_and_says_so(tmp_path, rgba, mode, channels):
    Image.fromarray(rgba(4, 4)).convert(mode).save(tmp_path / "a.png")
    image, has_alpha = read_image(tmp_path / "a.png")
    assert not has_alpha and image.shape == (4, 4, 4)
    assert (image[..., 3] == 1).all()


def test_palette_with_transparency_has_alpha(tmp_path):
    picture = Image.new("P", (2, 1))
    picture.putdata([0, 1])
    picture.save(tmp_path / "a.png", transparency=0)
    image, has_alpha = read_image(tmp_path / "a.png")
    assert has_alpha and image[0, 0, 3] == 0 and image[0, 1, 3] == 1


def test_missing_image_is_named(tmp_path):
    for read in (read_image, image_header):
        with pytest.raises(FileNotFoundError, match=r"gone\.png does not exist"):
            read(tmp_path / "gone.png")


def test_unreadable_image_is_named(tmp_path):
    (tmp_path / "text.png").write_text("not a picture")
    for read in (read_image, image_header):
        with pytest.raises(ValueError, match=r"text\.png is not a readable image"):
            read(tmp_path / "text.png")


def test_truncated_image_is_named(tmp_path, rgba):
    Image.fromarray(rgba(40, 40)).save(tmp_path / "whole.png")
    data = (tmp_path / "whole.png").read_bytes()
    for keep in (len(data) // 2, len(data) - 40, 20):
        (tmp_path / "cut.png").write_bytes(data[:keep])
        with pytest.raises(ValueError, match=r"cut\.png"):
            read_image(tmp_path / "cut.png")


def test_changed_bytes_are_not_read_as_pixels(tmp_path, rgba):
    Image.fromarray(rgba(40, 40)).save(tmp_path / "a.png")
    data = bytearray((tmp_path / "a.png").read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.png is damaged"):
        read_image(tmp_path / "a.png")


def test_sixteen_bit_image_is_refused(tmp_path):
    Image.fromarray(np.full((4, 4), 40000, np.uint16)).save(tmp_path / "deep.png")
    with pytest.raises(ValueError, match=r"deep\.png has pixel type 'I;16'"):
        read_image(tmp_path / "deep.png")


@pytest.mark.parametrize("size", [(6, 9), (4, 3), (5, 7), (12, 1), (11, 8)])  # height, width
def test_area_downsample_against_a_loop(rng, size):
    image = rng.random((12, 9, 4)).astype(np.float32)
    height, width = size
    expected = np.zeros((height, width, 4))
    for i in range(height):
        for j in range(width):
            top, bottom = i * 12 / height, (i + 1) * 12 / height
            left, right = j * 9 / width, (j + 1) * 9 / width
            for y in range(12):
                for x in range(9):
                    h = max(0, min(bottom, y + 1) - max(top, y))
                    w = max(0, min(right, x + 1) - max(left, x))
                    expected[i, j] += h * w * image[y, x]
            expected[i, j] /= (bottom - top) * (right - left)
    result = area_downsample(image, width, height)
    assert result.dtype == np.float32 and result.shape == expected.shape
    assert_allclose(result, expected, atol=ROUNDING)


def test_area_downsample_keeps_the_mean_and_constants(rng):
    image = rng.random((31, 17, 4)).astype(np.float32)
    small = area_downsample(image, 7, 10)
    assert_allclose(small.mean((0, 1)), image.mean((0, 1)), atol=ROUNDING)
    assert_allclose(area_downsample(np.ones((31, 17, 4), np.float32), 7, 10), 1, atol=ROUNDING)


def test_area_downsample_to_the_same_size_is_a_copy(rng):
    image = rng.random((5, 6, 4)).astype(np.float32)
    same = area_downsample(image, 6, 5)
    assert_array_equal(same, image)
    assert not np.shares_memory(same, image)


def test_clear_pixels_do_not_bleed(tmp_path):
    pixels = np.array([[[255, 0, 0, 255], [0, 255, 0, 0]]], np.uint8)  # red beside clear green
    Image.fromarray(pixels).save(tmp_path / "a.png")
    small = area_downsample(read_image(tmp_path / "a.png")[0], 1, 1)
    assert_allclose(unpremultiply(small)[0, 0], [1, 0, 0, 0.5], atol=ROUNDING)


@pytest.mark.parametrize("width, height", [(10, 5), (5, 13), (0, 5), (5, 0)])
def test_area_downsample_refuses_other_sizes(width, height):
    with pytest.raises(ValueError, match=rf"cannot downsample 9x12 to {width}x{height}"):
        area_downsample(np.zeros((12, 9, 4), np.float32), width, height)


def test_composite():
    half_red = np.array([[0.5, 0, 0, 0.5]], np.float32)
    assert_allclose(composite(half_red, "white"), [[1, 0.5, 0.5]])
    assert_allclose(composite(half_red, "black"), [[0.5, 0, 0]])
    assert_allclose(composite(half_red, [0, 0, 1.0]), [[0.5, 0, 0.5]])
    assert_allclose(composite(half_red, np.array([[0, 1.0, 0]])), [[0.5, 0.5, 0]])
    with pytest.raises(ValueError, match="'green'"):
        composite(half_red, "green")


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_write_png_round_trip(tmp_path, rng, channels):
    image = rng.integers(0, 256, (6, 5, channels)) / 255.0
    write_png(tmp_path / "new" / "a.png", image, optimize=channels == 3)
    stored = np.asarray(Image.open(tmp_path / "new" / "a.png")).reshape(image.shape)
    assert_array_equal(stored, np.rint(image * 255))
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a.png"]


def test_straight_alpha_survives_the_file(tmp_path, rng):
    image = rng.random((6, 5, 4)).astype(np.float32)
    image[..., :3] *= image[..., 3:]
    write_png(tmp_path / "a.png", unpremultiply(image))
    # Alpha and colour are each rounded by half of 1/255; premultiplied the errors add.
    assert_allclose(read_image(tmp_path / "a.png")[0], image, atol=1.001 / 255)


def test_unpremultiply_of_clear_pixels_is_black():
    assert_array_equal(unpremultiply(np.zeros((2, 4), np.float32)), np.zeros((2, 4)))


def test_write_png_clips(tmp_path):
    write_png(tmp_path / "a.png", np.array([[[-1.0], [2.0]]]))
    assert np.asarray(Image.open(tmp_path / "a.png")).tolist() == [[0, 255]]


@pytest.mark.parametrize(
    "image, message",
    [
        (np.zeros((4, 4)), r"got \(4, 4\)"),
        (np.zeros((4, 4, 2)), r"got \(4, 4, 2\)"),
        (np.zeros((0, 4, 3)), r"got \(0, 4, 3\)"),
        (np.full((2, 2, 3), np.nan), r"12 non-finite values .*first at \(0, 0, 0\)"),
        (np.zeros((2, 2, 3), np.int64), "int64"),
    ],
)
def test_write_png_leaves_the_old_file_on_bad_input(tmp_path, image, message):
    path = tmp_path / "a.png"
    write_png(path, np.ones((2, 2, 3)))
    before = path.read_bytes()
    with pytest.raises(ValueError, match=message) as caught:
        write_png(path, image)
    assert str(path) in str(caught.value)
    assert path.read_bytes() == before


def test_a_failing_write_leaves_nothing(tmp_path, monkeypatch):
    def fail(self, path, **_):
        path.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(Image.Image, "save", fail)
    with pytest.raises(OSError, match="disk full"):
        write_png(tmp_path / "a.png", np.ones((2, 2, 3)))
    assert list(tmp_path.iterdir()) == []


def test_write_png_onto_a_folder(tmp_path):
    with pytest.raises(IsADirectoryError, match="is a folder"):
        write_png(tmp_path, np.ones((2, 2, 3)))


def test_to_uint8_passes_bytes_through():
    assert_array_equal(to_uint8(np.array([0, 7, 255], np.uint8)), [0, 7, 255])
