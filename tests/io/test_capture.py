"""io.capture and io.colmap: poses, lenses and sizes of photographs, against lens models written out here."""

import importlib.util
import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from captures import LENS, distort, undistort
from numpy.testing import assert_allclose
from PIL import Image
from scene_files import camera_to_world
from scipy import ndimage

from nimpostor_jax.io import capture as capture_module
from nimpostor_jax.io.blender import load_blender
from nimpostor_jax.io.capture import common_crops, read_capture, write_views
from nimpostor_jax.io.colmap import Lens, require_pycolmap
from nimpostor_jax.preprocess.surroundings import pixel_directions

WIDTH, HEIGHT = 120, 90
INTRINSICS = {"fl_x": 130.0, "fl_y": 128.0, "cx": 63.0, "cy": 42.0, "w": WIDTH, "h": HEIGHT}
# Lights to find again: on a cross, and towards the corners, where distortion is largest.
LIGHTS = np.array([[0, 0], [0.3, 0], [-0.3, 0.05], [0, 0.2], [0.05, -0.2], [0.3, 0.2], [-0.3, -0.2]])
SPOT = 0.015  # radius of a light
# A light's centroid: 8-bit and bilinear resampling of spots about 2 pixels wide.
PIXELS = 0.1

needs_pycolmap = pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None,
    reason="pycolmap (extra capture) is not installed",
)


def fisheye_undistort(points, k1=0.0, k2=0.0, k3=0.0, k4=0.0):
    """OpenCV's fisheye model inverted by bisection on the angle."""
    radius = np.linalg.norm(points, axis=-1)
    low, high = np.zeros_like(radius), np.full_like(radius, 1.4)
    for _ in range(60):
        theta = 0.5 * (low + high)
        t2 = theta**2
        below = theta * (1 + k1 * t2 + k2 * t2**2 + k3 * t2**3 + k4 * t2**4) < radius
        low, high = np.where(below, theta, low), np.where(below, high, theta)
    return points * (np.tan(low) / np.maximum(radius, 1e-12))[..., None]


def lights(size, intrinsics, invert):
    """A photograph of `LIGHTS` through a lens, uint8 RGB."""
    width, height = size
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    center = [intrinsics["cx"], intrinsics["cy"]]
    at = invert((np.stack([x, y], -1) - center) / [intrinsics["fl_x"], intrinsics["fl_y"]])
    squared = np.sum((at[:, :, None] - LIGHTS) ** 2, axis=-1)
    return np.repeat(np.rint(255 * np.exp(-0.5 * squared / SPOT**2).sum(-1).clip(0, 1)), 3).reshape(
        height, width, 3
    ).astype(np.uint8)


def centroid(image, expected, radius=6):
    """Of the light near an expected position, in pixels."""
    x, y = np.meshgrid(np.arange(image.shape[1]) + 0.5, np.arange(image.shape[0]) + 0.5)
    weight = image * (np.hypot(x - expected[0], y - expected[1]) < radius)
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


def write_folder(folder, pictures, meta, frames=None):
    """Photographs and a `transforms.json` of cameras around the origin."""
    (folder / "images").mkdir(parents=True)
    listed = []
    for i, pixels in enumerate(pictures):
        Image.fromarray(pixels).save(folder / "images" / f"p{i}.png")
        listed.append({"file_path": f"images/p{i}.png", "transform_matrix": camera_to_world(i).tolist()})
        listed[-1] |= frames[i] if frames else {}
    (folder / "transforms.json").write_text(json.dumps({**meta, "frames": listed}))
    return folder


def undistorted_views(folder, tmp_path):
    """The capture of a folder, written and read again."""
    capture = read_capture(folder, tmp_path / "work", log=lambda _: None)
    crops, width, height = common_crops(capture, log=lambda _: None)
    (tmp_path / "scene").mkdir()
    write_views(capture, tmp_path / "scene", np.arange(len(crops)), "train", crops, (width, height))
    return load_blender(tmp_path / "scene", "train")


def check_lights(views):
    """Every light stands where the pinhole of the written scene says."""
    for image, focal, principal in zip(views.images, views.focal, views.principal, strict=True):
        expected = LIGHTS * focal + principal
        inside = ((expected > 5) & (expected < [views.width - 5, views.height - 5])).all(axis=1)
        assert inside.all()
        for light in expected[inside]:
            assert_allclose(centroid(image[..., 0], light), light, atol=PIXELS)


