import copy
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from scene_files import camera_to_world, read_transforms, write_transforms

from nimpostor_jax.config import DataConfig
from nimpostor_jax.io import blender
from nimpostor_jax.io.blender import check_masks, load_blender, load_scene
from nimpostor_jax.io.images import area_downsample, read_image

ROUNDING = 1e-6  # float32 pixels in [0, 1]


def test_load_blender_reads_pixels_and_cameras(make_scene, rgba):
    images = [rgba(6, 8) for _ in range(3)]
    posed = load_blender(make_scene(images), "train")
    assert len(posed) == 3 and posed.images.shape == (3, 6, 8, 4)
    assert posed.images.dtype == np.float32 and posed.camera_to_world.dtype == np.float64
    assert posed.names == ("train/r_0.png", "train/r_1.png", "train/r_2.png")
    assert posed.has_alpha.all()
    for i, pixels in enumerate(images):
        straight = pixels / 255.0
        expected = np.concatenate([straight[..., :3] * straight[..., 3:], straight[..., 3:]], -1)
        assert_allclose(posed.images[i], expected, atol=ROUNDING)
        assert_array_equal(posed.camera_to_world[i], camera_to_world(0.3 * i))
    assert_array_equal(posed.masks, posed.images[..., 3])
    focal = 4 / math.tan(0.35)  # half the width over the tangent of half the horizontal angle
    assert_allclose(posed.focal, np.full((3, 2), focal))
    assert_allclose(posed.principal, [[4, 3]] * 3)


def test_cameras_are_one_float32_record(make_scene, rgba):
    posed = load_blender(make_scene([rgba(6, 8), rgba(6, 8)]), "train")
    cameras = posed.cameras
    assert (cameras.width, cameras.height) == (8, 6) == (posed.width, posed.height)
    assert cameras.camera_to_world.shape == (2, 4, 4) and cameras.focal.shape == (2, 2)
    assert {str(a.dtype) for a in (cameras.camera_to_world, cameras.focal)} == {"float32"}


@pytest.mark.parametrize("resolution, height", [(8, 6), (4, 3), (5, 4), (3, 2)])  # round(6 r / 8)
def test_resolution_scales_pixels_and_intrinsics(make_scene, rgba, resolution, height):
    folder = make_scene([rgba(6, 8)])
    full, small = load_blender(folder, "train"), load_blender(folder, "train", resolution)
    assert small.images.shape == (1, height, resolution, 4)
    expected = area_downsample(full.images[0], resolution, height)
    assert_allclose(small.images[0], expected, atol=ROUNDING)
    shrink = [resolution / 8, height / 6]
    assert_allclose(small.focal, full.focal * shrink)
    assert_allclose(small.principal, full.principal * shrink)


def test_stated_intrinsics_take_precedence(make_scene, rgba):
    folder = make_scene([rgba(6, 8)], w=16, h=12, fl_x=20.0, fl_y=22.0, cx=7.0, cy=5.0)
    posed = load_blender(folder, "train")  # stated for twice the stored size
    assert_allclose(posed.focal, [[10, 11]])
    assert_allclose(posed.principal, [[3.5, 2.5]])
    meta = read_transforms(folder)
    del meta["fl_y"], meta["camera_angle_x"]
    meta["frames"][0]["fl_x"] = 40.0
    write_transforms(folder, "train", meta)
    assert_allclose(load_blender(folder, "train").focal, [[20, 20]])


def test_stated_size_with_the_angle(make_scene, rgba):
    posed = load_blender(make_scene([rgba(6, 8)], w=16, h=12), "train")
    assert_allclose(posed.focal, np.full((1, 2), 4 / math.tan(0.35)))


def test_file_path_with_a_suffix(make_scene, rgba):
    folder = make_scene([rgba(4, 4)])
    meta = read_transforms(folder)
    meta["frames"][0]["file_path"] = "train/r_0.png"
    write_transforms(folder, "train", meta)
    assert load_blender(folder, "train").names == ("train/r_0.png",)


def test_pictures_may_lie_elsewhere(make_scene, rgba, tmp_path):
    folder = make_scene([rgba(4, 4)])
    frames = read_transforms(folder, "train")
    (folder / "train" / "r_0.png").rename(tmp_path / "far.png")
    frames["frames"][0]["file_path"] = str(tmp_path / "far.png")
    write_transforms(folder, "train", frames)
    assert load_blender(folder, "train").names == ("../far.png",)


