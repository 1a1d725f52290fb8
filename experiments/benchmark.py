"""Time training and rendering on this machine; JSON with device, versions, compile and run times apart.

    python experiments/benchmark.py --out=benchmark.json
    python experiments/benchmark.py --data=DIR --workdir=out/mic --out=benchmark.json   # a trained impostor
    python experiments/benchmark.py --peers --out=peers.json   # beside other libraries (extra `peers`)

Without a workdir, an untrained impostor on a cage built from the scene's images is timed. Medians of repeats;
`train_step_*` is the whole step: batch, forward, backward, update.

`--peers` times ours and other libraries in turns on the same inputs, instead (`peers.py`). `ratio` is
ours_ms / peer_ms: below 1, ours is faster. With --workdir and --data, the trained impostor is rendered too.
"""

import argparse
import contextlib
import dataclasses
import platform
import resource
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from peers import PACKAGES, compare_all
from peers_match import Row, Work

from nimpostor_jax.config import ExperimentConfig, RenderConfig
from nimpostor_jax.field.impostor import init_impostor
from nimpostor_jax.gin_flags import add_flags, config_from_args, load_config, run_cli
from nimpostor_jax.io.impostor_file import load_impostor
from nimpostor_jax.metrics import psnr
from nimpostor_jax.pipeline.evaluate import camera_of, write_json
from nimpostor_jax.pipeline.prepare import Scene, prepare, prepare_trained, use_all_cores
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.frame import (
    View,
    for_frames,
    frame_config,
    on_all_devices,
    render_frame,
    to_image,
)
from nimpostor_jax.render.sampling import plan_samples
from nimpostor_jax.render.segments import locate_segments
from nimpostor_jax.render.traverse import march_tables, traverse
from nimpostor_jax.train.pool import draw_batch
from nimpostor_jax.train.sharding import data_parallel, device_mesh, dividing_devices, over_rays, replicated
from nimpostor_jax.train.step import init_state, make_optimizer, train_step
from nimpostor_jax.types import Camera, NeuralImpostor, Rays


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/benchmark.json"), help="JSON file")
    parser.add_argument("--data", default="fluffy_ball", help="a nerf-synthetic folder, or a built-in scene")
    parser.add_argument("--workdir", type=Path, help="of a training run: its impostor and cage are timed")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--frame_size", type=int, default=800)
    parser.add_argument("--peers", action="store_true", help="time ours beside other libraries")
    parser.add_argument(
        "--only", nargs="+", default=[], help="of --peers: rows whose names contain one of these"
    )
    add_flags(parser)
    args = parser.parse_args(argv)
    use_all_cores()
    trained = None
    config = config_from_args(args)
    if args.workdir is not None:
        config = load_config(
            [args.workdir / "config.gin", *(args.gin_configs or [])], args.gin_bindings or []
        )
        trained = load_impostor(args.workdir / "impostor.npz")

    def scene() -> Scene:
        if trained is None:
            return prepare(config, args.data)
        return prepare_trained(config, args.data, trained)

    report = {
        "device": f"{jax.devices()[0].device_kind} x {jax.local_device_count()}, {platform.machine()}",
        "versions": versions("nimpostor-jax", "jax", "jaxlib", "numpy"),
        "trained": trained is not None,
    }
    if args.peers:
        work = Work(repeats=args.repeats, frame_size=args.frame_size)
        if trained is not None:
            camera = first_camera(scene(), args.frame_size)
            work = dataclasses.replace(work, trained=(trained, camera, config.render))
        report["versions"] |= versions(*PACKAGES)
        report["rows"] = compare_all(work, args.only)
    else:
        report |= time_own(scene(), str(args.data), trained, args)
    report["rows"] = list(map(show, report["rows"]))
    write_json(args.out, report)
    print(f"wrote {args.out}")


