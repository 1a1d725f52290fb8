"""The training run: it learns, it logs, and a killed run ends like one that was not."""

import csv
import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nimpostor_jax.gin_flags import load_config
from nimpostor_jax.io.checkpoint import latest_step
from nimpostor_jax.io.images import composite
from nimpostor_jax.io.mesh_files import save_tets
from nimpostor_jax.metrics import psnr
from nimpostor_jax.pipeline import fit as fit_module
from nimpostor_jax.pipeline.curve import HeldOutCurve
from nimpostor_jax.pipeline.evaluate import MAX_PSNR, evaluate, orbit, picture_name, vertical
from nimpostor_jax.pipeline.fit import Progress, _fingerprint, fit
from nimpostor_jax.pipeline.prepare import prepare
from nimpostor_jax.render.frame import _render_sharded


class Killed(Exception):
    """Stands for the end of the process."""


@pytest.fixture(scope="module")
def scene(config, cage):
    return prepare(config, "fluffy_ball", cage=cage, log=lambda _: None)


def cleared(impostor):
    """One that shows nothing."""
    decoders = jax.tree.map(np.zeros_like, impostor.decoders)
    decoders["density"][-1]["bias"] = decoders["density"][-1]["bias"] - 40.0  # exp(-40)
    return dataclasses.replace(impostor, decoders=decoders)


def arrays(impostor):
    return [np.asarray(leaf) for leaf in jax.tree.leaves((impostor.tables.features, impostor.decoders))]


def test_killed_and_resumed_run_equals_one_that_was_not(bindings, cage, tmp_path):
    config = load_config(bindings=[*bindings, "TrainConfig.eval_every=5"])
    scene = prepare(config, "fluffy_ball", cage=cage, log=lambda _: None)

    def die(impostor, step):
        raise Killed

    through, _ = fit(scene, workdir=tmp_path / "a", log=lambda _: None)
    with pytest.raises(Killed):  # at step 5, two steps after the last checkpoint
        fit(scene, workdir=tmp_path / "b", callback=die, log=lambda _: None)
    messages = []
    resumed, progress = fit(scene, workdir=tmp_path / "b", log=messages.append)
    assert "step 3" in messages[0]
    assert progress.step == 6
    for a, b in zip(arrays(through), arrays(resumed), strict=True):
        np.testing.assert_array_equal(a, b)
    with (tmp_path / "b" / "log.csv").open() as file:
        assert [int(row["step"]) for row in csv.DictReader(file)] == [1, 2, 4, 6]


def no_number_from(step, monkeypatch):
    """Training whose parameters are no numbers from a step on."""
    train_step = fit_module.train_step

    def broken(state, *rest, **options):
        state, metrics = train_step(state, *rest, **options)
        bad = jax.tree.map(lambda x: jnp.where(state.step >= step, jnp.nan, x), state.parameters)
        return dataclasses.replace(state, parameters=bad), metrics

    monkeypatch.setattr(fit_module, "train_step", broken)


def test_what_is_no_number_is_not_saved(bindings, cage, tmp_path, monkeypatch):
    bindings = [*bindings, "TrainConfig.log_every=50", "TrainConfig.checkpoint_every=2"]
    scene = prepare(load_config(bindings=bindings), "fluffy_ball", cage=cage, log=lambda _: None)
    no_number_from(4, monkeypatch)
    with pytest.raises(FloatingPointError, match="after step 4; lower"):
        fit(scene, workdir=tmp_path, log=lambda _: None)
    assert latest_step(tmp_path / "checkpoints") == 2


def test_what_is_no_number_is_not_returned(scene, monkeypatch):
    no_number_from(6, monkeypatch)
    with pytest.raises(FloatingPointError, match="after step 6"):
        fit(scene, log=lambda _: None)


