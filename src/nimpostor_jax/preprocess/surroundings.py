"""Where a captured object stands, and what is seen behind it, from posed images without masks.

The region of interest comes from the cameras alone. The surroundings are taken to be far away or plain: their
colour is a function of the view direction. It is read off the pixels whose rays miss the region, as a robust
mean in small bins of direction; directions that no such pixel has are filled in smoothly.

World units; cameras have OpenGL axes; pixel centres at half integers. Host code, float64.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage, sparse
from scipy.sparse import linalg
from scipy.spatial import cKDTree

BIN_PIXELS = 2.0  # pixels across a bin of directions
MIN_BINS, MAX_BINS = 2_000, 100_000
_NEIGHBORS = 6  # of a bin, in the diffusion that fills holes
_MIN_AXES = 1e-3  # of the spread of optical axes: below, they are parallel
_IN_FRONT = 0.75  # of the cameras must look towards the focus
_CUBE_PIXELS = 1.5  # of the cube map to a bin
_FILL_FROM = 3  # pixels that a bin needs; others are filled from their neighbours


@dataclasses.dataclass(frozen=True)
class Region:
    """An axis-aligned box, or the largest ball in it, that contains the object and little else."""

    lower: Float[np.ndarray, " 3"]
    upper: Float[np.ndarray, " 3"]
    is_ball: bool = False

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Lower and upper corner."""
        return np.stack([self.lower, self.upper])

    def is_missed(
        self, origin: Float[np.ndarray, " 3"], directions: Float[np.ndarray, "*pixels 3"]
    ) -> Bool[np.ndarray, "*pixels"]:
        """Which rays from `origin`, of unit directions, do not meet the region."""
        if self.is_ball:
            offset = 0.5 * (self.lower + self.upper) - origin
            along = directions @ offset
            radius = 0.5 * float((self.upper - self.lower).min())
            nearest = offset @ offset - np.maximum(along, 0.0) ** 2  # behind the camera: the camera itself
            return nearest > radius**2
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(self.lower - origin) / directions, (self.upper - origin) / directions])
        # 0 / 0: a ray within a face's plane; it neither enters nor leaves there.
        enter = np.nan_to_num(ends.min(axis=0), nan=-np.inf).max(axis=-1)
        leave = np.nan_to_num(ends.max(axis=0), nan=np.inf).min(axis=-1)
        return (enter > leave) | (leave < 0)


def region_from_cameras(
    camera_to_world: Float[np.ndarray, "N 4 4"],
    focal: Float[np.ndarray, "N 2"],
    principal: Float[np.ndarray, "N 2"],
    width: int,
    height: int,
    names: Sequence[str] | None = None,
) -> Region:
    """A ball around the point nearest to all optical axes, the largest that half of the frames contain.

    Raises ValueError where the axes are parallel or most cameras look away from that point.
    """
    poses = np.asarray(camera_to_world, np.float64)
    origins, forward = poses[:, :3, 3], -poses[:, :3, 2]
    remedy = "give the object's box with --box x0 y0 z0 x1 y1 z1"
    projectors = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    matrix = projectors.mean(axis=0)
    if np.linalg.eigvalsh(matrix)[0] < _MIN_AXES:
        raise ValueError(
            f"the optical axes of the {len(poses)} cameras are nearly parallel: they do not surround an "
            f"object; {remedy}"
        )
    center = np.linalg.solve(matrix, np.einsum("nij,nj->i", projectors, origins) / len(poses))
    local = np.einsum("nji,nj->ni", poses[:, :3, :3], center - origins)
    depth = -local[:, 2]
    away = np.flatnonzero(depth <= 0)
    if len(away) > (1 - _IN_FRONT) * len(poses):
        first = away[0] if names is None else names[away[0]]
        raise ValueError(
            f"{len(away)} of {len(poses)} cameras look away from the point nearest to all optical axes, "
            f"{np.round(center, 3).tolist()} (first: {first}): they do not surround an object; check the "
            f"poses' convention (camera-to-world, looking down -z, y up), or {remedy}"
        )
    # Distance to the four planes through the camera and an edge of its frame, inside positive.
    right = (np.array([width, height]) - principal) / focal
    left = principal / focal
    x, y = local[:, 0], -local[:, 1]  # right and down
    reach = np.stack(
        [
            (right[:, 0] * depth - x) / np.hypot(1, right[:, 0]),
            (left[:, 0] * depth + x) / np.hypot(1, left[:, 0]),
            (right[:, 1] * depth - y) / np.hypot(1, right[:, 1]),
            (left[:, 1] * depth + y) / np.hypot(1, left[:, 1]),
        ]
    ).min(axis=0)
    radius = float(np.median(reach))
    if radius <= 0:
        raise ValueError(
            f"the point nearest to all optical axes, {np.round(center, 3).tolist()}, is out of most frames: "
            f"the cameras do not look at one object; {remedy}"
        )
    return Region(center - radius, center + radius, is_ball=True)


