"""The first edit (Sec. 4.1): move the cage's vertices by a function of space, and nothing else.

The field is a function of tet and barycentric coordinates, so tables and decoders stay as they are
and the radiance moves along, piecewise linearly with the tets. The families are the maps of the
deformed reference scenes (world coordinates, z up).
"""

import dataclasses
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nimpostor_jax.geometry.tetrahedron import corners, cross, signed_volumes
from nimpostor_jax.types import BakedImpostor, NeuralImpostor

Deformable = TypeVar("Deformable", NeuralImpostor, BakedImpostor)
SpaceMap = Callable[[Float[Array, "V 3"]], Float[Array, "V 3"]]
Scalar = Float[Array, ""] | float


def deform(impostor: Deformable, space_map: SpaceMap) -> Deformable:
    """The impostor, baked or not, with its vertices moved by `space_map`, a function of world points [V, 3].

    The map may use jnp (then this works under jit and grad, also with respect to the map's
    parameters) or NumPy (it is given a read-only array). The mesh keeps its frame, also where
    vertices leave it. Inverted tets are no error here: see `deformation_report`, or
    `geometry.tetrahedron.num_inverted` under jit.

    Raises:
        ValueError: the map returns another shape, or (outside jit) a vertex is not finite
        afterwards.
    """
    mesh = impostor.mesh
    world = mesh.center + mesh.scale * mesh.vertices
    moved = space_map(world)
    if np.shape(moved) != world.shape:
        raise ValueError(
            f"the map must return one point for each of the {world.shape[0]} vertices, "
            f"shape {world.shape}; got shape {np.shape(moved)}"
        )
    if not isinstance(moved, jax.core.Tracer):
        bad = np.flatnonzero(~np.isfinite(np.asarray(moved)).all(axis=1))
        if bad.size:
            raise ValueError(
                f"{bad.size} of {world.shape[0]} vertices are not finite after the map; first: "
                f"vertex {bad[0]} at {np.asarray(world[bad[0]]).tolist()}; "
                "restrict the map's parameters"
            )
    # By what they move: vertices that stay keep their bits.
    return with_vertices(impostor, mesh.vertices + (jnp.asarray(moved, world.dtype) - world) / mesh.scale)


def with_vertices(impostor: Deformable, vertices: Float[Array, "V 3"]) -> Deformable:
    """The impostor with its vertices, in the mesh's frame, elsewhere; remembers where they were at rest.

    Outside jit, one that was at rest and of which none moves is given back as it is: it has not turned, and
    renders by the same program to the same bits, with `directions` "rest" too. Baked ones remember nothing:
    they are seen from directions in the world.
    """
    mesh = dataclasses.replace(impostor.mesh, vertices=vertices)
    if isinstance(impostor, BakedImpostor):
        return dataclasses.replace(impostor, mesh=mesh)
    known = not any(isinstance(x, jax.core.Tracer) for x in (vertices, impostor.mesh.vertices))
    if known and impostor.rest_vertices is None and np.array_equal(vertices, impostor.mesh.vertices):
        return impostor
    rest = impostor.mesh.vertices if impostor.rest_vertices is None else impostor.rest_vertices
    return dataclasses.replace(impostor, mesh=mesh, rest_vertices=rest)


@dataclasses.dataclass(frozen=True)
class DeformationReport:
    """How healthy a cage is: no inverted tets, no volume near zero."""

    num_tets: int
    inverted: Int[np.ndarray, " inverted"]  # ids of the tets without positive volume
    smallest_volume: float  # signed, world units cubed

    @property
    def num_inverted(self) -> int:
        """How many tets have no positive volume."""
        return len(self.inverted)


def deformation_report(impostor: NeuralImpostor | BakedImpostor) -> DeformationReport:
    """Which tets of the cage have been turned inside out or flattened. Host code."""
    mesh = impostor.mesh
    volumes = np.asarray(signed_volumes(corners(mesh.vertices, mesh.tets)), np.float64)
    return DeformationReport(
        num_tets=len(volumes),
        inverted=np.flatnonzero(volumes <= 0),
        smallest_volume=float(volumes.min() * np.float64(mesh.scale) ** 3),
    )


def twist(k: Scalar) -> SpaceMap:
    """Rotation about the z axis by the angle k z."""

    def space_map(points: Float[Array, "V 3"]) -> Float[Array, "V 3"]:
        x, y, z = (points[:, i] for i in range(3))
        cos, sin = jnp.cos(k * z), jnp.sin(k * z)
        return jnp.stack([x * cos - y * sin, x * sin + y * cos, z], axis=-1)

    return space_map


def bend(c: Scalar) -> SpaceMap:
    """The z axis rolled onto a circle of curvature c about (1/c, y, 0); the identity for c = 0.

    x' = x cos(cz) + (1 - cos(cz)) / c and z' = sin(cz) / c - x sin(cz), written without a division by c.
    Raises ValueError when it is applied outside of jit to a point with c x >= 1, where space would fold.
    """

    def space_map(points: Float[Array, "V 3"]) -> Float[Array, "V 3"]:
        x, y, z = (points[:, i] for i in range(3))
        _require_bendable(x, c)
        cos, sin = jnp.cos(c * z), jnp.sin(c * z)
        rise = c * z**2 / 2 * jnp.sinc(c * z / (2 * jnp.pi)) ** 2  # jnp.sinc(u) = sin(pi u) / (pi u)
        return jnp.stack([x * cos + rise, y, z * jnp.sinc(c * z / jnp.pi) - x * sin], axis=-1)

    return space_map


