"""The methods that the paper's tables compare, trained or reused; and the tables' files."""

import csv
import dataclasses
import hashlib
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from nimpostor_jax.config import ExperimentConfig
from nimpostor_jax.gin_flags import load_config, operative_config_text
from nimpostor_jax.io.atomic import atomic_path
from nimpostor_jax.io.blender import PosedImages, check_masks, load_scene
from nimpostor_jax.io.images import read_image, write_png
from nimpostor_jax.io.impostor_file import load_baked, load_impostor, save_impostor
from nimpostor_jax.io.mesh_files import save_tets
from nimpostor_jax.io.scenes import resolve_scene
from nimpostor_jax.pipeline.bake import bake
from nimpostor_jax.pipeline.curve import HeldOutCurve
from nimpostor_jax.pipeline.evaluate import camera_of, evaluate, picture_name, write_json
from nimpostor_jax.pipeline.fit import fit
from nimpostor_jax.pipeline.prepare import Scene, check_built, prepare, settings_of
from nimpostor_jax.preprocess.cage import cage_from_images
from nimpostor_jax.render.frame import frame_config, render_frame, to_image
from nimpostor_jax.render.raster_frame import rasterize_frame
from nimpostor_jax.types import BakedImpostor, NeuralImpostor

CONFIGS = Path(__file__).parent / "configs" / "ladder"
METHODS = {
    "NGP-Bounded": "ngp_bounded",
    "BaryEnc": "bary_enc",
    "BarySpl": "bary_spl",
    "FeatInt": "feat_int",
}
CURVE_POINTS = 10  # of held-out PSNR against training time
# What --quick puts in the place of the defaults: every step of the script in a minute or two, for tests.
QUICK = (
    "CageConfig.target_tets=100",
    "CageConfig.grid_resolution=48",
    "SamplerConfig.max_samples_per_ray=64",
    "TrainConfig.steps=20",
    "TrainConfig.warmup_steps=5",
    "TrainConfig.rays_per_batch=512",
    "BakeConfig.fit_rays=20000",
    "BakeConfig.novel_views=4",
    "BakeConfig.refine_steps=10",
)
QUICK_RESOLUTION = 24
Row = dict[str, Any]


class Trained(NamedTuple):
    """A method's impostor on a scene, and its row of the table."""

    scene: Scene
    impostor: NeuralImpostor | BakedImpostor
    row: Row


def scene_name(data: str) -> str:
    """A scene's folder's own name, of `.` and `..` too."""
    return Path(os.path.abspath(data)).name


def cage_of(data: str, given: Path | None, folder: Path, config: ExperimentConfig, quick: bool) -> Path:
    """Where the cage of all of a scene's methods is: the given file, or one in `folder`, built if need be.

    An envelope, of which NGP-Bounded takes the bounding box; that of a quick run is apart. Raises
    FileNotFoundError for a given file that is not there, ValueError for one that was built otherwise.
    """
    if given is not None:
        if not given.is_file():
            raise FileNotFoundError(f"cage {given} does not exist; without --cage one is built")
        return given
    path = (folder / f"{QUICK_RESOLUTION}" if quick else folder) / "cage.npz"
    envelope = dataclasses.replace(config.cage, shape="envelope")
    if path.exists():
        check_built(path, envelope)
    else:
        train, _ = load_scene(resolve_scene(data), config.data)
        check_masks(train)
        save_tets(path, *cage_from_images(train, envelope), settings_of(envelope))
    return path


