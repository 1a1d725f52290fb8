"""Run time of a frame against its error, for every setting that trades one for the other.

    python experiments/pareto.py --data=DIR --workdir=out/mic --out=out/pareto

On a trained impostor, at the resolution of its data. The error is that to a converged float64 quadrature of
the same field (an eighth of the default steps, nothing visible left out); `share_within` is that of pixels
within the tolerance of it (without cells that training never saw), or 1/255 where none was given; the PSNR is
that to the held-out images. `--also` adds other runs on the same data (another interpolation, layout or
number of levels), each against its own integral. Writes `pareto.csv`, `pareto.json` and `pareto.png`.
Settings take turns in random order, so that a slow minute hits all of them; times are medians without
compilation.
"""

import argparse
import csv
import dataclasses
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from tqdm import tqdm

from nimpostor_jax.config import RenderConfig
from nimpostor_jax.gin_flags import add_flags, config_of_run, load_config, run_cli
from nimpostor_jax.io.atomic import atomic_path
from nimpostor_jax.io.blender import load_scene
from nimpostor_jax.io.images import composite
from nimpostor_jax.io.impostor_file import load_impostor
from nimpostor_jax.io.scenes import resolve_scene
from nimpostor_jax.metrics import psnr
from nimpostor_jax.pipeline.evaluate import camera_of, composite_frame, write_json
from nimpostor_jax.pipeline.prepare import use_all_cores
from nimpostor_jax.render.frame import Frame, frame_config, on_all_devices, render_frame
from nimpostor_jax.render.sampling import known_step, with_step
from nimpostor_jax.types import Camera, NeuralImpostor

matplotlib.use("Agg")
from matplotlib import pyplot as plt

Row = dict[str, Any]

