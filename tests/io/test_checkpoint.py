import dataclasses
import logging
import shutil
import subprocess
import sys
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nimpostor_jax.config import EncodingConfig, ExperimentConfig, ImpostorConfig, TrainConfig
from nimpostor_jax.io.checkpoint import (
    cage_fingerprint,
    latest_step,
    load_config,
    load_metadata,
    restore_checkpoint,
    save_checkpoint,
)

CONFIG = ExperimentConfig()


class Moments(NamedTuple):
    count: jax.Array
    mean: dict


@pytest.fixture
def state(impostor, rng):
    """What a run may carry, in the containers that optax and flax use."""
    bits = rng.integers(0, 2**32, 64, dtype=np.uint32)
    return {
        "impostor": impostor,
        "optimizer": (Moments(jnp.int32(7), {"w": jnp.asarray(bits).view(jnp.float32)}), ()),
        "key_data": jax.random.key_data(jax.random.key(3)),
        "key": jax.random.key(4),
        "mask": jnp.array([True, False]),
        "empty": jnp.zeros((0, 3), jnp.float32),
        "host": np.arange(3, dtype=np.float64),  # a NumPy leaf keeps float64 whatever jax's default
        "step": 12,
        "rate": 0.1,
        "done": False,
        "nothing": None,
    }


def leaf_bytes(leaf):
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    return np.asarray(leaf).tobytes()


