"""A new cage for an old field (Sec. 4.2): what still fits is kept to the last bit, the rest is trained anew.

Host code, float64 but for point location. Axes: V vertices, T tets of the new cage.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from nimpostor_jax.config import RenderConfig, RetrainConfig
from nimpostor_jax.edit.boolean import STEP, THRESHOLD
from nimpostor_jax.edit.region import with_region
from nimpostor_jax.edit.retrain import retrain
from nimpostor_jax.field import impostor as field
from nimpostor_jax.field.solids import CLOSED, MIXED, OPEN, is_kept, to_cells
from nimpostor_jax.geometry.locate import find_tets, locate, locate_tables
from nimpostor_jax.geometry.topology import build_in_frame, world_vertices
from nimpostor_jax.types import NeuralImpostor, TetMesh

_SAME = 1e-6  # in the mesh's frame: how far apart vertices are the same
_INSIDE = 1e-6  # in the mesh's frame: how far beyond a face rounding may put a corner
_PROBES = 1 << 16
_LOOKS, _POINTS_A_LOOK = 32, 64  # into tets of which perhaps nothing is left, until something is found


class Overlay(NamedTuple):
    """Where a new cage's tets lie in an old cage."""

    tets: Int[np.ndarray, " T"]  # the old tet that holds the whole new one, or -1
    lambdas: Float[np.ndarray, "T 4 4"]  # of the new tet's corners in it
    nearest: Int[np.ndarray, " T"]  # the old tet at its middle, or the nearest


def transfer(
    old: NeuralImpostor,
    vertices: Float[np.ndarray, "V 3"],
    tets: Int[np.ndarray, "T 4"],
    render: RenderConfig,
    config: RetrainConfig,
    log: Callable[[str], None] = print,
) -> NeuralImpostor:
    """The old impostor, as it stands, in a new cage of world-space vertices and positively oriented tets.

    New tets within an old one (kept or cut ones) go on in its field, exactly; the others get tables and
    decoders of their own and two-stage retraining. `render` is that of training. Where the old cage overlaps
    itself, only tets of the same vertices go on; others learn what pictures show, from either layer's field.

    Raises:
        ValueError: a bad mesh, live operations or several objects in the impostor, cages that do not overlap,
            or more than `config.max_lost_share` of what the old field shows outside of the new cage.
    """
    if old.gates or old.paints:
        raise ValueError("consolidate live operations (gates, paints) before the impostor is remeshed")
    mesh = old.mesh
    if len(np.unique(np.asarray(mesh.object_ids))) > 1:
        raise ValueError("the impostor has several objects: remesh them one by one, and compose the results")
    local = (np.asarray(vertices, np.float64) - np.asarray(mesh.center)) / np.float64(mesh.scale)
    twins = twins_of(mesh, local)
    # Vertices that are the old ones keep their bits.
    local = np.where(twins[:, None] >= 0, np.asarray(mesh.vertices, np.float64)[twins], local)
    new_mesh = build_in_frame(mesh, local, tets)
    lost = lost_share(old, new_mesh)
    log(f"{lost:.3%} of what the field shows lies outside the new cage")
    if lost > config.max_lost_share:
        raise ValueError(
            f"{lost:.2%} of what the old field shows lies outside the new cage, more than "
            f"RetrainConfig.max_lost_share = {config.max_lost_share:.2%}; enlarge the cage or raise the limit"
        )
    over = overlay(old, local, np.asarray(tets))
    cells = np.where(over.tets >= 0, _cells(old, over.tets), -1)
    lambdas = over.lambdas
    if old.embedding is not None:
        lambdas = lambdas @ np.asarray(old.embedding.lambdas, np.float64)[np.maximum(over.tets, 0)]
    new, region = with_region(old, new_mesh, cells, lambdas, _cells(old, over.nearest))
    if old.rest_vertices is not None:
        new = dataclasses.replace(new, rest_vertices=_at_rest(old, local, np.asarray(tets), over))
    log(f"{len(tets)} tets, {region.tets.size} of them to be trained")
    return retrain(old, new, region, render, config, log)


