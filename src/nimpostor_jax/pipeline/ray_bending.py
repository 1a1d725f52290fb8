"""The baseline of Tables 1 and 3: rays bent by a deformed cage, as in NeRF-Editing (Yuan et al. 2022).

A field of Cartesian coordinates, trained on the object at rest, is queried along rays through the deformed
cage: every sample is located among the tets around the nearest cage vertices and mapped back to the rest pose
by its barycentric coordinates. Samples come in two stages, evenly first and then where the first stage found
something (NeRF's). Location runs on the host (SciPy's KD-tree), the field under jit.

Axes: R rays, S samples, M points.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from nimpostor_jax.field import impostor as field
from nimpostor_jax.geometry.tetrahedron import signed_volumes
from nimpostor_jax.render.camera import image_pixels, pixel_rays
from nimpostor_jax.types import Camera, NeuralImpostor

NEAREST = 8  # cage vertices around which a sample is sought
RAYS = 4096  # at a time
LOCATED = 1 << 15  # points at a time: what is computed for them stays in the cache
POINTS = 1 << 16  # a call of the field
INSIDE = -1e-6  # barycentric coordinates of points on a face, rounded


class BentField:
    """A Cartesian field (layout `box`) seen through a cage that has moved from `rest` to `moved`.

    Vertices are in world units. Raises ValueError for a field of another layout, and for another number of
    vertices than at rest.
    """

    def __init__(
        self,
        impostor: NeuralImpostor,
        rest: Float[np.ndarray, "V 3"],
        moved: Float[np.ndarray, "V 3"],
        tets: Int[np.ndarray, "T 4"],
    ):
        if impostor.config.encoding.layout != "box":
            raise ValueError(
                f"ray bending needs a Cartesian field (EncodingConfig.layout = 'box'), got "
                f"{impostor.config.encoding.layout!r}"
            )
        if rest.shape != moved.shape:
            raise ValueError(f"{len(rest)} vertices at rest, {len(moved)} moved: not the same cage")
        used, tets = np.unique(tets, return_inverse=True)  # a file may have vertices that no tet uses
        self._impostor, self._tets = impostor, tets.reshape(-1, 4)
        self._rest, self._moved = (np.asarray(places, np.float64)[used] for places in (rest, moved))
        self._tree = cKDTree(self._moved)
        self._around = _tets_around(self._tets, len(used))
        corners = self._moved[self._tets]
        self._first = corners[:, 0]
        edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
        flat = np.flatnonzero(np.linalg.det(edges) == 0)
        if flat.size:
            raise ValueError(f"{flat.size} tets of the moved cage are flat (first: {flat[0]}); move it less")
        self._to_lambda = np.linalg.inv(edges)
        self._centers = corners.mean(axis=1)
        self._radii = np.linalg.norm(corners - self._centers[:, None], axis=2).max(axis=1) * (1 + 1e-9)

    def locate(
        self, points: Float[np.ndarray, "M 3"]
    ) -> tuple[Int[np.ndarray, " M"], Float[np.ndarray, "M 4"]]:
        """The tet around each point of the deformed cage, -1 where none is found, and its coordinates."""
        found = np.full(len(points), -1)
        lambdas = np.zeros((len(points), 4))
        for start in range(0, len(points), LOCATED):
            part = slice(start, start + LOCATED)
            self._locate(points[part], found[part], lambdas[part])
        return found, lambdas

    def _locate(
        self,
        points: Float[np.ndarray, "M 3"],
        found: Int[np.ndarray, " M"],
        lambdas: Float[np.ndarray, "M 4"],
    ) -> None:
        """Writes what it finds."""
        _, nearest = self._tree.query(points, k=min(NEAREST, len(self._moved)), workers=-1)
        nearest = nearest.reshape(len(points), -1)
        for turn in range(nearest.shape[1]):  # most are found around the first
            still = np.flatnonzero(found < 0)
            candidates = self._around[nearest[still, turn]]
            # Bounding spheres first: few of the tets around a vertex come near the point.
            apart = np.sum((points[still, None] - self._centers[candidates]) ** 2, axis=-1)
            row, column = np.nonzero((apart <= self._radii[candidates] ** 2) & (candidates >= 0))
            tets, which = candidates[row, column], still[row]
            rest = np.einsum("mij,mj->mi", self._to_lambda[tets], points[which] - self._first[tets])
            all_four = np.concatenate([1 - rest.sum(axis=1, keepdims=True), rest], axis=1)
            inside = np.flatnonzero(all_four.min(axis=1) >= INSIDE)
            found[which[inside]] = tets[inside]
            lambdas[which[inside]] = all_four[inside]

    def evaluate(
        self, points: Float[np.ndarray, "M 3"], directions: Float[np.ndarray, "M 3"]
    ) -> tuple[Float[np.ndarray, " M"], Float[np.ndarray, "M 3"]]:
        """Densities, per unit of the field's own frame, and colours of points in the deformed cage."""
        found, lambdas = self.locate(points)
        sigmas, colors = np.zeros(len(points)), np.zeros((len(points), 3))
        hits = np.flatnonzero(found >= 0)
        at_rest = np.einsum("mi,mix->mx", lambdas[hits], self._rest[self._tets[found[hits]]])
        for start in range(0, len(hits), POINTS):
            part = slice(start, start + POINTS)
            count = len(hits[part])
            arrays = [_padded(x, POINTS) for x in (at_rest[part], directions[hits[part]])]
            sigma, color = _query(self._impostor, *map(jnp.asarray, arrays))
            sigmas[hits[part]], colors[hits[part]] = np.asarray(sigma)[:count], np.asarray(color)[:count]
        return sigmas, colors

    def render(
        self,
        camera: Camera,
        *,
        coarse: int = 64,
        fine: int = 128,
        pixels: Int[np.ndarray, " P"] | None = None,
    ) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, " P"]]:
        """Premultiplied colour and opacity of pixels (indices, row by row; default all of them)."""
        grid = np.asarray(image_pixels(camera.height, camera.width)).reshape(-1, 2)
        grid = grid if pixels is None else grid[pixels]
        rays = pixel_rays(camera, jnp.asarray(grid))
        origins, directions = (np.asarray(x, np.float64) for x in (rays.origins, rays.directions))
        box = np.stack([self._moved.min(axis=0), self._moved.max(axis=0)])
        near, far = _box_interval(box, origins, directions)
        color, opacity = np.zeros((len(grid), 3)), np.zeros(len(grid))
        hits = np.flatnonzero(far > near)
        for start in range(0, len(hits), RAYS):
            part = hits[start : start + RAYS]
            arguments = origins[part], directions[part], near[part], far[part]
            color[part], opacity[part] = self._render_rays(*arguments, coarse, fine)
        return color, opacity

    def _render_rays(
        self,
        origins: Float[np.ndarray, "R 3"],
        directions: Float[np.ndarray, "R 3"],
        near: Float[np.ndarray, " R"],
        far: Float[np.ndarray, " R"],
        coarse: int,
        fine: int,
    ) -> tuple[Float[np.ndarray, "R 3"], Float[np.ndarray, " R"]]:
        edges = near[:, None] + np.linspace(0, 1, coarse + 1) * (far - near)[:, None]
        middles = (edges[:, 1:] + edges[:, :-1]) / 2
        weights, _, _ = self._integrate(origins, directions, middles, np.diff(edges))
        edges = np.sort(np.concatenate([edges, _importance(edges, weights, fine)], axis=1), axis=1)
        middles = (edges[:, 1:] + edges[:, :-1]) / 2
        _, color, opacity = self._integrate(origins, directions, middles, np.diff(edges))
        return color, opacity

    def _integrate(
        self,
        origins: Float[np.ndarray, "R 3"],
        directions: Float[np.ndarray, "R 3"],
        t: Float[np.ndarray, "R S"],
        lengths: Float[np.ndarray, "R S"],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        points = origins[:, None] + t[..., None] * directions[:, None]
        along = np.broadcast_to(directions[:, None], points.shape)
        sigmas, colors = self.evaluate(points.reshape(-1, 3), along.reshape(-1, 3))
        depth = sigmas.reshape(t.shape) * lengths / float(self._impostor.mesh.scale)
        light = np.exp(-np.concatenate([np.zeros((len(t), 1)), np.cumsum(depth, axis=1)[:, :-1]], axis=1))
        weights = light * -np.expm1(-depth)
        color = np.einsum("rs,rsc->rc", weights, colors.reshape(*t.shape, 3))
        return weights, color, weights.sum(axis=1)


def _tets_around(tets: Int[np.ndarray, "T 4"], num_vertices: int) -> Int[np.ndarray, "V most"]:
    """The tets at each vertex; -1 pads."""
    vertex, tet = tets.reshape(-1), np.repeat(np.arange(len(tets)), 4)
    order = np.argsort(vertex, kind="stable")
    counts = np.bincount(vertex, minlength=num_vertices)
    around = np.full((num_vertices, counts.max()), -1)
    place = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    around[vertex[order], place] = tet[order]
    return around


def _box_interval(
    box: Float[np.ndarray, "2 3"], origins: Float[np.ndarray, "R 3"], directions: Float[np.ndarray, "R 3"]
) -> tuple[Float[np.ndarray, " R"], Float[np.ndarray, " R"]]:
    """t at which rays enter and leave a box; entered after it is left where they miss."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (box[:, None] - origins) / directions
    low, high = np.fmin(*ends).max(axis=1), np.fmax(*ends).min(axis=1)
    return np.maximum(low, 0), high


def _importance(
    edges: Float[np.ndarray, "R S+1"], weights: Float[np.ndarray, "R S"], count: int
) -> Float[np.ndarray, "R count"]:
    """Places spread like the weights, a little of them everywhere."""
    density = weights + 1e-3 / weights.shape[1]
    until = np.concatenate([np.zeros((len(weights), 1)), np.cumsum(density, axis=1)], axis=1)
    until /= until[:, -1:]
    wanted = (np.arange(count) + 0.5) / count
    return np.stack([np.interp(wanted, *pair) for pair in zip(until, edges, strict=True)])


def _padded(values: np.ndarray, size: int) -> np.ndarray:
    return np.pad(values.astype(np.float32), ((0, size - len(values)), (0, 0)))


@jax.jit
def _query(
    impostor: NeuralImpostor, points: Float[jax.Array, "M 3"], directions: Float[jax.Array, "M 3"]
) -> tuple[Float[jax.Array, " M"], Float[jax.Array, "M 3"]]:
    """Density and colour of a Cartesian field at points of its rest pose.

    Its cage is a box of tets: any tet whose coordinates extend to the point gives the same Cartesian place,
    so that the first serves for all.
    """
    mesh = impostor.mesh
    local = (points - mesh.center) / mesh.scale
    corners = mesh.vertices[mesh.tets[0]]
    whole = signed_volumes(corners)
    parts = [
        signed_volumes(jnp.where((jnp.arange(4) == i)[:, None], local[:, None, :], corners)) for i in range(4)
    ]
    lambdas = jnp.stack(parts, axis=1) / whole
    tet_ids = jnp.zeros(len(points), jnp.int32)
    features = field.features(impostor, tet_ids, lambdas)
    colors = field.radiance(impostor, tet_ids, features, field.encode_directions(impostor, directions))
    return field.density(impostor, tet_ids, features), colors