def test_cameras_far_from_the_origin(make_scene, rgba):
    """What float32 cannot tell apart is refused; some thousands of distances are fine."""
    folder = make_scene([rgba(64, 64), rgba(64, 64)])
    meta = read_transforms(folder, "train")
    tripod = copy.deepcopy(meta["frames"][0])
    for row, value in zip(tripod["transform_matrix"], (0.1, 2.3, 4.7), strict=False):
        row[3] = value
    write_transforms(folder, "train", {**meta, "frames": 7 * [tripod]})  # whose mean is rounded
    load_blender(folder, "train")
    for shift, fine in ((1e4, True), (1e7, False), (1e9, False)):
        moved = copy.deepcopy(meta)
        for frame in moved["frames"]:
            frame["transform_matrix"][0][3] += shift
        write_transforms(folder, "train", moved)
        if fine:
            load_blender(folder, "train")
        else:
            with pytest.raises(ValueError, match=r"transforms_train.json: .*; subtract that point from all"):
                load_blender(folder, "train")


def test_masks_in_files_of_their_own_are_refused(make_scene, rgba):
    folder = make_scene([rgba(4, 4), rgba(4, 4)])
    meta = read_transforms(folder, "train")
    meta["frames"][1]["mask_path"] = "masks/r_1.png"
    write_transforms(folder, "train", meta)
    with pytest.raises(ValueError, match=r"frame 1: 'mask_path' is not read: write the masks into"):
        load_blender(folder, "train")


def test_select(make_scene, rgba):
    posed = load_blender(make_scene([rgba(4, 4) for _ in range(4)]), "train")
    picked = posed.select([2, 0])
    assert picked.names == ("train/r_2.png", "train/r_0.png") and len(picked) == 2
    assert_array_equal(picked.images, posed.images[[2, 0]])
    assert_array_equal(picked.camera_to_world, posed.camera_to_world[[2, 0]])
    assert len(posed.select([])) == 0
    with pytest.raises(IndexError, match="view 4 does not exist; there are 4"):
        posed.select(np.array([1, 4]))


# Held-out views


def test_load_scene_prefers_test_over_val(make_scene, rgba):
    folder = make_scene([rgba(8, 8) for _ in range(3)])
    make_scene([rgba(8, 8)], "val")
    assert load_scene(folder, DataConfig())[1].names == ("val/r_0.png",)
    make_scene([rgba(8, 8), rgba(8, 8)], "test")
    train, test = load_scene(folder, DataConfig(resolution=8))
    assert len(train) == 3 and test.names == ("test/r_0.png", "test/r_1.png")


def test_load_scene_holds_out_every_nth(make_scene, rgba):
    folder = make_scene([rgba(8, 8) for _ in range(7)])
    train, test = load_scene(folder, DataConfig(test_every=3))
    assert test.names == ("train/r_0.png", "train/r_3.png", "train/r_6.png")
    assert len(train) == 4 and not set(train.names) & set(test.names)


def test_load_scene_cannot_split_one_view(make_scene, rgba):
    with pytest.raises(ValueError, match=r"transforms_train\.json: 1 view cannot be split"):
        load_scene(make_scene([rgba(8, 8)]), DataConfig())


def test_both_splits_are_checked_before_pixels(make_scene, rgba, monkeypatch):
    folder = make_scene([rgba(8, 8), rgba(8, 8)])
    make_scene([rgba(8, 8)], "test")
    (folder / "test" / "r_0.png").unlink()

    def never(path):
        raise AssertionError(f"decoded {path} before the checks were done")

    monkeypatch.setattr(blender, "read_image", never)
    with pytest.raises(FileNotFoundError, match=r"test/r_0\.png does not exist"):
        load_scene(folder, DataConfig())
    with pytest.raises(ValueError, match="resolution 9"):
        load_blender(folder, "train", 9)


# Bad input: one error that names the file, and the frame


def test_missing_folder_and_json(tmp_path, make_scene, rgba):
    with pytest.raises(FileNotFoundError, match=r"scene folder .*nowhere does not exist"):
        load_blender(tmp_path / "nowhere", "train")
    folder = make_scene([rgba(4, 4)])
    with pytest.raises(FileNotFoundError, match=r"transforms_val\.json .*transforms_train\.json"):
        load_blender(folder, "val")
    (folder / "transforms_train.json").write_text("{")
    with pytest.raises(ValueError, match=r"transforms_train\.json is not valid JSON"):
        load_blender(folder, "train")


@pytest.mark.parametrize("frames", [None, [], "none", [1]])
def test_bad_frames(make_scene, rgba, frames):
    folder = make_scene([rgba(4, 4)])
    write_transforms(folder, "train", {"camera_angle_x": 0.7, "frames": frames})
    with pytest.raises(ValueError, match=r"transforms_train\.json: 'frames'"):
        load_blender(folder, "train")


