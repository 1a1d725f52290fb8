"""Deform a trained impostor and compare it with true pictures of the deformed object, without retraining.

    python experiments/edit_deform.py --data=DIR --workdir=out/spot --deformation=DIR/deformation_bend.json

The deformation moves the cage's vertices (families: twist, bend, stretch, rigid, drag). The true pictures are
a split of the scene: `transforms_test_bend.json` for `deformation_bend.json`, or --split. Writes to --out
(default: the workdir) edit.json, edit/rest and edit/deformed with a picture of each view (truth, ours, error
times 4, depth), and edit.gif, in which the vertices move to their places on straight lines.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from nimpostor_jax import metrics
from nimpostor_jax.config import ExperimentConfig
from nimpostor_jax.edit.cage_fit import fit_cage, make_handles
from nimpostor_jax.edit.deform import SpaceMap, deform, deformation_report
from nimpostor_jax.edit.subdivide import subdivide
from nimpostor_jax.export.video import write_video
from nimpostor_jax.geometry.topology import world_vertices
from nimpostor_jax.gin_flags import add_flags, config_of_run, run_cli
from nimpostor_jax.io.blender import PosedImages, load_blender, load_scene
from nimpostor_jax.io.deformations import load_deformation
from nimpostor_jax.io.images import composite, write_png
from nimpostor_jax.io.impostor_file import load_impostor
from nimpostor_jax.io.scenes import resolve_scene
from nimpostor_jax.pipeline.evaluate import camera_of, composite_frame, evaluate, picture_name, write_json
from nimpostor_jax.pipeline.prepare import use_all_cores
from nimpostor_jax.pipeline.ray_bending import BentField
from nimpostor_jax.render.frame import frame_config, render_frame, to_image
from nimpostor_jax.types import Camera, NeuralImpostor

QUICK = {"resolution": 24, "views": 2, "frames": 3}


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", required=True, help="the scene with a split of the deformed object")
    parser.add_argument("--workdir", required=True, type=Path, help="of a training run at rest")
    parser.add_argument("--deformation", required=True, type=Path, help='JSON: {"name": "bend", "c": 0.5}')
    parser.add_argument("--split", help="true pictures; default: test_NAME for deformation_NAME.json")
    parser.add_argument("--out", type=Path, help="where everything is written; default: the workdir")
    parser.add_argument("--resolution", type=int, help="image width; default: the run's")
    parser.add_argument("--views", type=int, help="how many of the views, spread evenly; default: all")
    parser.add_argument("--frames", type=int, default=24, help="of the animation")
    parser.add_argument("--handles", type=int, help="also: move only so many vertices, the others follow")
    parser.add_argument("--subdivide", type=int, help="also: cut the cage into eight, up to so many times")
    parser.add_argument("--ray_bending", type=Path, help="workdir of a Cartesian field: the baseline's row")
    parser.add_argument("--ray_bending_views", type=int, default=1, help="it takes minutes a view")
    parser.add_argument("--quick", action="store_true", help="small and short, to try the script")
    add_flags(parser)
    args = parser.parse_args(argv)
    use_all_cores()
    if args.quick:
        vars(args).update(QUICK)
    for name in ("views", "frames", "handles", "subdivide", "ray_bending_views"):
        if getattr(args, name) is not None and getattr(args, name) < 1:
            raise ValueError(f"--{name} must be >= 1, got {getattr(args, name)}")
    if args.resolution is not None:
        args.gin_bindings = [*args.gin_bindings, f"DataConfig.resolution={args.resolution}"]
    impostor = load_run(args.workdir, args.data)
    config = config_of_run(args.workdir, args)
    cartesian = None if args.ray_bending is None else load_run(args.ray_bending, args.data)
    space_map = load_deformation(args.deformation)
    folder = resolve_scene(args.data)
    split = args.split or split_of(args.deformation, folder)
    truth = spread(load_blender(folder, split, config.data.resolution), args.views)
    _, rest = load_scene(folder, config.data)
    rest = spread(rest, args.views)
    out = args.out or args.workdir

    moved = deform(impostor, space_map)
    report = deformation_report(moved)
    print(f"{report.num_inverted} of {report.num_tets} tets inverted, smallest {report.smallest_volume:.3g}")
    start = time.perf_counter()
    shared = {"background": config.data.background}
    at_rest = evaluate(impostor, rest, config.render, pictures=out / "edit" / "rest", **shared)
    deformed = evaluate(moved, truth, config.render, pictures=out / "edit" / "deformed", **shared)
    unmoved_psnr = unmoved(impostor, truth, config)
    result: dict[str, Any] = {
        "psnr_rest": at_rest["psnr"],
        "psnr_deformed": deformed["psnr"],
        "ssim_rest": at_rest["ssim"],
        "ssim_deformed": deformed["ssim"],
        "psnr_unmoved": float(np.mean(unmoved_psnr)),
        "scene": folder.name,
        "split": split,
        "deformation": args.deformation.name,
        "views": len(truth),
        "resolution": truth.width,
        "tets": report.num_tets,
        "inverted_tets": report.num_inverted,
        "smallest_volume": report.smallest_volume,
        "seconds_per_frame": deformed["seconds_per_frame"],
        "seconds": time.perf_counter() - start,
        "per_view": deformed["per_view"],
    }
    if args.handles is not None:
        fitted, result["handles"] = by_handles(impostor, moved, args.handles)
        print(f"{args.handles} handles: {result['handles']}")
        scores = evaluate(fitted, truth, config.render, pictures=out / "edit" / "handles", **shared)
        result["handles"] |= {f"{key}_deformed": scores[key] for key in ("psnr", "ssim")}
    if args.subdivide is not None:
        result["finer_cages"] = finer_cages(impostor, space_map, truth, args.subdivide, config)
    if cartesian is not None:
        views = spread(truth, args.ray_bending_views)
        result["ray_bending"] = ray_bending(cartesian, impostor, moved, views, out / "edit", config)
    write_json(out / "edit.json", result)
    camera = camera_of(truth, int(np.argmin(unmoved_psnr)))  # that sees most of the deformation
    animate(impostor, moved, camera, args.frames, out / "edit.gif", config)
    print(
        f"PSNR {result['psnr_rest']:.2f} dB at rest, {result['psnr_deformed']:.2f} dB deformed (left as it "
        f"was: {result['psnr_unmoved']:.2f} dB); wrote {out}/edit.json, edit.gif and edit/*/*.png"
    )


def load_run(workdir: Path, data: str) -> NeuralImpostor:
    """A trained impostor; an error with the command that makes one."""
    path = workdir / "impostor.npz"
    if not path.exists():
        raise FileNotFoundError(
            f"{path} does not exist; train first: "
            f"python experiments/train.py --data={data} --workdir={workdir}"
        )
    return load_impostor(path)


def split_of(deformation: Path, folder: Path) -> str:
    """The split whose name belongs to a deformation file: test_bend for deformation_bend.json."""
    split = f"test_{deformation.stem.removeprefix('deformation_')}"
    if not (folder / f"transforms_{split}.json").is_file():
        found = sorted(p.stem.removeprefix("transforms_") for p in folder.glob("transforms_*.json"))
        raise FileNotFoundError(
            f"{folder} has no split {split!r} for {deformation.name}; give --split, of: {', '.join(found)}"
        )
    return split


def spread(views: PosedImages, count: int | None) -> PosedImages:
    """That many views, evenly spread."""
    if count is None or count >= len(views):
        return views
    return views.select(np.linspace(0, len(views) - 1, count).astype(int))


def unmoved(impostor: NeuralImpostor, truth: PosedImages, config: ExperimentConfig) -> list[float]:
    """PSNR of the object at rest to the deformed truth, by view: what doing nothing would score."""
    pairs = zip(pictures_of(impostor, truth, config), truth_of(truth, config), strict=True)
    return [metrics.psnr(*pair) for pair in pairs]


def pictures_of(
    impostor: NeuralImpostor, views: PosedImages, config: ExperimentConfig
) -> list[np.ndarray]:
    """What the impostor shows in each view, over its own background or the config's."""
    sized = frame_config(impostor, camera_of(views, 0), config.render)
    behind = (views.background(i, config.data.background) for i in range(len(views)))
    frames = (render_frame(impostor, camera_of(views, i), sized) for i in range(len(views)))
    return [composite_frame(*pair) for pair in zip(frames, behind, strict=True)]