def consolidate(
    live: NeuralImpostor,
    render: RenderConfig,
    config: RetrainConfig,
    log: Callable[[str], None] = print,
) -> NeuralImpostor:
    """The result of live operations as a plain field (Eq. 15): no gates, no paints, only what is seen.

    Tets that gates close are taken away, those that are cut or painted are trained anew, all others stay as
    they are. Raises ValueError where everything is hidden.
    """
    if not live.gates and not live.paints:
        return live
    mesh, tets = live.mesh, np.asarray(live.mesh.tets)
    closed, cut, painted = (np.zeros(len(tets), bool) for _ in range(3))
    for gate in live.gates:
        closed |= np.asarray(gate.states) == CLOSED
        cut |= np.asarray(gate.states) == MIXED
    for paint in live.paints:
        painted |= np.asarray(paint.states) != OPEN
    shown = ~closed & ~_empty_of(live, cut)
    if not shown.any():
        raise ValueError("the operation hides everything: there is nothing to consolidate")
    cut = (cut | painted)[shown]
    used, inverse = np.unique(tets[shown], return_inverse=True)
    new_mesh = build_in_frame(
        mesh,
        np.asarray(mesh.vertices)[used],
        inverse.reshape(-1, 4),
        np.asarray(mesh.object_ids)[shown],
        deformed=True,
    )
    old_cells = _cells(live, np.flatnonzero(shown))
    places = np.broadcast_to(np.eye(4), (shown.sum(), 4, 4))
    if live.embedding is not None:
        places = np.asarray(live.embedding.lambdas, np.float64)[shown]
    new, region = with_region(live, new_mesh, np.where(cut, -1, old_cells), places, old_cells)
    # Objects may overlap: where a point is in the old mesh is known, and must not be sought.
    region = dataclasses.replace(region, sources=jnp.asarray(np.flatnonzero(shown)[cut], jnp.int32))
    if live.rest_vertices is not None:
        new = dataclasses.replace(new, rest_vertices=live.rest_vertices[used])
    log(f"{shown.sum()} of {len(tets)} tets remain, {region.tets.size} of them to be trained")
    return retrain(live, new, region, render, config, log)


def _empty_of(live: NeuralImpostor, cut: Bool[np.ndarray, " T"]) -> Bool[np.ndarray, " T"]:
    """Tets that are cut, and of which a cloud of points finds nothing left."""
    rng = np.random.default_rng(0)
    left = np.zeros(len(cut), bool)
    rows = np.flatnonzero(cut)
    test = jax.jit(is_kept)
    for _ in range(_LOOKS):
        rows = np.resize(rows[~left[rows]], len(rows)) if not left[rows].all() else rows[:0]
        if not len(rows):
            break
        many = np.tile(rows, _POINTS_A_LOOK)
        lambdas = jnp.asarray(rng.dirichlet(np.ones(4), len(many)), live.mesh.vertices.dtype)
        tets = jnp.asarray(many, jnp.int32)
        kept = np.asarray(test(live, tets, to_cells(live.embedding, tets, lambdas)[1]))
        left[many[kept]] = True
    return cut & ~left


