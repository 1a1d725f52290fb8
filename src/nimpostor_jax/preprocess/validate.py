"""Checks of tetrahedral cages: what is broken (errors), how good they are (report), what rays miss.

Axes: V vertices, T tets, F boundary faces, N images. All float64 NumPy in world units, angles in
degrees.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.spatial import cKDTree

from nimpostor_jax.geometry.topology import adjacency
from nimpostor_jax.preprocess.visual_hull import FOREGROUND_ALPHA, view_label

# Corner triples of the face opposite each corner, outward for a positively oriented tet.
FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
_EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
# A tet is degenerate below this share of its longest edge cubed (1e-12 of a regular tet's 0.118).
_DEGENERATE = 1e-13
_RAY_CHUNK = 1 << 20


@dataclasses.dataclass(frozen=True)
class CageReport:
    """Size and quality of a cage."""

    num_vertices: int
    num_tets: int
    num_boundary_faces: int
    num_components: int  # connected across faces
    num_overlapping_tets: int  # tets with a sampled interior point inside another tet
    volume: float
    min_dihedral: float  # degrees; 70.5 in a regular tet
    max_dihedral: float
    worst_aspect: float  # longest edge over 2 sqrt(6) times the inradius; 1 in a regular tet

    def __str__(self) -> str:
        return (
            f"cage: {self.num_tets} tets, {self.num_vertices} vertices, "
            f"{self.num_boundary_faces} boundary faces, {self.num_components} component(s), "
            f"volume {self.volume:.4g}; dihedral angles {self.min_dihedral:.1f} to "
            f"{self.max_dihedral:.1f} degrees, worst aspect ratio {self.worst_aspect:.1f}, "
            f"{self.num_overlapping_tets} overlapping tets"
        )


@dataclasses.dataclass(frozen=True)
class Coverage:
    """How many foreground pixels' rays (or other samples, `what`) miss a cage, by image."""

    foreground: Int[np.ndarray, " N"]
    missed: Int[np.ndarray, " N"]
    what: str = "foreground rays"

    @property
    def missed_share(self) -> float:
        """Missed share of the foreground pixels of all images."""
        return float(self.missed.sum() / max(self.foreground.sum(), 1))

    @property
    def worst_view(self) -> int:
        """Image with the largest missed share."""
        return int(np.argmax(self.missed / np.maximum(self.foreground, 1)))

    def __str__(self) -> str:
        return (
            f"{int(self.missed.sum())} of {int(self.foreground.sum())} {self.what} miss the cage "
            f"({100 * self.missed_share:.4f}%)"
        )


def signed_volumes(
    vertices: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"]
) -> Float[np.ndarray, " T"]:
    """Volume of each tet, negative where it is inverted."""
    a, b, c, d = (vertices[tets[:, i]] for i in range(4))
    return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6.0


def orient_tets(
    tets: Int[np.ndarray, "T 4"], vertices: Float[np.ndarray, "V 3"]
) -> Int[np.ndarray, "T 4"]:
    """The tets, with two corners swapped wherever the volume is negative."""
    oriented = np.array(tets)
    inverted = signed_volumes(vertices, oriented) < 0
    oriented[inverted] = oriented[inverted][:, [0, 2, 1, 3]]
    return oriented


