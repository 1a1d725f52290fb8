"""CPU time of each stage of rendering and of a training step, on one device.

    python experiments/stages.py --data=DIR --workdir=out/mic --out=stages.json [--baked=out/mic/baked.npz]

Frame rays are a chunk of the first test view at 800 pixels, as `render_frame` takes them; training rays half
a batch, as one of two devices has them. Stages are compiled one by one, so that their sum is not quite the
whole. Medians, without compilation; `page_faults` should be 0 after the first call.
"""

import argparse
import dataclasses
import resource
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from benchmark import first_camera

from nimpostor_jax.config import RenderConfig
from nimpostor_jax.encoding.spherical_harmonics import spherical_harmonics
from nimpostor_jax.field.decoder import num_decoder_sets
from nimpostor_jax.field.impostor import merge_levels
from nimpostor_jax.gin_flags import add_flags, config_of_run, run_cli
from nimpostor_jax.io.impostor_file import load_baked, load_impostor
from nimpostor_jax.pipeline.evaluate import write_json
from nimpostor_jax.pipeline.prepare import prepare_trained, use_all_cores
from nimpostor_jax.render.baked import (
    BASIS,
    lit_segments,
    opacities_at,
    places_seen,
    render_baked_rays,
    shade_segments,
)
from nimpostor_jax.render.camera import image_pixels, pixel_rays, tile_order, to_local
from nimpostor_jax.render.capacity import ray_entries
from nimpostor_jax.render.frame import CHUNK, frame_config
from nimpostor_jax.render.renderer import decode_integrated, integrate_samples, render_rays
from nimpostor_jax.render.sampling import place_samples, plan_samples
from nimpostor_jax.render.segments import locate_segments
from nimpostor_jax.render.selection import in_order, present_samples, slabs_of, visible_samples
from nimpostor_jax.render.traverse import find_entries, march_tables, traverse
from nimpostor_jax.train.pool import draw_batch
from nimpostor_jax.train.step import RayBatch, loss_gradient, make_optimizer, trainable
from nimpostor_jax.types import BakedImpostor, NeuralImpostor, Rays, TetMesh

Row = dict[str, Any]

FRAME_SIZE = 800
REPEATS = 9


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", required=True, help="a nerf-synthetic folder, or a built-in scene")
    parser.add_argument("--workdir", required=True, type=Path, help="of a training run")
    parser.add_argument("--baked", type=Path, help="what was baked of the run: its frame's stages, too")
    parser.add_argument("--out", type=Path, default=Path("out/stages.json"))
    add_flags(parser)
    args = parser.parse_args(argv)
    use_all_cores()
    config = config_of_run(args.workdir, args)
    impostor = load_impostor(args.workdir / "impostor.npz")
    scene = prepare_trained(config, args.data, impostor, log=lambda _: None)
    camera = first_camera(scene, FRAME_SIZE)
    order = tile_order(camera.height, camera.width)
    rays = pixel_rays(camera, image_pixels(camera.height, camera.width).reshape(-1, 2)[order])
    sized = frame_config(impostor, camera, config.render)
    rows = render_stages("frame", merge_levels(impostor), chunk_of_hits(impostor, rays, sized), sized, None)
    half = config.train.rays_per_batch // 2
    batch = draw_batch(jax.random.key(0), 0, scene.pool, half, "random")
    rows += render_stages("training", impostor, batch.rays, scene.render, batch.jitter)
    rows += training_stages(impostor, batch, scene.render)
    if args.baked:
        baked = load_baked(args.baked)
        sized = frame_config(baked, camera, config.render)
        rows += baked_stages(baked, chunk_of_hits(baked, rays, sized), sized)
    write_json(args.out, {"device": jax.devices()[0].device_kind, "rows": rows})
    print(f"wrote {args.out}")