def _cells(impostor: NeuralImpostor, tets: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """The cells of tets (of tet 0 where there is none)."""
    held = np.maximum(tets, 0)
    return held if impostor.embedding is None else np.asarray(impostor.embedding.cells)[held]


def twins_of(mesh: TetMesh, local: Float[np.ndarray, "V 3"]) -> Int[np.ndarray, " V"]:
    """The mesh's vertex at each point of its frame, or -1."""
    distance, nearest = cKDTree(np.asarray(mesh.vertices, np.float64)).query(local)
    return np.where(distance < _SAME, nearest, -1)


def overlay(
    old: NeuralImpostor, local: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"]
) -> Overlay:
    """Which new tets lie within single old ones, as both stand; vertices in the old mesh's frame.

    Tets of the same vertices are the same, also where the old cage overlaps itself. Others do not count as
    within one of two there.
    """
    corners = local[tets]
    middles = corners.mean(axis=1)
    old_tets = np.asarray(old.mesh.tets)
    old_corners = np.asarray(old.mesh.vertices, np.float64)[old_tets]
    same = _same_tets(old_tets, twins_of(old.mesh, local)[tets])
    found = np.where(same >= 0, same, _located(old.mesh, middles))
    _, near = cKDTree(old_corners.mean(axis=1)).query(middles)
    nearest = np.where(found >= 0, found, near)
    unclear = (same < 0) & _overlapping(old.mesh, old_corners)[nearest]
    lambdas, lengths, flat = _coordinates(old_corners[nearest], corners)
    off = np.abs(lambdas - np.rint(lambdas)) * lengths[:, None]  # as distances
    lambdas = np.where(off < _INSIDE, np.rint(lambdas), lambdas)
    within = (found >= 0) & ~flat & ~unclear & np.all(lambdas >= 0, axis=(1, 2))
    return Overlay(tets=np.where(within, nearest, -1), lambdas=lambdas, nearest=nearest)


def _coordinates(
    corners: Float[np.ndarray, "n 4 3"], points: Float[np.ndarray, "n k 3"]
) -> tuple[Float[np.ndarray, "n k 4"], Float[np.ndarray, "n 4"], Bool[np.ndarray, " n"]]:
    """Points in the coordinates of a tet each; what a unit of these is as a distance; which tets are flat."""
    edges = corners[:, 1:] - corners[:, :1]  # [n, 3, 3], rows are edges
    flat = np.abs(np.linalg.det(edges)) <= 0
    slopes = np.linalg.inv(np.where(flat[:, None, None], np.eye(3), edges))
    # [n, 3, 4]: columns are the gradients of the coordinates
    slopes = np.concatenate([-slopes.sum(axis=2, keepdims=True), slopes], axis=2)
    lambdas = np.einsum("nkx,nxe->nke", points - corners[:, :1], slopes)
    lambdas[:, :, 0] += 1
    return lambdas, 1 / np.linalg.norm(slopes, axis=1), flat


def _overlapping(mesh: TetMesh, corners: Float[np.ndarray, "O 4 3"]) -> Bool[np.ndarray, " O"]:
    """Upright tets of which a sample (the middle, half-way to a corner) is in another upright one, and those.

    A sliver that a deformation turned inside out is no fold: its place is that of its neighbours.
    """
    middles = corners.mean(axis=1, keepdims=True)
    samples = np.concatenate([middles, (middles + corners) / 2], axis=1).reshape(-1, 3)
    owners, others = np.arange(len(corners)).repeat(5), _located(mesh, samples)
    upright = np.linalg.det(corners[:, 1:] - corners[:, :1]) > 0
    rows = np.flatnonzero((others >= 0) & (others != owners) & upright[owners] & upright[others])
    lambdas, lengths, _ = _coordinates(corners[others[rows]], samples[rows, None])
    rows = rows[np.all(lambdas[:, 0] * lengths > _INSIDE, axis=1)]  # not by a rounding
    overlapping = np.zeros(len(corners), bool)
    overlapping[owners[rows]] = overlapping[others[rows]] = True
    return overlapping


def _same_tets(old: Int[np.ndarray, "O 4"], new: Int[np.ndarray, "T 4"]) -> Int[np.ndarray, " T"]:
    """The old tet of the same four vertices, or -1; new tets name old vertices, or -1."""
    rows = np.sort(np.concatenate([old, new]), axis=1)
    _, kinds = np.unique(rows, axis=0, return_inverse=True)
    tet_of = np.full(kinds.max() + 1, -1)
    kinds = kinds.reshape(-1)  # NumPy 2.0 keeps the axis
    tet_of[kinds[: len(old)]] = np.arange(len(old))
    return tet_of[kinds[len(old) :]]


def _located(mesh: TetMesh, local: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """The mesh's tets that hold points of its frame, or -1."""
    return np.asarray(find_tets(locate_tables(mesh), jnp.asarray(local, mesh.vertices.dtype)))


def _at_rest(
    old: NeuralImpostor, local: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"], over: Overlay
) -> jnp.ndarray:
    """Where vertices were before the old cage moved: those that are new, by the old tet around them."""
    owner, around = np.zeros(len(local), int), _located(old.mesh, local)
    owner[tets.reshape(-1)] = np.repeat(over.nearest, 4)
    owner = np.where(around >= 0, around, owner)
    kept = over.tets >= 0
    owner[tets[kept].reshape(-1)] = np.repeat(over.tets[kept], 4)
    old_tets = np.asarray(old.mesh.tets)
    moved, rest = (
        np.asarray(x, np.float64)[old_tets[owner]] for x in (old.mesh.vertices, old.rest_vertices)
    )  # [V, 4, 3]
    inverse = np.linalg.pinv(moved[:, 1:] - moved[:, :1])
    weights = np.einsum("vx,vxe->ve", local - moved[:, 0], inverse)
    placed = rest[:, 0] + np.einsum("ve,vex->vx", weights, rest[:, 1:] - rest[:, :1])
    twins = twins_of(old.mesh, local)
    tet, corner = np.nonzero(kept[:, None] & (over.lambdas.max(axis=2) == 1))
    # Of vertices that have come to lie together, the one whose tet is kept
    twins[tets[tet, corner]] = old_tets[over.tets[tet], over.lambdas[tet, corner].argmax(axis=1)]
    placed = np.where(twins[:, None] >= 0, np.asarray(old.rest_vertices)[twins], placed)
    return jnp.asarray(placed, old.mesh.vertices.dtype)


def lost_share(old: NeuralImpostor, new_mesh: TetMesh, threshold: float = THRESHOLD) -> float:
    """Share of the volume that the old field fills (Eq. 13) but the new cage does not hold, by points."""
    rng = np.random.default_rng(0)
    corners = world_vertices(old.mesh)[np.asarray(old.mesh.tets)]
    volumes = np.maximum(np.linalg.det(corners[:, 1:] - corners[:, :1]), 0)
    tets = rng.choice(len(volumes), _PROBES, p=volumes / volumes.sum())
    lambdas = rng.dirichlet(np.ones(4), _PROBES)
    points = np.einsum("nc,ncx->nx", lambdas, corners[tets])
    dtype = old.mesh.vertices.dtype
    cells, places = to_cells(old.embedding, jnp.asarray(tets, jnp.int32), jnp.asarray(lambdas, dtype))
    filled = np.asarray(_densities(old, cells, places)) * STEP > threshold
    outside = np.asarray(locate(new_mesh, jnp.asarray(points, dtype))[0]) < 0
    if outside.all():
        raise ValueError("the new cage does not overlap the old one; are both in the same world coordinates?")
    return float(np.sum(filled & outside)) / max(int(np.sum(filled)), 1)


@jax.jit
def _densities(impostor: NeuralImpostor, cells: jax.Array, places: jax.Array) -> jax.Array:
    return field.density(impostor, cells, field.features(impostor, cells, places))