def truth_of(views: PosedImages, config: ExperimentConfig) -> list[np.ndarray]:
    """The views' pictures over their own backgrounds or the config's."""
    behind = (views.background(i, config.data.background) for i in range(len(views)))
    return [composite(*pair) for pair in zip(views.images, behind, strict=True)]


def finer_cages(
    impostor: NeuralImpostor,
    space_map: SpaceMap,
    truth: PosedImages,
    times: int,
    config: ExperimentConfig,
) -> list[dict[str, Any]]:
    """The same field moved by finer and finer cages: PSNR to the truth, and to what the finest shows."""
    rows, pictures = [], []
    for n in range(times + 1):
        moved = deform(subdivide(impostor, n), space_map)
        pictures.append(pictures_of(moved, truth, config))
        pairs = zip(pictures[-1], truth_of(truth, config), strict=True)
        scores = [metrics.psnr(*pair) for pair in pairs]
        report = deformation_report(moved)
        rows.append({"tets": report.num_tets, "inverted_tets": report.num_inverted})
        rows[-1]["psnr_deformed"] = np.mean(scores)
        print(f"{report.num_tets} tets: {np.mean(scores):.2f} dB deformed")
    for row, images in zip(rows[:-1], pictures[:-1], strict=True):
        pairs = zip(images, pictures[-1], strict=True)
        row["psnr_to_finest"] = np.mean([metrics.psnr(*pair) for pair in pairs])
    return [{name: float(value) for name, value in row.items()} for row in rows]


