"""Stress the traversal: random and adversarial rays through awkward meshes, against a float64 oracle.

    python experiments/stress.py --rays=1000000 --out=out/stress.json
    python experiments/stress.py --cage=cage.npz          # a cage of your own besides the built-in meshes

For every mesh and dtype: `lost` and `doubled` count rays whose segments leave out or repeat more than the
tolerance of the line's part inside the mesh, `max_chord_error` is the largest difference of the two relative
to the mesh's size, `nonfinite` counts values and gradients that are not finite. The oracle clips each ray
against every tet's four planes in float64. Rounding the ray's own numbers moves a grazing ray's chord by any
amount, so the error is the distance to the chords of rays moved by a few units in the last place.
"""

import argparse
import itertools
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import Delaunay
from tqdm import tqdm

from nimpostor_jax.config import MarchConfig
from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.gin_flags import run_cli
from nimpostor_jax.io.mesh_files import load_tets
from nimpostor_jax.pipeline.evaluate import write_json
from nimpostor_jax.preprocess.topology import build_tet_mesh
from nimpostor_jax.preprocess.validate import orient_tets
from nimpostor_jax.render.segments import locate_segments
from nimpostor_jax.render.traverse import march_tables, traverse
from nimpostor_jax.types import Rays, TetMesh, TetSegments

Points = np.ndarray
Geometry = tuple[np.ndarray, np.ndarray]  # vertices [V, 3] and tets [T, 4], or origins and directions [R, 3]

TOLERANCE = {"float32": 1e-4, "float64": 1e-10}  # of the mesh's size
# Units in the last place by which the oracle's ray may be moved; the oracle, itself in float64, must see it.
PERTURBATION = {"float32": 32, "float64": 2048}
BEHIND = -1e3  # sizes of the mesh: no ray starts further away
GROUP = 32  # rays whose chords are sought again
CHUNK = 2048  # rays at a time: the oracle takes rays x tets
GRADIENT_EVERY = 4  # chunks of which one is differentiated


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rays", type=int, default=100_000, help="in all, over meshes, kinds and dtypes")
    parser.add_argument("--out", type=Path, default=Path("out/stress.json"))
    parser.add_argument("--cage", type=Path, action="append", default=[], help=".npz with V and T")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    meshes = {name: make(np.random.default_rng(args.seed)) for name, make in MESHES.items()}
    meshes |= {path.stem: load_tets(path) for path in args.cage}
    share = -(-args.rays // (len(meshes) * len(TOLERANCE) * len(RAYS) * CHUNK))
    results: dict[str, Any] = {}
    jobs = list(itertools.product(meshes, TOLERANCE))
    with tqdm(total=len(jobs) * len(RAYS) * share * CHUNK, unit="ray", unit_scale=True, disable=None) as bar:
        for name, dtype in jobs:
            rng = np.random.default_rng([args.seed, len(results)])
            row = stress(meshes[name], dtype, share, rng, bar.update)
            results.setdefault(name, {})[dtype] = row
            tqdm.write(f"{name:12s} {dtype}: " + ", ".join(f"{k} {v:.3g}" for k, v in row.items()))
    rows = [row for by_dtype in results.values() for row in by_dtype.values()]
    totals = {key: sum(row[key] for row in rows) for key in ("rays", "lost", "doubled", "nonfinite")}
    totals["max_chord_error"] = {
        dtype: max(by_dtype[dtype]["max_chord_error"] for by_dtype in results.values()) for dtype in TOLERANCE
    }
    write_json(args.out, {"tolerance": TOLERANCE, "totals": totals, "meshes": results})
    print(f"{totals}\nwrote {args.out}")


def stress(
    geometry: Geometry, dtype: str, chunks: int, rng: np.random.Generator, progress: Callable[[int], Any]
) -> dict[str, float]:
    """Counts and errors of one mesh in one precision, `chunks` chunks of every kind of ray."""
    mesh = build_tet_mesh(*geometry, dtype=dtype)
    vertices, tets = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.tets)
    march = MarchConfig(max_tets_per_ray=2 * len(tets), max_entries_per_ray=32)
    planes = tet_planes(vertices, tets)
    row = dict(rays=0, lost=0, doubled=0, max_chord_error=0.0, nonfinite=0, overflow=0)
    for kind, chunk in itertools.product(RAYS, range(chunks)):
        origins, directions = RAYS[kind](vertices, tets, rng, CHUNK)
        rays = Rays(origins=jnp.asarray(origins, dtype), directions=jnp.asarray(unit(directions), dtype))
        segments = march_rays(mesh, rays, march)
        error = chord_errors(planes, rays, segments, TOLERANCE[dtype])
        wrong = np.abs(error) > TOLERANCE[dtype]
        row["rays"] += CHUNK
        row["lost"] += int(np.sum(wrong & (error < 0)))
        repeated = np.asarray(overlapping(segments, TOLERANCE[dtype]))
        row["doubled"] += int(np.sum((wrong & (error > 0)) | repeated))
        row["max_chord_error"] = max(row["max_chord_error"], float(np.nanmax(np.abs(error))))
        row["overflow"] += int(np.sum(segments.overflow))
        row["nonfinite"] += count_nonfinite(segments)
        if chunk % GRADIENT_EVERY == 0:
            row["nonfinite"] += count_nonfinite(segment_gradients(mesh, rays, march))
        progress(CHUNK)
    return row