def _require_bendable(x: Float[Array, " V"], c: Scalar) -> None:
    if isinstance(x, jax.core.Tracer) or isinstance(c, jax.core.Tracer):
        return
    bad = np.flatnonzero(np.asarray(x) * float(c) >= 1)
    if bad.size:
        raise ValueError(
            f"bend: {bad.size} of {len(x)} vertices have c x >= 1, at or beyond the centre 1/c = "
            f"{1 / float(c):g}; first: vertex {bad[0]} with x = {float(x[bad[0]]):g}; use a smaller c"
        )


def stretch(a: Scalar, b: Scalar) -> SpaceMap:
    """A thickness that varies with height: x and y times 1 + a sin(b z), z times 1.1."""

    def space_map(points: Float[Array, "V 3"]) -> Float[Array, "V 3"]:
        x, y, z = (points[:, i] for i in range(3))
        scale = 1 + a * jnp.sin(b * z)
        return jnp.stack([scale * x, scale * y, 1.1 * z], axis=-1)

    return space_map


def rigid(rotation: Float[Array, "3 3"], translation: Float[Array, " 3"]) -> SpaceMap:
    """x' = rotation x + translation. Raises ValueError (outside jit) where rotation is none."""
    if not isinstance(rotation, jax.core.Tracer):
        matrix = np.asarray(rotation, np.float64)
        # 1e-5: float32 rotations, composed a few times, pass
        valid = matrix.shape == (3, 3) and np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-5)
        if not valid or np.linalg.det(matrix) < 0:
            raise ValueError(f"rigid: rotation must be a 3x3 rotation matrix, got {matrix.tolist()}")

    def space_map(points: Float[Array, "V 3"]) -> Float[Array, "V 3"]:
        # Elementwise: a float32 dot runs in reduced precision on accelerators.
        matrix = jnp.asarray(rotation, points.dtype)
        rotated = jnp.sum(matrix[None] * points[:, None, :], axis=-1)
        return rotated + jnp.asarray(translation, points.dtype)

    return space_map


def drag(
    center: Float[Array, " 3"],
    radius: Scalar,
    translation: Float[Array, " 3"],
    rotation_vector: Float[Array, " 3"],
) -> SpaceMap:
    """A handle with falloff: a ball turned about its centre and moved, less and less towards its surface.

    With w = (1 - |x - center|^2 / radius^2)^3 inside and 0 outside (C^2, compact), x moves to
    center + R(w * rotation_vector) (x - center) + w * translation; `rotation_vector` is the axis times the
    angle in radians. A translation folds space when it is longer than 0.58 radius (1 / max |dw/dr|).

    Raises ValueError (outside jit) unless the radius is positive and all parameters are finite.
    """
    vectors = {"center": center, "translation": translation, "rotation_vector": rotation_vector}
    for name, value in {"radius": radius, **vectors}.items():
        if isinstance(value, jax.core.Tracer):
            continue
        shape = () if name == "radius" else (3,)
        if np.shape(value) != shape or not np.isfinite(np.asarray(value)).all():
            raise ValueError(f"drag: {name} must be finite, of shape {shape}; got {value!r}")
        if name == "radius" and not value > 0:
            raise ValueError(f"drag: radius must be > 0, got {value}")

    def space_map(points: Float[Array, "V 3"]) -> Float[Array, "V 3"]:
        middle, shift, turn = (jnp.asarray(x, points.dtype) for x in (center, translation, rotation_vector))
        offset = points - middle
        weight = (jnp.maximum(1 - jnp.sum(offset**2, axis=-1, keepdims=True) / radius**2, 0)) ** 3
        # The exact identity outside, where (x - center) + center would round.
        moved = middle + _rotated(offset, weight * turn) + weight * shift
        return jnp.where(weight > 0, moved, points)

    return space_map


def _rotated(vectors: Float[Array, "V 3"], turns: Float[Array, "V 3"]) -> Float[Array, "V 3"]:
    """Rodrigues' formula for a rotation vector each; differentiable where it is zero, too."""
    squared = jnp.sum(turns**2, axis=-1, keepdims=True)
    small = squared < 1e-8  # the series' next term is below the square of this: no digit, in float32
    angle = jnp.sqrt(jnp.where(small, 1, squared))
    sine = jnp.where(small, 1 - squared / 6, jnp.sin(angle) / angle)
    versine = jnp.where(small, 0.5 - squared / 24, 2 * (jnp.sin(angle / 2) / angle) ** 2)
    once = cross(turns, vectors)
    return vectors + sine * once + versine * cross(turns, once)


FAMILIES: dict[str, Callable[..., SpaceMap]] = {
    "twist": twist,
    "bend": bend,
    "stretch": stretch,
    "rigid": rigid,
    "drag": drag,
}
