"""Stress the traversal: random and adversarial rays through awkward meshes, against a float64 oracle.

    python experiments/stress.py --rays=1000000 --out=out/stress.json
    python experiments/stress.py --cage=cage.npz          # a cage of your own besides the built-in meshes

For every mesh (`stress_meshes.py`) and dtype:
  lost, doubled    rays whose segments leave out, or repeat, more than the tolerance of the line's part inside
  max_chord_error  largest difference of the two, relative to the mesh's size
  color_error      largest error of colour and opacity, for densities 0, 1 and 1e8, of some rays
  nonfinite        values and gradients that are NaN or infinite
  overflow         rays with more tets or entries than slots
  unclear          share of rays whose colour rounding may change, and which color_error leaves out
Where a ray grazes the surface, rounding decides whether it is inside: errors are the distance to what lies
between the line's part surely inside and that not surely outside (`stress_oracle.py`). In meshes with
inverted tets a walk goes backwards: there, forward less backward length is compared with positive less
inverted tets.
"""

import argparse
import itertools
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from stress_meshes import FROM_ORIGIN, MESHES, RAYS, Case, build, unit
from stress_oracle import (
    Geometry,
    Lines,
    Solid,
    chord_range,
    color_range,
    face_intervals,
    pieces,
    solid_of,
    tet_lengths,
)
from tqdm import tqdm

from nimpostor_jax.config import MarchConfig
from nimpostor_jax.gin_flags import run_cli
from nimpostor_jax.io.mesh_files import load_tets
from nimpostor_jax.pipeline.evaluate import write_json
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.composite import sample_weights, sum_by_ray
from nimpostor_jax.render.segments import locate_segments
from nimpostor_jax.render.traverse import Crossings, march_tables, traverse
from nimpostor_jax.train.sharding import num_cores
from nimpostor_jax.types import Rays, TetMesh, TetSegments

Row = dict[str, float]

