"""How time and memory grow with the cage and with the image, and the exponents of both.

    python experiments/scaling.py --out=scaling.json
    python experiments/scaling.py --max_tets=30000 --max_size=400

Cages are cubes of n³ cells of six tets, their inner vertices jittered. `cage` rows march one image through
growing cages: camera rays, tile by tile, and as many rays without any order, as in a training batch.
`image` rows march growing images through one cage, in chunks as frames are; `call` rows march one image with
more and more rays a call. Each row runs in a process of its own, for its peak memory. An exponent e means
that the time per ray grows like tets^e, or the time like pixels^e; cages below 300 tets, and images below
200², where fixed costs show, are left out of the fits.
"""

import argparse
import multiprocessing
import resource
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from stress_meshes import kuhn_grid, unit
from tqdm import tqdm

from nimpostor_jax.config import MarchConfig
from nimpostor_jax.geometry.topology import build_tet_mesh
from nimpostor_jax.gin_flags import run_cli
from nimpostor_jax.pipeline.evaluate import write_json
from nimpostor_jax.render.camera import image_pixels, pixel_rays, tile_order
from nimpostor_jax.render.traverse import march_tables, traverse
from nimpostor_jax.types import Camera, Rays

Row = dict[str, Any]

CELLS = (1, 2, 4, 8, 17, 32, 55)  # on the cube's side: 6 to 998,250 tets
SIZES = (100, 200, 400, 800, 1600)
CHUNK = 8192  # rays a call, as in render_frame
CAGE_IMAGE = 256  # pixels on the side of the image that growing cages are seen in
IMAGE_CELLS = 8  # of the cage that growing images are made of
CALLS = tuple(1 << n for n in range(12, 21, 2))  # rays


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/scaling.json"))
    parser.add_argument("--max_tets", type=int, default=1_000_000)
    parser.add_argument("--max_size", type=int, default=1600, help="pixels on the image's side")
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args(argv)
    jobs = [
        (sweep, cells, min(CAGE_IMAGE, args.max_size), CHUNK, args.repeats)
        for cells in CELLS
        if 6 * cells**3 <= args.max_tets
        for sweep in ("cage", "cage_unordered")
    ]
    sizes = [size for size in SIZES if size <= args.max_size]
    jobs += [("image", IMAGE_CELLS, size, CHUNK, args.repeats) for size in sizes]
    side = 1 << min(10, args.max_size.bit_length() - 1)
    jobs += [("call", IMAGE_CELLS, side, rays, args.repeats) for rays in CALLS if rays <= side**2]
    rows = []
    spawn = multiprocessing.get_context("spawn")
    for job in tqdm(jobs, disable=None):
        with ProcessPoolExecutor(1, mp_context=spawn) as fresh:
            rows.append(row := fresh.submit(time_march, *job).result())
        tqdm.write("  ".join(f"{k}={v:.4g}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items()))
    write_json(args.out, {"rows": rows, "exponents": (fits := exponents(rows))})
    print(f"{fits}\nwrote {args.out}")


def cage(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """A cube of 6 cells³ tets around 0, of size 1."""
    vertices, tets = kuhn_grid(cells, cells, cells)
    inside = np.all((vertices > 0) & (vertices < cells), axis=1, keepdims=True)
    jitter = np.random.default_rng(0).uniform(-0.15, 0.15, vertices.shape)  # turns no tet over
    return (vertices + inside * jitter) / cells - 0.5, tets


def camera_rays(size: int) -> Rays:
    """All rays of an image of the cube, tile by tile; it fills most of it."""
    pose = np.eye(4, dtype=np.float32)
    pose[:3, 3] = 0, 0, 2
    turn = np.array([[0.8, 0, 0.6], [0.36, 0.8, -0.48], [-0.48, 0.6, 0.64]])
    pose[:3] = turn @ pose[:3]
    camera = Camera(
        camera_to_world=jnp.asarray(pose, jnp.float32),
        focal=jnp.full(2, 1.2 * size, jnp.float32),
        principal=jnp.full(2, size / 2, jnp.float32),
        width=size,
        height=size,
    )
    return pixel_rays(camera, image_pixels(size, size).reshape(-1, 2)[tile_order(size, size)])


def unordered_rays(count: int) -> Rays:
    """From all around the cube through random points of it."""
    rng = np.random.default_rng(0)
    directions = unit(rng.normal(size=(count, 3)))
    origins = rng.uniform(-0.5, 0.5, (count, 3)) - 2 * directions
    return Rays(origins=jnp.asarray(origins, jnp.float32), directions=jnp.asarray(directions, jnp.float32))


def time_march(sweep: str, cells: int, size: int, rays_a_call: int, repeats: int) -> Row:
    """Build a cage and march an image's rays through it, chunk by chunk: medians of CPU time."""
    vertices, tets = cage(cells)
    start = time.process_time()
    mesh = build_tet_mesh(vertices, tets)
    build_s = time.process_time() - start
    rays = unordered_rays(size * size) if sweep == "cage_unordered" else camera_rays(size)
    rays = Rays(origins=(rays.origins - mesh.center) / mesh.scale, directions=rays.directions)
    tables = march_tables(mesh)
    chunk = min(rays_a_call, size * size)
    chunks = [jax.tree.map(lambda x, i=i: x[i : i + chunk], rays) for i in range(0, size * size, chunk)]
    chunks[-1] = jax.tree.map(lambda x: x[-chunk:], rays)
    # A line meets at most 3 n diagonal and axis-parallel planes in each of two directions; entries are few.
    march = MarchConfig(max_tets_per_ray=8 * (cells + 1), max_entries_per_ray=4)
    compiled = jax.jit(traverse, static_argnums=2)
    start = time.process_time()
    executable = compiled.lower(tables, chunks[0], march).compile()
    compile_s = time.process_time() - start
    times, segments = [], 0
    for repeat in range(repeats + 1):
        start = time.process_time()
        for part in chunks:
            crossings = jax.block_until_ready(executable(tables, part))
            if repeat == 0:
                segments += int(jnp.sum(crossings.codes >= 0))
                if jnp.any(crossings.overflow):
                    raise RuntimeError(
                        f"{cells} cells: a ray crosses more than {march.max_tets_per_ray} tets"
                    )
        times.append(time.process_time() - start)
    seconds, count = float(np.median(times[1:])), chunk * len(chunks)
    return {
        "sweep": sweep,
        "tets": len(tets),
        "pixels": size * size,
        "rays": count,
        "rays_a_call": chunk,
        "ms": 1e3 * seconds,
        "ns_per_ray": 1e9 * seconds / count,
        "ns_per_segment": 1e9 * seconds / max(segments, 1),
        "segments_per_ray": segments / count,
        "compile_s": compile_s,
        "build_s": build_s,
        "peak_memory_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def exponents(rows: Sequence[Row]) -> dict[str, float]:
    """Slopes of straight lines through the logarithms; NaN with fewer than two rows."""
    result = {}
    for sweep, size, value, least in (
        ("cage", "tets", "ns_per_ray", 300),
        ("cage_unordered", "tets", "ns_per_ray", 300),
        ("cage", "tets", "peak_memory_gib", 300),
        ("cage", "tets", "build_s", 300),
        ("image", "pixels", "ms", 200**2),
        ("image", "pixels", "peak_memory_gib", 200**2),
    ):
        points = [(row[size], row[value]) for row in rows if row["sweep"] == sweep and row[size] >= least]
        fit = np.polyfit(*np.log(points).T, 1)[0] if len(points) > 1 else np.nan
        result[f"{sweep}: {value} by {size}"] = float(fit)
    return result


if __name__ == "__main__":
    run_cli(main)
