"""Several impostors as one (Fig. 4, Eq. 16): meshes side by side, tables and decoders behind each other.

The result is an impostor like any other: rays merge the samples of tets that overlap, under one
transmittance, and each object keeps its own decoders. Nothing is trained: every object looks as it did.

Host code, NumPy. Axes: V vertices, T tets, C cells of the field, L levels.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from nimpostor_jax.config import ImpostorConfig
from nimpostor_jax.encoding.layout import join_layouts
from nimpostor_jax.field.decoder import Parameters
from nimpostor_jax.field.impostor import check_unmerged
from nimpostor_jax.geometry.topology import build_tet_mesh, world_vertices
from nimpostor_jax.render.occupancy import finer_cells
from nimpostor_jax.types import Embedding, HashLayout, HashTables, NeuralImpostor


def compose(
    impostors: Sequence[NeuralImpostor], transforms: Sequence[ArrayLike | None] | None = None
) -> NeuralImpostor:
    """One impostor of several, each placed by a 4x4 matrix (affine, positive determinant; None: as it is).

    Objects are numbered in `mesh.object_ids`, those of impostors that are composed themselves too. Impostors
    may have different cages, numbers of levels and table sizes, but must agree in everything else of their
    configs. With `RenderConfig.directions` "rest" each object's view dependence turns with it. Densities must
    be barycentric (`RenderConfig.density_measure`): Euclidean ones are per unit of a frame that changes here.

    Raises:
        ValueError: no impostor, as many transforms as there are not impostors, a matrix that is not affine or
            mirrors, or configs that cannot be mixed (naming the impostor and the field).
    """
    if not impostors:
        raise ValueError("compose needs at least one impostor")
    transforms = [None] * len(impostors) if transforms is None else list(transforms)
    if len(transforms) != len(impostors):
        raise ValueError(f"{len(transforms)} transforms for {len(impostors)} impostors; one each, or None")
    matrices = [_affine(matrix, i) for i, matrix in enumerate(transforms)]
    config = _common_config([impostor.config for impostor in impostors])

    vertices = [
        world_vertices(each.mesh) @ matrix[:3, :3].T + matrix[:3, 3]
        for each, matrix in zip(impostors, matrices, strict=True)
    ]
    tets = _shifted([np.asarray(each.mesh.tets) for each in impostors], [len(v) for v in vertices])
    objects = [np.asarray(each.mesh.object_ids) for each in impostors]
    objects = _shifted(objects, [ids.max() + 1 for ids in objects])
    dtype = impostors[0].mesh.vertices.dtype.name
    mesh = build_tet_mesh(
        np.concatenate(vertices), np.concatenate(tets), np.concatenate(objects), dtype, deformed=True
    )

    features, layout = _joined_tables(impostors)
    num_tets = [each.mesh.tets.shape[0] for each in impostors]
    num_cells = [each.decoder_index.shape[0] for each in impostors]
    num_sets = [jax.tree.leaves(each.decoders)[0].shape[0] for each in impostors]
    index = _shifted([np.asarray(each.decoder_index) for each in impostors], num_sets)
    decoders = [_padded(each.decoders, each.config, config) for each in impostors]
    return NeuralImpostor(
        mesh=mesh,
        tables=HashTables(features=features, layout=layout),
        decoders=jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *decoders),
        decoder_index=jnp.asarray(np.concatenate(index), jnp.int32),
        config=config,
        occupied=_joined_occupancy(impostors),
        embedding=_joined_embedding(impostors, num_cells, dtype),
        rest_vertices=_joined_rest(impostors, transforms, mesh.scale),
        gates=_joined([each.gates for each in impostors], num_tets),
        paints=_joined([each.paints for each in impostors], num_tets),
    )


def _affine(matrix: ArrayLike | None, index: int) -> Float[np.ndarray, "4 4"]:
    values = np.eye(4) if matrix is None else np.asarray(matrix, np.float64)
    if values.shape != (4, 4) or not np.isfinite(values).all() or not np.allclose(values[3], [0, 0, 0, 1]):
        raise ValueError(
            f"transform {index} must be a finite 4x4 matrix with last row 0 0 0 1, got {values.tolist()}"
        )
    if not np.linalg.det(values[:3, :3]) > 0:
        raise ValueError(f"transform {index} mirrors or flattens: its determinant must be > 0")
    return values


def _common_config(configs: Sequence[ImpostorConfig]) -> ImpostorConfig:
    """The config of the impostor with most levels. Raises ValueError where others differ in what cannot."""
    first = max(configs, key=lambda config: config.encoding.num_levels)
    # Table sizes are in the layouts; what `init_scale` and `density_bias` began with is trained away.
    free = {"num_levels", "log2_table_size", "min_log2_tet_table", "max_log2_tet_table", "log2_tet_table"}
    free |= {"init_scale", "density_bias"}
    for i, config in enumerate(configs):
        for part in ("encoding", "decoder"):
            ours, theirs = (dataclasses.asdict(getattr(c, part)) for c in (first, config))
            wrong = [name for name in ours if name not in free and ours[name] != theirs[name]]
            if wrong:
                raise ValueError(
                    f"impostor {i} has {part} {wrong[0]} = {theirs[wrong[0]]!r}, another {ours[wrong[0]]!r}; "
                    "train both with the same config"
                )
        if config.encoding.layout == "box":
            raise ValueError(f"impostor {i} has a Cartesian grid (layout 'box'), which cannot be placed anew")
    return first


def _shifted(parts: Sequence[np.ndarray], sizes: Sequence[int]) -> list[np.ndarray]:
    """Indices of each part, counted on from those before."""
    starts = np.cumsum([0, *sizes[:-1]])
    return [part + start for part, start in zip(parts, starts, strict=True)]


def _joined_tables(impostors: Sequence[NeuralImpostor]) -> tuple[Float[jax.Array, "entries F"], HashLayout]:
    """All features, level by level; a level that an impostor does not have is one entry of zeros for it."""
    for each in impostors:
        check_unmerged(each)
    layouts: list[HashLayout] = [each.tables.layout for each in impostors]  # type: ignore[misc]
    joined = join_layouts(layouts)
    features = []
    for level in range(joined.regions.shape[0]):
        for each, layout in zip(impostors, layouts, strict=True):
            table, starts = each.tables.features, np.asarray(layout.starts)
            if level < layout.regions.shape[0]:
                features.append(table[starts[level] : starts[level + 1]])
            else:
                features.append(jnp.zeros_like(table[:1]))
    return jnp.concatenate(features), joined


def _padded(decoders: Parameters, config: ImpostorConfig, wanted: ImpostorConfig) -> Parameters:
    """Decoders that also take, and ignore, the features of levels that their own field does not have."""
    own, missing = config.encoding.feature_dim, wanted.encoding.feature_dim - config.encoding.feature_dim
    padded = {}
    for name, layers in decoders.items():
        weight = layers[0]["weight"]
        zeros = jnp.zeros((weight.shape[0], missing, weight.shape[2]), weight.dtype)
        weight = jnp.concatenate([weight[:, :own], zeros, weight[:, own:]], axis=1)
        padded[name] = [{**layers[0], "weight": weight}, *layers[1:]]
    return padded


def _joined_occupancy(impostors: Sequence[NeuralImpostor]) -> jax.Array | None:
    """At the finest of their resolutions; all of an impostor that has none counts as occupied."""
    known = [each.occupied.shape[1] for each in impostors if each.occupied is not None]
    if not known:
        return None
    parts = max(known)
    return jnp.concatenate(
        [
            jnp.ones((each.decoder_index.shape[0], parts), bool)
            if each.occupied is None
            else finer_cells(each.occupied, parts)
            for each in impostors
        ]
    )


def _joined_embedding(
    impostors: Sequence[NeuralImpostor], num_cells: Sequence[int], dtype: str
) -> Embedding | None:
    if all(each.embedding is None for each in impostors):
        return None
    embeddings = [each.embedding or identity_embedding(each) for each in impostors]
    cells = _shifted([np.asarray(embedding.cells) for embedding in embeddings], num_cells)
    return Embedding(
        cells=jnp.asarray(np.concatenate(cells), jnp.int32),
        lambdas=jnp.concatenate([embedding.lambdas.astype(dtype) for embedding in embeddings]),
    )


def identity_embedding(impostor: NeuralImpostor) -> Embedding:
    """Tets that are cells."""
    count = impostor.mesh.tets.shape[0]
    eye = jnp.eye(4, dtype=impostor.mesh.vertices.dtype)
    return Embedding(cells=jnp.arange(count, dtype=jnp.int32), lambdas=jnp.broadcast_to(eye, (count, 4, 4)))


def _joined_rest(
    impostors: Sequence[NeuralImpostor], transforms: Sequence[Any], scale: jax.Array
) -> Float[jax.Array, "V 3"] | None:
    """Where all were at rest, each in its own world; None where nothing has moved since."""
    if all(matrix is None for matrix in transforms) and all(e.rest_vertices is None for e in impostors):
        return None
    rests = [e.mesh.vertices if e.rest_vertices is None else e.rest_vertices for e in impostors]
    # Sizes count, places do not: of a rest shape only edges are used.
    return jnp.concatenate(
        [rest * (each.mesh.scale / scale) for rest, each in zip(rests, impostors, strict=True)]
    )


def _joined(parts: Sequence[tuple[Any, ...]], num_tets: Sequence[int]) -> tuple[Any, ...]:
    """All gates, or paints; each is open for the tets of other impostors."""
    joined = []
    for i, own in enumerate(parts):
        around = sum(num_tets[:i]), sum(num_tets[i + 1 :])
        for part in own:
            corners = jnp.pad(part.corners, (around, (0, 0), (0, 0)))
            joined.append(dataclasses.replace(part, corners=corners, states=jnp.pad(part.states, around)))
    return tuple(joined)


def object_tets(impostor: NeuralImpostor, object_id: int) -> Int[np.ndarray, " tets"]:
    """The tets of one object. Raises ValueError where there is none of that number."""
    ids = np.asarray(impostor.mesh.object_ids)
    found = np.flatnonzero(ids == object_id)
    if not found.size:
        raise ValueError(f"there is no object {object_id}; objects: {np.unique(ids).tolist()}")
    return found