def assert_same_bits(a, b):
    """Equal structure, leaf kinds, dtypes, shapes and bytes; NaN payloads and -0.0 count."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert isinstance(x, jax.Array) == isinstance(y, jax.Array)
        assert getattr(x, "dtype", type(x)) == getattr(y, "dtype", type(y))
        assert np.shape(x) == np.shape(y)
        assert leaf_bytes(x) == leaf_bytes(y)


def zero(leaf):
    if isinstance(leaf, (bool, int, float)):
        return type(leaf)(0)
    if isinstance(leaf, np.ndarray):
        return np.zeros_like(leaf)
    return (
        jax.random.key(0)
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        else jnp.zeros_like(leaf)
    )


def blank(state):
    """The same structure with other values, except the tets, which name the cage."""
    zeros = jax.tree.map(zero, state)
    tets = state["impostor"].mesh.tets
    mesh = zeros["impostor"].mesh.replace(tets=tets)
    return {**zeros, "impostor": zeros["impostor"].replace(mesh=mesh)}


def test_round_trip_is_exact(tmp_path, state):
    save_checkpoint(tmp_path, 12, state, CONFIG)
    restored, step = restore_checkpoint(tmp_path, blank(state), CONFIG)
    assert step == 12
    assert_same_bits(restored, state)


def test_restored_arrays_are_as_free_to_move_as_the_given_ones(tmp_path):
    device = jax.devices()[0]
    state = {"free": jnp.ones(3), "bound": jax.device_put(jnp.ones(3), device)}
    save_checkpoint(tmp_path, 1, state, CONFIG)
    restored, _ = restore_checkpoint(tmp_path, state, CONFIG)
    assert not restored["free"].committed and restored["bound"].committed


def test_restore_into_shapes(tmp_path):
    state = {"w": jnp.arange(3.0), "n": jnp.uint32(4)}
    save_checkpoint(tmp_path, 1, state, CONFIG)
    shapes = jax.eval_shape(lambda: state)
    assert_same_bits(restore_checkpoint(tmp_path, shapes, CONFIG)[0], state)


def test_keeps_the_last_two_steps(tmp_path):
    folder = tmp_path / "run" / "checkpoints"
    assert latest_step(folder) is None
    for step in (0, 5, 10, 15):
        save_checkpoint(folder, step, {"w": jnp.full(3, step)}, CONFIG)
        assert latest_step(folder) == step
    assert sorted(p.name for p in folder.iterdir() if p.is_dir()) == ["10", "15"]
    like = {"w": jnp.zeros(3, jnp.int32)}
    assert restore_checkpoint(folder, like, CONFIG)[0]["w"].tolist() == [15] * 3
    restored, step = restore_checkpoint(folder, like, CONFIG, step=10)
    assert step == 10 and restored["w"].tolist() == [10] * 3


def test_saving_the_latest_step_again_replaces_it(tmp_path):
    for value in (1, 2):
        save_checkpoint(tmp_path, 3, {"w": jnp.int32(value)}, CONFIG)
    restored, _ = restore_checkpoint(tmp_path, {"w": jnp.int32(0)}, CONFIG)
    assert int(restored["w"]) == 2


def test_an_earlier_step_is_refused(tmp_path):
    save_checkpoint(tmp_path, 20, {"w": jnp.zeros(2)}, CONFIG)
    with pytest.raises(ValueError, match="already holds step 20, later than 10; resume"):
        save_checkpoint(tmp_path, 10, {"w": jnp.zeros(2)}, CONFIG)
    assert latest_step(tmp_path) == 20


def test_config_and_metadata_come_back(tmp_path):
    config = ExperimentConfig(
        impostor=ImpostorConfig(encoding=EncodingConfig(log2_tet_table=9)),
        train=TrainConfig(steps=7),
    )
    save_checkpoint(tmp_path, 1, {"w": jnp.zeros(2)}, config, metadata={"seconds": 1.5, "l": [1]})
    assert load_config(tmp_path) == config
    assert load_metadata(tmp_path) == {"seconds": 1.5, "l": [1]}


def test_metadata_must_be_json(tmp_path):
    with pytest.raises(ValueError, match="metadata must be JSON"):
        save_checkpoint(tmp_path, 1, {"w": jnp.zeros(2)}, CONFIG, metadata={"a": np.zeros(2)})
    assert latest_step(tmp_path) is None


def test_training_fields_may_differ(tmp_path):
    save_checkpoint(tmp_path, 1, {"w": jnp.zeros(2)}, CONFIG)
    longer = dataclasses.replace(CONFIG, train=TrainConfig(steps=9999, log_every=3))
    restore_checkpoint(tmp_path, {"w": jnp.zeros(2)}, longer)


# Another configuration or cage


def test_another_impostor_config_names_the_first_field(tmp_path):
    save_checkpoint(tmp_path, 1, {"w": jnp.zeros(2)}, CONFIG)
    other = dataclasses.replace(
        CONFIG, impostor=ImpostorConfig(encoding=EncodingConfig(num_levels=3, growth=1.5))
    )
    message = r"impostor\.encoding\.num_levels is 13 there and 3 here"
    with pytest.raises(ValueError, match=message):
        restore_checkpoint(tmp_path, {"w": jnp.zeros(2)}, other)


def test_another_density_measure_is_refused(tmp_path):
    save_checkpoint(tmp_path, 1, {"w": jnp.zeros(2)}, CONFIG)
    render = dataclasses.replace(CONFIG.render, density_measure="euclidean", near=0.5)
    message = r"render\.density_measure is 'barycentric' there and 'euclidean' here"
    with pytest.raises(ValueError, match=message):
        restore_checkpoint(
            tmp_path, {"w": jnp.zeros(2)}, dataclasses.replace(CONFIG, render=render)
        )


@pytest.mark.parametrize(
    "like, message",
    [
        ({"a": {"w": jnp.zeros(3)}}, r"array a\.w is float32\[2\] there and float32\[3\] here"),
        ({"a": {"w": jnp.zeros(2, jnp.int32)}}, r"a\.w is float32\[2\] there and int32\[2\] here"),
        ({"a": {"v": jnp.zeros(2)}}, r"a\.v is missing there and float32\[2\] here"),
        ({"a": {}}, r"a\.w is float32\[2\] there and missing here"),
    ],
)
def test_other_arrays_are_refused(tmp_path, like, message):
    save_checkpoint(tmp_path, 1, {"a": {"w": jnp.zeros(2)}}, CONFIG)
    with pytest.raises(ValueError, match=message):
        restore_checkpoint(tmp_path, like, CONFIG)


def test_other_tets_of_the_same_shape_are_refused(tmp_path, state):
    save_checkpoint(tmp_path, 1, state, CONFIG)
    like = blank(state)
    mesh = like["impostor"].mesh
    swapped = mesh.replace(tets=mesh.tets.at[1].set(jnp.array([0, 2, 3, 4])))
    like["impostor"] = like["impostor"].replace(mesh=swapped)
    message = (
        r"another cage: 1 tets differ \(first: tet 1, vertices \[1, 2, 3, 4\] there and \[0, 2,"
    )
    with pytest.raises(ValueError, match=message):
        restore_checkpoint(tmp_path, like, CONFIG)


def test_cage_fingerprint_guards_a_state_without_mesh(tmp_path, impostor):
    mesh, like = impostor.mesh, {"w": jnp.zeros(2)}
    moved = mesh.replace(vertices=mesh.vertices.at[2, 0].add(0.5))
    save_checkpoint(tmp_path, 1, like, CONFIG, metadata={"cage": cage_fingerprint(mesh)})
    restore_checkpoint(tmp_path, like, CONFIG, metadata={"cage": cage_fingerprint(mesh)})
    with pytest.raises(ValueError, match=r"has another cage: saved \{'num_vertices': 6.*now"):
        restore_checkpoint(tmp_path, like, CONFIG, metadata={"cage": cage_fingerprint(moved)})
    assert cage_fingerprint(mesh) != cage_fingerprint(mesh.replace(tets=mesh.tets[::-1]))


# Missing, partial and damaged checkpoints


def test_missing_checkpoints(tmp_path):
    for read in (lambda f: restore_checkpoint(f, {}, CONFIG), load_config, load_metadata):
        for folder in (tmp_path / "none", tmp_path):
            with pytest.raises(FileNotFoundError, match=f"no checkpoint in {folder}"):
                read(folder)
    assert not (tmp_path / "none").exists()
    save_checkpoint(tmp_path, 4, {"w": jnp.zeros(2)}, CONFIG)
    with pytest.raises(FileNotFoundError, match=r"no checkpoint of step 5; it has \[4\]"):
        restore_checkpoint(tmp_path, {"w": jnp.zeros(2)}, CONFIG, step=5)


# Saves step 2 and dies just before the given rename, as of a power cut.
KILLED_SAVE = """
import os, sys
import jax.numpy as jnp
from nimpostor_jax.config import ExperimentConfig
from nimpostor_jax.io.checkpoint import save_checkpoint