REFERENCE_REFINEMENT = 8  # of the default frame's steps
REFERENCE_SAMPLES = 1 << 14
REFERENCE_WEIGHT = 1e-8  # thousands of samples of less are a small part of an 8-bit step


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", required=True, help="a nerf-synthetic folder, or a built-in scene")
    parser.add_argument("--workdir", required=True, type=Path, help="of a training run")
    parser.add_argument("--out", type=Path, default=Path("out/pareto"), help="folder")
    parser.add_argument("--views", type=int, default=3, help="held-out views, spread over all")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--only", action="append", help="lever to vary (repeatable); default: all")
    parser.add_argument(
        "--also", type=Path, action="append", default=[], help="another run to compare (repeatable)"
    )
    add_flags(parser)
    args = parser.parse_args(argv)
    if args.views < 1 or args.repeats < 1:
        raise ValueError("--views and --repeats must be >= 1")
    use_all_cores()
    config, impostor = config_of_run(args.workdir, args), load_impostor(args.workdir / "impostor.npz")
    render = with_step(config.render, impostor.config.encoding)
    settings = levers(render)
    unknown = set(args.only or []) - {s[0] for s in settings}
    if unknown:
        raise ValueError(f"--only: no lever {min(unknown)!r}; there are {sorted({s[0] for s in settings})}")
    settings = [s for s in settings if not args.only or s[0] in [*args.only, "default"]]
    impostors = {"tables": with_tables(impostor, jnp.bfloat16)}
    for folder in args.also:  # each as it was trained to be rendered
        if f"run {folder}" in impostors:
            raise ValueError(f"--also {folder} is given twice")
        impostors[f"run {folder}"] = other = load_impostor(folder / "impostor.npz")
        own = with_step(load_config([folder / "config.gin"]).render, other.config.encoding)
        settings.append((f"run {folder}", "", own))
    impostor, impostors = on_all_devices((impostor, impostors))
    args.out.mkdir(parents=True, exist_ok=True)
    _, test = load_scene(resolve_scene(args.data), config.data)
    views = np.linspace(0, len(test.images) - 1, min(args.views, len(test.images))).round().astype(int)
    cameras = [camera_of(test, view) for view in views]
    behind = [test.background(view, config.data.background) for view in views]
    truths = [composite(test.images[v], b) for v, b in zip(views, behind, strict=True)]

    def pictures(render_one: Callable[[Camera], Frame]) -> list[np.ndarray]:
        return [composite_frame(render_one(c), b) for c, b in zip(cameras, behind, strict=True)]

    def reference(impostor: NeuralImpostor, render: RenderConfig) -> list[np.ndarray]:
        return pictures(lambda camera: reference_frame(impostor, camera, render))

    references = reference(impostor, dataclasses.replace(render, skip_empty=False))
    # What a tolerance bounds is the error of integration: of the field without what training never saw.
    seen = reference(impostor, render) if any(s[0] == "tolerance" for s in settings) else references
    rows = []
    for lever, value, render in settings:
        shown = impostors.get(lever, impostor)
        own_render, render = render, frame_config(shown, cameras[0], render)
        tolerance = value if lever == "tolerance" else None
        images = pictures(partial(render_frame, shown, config=render, tolerance=tolerance))
        exact = seen if lever == "tolerance" else references
        if lever.startswith("run "):
            exact = reference(shown, dataclasses.replace(own_render, skip_empty=False))
        error = np.abs(np.array(images) - np.array(exact))
        rows.append(
            {
                "lever": lever,
                "value": value,
                "ms": [],
                "max_error": float(error.max()),
                "mean_error": float(error.mean()),
                "psnr_to_reference": mean_psnr(images, exact),
                "psnr": mean_psnr(images, truths),
                "share_within": float(np.mean(error.max(axis=-1) <= (tolerance or 1 / 255))),
                "render": (shown, render, tolerance),
            }
        )
        print(f"{lever} {value}: mean error {rows[-1]['mean_error']:.6f}", flush=True)
    order = np.random.default_rng(0)  # what a setting leaves in caches and buffers hits another one each time
    for _ in tqdm(range(args.repeats), desc="timing", disable=None):
        for row in order.permutation(np.array(rows, object)):
            start = time.perf_counter()
            shown, render, tolerance = row["render"]
            for camera in cameras:
                render_frame(shown, camera, render, tolerance)
            row["ms"].append(1e3 * (time.perf_counter() - start) / len(cameras))
    for row in rows:
        row["ms"] = float(np.median(row["ms"]))
        del row["render"]
    mark_front(rows)
    write_table(args.out / "pareto.csv", rows)
    size = f"{cameras[0].width} x {cameras[0].height}"
    about = {
        "scene": str(args.data),
        "size": size,
        "views": views.tolist(),
        "device": jax.devices()[0].device_kind,
        "reference_psnr": mean_psnr(references, truths),  # no quadrature does better, but for chance
    }
    write_json(args.out / "pareto.json", about | {"rows": rows})
    plot(args.out / "pareto.png", rows, f"{Path(args.data).name}, {size}")
    for row in rows:
        print(
            f"{'*' if row['front'] else ' '} {row['lever']:12s} {row['value']!s:12s} {row['ms']:8.0f} ms  "
            f"error max {row['max_error']:.4f} mean {row['mean_error']:.6f} within {row['share_within']:.3%} "
            f"({row['psnr_to_reference']:.2f} dB)  PSNR {row['psnr']:.2f} dB"
        )
    print(f"converged quadrature: PSNR {about['reference_psnr']:.2f} dB; wrote {args.out}")


def levers(base: RenderConfig) -> list[tuple[str, Any, RenderConfig]]:
    """(lever, value, config): the given config, and it with one field changed at a time."""

    def sampler(**changes: Any) -> RenderConfig:
        changed = dataclasses.replace(base.sampler, **changes)
        return dataclasses.replace(base, sampler=changed, frame_refinement=1.0)

    default = base.sampler.step / base.frame_refinement
    settings: list[tuple[str, Any, RenderConfig]] = [("default", default, base)]
    many = {"max_samples_per_ray": 1024}  # no ray is coarsened
    for step in (1 / 2, 1 / 4, 1 / 8, 1 / 12, 1 / 16):
        settings.append(("step", step, sampler(step=step, **many)))
    for refinement in sorted({1.0, 1.25, 1.5} - {base.frame_refinement}):
        settings.append(("refinement", refinement, dataclasses.replace(base, frame_refinement=refinement)))
    for steps in (2, 4, 8):
        settings.append(("alpha", 1 / steps, sampler(measure="alpha", step=1 / steps, **many)))
    for step in (0.05, 0.025, 0.0125):
        settings.append(("euclidean", step, sampler(measure="euclidean", step=step, **many)))
    for angle in (0.03, 0.1):
        settings.append(("cone_angle", angle, sampler(cone_angle=angle)))
    for most in (32, 64):
        settings.append(("max_samples", most, sampler(max_samples_per_ray=most)))
    for weight in sorted({0.0, 1e-4, 1e-3, 1e-2} - {base.min_weight}):  # 0: in one pass
        settings.append(("min_weight", weight, dataclasses.replace(base, min_weight=weight)))
    settings.append(("skips", "not empty", dataclasses.replace(base, skip_empty=False)))
    settings.append(("skips", "all sorted", dataclasses.replace(base, skip_sorting=False)))
    none = dataclasses.replace(base, skip_empty=False, skip_sorting=False, min_weight=0.0)
    settings.append(("skips", "none", none))
    settings.append(("tables", "bfloat16", base))
    for tolerance in (4 / 255, 1 / 255):
        settings.append(("tolerance", tolerance, base))
    return settings


