"""Small tetrahedral meshes: (vertices [V,3] float64, tets [T,4]), positively oriented."""

import itertools

import numpy as np
from scipy.spatial import Delaunay

from nimpostor_jax.geometry.topology import build_tet_mesh


def oriented(vertices, tets):
    """The same tets, two corners swapped where the volume is negative."""
    edges = vertices[tets[:, 1:]] - vertices[tets[:, :1]]
    flipped = np.where((np.linalg.det(edges) < 0)[:, None], tets[:, [0, 1, 3, 2]], tets)
    return vertices, flipped.astype(np.int32)


def one_tet():
    vertices = np.array([[0.1, 0.0, 0.0], [1.0, 0.1, -0.1], [0.0, 0.9, 0.2], [0.2, 0.1, 1.1]])
    return oriented(vertices, np.array([[0, 1, 2, 3]]))


def grid(occupied):
    """Six tets (Kuhn) in each unit cell where `occupied` [nx, ny, nz] is true."""
    shape = np.array(occupied.shape) + 1
    vertices = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
    tets = []
    for cell in np.argwhere(occupied):
        for order in itertools.permutations(range(3)):
            path = [cell]
            for axis in order:
                path.append(path[-1] + np.eye(3, dtype=int)[axis])
            tets.append(np.ravel_multi_index(np.array(path).T, shape))
    tets = np.array(tets)
    used = np.unique(tets)
    renumber = np.zeros(len(vertices), int)
    renumber[used] = np.arange(len(used))
    return oriented(vertices[used].astype(float), renumber[tets])


def cube():
    return grid(np.ones((1, 1, 1), bool))


def delaunay(seed=0, count=30, center=(0, 0, 0)):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return oriented(points + center, Delaunay(points).simplices)


def union(*meshes):
    """Several meshes side by side in one."""
    vertices, tets, start = [], [], 0
    for v, t in meshes:
        vertices.append(v)
        tets.append(t + start)
        start += len(v)
    return np.concatenate(vertices), np.concatenate(tets)


def blobs():
    """Two random clouds that do not touch."""
    return union(delaunay(1, 15, (-4, 0, 0)), delaunay(2, 15, (4, 1, 0.5)))


def nonconvex():
    """A bent U of cells with a tunnel, all vertices jittered."""
    occupied = np.ones((3, 3, 2), bool)
    occupied[1, 1:, :] = False
    occupied[0, 1, 1] = False
    vertices, tets = grid(occupied)
    return vertices + np.random.default_rng(3).uniform(-0.08, 0.08, vertices.shape), tets


MESHES = {
    "one_tet": one_tet, "cube": cube, "delaunay": delaunay, "blobs": blobs, "nonconvex": nonconvex,
}  # fmt: skip


def tet_mesh(name, dtype="float32"):
    """A TetMesh by name."""
    return build_tet_mesh(*MESHES[name](), dtype=dtype)


def local_vertices(mesh):
    """A TetMesh's vertices in its own frame and its tets, for the oracles."""
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.tets)
