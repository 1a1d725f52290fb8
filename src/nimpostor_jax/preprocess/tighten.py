"""Pull a coarse cage tight around an object: fewer samples are spent on empty space.

A pattern search over the vertices: each tries to move inward or to smooth its surroundings, and a
move counts only where every required point stays inside, the tets keep their orientation and shape,
and the cage loses volume. Because the link of a vertex does not move, a required point that was in
the star of the vertex must be in it afterwards, which makes the test local and exact.
"""

import numpy as np
from jaxtyping import Float, Int

from nimpostor_jax.preprocess.validate import FACES, boundary_faces, points_near_tets

_MIN_QUALITY = 0.3  # mean ratio below which no move may push a tet (1 is regular)
_SMALLEST_STEP = 0.02  # of the mean edge
_INSIDE = -1e-9  # barycentric tolerance, rounding only


def tighten(
    vertices: Float[np.ndarray, "V 3"],
    tets: Int[np.ndarray, "T 4"],
    required: Float[np.ndarray, "points 3"],
    max_sweeps: int = 30,
) -> Float[np.ndarray, "V 3"]:
    """Vertices of a cage with the same tets, less volume and the `required` points still inside.

    Points that are outside at the start do not count. Deterministic.
    """
    vertices = np.array(vertices, np.float64)
    stars = _stars(tets, len(vertices))
    owned = _owned_points(required, vertices, tets)
    surface = boundary_faces(tets)
    neighbors = _surface_neighbors(surface, tets, len(vertices))
    on_surface = np.zeros(len(vertices), bool)
    on_surface[surface] = True
    edge = np.linalg.norm(vertices[tets[:, 0]] - vertices[tets[:, 1]], axis=1).mean()
    steps = np.full(len(vertices), 0.5)
    for _ in range(max_sweeps):
        active = np.flatnonzero(steps > _SMALLEST_STEP)
        if active.size == 0:
            break
        before = _volume(vertices, tets)
        for vertex in active.tolist():
            star = stars[vertex]
            moved = _try_moves(
                vertices,
                tets[star],
                vertex,
                neighbors[vertex],
                bool(on_surface[vertex]),
                steps[vertex] * edge,
                [required[owned[t]] for t in star],
            )
            if moved is None:
                steps[vertex] *= 0.5
                continue
            position, owner = moved
            vertices[vertex] = position
            steps[vertex] = min(1.5 * steps[vertex], 1.0)
            _hand_over(owned, star, owner)
            # The surroundings have changed: let them try again.
            around = np.unique(tets[star])
            steps[around] = np.maximum(steps[around], 2.0 * _SMALLEST_STEP)
        # While steps are still long, a sweep without progress only halves them.
        if np.median(steps) < 4.0 * _SMALLEST_STEP and _volume(vertices, tets) > 0.999 * before:
            break
    return vertices


def _try_moves(
    vertices: Float[np.ndarray, "V 3"],
    star: Int[np.ndarray, "star 4"],
    vertex: int,
    neighbors: Int[np.ndarray, " ring"],
    on_surface: bool,
    step: float,
    points: list[Float[np.ndarray, "points 3"]],
) -> tuple[Float[np.ndarray, " 3"], Int[np.ndarray, " points"]] | None:
    """The first acceptable move of one vertex, and the star's tet that then holds each point."""
    corners = vertices[star]
    slots = star == vertex
    old_quality, gradients = _quality(corners), _volume_gradients(corners, slots)
    old_volume = _volumes(corners).sum()
    floor = min(float(old_quality.min()), _MIN_QUALITY)
    toward_ring = vertices[neighbors].mean(axis=0) - vertices[vertex]
    directions = [toward_ring * min(1.0, step / max(float(np.linalg.norm(toward_ring)), 1e-300))]
    if on_surface:
        inward = -gradients.sum(axis=0)
        length = float(np.linalg.norm(inward))
        if length > 0:
            inward = inward * (step / length)
            directions = [inward, 0.7 * (inward + directions[0]), directions[0]]
    gathered = np.concatenate(points)
    for move in directions:
        corners = vertices[star]
        corners[slots] += move
        quality = _quality(corners)
        if quality.min() <= 0.0:
            continue
        volume = _volumes(corners).sum()
        better_shape = quality.min() > 1.05 * old_quality.min() and volume <= old_volume * (
            1 + 1e-12
        )
        smaller = on_surface and volume < old_volume * (1 - 1e-4) and quality.min() >= floor
        if not (better_shape or smaller):
            continue
        owner = _owners(gathered, corners)
        if (owner >= 0).all():
            return vertices[vertex] + move, owner
    return None


