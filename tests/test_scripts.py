"""The scripts as a user runs them: the main job in small, and errors that end in one line."""

import importlib.util
import json
import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import captures
import jax
import numpy as np
import pytest

from nimpostor_jax.io.blender import load_blender
from nimpostor_jax.io.mesh_files import load_tets
from nimpostor_jax.io.scenes import builtin_scene
from nimpostor_jax.pipeline.prepare import SMALL_LOOPS
from nimpostor_jax.preprocess.validate import missed_foreground

ROOT = Path(__file__).resolve().parents[1]
SMALL = [
    "--gin_bindings",
    "DataConfig.resolution=32",
    "CageConfig.target_tets=100",
    "CageConfig.grid_resolution=48",
    "EncodingConfig.num_levels=3",
    "TrainConfig.steps=20",
    "TrainConfig.rays_per_batch=512",
]


@pytest.fixture
def run_here(monkeypatch, capsys):
    """Run a script to its end within this process, which has imported most of what it needs."""
    jax.devices()  # initialised first: what a script says about devices is without effect then
    chosen = f"--xla_force_host_platform_device_count=2 {SMALL_LOOPS}"
    monkeypatch.setenv("XLA_FLAGS", f"{os.environ.get('XLA_FLAGS', '')} {chosen}")
    monkeypatch.syspath_prepend(str(ROOT / "experiments"))

    def run_script(script, *arguments):
        monkeypatch.setattr(sys, "argv", [script, *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(ROOT / "experiments" / script), run_name="__main__")
        return ended.value.code, *capsys.readouterr()

    return run_script


def run(script, *arguments, timeout=300):
    """Small runs mostly compile: less well, but faster. (`.ci/run` trains and evaluates as users do.)"""
    command = [sys.executable, str(ROOT / "experiments" / script), *map(str, arguments)]
    quick = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False, env=quick)


def test_train_and_render(tmp_path, run_here):
    """(`.ci/run` evaluates the same run again.)"""
    done = run("train.py", "--data=fluffy_ball", f"--workdir={tmp_path}", *SMALL)
    assert done.returncode == 0, done.stderr
    for name in ("cage.npz", "config.gin", "log.csv", "impostor.npz", "metrics.json"):
        assert (tmp_path / name).exists(), name
    trained = json.loads((tmp_path / "metrics.json").read_text())
    assert trained["steps"] == 20
    assert len(trained["per_view"]) == 25

    kept = (tmp_path / "config.gin").read_text()
    other = [*SMALL, "TrainConfig.learning_rate=0.02", "TrainConfig.log_every=7"]
    status, _, errors = run_here("train.py", "--data=fluffy_ball", f"--workdir={tmp_path}", *other)
    assert status == 2
    assert "a finished run with TrainConfig.learning_rate = 0.01, not 0.02" in errors
    assert (tmp_path / "config.gin").read_text() == kept

    bend = tmp_path / "twist.json"
    bend.write_text('{"name": "twist", "k": 0.9}')
    done = run(
        "render.py",
        "--data=fluffy_ball",
        f"--workdir={tmp_path}",
        "--frames=2",
        "--video=orbit.gif",
        f"--deformation={bend}",
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "orbit.gif").exists()
    assert len(list((tmp_path / "frames" / "orbit").glob("*.png"))) == 2