def test_missing_image_is_named(make_scene, rgba):
    folder = make_scene([rgba(4, 4) for _ in range(3)])
    (folder / "train" / "r_1.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"train/r_1\.png does not exist .*frame 1"):
        load_blender(folder, "train")


def test_truncated_image_is_named(make_scene, rgba):
    folder = make_scene([rgba(40, 40) for _ in range(2)])
    path = folder / "train" / "r_1.png"
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"train/r_1\.png is damaged or truncated"):
        load_blender(folder, "train")


def test_images_of_different_sizes(make_scene, rgba):
    folder = make_scene([rgba(6, 8), rgba(6, 8), rgba(6, 7), rgba(2, 2)])
    with pytest.raises(ValueError, match=r"r_2\.png is 7x6 but .*r_0\.png is 8x6"):
        load_blender(folder, "train")


def scale(matrix):
    matrix[:3, :3] *= 1.01


def mirror(matrix):
    matrix[:3, 0] *= -1


def shear(matrix):
    matrix[0, 1] += 0.01


def nan(matrix):
    matrix[1, 3] = np.nan


def perspective(matrix):
    matrix[3, 2] = 0.5


@pytest.mark.parametrize("change", [scale, mirror, shear, perspective])
def test_non_rigid_camera(make_scene, rgba, change):
    folder = make_scene([rgba(4, 4), rgba(4, 4)])
    with pytest.raises(ValueError, match=r"transforms_train\.json: frame 1: .* is not rigid"):
        load_with_matrix(folder, change)


def test_non_finite_camera(make_scene, rgba):
    folder = make_scene([rgba(4, 4), rgba(4, 4)])
    with pytest.raises(ValueError, match=r"transforms_train\.json: frame 1: .* non-finite"):
        load_with_matrix(folder, nan)


def load_with_matrix(folder, change):
    meta = read_transforms(folder)
    matrix = np.array(meta["frames"][1]["transform_matrix"])
    change(matrix)
    meta["frames"][1]["transform_matrix"] = matrix.tolist()
    write_transforms(folder, "train", meta)
    return load_blender(folder, "train")


def test_camera_rounded_to_four_digits_is_rigid(make_scene, rgba):
    folder = make_scene([rgba(4, 4), rgba(4, 4)])
    load_with_matrix(folder, lambda m: m.__setitem__(slice(None), m.round(4)))


@pytest.mark.parametrize(
    "key, value, message",
    [
        ("transform_matrix", None, "'transform_matrix' is missing"),
        ("transform_matrix", [[1, 2], [3]], "not a matrix of numbers"),
        ("transform_matrix", [[1, 0], [0, 1]], r"shape \(2, 2\)"),
        ("file_path", None, "'file_path' is missing"),
        ("file_path", 3, "'file_path' is missing or not a string"),
        ("fl_x", -1.0, "must be positive"),
        ("fl_x", "wide", "'fl_x' must be a finite number"),
        ("camera_angle_x", 3.5, r"in \(0, pi\)"),
        ("k1", 0.1, "'k1' is not supported here; undistort"),
        ("w", 0, "must be positive"),
        ("w", 8, "say 8x4, the images are 4x4"),
    ],
)
def test_bad_frame_values(make_scene, rgba, key, value, message):
    folder = make_scene([rgba(4, 4), rgba(4, 4)])
    meta = read_transforms(folder)
    meta["frames"][1][key] = value
    if value is None:
        del meta["frames"][1][key]
    write_transforms(folder, "train", meta)
    with pytest.raises(ValueError, match=rf"transforms_train\.json: frame 1.*{message}"):
        load_blender(folder, "train")


def test_missing_angle(make_scene, rgba):
    folder = make_scene([rgba(4, 4)])
    write_transforms(folder, "train", {"frames": read_transforms(folder)["frames"]})
    with pytest.raises(ValueError, match=r"frame 0: 'camera_angle_x' \(or 'fl_x'\) is missing"):
        load_blender(folder, "train")


@pytest.mark.parametrize("resolution", [0, 9])
def test_resolution_beyond_the_stored(make_scene, rgba, resolution):
    with pytest.raises(ValueError, match=rf"resolution {resolution} .*stored width of .*r_0\.png"):
        load_blender(make_scene([rgba(6, 8)]), "train", resolution)


# Backgrounds


def add_backgrounds(folder, pictures, frames=None):
    meta = read_transforms(folder)
    for i, pixels in enumerate(pictures):
        Image.fromarray(pixels).save(folder / f"b{i}.png")
        if frames is None or i in frames:
            meta["frames"][i]["background_path"] = f"b{i}.png"
    write_transforms(folder, "train", meta)
    return folder


