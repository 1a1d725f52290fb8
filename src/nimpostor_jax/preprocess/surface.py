"""Input surfaces: reading, and refusing empty, non-finite, open or self-intersecting ones.

An open surface has no inside. A closed one that crosses itself does have an outside, and an
envelope around all that the outside does not reach is well defined, but what the surface means as a
solid is not: it takes the caller's word (`allow_self_intersections`).
"""

from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int


def load_surface(path: str | Path) -> trimesh.Trimesh:
    """Read a triangle surface and merge the vertices that coincide (texture seams, split normals).

    Triangles that this leaves with two corners are dropped (quads at the poles of a sphere).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: trimesh cannot read it, or it has no triangles.
    """
    path = Path(path)
    check_exists(path, "surface")
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # trimesh raises whatever its many readers raise
        raise ValueError(
            f"{path}: not a surface that trimesh can read ({error}); use OBJ, PLY or STL"
        ) from error
    faces = np.asarray(getattr(mesh, "faces", np.empty((0, 3))))
    if len(faces) == 0:
        raise ValueError(f"{path}: there are no triangles in it; give a triangle surface mesh")
    surface = trimesh.Trimesh(np.asarray(mesh.vertices, np.float64), faces, process=False)
    surface.merge_vertices(merge_tex=True, merge_norm=True)
    corners = np.sort(surface.faces, axis=1)
    surface.update_faces((corners[:, 1:] != corners[:, :-1]).all(axis=1))
    return surface


def check_exists(path: Path, what: str) -> None:
    """Raise FileNotFoundError, with what is there instead, unless `path` is a file."""
    if not path.is_file():
        found = (
            sorted(p.name for p in path.parent.glob(f"*{path.suffix}"))
            if path.parent.is_dir()
            else []
        )
        beside = f"there is {', '.join(found[:5])}" if found else "the folder has none"
        raise FileNotFoundError(f"{path}: no such {what} file; of this suffix, {beside}")


def check_surface(
    surface: trimesh.Trimesh, source: str = "surface", allow_self_intersections: bool = False
) -> None:
    """Raise ValueError, naming `source`, unless a surface is finite, closed and without crossings.

    Closed: every edge has an even number of triangles; where closed parts touch along one, it is four.
    Triangles that are there twice, as walls of two sides, do not close anything.
    Crossings are transversal ones (an edge through the inside of a triangle); coincident coplanar
    triangles are not looked for.
    """
    vertices, faces = np.asarray(surface.vertices), np.asarray(surface.faces)
    if len(vertices) == 0 or len(faces) == 0:
        raise ValueError(
            f"{source}: the surface is empty ({len(vertices)} vertices, {len(faces)} triangles)"
        )
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        raise ValueError(
            f"{source}: {int(bad.sum())} non-finite vertices (first: {int(np.argmax(bad))}); "
            "repair the mesh"
        )
    single, times = np.unique(np.sort(faces, axis=1), axis=0, return_counts=True)
    single = single[times % 2 == 1]
    if len(single) == 0:
        raise ValueError(
            f"{source}: the surface is not closed: all of its triangles are there twice; give it a "
            "thickness, or build the cage from images"
        )
    edges = single[:, [[0, 1], [0, 2], [1, 2]]].reshape(-1, 2)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    open_edges = counts % 2 == 1
    if open_edges.any():
        first = unique[np.argmax(open_edges)].tolist()
        raise ValueError(
            f"{source}: the surface is not closed: {int((counts == 1).sum())} boundary edges "
            f"and {int((open_edges & (counts > 2)).sum())} edges with three or more (first: {first}); "
            "close its holes (for example with a remesher), or build the cage from images"
        )
    if allow_self_intersections:
        return
    crossing = self_intersections(vertices, faces)
    if len(crossing):
        raise ValueError(
            f"{source}: the surface intersects itself in {len(crossing)} pairs of triangles "
            f"(first: {crossing[0].tolist()}); unite its parts (Boolean union, voxel remesh), or "
            "pass allow_self_intersections=True to enclose all that it cuts off from the outside"
        )


def self_intersections(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Int[np.ndarray, "pairs 2"]:
    """Pairs of triangles of which an edge of one passes through the inside of the other."""
    pairs = _box_pairs(vertices, faces)
    crossing = np.zeros(len(pairs), bool)
    for first, second in ((0, 1), (1, 0)):
        triangle = faces[pairs[:, second]]
        for edge in ((0, 1), (1, 2), (2, 0)):
            ends = faces[pairs[:, first]][:, edge]
            apart = ~(ends[:, :, None] == triangle[:, None, :]).any(axis=(1, 2))
            crossing |= apart & _pierces(vertices[ends], vertices[triangle])
    return np.sort(pairs[crossing], axis=1)


def _pierces(
    segments: Float[np.ndarray, "pairs 2 3"], triangles: Float[np.ndarray, "pairs 3 3"]
) -> Bool[np.ndarray, " pairs"]:
    p, q = segments[:, 0], segments[:, 1]
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    sides = np.stack([_orientation(p, q, a, b), _orientation(p, q, b, c), _orientation(p, q, c, a)])
    through = (sides > 0).all(axis=0) | (sides < 0).all(axis=0)
    return through & (_orientation(a, b, c, p) * _orientation(a, b, c, q) < 0)


def _orientation(*corners: Float[np.ndarray, "pairs 3"]) -> Float[np.ndarray, " pairs"]:
    a, b, c, d = corners
    return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)


def _box_pairs(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Int[np.ndarray, "pairs 2"]:
    """Pairs of triangles with overlapping boxes, by a descent in a binary tree in Morton order."""
    corners = vertices[faces]
    order = np.argsort(_morton(corners.mean(axis=1)), kind="stable")
    depth = int(np.ceil(np.log2(max(len(faces), 2))))
    padding = ((0, (1 << depth) - len(faces)), (0, 0))
    # Padded leaves are inside out, so that they overlap nothing.
    lower = [np.pad(corners[order].min(axis=1), padding, constant_values=np.inf)]
    upper = [np.pad(corners[order].max(axis=1), padding, constant_values=-np.inf)]
    for _ in range(depth):
        lower.append(np.minimum(lower[-1][::2], lower[-1][1::2]))
        upper.append(np.maximum(upper[-1][::2], upper[-1][1::2]))
    pairs = np.zeros((1, 2), np.int64)
    children = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
    for low, high in zip(lower[-2::-1], upper[-2::-1], strict=True):
        pairs = (2 * pairs[:, None] + children).reshape(-1, 2)
        pairs = pairs[pairs[:, 0] <= pairs[:, 1]]
        i, j = pairs[:, 0], pairs[:, 1]
        pairs = pairs[((low[i] <= high[j]) & (low[j] <= high[i])).all(axis=1)]
    return order[pairs[pairs[:, 0] < pairs[:, 1]]]


def _morton(points: Float[np.ndarray, "points 3"]) -> Int[np.ndarray, " points"]:
    """Interleaved bits of the coordinates on a grid of 1024 cells a side."""
    extent = max(float(np.ptp(points, axis=0).max()), np.finfo(float).tiny)
    cells = np.minimum((points - points.min(axis=0)) / extent * 1024, 1023).astype(np.int64)
    code = np.zeros(len(points), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code