def chunk_of_hits(impostor: NeuralImpostor | BakedImpostor, rays: Rays, config: RenderConfig) -> Rays:
    """A chunk of a frame's rays that hit the cage, tile by tile from all over the image."""
    tables = march_tables(impostor.mesh)
    hits = np.flatnonzero(np.asarray(ray_entries(impostor.mesh, tables, rays, config.march).holds)[:, 0] >= 0)
    tile = 256
    tiles = np.linspace(0, len(hits) // tile - 1, CHUNK // tile).round().astype(int)
    chosen = hits[(tiles[:, None] * tile + np.arange(tile)).ravel()]
    return jax.tree.map(lambda x: x[chosen], rays)


def timed(kind: str, stage: str, function: Callable, *arguments: Any) -> tuple[Row, Any]:
    """A row, and what the function returns."""
    call = jax.jit(function)
    result = jax.block_until_ready(call(*arguments))
    times, faults = [], []
    for _ in range(REPEATS):
        before, start = resource.getrusage(resource.RUSAGE_SELF).ru_minflt, time.process_time()
        jax.block_until_ready(call(*arguments))
        times.append(time.process_time() - start)
        faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
    row = {"rays": kind, "stage": stage, "cpu_ms": 1e3 * float(np.median(times))}
    row["page_faults"] = int(np.median(faults))
    print(f"{kind:9s} {stage:15s} {row['cpu_ms']:8.2f} ms  {row['page_faults']} page faults", flush=True)
    return row, result


def render_stages(
    kind: str, impostor: NeuralImpostor, rays: Rays, config: RenderConfig, jitter: jax.Array | None
) -> list[Row]:
    """Each stage of `render_rays`, and all of it with known entries."""
    rows: list[Row] = []
    stage = partial(_add_timed, rows, kind)
    local, tables, entries, segments = march_stages(stage, impostor.mesh, rays, config)
    slabs = slabs_of(impostor, config) if jitter is None else None
    plan = stage(
        "plan",
        lambda s, b: plan_samples(s, config.sampler, config.density_measure, jitter, slabs=b),
        segments, slabs,
    )  # fmt: skip
    plan, chosen, count = stage("cells", lambda i, p: present_samples(i, p, config), impostor, plan)
    numbers = {"planned": int(plan.num_used), "in occupied cells": int(count)}
    sort_all = dataclasses.replace(config, skip_sorting=False)
    stage("if tets overlap", lambda p, c, n: in_order(p, c, n, sort_all), plan, chosen, count)
    features = None
    if config.min_weight > 0:
        look = lambda i, p, c, n: visible_samples(i, p, c, n, config, None)  # noqa: E731
        chosen, features, count = stage("visible", look, impostor, plan, chosen, count)
        numbers["visible"] = int(count)
    samples = stage("place", place_samples, plan, chosen, count)
    stage(
        "colours",
        lambda i, r, s, f, o: integrate_samples(i, r, s, f, o, config),
        impostor, local, samples, features, segments.overflow,
    )  # fmt: skip
    stage(
        "all",
        lambda i, r, t, e, b: render_rays(i, r, config, jitter, t, e, slabs=b),
        impostor, rays, tables, entries, slabs,
    )  # fmt: skip
    print(f"{kind}: samples {numbers}")
    return [row | {"samples": numbers} for row in rows]


def baked_stages(baked: BakedImpostor, rays: Rays, config: RenderConfig) -> list[Row]:
    """Each stage of `render_baked_rays`, and all of it with known entries."""
    rows: list[Row] = []
    stage = partial(_add_timed, rows, "baked")
    local, tables, entries, segments = march_stages(stage, baked.mesh, rays, config)
    used = dataclasses.replace(segments, tet_ids=jnp.maximum(segments.tet_ids, 0))
    count = jnp.sum(segments.tet_ids >= 0)
    last = jnp.max(jnp.where(segments.tet_ids >= 0, jnp.arange(segments.rays.size), 0)) + 1
    places, _ = stage("depths", places_seen, baked.depths, used, last)
    stage("opacities", opacities_at, baked.opacities, used, places, last)
    shade = partial(shade_segments, config=config)
    shown = stage("all lookups", shade, baked, local, segments)
    num_sets, channels = num_decoder_sets(baked.decoders), baked.textures.features.shape[1] // BASIS
    directions = spherical_harmonics(rays.directions, baked.config.decoder.sh_degree)
    each = jnp.ones((num_sets * len(rays.origins), channels + 2)), jnp.tile(directions, (num_sets, 1))
    stage("their decoder", decode_integrated, baked.decoders, *each)
    *_, lit = lit_segments(baked, segments, config.min_weight)
    everything = lambda b, r, t, e: render_baked_rays(b, r, config, t, e)  # noqa: E731
    stage("all", everything, baked, rays, tables, entries)
    visible = int(jnp.sum(shown.opacity > 0))
    numbers = {"segments": int(count), "that light reaches": int(lit), "pixels that show something": visible}
    print(f"baked: {numbers}")
    return [row | {"samples": numbers} for row in rows]


def march_stages(stage: Callable, mesh: TetMesh, rays: Rays, config: RenderConfig) -> tuple:
    """Entries and segments; and the rays in the mesh's frame, and its tables."""
    local, tables = to_local(mesh, rays), march_tables(mesh)
    capacity = (config.march.capacity_per_ray or config.march.max_tets_per_ray) * rays.origins.shape[0]
    entries = stage("entries", lambda t, r: find_entries(t, r, config.march), tables, local)
    crossings = stage("march", lambda t, r, e: traverse(t, r, config.march, e), tables, local, entries)
    segments = stage(
        "segments", lambda m, r, c: locate_segments(m, r, c, 0.0, capacity), mesh, local, crossings
    )
    return local, tables, entries, segments


def _add_timed(rows: list[Row], kind: str, name: str, function: Callable, *arguments: Any) -> Any:
    """What the function returns; its row is added."""
    row, result = timed(kind, name, function, *arguments)
    rows.append(row)
    return result


def training_stages(impostor: NeuralImpostor, batch: RayBatch, config: RenderConfig) -> list[Row]:
    """The gradient of a batch, and the optimiser's update."""
    parameters, optimizer = trainable(impostor), make_optimizer()
    gradient, (gradients, _) = timed(
        "training", "gradient", lambda p, i, b: loss_gradient(p, i, b, config), parameters, impostor, batch
    )
    gradients = jax.tree.map(jnp.asarray, gradients)
    update, _ = timed("training", "Adam", optimizer.update, gradients, optimizer.init(parameters), parameters)
    return [gradient, update]


if __name__ == "__main__":
    run_cli(main)
