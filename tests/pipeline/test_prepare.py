"""pipeline.prepare: what the scene says about the config."""

import dataclasses
import os
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from nimpostor_jax.config import CageConfig, ExperimentConfig
from nimpostor_jax.gin_flags import load_config
from nimpostor_jax.io.mesh_files import save_tets
from nimpostor_jax.pipeline import prepare as prepare_module
from nimpostor_jax.pipeline.prepare import (
    SMALL_LOOPS,
    check_built,
    fit_levels,
    load_cage,
    pixels_per_edge,
    prepare,
    settings_of,
    use_all_cores,
)
from nimpostor_jax.preprocess.tetrahedralize import box_tets


@pytest.mark.parametrize("pixels, levels", [(100.0, 13), (20.0, 10), (0.1, 1)])
def test_levels_with_cells_below_half_a_pixel_are_left_out(pixels, levels):
    """Resolutions 1, 2, 3, ..., 96 on an edge of so many pixels."""
    said = []
    config = fit_levels(ExperimentConfig(), pixels, said.append)
    assert config.impostor.encoding.num_levels == levels
    assert f"the finest of {levels} levels" in said[0]
    assert ("13 were asked for" in said[0]) == (levels < 13)


def test_edges_count_by_the_volume_of_their_tets():
    """Equal tets: the median. A skin of many small ones does not count, however many they are."""
    vertices, tets = box_tets(np.array([[0.0, 0, 0], [1, 2, 3]]))
    poses = np.tile(np.eye(4), (3, 1, 1))
    center = vertices.mean(axis=0)
    poses[:, :3, 3] = center + np.array([0, 0, 4])
    views = SimpleNamespace(camera_to_world=poses, focal=np.full((3, 2), 100.0))
    lengths = np.concatenate([pdist(vertices[tet]) for tet in tets])
    expected = np.median(lengths) * 100 / 4
    assert pixels_per_edge(vertices, tets, views) == pytest.approx(expected)

    stray = np.concatenate([vertices, [[99.0, 99, 99]]])  # of no tet
    assert pixels_per_edge(stray, tets, views) == pytest.approx(expected)

    skin = np.concatenate([vertices, *[center + 0.01 * (vertices - center)] * 9])
    many = np.concatenate([tets + len(vertices) * i for i in range(10)])
    assert pixels_per_edge(skin, many, views) == pytest.approx(expected, rel=1e-3)  # 9e-6 of the volume


@pytest.mark.parametrize("own", ["", " --xla_backend_extra_options=some_option=1"])
def test_small_loops_are_compiled_as_a_whole_unless_the_user_has_such_options(own, monkeypatch):
    flags = "--xla_force_host_platform_device_count=2" + own  # as the number of devices, which is chosen
    monkeypatch.setenv("XLA_FLAGS", flags)
    use_all_cores()
    assert os.environ["XLA_FLAGS"] == (flags if own else f"{flags} {SMALL_LOOPS}")


def test_a_cage_is_read_before_pictures_are(monkeypatch):
    def read(*_):
        raise AssertionError("pictures were read first")

    monkeypatch.setattr(prepare_module, "load_scene", read)
    with pytest.raises(FileNotFoundError, match=r"gone\.npz: no such cage file"):
        prepare(load_config(), "fluffy_ball", cage="gone.npz")


def test_opaque_alpha_is_no_mask(config, cage):
    """Pictures that were saved with an alpha channel of ones; a cage does not have to hold all they show."""
    scene = prepare(config, "fluffy_ball", cage=cage, log=lambda _: None)
    opaque = scene.train.images.copy()
    opaque[..., 3] = 1
    train = dataclasses.replace(scene.train, images=opaque)
    assert scene.train.show_masks and train.has_alpha.all() and not train.show_masks
    load_cage(config, train, cage, None, lambda _: None)


def test_a_step_that_is_not_known_is_asked_for_before_anything_is_read():
    config = load_config(bindings=["SamplerConfig.measure='euclidean'"])
    with pytest.raises(ValueError, match=r"SamplerConfig\.step must be given"):
        prepare(config, "no/such/folder")


def test_a_built_cage_is_taken_again_with_its_own_settings_alone(tmp_path):
    own, path = CageConfig(target_tets=100), tmp_path / "cage.npz"
    cage = box_tets(np.array([[0.0, 0, 0], [1, 1, 1]]))
    save_tets(path, *cage, settings_of(own))
    check_built(path, own)
    config = ExperimentConfig(cage=CageConfig(target_tets=300))
    with pytest.raises(ValueError, match=r"cage\.npz was built with CageConfig.target_tets = 100, not 300"):
        prepare(config, "nowhere", cage=path, cage_output=path)  # before anything else is read
    check_built(path, CageConfig(target_tets=100, max_missed_share=0.1))  # asked anew of all views
    save_tets(path, *cage)  # from elsewhere
    check_built(path, own)
    save_tets(tmp_path / "cage.vtu", *cage, settings_of(own))  # which keeps none
    check_built(tmp_path / "cage.vtu", own)
