"""Table 1: frames a second of ray bending, of the accelerated volume renderer, and of the baked impostor.

    python experiments/table1.py --scene DIR --out=out/table2 --size=800
    python experiments/table1.py --scene fluffy_ball --out=out/table1 --quick

Runs that `table2.py` has left in the same folder are reused. Times are medians of frames of one held-out view
that are rendered in turns; ray bending, which takes minutes, is timed on every `--every`-th image tile, and
its time is multiplied. Writes table1.json (`rows`), .csv, .md and a picture of every method.
"""

import argparse
import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from ladder import (
    QUICK,
    QUICK_RESOLUTION,
    Row,
    bake_or_reuse,
    cage_of,
    config_of,
    scene_name,
    train_or_reuse,
    write_table,
)
from PIL import Image

from nimpostor_jax.geometry.topology import world_vertices
from nimpostor_jax.gin_flags import add_flags, run_cli
from nimpostor_jax.io.images import composite, to_uint8, write_png
from nimpostor_jax.metrics import psnr
from nimpostor_jax.pipeline.evaluate import MAX_PSNR, camera_of, composite_frame
from nimpostor_jax.pipeline.prepare import use_all_cores
from nimpostor_jax.pipeline.ray_bending import BentField
from nimpostor_jax.render.camera import TILE
from nimpostor_jax.render.frame import for_frames, frame_config, render_frame
from nimpostor_jax.render.raster_frame import rasterize_frame
from nimpostor_jax.train.sharding import num_cores
from nimpostor_jax.types import Camera