@pytest.fixture
def plain():
    return [lights((WIDTH, HEIGHT), INTRINSICS, lambda x: x)] * 3


def test_a_pinhole_capture_is_taken_as_it_is_and_needs_no_pycolmap(tmp_path, plain, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    views = undistorted_views(write_folder(tmp_path / "data", plain, INTRINSICS), tmp_path)
    assert (views.width, views.height) == (WIDTH, HEIGHT)
    assert_allclose(views.focal, [[130, 128]] * 3)
    assert_allclose(views.principal, [[63, 42]] * 3)
    assert_allclose(views.camera_to_world, np.stack([camera_to_world(i) for i in range(3)]))
    assert_allclose(views.images[1, ..., :3], plain[1] / 255.0, atol=1e-6)
    assert not views.has_alpha.any()


@needs_pycolmap
@pytest.mark.parametrize(
    "extra, invert",
    [
        (LENS, lambda x: undistort(x, **LENS)),
        ({"k1": -0.2, "k2": 0.05, "camera_model": "OPENCV"}, lambda x: undistort(x, k1=-0.2, k2=0.05)),
        (
            {"k1": 0.05, "k2": -0.01, "camera_model": "OPENCV_FISHEYE"},
            lambda x: fisheye_undistort(x, k1=0.05, k2=-0.01),
        ),
        ({"k1": -0.02, "k3": 0.01, "is_fisheye": True}, lambda x: fisheye_undistort(x, k1=-0.02, k3=0.01)),
    ],
    ids=["opencv", "barrel", "fisheye", "instant-ngp fisheye"],
)
def test_lights_stand_where_the_pinhole_says(tmp_path, extra, invert):
    photographs = [lights((WIDTH, HEIGHT), INTRINSICS, invert)] * 3
    views = undistorted_views(write_folder(tmp_path / "data", photographs, INTRINSICS | extra), tmp_path)
    check_lights(views)
    # The test can fail: without undistortion the outer lights are off by more.
    off = np.abs(distort(LIGHTS, **LENS) - LIGHTS) * 130
    assert off.max() > 3 * PIXELS


@needs_pycolmap
def test_a_third_radial_term_is_honoured():
    lens = Lens("FULL_OPENCV", WIDTH, HEIGHT, (130, 128, 63, 42, 0.1, 0, 0, 0, -0.05, 0, 0, 0))
    camera = require_pycolmap("a test").Camera(
        model=lens.model, width=WIDTH, height=HEIGHT, params=list(lens.params)
    )
    x, y = 0.3, 0.2
    r2 = x * x + y * y
    scale = 1 + 0.1 * r2 - 0.05 * r2**3
    found = camera.img_from_cam(np.array([x, y, 1.0]))
    assert_allclose(found, [130 * x * scale + 63, 128 * y * scale + 42], atol=1e-9)


def test_sizes_and_cameras_that_differ_end_in_one(tmp_path):
    """A second camera with twice the pixels, and one that is turned upright."""
    sizes = [(WIDTH, HEIGHT), (2 * WIDTH, 2 * HEIGHT), (HEIGHT, WIDTH)]
    frames, pictures = [], []
    for width, height in sizes:
        zoom = 2.0 if width > WIDTH else 1.0
        own = {"fl_x": 75 * zoom, "fl_y": 75 * zoom, "cx": 0.5 * width, "cy": 0.5 * height}
        frames.append(own | {"w": width, "h": height})
        pictures.append(lights((width, height), own, lambda x: x))
    messages = []
    capture = read_capture(write_folder(tmp_path / "data", pictures, {}, frames), tmp_path, messages.append)
    _, width, height = common_crops(capture, messages.append)
    assert any("57%" in message for message in messages)  # 90 x 68 of 90 x 120
    assert (width, height) == (90, 68)
    views = undistorted_views(tmp_path / "data", tmp_path)
    check_lights(views)


def test_a_smaller_copy_has_scaled_intrinsics(tmp_path):
    pictures = [lights((60, 45), {k: v / 2 for k, v in INTRINSICS.items()}, lambda x: x)] * 3
    views = undistorted_views(write_folder(tmp_path / "data", pictures, INTRINSICS), tmp_path)
    assert_allclose(views.focal[0], [65, 64])
    check_lights(views)


@needs_pycolmap
@pytest.mark.parametrize("binary", [True, False])
def test_poses_of_a_colmap_model(tmp_path, plain, binary):
    pycolmap = require_pycolmap("a test")
    rng = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT, params=[130, 128, 63, 42]
    )
    model.add_camera_with_trivial_rig(camera)
    (tmp_path / "data" / "images").mkdir(parents=True)
    for i, pixels in enumerate(plain):
        Image.fromarray(pixels).save(tmp_path / "data" / "images" / f"p{i}.png")
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        matrix = np.c_[rotation * np.sign(np.linalg.det(rotation)), rng.normal(size=3)]
        image = pycolmap.Image(name=f"p{i}.png", camera_id=1, image_id=3 - i)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(matrix))
    (tmp_path / "data" / "sparse" / "0").mkdir(parents=True)
    (model.write_binary if binary else model.write_text)(tmp_path / "data" / "sparse" / "0")
    views = undistorted_views(tmp_path / "data", tmp_path)
    assert [name.split("_")[1] for name in views.names] == ["p0.png", "p1.png", "p2.png"]
    for i in range(3):
        image = model.images[3 - i]
        # A point 2 units in front of the camera, projected by COLMAP and by our pinhole.
        world = image.cam_from_world().inverse() * np.array([0.3, -0.2, 2.0])
        local = np.linalg.inv(views.camera_to_world[i]) @ np.append(world, 1)
        ours = views.principal[i] + views.focal[i] * np.array([local[0], -local[1]]) / -local[2]
        assert_allclose(ours, image.project_point(world), atol=1e-6)