def pixel_directions(
    camera_to_world: Float[np.ndarray, "4 4"],
    focal: Float[np.ndarray, " 2"],
    principal: Float[np.ndarray, " 2"],
    width: int,
    height: int,
) -> Float[np.ndarray, "H W 3"]:
    """Unit directions, in the world, through the centres of a camera's pixels."""
    x = (np.arange(width) + 0.5 - principal[0]) / focal[0]
    y = (np.arange(height) + 0.5 - principal[1]) / focal[1]
    x, y = np.meshgrid(x, y)
    local = np.stack([x, -y, -np.ones_like(x)], axis=-1)
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    return local @ np.asarray(camera_to_world)[:3, :3].T


@dataclasses.dataclass(frozen=True)
class Surroundings:
    """Colour by direction, on a cube map whose faces reach one texel beyond their edges."""

    faces: Float[np.ndarray, "6 R R 3"]
    known_share: float  # of the directions behind the region: what was seen rather than filled in

    def __call__(self, directions: Float[np.ndarray, "*pixels 3"]) -> Float[np.ndarray, "*pixels 3"]:
        """Colours in [0, 1] of unit directions, interpolated linearly."""
        flat = directions.reshape(-1, 3)
        face, u, v = _on_cube(flat)
        inner = self.faces.shape[1] - 2
        rows = 0.5 * (v + 1) * inner + 0.5
        columns = 0.5 * (u + 1) * inner + 0.5
        out = np.empty_like(flat)
        for i in range(6):
            here = face == i
            for c in range(3):
                out[here, c] = ndimage.map_coordinates(
                    self.faces[i, ..., c], [rows[here], columns[here]], order=1, mode="nearest"
                )
        return out.reshape(directions.shape)


def estimate_surroundings(
    images: Float[np.ndarray, "N H W 3"],
    camera_to_world: Float[np.ndarray, "N 4 4"],
    focal: Float[np.ndarray, "N 2"],
    principal: Float[np.ndarray, "N 2"],
    region: Region,
) -> Surroundings:
    """The median colour, by direction, of pixels whose rays miss the region; holes are filled smoothly.

    Raises ValueError where no pixel misses the region.
    """
    count, height, width = images.shape[:3]
    spacing = BIN_PIXELS / float(np.median(focal))
    num_bins = int(np.clip(4 * math.pi / spacing**2, MIN_BINS, MAX_BINS))
    bins = fibonacci_sphere(num_bins)
    tree = cKDTree(bins)
    found, values, wanted = [], [], np.zeros(num_bins, bool)
    for i in range(count):
        directions = pixel_directions(camera_to_world[i], focal[i], principal[i], width, height)
        missed = region.is_missed(np.asarray(camera_to_world)[i, :3, 3], directions)
        _, nearest = tree.query(directions.reshape(-1, 3))
        found.append(nearest[missed.reshape(-1)])
        values.append(images[i][missed])
        wanted[nearest[~missed.reshape(-1)]] = True
    index, colors = np.concatenate(found), np.concatenate(values).astype(np.float64)
    if not len(index):
        raise ValueError(
            f"every pixel of the {count} images may show the object: nothing tells its background; "
            "give a smaller --box, images that show more around the object, or masks (RGBA)"
        )
    medians, counts = _medians(index, colors, num_bins)
    known = counts >= min(_FILL_FROM, int(counts.max()))
    filled = _diffuse(bins, medians, known)
    texels = math.ceil(_CUBE_PIXELS * math.sqrt(num_bins / 6))
    faces = np.stack([_face_directions(face, texels) for face in range(6)])
    distance, near = tree.query(faces.reshape(-1, 3), k=4)
    weights = np.exp(-0.5 * (distance / (0.5 * math.sqrt(4 * math.pi / num_bins))) ** 2)
    smooth = np.einsum("pk,pkc->pc", weights, filled[near]) / weights.sum(axis=1)[:, None]
    return Surroundings(
        faces=smooth.reshape(faces.shape),
        known_share=float(np.mean(known[wanted])) if wanted.any() else 1.0,
    )