def test_buffers_grow_until_all_rays_are_trained_on(bindings, cage, tmp_path):
    """At the same steps in a run that was cut off."""
    steps = {"log_every": 4, "checkpoint_every": 2, "eval_every": 3, "warmup_steps": 1}
    config = load_config(bindings=[*bindings, *(f"TrainConfig.{k}={v}" for k, v in steps.items())])
    scene = prepare(config, "fluffy_ball", cage=cage, log=lambda _: None)
    march = dataclasses.replace(scene.render.march, max_tets_per_ray=3, capacity_per_ray=None)
    scene = dataclasses.replace(scene, render=dataclasses.replace(scene.render, march=march))
    messages = []
    through, progress = fit(scene, log=messages.append)
    assert 0 < progress.growths < fit_module.MAX_GROWTH
    assert any("of the rays overflowed; larger buffers" in message for message in messages)

    def die(impostor, step):
        raise Killed

    with pytest.raises(Killed):
        fit(scene, workdir=tmp_path, callback=die, log=lambda _: None)
    resumed, again = fit(scene, workdir=tmp_path, log=lambda _: None)
    assert again.growths == progress.growths
    for a, b in zip(arrays(through), arrays(resumed), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_log_keeps_its_lines_when_a_run_goes_on(tmp_path):
    """Before anything else happens, and without a line that was cut off."""
    path = tmp_path / "log.csv"
    header, rows = ",".join(fit_module.LOG_FIELDS), [f"{i},1,2,3,4,5,6,7" for i in (1, 2, 4, 6)]
    path.write_text("\n".join([header, *rows, "1"]))
    log = fit_module._LogFile(path, 4)
    assert path.read_text().split() == [header, *rows[:3]]
    log.close()


def test_a_callback_may_keep_what_it_gets(bindings, cage):
    config = load_config(bindings=[*bindings, "TrainConfig.eval_every=2"])
    scene, kept = prepare(config, "fluffy_ball", cage=cage, log=lambda _: None), []
    trained, _ = fit(scene, callback=lambda impostor, step: kept.append(impostor), log=lambda _: None)
    first, last = arrays(kept[0]), arrays(kept[-1])
    assert np.abs(first[0] - last[0]).max() > 0
    for a, b in zip(last, arrays(trained), strict=True):
        np.testing.assert_array_equal(a, b)


def test_loss_falls_and_time_budget_ends_the_run(scene):
    losses = []
    trained, progress = fit(scene, max_minutes=0.05, log=losses.append)
    before = evaluate(scene.impostor, scene.test.select([0]), scene.config.render, log=lambda _: None)
    after = evaluate(trained, scene.test.select([0]), scene.config.render, log=lambda _: None)
    assert progress.seconds >= 3
    assert after["psnr"] > before["psnr"] + 1  # an untrained fog against seconds of training


def test_a_curve_is_that_of_evaluation_and_compiles_once(scene, tmp_path):
    """Cells that become empty change no buffer; points beyond the checkpoint, or of other settings, go."""
    train = dataclasses.replace(scene.config.train, eval_every=2)
    scene = dataclasses.replace(scene, config=dataclasses.replace(scene.config, train=train))
    file, lines = tmp_path / "curve.json", []
    file.write_text("[[2, 10.0], [3, 10.5], [4, 11.0], [6, 30.0]]")
    curve = HeldOutCurve(scene, file, log=lines.append)
    full = dataclasses.replace(scene.impostor, occupied=jnp.ones((6, 20), bool))
    curve(full, 4)
    programs = _render_sharded._cache_size()
    curve(dataclasses.replace(full, occupied=jnp.zeros((6, 20), bool)), 6)
    assert _render_sharded._cache_size() == programs
    assert json.loads(file.read_text()) == [list(point) for point in curve.points]
    steps, (_, untrained, nothing) = zip(*curve.points, strict=True)
    assert steps == (2, 4, 6)
    views = scene.test.select(np.linspace(0, len(scene.test) - 1, 4).astype(int))
    result = evaluate(full, views, scene.config.render, log=lambda _: None)
    assert untrained == pytest.approx(result["psnr"], abs=1e-6)
    truths = [composite(image, "white") for image in views.images]
    white = np.mean([psnr(np.ones_like(truth), truth) for truth in truths])
    assert nothing == pytest.approx(white, abs=1e-6)
    assert lines[0] == f"step 4: PSNR {untrained:.2f} dB on 4 held-out views"


def test_equal_pictures_have_a_finite_psnr(scene, tmp_path):
    """Nothing, in front of white: of such a view infinity would go into the mean, and into JSON."""
    views = scene.test.select([0, 1])
    images = views.images.copy()
    images[0] = 0
    clear = cleared(scene.impostor)
    views = dataclasses.replace(views, images=images)
    result = evaluate(clear, views, scene.config.render, log=lambda _: None)
    assert result["per_view"][0]["psnr"] == MAX_PSNR
    assert MAX_PSNR / 2 < result["psnr"] < MAX_PSNR


def test_a_damaged_curve_is_named(scene, tmp_path):
    (tmp_path / "curve.json").write_text("[[2,")
    with pytest.raises(ValueError, match=r"curve\.json is damaged .*remove it"):
        HeldOutCurve(scene, tmp_path / "curve.json")


def test_evaluation_writes_pictures(scene, tmp_path):
    result = evaluate(
        scene.impostor, scene.test.select([0, 1]), scene.config.render, pictures=tmp_path, log=lambda _: None
    )
    assert set(result) == {"psnr", "ssim", "lpips", "seconds_per_frame", "per_view"}
    assert result["lpips"] is None  # pictures of 25 pixels are too small for it
    assert len(result["per_view"]) == len(list(tmp_path.glob("*.png"))) == 2


def test_pictures_of_equal_names_are_apart(scene):
    views = scene.test.select([0, 1])
    assert picture_name(views, 1) == views.names[1].split("/")[-1]
    twins = dataclasses.replace(views, names=("left/0001.png", "right/0001.png"))
    assert [picture_name(twins, i) for i in range(2)] == ["left_0001.png", "right_0001.png"]


def test_schedule_follows_steps_or_the_clock(config):
    progress = Progress(step=3, seconds=30.0)
    assert progress.share(config.train, None) == 0.5
    assert progress.share(config.train, 1.0) == 0.5


def test_cage_beside_the_object_is_refused(config, cage, tmp_path):
    with np.load(cage) as data:
        save_tets(tmp_path / "beside.npz", data["V"] + 10.0, data["T"])
    with pytest.raises(ValueError, match=r"beside\.npz.*miss"):
        prepare(config, "fluffy_ball", cage=tmp_path / "beside.npz", log=lambda _: None)


def test_checkpoint_of_another_configuration_is_refused(scene, bindings, cage, tmp_path):
    fit(scene, workdir=tmp_path, log=lambda _: None)
    other = load_config(bindings=[*bindings, "EncodingConfig.num_levels=2"])
    with pytest.raises(ValueError, match="num_levels"):
        fit(prepare(other, "fluffy_ball", cage=cage, log=lambda _: None), workdir=tmp_path)
    render = dataclasses.replace(scene.config.render, integrate="features")
    early = dataclasses.replace(scene, config=dataclasses.replace(scene.config, render=render))
    with pytest.raises(ValueError, match=r"render\.integrate is 'color' there and 'features' here"):
        fit(early, workdir=tmp_path)


def test_a_folders_cage_stays_its_own(config, cage, tmp_path):
    with np.load(cage) as data:
        save_tets(tmp_path / "cage.npz", 1.01 * data["V"], data["T"])
    with pytest.raises(ValueError, match=r"cage\.npz is another cage than .*cube\.npz"):
        prepare(config, "fluffy_ball", cage=cage, cage_output=tmp_path / "cage.npz", log=lambda _: None)
    prepare(config, "fluffy_ball", cage=cage, cage_output=cage, log=lambda _: None)


def test_views_are_compared_over_their_own_backgrounds(scene):
    """A field that shows nothing is right where the truth is the background, and off by the rest."""
    views = scene.test.select([0])
    behind = np.random.default_rng(0).uniform(size=views.images[..., :3].shape).astype(np.float32)
    opaque = np.concatenate([behind, np.ones_like(behind[..., :1])], axis=-1)
    opaque[0, :5, :, :3] = 1 - behind[0, :5]
    clear = cleared(scene.impostor)
    views = dataclasses.replace(views, images=opaque, backgrounds=behind)
    found = evaluate(clear, views, scene.config.render, log=lambda _: None)["psnr"]
    wrong = np.mean(np.square(opaque[..., :3] - behind))
    assert found == pytest.approx(-10 * np.log10(wrong), abs=1e-3)


def test_pictures_too_small_for_a_metric_have_none_of_it(scene):
    views = scene.test.select([0])
    low = dataclasses.replace(views, images=views.images[:, :8])
    result = evaluate(cleared(scene.impostor), low, scene.config.render, log=lambda _: None)
    assert result["ssim"] is None and result["lpips"] is None
    assert np.isfinite(result["psnr"])


def test_other_backgrounds_are_other_pictures(scene):
    views = dataclasses.replace(scene.train, backgrounds=np.zeros_like(scene.train.images[..., :3]))
    other = dataclasses.replace(views, backgrounds=views.backgrounds + 1)
    assert len({_fingerprint(each) for each in (scene.train, views, other)}) == 3


def test_the_vertical_is_the_cameras_own(scene):
    views = scene.train  # held level, in a world with z up
    np.testing.assert_allclose(vertical(views), [0, 0, 1], atol=1e-6)
    turn = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
    poses = views.camera_to_world.copy()
    poses[:, :3] = turn @ poses[:, :3]
    turned = dataclasses.replace(views, camera_to_world=poses)
    np.testing.assert_allclose(vertical(turned), turn @ [0, 0, 1], atol=1e-6)
    for one, other in zip(orbit(views, 3), orbit(turned, 3), strict=True):
        height = np.asarray(one.camera_to_world)[2, 3]
        turned_height = turn[:, 2] @ np.asarray(other.camera_to_world)[:3, 3]
        np.testing.assert_allclose(turned_height, height, atol=1e-5)  # float32


def test_orbit_looks_at_the_object(scene):
    for camera in orbit(scene.train, 3):
        pose = np.asarray(camera.camera_to_world)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)  # float32
        toward_center = -pose[:3, 3] / np.linalg.norm(pose[:3, 3])
        assert -pose[:3, 2] @ toward_center > 0.99  # the scene is centred near the origin
