"""What a frame costs as more and more overlapping objects are composed.

    python experiments/compose_cost.py --workdir=out/ball --out=out/compose_cost.json

Copies of a trained impostor, turned and moved by fractions of their size so that they overlap, seen by one
camera. Writes for each number of objects the segments that the frame's rays cross, samples, visible samples,
and the median time of a frame, all numbers in turns; and the exponents of time against segments and objects.
"""

import argparse
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import jax
import numpy as np
from edit_compose import around
from edit_deform import load_run
from scipy.spatial.transform import Rotation

from nimpostor_jax.config import RenderConfig
from nimpostor_jax.edit.compose import compose
from nimpostor_jax.geometry.topology import world_vertices
from nimpostor_jax.gin_flags import add_flags, config_of_runs, run_cli
from nimpostor_jax.pipeline.evaluate import write_json
from nimpostor_jax.pipeline.prepare import use_all_cores
from nimpostor_jax.render.camera import image_pixels, pixel_rays, to_local
from nimpostor_jax.render.frame import frame_config, on_all_devices, render_frame
from nimpostor_jax.render.renderer import render_samples
from nimpostor_jax.render.segments import march_segments
from nimpostor_jax.types import NeuralImpostor, Rays

COUNTS = (1, 2, 4, 7, 10)
OFFSET = 0.3  # of the object's size
PROBE_RAYS = 8192


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--workdir", required=True, type=Path, help="of a training run")
    parser.add_argument("--out", type=Path, default=Path("out/compose_cost.json"))
    parser.add_argument("--size", type=int, default=200, help="image width and height")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS, help="of objects, ascending")
    add_flags(parser)
    args = parser.parse_args(argv)
    use_all_cores()
    impostor, config = load_run(args.workdir, "DIR"), config_of_runs([args.workdir], args)
    transforms = scattered(impostor, max(args.counts))
    camera = around(compose([impostor] * len(transforms), transforms), args.size, 1)[0]
    grid = image_pixels(args.size, args.size).reshape(-1, 2)
    chosen = np.linspace(0, len(grid) - 1, min(PROBE_RAYS, len(grid))).astype(int)
    rays = pixel_rays(camera, grid[chosen])
    rows, frames = [], []
    for count in args.counts:
        whole = on_all_devices(compose([impostor] * count, transforms[:count]))
        sized = frame_config(whole, camera, config.render)
        segments, visible = (int(n) for n in counted(whole, rays, config=sized))
        rows.append({"objects": count, "segments": segments, "visible_samples": visible, "rays": len(chosen)})
        frames.append(partial(render_frame, whole, camera, sized))
        frames[-1]()  # compiles
        print(rows[-1], flush=True)
    seconds: list[list[float]] = [[] for _ in frames]
    for _ in range(args.repeats):
        for times, frame in zip(seconds, frames, strict=True):
            start = time.perf_counter()
            frame()
            times.append(time.perf_counter() - start)
    for row, times in zip(rows, seconds, strict=True):
        row["seconds_per_frame"] = float(np.median(times))
        print(row)
    exponents = {name: slope(rows, name) for name in ("segments", "objects")} if len(rows) > 1 else {}
    write_json(args.out, {"rows": rows, "exponents": exponents})
    print(f"time grows like {exponents}; wrote {args.out}")


def scattered(impostor: NeuralImpostor, count: int) -> list[np.ndarray]:
    """Places about the first, turned at random, that overlap with others."""
    rng = np.random.default_rng(0)
    vertices = world_vertices(impostor.mesh)
    center, size = vertices.mean(axis=0), np.ptp(vertices, axis=0).max()
    matrices = []
    for turn in Rotation.random(count, random_state=0).as_matrix():
        matrix = np.eye(4)
        matrix[:3, :3] = turn
        matrix[:3, 3] = center - turn @ center + OFFSET * size * rng.normal(size=3)
        matrices.append(matrix)
    return matrices


@partial(jax.jit, static_argnames="config")
def counted(impostor: NeuralImpostor, rays: Rays, config: RenderConfig) -> tuple[jax.Array, jax.Array]:
    """Segments that the rays cross, and samples that are seen."""
    segments = march_segments(impostor.mesh, to_local(impostor.mesh, rays), config)
    _, samples = render_samples(impostor, rays, config)
    return (segments.tet_ids >= 0).sum(), samples.num_used


def slope(rows: list[dict], name: str) -> float:
    """The exponent of time against a column, by least squares of the logarithms."""
    values = np.log([[row[name], row["seconds_per_frame"]] for row in rows])
    return float(np.polyfit(values[:, 0], values[:, 1], 1)[0])


if __name__ == "__main__":
    run_cli(main)