# Bad input


@pytest.mark.parametrize(
    "change, message",
    [
        ({"camera_model": "EQUIRECTANGULAR"}, r"transforms\.json: frame 0: 'camera_model' 'EQUIRECTANGULAR'"),
        ({"camera_model": "PINHOLE", "k1": 0.1}, r"frame 0: 'k1' has no meaning for the lens 'PINHOLE'"),
        ({"k4": 0.1}, r"frame 0: 'k4' has no meaning for the lens 'OPENCV'"),
        ({"k1": "much"}, r"frame 0: 'k1' must be a finite number"),
        ({"fl_x": -3}, r"frame 0: focal lengths must be positive"),
        ({"w": 100}, r"frame 0: 'w' and 'h' say 100x90, the images are 120x90"),
    ],
)
def test_bad_metadata_names_file_and_frame(tmp_path, plain, change, message):
    folder = write_folder(tmp_path / "data", plain, INTRINSICS | change)
    with pytest.raises(ValueError, match=message):
        read_capture(folder, tmp_path, log=lambda _: None)


def test_too_few_views_and_repeated_ones(tmp_path, plain):
    folder = write_folder(tmp_path / "data", plain, INTRINSICS)
    meta = json.loads((folder / "transforms.json").read_text())
    frames = meta["frames"]
    (folder / "transforms.json").write_text(json.dumps(meta | {"frames": frames[:2]}))
    with pytest.raises(ValueError, match="2 views; at least 3"):
        read_capture(folder, tmp_path, log=lambda _: None)
    (folder / "transforms.json").write_text(json.dumps(meta | {"frames": [*frames, frames[1]]}))
    with pytest.raises(ValueError, match=r"p1\.png is listed more than once"):
        read_capture(folder, tmp_path, log=lambda _: None)