folder, last = sys.argv[1], int(sys.argv[2])
seen = []

def hook(event, args):
    if event == "os.rename" and str(args[0]).startswith(folder):
        seen.append(args)
        if len(seen) == last:
            os._exit(9)

sys.addaudithook(hook)
save_checkpoint(folder, 2, {"w": jnp.full(1000, 2.0)}, ExperimentConfig())
"""


@pytest.mark.parametrize("rename", [1, 3])  # the first part of a step, and the step as a whole
def test_a_killed_save_leaves_the_step_before(tmp_path, rename):
    like = {"w": jnp.ones(1000)}
    save_checkpoint(tmp_path, 1, like, CONFIG)
    command = [sys.executable, "-c", KILLED_SAVE, str(tmp_path), str(rename)]
    killed = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert killed.returncode == 9, killed.stderr
    assert any(p.name.startswith("2") for p in tmp_path.iterdir())  # it had begun to write
    assert latest_step(tmp_path) == 1
    restored, step = restore_checkpoint(tmp_path, like, CONFIG)
    assert step == 1 and restored["w"][0] == 1
    save_checkpoint(tmp_path, 2, {"w": jnp.full(1000, 3.0)}, CONFIG)
    restored, step = restore_checkpoint(tmp_path, like, CONFIG)
    assert step == 2 and restored["w"][0] == 3
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_dir()) == ["1", "2"]


def test_a_damaged_step_is_named(tmp_path):
    like = {"w": jnp.asarray(np.random.default_rng(0).random(5000), jnp.float32)}
    for step in (1, 2):
        save_checkpoint(tmp_path, step, like, CONFIG)
    shutil.copytree(tmp_path, tmp_path.with_name("copy"))
    for path in (tmp_path / "2" / "state").rglob("*"):
        if path.is_file() and path.stat().st_size > 5000:
            path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"checkpoint .*/2 is damaged .*delete this folder"):
        restore_checkpoint(tmp_path, like, CONFIG)
    assert restore_checkpoint(tmp_path, like, CONFIG, step=1)[1] == 1
    (tmp_path.with_name("copy") / "2" / "config" / "metadata").write_text("{")
    with pytest.raises(ValueError, match=r"checkpoint .*/2 is damaged"):
        load_config(tmp_path.with_name("copy"))


def test_saving_is_quiet(tmp_path, capfd, caplog):
    level = logging.getLogger("absl").level
    with caplog.at_level(logging.INFO):
        for step in (1, 2, 3):
            save_checkpoint(tmp_path, step, {"w": jnp.zeros(2)}, CONFIG)
        restore_checkpoint(tmp_path, {"w": jnp.zeros(2)}, CONFIG)
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""
    assert [r for r in caplog.records if r.name == "absl"] == []
    assert logging.getLogger("absl").level == level