@partial(jax.jit, static_argnames="march")
def march_rays(mesh: TetMesh, rays: Rays, march: MarchConfig) -> TetSegments:
    """Segments along the whole line, in the mesh's frame."""
    return locate_segments(mesh, rays, traverse(march_tables(mesh), rays, march), near=BEHIND)


@partial(jax.jit, static_argnames="march")
def segment_gradients(mesh: TetMesh, rays: Rays, march: MarchConfig) -> Any:
    """Gradients of a number that depends on every output, in vertices, origins and directions."""

    def total(vertices: jax.Array, rays: Rays) -> jax.Array:
        segments = march_rays(mesh.replace(vertices=vertices), rays, march)
        parts = (segments.t_enter, segments.t_exit, segments.lambda_enter, segments.lambda_exit)
        return sum(jnp.sum(jnp.sin(part)) for part in parts)

    return jax.grad(total, argnums=(0, 1))(mesh.vertices, rays)


def count_nonfinite(tree: Any) -> int:
    """Floating-point values that are NaN or infinite."""
    leaves = [np.asarray(x) for x in jax.tree.leaves(tree)]
    return sum(int(np.sum(~np.isfinite(x))) for x in leaves if np.issubdtype(x.dtype, np.floating))


@jax.jit
def overlapping(segments: TetSegments, tolerance: float) -> jax.Array:
    """Rays on which a segment of some length begins before an earlier one has ended."""
    long = segments.t_exit - segments.t_enter > tolerance
    before = jax.lax.cummax(jnp.where(long, segments.t_exit, -jnp.inf), axis=1)[:, :-1]
    return jnp.any(long[:, 1:] & (segments.t_enter[:, 1:] < before - tolerance), axis=1)


# ---- the oracle ------------------------------------------------------------------------------------------


def tet_planes(vertices: Points, tets: np.ndarray) -> jax.Array:
    """[T, 4, 4]: normals (into the tet) and offsets of each tet's faces, unit normals, float64."""
    corners = vertices[tets]
    faces = corners[:, np.array(FACES)]  # [T, face, 3, xyz]
    normals = np.cross(faces[:, :, 1] - faces[:, :, 0], faces[:, :, 2] - faces[:, :, 0])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    offsets = -np.sum(normals * faces[:, :, 0], axis=-1)
    inside = np.sum(normals * corners, axis=-1) + offsets  # of the opposite corner
    return jnp.asarray(np.concatenate([normals, offsets[..., None]], axis=-1) * np.sign(inside)[..., None])


def chord_errors(planes: jax.Array, rays: Rays, segments: TetSegments, tolerance: float) -> np.ndarray:
    """Our chord minus the oracle's, [R], as near as rays moved by rounding bring it; < 0 where we lose."""
    ours = np.asarray(jnp.sum((segments.t_exit - segments.t_enter).astype(jnp.float64), axis=1))
    origins, directions = (np.asarray(x, np.float64) for x in (rays.origins, rays.directions))
    error = ours - np.asarray(jnp.sum(tet_lengths(planes, origins, directions), axis=1))
    if np.any(np.abs(error) > tolerance / 10):  # rays in a face lie in both tets beside it
        error = ours - np.asarray(chords(planes, origins, directions))
    suspects = np.flatnonzero(np.abs(error) > tolerance / 10)
    for group in np.split(suspects, range(GROUP, len(suspects), GROUP)) if suspects.size else []:
        low, high = chord_range(planes, origins[group], directions[group], rays.origins.dtype)
        error[group] = np.maximum(ours[group] - high, 0) - np.maximum(low - ours[group], 0)
    return error