@pytest.mark.slow
def test_edits_come_out_of_scripts(tmp_path):
    """A run, then a finer cage, another cage, a bite, and two of them side by side."""
    work, few = tmp_path / "work", ["RetrainConfig.feature_steps=5", "RetrainConfig.render_steps=5"]
    done = run("train.py", "--data=fluffy_ball", f"--workdir={work}", *SMALL)
    assert done.returncode == 0, done.stderr
    common = ["--data=fluffy_ball", f"--workdir={work}", "--frames=2"]

    done = run("edit_remesh.py", *common, "--subdivide", timeout=900)
    assert done.returncode == 0, done.stderr
    result = json.loads((work / "remesh" / "remesh.json").read_text())
    assert result["psnr_to_before"] > 60 and result["tets_after"] > 3 * result["tets_before"]
    done = run("evaluate.py", "--data=fluffy_ball", f"--workdir={work / 'remesh'}")
    assert done.returncode == 0, done.stderr
    psnr = json.loads((work / "remesh" / "metrics.json").read_text())["psnr"]
    assert psnr == pytest.approx(result["psnr_after"], abs=0.01)

    # After 20 steps there still is haze all over the old cage, and more than 0.1 % of it beyond the new one.
    retrain = ["--gin_bindings", *few, "CageConfig.target_tets=80", "RetrainConfig.max_lost_share=0.2"]
    done = run("edit_remesh.py", *common, f"--out={tmp_path / 'anew'}", *retrain, timeout=900)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "anew" / "orbit.gif").exists() and (tmp_path / "anew" / "impostor.npz").exists()

    bite = ["--operation=difference", "--pattern=sphere", "--consolidate", "--gin_bindings", *few]
    done = run("edit_boolean.py", *common, *bite, timeout=900)
    assert done.returncode == 0, done.stderr
    assert json.loads((work / "boolean" / "boolean.json").read_text())["psnr_consolidated_to_live"] > 10

    both = [f"--out={tmp_path / 'both'}", "--size=32", "--frames=2"]
    done = run("edit_compose.py", "--workdirs", str(work), str(work), *both, timeout=900)
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "both" / "compose.json").read_text())["objects"] == 2

    small = [f"--out={tmp_path / 'snow'}", "--size=32", "--frames=2"]
    done = run("snowman.py", f"--ball={work}", *small, timeout=900)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "snow" / "frame.png").exists()


@pytest.mark.slow
def test_measurements_come_out_of_scripts(tmp_path):
    """Of a run whose folder has no cage, as the ladder's; its impostor says what cage it was trained in."""
    work, size = tmp_path / "work", "--gin_bindings=DataConfig.resolution=32"
    done = run("train.py", "--data=fluffy_ball", f"--workdir={work}", *SMALL)
    assert done.returncode == 0, done.stderr
    (work / "cage.npz").unlink()
    run_of = ["--data=fluffy_ball", f"--workdir={work}"]
    done = run("stages.py", *run_of, f"--out={tmp_path / 'stages.json'}", timeout=900)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "stages.json").read_text())["rows"]
    assert {row["rays"] for row in rows} >= {"frame", "training"} and all(row["cpu_ms"] >= 0 for row in rows)

    same = tmp_path / "same" / "work"
    shutil.copytree(work, same)
    few = ["--views=1", "--repeats=1", "--only=step", f"--also={work}", f"--also={same}"]
    done = run("pareto.py", *run_of, f"--out={tmp_path / 'pareto'}", *few, timeout=900)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "pareto" / "pareto.json").read_text())["rows"]
    errors = {(row["lever"], row["value"]): row["mean_error"] for row in rows}
    assert errors["step", 1 / 16] < errors["step", 1 / 4] < errors["step", 1 / 2]
    twins = [row["psnr"] for row in rows if row["lever"].startswith("run ")]
    psnr = json.loads((work / "metrics.json").read_text())["per_view"][0]["psnr"]
    assert len(twins) == 2 and twins[0] == twins[1] == pytest.approx(psnr, abs=0.01)

    done = run("layouts.py", *run_of, f"--out={tmp_path / 'layouts'}", "--views=1", timeout=900)
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "layouts" / "layouts.json").read_text())["rows"][0]["seams"] > 0
    cost = [f"--out={tmp_path / 'cost.json'}", "--size=32", "--repeats=1", "--counts", "1", "2"]
    done = run("compose_cost.py", f"--workdir={work}", *cost, timeout=900)
    assert done.returncode == 0, done.stderr
    quick = [f"BakeConfig.{text}" for text in ("fit_rays=20000", "novel_views=2", "refine_steps=5")]
    done = run("bake.py", *run_of, "--gin_bindings", *quick, timeout=900)
    assert done.returncode == 0, done.stderr
    fps = json.loads((work / "baked.json").read_text())["fps"]
    assert set(fps) == {"field", "baked, marched", "baked, rasterized"}
    timed = [f"--out={tmp_path / 'times.json'}", "--repeats=1", "--frame_size=32", size]
    done = run("benchmark.py", *run_of, *timed, timeout=900)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_edit_deform_compares_with_true_pictures(tmp_path):
    """The held-out views stand for pictures of an object that has hardly moved, and of one that has."""
    builtin = ROOT / "src" / "nimpostor_jax" / "data" / "fluffy_ball"
    data, work = tmp_path / "data", tmp_path / "work"
    shutil.copytree(builtin, data)
    shutil.copy(data / "transforms_test.json", data / "transforms_test_bend.json")
    still, real = tmp_path / "deformation_bend.json", tmp_path / "deformation_far.json"
    still.write_text('{"name": "bend", "c": 1e-3}')
    real.write_text('{"name": "rigid", "rotation": [[1,0,0],[0,1,0],[0,0,1]], "translation": [0.5, 0, 0]}')
    done = run("train.py", f"--data={data}", f"--workdir={work}", *SMALL)
    assert done.returncode == 0, done.stderr
    common = [f"--data={data}", f"--workdir={work}", "--quick", "--handles=6"]
    done = run("edit_deform.py", *common, f"--deformation={still}")
    assert done.returncode == 0, done.stderr
    result = json.loads((work / "edit.json").read_text())
    # Bent by 1e-3 rad a unit: less than a hundredth of a pixel.
    assert result["psnr_deformed"] == pytest.approx(result["psnr_rest"], abs=0.1)
    assert result["handles"]["converged"] and result["handles"]["rms_distance"] < 1e-3  # of what hardly moved
    assert result["views"] == 2 and result["inverted_tets"] == 0 and result["split"] == "test_bend"
    assert (work / "edit.gif").exists() and len(list((work / "edit").glob("*/*.png"))) == 6

    split = ["--split=test_bend", f"--out={tmp_path / 'far'}"]
    done = run("edit_deform.py", *common, f"--deformation={real}", *split)
    assert done.returncode == 0, done.stderr
    far = json.loads((tmp_path / "far" / "edit.json").read_text())
    assert far["psnr_deformed"] < result["psnr_rest"] - 1  # it stands a quarter of the picture away
    assert far["psnr_unmoved"] == pytest.approx(result["psnr_rest"], abs=1e-3)  # the same pictures

    done = run("edit_deform.py", *common, f"--deformation={real}")
    assert done.returncode == 2 and "no split 'test_far'" in done.stderr


