"""From vertices and tets to a TetMesh: adjacency, search trees, the cage's own frame. Host, float64."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.types import BoundaryFaces, TetMesh

Cage = tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "T 4"]]  # vertices and tets

_FACE_CORNERS = np.array(FACES)
TETS_PER_LEAF = 2
MAX_FACE_CLUSTERS = 1 << 15


def adjacency(tets: Int[np.ndarray, "T 4"]) -> Int[np.ndarray, "T 4"]:
    """The tet across the face opposite each corner, -1 outside.

    Raises ValueError where a face has three tets, or two on the same side of it.
    """
    as_seen = tets[:, _FACE_CORNERS].reshape(-1, 3)  # counter-clockwise, from outside of their tets
    faces = np.sort(as_seen, axis=1)
    order = np.lexsort(faces.T[::-1])
    ordered = faces[order]
    same = np.all(ordered[1:] == ordered[:-1], axis=1)
    if np.any(same[1:] & same[:-1]):
        first = order[np.flatnonzero(same[1:] & same[:-1])[0]]
        raise ValueError(
            f"tet {first // 4}: its face {tuple(faces[first].tolist())} belongs to more than two tets; "
            "split the mesh there or remove the duplicate tets"
        )
    neighbors = np.full(len(faces), -1, np.int32)
    left, right = order[:-1][same], order[1:][same]
    ascends = as_seen < np.roll(as_seen, -1, axis=1)
    even = ascends.sum(axis=1) == 2  # a cyclic permutation of the sorted corners
    if np.any(even[left] == even[right]):
        first = np.argmax(even[left] == even[right])
        raise ValueError(
            f"tets {left[first] // 4} and {right[first] // 4} lie on the same side of their common face "
            f"{tuple(faces[left[first]].tolist())}: the mesh is folded there, or has a tet twice; remesh it "
            "or remove the duplicate tets"
        )
    neighbors[left] = right // 4
    neighbors[right] = left // 4
    return neighbors.reshape(-1, 4)


def build_tet_mesh(
    vertices: Float[np.ndarray, "V 3"],
    tets: Int[np.ndarray, "T 4"],
    object_ids: Int[np.ndarray, " T"] | None = None,
    dtype: str = "float32",
    *,
    deformed: bool = False,
) -> TetMesh:
    """A TetMesh from world-space vertices and positively oriented tets.

    The mesh is stored relative to the centre of its bounding box and half the box's diagonal, computed in
    float64, so that float32 results depend neither on where the object stands nor on its size. Vertices that
    no tet uses do not count there. Raises ValueError for shapes, types, indices, non-finite vertices, as
    `adjacency`, and (naming the first) for inverted or flat tets, unless the mesh is `deformed`: then its
    tets were positively oriented once.
    """
    vertices = np.asarray(vertices, np.float64)
    tets = np.asarray(tets)
    if (
        vertices.ndim != 2
        or vertices.shape[1] != 3
        or tets.ndim != 2
        or tets.shape[1] != 4
        or not len(tets)
    ):
        raise ValueError(
            f"expected vertices [V,3] and tets [T,4], T >= 1; got {vertices.shape}, {tets.shape}"
        )
    if not np.issubdtype(tets.dtype, np.integer):
        raise ValueError(f"tets must be integers, got {tets.dtype}")
    if object_ids is not None and np.shape(object_ids) != (len(tets),):
        raise ValueError(f"expected an object id for each of {len(tets)} tets, got {np.shape(object_ids)}")
    if tets.min() < 0 or tets.max() >= len(vertices):
        bad = np.flatnonzero((tets < 0).any(1) | (tets >= len(vertices)).any(1))[0]
        raise ValueError(
            f"tet {bad} names vertex {tets[bad].tolist()}, but there are {len(vertices)} vertices"
        )
    if not np.isfinite(vertices).all():
        bad = np.flatnonzero(~np.isfinite(vertices).all(1))[0]
        raise ValueError(f"vertex {bad} is not finite: {vertices[bad]}")
    edges = vertices[tets[:, 1:]] - vertices[tets[:, :1]]
    inverted = np.flatnonzero(np.linalg.det(edges) <= 0)
    if inverted.size and not deformed:
        raise ValueError(
            f"{inverted.size} of {len(tets)} tets are inverted or flat (first: {inverted[0]}); "
            "call preprocess.validate.orient_tets, or remove flat tets"
        )
    used = vertices[np.unique(tets)]
    low, high = used.min(axis=0), used.max(axis=0)
    # As they are stored: what `dtype` rounds here is not lost, but in the local vertices.
    center = ((low + high) / 2).astype(dtype).astype(np.float64)
    scale = (np.linalg.norm(high - low) / 2).astype(dtype).astype(np.float64)
    local = (vertices - center) / scale
    neighbors = adjacency(tets)
    return TetMesh(
        vertices=jnp.asarray(local, dtype),
        tets=jnp.asarray(tets, jnp.int32),
        neighbors=jnp.asarray(neighbors),
        object_ids=jnp.asarray(
            np.zeros(len(tets)) if object_ids is None else object_ids, jnp.int32
        ),
        boundary=_boundary_faces(local, tets, neighbors),
        tet_leaves=jnp.asarray(_leaves(local[tets].mean(axis=1), TETS_PER_LEAF)),
        center=jnp.asarray(center, dtype),
        scale=jnp.asarray(scale, dtype),
    )


def build_in_frame(
    mesh: TetMesh,
    vertices: Float[np.ndarray, "V 3"],
    tets: Int[np.ndarray, "T 4"],
    object_ids: Int[np.ndarray, " T"] | None = None,
    *,
    deformed: bool = False,
) -> TetMesh:
    """`build_tet_mesh` of vertices in another mesh's frame, which stays: kept vertices keep their bits."""
    dtype = mesh.vertices.dtype
    built = build_tet_mesh(vertices, tets, object_ids, dtype.name, deformed=deformed)
    placed = jnp.asarray(vertices, dtype)
    return dataclasses.replace(built, vertices=placed, center=mesh.center, scale=mesh.scale)