def chord_range(
    planes: jax.Array, origins: Points, directions: Points, dtype: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Chords that rounding can explain: of what all moved rays, and of what any of them has in the mesh.

    Rays are moved aside at their origin and at the mesh. Rounding moves every vertex on its own, so that of
    several faces in which a ray lies, each may be passed on either side.
    """
    count = len(origins)
    origins, directions = (np.resize(x, (GROUP, 3)) for x in (origins, directions))  # one compiled shape
    side = unit(np.cross(directions, np.eye(3)[np.argmin(np.abs(directions), axis=1)]))
    up = np.cross(directions, side)
    reach = 1 + np.linalg.norm(origins, axis=1, keepdims=True)
    shift = PERTURBATION[jnp.dtype(dtype).name] * float(jnp.finfo(dtype).eps) * reach
    moved = []
    angles = 0.1 + np.arange(16) * np.pi / 8  # 0.1: a moved ray must not lie in a face again
    for angle, (first, last) in itertools.product(angles, ((1, 1), (1, -1), (0, 1))):
        move = shift * (np.cos(angle) * side + np.sin(angle) * up)
        moved.append((origins + first * move, directions + (last - first) * move / reach))
    all_origins, all_directions = (np.stack(x) for x in zip(*moved, strict=True))
    common, total = covered(planes, all_origins, all_directions)
    return np.asarray(common)[:count], np.asarray(total)[:count]


@jax.jit
def covered(planes: jax.Array, origins: jax.Array, directions: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Length in the mesh for all, and for any, of several moved rays [moves, R, 3]: by sweeping along t."""
    low, high = jax.vmap(partial(tet_intervals, planes))(origins, directions)  # [moves, R, T]
    inside = high > low
    ends = jnp.stack([jnp.where(inside, low, jnp.inf), jnp.where(inside, high, jnp.inf)])
    steps = jnp.where(inside, jnp.array([1, -1]).reshape(2, 1, 1, 1), 0)
    at, step = (jnp.moveaxis(x, 2, 0).reshape(origins.shape[1], -1) for x in (ends, steps))
    at, step = jax.lax.sort((at, step), dimension=1, num_keys=1)
    rays_inside, length = jnp.cumsum(step, axis=1)[:, :-1], jnp.diff(at, axis=1)
    length = jnp.where(jnp.isfinite(at[:, 1:]), length, 0)
    parts = (jnp.sum(jnp.where(rays_inside >= n, length, 0), axis=1) for n in (origins.shape[0], 1))
    return tuple(parts)


def tet_intervals(
    planes: jax.Array, origins: jax.Array, directions: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Where each line is inside each tet, [R, T]: clipped by four planes; low >= high where it is nowhere."""
    low, high = -jnp.inf, jnp.inf
    for face in range(4):
        normal, offset = planes[:, face, :3], planes[:, face, 3]
        height = sum(origins[:, None, i] * normal[:, i] for i in range(3)) + offset
        slope = sum(directions[:, None, i] * normal[:, i] for i in range(3))
        flat = jnp.abs(slope) < 1e-15
        at = -height / jnp.where(flat, 1, slope)
        at = jnp.where(flat, jnp.where(height < 0, jnp.inf, -jnp.inf), at)
        low = jnp.maximum(low, jnp.where(slope > 0, at, jnp.where(flat, at, -jnp.inf)))
        high = jnp.minimum(high, jnp.where((slope < 0) & ~flat, at, jnp.inf))
    return low, high


@jax.jit
def tet_lengths(planes: jax.Array, origins: jax.Array, directions: jax.Array) -> jax.Array:
    """Length of each line inside each tet, [R, T]."""
    low, high = tet_intervals(planes, origins, directions)
    return jnp.where(high > low, high - low, 0)


@jax.jit
def chords(planes: jax.Array, origins: jax.Array, directions: jax.Array) -> jax.Array:
    """Length of each line inside the union of the tets, [R]."""
    low, high = tet_intervals(planes, origins, directions)
    empty = ~(high > low)
    low, high = jax.lax.sort((jnp.where(empty, jnp.inf, low), jnp.where(empty, -jnp.inf, high)), dimension=1)
    reached = jax.lax.cummax(high, axis=1)
    before = jnp.concatenate([jnp.full_like(reached[:, :1], -jnp.inf), reached[:, :-1]], axis=1)
    new = jnp.maximum(high - jnp.maximum(low, before), 0)
    return jnp.sum(jnp.where(jnp.isfinite(low), new, 0), axis=1)


# ---- meshes: (vertices [V, 3], tets [T, 4]) ----------------------------------------------------------------


def delaunay(points: Points) -> Geometry:
    """Positively oriented, without flat tets."""
    tets = Delaunay(points).simplices
    volumes = np.abs(np.linalg.det(points[tets[:, 1:]] - points[tets[:, :1]]))
    return points, orient_tets(tets[volumes > 0], points)


def kuhn_grid(size: int) -> Geometry:
    """Six tets in each cell of a cubic grid: every face lies in an axis-parallel or diagonal plane."""
    axis = np.arange(size + 1)
    vertices = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = np.stack(np.meshgrid(*[axis[:-1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    tets = []
    for order in itertools.permutations(range(3)):
        steps = np.concatenate([np.zeros((1, 3), int), np.cumsum(np.eye(3, dtype=int)[list(order)], axis=0)])
        corners = cells[:, None] + steps
        tets.append(np.ravel_multi_index(np.moveaxis(corners, -1, 0), [size + 1] * 3))
    points = vertices.astype(np.float64)
    return points, orient_tets(np.concatenate(tets), points)


def with_holes(rng: np.random.Generator) -> Geometry:
    """A grid from which a third of the tets is missing: many entries, pieces, and edges that only touch."""
    vertices, tets = kuhn_grid(3)
    return vertices, tets[rng.uniform(size=len(tets)) > 0.33]


MESHES: dict[str, Callable[[np.random.Generator], Geometry]] = {
    "one_tet": lambda rng: delaunay(rng.normal(size=(4, 3))),
    "cloud": lambda rng: delaunay(rng.normal(size=(25, 3))),
    "grid": lambda rng: kuhn_grid(3),
    "holes": with_holes,
    "pancake": lambda rng: delaunay(rng.normal(size=(25, 3)) * [1, 1, 1e-3]),
    "needle": lambda rng: delaunay(rng.normal(size=(25, 3)) * [1e-3, 1e-3, 1]),
    "far_away": lambda rng: delaunay(rng.normal(size=(25, 3)) + 1e4),
}


# ---- rays: origins and directions [R, 3] in the mesh's frame -----------------------------------------------


def unit(vectors: Points) -> Points:
    """Vectors of length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def points_inside(vertices: Points, tets: np.ndarray, rng: np.random.Generator, count: int) -> Points:
    """Random points of random tets."""
    corners = vertices[tets[rng.integers(0, len(tets), count)]]
    return np.einsum("ri,rix->rx", rng.dirichlet(np.ones(4), count), corners)


def towards(targets: Points, rng: np.random.Generator, distance: float = 3.0) -> Geometry:
    """From random sides through the targets."""
    directions = unit(rng.normal(size=targets.shape))
    return targets - distance * directions, directions


def random_face(vertices: Points, tets: np.ndarray, rng: np.random.Generator, count: int) -> Points:
    """Corners [R, 3, 3] of random faces."""
    chosen = tets[rng.integers(0, len(tets), count)]
    faces = np.array(FACES)[rng.integers(0, 4, count)]
    return vertices[np.take_along_axis(chosen, faces, axis=1)]


def along_edges(vertices: Points, tets: np.ndarray, rng: np.random.Generator, count: int) -> Geometry:
    """Along an edge, from beyond its end."""
    face = random_face(vertices, tets, rng, count)
    directions = unit(face[:, 1] - face[:, 0])
    return face[:, 0] - 2 * directions, directions


def in_faces(vertices: Points, tets: np.ndarray, rng: np.random.Generator, count: int) -> Geometry:
    """In the plane of a face, through its inside."""
    face = random_face(vertices, tets, rng, count)
    start, end = (np.einsum("ri,rix->rx", rng.dirichlet(np.ones(3), count), face) for _ in range(2))
    directions = unit(end - start)
    return start - 2 * directions, directions


def along_axes(vertices: Points, tets: np.ndarray, rng: np.random.Generator, count: int) -> Geometry:
    """Parallel to an axis, half of them through vertices; zeros in the direction have either sign."""
    points = points_inside(vertices, tets, rng, count)
    points[::2] = vertices[rng.integers(0, len(vertices), len(points[::2]))]
    signs = np.where(rng.uniform(size=(count, 3)) < 0.5, -1.0, 1.0)
    directions = np.eye(3)[rng.integers(0, 3, count)] * signs
    return points - 3 * directions, directions


RAYS: dict[str, Callable[..., Geometry]] = {
    "random": lambda v, t, rng, n: towards(points_inside(v, t, rng, n), rng),
    "from_inside": lambda v, t, rng, n: (points_inside(v, t, rng, n), unit(rng.normal(size=(n, 3)))),
    "from_afar": lambda v, t, rng, n: towards(points_inside(v, t, rng, n), rng, 100.0),
    "missing": lambda v, t, rng, n: towards(unit(rng.normal(size=(n, 3))) * 1.5, rng),
    "through_vertices": lambda v, t, rng, n: towards(v[rng.integers(0, len(v), n)], rng),
    "through_edges": lambda v, t, rng, n: towards(random_face(v, t, rng, n)[:, :2].mean(axis=1), rng),
    "along_edges": along_edges,
    "in_faces": in_faces,
    "along_axes": along_axes,
}


if __name__ == "__main__":
    run_cli(main)
