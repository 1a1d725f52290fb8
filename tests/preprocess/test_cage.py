import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh
from posed_balls import posed_balls

from nimpostor_jax.config import CageConfig
from nimpostor_jax.preprocess import cage as module
from nimpostor_jax.preprocess import validate
from nimpostor_jax.preprocess.cage import cage_from_images, cage_from_surface
from nimpostor_jax.preprocess.tetrahedralize import box_tets

MESHES = Path(__file__).resolve().parents[2] / "../shared/data/meshes"
CONFIG = CageConfig(target_tets=120, grid_resolution=48)


@dataclasses.dataclass(frozen=True)
class Views:
    images: np.ndarray
    camera_to_world: np.ndarray
    focal: np.ndarray
    principal: np.ndarray
    names: tuple[str, ...]


def views_of(balls, **options):
    masks, *cameras = posed_balls(balls, **options)
    names = tuple(f"r_{i}" for i in range(len(masks)))
    return Views(np.repeat(masks[..., None], 4, axis=-1), *cameras, names)


def test_cage_from_images_contains_the_object_and_prints_its_report():
    balls = [((0.1, 0, 0), 0.5), ((0.1, 0, 0.7), 0.15)]
    lines = []
    vertices, tets = cage_from_images(views_of(balls), CONFIG, lines.append)
    validate.check_tets(vertices, tets)
    assert vertices.dtype == np.float64 and tets.dtype == np.int32
    assert abs(len(tets) / 120 - 1) <= 0.2
    # Views that the cage was not built from.
    masks, *cameras = posed_balls(balls, count=37, side=80)
    assert validate.missed_foreground(vertices, tets, masks, *cameras).missed.sum() == 0
    # The balls have 0.54; pixels (0.08 wide), voxels and 120 flat tets cost the rest.
    assert validate.quality_report(vertices, tets).volume < 2.0
    assert "dihedral angles" in lines[-1] and "0.0000%" in lines[-1]


def test_a_box_stays_the_bounding_box():
    vertices, tets = cage_from_images(views_of([((0.1, 0, 0), 0.5)]), CageConfig(shape="box"), lambda _: None)
    expected, same = box_tets(np.stack([vertices.min(axis=0), vertices.max(axis=0)]))
    np.testing.assert_array_equal(vertices, expected)  # or a run that goes on would have another
    np.testing.assert_array_equal(tets, same)


def test_an_empty_mask_stops_before_any_meshing():
    views = views_of([((0, 0, 0), 0.5)], count=6, side=32)
    views.images[3] = 0
    with pytest.raises(ValueError, match=r"image 3 \(r_3\) is empty"):
        cage_from_images(views, CONFIG, print)


def test_rays_that_miss_after_every_attempt_are_an_error(monkeypatch):
    views = views_of([((0, 0, 0), 0.5)], count=12, side=48)
    box = np.array([[0.3] * 3, [0.5] * 3])  # a corner of the object only
    margins = []

    def small_box(envelope, target, diagonal, margin, log):
        margins.append(margin)
        return box_tets(box)

    monkeypatch.setattr(module, "tetrahedralize", small_box)
    with pytest.raises(ValueError, match=r"foreground rays miss the cage .* worst view: \d+ \(r_"):
        cage_from_images(views, CONFIG, lambda _: None)
    assert len(margins) == 3 and margins[0] < margins[1] < margins[2]


def test_cage_from_a_surface(tmp_path):
    torus = trimesh.creation.torus(1.0, 0.3)
    torus.export(tmp_path / "torus.obj")
    vertices, tets = cage_from_surface(tmp_path / "torus.obj", CONFIG, lambda _: None)
    validate.check_tets(vertices, tets)
    assert abs(len(tets) / 120 - 1) <= 0.2
    assert not validate.outside_points(np.asarray(torus.vertices), vertices, tets).any()
    with pytest.raises(ValueError, match="not closed"):
        open_ball = trimesh.creation.icosphere()
        open_ball.update_faces(np.arange(len(open_ball.faces)) > 0)
        cage_from_surface(open_ball, CONFIG)
    with pytest.raises(FileNotFoundError, match=r"knot.obj: no such surface file.*torus.obj"):
        cage_from_surface(tmp_path / "knot.obj", CONFIG)


@pytest.mark.skipif(not MESHES.is_dir(), reason="the shared meshes are not on this machine")
def test_cage_of_spot():
    vertices, tets = cage_from_surface(MESHES / "spot.obj", CageConfig(grid_resolution=64), print)
    assert abs(len(tets) / 350 - 1) <= 0.2
    # Spot's own volume is 0.72.
    assert 0.72 < validate.quality_report(vertices, tets).volume < 1.5