def boundary_faces(tets: Int[np.ndarray, "T 4"]) -> Int[np.ndarray, "F 3"]:
    """Vertex triples of the faces of only one tet, outward for positively oriented tets."""
    faces = tets[:, FACES].reshape(-1, 3)
    _, inverse, counts = np.unique(
        np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return faces[counts[inverse.reshape(-1)] == 1]


def check_tets(
    vertices: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"], source: str = "cage"
) -> None:
    """Raise ValueError, naming `source` and the first offender, unless the arrays are a sound tet
    mesh.

    Sound: finite vertices, indices in range, positive and non-degenerate volumes, at most one tet on
    either side of a face. Overlap is not an error here (edited cages may overlap); see `quality_report`.
    """
    vertices, tets = np.asarray(vertices), np.asarray(tets)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or tets.ndim != 2 or tets.shape[1] != 4:
        raise ValueError(
            f"{source}: need vertices [n, 3] and tets [m, 4], got {vertices.shape} and {tets.shape}"
        )
    if not np.issubdtype(tets.dtype, np.integer):
        raise ValueError(f"{source}: tets must be integers, got {tets.dtype}")
    if len(tets) == 0:
        raise ValueError(f"{source}: there are no tets")
    _fail(
        source,
        ~np.isfinite(vertices).all(axis=1),
        "non-finite vertices",
        "repair or rebuild the mesh",
    )
    outside = (tets.min(axis=1) < 0) | (tets.max(axis=1) >= len(vertices))
    _fail(
        source, outside, f"tets with indices outside 0..{len(vertices) - 1}", "indices are 0-based"
    )
    volumes = signed_volumes(vertices.astype(np.float64), tets)
    longest = edge_lengths(vertices, tets).max(axis=1)
    degenerate = np.abs(volumes) <= _DEGENERATE * longest**3
    _fail(source, degenerate, "degenerate tets (no volume)", "remove or remesh them")
    _fail(
        source,
        volumes < 0,
        "inverted tets (negative volume)",
        "call orient_tets, or load with orient=True",
    )
    try:
        adjacency(tets)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error


def _fail(source: str, bad: np.ndarray, what: str, remedy: str) -> None:
    if bad.any():
        raise ValueError(
            f"{source}: {int(bad.sum())} {what} (first: {int(np.argmax(bad))}); {remedy}"
        )


def quality_report(vertices: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"]) -> CageReport:
    """Size, worst shapes, components and self-overlap of a cage that passes `check_tets`."""
    volumes = signed_volumes(vertices, tets)
    dihedral = dihedral_angles(vertices, tets)
    return CageReport(
        num_vertices=len(np.unique(tets)),
        num_tets=len(tets),
        num_boundary_faces=len(boundary_faces(tets)),
        num_components=_count_components(tets),
        num_overlapping_tets=int(overlapping_tets(vertices, tets).sum()),
        volume=float(volumes.sum()),
        min_dihedral=float(dihedral.min()),
        max_dihedral=float(dihedral.max()),
        worst_aspect=float(aspect_ratios(vertices, tets).max()),
    )


def dihedral_angles(
    vertices: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"]
) -> Float[np.ndarray, "T 6"]:
    """Interior angles at the six edges of each tet, in degrees."""
    a, b, c = (vertices[tets[:, FACES[:, i]]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    cosines = -np.einsum("tek,tek->te", normals[:, _EDGES[:, 0]], normals[:, _EDGES[:, 1]])
    return np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))


def aspect_ratios(
    vertices: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"]
) -> Float[np.ndarray, " T"]:
    """Longest edge over 2 sqrt(6) times the radius of the inscribed sphere: 1 at best."""
    a, b, c = (vertices[tets[:, FACES[:, i]]] for i in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum(axis=1)
    inradius = 3.0 * np.abs(signed_volumes(vertices, tets)) / areas
    return edge_lengths(vertices, tets).max(axis=1) / (2.0 * np.sqrt(6.0) * inradius)


def edge_lengths(
    vertices: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"]
) -> Float[np.ndarray, "T 6"]:
    """Length of each tet's six edges, from its first corner on, in the vertices' units (float64)."""
    corners = np.asarray(vertices, np.float64)[tets]
    return np.linalg.norm(corners[:, _EDGES[:, 0]] - corners[:, _EDGES[:, 1]], axis=-1)


def _count_components(tets: Int[np.ndarray, "T 4"]) -> int:
    """Groups of tets that are connected across faces."""
    faces = np.sort(tets[:, FACES].reshape(-1, 3), axis=1)
    _, face_ids = np.unique(faces, axis=0, return_inverse=True)
    face_ids = face_ids.reshape(-1)
    owners = np.arange(len(tets)).repeat(4)
    # Bipartite graph of tets and faces: two tets are connected where they share a face.
    links = (np.ones(len(owners)), (owners, len(tets) + face_ids))
    size = len(tets) + int(face_ids.max()) + 1
    graph = sparse.coo_matrix(links, shape=(size, size))
    return int(sparse.csgraph.connected_components(graph, directed=False)[0])


def overlapping_tets(
    vertices: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"]
) -> Bool[np.ndarray, " T"]:
    """Which tets have a sample (centroid, half-way to a corner) strictly inside another."""
    corners = np.asarray(vertices, np.float64)[tets]
    centroids = corners.mean(axis=1, keepdims=True)
    samples = np.concatenate([centroids, 0.5 * (centroids + corners)], axis=1).reshape(-1, 3)
    owners = np.arange(len(tets)).repeat(5)
    overlapping = np.zeros(len(tets), bool)
    for tet, (index, weights) in enumerate(points_near_tets(samples, vertices, tets)):
        # 1e-6: a sample on a shared face, up to rounding, is not an overlap.
        inside = index[(weights > 1e-6).all(axis=1)]
        inside = inside[owners[inside] != tet]
        overlapping[owners[inside]] = True
        overlapping[tet] |= inside.size > 0
    return overlapping


def points_near_tets(
    points: Float[np.ndarray, "points 3"],
    vertices: Float[np.ndarray, "V 3"],
    tets: Int[np.ndarray, "T 4"],
) -> list[tuple[Int[np.ndarray, " near"], Float[np.ndarray, "near 4"]]]:
    """For each tet, the points in a ball around it and their barycentric coordinates in the tet."""
    corners = np.asarray(vertices, np.float64)[tets]
    centroids = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centroids[:, None], axis=2).max(axis=1)
    near = cKDTree(points).query_ball_point(centroids, radii * (1 + 1e-9))
    inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
    result = []
    for tet, found in enumerate(near):
        index = np.asarray(found, np.int64)
        last = (points[index] - corners[tet, 0]) @ inverse[tet].T
        result.append((index, np.c_[1.0 - last.sum(axis=1), last]))
    return result


def outside_points(
    points: Float[np.ndarray, "points 3"],
    vertices: Float[np.ndarray, "V 3"],
    tets: Int[np.ndarray, "T 4"],
    tolerance: float = 1e-9,
) -> Bool[np.ndarray, " points"]:
    """Which points lie in no tet."""
    outside = np.ones(len(points), bool)
    for index, weights in points_near_tets(points, vertices, tets):
        outside[index[(weights >= -tolerance).all(axis=1)]] = False
    return outside


def missed_foreground(
    vertices: Float[np.ndarray, "V 3"],
    tets: Int[np.ndarray, "T 4"],
    masks: Float[np.ndarray, "N H W"],
    camera_to_world: Float[np.ndarray, "N 4 4"],
    focal: Float[np.ndarray, "N 2"],
    principal: Float[np.ndarray, "N 2"],
) -> Coverage:
    """Trace the ray of every foreground pixel's centre against the cage's boundary (Embree)."""
    surface = trimesh.Trimesh(vertices, boundary_faces(tets), process=False)
    foreground = np.zeros(len(masks), np.int64)
    missed = np.zeros(len(masks), np.int64)
    for i, mask in enumerate(masks):
        pixels = np.argwhere(np.asarray(mask) > FOREGROUND_ALPHA)[:, ::-1] + 0.5
        foreground[i] = len(pixels)
        local = np.c_[(pixels - principal[i]) / focal[i] * [1.0, -1.0], -np.ones(len(pixels))]
        directions = local @ np.asarray(camera_to_world[i], np.float64)[:3, :3].T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origin = np.asarray(camera_to_world[i], np.float64)[:3, 3]
        for start in range(0, len(pixels), _RAY_CHUNK):
            part = directions[start : start + _RAY_CHUNK]
            missed[i] += int(
                (~surface.ray.intersects_any(np.tile(origin, (len(part), 1)), part)).sum()
            )
    return Coverage(foreground, missed)


def check_coverage(
    coverage: Coverage,
    max_missed_share: float,
    names: Sequence[str] | None = None,
    source: str = "cage",
) -> None:
    """Raise ValueError, naming the worst view, if more than `max_missed_share` of rays miss."""
    if coverage.missed_share <= max_missed_share:
        return
    worst = coverage.worst_view
    raise ValueError(
        f"{source}: {coverage}, more than {100 * max_missed_share:.4g}% allowed; worst view: "
        f"{view_label(worst, names)} "
        f"({int(coverage.missed[worst])} of {int(coverage.foreground[worst])}). "
        "Is it the cage of another object? Else build it with a larger CageConfig.margin"
    )