def with_tables(impostor: NeuralImpostor, dtype: Any) -> NeuralImpostor:
    """The impostor with its tables' features in another precision."""
    tables = dataclasses.replace(impostor.tables, features=impostor.tables.features.astype(dtype))
    return dataclasses.replace(impostor, tables=tables)


def reference_frame(impostor: NeuralImpostor, camera: Camera, render: RenderConfig) -> Frame:
    """The field's integral, converged, in float64. Raises ValueError where rays need more samples."""
    step = known_step(render.sampler) / render.frame_refinement / REFERENCE_REFINEMENT
    sampler = dataclasses.replace(
        render.sampler, step=step, cone_angle=0.0, capacity_per_ray=None,
        max_samples_per_ray=REFERENCE_SAMPLES,
    )  # fmt: skip
    exact = dataclasses.replace(
        render, sampler=sampler, min_weight=REFERENCE_WEIGHT, frame_refinement=1.0
    )
    with jax.enable_x64(True):
        impostor, camera = jax.tree.map(
            lambda x: x.astype("float64") if x.dtype == "float32" else x, (impostor, camera)
        )
        frame = render_frame(impostor, camera, frame_config(impostor, camera, exact))
    if frame.coarsened.any():
        raise ValueError(f"a reference needs more than {REFERENCE_SAMPLES} samples on a ray of this cage")
    return frame


def mean_psnr(images: Sequence[np.ndarray], others: Sequence[np.ndarray]) -> float:
    """Mean over views, dB."""
    return float(np.mean([psnr(a, b) for a, b in zip(images, others, strict=True)]))


def mark_front(rows: list[Row]) -> None:
    """Sets `front`: no other row is at most as slow and at most as wrong, and better in one of the two."""
    for row in rows:
        mine = (row["ms"], row["mean_error"])
        others = [(other["ms"], other["mean_error"]) for other in rows]
        row["front"] = not any(o[0] <= mine[0] and o[1] <= mine[1] and o != mine for o in others)


def write_table(path: Path, rows: list[Row]) -> None:
    """CSV, one line a setting."""
    with atomic_path(path) as partial, open(partial, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


def plot(path: Path, rows: list[Row], title: str) -> None:
    """Time against mean error, a colour a lever; the front is joined."""
    figure, axes = plt.subplots(figsize=(9, 6))
    for lever in dict.fromkeys(row["lever"] for row in rows):
        points = [row for row in rows if row["lever"] == lever]
        axes.plot([p["ms"] for p in points], [p["mean_error"] for p in points], "o", label=lever)
        for point in points:
            value = point["value"]
            text = value if isinstance(value, str) else f"{value:.3g}"
            axes.annotate(text, (point["ms"], point["mean_error"]), fontsize=7)
    front = sorted((row["ms"], row["mean_error"]) for row in rows if row["front"])
    axes.plot(*zip(*front, strict=True), color="0.6", zorder=0)
    axes.set(xscale="log", yscale="log", xlabel="ms a frame", title=title)
    axes.set_ylabel("mean error to the converged integral")
    axes.legend()
    with atomic_path(path) as partial:
        figure.savefig(partial, dpi=120, bbox_inches="tight", format="png")
    plt.close(figure)


if __name__ == "__main__":
    run_cli(main)