TOLERANCE = {"float32": 1e-4, "float64": 1e-10}  # of the mesh's size, and of colours
# Units in the last place, of the distance from the ray's origin, by which rounding may move what a ray
# meets; float64 takes more because the oracle rounds as much.
MARGIN = {"float32": 32, "float64": 2048}
DENSITIES = (0.0, 1.0, 1e8)
BEHIND = -1e3  # sizes of the mesh: no ray starts further away
GROUP = 64  # rays that are looked at again
COLORED = 128  # rays of each chunk that are composited
DIFFERENTIATED = 16  # rays of each chunk whose gradients are taken: 100 times the time of a march


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rays", type=int, default=100_000, help="in all, over meshes, kinds and dtypes")
    parser.add_argument("--out", type=Path, default=Path("out/stress.json"))
    parser.add_argument("--cage", type=Path, action="append", default=[], help=".npz with V and T")
    parser.add_argument("--only", nargs="*", help="these meshes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=num_cores(), help="processes")
    args = parser.parse_args(argv)
    cases = {name: make(np.random.default_rng(args.seed)) for name, make in MESHES.items()}
    unknown = set(args.only or []) - set(cases)
    if unknown or args.rays < 1:
        raise ValueError(f"--only: no mesh {min(unknown)!r}" if unknown else "--rays must be >= 1")
    cases = {name: case for name, case in cases.items() if args.only is None or name in args.only}
    twice = {path.stem for path in args.cage} & set(cases)
    if twice or len({path.stem for path in args.cage}) < len(args.cage):
        raise ValueError("--cage: results go by the files' names, which another mesh has, too; rename them")
    cases |= {path.stem: Case(load_tets(path), chunk=256) for path in args.cage}
    rounds = -(-args.rays // (len(TOLERANCE) * len(RAYS) * sum(case.chunk for case in cases.values())))
    jobs = list(itertools.product(cases, TOLERANCE))
    results: dict[str, dict[str, Row]] = {name: {} for name in cases}
    spawn = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(args.workers, mp_context=spawn) as pool,
        tqdm(total=len(jobs), unit="job", disable=None) as bar,
    ):
        futures = {
            pool.submit(stress, cases[name], dtype, rounds, [args.seed, i]): (name, dtype)
            for i, (name, dtype) in enumerate(jobs)
        }
        for future in as_completed(futures):
            name, dtype = futures[future]
            results[name][dtype] = row = future.result()
            bar.update()
            tqdm.write(f"{name:12s} {dtype}: " + ", ".join(f"{k} {v:.3g}" for k, v in row.items()))
    write_json(args.out, {"tolerance": TOLERANCE, "totals": (totals := total(results)), "meshes": results})
    print(f"{totals}\nwrote {args.out}")


def total(results: dict[str, dict[str, Row]]) -> dict[str, Any]:
    """Counts of all meshes together, and their largest errors by dtype."""
    rows = [row for by_dtype in results.values() for row in by_dtype.values()]
    names = ("rays", "lost", "doubled", "nonfinite", "overflow")
    counts = {key: sum(row[key] for row in rows) for key in names}
    errors = {
        key: {dtype: max(by_dtype[dtype][key] for by_dtype in results.values()) for dtype in TOLERANCE}
        for key in ("max_chord_error", "color_error")
    }
    return counts | errors


def stress(case: Case, dtype: str, rounds: int, seed: Any) -> Row:
    """Counts and errors of one mesh in one precision, `rounds` chunks of every kind of ray."""
    jax.config.update("jax_enable_x64", True)
    rng, mesh = np.random.default_rng(seed), build(case, dtype)
    march = MarchConfig(max_tets_per_ray=case.slots, max_entries_per_ray=32)
    solid, tolerance = solid_of(mesh), TOLERANCE[dtype]
    folded = bool(jnp.any(solid.geometry.signs < 0))
    row = dict(rays=0, lost=0, doubled=0, max_chord_error=0.0, color_error=0.0, nonfinite=0, overflow=0)
    unclear, colored = 0, 0
    for kind, turn in itertools.product(RAYS, range(rounds)):
        rays, lines = draw_rays(case, mesh, kind, rng)
        near = lines.near.astype(dtype)
        crossings, segments, walked = march_rays(mesh, rays, near, march)
        chords = walked if folded else lengths(segments)
        error = chord_errors(solid, lines, np.asarray(chords), tolerance, folded)
        wrong = np.abs(error) > tolerance
        repeated = wrong & False if folded else np.asarray(overlapping(segments, tolerance))
        row["rays"] += len(error)
        row["lost"] += int(np.sum(wrong & (error < 0)))
        row["doubled"] += int(np.sum((wrong & (error > 0)) | repeated))
        row["max_chord_error"] = max(row["max_chord_error"], float(np.nanmax(np.abs(error))))
        row["overflow"] += int(np.sum(segments.overflow))
        row["nonfinite"] += count_nonfinite(segments)
        few = np.arange(min(COLORED, len(error)))
        sigma = DENSITIES[turn % len(DENSITIES)]
        some_rays = jax.tree.map(lambda x, few=few: x[few], rays)
        some_crossings = jax.tree.map(lambda x, few=few: x[..., few], crossings)
        some_segments = locate(mesh, some_rays, some_crossings, near)
        first_crossings = jax.tree.map(lambda x: x[..., :DIFFERENTIATED], some_crossings)
        first_rays = jax.tree.map(lambda x: x[:DIFFERENTIATED], some_rays)
        gradients = color_gradients(mesh, first_rays, first_crossings, near, sigma)
        row["nonfinite"] += count_nonfinite(gradients)
        if not folded:
            errors = color_errors(mesh, solid, some_segments, take(lines, few), tolerance)
            row["color_error"] = max(row["color_error"], float(np.max(errors, initial=0)))
            unclear, colored = unclear + len(few) - len(errors), colored + len(few)
    _, empty, _ = march_rays(mesh, jax.tree.map(lambda x: x[:0], rays), near, march)
    row["nonfinite"] += count_nonfinite(empty)
    return row | {"unclear": unclear / max(colored, 1)}


def draw_rays(case: Case, mesh: TetMesh, kind: str, rng: np.random.Generator) -> tuple[Rays, Lines]:
    """Rays in the mesh's frame, rounded, and what they are in float64."""
    tets, dtype = np.asarray(case.geometry[1]), mesh.vertices.dtype
    vertices = np.asarray(mesh.vertices, np.float64)[: len(case.geometry[0])]
    origins, directions = RAYS[kind](vertices, tets, rng, case.chunk)
    center, scale = np.asarray(mesh.center, np.float64), np.float64(mesh.scale)
    if case.world_rays:
        origins = origins * scale + center
    rays = Rays(origins=jnp.asarray(origins, dtype), directions=jnp.asarray(unit(directions), dtype))
    exact = jax.tree.map(lambda x: x.astype(jnp.float64), rays)
    if case.world_rays:
        exact = exact.replace(origins=(exact.origins - center) / scale)
        rays = to_local(mesh, rays)
    reach = 1 + jnp.linalg.norm(exact.origins, axis=1)
    lines = Lines(
        origins=exact.origins,
        directions=exact.directions,
        near=jnp.float64(0 if kind in FROM_ORIGIN else BEHIND),
        margin=MARGIN[dtype.name] * float(jnp.finfo(dtype).eps) * reach,
    )
    return rays, lines


@partial(jax.jit, static_argnames="march")
def march_rays(
    mesh: TetMesh, rays: Rays, near: jax.Array, march: MarchConfig
) -> tuple[Crossings, TetSegments, jax.Array]:
    """Segments beyond `near`, in the mesh's frame, and their length, less what is walked backwards."""
    crossings = traverse(march_tables(mesh), rays, march)
    t_enter, t_exit = (jnp.maximum(crossings.ends[i].astype(jnp.float64), near) for i in (0, 3))
    walked = jnp.sum(jnp.where(crossings.codes >= 0, t_exit - t_enter, 0), axis=0)
    return crossings, locate_segments(mesh, rays, crossings, near), walked


locate = jax.jit(locate_segments)


@jax.jit
def lengths(segments: TetSegments) -> jax.Array:
    """Length of all segments of each ray, [R], summed in float64."""
    length = segments.t_exit.astype(jnp.float64) - segments.t_enter
    return jax.ops.segment_sum(length, segments.rays, segments.overflow.shape[0])


def palette(points: Any) -> Any:
    """A colour in [0, 1] for every point of the mesh's frame, linear: its value at vertices says it all."""
    x, y, z = (0.25 * points[..., i] for i in range(3))
    module = jnp if isinstance(points, jax.Array) else np
    return module.stack([0.5 + x + y, 0.5 + y - z, 0.5 + z - x], axis=-1)


@jax.jit
def segment_colors(mesh: TetMesh, segments: TetSegments, sigma: Any) -> jax.Array:
    """Colour and opacity [R, 4] of a mesh of constant density, coloured by its vertices."""
    colors = jax.lax.stop_gradient(palette(mesh.vertices))[mesh.tets[jnp.maximum(segments.tet_ids, 0)]]
    first, last = (
        sum(weights[..., i, None] * colors[..., i, :] for i in range(4))
        for weights in (segments.lambda_enter, segments.lambda_exit)
    )
    depth = sigma * (segments.t_exit - segments.t_enter)
    # Of the light of a segment of optical depth x, the mean place is 1/x - 1/(e^x - 1) of its length.
    thin, thick = jnp.minimum(depth, 1e-2), jnp.maximum(depth, 1e-2)
    place = 1 / thick - 1 / jnp.expm1(jnp.minimum(thick, 50))  # beyond, the second term is below rounding
    place = jnp.where(depth > 1e-2, place, 0.5 - thin / 12 + thin**3 / 720)[..., None]
    values = jnp.concatenate([first + place * (last - first), jnp.ones_like(place)], axis=-1)
    weights, count = sample_weights(depth, segments.rays), jnp.int32(len(depth))
    return sum_by_ray(weights, values, segments.rays, segments.overflow.shape[0], count)


@jax.jit
def color_gradients(mesh: TetMesh, rays: Rays, crossings: Crossings, near: jax.Array, sigma: float) -> Any:
    """Gradients of a colour, and of a number that depends on every output, in vertices and rays."""

    def value(vertices: jax.Array, rays: Rays) -> jax.Array:
        segments = locate_segments(mesh.replace(vertices=vertices), rays, crossings, near)
        ends = (segments.t_enter, segments.t_exit, segments.lambda_enter, segments.lambda_exit)
        values = [*ends, segment_colors(mesh, segments, sigma)]
        return sum(jnp.sum(jnp.sin(x)) for x in values)  # type: ignore[return-value]

    return jax.grad(value, argnums=(0, 1))(mesh.vertices, rays)


def count_nonfinite(tree: Any) -> int:
    """Floating-point values that are NaN or infinite."""
    leaves = [np.asarray(x) for x in jax.tree.leaves(tree)]
    return sum(int(np.sum(~np.isfinite(x))) for x in leaves if np.issubdtype(x.dtype, np.floating))


@jax.jit
def overlapping(segments: TetSegments, tolerance: float) -> jax.Array:
    """Rays on which a segment of some length begins before an earlier one has ended."""
    long = segments.t_exit - segments.t_enter > tolerance
    ends = jnp.where(long, segments.t_exit, -jnp.inf)
    goes_on = jnp.pad(segments.rays[1:] == segments.rays[:-1], (1, 0))

    def join(left: tuple, right: tuple) -> tuple:
        return jnp.where(right[1], jnp.maximum(left[0], right[0]), right[0]), left[1] & right[1]

    furthest, _ = jax.lax.associative_scan(join, (ends, goes_on))
    again = long[1:] & goes_on[1:] & (segments.t_enter[1:] < furthest[:-1] - tolerance)
    return jax.ops.segment_max(again, segments.rays[1:], segments.overflow.shape[0])


def chord_errors(
    solid: Solid, lines: Lines, ours: np.ndarray, tolerance: float, folded: bool = False
) -> np.ndarray:
    """Our chord minus the oracle's, [R], beyond what rounding can explain; < 0 where we lose."""
    seen = nudged(lines) if folded else lines
    expected = np.asarray(jnp.sum(tet_lengths(solid.geometry, seen), axis=1))
    error = ours - expected
    suspects = np.flatnonzero(~(np.abs(error) <= tolerance / 10))
    for group in np.split(suspects, range(GROUP, len(suspects), GROUP)) if suspects.size else []:
        part, count = take(lines, np.resize(group, GROUP)), len(group)  # one compiled shape
        if folded:
            slack = np.asarray(grazed(solid.geometry, part))[:count]
            low, high = expected[group] - slack, expected[group] + slack
        else:
            low, high = (np.asarray(x)[:count] for x in chord_range(pieces(solid, part)))
        error[group] = np.maximum(ours[group] - high, 0) - np.maximum(low - ours[group], 0)
    return error


def nudged(lines: Lines) -> Lines:
    """Lines aside of faces and edges, by less than rounding may move them: a tet holds them or not."""
    aside = jnp.cross(lines.directions, jnp.array([0.36, 0.48, 0.8]))
    return lines.replace(origins=lines.origins + lines.margin[:, None] / 4 * aside)


@jax.jit
def grazed(solid: Geometry, lines: Lines) -> jax.Array:
    """Length along which each line is near boundary faces, [R]."""
    low, high = face_intervals(solid, lines)
    return jnp.sum(jnp.where(low < high, high - low, 0), axis=1)


def take(lines: Lines, chosen: np.ndarray) -> Lines:
    """Some of the lines."""
    return lines.replace(
        origins=lines.origins[chosen], directions=lines.directions[chosen], margin=lines.margin[chosen]
    )


def color_errors(
    mesh: TetMesh, solid: Solid, segments: TetSegments, lines: Lines, tolerance: float
) -> np.ndarray:
    """Largest error over densities and channels, of the rays whose colour rounding does not change."""
    cut = pieces(solid, lines)
    clear, errors = np.ones(len(lines.origins), bool), np.zeros(len(lines.origins))
    for sigma in DENSITIES:
        ours = np.asarray(segment_colors(mesh, segments, sigma), np.float64)
        ends = np.stack(color_range(cut, lines, sigma, palette))
        low, high = ends.min(axis=0), ends.max(axis=0)
        clear &= np.all(high - low < tolerance, axis=1)
        beyond = np.maximum(ours - high, 0) + np.maximum(low - ours, 0)
        errors = np.maximum(errors, np.max(np.where(np.isfinite(ours), beyond, np.inf), axis=1))
    return errors[clear]


if __name__ == "__main__":
    run_cli(main)
