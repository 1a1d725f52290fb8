"""How tables' layouts fit: fields' jumps across faces, seams in pictures, and levels that single tets need.

    python experiments/layouts.py --data=DIR --workdir out/per_simplex out/per_tet --out=out/layouts

For each run: at random points of interior faces, what the field is on one side against the other (colour, and
opacity of a step of 1/8, where at least one side has some); in held-out views, the error's step from pixel to
pixel where the tet that is seen changes, over that where it does not, 1 without seams; and the share of all
lookups that would be saved if each tet left out the levels whose cells are narrower than half a pixel there.
Writes layouts.json (`rows`), and for each run an enlarged part of a view: truth, render, and tets' borders.
"""

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nimpostor_jax.config import ExperimentConfig, RenderConfig
from nimpostor_jax.field import impostor as field
from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.geometry.topology import world_vertices
from nimpostor_jax.gin_flags import add_flags, config_of_run, run_cli
from nimpostor_jax.io.blender import PosedImages, load_scene
from nimpostor_jax.io.images import composite, write_png
from nimpostor_jax.io.impostor_file import load_impostor
from nimpostor_jax.io.scenes import resolve_scene
from nimpostor_jax.pipeline.evaluate import camera_of, composite_frame, write_json
from nimpostor_jax.pipeline.prepare import MIN_CELL, use_all_cores
from nimpostor_jax.render.camera import image_pixels, pixel_rays
from nimpostor_jax.render.frame import frame_config, render_frame
from nimpostor_jax.render.renderer import render_samples
from nimpostor_jax.render.selection import optical_weights, sample_densities
from nimpostor_jax.types import NeuralImpostor, Rays

POINTS = 1 << 16
STEP = 1 / 8
LEAST_OPACITY = 0.02
ROWS = 8192  # rays a call
ENLARGED = 6


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", required=True, help="the scene of the runs")
    parser.add_argument("--workdir", type=Path, nargs="+", required=True, help="of training runs")
    parser.add_argument("--out", type=Path, default=Path("out/layouts"), help="folder")
    parser.add_argument("--views", type=int, default=5)
    add_flags(parser)
    args = parser.parse_args(argv)
    names = [workdir.name for workdir in args.workdir]
    if len(set(names)) < len(names):
        raise ValueError(f"--workdir: pictures are named after runs, which need different names, got {names}")
    use_all_cores()
    rows: list[dict[str, Any]] = []
    for workdir in args.workdir:
        config, impostor = config_of_run(workdir, args), load_impostor(workdir / "impostor.npz")
        train, test = load_scene(resolve_scene(args.data), config.data)
        views = test.select(np.linspace(0, len(test) - 1, min(args.views, len(test))).astype(int))
        encoding = impostor.config.encoding
        row: dict[str, Any] = {"run": workdir.name, "layout": encoding.layout}
        row["interpolation"] = encoding.interpolation
        row |= jumps(impostor) | in_pictures(impostor, views, config, args.out / f"{workdir.name}.png")
        row["saved_by_own_levels"] = saved_by_own_levels(impostor, train)
        rows.append(row)
        print(", ".join(f"{k}: {v:.4g}" if isinstance(v, float) else f"{k}: {v}" for k, v in row.items()))
    write_json(args.out / "layouts.json", {"rows": rows})
    print(f"wrote {args.out}")


def saved_by_own_levels(impostor: NeuralImpostor, views: PosedImages) -> float:
    """Share of lookups in levels too fine for their tet; a tet is looked up about as often as it is large."""
    corners = world_vertices(impostor.mesh)[np.asarray(impostor.mesh.tets)]
    first, second = np.triu_indices(4, 1)
    edges = np.median(np.linalg.norm(corners[:, first] - corners[:, second], axis=-1), axis=1)
    distances = np.linalg.norm(views.camera_to_world[:, :3, 3] - corners.mean(axis=(0, 1)), axis=1)
    pixels = edges * np.median(views.focal) / np.median(distances)
    size = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) ** (2 / 3)  # as rays meet it
    levels = np.array(impostor.config.encoding.resolutions)
    needed = np.sum(pixels[:, None] / levels >= MIN_CELL, axis=1)
    return float(1 - np.sum(np.maximum(needed, 1) * size) / (len(levels) * np.sum(size)))


