"""Figure 10: how little the shape and number of the cage's tets matter, on seven proxies of one object.

    python experiments/figure10.py --scene fluffy_ball --out=out/figure10
    python experiments/figure10.py --scene DIR --out=out/figure10 --quick

The proxies are an envelope, the bounding box, a cube, and spheres (an icosahedron subdivided 0 to 3 times),
with the paper's numbers of tets, and the same parameter budget. Cages and runs that are there are reused.
TrainConfig.rays_per_batch counts rays that show the object, on average: half of those through a cube pass it
by, and with as many rays in all, its field would have seen each pixel of the object half as often.
Writes figure10.json (`rows`), .csv, .md and a picture of every proxy's render.
"""

import argparse
import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import trimesh
from ladder import (
    QUICK,
    QUICK_RESOLUTION,
    Row,
    config_of,
    scene_name,
    train_or_reuse,
    write_picture,
    write_table,
)

from nimpostor_jax.config import CageConfig
from nimpostor_jax.geometry.topology import Cage
from nimpostor_jax.gin_flags import add_flags, run_cli
from nimpostor_jax.io.blender import PosedImages, load_scene
from nimpostor_jax.io.mesh_files import load_tets, save_tets
from nimpostor_jax.io.scenes import resolve_scene
from nimpostor_jax.pipeline.prepare import check_built, settings_of, use_all_cores
from nimpostor_jax.preprocess.cage import cage_from_images
from nimpostor_jax.preprocess.tetrahedralize import box_tets, is_sound, run_ftetwild
from nimpostor_jax.preprocess.validate import missed_foreground
from nimpostor_jax.preprocess.visual_hull import visual_hull
from nimpostor_jax.train.sharding import num_cores

# Tets of each proxy; the paper's PSNR lies between 32.58 and 33.24 dB for all seven.
PROXIES = {
    "shell": 600, "box": 6, "cube": 2258,
    "sphere0": 544, "sphere1": 436, "sphere2": 1372, "sphere3": 1197,
}  # fmt: skip
SAME_BUDGET = Path(__file__).parent / "configs" / "figure10.gin"
ROUND_RAYS = 64  # batches are spread over devices
FILL_CALLS, LONG_EDGE = 16, 0.2
EDGE_SLOPE, EPSILON_SLOPE = 5, 1.3  # the count goes about as edges**-5, or as epsilon**-1.3
SPREAD = 0.08  # of the logarithm of edges, around the best
CLOSE_ENOUGH = 0.08  # logarithm
COLUMNS = (
    "proxy", "tets", "target_tets", "psnr", "ssim", "lpips", "train_seconds", "rays_per_batch", "parameters",
)  # fmt: skip


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", required=True, help="a nerf-synthetic folder, or fluffy_ball")
    parser.add_argument("--out", type=Path, required=True, help="folder of table, pictures and trained runs")
    parser.add_argument("--resolution", type=int, default=100, help="image width")
    parser.add_argument("--proxies", nargs="+", choices=PROXIES, default=list(PROXIES))
    parser.add_argument("--quick", action="store_true", help="small and short, to try the script")
    add_flags(parser)
    args = parser.parse_args(argv)
    use_all_cores()
    bindings = [*(QUICK if args.quick else ()), *args.gin_bindings]
    resolution = QUICK_RESOLUTION if args.quick else args.resolution
    config = config_of("BarySpl", resolution, [SAME_BUDGET, *args.gin_configs], bindings)
    views, _ = load_scene(resolve_scene(args.scene), config.data)
    rows: list[Row] = []
    runs: list[Path] = []
    for proxy in args.proxies:
        folder = args.out / scene_name(args.scene) / f"{resolution}" / proxy
        cage = folder / "cage.npz"
        if cage.exists():
            check_built(cage, config.cage)
        else:
            save_tets(cage, *proxy_cage(proxy, views, config.cage), settings_of(config.cage))
        rays = rays_per_batch(load_tets(cage), views, config.train.rays_per_batch)
        own = dataclasses.replace(config, train=dataclasses.replace(config.train, rays_per_batch=rays))
        trained = train_or_reuse("BarySpl", own, args.scene, cage, folder)
        runs.append(folder)
        rows.append({**trained.row, "proxy": proxy, "target_tets": PROXIES[proxy]})
        spread = max(row["psnr"] for row in rows) - min(row["psnr"] for row in rows)
        notes = (
            f"{resolution} pixels wide, {config.train.steps} steps of {config.train.rays_per_batch} rays "
            f"that show the object, {num_cores()} cores; PSNR within {spread:.2f} dB (the paper: 0.66)."
        )
        write_table(args.out / "figure10", rows, COLUMNS, notes)
    write_picture(args.out / "figure10.png", trained.scene.test, runs)


