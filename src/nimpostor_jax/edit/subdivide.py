"""A finer cage around the same field (Sec. 4.2): exact, and without any training.

The new tets lie in the old ones' field, whose tables they share (`Embedding`). What changes is how finely the
cage can be moved afterwards.
"""

import dataclasses
from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from nimpostor_jax.geometry import subdivide as geometry
from nimpostor_jax.geometry.topology import build_in_frame
from nimpostor_jax.types import Embedding, Gate, NeuralImpostor, Paint

Part = TypeVar("Part", Gate, Paint)


def subdivide(
    impostor: NeuralImpostor, times: int = 1, region: Bool[np.ndarray, " T"] | None = None
) -> NeuralImpostor:
    """The impostor with the tets in a region of its mesh (None: all) cut into eight, `times` times.

    Neighbours of the region are cut where they must be for faces to match; all other tets, and the field
    everywhere, stay as they are. Host code. Raises ValueError for `times` < 0 and a region of another shape.
    """
    if times < 0:
        raise ValueError(f"times must be >= 0, got {times}")
    mesh = impostor.mesh
    tets = np.asarray(mesh.tets)
    fine = geometry.subdivide(np.asarray(mesh.vertices, np.float64), tets, times, region)
    object_ids = np.asarray(mesh.object_ids)[fine.parents]
    rest = impostor.rest_vertices
    if rest is not None:
        rest = jnp.asarray(fine.vertices_of(np.asarray(rest), tets))
    return dataclasses.replace(
        impostor,
        mesh=build_in_frame(mesh, fine.vertices, fine.tets, object_ids, deformed=True),
        embedding=_within(impostor.embedding, fine, mesh.vertices.dtype.name),
        rest_vertices=rest,
        gates=tuple(_by_parent(gate, fine.parents) for gate in impostor.gates),
        paints=tuple(_by_parent(paint, fine.parents) for paint in impostor.paints),
    )


def _by_parent(part: Part, parents: Int[np.ndarray, " U"]) -> Part:
    """A gate or paint is a matter of cells and of the tets' maps, which the children share."""
    return dataclasses.replace(part, corners=part.corners[parents], states=part.states[parents])


def _within(embedding: Embedding | None, fine: geometry.Subdivision, dtype: str) -> Embedding:
    """Where tets are in the cells in which their parents are."""
    cells, lambdas = fine.parents, fine.lambdas
    if embedding is not None:
        parents = np.asarray(embedding.lambdas, np.float64)[fine.parents]
        cells, lambdas = np.asarray(embedding.cells)[fine.parents], fine.lambdas @ parents
    return Embedding(cells=jnp.asarray(cells, jnp.int32), lambdas=jnp.asarray(lambdas, dtype))