def jumps(impostor: NeuralImpostor) -> dict[str, float]:
    """Differences between the two sides of interior faces, over points that at least one side shows."""
    rng = np.random.default_rng(0)
    tets, neighbors = np.asarray(impostor.mesh.tets), np.asarray(impostor.mesh.neighbors)
    first, face = np.nonzero(neighbors > np.arange(len(tets))[:, None])
    chosen = rng.integers(len(first), size=POINTS)
    first, face = first[chosen], face[chosen]
    second = neighbors[first, face]
    weights = rng.dirichlet(np.ones(3), POINTS)
    corners = np.array(FACES)[face]  # [M, 3], numbers of corners
    lambdas = np.zeros((2, POINTS, 4))
    np.put_along_axis(lambdas[0], corners, weights, axis=1)
    for i in range(3):
        vertex = tets[first, corners[:, i]]
        lambdas[1][tets[second] == vertex[:, None]] = weights[:, i]
    directions = rng.normal(size=(POINTS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)

    @jax.jit
    def side(tets: jax.Array, lambdas: jax.Array) -> tuple[jax.Array, jax.Array]:
        features = field.features(impostor, tets, lambdas)
        encoded = field.encode_directions(impostor, jnp.asarray(directions, jnp.float32))
        sigmas = field.density(impostor, tets, features)
        return -jnp.expm1(-STEP * sigmas), field.radiance(impostor, tets, features, encoded)

    (a, colors_a), (b, colors_b) = (
        map(np.asarray, side(jnp.asarray(t, jnp.int32), jnp.asarray(x, jnp.float32)))
        for t, x in ((first, lambdas[0]), (second, lambdas[1]))
    )
    shown = np.maximum(a, b) > LEAST_OPACITY
    opacity = np.abs(a - b)[shown]
    color = (np.maximum(a, b) * np.abs(colors_a - colors_b).mean(axis=1))[shown]
    return {
        "points_shown": float(shown.mean()),
        "opacity_jump": float(opacity.mean()),
        "opacity_jump_max": float(opacity.max()),
        "color_jump": float(color.mean()),
        "color_jump_max": float(color.max()),
    }


def in_pictures(
    impostor: NeuralImpostor, views: PosedImages, config: ExperimentConfig, path: Path
) -> dict[str, float]:
    """The error's steps across and within the borders of the tets that pixels show."""
    sized = frame_config(impostor, camera_of(views, 0), config.render)
    seen = jax.jit(partial(seen_tets, config=sized))
    across, within = [], []
    for i in range(len(views)):
        camera = camera_of(views, i)
        behind = views.background(i, config.data.background)
        image = composite_frame(render_frame(impostor, camera, sized), behind)
        truth = composite(views.images[i], behind)
        rays = pixel_rays(camera, image_pixels(views.height, views.width).reshape(-1, 2))
        padding = -rays.origins.shape[0] % ROWS
        rays = jax.tree.map(lambda x, p=padding: jnp.pad(x, ((0, p), (0, 0)), mode="edge"), rays)
        parts = range(0, rays.origins.shape[0], ROWS)
        found = [seen(impostor, jax.tree.map(lambda x, s=s: x[s : s + ROWS], rays)) for s in parts]
        tets = np.concatenate([np.asarray(x) for x in found])[: views.height * views.width]
        tets = tets.reshape(views.height, views.width)
        error, borders = image - truth, np.zeros(tets.shape, bool)
        for axis in (0, 1):
            step = np.abs(np.diff(error, axis=axis)).mean(axis=-1)
            one, other = (np.take(tets, np.arange(n, tets.shape[axis] - 1 + n), axis) for n in (0, 1))
            both = (one >= 0) & (other >= 0)
            across.append(step[both & (one != other)])
            within.append(step[both & (one == other)])
            borders[: one.shape[0], : one.shape[1]] |= both & (one != other)
        if i == 0:
            middle = np.argwhere(tets >= 0).mean(axis=0).astype(int)
            half = min(views.height, views.width) // 6
            cut = tuple(slice(max(m - half, 0), m + half) for m in middle)
            drawn = np.where(borders[..., None], [1.0, 0, 0], image)
            panel = np.concatenate([truth[cut], image[cut], drawn[cut]], axis=1)
            write_png(path, panel.repeat(ENLARGED, axis=0).repeat(ENLARGED, axis=1))
    across, within = np.concatenate(across), np.concatenate(within)
    return {
        "step_across": float(across.mean()),
        "step_within": float(within.mean()),
        "seams": float(across.mean() / within.mean()),
        "share_across": float(across.size / (across.size + within.size)),
    }


def seen_tets(impostor: NeuralImpostor, rays: Rays, config: RenderConfig) -> jax.Array:
    """The tet that contributes most to each ray; -1 where nothing does much."""
    output, samples = render_samples(impostor, rays, config)
    features = field.features(impostor, samples.tet_ids, samples.lambdas, samples.num_used)
    sigmas = sample_densities(impostor, samples.tet_ids, features, samples.num_used)
    weights = optical_weights(sigmas, samples)
    weights = jnp.where(jnp.arange(weights.size) < samples.num_used, weights, 0)
    count = rays.origins.shape[0]
    most = jax.ops.segment_max(weights, samples.rays, count)
    best = jnp.where((weights == most[samples.rays]) & (weights > 0), samples.tet_ids, -1)
    return jnp.where(output.opacity > 0.5, jax.ops.segment_max(best, samples.rays, count), -1)


if __name__ == "__main__":
    run_cli(main)