def rays_per_batch(cage: Cage, views: PosedImages, count: int) -> int:
    """How many of a cage's rays are drawn at once, so that `count` of them show the object."""
    cameras = views.camera_to_world, views.focal, views.principal
    all_rays = missed_foreground(*cage, np.ones_like(views.masks), *cameras)
    shown = missed_foreground(*cage, views.masks, *cameras)
    hits, object_hits = (int(np.sum(rays.foreground - rays.missed)) for rays in (all_rays, shown))
    share = hits / max(object_hits, 1)  # a cage of another object is refused when the scene is prepared
    return ROUND_RAYS * math.ceil(count * share / ROUND_RAYS)


def proxy_cage(proxy: str, views: PosedImages, config: CageConfig) -> Cage:
    """A cage of the named shape around the object that the views' masks show."""
    target = PROXIES[proxy]
    if proxy == "shell":
        return cage_from_images(views, dataclasses.replace(config, target_tets=target))
    grid = visual_hull(
        views.masks, views.camera_to_world, views.focal, views.principal,
        resolution=config.grid_resolution, names=views.names,
    )  # fmt: skip
    center = grid.bounds.mean(axis=0)
    diagonal = float(np.linalg.norm(np.diff(grid.bounds, axis=0)))
    surface = _shape(proxy, grid.centers - center)(config.margin * diagonal)
    surface.apply_translation(center)
    if proxy == "box":
        return box_tets(surface.bounds)
    return fill(surface, target, config.margin * diagonal / 4)


def fill(surface: trimesh.Trimesh, target: int, epsilon: float) -> Cage:
    """About so many tets in a simple surface; raises ValueError where no attempt is within 20 %.

    `preprocess.tetrahedralize` steers the count by the surface's tolerance, which alone says nothing of
    spheres and cubes. Here the length of edges does, and the tolerance where the surface needs more tets than
    long edges do. The count jumps, and differs by some ten percent between equal calls: the next call is made
    near the best.
    """
    edge, attempts, rng = LONG_EDGE, [], np.random.default_rng(0)
    for call in range(FILL_CALLS):
        vertices, tets = run_ftetwild(surface, epsilon, edge)
        print(f"fTetWild call {call + 1}: edges of {edge:.3f}, {len(tets)} tets", flush=True)
        if len(tets) and is_sound(vertices, tets):
            attempts.append((math.log(len(tets) / target), edge, epsilon, (vertices, tets)))
        if not attempts:
            edge *= math.exp(rng.uniform(-SPREAD, SPREAD))
            continue
        off, edge, epsilon, best = min(attempts, key=lambda attempt: abs(attempt[0]))
        if abs(off) < CLOSE_ENOUGH:
            return best
        if off > 0 and edge >= LONG_EDGE:
            epsilon *= math.exp(off / EPSILON_SLOPE + rng.uniform(0, SPREAD))
        else:
            edge *= math.exp(off / EDGE_SLOPE + rng.uniform(-SPREAD, SPREAD))
    if not attempts:
        raise ValueError(f"fTetWild returned no usable mesh in {FILL_CALLS} calls; enlarge CageConfig.margin")
    if not 0.8 <= len(best[1]) / target <= 1.2:
        raise ValueError(f"no cage with about {target} tets, but {len(best[1])}, in {FILL_CALLS} calls")
    return best


def _shape(proxy: str, points: np.ndarray) -> Callable[[float], trimesh.Trimesh]:
    """A surface around points, at a distance."""
    if proxy in ("box", "cube"):
        half = np.abs(points).max(axis=0)
        half = half if proxy == "box" else np.full(3, half.max())
        size = half.max() / 2
        return lambda offset: trimesh.creation.box(extents=2 * (half + offset)).subdivide_to_size(size)
    sphere = trimesh.creation.icosphere(subdivisions=int(proxy.removeprefix("sphere")))
    radius = float(np.linalg.norm(points, axis=1).max())
    # Faces lie within the sphere through the vertices: scaled until they do not cut into the object.
    inside = float(np.min(np.sum(sphere.face_normals * sphere.triangles_center, axis=1)))
    return lambda offset: sphere.copy().apply_scale((radius + offset) / inside)


if __name__ == "__main__":
    run_cli(main)