def fibonacci_sphere(count: int) -> Float[np.ndarray, "count 3"]:
    """Unit directions, evenly spread."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * math.pi * (3 - math.sqrt(5))
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def _medians(
    index: Int[np.ndarray, " P"], values: Float[np.ndarray, "P 3"], count: int
) -> tuple[Float[np.ndarray, "count 3"], Int[np.ndarray, " count"]]:
    """The median by channel of the values of each index (0 without any), and how many there are."""
    counts = np.bincount(index, minlength=count)
    starts = np.cumsum(counts) - counts
    medians = np.zeros((count, 3))
    some = counts > 0
    for c in range(3):
        ordered = values[np.lexsort((values[:, c], index)), c]
        low, high = (counts[some] - 1) // 2, counts[some] // 2
        medians[some, c] = 0.5 * (ordered[starts[some] + low] + ordered[starts[some] + high])
    return medians, counts


def _diffuse(
    points: Float[np.ndarray, "B 3"], values: Float[np.ndarray, "B 3"], known: Bool[np.ndarray, " B"]
) -> Float[np.ndarray, "B 3"]:
    """Values everywhere: what is known stays, the rest is harmonic on the graph of nearest neighbours."""
    _, near = cKDTree(points).query(points, k=_NEIGHBORS + 1)
    rows = np.repeat(np.arange(len(points)), _NEIGHBORS)
    graph = sparse.coo_matrix((np.ones(rows.size), (rows, near[:, 1:].reshape(-1)))).tocsr()
    graph = graph + graph.T
    laplacian = sparse.diags(np.asarray(graph.sum(axis=1)).reshape(-1)) - graph
    filled = values.copy()
    holes = ~known
    if holes.any():
        system = laplacian[holes][:, holes].tocsc()
        right = -(laplacian[holes][:, known] @ values[known])
        filled[holes] = linalg.splu(system).solve(right)
    return filled


_AXES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
# Of each face: the axes along its columns and rows.
_TANGENTS = np.roll(np.abs(_AXES), 1, axis=1), np.roll(np.abs(_AXES), 2, axis=1)


def _face_directions(face: int, texels: int) -> Float[np.ndarray, "texels+2 texels+2 3"]:
    """Unit directions of a face's texels, and of one more around them."""
    at = (np.arange(texels + 2) - 0.5) / texels * 2 - 1
    u, v = np.meshgrid(at, at)
    directions = _AXES[face] + u[..., None] * _TANGENTS[0][face] + v[..., None] * _TANGENTS[1][face]
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def _on_cube(directions: Float[np.ndarray, "P 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Face, column and row coordinate in [-1, 1] of directions."""
    axis = np.argmax(np.abs(directions), axis=1)
    largest = np.take_along_axis(directions, axis[:, None], axis=1)[:, 0]
    face = 2 * axis + (largest < 0)
    u = np.sum(directions * _TANGENTS[0][face], axis=1) / np.abs(largest)
    v = np.sum(directions * _TANGENTS[1][face], axis=1) / np.abs(largest)
    return face, u, v
