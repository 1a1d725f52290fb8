"""Boolean operations on impostors and patterns (Sec. 4.3, Eqs. 13 and 14), live: nothing is trained.

What an operation removes is hidden by gates, decided first for whole tets and then, in tets that are cut, for
single samples. Gates follow the cage when it moves, so that results can be deformed, composed and saved.
`remesh.consolidate` turns a live result into a plain field.

Each operand's own density stays as it is where it is kept. A point counts as filled where the optical depth
of one sampling step exceeds `threshold`: densities are per barycentric unit, and thin haze should not cut.
"""

import dataclasses
import itertools
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.edit.compose import compose, object_tets
from nimpostor_jax.field.solids import CLOSED, MIXED, OPEN
from nimpostor_jax.geometry.topology import build_in_frame, world_vertices
from nimpostor_jax.types import FunctionSolid, Gate, GridSolid, ImpostorSolid, NeuralImpostor, Solid

Choice = Literal["first", "second", "blend"]
STEP = 0.125  # in barycentric units, a sixteenth of a way across a tet
THRESHOLD = 0.02  # optical depth of a step of `STEP`
COARSE_CELLS = 64  # a side, of the grid on which tets are told apart


def union(
    a: NeuralImpostor, b: NeuralImpostor, *, color: Choice = "blend", threshold: float = THRESHOLD
) -> NeuralImpostor:
    """What either fills. Where both do, the field is the first's, the second's, or both, by density.

    `threshold`, in all of these: the optical depth of a step above which a point counts as filled. Raises
    ValueError for another choice, a threshold below 0, and as `compose.compose`.
    """
    _check_choice(color)
    if color == "first":
        b = gated(b, solid_of(a, threshold), keep_inside=False)
    elif color == "second":
        a = gated(a, solid_of(b, threshold), keep_inside=False)
    return compose([a, b])


def intersection(
    a: NeuralImpostor,
    b: NeuralImpostor | Solid,
    *,
    color: Choice = "first",
    threshold: float = THRESHOLD,
) -> NeuralImpostor:
    """What both fill, with the first's field, the second's, or both, by density (of impostors only).

    Raises ValueError as `union`, and for a pattern (a solid) where its field is asked for: it has none.
    """
    _check_choice(color)
    if not isinstance(b, NeuralImpostor):
        if color != "first":
            raise ValueError(f"a pattern has no field to take: color must be 'first', got {color!r}")
        return gated(a, b, keep_inside=True)
    ours, theirs = solid_of(a, threshold), solid_of(b, threshold)
    first, second = gated(a, theirs, keep_inside=True), gated(b, ours, keep_inside=True)
    if color == "blend":
        return compose([first, second])
    return first if color == "first" else second


def difference(
    a: NeuralImpostor, b: NeuralImpostor | Solid, *, threshold: float = THRESHOLD
) -> NeuralImpostor:
    """What the first fills and the second, an impostor or a pattern, does not. Errors as in `union`."""
    solid = solid_of(b, threshold) if isinstance(b, NeuralImpostor) else b
    return gated(a, solid, keep_inside=False)


def symmetric_difference(
    a: NeuralImpostor, b: NeuralImpostor, *, threshold: float = THRESHOLD
) -> NeuralImpostor:
    """What one fills and the other does not. Errors as in `union`."""
    return compose([difference(a, b, threshold=threshold), difference(b, a, threshold=threshold)])


def _check_choice(color: str) -> None:
    if color not in ("first", "second", "blend"):
        raise ValueError(f"color must be 'first', 'second' or 'blend', got {color!r}")


def solid_of(impostor: NeuralImpostor, threshold: float = THRESHOLD) -> ImpostorSolid:
    """The solid that an impostor fills, as it stands. Raises ValueError for a threshold below 0.

    Objects may overlap each other. Where an object overlaps itself, after a fold, one of its tets there is
    asked, whichever `locate` finds.
    """
    if not threshold >= 0:
        raise ValueError(f"threshold must be >= 0, got {threshold}")
    mesh = impostor.mesh
    vertices, tets = np.asarray(mesh.vertices), np.asarray(mesh.tets)
    ids = [object_tets(impostor, i) for i in np.unique(np.asarray(mesh.object_ids))]
    objects = []
    for chosen in ids:
        used, inverse = np.unique(tets[chosen], return_inverse=True)
        objects.append(build_in_frame(mesh, vertices[used], inverse.reshape(-1, 4), deformed=True))
    return ImpostorSolid(
        impostor=impostor,
        objects=tuple(objects),
        tet_ids=tuple(jnp.asarray(chosen, jnp.int32) for chosen in ids),
        threshold=jnp.asarray(threshold / STEP, mesh.vertices.dtype),
    )


def gated(impostor: NeuralImpostor, solid: Solid, *, keep_inside: bool) -> NeuralImpostor:
    """The impostor without what lies outside (or inside) a solid, both as they stand in the world."""
    corners, full, empty = fixed_to(impostor, solid)
    kept, hidden = (full, empty) if keep_inside else (empty, full)
    states = jnp.asarray(np.select([hidden, kept], [CLOSED, OPEN], MIXED), jnp.int32)
    gate = Gate(solid=solid, corners=corners, states=states, inside=keep_inside)
    return dataclasses.replace(impostor, gates=(*impostor.gates, gate))


