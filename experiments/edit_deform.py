"""Deform a trained impostor and compare it with true pictures of the deformed object, without retraining.

    python experiments/edit_deform.py --data=DIR --workdir=out/spot --deformation=DIR/deformation_bend.json

The deformation moves the cage's vertices (families: twist, bend, stretch, rigid, drag). The true pictures are a
split of the scene: `transforms_test_bend.json` for `deformation_bend.json`, or --split. Writes to --out (default:
the workdir) edit.json, edit/rest and edit/deformed with a picture of each view (truth, ours, error times 4,
depth), and edit.gif, in which the vertices move to their places on straight lines.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nimpostor_jax import metrics
from nimpostor_jax.edit.deform import deform, deformation_report
from nimpostor_jax.export.video import write_video
from nimpostor_jax.gin_flags import add_flags, config_of_run, run_cli
from nimpostor_jax.io.blender import PosedImages, load_blender, load_scene
from nimpostor_jax.io.deformations import load_deformation
from nimpostor_jax.io.images import composite, write_png
from nimpostor_jax.io.impostor_file import load_impostor
from nimpostor_jax.io.scenes import resolve_scene
from nimpostor_jax.pipeline.evaluate import camera_of, evaluate, write_json
from nimpostor_jax.pipeline.prepare import use_all_cores
from nimpostor_jax.pipeline.ray_bending import BentField
from nimpostor_jax.preprocess.topology import world_vertices
from nimpostor_jax.render.frame import frame_config, render_frame, to_image
from nimpostor_jax.types import NeuralImpostor

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
    parser.add_argument("--ray_bending", type=Path, help="workdir of a Cartesian field: the KNN baseline's row")
    parser.add_argument("--ray_bending_views", type=int, default=1, help="it takes minutes a view")
    parser.add_argument("--quick", action="store_true", help="small and short, to try the script")
    add_flags(parser)
    args = parser.parse_args(argv)
    use_all_cores()
    if args.quick:
        vars(args).update(QUICK)
    for name in ("views", "frames", "ray_bending_views"):
        if getattr(args, name) is not None and getattr(args, name) < 1:
            raise ValueError(f"--{name} must be >= 1, got {getattr(args, name)}")
    if args.resolution is not None:
        args.gin_bindings = [*args.gin_bindings, f"DataConfig.resolution={args.resolution}"]
    config = config_of_run(args.workdir, args)
    impostor = load_run(args.workdir, args.data)
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
    print(f"{report.num_inverted} of {report.num_tets} tets inverted, smallest volume {report.smallest_volume:.3g}")
    start = time.perf_counter()
    shared = {"background": config.data.background}
    at_rest = evaluate(impostor, rest, config.render, pictures=out / "edit" / "rest", **shared)
    deformed = evaluate(moved, truth, config.render, pictures=out / "edit" / "deformed", **shared)
    result: dict[str, Any] = {
        "psnr_rest": at_rest["psnr"],
        "psnr_deformed": deformed["psnr"],
        "ssim_rest": at_rest["ssim"],
        "ssim_deformed": deformed["ssim"],
        "psnr_unmoved": unmoved(impostor, truth, config),
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
    if cartesian is not None:
        views = spread(truth, args.ray_bending_views)
        result["ray_bending"] = ray_bending(cartesian, impostor, moved, views, out / "edit", config)
    write_json(out / "edit.json", result)
    animate(impostor, moved, rest, args.frames, out / "edit.gif", config)
    print(
        f"PSNR {result['psnr_rest']:.2f} dB at rest, {result['psnr_deformed']:.2f} dB deformed (left as it was: "
        f"{result['psnr_unmoved']:.2f} dB); wrote {out}/edit.json, edit.gif and edit/*/*.png"
    )


def load_run(workdir: Path, data: str) -> NeuralImpostor:
    """A trained impostor; an error with the command that makes one."""
    path = workdir / "impostor.npz"
    if not path.exists():
        raise FileNotFoundError(
            f"{path} does not exist; train first: python experiments/train.py --data={data} --workdir={workdir}"
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


def unmoved(impostor: NeuralImpostor, truth: PosedImages, config: Any) -> float:
    """PSNR of the object at rest to the deformed truth: what doing nothing would score."""
    sized = frame_config(impostor, camera_of(truth, 0), config.render)
    background = 1.0 if config.data.background == "white" else 0.0
    values = [
        metrics.psnr(
            to_image(render_frame(impostor, camera_of(truth, i), sized), background),
            composite(truth.images[i], config.data.background),
        )
        for i in range(len(truth))
    ]
    return float(np.mean(values))


def ray_bending(
    cartesian: NeuralImpostor,
    impostor: NeuralImpostor,
    moved: NeuralImpostor,
    views: PosedImages,
    folder: Path,
    config: Any,
) -> dict[str, Any]:
    """The baseline's row: rays bent by the same cage through a field of Cartesian coordinates."""
    cages = world_vertices(impostor.mesh), world_vertices(moved.mesh)
    bent = BentField(cartesian, *cages, np.asarray(impostor.mesh.tets))
    background = 1.0 if config.data.background == "white" else 0.0
    start, rows = time.perf_counter(), []
    for i, name in enumerate(views.names):
        color, opacity = bent.render(camera_of(views, i))
        image = (color + background * (1 - opacity)[:, None]).reshape(views.height, views.width, 3)
        true = composite(views.images[i], config.data.background)
        rows.append({"view": name, "psnr": metrics.psnr(image, true), "ssim": metrics.ssim(image, true)})
        panel = [true, image, np.clip(4 * np.abs(true - image), 0, 1)]
        write_png(folder / "ray_bending" / f"{Path(name).stem}.png", np.concatenate(panel, axis=1))
    mean = {f"{key}_deformed": float(np.mean([row[key] for row in rows])) for key in ("psnr", "ssim")}
    return mean | {"views": len(views), "seconds": time.perf_counter() - start, "per_view": rows}


def animate(
    impostor: NeuralImpostor, moved: NeuralImpostor, views: PosedImages, count: int, path: Path, config: Any
) -> None:
    """The first view while the vertices move to their places on straight lines."""
    cages = world_vertices(impostor.mesh), world_vertices(moved.mesh)
    camera = camera_of(views, 0)
    # The buffers of the widest of the frames: the camera and the cage's ends decide them.
    sized = frame_config(moved, camera, config.render)
    frames = []
    for share in np.linspace(0, 1, count):
        between = (1 - share) * cages[0] + share * cages[1]
        frame = render_frame(deform(impostor, lambda _, between=between: between), camera, sized)
        frames.append(to_image(frame, 1.0 if config.data.background == "white" else 0.0))
    write_video(path, np.stack(frames), 12.0)


if __name__ == "__main__":
    run_cli(main)