def config_of(
    method: str, resolution: int, configs: Sequence[Path], bindings: Sequence[str]
) -> ExperimentConfig:
    """A method's config at an image width, from the caller's files and bindings, with `CURVE_POINTS`."""
    files = [CONFIGS / f"{METHODS[method]}.gin", *configs]
    bindings = [f"DataConfig.resolution={resolution}", *bindings]
    every = max(1, load_config(files, bindings).train.steps // CURVE_POINTS)
    curve = [f"TrainConfig.eval_every={every}", f"TrainConfig.log_every={every}"]
    return load_config(files, [*bindings, *curve])


def train_or_reuse(method: str, config: ExperimentConfig, data: str, cage: Path, workdir: Path) -> Trained:
    """Train a method on a scene, or take what an earlier run left in `workdir`, finished or not.

    Raises ValueError where that had other settings, pictures or another cage.
    """
    scene = prepare(config, data, cage=cage)
    row_file, file = (workdir / name for name in ("row.json", "impostor.npz"))
    # Training knows nothing of these, and what uses the run may have other defaults by then.
    lines = operative_config_text(config).splitlines(keepends=True)
    text = "".join(line for line in lines if not line.startswith(("BakeConfig.", "RetrainConfig.")))
    mesh = scene.impostor.mesh
    pictures = [array for views in (scene.train, scene.test) for array in _content(views)]
    _claim(workdir, text, mesh.vertices, mesh.tets, mesh.center, mesh.scale, *pictures)
    if row_file.exists():
        print(f"{workdir}: trained already")
        return Trained(scene, load_impostor(file), json.loads(row_file.read_text(encoding="utf-8")))
    curve = HeldOutCurve(scene, workdir / "curve.json")
    impostor, progress = fit(scene, workdir=workdir, callback=curve)
    save_impostor(file, impostor)
    behind, pictures = config.data.background, workdir / "pictures"
    result = evaluate(impostor, scene.test, config.render, background=behind, pictures=pictures)
    with open(workdir / "log.csv", newline="", encoding="utf-8") as log:
        seconds = {int(line["step"]): float(line["seconds"]) for line in csv.DictReader(log)}
    row = {
        "method": method,
        "scene": scene_name(data),
        "psnr": result["psnr"],
        "ssim": result["ssim"],
        "lpips": result["lpips"],
        "train_seconds": progress.seconds,
        "fps": 1 / result["seconds_per_frame"],
        "resolution": scene.test.width,
        "tets": len(scene.impostor.mesh.tets),
        "parameters": int(scene.impostor.tables.features.size),
        "steps": progress.step,
        "rays_per_batch": config.train.rays_per_batch,
        "curve": [(seconds[step], value) for step, value in curve.points],
    }
    write_json(row_file, row)
    forget_programs()
    return Trained(scene, impostor, row)


def _content(views: PosedImages) -> list[np.ndarray]:
    pictures = [views.images] if views.backgrounds is None else [views.images, views.backgrounds]
    return [*pictures, views.camera_to_world, views.focal, views.principal]


def _claim(workdir: Path, settings: str, *arrays: Any) -> None:
    """Write down what a folder's run is made from, or raise ValueError where it has been made from other."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).reshape(-1))
    text, path = f"# made from {digest.hexdigest()[:16]}\n{settings}", workdir / "config.gin"
    if not path.exists():
        with atomic_path(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
        return
    there = path.read_text(encoding="utf-8").splitlines()
    changed = [line for line in text.splitlines() if line not in there]
    if changed:
        what = "its cage, pictures or field" if changed[-1].startswith("#") else f"not {changed[-1]}"
        raise ValueError(
            f"{workdir} has a run of other input ({what}); remove that folder, or use another --out"
        )


def bake_or_reuse(trained: Trained, workdir: Path) -> tuple[BakedImpostor, Row]:
    """Bake a method's impostor, or take what an earlier run left in `workdir`; and the row of the table."""
    config = trained.scene.config
    row_file, file = (workdir / name for name in ("row.json", "baked.npz"))
    if not row_file.exists():  # a baking that was refused or cut off has left nothing of its settings
        (workdir / "config.gin").unlink(missing_ok=True)
    _claim(workdir, operative_config_text(config), trained.impostor.tables.features)  # type: ignore[union-attr]
    if row_file.exists():
        print(f"{workdir}: baked already")
        return load_baked(file), json.loads(row_file.read_text(encoding="utf-8"))
    start = time.perf_counter()
    baked = bake(trained.impostor, trained.scene, config.bake)
    seconds = time.perf_counter() - start
    save_impostor(file, baked)
    behind, pictures = config.data.background, workdir / "pictures"
    result = evaluate(baked, trained.scene.test, config.render, background=behind, pictures=pictures)
    camera = camera_of(trained.scene.test, 0)
    sized = frame_config(baked, camera, config.render)
    rasterize_frame(baked, camera, sized)  # compiles
    start = time.perf_counter()
    raster = rasterize_frame(baked, camera, sized)
    fps = 1 / (time.perf_counter() - start)
    difference = np.abs(to_image(raster) - to_image(render_frame(baked, camera, sized))).mean()
    row = {key: value for key, value in trained.row.items() if key != "curve"} | {
        "method": "Baked",
        "psnr": result["psnr"],
        "ssim": result["ssim"],
        "lpips": result["lpips"],
        "bake_seconds": seconds,
        "fps": 1 / result["seconds_per_frame"],
        "raster_fps": fps,
        "raster_difference": float(difference),
        "parameters": sum(
            int(table.features.size) for table in (baked.depths, baked.opacities, baked.textures)
        ),
        "tets": len(baked.mesh.tets),
    }
    write_json(row_file, row)
    forget_programs()
    return baked, row


def forget_programs() -> None:
    """Free what was compiled for a row: it is thousands of memory maps, of which Linux allows 65,530.

    Beyond, compiling ends the process, as that of a ladder's fifth row once did.
    """
    jax.clear_caches()


def seconds_to(curve: Sequence[tuple[float, float]], target: float) -> float | None:
    """Training time after which a curve of (seconds, PSNR) reaches a PSNR for good; None if it does not."""
    before = (0.0, 0.0)
    for i, (seconds, value) in enumerate(curve):
        if all(later >= target for _, later in curve[i:]):
            share = (target - before[1]) / (value - before[1]) if value > before[1] else 1.0
            return before[0] + min(max(share, 0.0), 1.0) * (seconds - before[0])
        before = (seconds, value)
    return None


def write_picture(path: Path, views: PosedImages, folders: Sequence[Path]) -> None:
    """The first held-out view, from the pictures in the runs' folders: truth, then every method."""
    name = picture_name(views, 0)
    panels = [read_image(folder / "pictures" / name)[0][..., :3] for folder in folders]
    truth = panels[0][:, : views.width]
    renders = [panel[:, views.width : 2 * views.width] for panel in panels]
    write_png(path, np.concatenate([truth, *renders], axis=1))


def write_table(out: Path, rows: Sequence[Row], columns: Sequence[str], notes: str) -> None:
    """`out`.json with all of the rows; `out`.csv and `out`.md with the given columns."""
    write_json(out.with_suffix(".json"), {"notes": notes, "rows": list(rows)})
    cells = [[_text(row.get(column)) for column in columns] for row in rows]
    with atomic_path(out.with_suffix(".csv")) as path, open(path, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([columns, *cells])
    lines = [list(columns), ["---"] * len(columns), *cells]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    with atomic_path(out.with_suffix(".md")) as path:
        path.write_text(f"{table}\n\n{notes}\n", encoding="utf-8")
    print(f"\n{table}\n\n{notes}\nwrote {out}.json, .csv, .md")


def _text(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