def fixed_to(
    impostor: NeuralImpostor, solid: Solid
) -> tuple[Float[Array, "T 4 3"], Bool[np.ndarray, " T"], Bool[np.ndarray, " T"]]:
    """World corners of each tet's cell, and which tets are surely inside of a solid, and outside."""
    mesh = impostor.mesh
    corners = world_vertices(mesh)[np.asarray(mesh.tets)]
    full, empty = settled_tets(solid, corners)
    if impostor.embedding is not None:  # from corners of tets to those of their cells
        corners = np.linalg.solve(np.asarray(impostor.embedding.lambdas, np.float64), corners)
    return jnp.asarray(corners, mesh.vertices.dtype), full, empty


def settled_tets(
    solid: Solid, corners: Float[np.ndarray, "T 4 3"]
) -> tuple[Bool[np.ndarray, " T"], Bool[np.ndarray, " T"]]:
    """Tets that are surely wholly inside, and wholly outside; by their bounding boxes."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    neither = np.zeros(len(corners), bool)
    if isinstance(solid, FunctionSolid):
        return neither, neither
    if isinstance(solid, GridSolid):
        return _settled_by_grid(solid, corners)
    filled = []
    for mesh in solid.objects:
        others = world_vertices(mesh)[np.asarray(mesh.tets)]
        filled.append((others.min(axis=1), others.max(axis=1)))
    box_low, box_high = (np.concatenate(side) for side in zip(*filled, strict=True))
    return neither, ~_touch(low, high, box_low, box_high)


def _settled_by_grid(
    solid: GridSolid, corners: Float[np.ndarray, "T 4 3"]
) -> tuple[Bool[np.ndarray, " T"], Bool[np.ndarray, " T"]]:
    """An interpolated value lies between those of the voxels around it."""
    to_grid = np.asarray(solid.world_to_grid, np.float64)
    values = np.pad(np.asarray(solid.values), 1, mode="edge")  # as far as a voxel's half beyond the centres
    places = corners @ to_grid[:, :3].T + to_grid[:, 3] + 1
    shape = np.array(values.shape)
    low = np.floor(places.min(axis=1) - 1e-3).astype(int)
    high = np.ceil(places.max(axis=1) + 1e-3).astype(int) + 1
    inside_grid = np.all((places.min(axis=1) >= 0.5) & (places.max(axis=1) <= shape - 1.5), axis=1)
    positive = _box_sums(values > 0, np.clip(low, 0, shape), np.clip(high, 0, shape))
    size = np.prod(np.clip(high, 0, shape) - np.clip(low, 0, shape), axis=1)
    return inside_grid & (positive == size), positive == 0


def _touch(
    low: Float[np.ndarray, "T 3"],
    high: Float[np.ndarray, "T 3"],
    box_low: Float[np.ndarray, "B 3"],
    box_high: Float[np.ndarray, "B 3"],
) -> Bool[np.ndarray, " T"]:
    """Whether boxes may meet any of the others, up to cells of a coarse grid: never all pairs."""
    origin, end = box_low.min(axis=0), box_high.max(axis=0)
    size = np.maximum((end - origin).max() / COARSE_CELLS, np.finfo(float).tiny)
    shape = np.maximum(np.ceil((end - origin) / size).astype(int), 1)
    counts = np.zeros(shape + 1, np.int64)
    first = np.clip(((box_low - origin) / size).astype(int), 0, shape - 1)
    last = np.clip(((box_high - origin) / size).astype(int), 0, shape - 1) + 1
    for sides in itertools.product((0, 1), repeat=3):  # +-1 at the corners of each range, then running sums
        picked = np.where(sides, last, first)
        np.add.at(counts, tuple(picked.T), (-1) ** sum(sides))
    occupied = counts.cumsum(0).cumsum(1).cumsum(2)[:-1, :-1, :-1] > 0
    margin = 1e-6 * size  # of rounding
    near_low = np.floor((low - margin - origin) / size).astype(int)
    near_high = np.floor((high + margin - origin) / size).astype(int) + 1
    near_low, near_high = np.clip(near_low, 0, shape), np.clip(near_high, 0, shape)
    return _box_sums(occupied, near_low, near_high) > 0


def _box_sums(
    flags: Bool[np.ndarray, "X Y Z"], low: Int[np.ndarray, "T 3"], high: Int[np.ndarray, "T 3"]
) -> Int[np.ndarray, " T"]:
    """How many flags are set in each range of cells."""
    sums = np.pad(flags.astype(np.int64), ((1, 0),) * 3).cumsum(0).cumsum(1).cumsum(2)
    total = np.zeros(len(low), np.int64)
    for sides in itertools.product((0, 1), repeat=3):
        picked = np.where(sides, high, low)
        total += (-1) ** (3 - sum(sides)) * sums[tuple(picked.T)]
    return total