@pytest.mark.parametrize(
    "script, arguments, message",
    [
        ("train.py", ["--data=fluffy_ball", "--workdir=W", "--gin_bindings=TrainConfig.stepz=1"], "steps"),
        ("train.py", ["--data=fluffy_ball", "--workdir=W", "--gin_bindings=TrainConfig.steps='9'"], "steps"),
        ("train.py", ["--data=nowhere", "--workdir=W"], "nowhere"),
        ("train.py", ["--data=fluffy_ball", "--workdir=W", "--max_minutes=-1"], "max_minutes"),
        ("train.py", ["--data=fluffy_ball", "--workdir=W", "--cage=none.npz"], "none.npz"),
        ("evaluate.py", ["--data=fluffy_ball", "--workdir=W"], "config.gin"),
        (
            "edit_deform.py",
            ["--data=fluffy_ball", "--workdir=W", "--deformation=none.json"],
            "experiments/train.py --data",
        ),
        ("bake.py", ["--data=fluffy_ball", "--workdir=W"], "config.gin"),
        ("table2.py", ["--scene=fluffy_ball", "--out=W", "--cage", "a.npz", "b.npz"], "2 cages for 1 scenes"),
        ("table2.py", ["--scene=fluffy_ball", "--out=W", "--cage=none.npz"], "none.npz does not exist"),
        ("table1.py", ["--scene=fluffy_ball", "--out=W", "--cage=none.npz"], "none.npz does not exist"),
        ("table2.py", ["--scene", "a/mic", "b/mic", "--out=W"], "different names"),
        ("make_cage.py", ["--surface=none.obj", "--out=W/c.npz"], "none.obj"),
        ("make_cage.py", ["--data=fluffy_ball", "--out=W/c.obj"], "unknown cage format '.obj'"),
        ("render.py", ["--data=fluffy_ball", "--workdir=W", "--video=o.gif", "--fps=60"], "0.01 to 50 fps"),
        ("capture.py", ["--data=nowhere", "--workdir=W"], "nowhere"),
        ("capture.py", ["--data=nowhere", "--workdir=W", "--coarse_bindings=TrainConfig.stepz=1"], "steps"),
        ("capture.py", ["--data=.", "--workdir=W", "--box", "0", "0", "0", "1", "1", "0"], "--box"),
    ],
)
def test_bad_input_ends_in_one_line(script, arguments, message, tmp_path, run_here):
    workdir = tmp_path / "work"
    filled = [a.replace("W", str(workdir), 1) if "=W" in a else a for a in arguments]
    status, _, errors = run_here(script, *filled)
    assert status == 2
    lines = errors.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and message in lines[0]
    assert not workdir.exists()


