"""Reference back end on the host: point queries and ray segments through Embree (trimesh and
embreex).

Wald et al. 2019: the scene holds every face of the cage once, and each face knows the tet in front
of it and the tet behind. The first face that a ray from a point hits, and the side from which it
does, name the tet. World units, float64 in and out; Embree itself traces in float32, so points and
segments within about 1e-6 of the cage's size from a face may be given to either side. `t` is
recomputed in float64.

Only single-hit queries are used: embreex's multi-hit query returned a wrong number of hits on some
rays.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int
from trimesh.ray.ray_pyembree import RayMeshIntersector

from nimpostor_jax.geometry.tetrahedron import FACES

_DIRECTION = np.array([0.5377, 0.6271, 0.5637])  # generic: parallel to no face that a tidy mesh would have
_RESTART = 1e-5  # of the cage's size: how far behind a hit the next query starts


@dataclass(frozen=True)
class EmbreeSegments:
    """The tets that rays cross, one entry a segment, ordered by ray and along each ray."""

    rays: Int[np.ndarray, " S"]
    tets: Int[np.ndarray, " S"]
    t_enter: Float[np.ndarray, " S"]
    t_exit: Float[np.ndarray, " S"]


class EmbreeQuery:
    """Point location and ray casting in a tet mesh with valid, positively oriented tets."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"]) -> None:
        vertices, tets = np.asarray(vertices, np.float64), np.asarray(tets, np.int64)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        self._center, self._scale = (low + high) / 2, float(np.linalg.norm(high - low)) / 2

        faces = tets[:, np.array(FACES)].reshape(-1, 3)  # counter-clockwise from outside
        owners = np.repeat(np.arange(len(tets)), 4)
        _, first, inverse = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True)
        inverse = inverse.reshape(-1)
        if np.bincount(inverse).max() > 2:
            face = np.argmax(np.bincount(inverse))
            raise ValueError(f"face {faces[first[face]].tolist()} belongs to more than two tets")
        self._behind = owners[first]  # the normal points out of the tet that names the face first
        self._front = np.full(len(first), -1, np.int64)
        others = np.ones(len(faces), bool)
        others[first] = False
        self._front[inverse[others]] = owners[others]

        local = (vertices - self._center) / self._scale
        corners = local[faces[first]]
        self._normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._anchors = corners[:, 0]
        surface = trimesh.Trimesh(local, faces[first], process=False, validate=False)
        self._intersector = RayMeshIntersector(surface)

    def locate(self, points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"]:
        """The tet of each point, -1 outside, by one ray a point (winding-order test)."""
        points = np.asarray(points, np.float64)
        direction = np.broadcast_to(_DIRECTION / np.linalg.norm(_DIRECTION), points.shape)
        face = self._first_faces((points - self._center) / self._scale, direction)
        return self._near_side(face, direction)

    def first_hits(
        self, origins: Float[np.ndarray, "R 3"], directions: Float[np.ndarray, "R 3"]
    ) -> tuple[Float[np.ndarray, " R"], Int[np.ndarray, " R"]]:
        """Where each ray hits its first face, as t, and the tet behind it; inf and -1 where it hits
        none.

        The tet is -1 too where the ray leaves the cage. Directions have length 1.
        """
        directions = np.asarray(directions, np.float64)
        local = (np.asarray(origins, np.float64) - self._center) / self._scale
        face = self._first_faces(local, directions)
        return self._scale * self._distance(face, local, directions), self._near_side(face, -directions)

    def segments(
        self, origins: Float[np.ndarray, "R 3"], directions: Float[np.ndarray, "R 3"]
    ) -> EmbreeSegments:
        """All tets that each ray crosses after its origin, by single-hit queries restarted behind
        each hit.

        Segments shorter than about 1e-5 of the cage's size may be missing; a neighbour covers their
        length.
        """
        directions = np.asarray(directions, np.float64)
        local = (np.asarray(origins, np.float64) - self._center) / self._scale
        reached = np.zeros(len(local))
        live = np.arange(len(local))
        none = np.zeros(0, np.int64)
        found = [(none, none, np.zeros(0), np.zeros(0))]
        while live.size:
            start = np.where(reached[live] > 0, reached[live] + _RESTART, 0.0)
            face = self._first_faces(local[live] + start[:, None] * directions[live], directions[live])
            live, face = live[face >= 0], face[face >= 0]
            t = np.maximum(self._distance(face, local[live], directions[live]), reached[live])
            tet = self._near_side(face, directions[live])
            inside = tet >= 0
            found.append((live[inside], tet[inside], reached[live][inside], t[inside]))
            # A grazed face may be reported again from its own restart: always advance.
            reached[live] = np.maximum(t, reached[live] + _RESTART)
        rays, tets, t_enter, t_exit = (np.concatenate(column) for column in zip(*found, strict=True))
        order = np.lexsort((t_enter, rays))
        return EmbreeSegments(
            rays=rays[order],
            tets=tets[order],
            t_enter=self._scale * t_enter[order],
            t_exit=self._scale * t_exit[order],
        )

    def _first_faces(
        self, origins: Float[np.ndarray, "R 3"], directions: Float[np.ndarray, "R 3"]
    ) -> Int[np.ndarray, " R"]:
        if not len(origins):
            return np.zeros(0, np.int64)
        return np.asarray(self._intersector.intersects_first(origins, directions), np.int64)

    def _near_side(
        self, face: Int[np.ndarray, " R"], directions: Float[np.ndarray, "R 3"]
    ) -> Int[np.ndarray, " R"]:
        """The tet from which a ray arrives at a face; -1 where there is no face or no tet."""
        leaves = np.sum(self._normals[face] * directions, axis=1) > 0
        return np.where(face >= 0, np.where(leaves, self._behind[face], self._front[face]), -1)

    def _distance(
        self,
        face: Int[np.ndarray, " R"],
        origins: Float[np.ndarray, "R 3"],
        directions: Float[np.ndarray, "R 3"],
    ) -> Float[np.ndarray, " R"]:
        """t at the plane of the face; inf where there is no face or the ray runs along it."""
        slope = np.sum(self._normals[face] * directions, axis=1)
        height = np.sum(self._normals[face] * (self._anchors[face] - origins), axis=1)
        crosses = (face >= 0) & (slope != 0)
        return np.where(crosses, height / np.where(crosses, slope, 1.0), np.inf)