def by_handles(
    impostor: NeuralImpostor, moved: NeuralImpostor, count: int
) -> tuple[NeuralImpostor, dict[str, Any]]:
    """The cage with some vertices, far from each other, moved to their places; how far the others are."""
    rest, goal = world_vertices(impostor.mesh), world_vertices(moved.mesh)
    chosen = [int(np.argmax(np.linalg.norm(rest - rest.mean(axis=0), axis=1)))]
    while len(chosen) < min(count, len(rest)):
        nearest = np.linalg.norm(rest[:, None] - rest[chosen], axis=-1).min(axis=1)
        chosen.append(int(np.argmax(nearest)))
    handles = make_handles(impostor.mesh, vertices=chosen)
    seconds = []
    for _ in range(2):  # the first one compiles
        start = time.perf_counter()
        fitted, status = fit_cage(impostor, handles, goal[chosen])
        status = jax.block_until_ready(status)
        seconds.append(time.perf_counter() - start)
    distances = np.linalg.norm(world_vertices(fitted.mesh) - goal, axis=1)
    return fitted, {
        "count": len(chosen),
        "converged": bool(status.converged),
        "steps": int(status.num_steps),
        "residual": float(status.residual),
        "inverted_tets": int(status.num_inverted),
        "rms_distance": float(np.sqrt(np.mean(distances**2))),
        "compile_seconds": seconds[0] - seconds[1],
        "fit_seconds": seconds[1],
    }


def ray_bending(
    cartesian: NeuralImpostor,
    impostor: NeuralImpostor,
    moved: NeuralImpostor,
    views: PosedImages,
    folder: Path,
    config: ExperimentConfig,
) -> dict[str, Any]:
    """The baseline's row: rays bent by the same cage through a field of Cartesian coordinates."""
    cages = world_vertices(impostor.mesh), world_vertices(moved.mesh)
    bent = BentField(cartesian, *cages, np.asarray(impostor.mesh.tets))
    start, rows = time.perf_counter(), []
    for i, (name, true) in enumerate(zip(views.names, truth_of(views, config), strict=True)):
        color, opacity = bent.render(camera_of(views, i))
        seen = np.column_stack([color, opacity]).reshape(views.height, views.width, 4)
        image = composite(seen, views.background(i, config.data.background))
        rows.append({"view": name, "psnr": metrics.psnr(image, true), "ssim": metrics.ssim(image, true)})
        panel = [true, image, np.clip(4 * np.abs(true - image), 0, 1)]
        write_png(folder / "ray_bending" / picture_name(views, i), np.concatenate(panel, axis=1))
    mean = {f"{key}_deformed": float(np.mean([row[key] for row in rows])) for key in ("psnr", "ssim")}
    return mean | {"views": len(views), "seconds": time.perf_counter() - start, "per_view": rows}


def animate(
    impostor: NeuralImpostor,
    moved: NeuralImpostor,
    camera: Camera,
    count: int,
    path: Path,
    config: ExperimentConfig,
) -> None:
    """One view while the vertices move to their places on straight lines."""
    cages = world_vertices(impostor.mesh), world_vertices(moved.mesh)
    sized = frame_config(moved, camera, config.render)
    frames = []
    for share in np.linspace(0, 1, count):
        between = (1 - share) * cages[0] + share * cages[1]
        frame = render_frame(deform(impostor, lambda _, between=between: between), camera, sized)
        frames.append(to_image(frame, 1.0 if config.data.background == "white" else 0.0))
    write_video(path, np.stack(frames), 12.0)


if __name__ == "__main__":
    run_cli(main)
