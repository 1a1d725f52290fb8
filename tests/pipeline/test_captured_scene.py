"""pipeline.capture: a dataset folder from photographs, and voxels from the light that a field takes."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from captures import dome, write_capture
from numpy.testing import assert_allclose

from nimpostor_jax.config import DataConfig, ExperimentConfig
from nimpostor_jax.io.blender import load_blender, load_scene
from nimpostor_jax.io.scenes import builtin_scene
from nimpostor_jax.pipeline import capture
from nimpostor_jax.pipeline.capture import box_region, captured_cage, make_scene, object_grid
from nimpostor_jax.pipeline.prepare import prepare_views
from nimpostor_jax.preprocess.surroundings import Region, pixel_directions
from nimpostor_jax.preprocess.tetrahedralize import box_tets
from nimpostor_jax.preprocess.visual_hull import OccupancyGrid
from nimpostor_jax.render.camera import pixel_rays

STAY = (np.eye(3), 1.0, np.zeros(3))  # a world that is not moved


def quiet(_):
    """Say nothing."""


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """The furry ball before the dome, without distortion: no pycolmap is needed."""
    views = load_blender(builtin_scene("fluffy_ball"), "train", 50)
    return write_capture(tmp_path_factory.mktemp("data"), views, STAY, lens={})


def test_many_large_photographs_are_reduced_for_memory(photographs, tmp_path, monkeypatch):
    lines = []
    monkeypatch.setattr(capture, "_MAX_PIXELS", 100 * 40 * 40)
    folder, _ = make_scene(photographs, tmp_path / "small", ExperimentConfig(), log=lines.append)
    assert any("100 images of 50 x 50 are reduced to 40 pixels" in line for line in lines)
    small = load_blender(folder, "train")
    assert small.images.shape[1:3] == (40, 40)
    asked = ExperimentConfig(data=DataConfig(resolution=50))
    folder, _ = make_scene(photographs, tmp_path / "large", asked, log=quiet)
    large = load_blender(folder, "train")
    assert large.images.shape[1:3] == (50, 50)
    assert_allclose(small.focal / 40, large.focal / 50)
    assert_allclose(small.principal / 40, large.principal / 50)
    assert_allclose(small.images.mean(axis=(1, 2)), large.images.mean(axis=(1, 2)), atol=0.003)  # 8 bits


def test_the_dataset_folder_is_whole_and_knows_its_backgrounds(photographs, tmp_path):
    config = ExperimentConfig()
    folder, region = make_scene(photographs, tmp_path / "work", config, log=quiet)
    train, test = load_scene(folder, config.data)
    count = len(list((photographs / "images").iterdir()))
    assert len(test) == -(-count // config.data.test_every) and len(train) + len(test) == count
    assert test.names[0].endswith("_000.png") and not train.has_alpha.any()
    assert region.is_ball
    assert (region.lower < -1).all() and (region.upper > 1).all()  # the ball's fur reaches 1
    for i in (0, len(train) - 1):
        directions = pixel_directions(train.camera_to_world[i], train.focal[i], train.principal[i], 50, 50)
        error = np.abs(train.backgrounds[i] - dome(directions))
        # 25 directions' worth of frame corners tell the dome; the largest errors are behind the ball.
        assert np.median(error) < 0.02 and error.max() < 0.25
    made = []
    again, same = make_scene(photographs, tmp_path / "work", config, log=made.append)
    assert again == folder and "made already" in made[0]
    assert_allclose(same.bounds, region.bounds)
    with pytest.raises(ValueError, match="was made from other input"):
        make_scene(photographs, tmp_path / "work", config, box_region([-1, -1, -1, 1, 1, 1]), quiet)


def test_what_an_earlier_capture_left_is_not_taken_for_this_ones(photographs, tmp_path):
    (tmp_path / "cage.npz").write_bytes(b"")
    with pytest.raises(ValueError, match=r"no scene, but cage\.npz of an earlier one; remove"):
        make_scene(photographs, tmp_path, ExperimentConfig(), log=quiet)
    (tmp_path / "coarse").mkdir()
    (tmp_path / "coarse" / "config.json").write_text("{}")
    with pytest.raises(ValueError, match="coarse has a fit with other --coarse_bindings; remove it"):
        captured_cage(tmp_path, Region(-np.ones(3), np.ones(3)), *2 * [ExperimentConfig()], tmp_path, quiet)


@pytest.mark.parametrize(
    ("config", "box", "message"),
    [
        (ExperimentConfig(data=DataConfig(resolution=51)), None, r"resolution = 51, but .* 50 pixels wide"),
        (ExperimentConfig(), [90, 90, 90, 91, 91, 91], "no camera sees the region"),
    ],
)
def test_what_cannot_work_is_refused_before_long_work(photographs, tmp_path, config, box, message):
    region = None if box is None else box_region(box)
    with pytest.raises(ValueError, match=message):
        make_scene(photographs, tmp_path / "work", config, region, quiet)
    assert not (tmp_path / "work" / "scene").exists()


def test_nothing_is_left_half_written(photographs, tmp_path):
    folder = tmp_path / "data"
    (folder / "images").mkdir(parents=True)
    names = sorted(path.name for path in (photographs / "images").iterdir())
    for name in names:
        (folder / "images" / name).write_bytes((photographs / "images" / name).read_bytes())
    (folder / "transforms.json").write_text((photographs / "transforms.json").read_text())
    broken = folder / "images" / names[-1]
    content = broken.read_bytes()
    broken.write_bytes(content[: len(content) // 2])  # the header is whole
    with pytest.raises(ValueError, match=f"{names[-1]} is damaged"):
        make_scene(folder, tmp_path / "work", ExperimentConfig(), log=quiet)
    assert list((tmp_path / "work").iterdir()) == []


@pytest.mark.parametrize("box", [[0, 0, 0, 1, 1, 0], [1, 0, 0, 0, 1, 1], [0, 0, 0, 1, 1, np.inf], [0, 1]])
def test_boxes_without_volume_are_refused(box):
    with pytest.raises(ValueError, match="--box must be"):
        box_region(box)


def test_a_folder_that_is_no_captures_is_left_alone(photographs, tmp_path):
    (tmp_path / "scene").mkdir()
    with pytest.raises(ValueError, match=r"no capture\.json"):
        make_scene(photographs, tmp_path, ExperimentConfig(), log=quiet)


RADIUS = 0.6


@pytest.fixture(scope="module")
def boxed(config):
    """A scene in a box, and the box."""
    views = load_blender(builtin_scene("fluffy_ball"), "train", 40)
    region = Region(np.full(3, -1.5), np.full(3, 1.5))
    return prepare_views(config, views, views, box_tets(region.bounds), quiet), region


@pytest.fixture
def ball_of_light(boxed, monkeypatch):
    """The scene, whose field takes all light on a sphere."""

    def light(impostor, pool, chosen, render):
        cameras = jax.tree.map(lambda x: x[pool.views[chosen]], pool.cameras)
        rays = pixel_rays(cameras, pool.pixels[chosen] + 0.5)
        along = -jnp.sum(rays.origins * rays.directions, axis=-1)
        gap = jnp.sum(rays.origins**2, axis=-1) - along**2
        t = along - jnp.sqrt(jnp.maximum(RADIUS**2 - gap, 0))
        points = rays.origins + t[:, None] * rays.directions
        return jnp.arange(len(chosen)), points, jnp.where(gap < RADIUS**2, 1.0, 0.0)

    monkeypatch.setattr(capture, "_light", light)
    return boxed


def test_voxels_are_where_light_ends(ball_of_light):
    scene, region = ball_of_light
    grid = object_grid(scene, scene.impostor, region, 32, log=quiet)
    reach = np.linalg.norm(grid.centers, axis=1)
    half = 0.5 * np.sqrt(3) * grid.voxel_size  # from a voxel's centre to its corner
    assert np.abs(reach - RADIUS).max() < half
    assert_allclose(grid.bounds, [[-RADIUS] * 3, [RADIUS] * 3], atol=2 * grid.voxel_size)
    assert grid.voxel_size < 3 / 32  # along the object, not along the region


def test_a_field_without_light_is_an_error(ball_of_light, monkeypatch):
    scene, region = ball_of_light

    def dark(impostor, pool, chosen, render):
        return chosen, jnp.zeros((len(chosen), 3)), jnp.zeros(len(chosen))

    monkeypatch.setattr(capture, "_light", dark)
    with pytest.raises(ValueError, match=r"finds nothing opaque.*--box"):
        object_grid(scene, scene.impostor, region, 32, log=quiet)


def test_floaters_and_walls_are_left_out():
    occupied = np.zeros((40, 40, 40), bool)
    occupied[15:25, 15:25, 15:25] = True  # the object
    occupied[30:36, 18:24, 18:24] = True  # its other part
    occupied[3:5, 3:5, 3:5] = True  # a floater
    occupied[:, :, 38:] = True  # what the surroundings do not explain, larger than all
    grid = OccupancyGrid(occupied, np.full(3, -1.95), 0.1)
    kept = capture._main_parts(grid, Region(np.full(3, -2.0), np.full(3, 2.0))).occupied
    assert kept[20, 20, 20] and kept[33, 20, 20]
    assert kept.sum() == 10**3 + 6**3


def test_an_object_on_a_table_that_reaches_the_wall_is_kept():
    occupied = np.zeros((40, 40, 40), bool)
    occupied[15:25, 15:25, 10:25] = True
    occupied[:, :, 8:10] = True
    grid = OccupancyGrid(occupied, np.full(3, -1.95), 0.1)
    kept = capture._main_parts(grid, Region(np.full(3, -2.0), np.full(3, 2.0))).occupied
    assert kept.sum() == occupied.sum()


def test_the_record_says_what_was_asked(photographs, tmp_path):
    folder, _ = make_scene(photographs, tmp_path, ExperimentConfig(), log=quiet)
    record = json.loads((folder / "capture.json").read_text())
    assert record["data"] == str(photographs.resolve()) and record["box"] is None