def test_folders_without_anything(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere does not exist"):
        read_capture(tmp_path / "nowhere", tmp_path)
    with pytest.raises(FileNotFoundError, match=r"no transforms\.json, no COLMAP model .* and no images"):
        read_capture(tmp_path, tmp_path)


def test_a_missing_pycolmap_is_named_with_its_extra(tmp_path, plain, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    folder = write_folder(tmp_path / "data", plain, INTRINSICS | LENS)
    capture = read_capture(folder, tmp_path, log=lambda _: None)
    with pytest.raises(ValueError, match=r"needs pycolmap.*'\.\[capture\]'"):
        common_crops(capture, log=lambda _: None)


def test_an_image_with_a_mask_is_refused(tmp_path, plain):
    masked = np.dstack([plain[1], np.full((HEIGHT, WIDTH), 128, np.uint8)])
    folder = write_folder(tmp_path / "data", [plain[0], masked, plain[2]], INTRINSICS)
    with pytest.raises(ValueError, match=r"p1\.png has an alpha mask.*train\.py"):
        undistorted_views(folder, tmp_path)


def test_masks_in_files_of_their_own_are_refused(tmp_path, plain):
    """They would be left out."""
    frames = [{}, {"mask_path": "masks/p1.png"}, {}]
    folder = write_folder(tmp_path / "data", plain, INTRINSICS, frames)
    with pytest.raises(ValueError, match=r"transforms\.json: frame 1: 'mask_path' is not read.*train\.py"):
        read_capture(folder, tmp_path, log=lambda _: None)


# Images alone


def test_poses_of_other_images_are_not_taken(tmp_path, plain, monkeypatch):
    """Cameras number their pictures alike: the names are the same, and the pictures are not."""
    lens = Lens("PINHOLE", WIDTH, HEIGHT, (130.0, 128.0, 63.0, 42.0))

    def poses(images, names, output, log):
        (output / "sparse" / "0").mkdir(parents=True)
        (output / "sparse" / "0" / "cameras.bin").write_bytes(b"")
        return output / "sparse" / "0"

    def model(path):
        return [SimpleNamespace(name=f"p{i}.png", lens=lens, camera_to_world=np.eye(4)) for i in range(3)]

    monkeypatch.setattr(capture_module, "poses_from_images", poses)
    monkeypatch.setattr(capture_module, "read_model", model)
    work = tmp_path / "work"
    for name, pictures in (("a", plain), ("b", [np.zeros_like(x) for x in plain])):
        (write_folder(tmp_path / name, pictures, INTRINSICS) / "transforms.json").unlink()
    for _ in range(2):
        assert len(read_capture(tmp_path / "a", work, log=lambda _: None).paths) == 3
    with pytest.raises(ValueError, match=r"colmap has the poses of other images than .*b.images; remove it"):
        read_capture(tmp_path / "b", work, log=lambda _: None)


def textured_ball(pose, focal, side, lattice):
    """A ball of radius 1 with random texture before grey, uint8 RGB."""
    directions = pixel_directions(pose, np.full(2, focal), np.full(2, 0.5 * side), side, side)
    along = -directions @ pose[:3, 3]
    gap = pose[:3, 3] @ pose[:3, 3] - along**2
    points = pose[:3, 3] + (along - np.sqrt(np.maximum(1 - gap, 0)))[..., None] * directions
    grey = np.zeros((side, side))
    for scale, weight in ((6, 0.6), (14, 0.4)):
        at = np.moveaxis(scale * points, -1, 0)
        grey += weight * ndimage.map_coordinates(lattice, at, order=1, mode="grid-wrap")
    grey = np.where(gap < 1, grey, 0.5)
    return np.repeat(np.rint(255 * grey).astype(np.uint8)[..., None], 3, axis=-1)


@pytest.mark.slow
@needs_pycolmap
def test_poses_from_images_alone(tmp_path):
    """COLMAP's cameras stand where ours did, up to its choice of world."""
    rng, side, focal = np.random.default_rng(0), 300, 400.0
    lattice = rng.uniform(size=(32, 32, 32))
    angles = np.arange(36) * np.pi / 18
    elevation = 0.35 * np.sin(3 * angles)
    right = np.stack([-np.sin(angles), np.cos(angles), 0 * angles], 1)
    level = np.cross(right, [0, 0, 1])
    back = np.cos(elevation)[:, None] * level + np.sin(elevation)[:, None] * [0, 0, 1]
    poses = np.tile(np.eye(4), (36, 1, 1))
    poses[:, :3] = np.stack([right, np.cross(back, right), back, 3.2 * back], axis=2)
    (tmp_path / "data" / "images").mkdir(parents=True)
    for i, pose in enumerate(poses):
        pixels = textured_ball(pose, focal, side, lattice)
        Image.fromarray(pixels).save(tmp_path / "data" / "images" / f"{i:02d}.png")
    capture = read_capture(tmp_path / "data", tmp_path / "work", log=lambda _: None)
    assert len(capture.paths) == 36
    found, true = capture.camera_to_world[:, :3, 3], poses[:, :3, 3]
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    scale = (s * [1, 1, np.sign(np.linalg.det(u @ vt))]).sum() / np.sum(a**2)
    # Features are a few tenths of a pixel off: 0.1 % of the distance; a lens is estimated too.
    assert np.abs(scale * a @ rotation.T - b).max() < 0.03 * 3.2
    turned = rotation @ capture.camera_to_world[:, :3, :3]
    assert_allclose(turned, poses[:, :3, :3], atol=0.05)
    again = read_capture(tmp_path / "data", tmp_path / "work", log=lambda _: None)
    assert_allclose(again.camera_to_world, capture.camera_to_world)