SCRIPTS = [
    "train", "evaluate", "render", "make_cage", "benchmark", "demo", "bake", "table2", "capture",
    "edit_deform", "edit_remesh", "edit_boolean", "edit_compose", "snowman",
    "layouts", "compose_cost",
]  # fmt: skip


@pytest.mark.parametrize("script", [f"{name}.py" for name in SCRIPTS])
def test_help_says_what_there_is(script, run_here):
    status, text, _ = run_here(script, "--help")
    assert status == 0
    assert "--gin_bindings" in text and "TrainConfig.steps" in text


@pytest.mark.slow
def test_the_tables_come_out_of_scripts(tmp_path):
    """Every method trained, baked, bent, timed, in small; the second script takes the first one's runs."""
    done = run("table2.py", "--scene=fluffy_ball", f"--out={tmp_path}", "--quick", timeout=1500)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "table2.json").read_text())["rows"]
    assert [row["method"] for row in rows] == ["NGP-Bounded", "BaryEnc", "BarySpl", "FeatInt", "Baked"]
    for row in rows:
        assert row["psnr"] > 5 and row["fps"] > 0 and row["steps"] == 20 and row["resolution"] == 24
    assert rows[-1]["raster_difference"] < 1e-3
    tets = [row["tets"] for row in rows]
    assert tets[0] == 6 and len(set(tets[1:4])) == 1 and 50 < tets[1] < 200  # about 100 are asked for
    for name in ("table2.csv", "table2.md", "fluffy_ball/24.png"):
        assert (tmp_path / name).exists()

    other = ["--quick", "--gin_bindings=TrainConfig.seed=1"]
    refused = run("table2.py", "--scene=fluffy_ball", f"--out={tmp_path}", *other)
    assert refused.returncode == 2 and "run of other input (not TrainConfig.seed = 1)" in refused.stderr

    done = run("table1.py", "--scene=fluffy_ball", f"--out={tmp_path}", "--quick", timeout=900)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("trained already") == 3 and "baked already" in done.stdout
    rows = json.loads((tmp_path / "table1.json").read_text())["rows"]
    assert len(rows) == 5 and all(row["fps"] > 0 for row in rows)

    proxies = ["--quick", "--proxies", "box", "sphere1"]
    done = run("figure10.py", "--scene=fluffy_ball", f"--out={tmp_path}", *proxies, timeout=900)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "figure10.json").read_text())["rows"]
    assert rows[0]["tets"] == 6
    assert rows[1]["tets"] == pytest.approx(436, rel=0.2)


@pytest.mark.slow
def test_photographs_become_an_impostor(tmp_path):
    """Poses, a lens and no masks: the dataset, a cage around the object, and a matte that is the object's."""
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("pycolmap (extra capture) is not installed")
    views = load_blender(builtin_scene("fluffy_ball"), "train", 64)
    world = captures.similarity(scale=0.02)
    captures.write_capture(tmp_path / "data", views, world)
    small = [*SMALL, "DataConfig.resolution=None", "TrainConfig.steps=100"]
    coarse = ["--coarse_bindings", "DataConfig.resolution=64", "TrainConfig.steps=120"]
    out = tmp_path / "work"
    done = run("capture.py", f"--data={tmp_path / 'data'}", f"--workdir={out}", *small, *coarse, timeout=1500)
    assert done.returncode == 0, done.stderr
    for name in ("scene/transforms_train.json", "cage.npz", "impostor.npz", "metrics.json"):
        assert (out / name).exists(), name
    vertices, tets = load_tets(out / "cage.npz")
    poses = captures.moved(views.camera_to_world, *world)
    solid = (views.masks > 0.9).astype(np.float32)
    missed = missed_foreground(vertices, tets, solid, poses, views.focal, views.principal)
    assert missed.missed_share < 0.01
    size = np.ptp(vertices, axis=0) / world[1]
    assert size.min() > 1.5 and size.max() < 3.5  # the ball with its fur is about 2 units wide
    psnr = json.loads((out / "metrics.json").read_text())["psnr"]
    assert psnr > 20  # 100 steps; the background alone gives less than 15 dB

    done = run("evaluate.py", f"--data={out / 'scene'}", f"--workdir={out}")
    assert done.returncode == 0, done.stderr
    assert json.loads((out / "metrics.json").read_text())["psnr"] == pytest.approx(psnr, abs=0.01)