def world_vertices(mesh: TetMesh) -> Float[np.ndarray, "V 3"]:
    """The mesh's vertices in world coordinates, float64."""
    return np.asarray(mesh.vertices, np.float64) * np.float64(mesh.scale) + np.asarray(
        mesh.center, np.float64
    )


def _boundary_faces(
    vertices: Float[np.ndarray, "V 3"],
    tets: Int[np.ndarray, "T 4"],
    neighbors: Int[np.ndarray, "T 4"],
) -> BoundaryFaces:
    tet_ids, local_faces = np.nonzero(neighbors < 0)
    width = -(-len(tet_ids) // MAX_FACE_CLUSTERS)
    face_vertices = tets[tet_ids[:, None], _FACE_CORNERS[local_faces]]
    leaves = _leaves(vertices[face_vertices].mean(axis=1), width)
    used = leaves >= 0
    return BoundaryFaces(
        tets=jnp.asarray(np.where(used, tet_ids[leaves], -1), jnp.int32),
        corners=jnp.asarray(np.where(used, local_faces[leaves], -1), jnp.int32),
    )


def _leaves(centroids: Float[np.ndarray, "N 3"], width: int) -> Int[np.ndarray, "leaves width"]:
    """Items in the leaves of a complete binary tree by median splits along the longest side; -1 pads.

    Level by level on equal-sized, padded groups: the tree's shape depends on the count alone.
    """
    count = len(centroids)
    num_leaves = 1 << max(0, int(np.ceil(np.log2(max(1, -(-count // width))))))
    groups = np.full((1, num_leaves * width), -1, np.int64)
    groups[0, :count] = np.arange(count)
    while len(groups) < num_leaves:
        points = np.where((groups >= 0)[..., None], centroids[groups], np.nan)
        with np.errstate(all="ignore"):
            spans = np.where(
                (groups >= 0).any(axis=1, keepdims=True),
                np.nanmax(np.where(np.isnan(points), -np.inf, points), axis=1)
                - np.nanmin(np.where(np.isnan(points), np.inf, points), axis=1),
                0.0,
            )
        axis = np.argmax(spans, axis=1)
        keys = np.take_along_axis(points, axis[:, None, None], axis=2)[..., 0]
        order = np.argsort(keys, axis=1, kind="stable")  # NaN, the padding, sorts last
        groups = np.take_along_axis(groups, order, axis=1)
        groups = _split_evenly(groups)
    return groups.astype(np.int32)


def _split_evenly(groups: Int[np.ndarray, "G N"]) -> Int[np.ndarray, "2G half"]:
    """Halve each sorted group so that both halves hold half of its used items, padding at their ends."""
    num_groups, size = groups.shape
    half = size // 2
    used = (groups >= 0).sum(axis=1)
    first = (used + 1) // 2
    columns = np.arange(half)
    left = np.where(columns < first[:, None], groups[:, :half], -1)
    source = np.minimum(first[:, None] + columns, size - 1)
    right = np.where(
        columns < (used - first)[:, None], np.take_along_axis(groups, source, axis=1), -1
    )
    return np.stack([left, right], axis=1).reshape(2 * num_groups, half)