def test_backgrounds_come_along_at_the_same_size(make_scene, rgba):
    behind = [rgba(6, 8)[..., :3] for _ in range(2)]
    folder = add_backgrounds(make_scene([rgba(6, 8)[..., :3] for _ in range(2)]), behind)
    posed = load_blender(folder, "train")
    assert_allclose(posed.backgrounds, np.stack(behind) / 255, atol=ROUNDING)
    small = load_blender(folder, "train", 4)
    for i in range(2):
        assert_allclose(small.backgrounds[i], area_downsample(posed.backgrounds[i], 4, 3), atol=ROUNDING)
    assert_array_equal(posed.select([1]).backgrounds, posed.backgrounds[1:])
    assert_array_equal(posed.background(1, "white"), posed.backgrounds[1])
    assert load_blender(make_scene([rgba(4, 4)]), "train").background(0, "white") == "white"


def test_a_background_of_some_frames_only(make_scene, rgba):
    folder = add_backgrounds(make_scene([rgba(4, 4)] * 2), [rgba(4, 4)[..., :3]] * 2, frames=[0])
    with pytest.raises(ValueError, match="frame 1 has no 'background_path' but others have"):
        load_blender(folder, "train")


def test_a_background_of_another_size(make_scene, rgba):
    folder = add_backgrounds(make_scene([rgba(4, 4)]), [rgba(4, 5)[..., :3]])
    with pytest.raises(ValueError, match=r"background .*b0\.png is 5x4 but the images are 4x4"):
        load_blender(folder, "train")


def test_a_missing_background(make_scene, rgba):
    folder = add_backgrounds(make_scene([rgba(4, 4)]), [rgba(4, 4)[..., :3]])
    (folder / "b0.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"b0\.png does not exist .*frame 0"):
        load_blender(folder, "train")


# Masks


def test_check_masks_accepts_a_scene(make_scene, rgba):
    check_masks(load_blender(make_scene([rgba(4, 4), rgba(4, 4)]), "train"))


def test_check_masks_names_the_empty_one(make_scene, rgba):
    images = [rgba(4, 4) for _ in range(3)]
    images[1][..., 3] = 0
    with pytest.raises(ValueError, match=r"1 of 3 images have an empty mask .*train/r_1\.png"):
        check_masks(load_blender(make_scene(images), "train"))


def test_check_masks_names_the_one_without_alpha(make_scene, rgba):
    posed = load_blender(make_scene([rgba(4, 4), rgba(4, 4)[..., :3]]), "train")
    assert posed.has_alpha.tolist() == [True, False]
    with pytest.raises(ValueError, match=r"1 of 2 images have no alpha channel .*train/r_1\.png"):
        check_masks(posed)


def test_check_masks_refuses_opaque_pictures(make_scene, rgba):
    images = [rgba(4, 4) for _ in range(2)]
    for image in images:
        image[..., 3] = 255
    with pytest.raises(ValueError, match="masks of all 2 images cover the whole image"):
        check_masks(load_blender(make_scene(images), "train"))


# A scene made elsewhere


def test_reads_a_scene_from_another_maker():
    folder = Path(__file__).resolve().parents[2] / "../shared/data/mic"
    if not folder.is_dir():
        pytest.skip("the mic scene is not here")
    posed = load_blender(folder, "test", 50)
    assert posed.images.shape == (25, 50, 50, 4)
    stored, _ = read_image(folder / posed.names[0])
    # An exact average keeps the mean; float32 sums over 160,000 pixels.
    assert_allclose(posed.images[0].mean((0, 1)), stored.mean((0, 1), np.float64), atol=1e-5)
    check_masks(posed)
    distances = np.linalg.norm(posed.camera_to_world[:, :3, 3], axis=1)
    assert_allclose(distances, 4.031, atol=2e-3)  # nerf-synthetic's dome
    looks_at_origin = -posed.camera_to_world[:, :3, 2] * distances[:, None]
    assert_allclose(looks_at_origin, -posed.camera_to_world[:, :3, 3], atol=1e-4)


def test_jpeg_counts_as_without_alpha(make_scene, rgba):
    folder = make_scene([rgba(4, 4)])
    Image.fromarray(rgba(4, 4)[..., :3]).save(folder / "train" / "photo.jpg")
    meta = read_transforms(folder)
    meta["frames"][0]["file_path"] = "train/photo.jpg"
    write_transforms(folder, "train", meta)
    assert load_blender(folder, "train").has_alpha.tolist() == [False]
