import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nimpostor_jax.config import DataConfig
from nimpostor_jax.io.blender import check_masks, load_blender, load_scene
from nimpostor_jax.io.scenes import BUILTIN_SCENES, builtin_scene, resolve_scene


@pytest.mark.parametrize("name", BUILTIN_SCENES)
def test_builtin_scenes_load(name):
    folder = builtin_scene(name)
    train, test = load_scene(folder, DataConfig())
    assert (len(train), len(test)) == (100, 25)
    assert train.images.shape[1:] == test.images.shape[1:] == (100, 100, 4)
    check_masks(train)
    check_masks(test)
    assert sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) <= 2e6


def test_builtin_scene_is_the_area_average_of_its_source():
    source = Path(__file__).resolve().parents[2] / "../shared/data/fluffy_ball"
    if not source.is_dir():
        pytest.skip("the full-size scene is not here")
    stored = load_blender(builtin_scene("fluffy_ball"), "test")
    expected = load_blender(source, "test", stored.width)
    # Alpha is rounded by half of 1/255, and so is the colour that is multiplied by at most 1.
    assert_allclose(stored.images, expected.images, atol=0.501 / 255)
    assert_allclose(stored.camera_to_world, expected.camera_to_world, rtol=0, atol=0)
    assert_allclose(stored.focal, expected.focal, rtol=1e-6)  # the source states 7 digits


def test_unknown_builtin_scene_lists_the_names():
    with pytest.raises(ValueError, match=r"no built-in scene 'fluffy'; there are: fluffy_ball"):
        builtin_scene("fluffy")


def test_resolve_scene(tmp_path, monkeypatch):
    assert resolve_scene(str(tmp_path)) == tmp_path
    assert resolve_scene("fluffy_ball") == builtin_scene("fluffy_ball")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fluffy_ball").mkdir()
    assert resolve_scene("fluffy_ball") == Path("fluffy_ball")  # what the caller has comes first


def test_resolve_scene_names_what_is_wrong(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no/such .*built-in: fluffy_ball"):
        resolve_scene("no/such")
    (tmp_path / "file").write_text("")
    with pytest.raises(NotADirectoryError, match="file is a file"):
        resolve_scene(tmp_path / "file")


def test_cameras_of_the_builtin_scene_see_it():
    """The mask's centroid lies near the picture's centre: camera and pixels belong together."""
    posed = load_blender(builtin_scene("fluffy_ball"), "train")
    columns = np.arange(posed.width) + 0.5
    weights = posed.masks / posed.masks.sum((1, 2), keepdims=True)
    centroids = np.einsum("nhw,w->n", weights, columns)
    # All cameras look at the ball's centre; its fur is uneven by about 1 px of 100.
    assert np.abs(centroids - posed.principal[:, 0]).max() < 3


def run_maker(monkeypatch, *arguments):
    script = Path(__file__).resolve().parents[2] / "experiments" / "make_builtin_scene.py"
    monkeypatch.setattr(sys, "argv", [str(script), *map(str, arguments)])
    runpy.run_path(str(script), run_name="__main__")


def test_make_builtin_scene(tmp_path, make_scene, rgba, monkeypatch, capsys):
    source = make_scene([rgba(12, 20) for _ in range(3)])
    make_scene([rgba(12, 20)], "test")
    run_maker(monkeypatch, source, tmp_path / "small", "--resolution", 10)
    assert "3 train + 1 test views" in capsys.readouterr().out
    for split in ("train", "test"):
        made, expected = load_blender(tmp_path / "small", split), load_blender(source, split, 10)
        assert_allclose(made.images, expected.images, atol=0.501 / 255)  # 8 bits, rounded
        assert_allclose(made.focal, expected.focal)
    with pytest.raises(SystemExit):
        run_maker(monkeypatch, source, tmp_path / "small", "--resolution", 10)
    assert "small exists" in capsys.readouterr().err


def test_make_builtin_scene_leaves_nothing_half_made(tmp_path, make_scene, rgba, monkeypatch):
    source = make_scene([rgba(12, 20)])  # no test split
    with pytest.raises(FileNotFoundError, match="transforms_test"):
        run_maker(monkeypatch, source, tmp_path / "small", "--resolution", 10)
    assert not (tmp_path / "small").exists()
