"""The stress test's oracle: each ray against every tet and every boundary face, in float64.

A point of a line counts as surely inside the mesh, surely outside, or near the surface, where rounding
decides. Near means within `margin` of a boundary face, by exact distances: what rounds every vertex and
ray a little can move a grazing ray's ends anywhere within that part of the line, but not beyond it.

Axes: R rays, T tets, B boundary faces, N pieces of a line.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.types import TetMesh

PARALLEL = 1e-13  # sine of an angle that float64 cannot tell from 0
AROUND = 1e-15  # how far tets are grown, in sizes of the mesh, so that no line slips between them
Interval = tuple[Float[Array, "R N"], Float[Array, "R N"]]  # low >= high where empty


@struct.dataclass
class Geometry:
    """What jitted functions read of a solid, float64; flat tets and unused faces have NaN."""

    planes: Float[Array, "T 4 4"]  # unit normals into the tet, and offsets
    signs: Float[Array, " T"]  # -1 for inverted tets, 0 for flat ones
    triangles: Float[Array, "B 3 3"]  # boundary faces


class Solid(NamedTuple):
    """A mesh as the oracle sees it."""

    geometry: Geometry
    long_planes: np.ndarray  # its planes in long double


@struct.dataclass
class Lines:
    """Rays in float64, from where they count, and how far rounding may move what they meet."""

    origins: Float[Array, "R 3"]
    directions: Float[Array, "R 3"]
    near: Float[Array, ""]
    margin: Float[Array, " R"]


class Pieces(NamedTuple):
    """Lines cut where they enter or leave any tet, or come near a boundary face, in order; NumPy."""

    start: np.ndarray  # [R, N]
    length: np.ndarray  # [R, N]; 0 in unused slots
    surely: np.ndarray  # [R, N] bool: inside a tet, and not near the surface
    perhaps: np.ndarray  # [R, N] bool: not surely outside


def solid_of(mesh: TetMesh) -> Solid:
    """From a mesh's current vertices. The two tets beside a face get the same plane, to the last bit."""
    vertices, tets = np.asarray(mesh.vertices, np.longdouble), np.asarray(mesh.tets)
    faces = tets[:, np.array(FACES)]  # [T, face, 3]
    a, b, c = (vertices[corner] for corner in np.moveaxis(np.sort(faces, axis=-1), -1, 0))
    normals = np.cross(b - a, c - a)
    heights = np.sum(normals * (vertices[tets] - a), axis=-1)  # of the opposite corner
    flat = np.any(heights == 0, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals *= np.sign(heights)[..., None] / np.linalg.norm(normals, axis=-1, keepdims=True)
    planes = np.concatenate([normals, -np.sum(normals * a, axis=-1, keepdims=True)], axis=-1)
    edges = vertices[tets[:, 1:]] - vertices[tets[:, :1]]
    signs = np.where(flat, 0, np.sign(np.sum(np.cross(edges[:, 0], edges[:, 1]) * edges[:, 2], axis=1)))
    used = np.asarray(mesh.boundary.tets) >= 0
    boundary = vertices[faces[np.asarray(mesh.boundary.tets), np.asarray(mesh.boundary.corners)]]
    triangles = np.where(used[..., None, None], boundary, np.nan).reshape(-1, 3, 3)
    planes = np.where(flat[:, None, None], np.nan, planes)
    arrays = (jnp.asarray(x, jnp.float64) for x in (planes, signs, triangles))
    return Solid(Geometry(*arrays), planes)


def _clip(interval: Interval, height: Array, slope: Array) -> Interval:
    """The part of each line's interval where height + t slope >= 0."""
    flat = slope == 0
    at = -height / jnp.where(flat, 1, slope)
    low = jnp.maximum(interval[0], jnp.where(slope > 0, at, -jnp.inf))
    high = jnp.minimum(interval[1], jnp.where(slope < 0, at, jnp.inf))
    return jnp.where(flat & ~(height >= 0), jnp.inf, low), high


def _dot(a: Array, b: Array) -> Array:
    return sum(a[..., i] * b[..., i] for i in range(3))  # type: ignore[return-value]


def tet_intervals(solid: Geometry, lines: Lines, around: float = 0.0) -> Interval:
    """Where each line is inside each tet, [R, T]: clipped by four planes; flat tets hold nothing.

    `around` moves the planes away from the tet.
    """
    shape = (lines.origins.shape[0], solid.planes.shape[0])
    interval = jnp.full(shape, lines.near), jnp.full(shape, jnp.inf)
    for face in range(4):
        normals = solid.planes[None, :, face, :3]
        height = _dot(lines.origins[:, None], normals) + solid.planes[:, face, 3] + around
        interval = _clip(interval, height, _dot(lines.directions[:, None], normals))
    low, high = interval
    return jnp.where(solid.signs != 0, low, jnp.inf), high


@jax.jit
def tet_lengths(solid: Geometry, lines: Lines) -> Float[Array, "R T"]:
    """Length of each line inside each tet, negative in inverted ones."""
    low, high = tet_intervals(solid, lines)
    return jnp.where(high > low, high - low, 0) * solid.signs


def face_intervals(solid: Geometry, lines: Lines) -> Interval:
    """Where each line is within `margin` of each boundary face, [R, B]: within its prism, or near an edge.

    What is that near to a convex set is convex: one interval, which spans those of the parts. A corner's
    ball is an edge's cylinder with round ends.
    """
    directions, margin = lines.directions[:, None], lines.margin[:, None]
    a, b, c = (solid.triangles[None, :, i] for i in range(3))
    # t counts from the point nearest to the face's centre: distances along the line cost no digits
    middle = _dot((a + b + c) / 3 - lines.origins[:, None], directions)
    origins = lines.origins[:, None] + middle[..., None] * directions
    everything = jnp.full(middle.shape, -jnp.inf), jnp.full(middle.shape, jnp.inf)
    normal = jnp.cross(b - a, c - a)
    area = jnp.sqrt(_dot(normal, normal))
    normal /= jnp.where(area > 0, area, 1)[..., None]
    height, slope = _dot(origins - a, normal), _dot(directions, normal)
    prism = _clip(_clip(everything, height + margin, slope), margin - height, -slope)
    parts = []
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        inward = jnp.cross(normal, edge)
        prism = _clip(prism, _dot(origins - start, inward), _dot(directions, inward))
        parts += [_ball_interval(origins - start, directions, margin)]
        parts += [_edge_interval(origins - start, directions, edge, margin)]
    parts.append((jnp.where(area > 0, prism[0], jnp.inf), prism[1]))
    low = jnp.min(jnp.stack([jnp.where(lo < hi, lo, jnp.inf) for lo, hi in parts]), axis=0)
    high = jnp.max(jnp.stack([jnp.where(lo < hi, hi, -jnp.inf) for lo, hi in parts]), axis=0)
    return jnp.maximum(low + middle, lines.near), high + middle


def _ball_interval(offset: Array, directions: Array, margin: Array) -> Interval:
    at = -_dot(offset, directions)
    nearest = offset + at[..., None] * directions
    half = jnp.sqrt(jnp.maximum(margin**2 - _dot(nearest, nearest), 0))
    return at - half, at + half


def _edge_interval(offset: Array, directions: Array, edge: Array, margin: Array) -> Interval:
    """Within `margin` of an edge and between the planes across its ends."""
    length = jnp.sqrt(_dot(edge, edge))
    edge = edge / jnp.where(length > 0, length, 1)[..., None]
    along, slope = _dot(offset, edge), _dot(directions, edge)
    aside = directions - slope[..., None] * edge
    speed = jnp.sqrt(_dot(aside, aside))
    parallel = speed < PARALLEL
    speed = jnp.where(parallel, 1, speed)
    at = jnp.zeros_like(along)
    for _ in range(2):  # once more, because a line nearly along the edge loses digits
        nearest = offset - along[..., None] * edge + at[..., None] * aside
        at -= jnp.where(parallel, 0, _dot(nearest, aside) / speed**2)
    nearest = offset - along[..., None] * edge + at[..., None] * aside
    reserve = margin**2 - _dot(nearest, nearest)
    half = jnp.where(parallel, jnp.inf, jnp.sqrt(jnp.maximum(reserve, 0)) / speed)
    interval = jnp.where(reserve > 0, at - half, jnp.inf), at + half
    return _clip(_clip(interval, along, slope), length - along, -slope)


@jax.jit
def _candidates(solid: Geometry, lines: Lines) -> tuple[Array, Interval]:
    low, high = tet_intervals(solid, lines, around=1e-9)
    return low < high, face_intervals(solid, lines)


def _long_intervals(
    solid: Solid, lines: Lines, rays: np.ndarray, tets: np.ndarray, around: float
) -> tuple[np.ndarray, np.ndarray]:
    """`tet_intervals` of pairs of a ray and a tet, in long double: a sliver's tip costs six digits."""
    origins, directions = (np.asarray(x, np.longdouble)[rays] for x in (lines.origins, lines.directions))
    low, high = (
        np.full(len(rays), float(lines.near), np.longdouble),
        np.full(len(rays), np.inf, np.longdouble),
    )
    for face in range(4):
        plane = solid.long_planes[tets, face]
        height = np.sum(origins * plane[:, :3], axis=1) + plane[:, 3] + around
        slope = np.sum(directions * plane[:, :3], axis=1)
        flat = slope == 0
        at = -height / np.where(flat, 1, slope)
        low = np.where(~flat & (slope > 0), np.maximum(low, at), low)
        high = np.where(~flat & (slope < 0), np.minimum(high, at), high)
        low = np.where(flat & (height < 0), np.inf, low)
    return low, high


def pieces(solid: Solid, lines: Lines) -> Pieces:
    """Cut lines by sweeping along t; of meshes without inverted tets."""
    candidates, faces = _candidates(solid.geometry, lines)
    num_rays = len(candidates)
    pairs = np.nonzero(np.asarray(candidates))
    near = np.asarray(faces[0]) < np.asarray(faces[1])  # false for NaN
    near_ends = (np.asarray(x)[near] for x in faces)
    found = [(pairs[0], *_long_intervals(solid, lines, *pairs, around)) for around in (0, AROUND)]
    found.append((np.nonzero(near)[0], *near_ends))
    parts = []
    for kind, (rays, low, high) in enumerate(found):
        used, weight = low < high, 1 << 20 * kind
        for ends, step in ((low, weight), (high, -weight)):
            parts.append((rays[used], ends[used].astype(np.float64), np.full(np.sum(used), step)))
    rays, at, steps = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    order = np.lexsort((at, rays))
    at, rays, counts = at[order], rays[order], np.cumsum(steps[order])  # 0 again at every ray's last end
    inside, grown, near = ((counts >> 20 * kind) % (1 << 20) > 0 for kind in range(3))
    ends = np.bincount(rays, minlength=num_rays)
    slots = np.arange(len(rays)) - np.repeat(np.cumsum(ends) - ends, ends)

    def padded(values: np.ndarray) -> np.ndarray:
        result = np.zeros((num_rays, max(1, ends.max(initial=0))), values.dtype)
        result[rays, slots] = values
        return result

    length = np.where(counts > 0, np.diff(at, append=0), 0)
    return Pieces(padded(at), padded(length), padded(inside & ~near), padded(grown | near))


def chord_range(cut: Pieces) -> tuple[np.ndarray, np.ndarray]:
    """Lengths [R] of each line's part surely inside, and of that not surely outside."""
    return np.sum(cut.length * cut.surely, axis=1), np.sum(cut.length * cut.perhaps, axis=1)


def color_range(
    cut: Pieces, lines: Lines, sigma: float, palette: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Colour and opacity [R, 4] (Eq. 1) of what is surely inside, and of what is not surely outside.

    `sigma` is the density; `palette` maps points to colours, linearly.
    """
    origins, directions = (np.asarray(x)[:, None] for x in (lines.origins, lines.directions))
    first = palette(origins + cut.start[..., None] * directions)
    last = palette(origins + (cut.start + cut.length)[..., None] * directions)
    surely, perhaps = (_emitted(sigma * cut.length * x, first, last) for x in (cut.surely, cut.perhaps))
    return surely, perhaps


def _emitted(depth: np.ndarray, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Of pieces of optical depth [R, N] and colours [R, N, 3] that are linear in between."""
    before = np.pad(np.cumsum(depth[:, :-1], axis=1), ((0, 0), (1, 0)))
    weights = np.exp(-before) * -np.expm1(-depth)
    thick = np.maximum(depth, 1e-3)
    place = np.where(depth > 1e-3, 1 / thick - 1 / np.expm1(np.minimum(thick, 500)), 0.5 - depth / 12)
    color = np.sum(weights[..., None] * (first + place[..., None] * (last - first)), axis=1)
    return np.concatenate([color, np.sum(weights, axis=1, keepdims=True)], axis=1)