PAPER = {"ray bending (KNN)": 0.147, "volume": 39.42, "baked, rasterized": 157.83}  # fps, mic, 294 tets
COLUMNS = ("method", "scene", "size", "ms", "fps", "times_ray_bending", "psnr", "paper_fps")
METHODS_TIMED = ("NGP-Bounded", "BarySpl", "FeatInt")
REPEATS = 3
WAYS = ("marched", "rasterized")


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", required=True, help="a nerf-synthetic folder, or fluffy_ball")
    parser.add_argument("--out", type=Path, required=True, help="folder of table, pictures and trained runs")
    parser.add_argument("--resolution", type=int, default=200, help="image width for training")
    parser.add_argument("--size", type=int, default=800, help="image width for timing")
    parser.add_argument("--every", type=int, default=32, help="of how many tiles ray bending renders one")
    parser.add_argument("--cage", type=Path, help="default: built")
    parser.add_argument("--quick", action="store_true", help="small and short, to try the script")
    add_flags(parser)
    args = parser.parse_args(argv)
    use_all_cores()
    bindings = [*(QUICK if args.quick else ()), *args.gin_bindings]
    resolution, size = (QUICK_RESOLUTION, 32) if args.quick else (args.resolution, args.size)
    folder = args.out / scene_name(args.scene)
    place = folder / f"{resolution}"
    configs = {m: config_of(m, resolution, args.gin_configs, bindings) for m in METHODS_TIMED}
    cage = cage_of(args.scene, args.cage, folder, configs["BarySpl"], args.quick)
    trained = {m: train_or_reuse(m, c, args.scene, cage, place / m) for m, c in configs.items()}
    baked = for_frames(bake_or_reuse(trained["FeatInt"], place / "Baked")[0])

    views = trained["BarySpl"].scene.test
    zoom = size / views.width
    camera = camera_of(views, 0)
    camera = dataclasses.replace(
        camera,
        focal=camera.focal * zoom,
        principal=camera.principal * zoom,
        width=size,
        height=round(views.height * zoom),
    )
    stored = views.background(0, "white")
    behind = stored if isinstance(stored, str) else resized(stored, camera)
    frames: dict[str, Callable[[], np.ndarray]] = {}
    for name, method in (("volume", "BarySpl"), ("volume, early integration", "FeatInt")):
        each = trained[method]
        ready = for_frames(each.impostor)
        config = frame_config(ready, camera, each.scene.config.render)
        frames[name] = lambda i=ready, c=config: composite_frame(render_frame(i, camera, c), behind)
    sized = frame_config(baked, camera, trained["FeatInt"].scene.config.render)
    frames["baked, marched"] = lambda: composite_frame(render_frame(baked, camera, sized), behind)
    frames["baked, rasterized"] = lambda: composite_frame(rasterize_frame(baked, camera, sized), behind)
    pictures = {name: frame() for name, frame in frames.items()}  # compiles
    seconds: dict[str, list[float]] = {name: [] for name in frames}
    for _ in range(REPEATS):
        for name, frame in frames.items():
            start = time.perf_counter()
            frame()
            seconds[name].append(time.perf_counter() - start)

    for name, values in seconds.items():
        print(f"{name}: {1e3 * np.median(values):.0f} ms", flush=True)
    mesh = trained["BarySpl"].impostor.mesh
    vertices = world_vertices(mesh)
    bent = BentField(trained["NGP-Bounded"].impostor, vertices, vertices, np.asarray(mesh.tets))
    pixels = some_tiles(camera, args.every)
    bent.evaluate(vertices[np.asarray(mesh.tets[:1])].mean(axis=1), np.array([[0.0, 0.0, 1.0]]))  # compiles
    start = time.perf_counter()
    color, opacity = bent.render(camera, pixels=pixels)
    bending = (time.perf_counter() - start) * camera.width * camera.height / len(pixels)
    if not opacity.any():
        raise ValueError(f"no tile that ray bending rendered shows the object; lower --every={args.every}")
    picture = np.ones((camera.height * camera.width, 3))
    if not isinstance(behind, str):
        picture[:] = behind.reshape(-1, 3)
    picture[pixels] = color + (1 - opacity)[:, None] * picture[pixels]
    pictures["ray bending (KNN)"] = picture.reshape(camera.height, camera.width, 3)

    truth = resized(composite(views.images[0], stored), camera)
    shown = np.zeros(camera.height * camera.width, bool)
    shown[pixels] = True
    shown = shown.reshape(camera.height, camera.width)
    rows: list[Row] = []
    for name, values in [("ray bending (KNN)", [bending]), *seconds.items()]:
        time_of = float(np.median(values))
        rows.append(
            {
                "method": name,
                "scene": scene_name(args.scene),
                "size": size,
                "ms": 1e3 * time_of,
                "fps": 1 / time_of,
                "times_ray_bending": bending / time_of,
                "psnr": min(psnr(pictures[name][shown], truth[shown]), MAX_PSNR),
                "paper_fps": PAPER.get(name),
            }
        )
    gains = [np.median(seconds["volume"]) / np.median(seconds[f"baked, {way}"]) for way in WAYS]
    notes = (
        f"{camera.width} x {camera.height}, {len(mesh.tets)} tets, {num_cores()} cores; "
        f"psnr: on the tiles that ray bending rendered, to the view enlarged from {views.width} pixels. "
        f"Ray bending: 64 + 128 samples a ray, timed on {len(pixels):,} pixels. Baked against volume: "
        f"{gains[0]:.1f} times as fast marched, {gains[1]:.1f} rasterized (paper: 4.0)."
    )
    write_table(args.out / "table1", rows, COLUMNS, notes)
    write_png(args.out / "table1.png", np.concatenate([truth, *pictures.values()], axis=1))


def resized(picture: np.ndarray, camera: Camera) -> np.ndarray:
    """A picture [H, W, 3] in the size of the camera's."""
    image = Image.fromarray(to_uint8(picture))
    return np.asarray(image.resize((camera.width, camera.height), Image.Resampling.BICUBIC)) / 255


def some_tiles(camera: Camera, every: int) -> np.ndarray:
    """Pixels of every n-th image tile, spread over the image."""
    y, x = np.divmod(np.arange(camera.height * camera.width), camera.width)
    tile = (y // TILE) * -(-camera.width // TILE) + x // TILE
    order = np.random.default_rng(0).permutation(tile.max() + 1)
    return np.flatnonzero(order[tile] % every == 0)


if __name__ == "__main__":
    run_cli(main)
