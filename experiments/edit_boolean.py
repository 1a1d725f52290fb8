"""Boolean operations on a trained impostor: with another one, or with a pattern.

    python experiments/edit_boolean.py --data=DIR --workdir=out/spot --operation=difference --pattern=sphere
    python experiments/edit_boolean.py ... --operation=union --other=out/mic --color=first --consolidate

Patterns: sphere (a third of the cage's size, at its upper front), a closed surface (.obj, .ply, .stl), or a
picture (.png, dark is inside), extruded through the cage. Writes to --out (default: WORKDIR/boolean)
boolean.json, impostor.npz, before_after.png (before, live and, where asked for, consolidated) and orbit.gif.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from edit_deform import load_run

from nimpostor_jax import metrics
from nimpostor_jax.edit.boolean import difference, intersection, symmetric_difference, union
from nimpostor_jax.edit.remesh import consolidate
from nimpostor_jax.export.video import write_video
from nimpostor_jax.geometry.topology import world_vertices
from nimpostor_jax.gin_flags import add_flags, config_of_runs, run_cli, save_config
from nimpostor_jax.io.blender import load_scene
from nimpostor_jax.io.images import composite, read_image, write_png
from nimpostor_jax.io.impostor_file import save_impostor
from nimpostor_jax.io.scenes import resolve_scene
from nimpostor_jax.pipeline.evaluate import MAX_PSNR, camera_of, composite_frame, orbit, write_json
from nimpostor_jax.pipeline.prepare import use_all_cores
from nimpostor_jax.preprocess.patterns import solid_from_image, solid_from_surface
from nimpostor_jax.render.frame import frame_config, render_frame, to_image
from nimpostor_jax.types import GridSolid, NeuralImpostor

OPERATIONS = ("union", "intersection", "difference", "symmetric_difference")


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", required=True, help="the scene of the run: gives cameras")
    parser.add_argument("--workdir", required=True, type=Path, help="of a training run")
    parser.add_argument("--operation", required=True, choices=OPERATIONS)
    operand = parser.add_mutually_exclusive_group(required=True)
    operand.add_argument("--other", type=Path, help="workdir of another training run")
    operand.add_argument("--pattern", help="sphere, or a file")
    parser.add_argument("--color", choices=("first", "second", "blend"), default="first")
    parser.add_argument("--consolidate", action="store_true", help="also as a plain field, by retraining")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--frames", type=int, default=12, help="of the animation; 0: none")
    add_flags(parser)
    args = parser.parse_args(argv)
    use_all_cores()
    config = config_of_runs([args.workdir] if args.other is None else [args.workdir, args.other], args)
    first = load_run(args.workdir, args.data)
    out = args.out or args.workdir / "boolean"
    train, test = load_scene(resolve_scene(args.data), config.data)
    second = load_run(args.other, "DIR") if args.other is not None else pattern_of(args.pattern, first)
    live = operate(args.operation, first, second, args.color)

    camera = camera_of(test, 0)
    results: dict[str, NeuralImpostor] = {"before": first, "live": live}
    numbers: dict[str, Any] = {"operation": args.operation, "color": args.color}
    if args.consolidate:
        start = time.perf_counter()
        results["consolidated"] = consolidate(live, config.render, config.retrain)
        numbers["consolidate_seconds"] = time.perf_counter() - start
    images, behind = {}, test.background(0, config.data.background)
    for name, impostor in results.items():
        sized = frame_config(impostor, camera, config.render)
        render_frame(impostor, camera, sized)  # compiles
        start = time.perf_counter()
        images[name] = composite_frame(render_frame(impostor, camera, sized), behind)
        numbers[f"seconds_per_frame_{name}"] = time.perf_counter() - start
    if args.consolidate:
        numbers["psnr_consolidated_to_live"] = min(
            metrics.psnr(images["consolidated"], images["live"]), MAX_PSNR
        )
    result = list(results.values())[-1]
    save_impostor(out / "impostor.npz", result)
    save_config(config, out)  # with which other scripts render it
    panel = [composite(test.images[0], behind), *images.values()]
    write_png(out / "before_after.png", np.concatenate(panel, axis=1))
    write_json(out / "boolean.json", numbers)
    if args.frames:
        cameras = orbit(train, args.frames)
        sized = frame_config(result, cameras[0], config.render)
        write_video(out / "orbit.gif", [to_image(render_frame(result, c, sized)) for c in cameras], 10.0)
    print(f"{numbers}\nwrote {out}")


def operate(
    operation: str, first: NeuralImpostor, second: NeuralImpostor | GridSolid, color: str
) -> NeuralImpostor:
    """The live result. Raises ValueError where a pattern stands for what needs a field."""
    if operation == "difference":
        return difference(first, second)
    if operation == "intersection":
        return intersection(first, second, color=color)  # type: ignore[arg-type]
    if not isinstance(second, NeuralImpostor):
        raise ValueError(f"{operation} needs another impostor (--other): a pattern has no field of its own")
    if operation == "union":
        return union(first, second, color=color)  # type: ignore[arg-type]
    return symmetric_difference(first, second)


def pattern_of(name: str, impostor: NeuralImpostor) -> GridSolid:
    """A pattern placed in the impostor's world."""
    vertices = world_vertices(impostor.mesh)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = high - low
    if name == "sphere":
        ball = trimesh.creation.icosphere(subdivisions=4, radius=float(size.max()) / 3)
        return solid_from_surface(ball.apply_translation(low + size * [0.5, 0.1, 0.7]))
    path = Path(name)
    if path.suffix.lower() == ".png":
        image, _ = read_image(path)
        dark = image[..., 3] * (1 - image[..., :3].mean(axis=-1))
        right, depth, up = np.diag(size)
        return solid_from_image(dark, low, right, up, depth)
    return solid_from_surface(path)


if __name__ == "__main__":
    run_cli(main)
