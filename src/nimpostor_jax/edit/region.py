"""Cells of their own for the tets that an edit changes, beside a field that stays to the last bit (Sec. 4.2).

A region's tables stand behind those of the old field, level by level, and its decoders are copies of those
that its tets had. What is trained is taken out and put back by index, so that nothing else can change.

Host code but for `trained_part` and `with_trained_part`. Axes: T tets of the mesh, C cells, D decoder sets.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.encoding.layout import build_layout, join_layouts
from nimpostor_jax.field.decoder import num_decoder_sets
from nimpostor_jax.field.impostor import check_unmerged
from nimpostor_jax.types import Embedding, HashLayout, HashTables, NeuralImpostor, TetMesh


@struct.dataclass
class Region:
    """What local retraining changes in an impostor."""

    tets: Int[Array, " n"]  # of the mesh
    entries: Int[Array, " m"]  # of the tables
    decoder_sets: Int[Array, " d"]
    sources: Int[Array, " n"] | None = None  # tets of the old mesh that are the same; None: there are none
    seen: Float[Array, "n parts"] | None = None  # how much is seen of each part of the tets, where known


def with_region(
    field: NeuralImpostor,
    mesh: TetMesh,
    cells: Int[np.ndarray, " T"],
    lambdas: Float[np.ndarray, "T 4 4"],
    like: Int[np.ndarray, " T"],
) -> tuple[NeuralImpostor, Region]:
    """An impostor on a mesh whose tets lie in cells of a field, or have a new one where `cells` is -1.

    `lambdas` are the tets' corners in their cells; `like` are the cells whose decoders new ones begin with.
    New cells' tables are zeros. Where no tet lies in an old cell, the old field is left behind. Raises
    ValueError for layouts that know no tets.
    """
    check_unmerged(field)
    if not isinstance(field.tables.layout, HashLayout):
        raise ValueError(f"layout {field.config.encoding.layout!r} has no tables of single tets to retrain")
    changed = np.flatnonzero(cells < 0)
    alone = len(changed) == len(cells)
    index = np.asarray(field.decoder_index)
    features, layout, decoders = field.tables.features, field.tables.layout, field.decoders
    entries, num_sets, num_cells = np.zeros(0, np.int64), num_decoder_sets(decoders), len(index)
    sets = np.arange(0)
    if alone:
        num_cells, index = 0, index[:0]
    if len(changed):
        own = build_layout(np.asarray(mesh.vertices), np.asarray(mesh.tets)[changed], field.config.encoding)
        layouts = [own] if alone else [layout, own]
        layout = own if alone else join_layouts(layouts)
        features, entries = _own_entries(None if alone else field.tables, own, layout, features)
        used, slots = np.unique(np.asarray(field.decoder_index)[like[changed]], return_inverse=True)
        first = 0 if alone else num_sets
        sets = np.arange(first, first + len(used))
        copies = jax.tree.map(lambda x: x[used], decoders)
        if not alone:
            copies = jax.tree.map(lambda x, new: jnp.concatenate([x, new]), decoders, copies)
        decoders, index = copies, np.concatenate([index, first + slots])
    placed = cells.copy()
    placed[changed] = num_cells + np.arange(len(changed))
    places = lambdas.copy()
    places[changed] = np.eye(4)
    dtype = mesh.vertices.dtype
    trivial = np.array_equal(placed, np.arange(len(cells))) and np.all(places == np.eye(4))
    embedding = Embedding(cells=jnp.asarray(placed, jnp.int32), lambdas=jnp.asarray(places, dtype))
    impostor = NeuralImpostor(
        mesh=mesh,
        tables=HashTables(features=features, layout=layout),
        decoders=decoders,
        decoder_index=jnp.asarray(index, jnp.int32),
        config=field.config,
        occupied=_occupied(field.occupied, len(changed), alone),
        embedding=None if trivial and len(index) == len(cells) else embedding,
    )
    region = Region(
        tets=jnp.asarray(changed, jnp.int32),
        entries=jnp.asarray(entries, jnp.int32),
        decoder_sets=jnp.asarray(sets, jnp.int32),
    )
    return impostor, region


def _own_entries(
    old: HashTables | None, own: HashLayout, joined: HashLayout, like: Float[Array, "entries F"]
) -> tuple[Float[Array, "entries F"], Int[np.ndarray, " m"]]:
    """Features of old and new cells, level by level, and the numbers of the new ones' entries."""
    parts, entries = [], []
    for level in range(own.regions.shape[0]):
        if old is not None:
            parts.append(old.features[int(old.layout.starts[level]) : int(old.layout.starts[level + 1])])
        size, end = int(own.starts[level + 1] - own.starts[level]), int(joined.starts[level + 1])
        parts.append(jnp.zeros((size, like.shape[1]), like.dtype))
        entries.append(np.arange(end - size, end))
    return jnp.concatenate(parts), np.concatenate(entries)


def _occupied(
    occupied: Bool[Array, "C parts"] | None, num_new: int, alone: bool
) -> Bool[Array, "cells parts"] | None:
    """New cells may hold something anywhere, until `probe.occupancy_of` says where."""
    if occupied is None:
        return None
    new = jnp.ones((num_new, occupied.shape[1]), bool)
    return new if alone else jnp.concatenate([occupied, new])


def entries_of(features: Float[Array, "entries F"], region: Region) -> Float[Array, "m F"]:
    """The region's rows of tables: all of them, in order, where nothing of an old field is left."""
    return features if _is_all(features, region) else features[region.entries]


def _is_all(features: Float[Array, "entries F"], region: Region) -> bool:
    return region.entries.shape[0] == features.shape[0]


def trained_part(impostor: NeuralImpostor, region: Region) -> dict[str, Any]:
    """The region's features and decoders, in arrays of their own: steps consume them."""
    return {
        "features": jnp.copy(entries_of(impostor.tables.features, region)),
        "decoders": jax.tree.map(lambda x: x[region.decoder_sets], impostor.decoders),
    }


def with_trained_part(impostor: NeuralImpostor, region: Region, part: dict[str, Any]) -> NeuralImpostor:
    """The impostor with its region's features and decoders replaced; all others keep their bits."""
    features = part["features"]
    if not _is_all(impostor.tables.features, region):
        features = impostor.tables.features.at[region.entries].set(features)
    decoders = jax.tree.map(
        lambda x, new: x.at[region.decoder_sets].set(new), impostor.decoders, part["decoders"]
    )
    tables = dataclasses.replace(impostor.tables, features=features)
    return dataclasses.replace(impostor, tables=tables, decoders=decoders)