def _owners(
    points: Float[np.ndarray, "points 3"], corners: Float[np.ndarray, "star 4 3"]
) -> Int[np.ndarray, " points"]:
    """Tet of the star that holds each point; -1 where none does."""
    inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
    last = np.einsum("tij,ptj->pti", inverse, points[:, None] - corners[None, :, 0])
    lowest = np.minimum(last.min(axis=2), 1.0 - last.sum(axis=2))
    best = lowest.argmax(axis=1)
    return np.where(lowest[np.arange(len(points)), best] >= _INSIDE, best, -1)


def _hand_over(
    owned: list[Int[np.ndarray, " points"]],
    star: Int[np.ndarray, " star"],
    owner: Int[np.ndarray, " points"],
) -> None:
    gathered = np.concatenate([owned[t] for t in star])
    for slot, tet in enumerate(star):
        owned[tet] = gathered[owner == slot]


def _owned_points(
    required: Float[np.ndarray, "points 3"],
    vertices: Float[np.ndarray, "V 3"],
    tets: Int[np.ndarray, "T 4"],
) -> list[Int[np.ndarray, " points"]]:
    """Indices of the required points in each tet, each in one."""
    free = np.ones(len(required), bool)
    owned = []
    for index, weights in points_near_tets(required, vertices, tets):
        inside = index[(weights >= _INSIDE).all(axis=1) & free[index]]
        free[inside] = False
        owned.append(inside)
    return owned


def _stars(tets: Int[np.ndarray, "T 4"], count: int) -> list[Int[np.ndarray, " star"]]:
    """Tets around each vertex."""
    order = np.argsort(tets.reshape(-1), kind="stable")
    starts = np.searchsorted(tets.reshape(-1)[order], np.arange(count + 1))
    return [order[starts[v] : starts[v + 1]] // 4 for v in range(count)]


def _surface_neighbors(
    surface: Int[np.ndarray, "F 3"], tets: Int[np.ndarray, "T 4"], count: int
) -> list[Int[np.ndarray, " ring"]]:
    """Neighbours of each vertex: along the surface for a vertex on it, in space for the others."""
    rings: list[set[int]] = [set() for _ in range(count)]
    for face in surface.tolist():
        for corner in face:
            rings[corner].update(face)
    inner = {v for v in range(count) if not rings[v]}
    for tet in tets.tolist():
        for corner in inner.intersection(tet):
            rings[corner].update(tet)
    return [np.array(sorted(ring - {v}), np.int64) for v, ring in enumerate(rings)]


def _volumes(corners: Float[np.ndarray, "T 4 3"]) -> Float[np.ndarray, " T"]:
    edges = corners[:, 1:] - corners[:, :1]
    return np.einsum("ij,ij->i", np.cross(edges[:, 0], edges[:, 1]), edges[:, 2]) / 6.0


def _volume(vertices: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"]) -> float:
    return float(_volumes(vertices[tets]).sum())


def _volume_gradients(
    corners: Float[np.ndarray, "T 4 3"], slots: np.ndarray
) -> Float[np.ndarray, "T 3"]:
    """Gradient of each tet's volume with respect to the corner in `slots`."""
    local = np.argmax(slots, axis=1)
    a, b, c = (corners[np.arange(len(corners)), FACES[local, i]] for i in range(3))
    return -np.cross(b - a, c - a) / 6.0


def _quality(corners: Float[np.ndarray, "T 4 3"]) -> Float[np.ndarray, " T"]:
    """Mean ratio 12 (3 V)**(2/3) / (sum of squared edges): 1 if regular, negative if inverted."""
    volumes = 3.0 * _volumes(corners)
    squared = sum(
        ((corners[:, i] - corners[:, j]) ** 2).sum(axis=1) for i in range(4) for j in range(i)
    )
    return 12.0 * np.sign(volumes) * np.abs(volumes) ** (2.0 / 3.0) / squared