def versions(*packages: str) -> dict[str, str]:
    """Installed versions; those of packages that are not installed are left out."""
    found = {}
    for name in packages:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def show(row: Row) -> Row:
    """Print a row as soon as it is there."""
    items = (f"{k}={v:.4g}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items())
    print("  ".join(items), flush=True)
    return row


def time_own(
    scene: Scene, name: str, trained: NeuralImpostor | None, args: argparse.Namespace
) -> dict[str, Any]:
    """Ours alone: marching, derivatives of the geometry, training steps, a frame, and peak memory."""
    rows = [time_traversal(scene, args.repeats), time_geometry(scene, args.repeats)]
    for interpolation, min_weight in (("grid", 0.0), ("grid", None), ("simplex", None)):
        config = scene.render
        if min_weight is not None:
            config = dataclasses.replace(config, min_weight=min_weight)
        rows.append(time_training(scene, interpolation, config, trained, args.repeats))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    rows += time_frames(trained or scene.impostor, scene, args.frame_size, args.repeats)
    return {
        "scene": name,
        "num_tets": scene.impostor.mesh.tets.shape[0],
        "peak_memory_gib_through_training": round(peak, 2),
        "rows": rows,
    }


def measure(call: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """Seconds of the first call, which compiles, and the median of the following ones."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return times[0], float(np.median(times[1:]))


def time_traversal(scene: Scene, repeats: int) -> Row:
    """Marching alone, on a training batch of incoherent rays."""
    mesh = scene.impostor.mesh
    batch = draw_batch(jax.random.key(0), 0, scene.pool, scene.config.train.rays_per_batch, "white")
    tables, rays = march_tables(mesh), to_local(mesh, batch.rays)
    march = jax.jit(traverse, static_argnums=2)
    first, median = measure(lambda: march(tables, rays, scene.render.march), repeats)
    segments = int((march(tables, rays, scene.render.march).codes >= 0).sum())
    return {
        "name": "traverse_training_rays",
        "ms": 1e3 * median,
        "compile_s": first - median,
        "rays": rays.origins.shape[0],
        "ns_per_segment": 1e9 * median / segments,
    }


def time_geometry(scene: Scene, repeats: int) -> Row:
    """The gradient of a training batch's segments in the cage's vertices and in the rays, on one device."""
    mesh, march = scene.impostor.mesh, scene.render.march
    batch = draw_batch(jax.random.key(0), 0, scene.pool, scene.config.train.rays_per_batch, "white")
    rays = to_local(mesh, batch.rays)
    crossings = jax.jit(traverse, static_argnums=2)(march_tables(mesh), rays, march)
    capacity = (march.capacity_per_ray or march.max_tets_per_ray) * rays.origins.shape[0]

    @jax.jit
    @partial(jax.grad, argnums=(0, 1))
    def gradient(vertices: jax.Array, rays: Rays) -> jax.Array:
        found = locate_segments(mesh.replace(vertices=vertices), rays, crossings, capacity=capacity)
        return jnp.sum(found.t_exit**2) + jnp.sum(found.lambda_enter**2) + jnp.sum(found.lambda_exit**2)

    first, median = measure(lambda: gradient(mesh.vertices, rays), repeats)
    return {
        "name": "gradient_of_geometry",
        "ms": 1e3 * median,
        "compile_s": first - median,
        "ns_per_segment": 1e9 * median / int((crossings.codes >= 0).sum()),
    }


def time_training(
    scene: Scene, interpolation: str, render: RenderConfig, trained: NeuralImpostor | None, repeats: int
) -> Row:
    """A whole step: drawing the batch, forward, backward, update."""
    config: ExperimentConfig = scene.config
    encoding = dataclasses.replace(config.impostor.encoding, interpolation=interpolation)
    impostor = init_impostor(
        jax.random.key(0),
        scene.impostor.mesh,
        dataclasses.replace(config.impostor, encoding=encoding),
    )
    if trained is not None and trained.config.encoding == encoding:
        impostor = trained
    optimizer = make_optimizer()
    mesh = device_mesh(dividing_devices(config.train.rays_per_batch))
    state = jax.device_put(init_state(impostor, optimizer, config.train.cells_per_edge), replicated(mesh))
    frozen, pool = jax.device_put((impostor, scene.pool), replicated(mesh))
    gradient = data_parallel(mesh)
    step = jax.jit(partial(train_step, optimizer=optimizer, gradient=gradient), static_argnames="config")
    size, key, rate = config.train.rays_per_batch, jax.random.key(0), jnp.float32(1e-3)

    def call() -> Any:
        batch = jax.device_put(draw_batch(key, 0, pool, size, "random"), over_rays(mesh))
        return step(state, frozen, batch, rate, config=render)

    first, median = measure(call, repeats)
    samples = count_samples(scene, size)
    trained_samples = "visible" if render.min_weight > 0 else "all"
    return {
        "name": f"train_step_{encoding.layout}_{interpolation}_{trained_samples}",
        "ms": 1e3 * median,
        "compile_s": first - median,
        "rays": size,
        "samples": samples,  # planned; densities of those in cells that are not known to be empty
        "samples_per_second": samples / median,
        "rays_per_second": size / median,
    }


def count_samples(scene: Scene, size: int) -> int:
    """Samples on the rays of the batch of `time_training`, those in empty cells included."""
    mesh = scene.impostor.mesh
    batch = draw_batch(jax.random.key(0), 0, scene.pool, size, "random")

    @jax.jit
    def counts() -> jax.Array:
        rays = to_local(mesh, batch.rays)
        segments = locate_segments(mesh, rays, traverse(march_tables(mesh), rays, scene.render.march))
        return plan_samples(segments, scene.render.sampler, "barycentric").num_used

    return int(counts())


def first_camera(scene: Scene, size: int) -> Camera:
    """The first test camera, at `size` pixels in width."""
    camera = camera_of(scene.test, 0)
    zoom = size / camera.width
    return Camera(
        camera_to_world=camera.camera_to_world,
        focal=camera.focal * zoom,
        principal=camera.principal * zoom,
        width=size,
        height=round(camera.height * zoom),
    )


def time_frames(impostor: NeuralImpostor, scene: Scene, size: int, repeats: int) -> list[Row]:
    """A frame of the first test camera, and what it would cost without each skip, in turns.

    One pass gives every sample a colour, not only those that a pass of densities finds visible.
    `psnr_to_exact` compares with the frame of every sample of every pixel: what the skips change.
    """
    camera = first_camera(scene, size)
    full = scene.config.render
    every_cell = dataclasses.replace(full, skip_empty=False)
    sorting = dataclasses.replace(full, skip_sorting=False)
    one_pass = dataclasses.replace(full, min_weight=0.0)
    everything = dataclasses.replace(one_pass, skip_empty=False, skip_sorting=False)
    merged, impostor = for_frames(impostor), on_all_devices(impostor)
    settings: dict[str, tuple[NeuralImpostor, RenderConfig, bool]] = {
        "": (merged, full, False),
        "_with_single_levels": (impostor, full, False),
        "_with_empty_cells": (merged, every_cell, False),
        "_with_sorting": (merged, sorting, False),
        "_in_one_pass": (merged, one_pass, False),
        "_with_empty_pixels": (merged, full, True),
        "_with_everything": (impostor, everything, True),
    }
    calls, images, times = {}, {}, {}
    pixels = np.arange(camera.width * camera.height)
    for name, (field, config, all_pixels) in settings.items():
        config = frame_config(field, camera, config)
        if all_pixels:
            calls[name] = lambda field=field, config=config: View(field, camera, config).render(pixels)
        else:
            calls[name] = partial(render_frame, field, camera, config)
        start = time.perf_counter()
        calls[name]()
        times[name] = [time.perf_counter() - start]
        images[name] = to_image(render_frame(field, camera, config))
        print(f"frame{name}: {times[name][0]:.1f} s with compilation", flush=True)
    for _ in range(repeats):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            times[name].append(time.perf_counter() - start)
    return [
        {
            "name": f"frame_{camera.width}x{camera.height}{name}",
            "ms": 1e3 * float(np.median(times[name][1:])),
            "compile_s": times[name][0] - float(np.median(times[name][1:])),
            "psnr_to_exact": None if name == "_with_everything"
            else float(psnr(images[name], images["_with_everything"])),
        }
        for name in settings
    ]


if __name__ == "__main__":
    run_cli(main)
