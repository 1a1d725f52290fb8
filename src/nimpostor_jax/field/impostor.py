"""The field: from a point in a tet to features, density and colour (Eqs. 6 and 7)."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nimpostor_jax.config import ImpostorConfig
from nimpostor_jax.encoding import merged
from nimpostor_jax.encoding.box_grid import build_box_layout
from nimpostor_jax.encoding.hash_grid import encode, init_features
from nimpostor_jax.encoding.layout import build_layout
from nimpostor_jax.encoding.merged import encode_merged
from nimpostor_jax.encoding.spherical_harmonics import spherical_harmonics
from nimpostor_jax.field.decoder import (
    decode_appearance,
    decode_density,
    init_decoders,
    reorder_features,
)
from nimpostor_jax.geometry.polar import nearest_rotation
from nimpostor_jax.geometry.tetrahedron import corners, deformation_gradients
from nimpostor_jax.types import (
    BoxLayout,
    HashLayout,
    HashTables,
    MergedTables,
    NeuralImpostor,
    TetMesh,
)


def init_impostor(key: Array, mesh: TetMesh, config: ImpostorConfig) -> NeuralImpostor:
    """An untrained impostor on a cage: packed tables, one decoder set. Host code: builds the layout."""
    table_key, decoder_key = jax.random.split(key)
    tets = np.asarray(mesh.tets)
    layout: HashLayout | BoxLayout = (
        build_box_layout(np.asarray(mesh.vertices), tets, config.encoding)
        if config.encoding.layout == "box"
        else build_layout(np.asarray(mesh.vertices), tets, config.encoding)
    )
    num_entries = int(layout.starts[-1])
    return NeuralImpostor(
        mesh=mesh,
        tables=HashTables(features=init_features(table_key, num_entries, config.encoding), layout=layout),
        decoders=init_decoders(decoder_key, config),
        decoder_index=jnp.zeros(mesh.tets.shape[0], jnp.int32),
        config=config,
    )


def features(
    impostor: NeuralImpostor,
    tet_ids: Int[Array, " M"],
    lambdas: Float[Array, "M 4"],
    num_used: Int[Array, ""] | None = None,
    known: Float[Array, "M C"] | None = None,
) -> Float[Array, "M C"]:
    """Position features f_p (Eq. 6), of the first `num_used` points where given.

    Features that are `known` are only given their derivatives.
    """
    config = impostor.config.encoding
    tables: HashTables | MergedTables = impostor.tables
    if isinstance(tables, MergedTables):
        if known is None:
            return encode_merged(tables, config, tet_ids, lambdas, num_used)
        return _without_derivative(known, lambdas)
    return encode(tables, config, tet_ids, lambdas, num_used, known)


@jax.custom_jvp
def _without_derivative(known: Float[Array, "M C"], lambdas: Float[Array, "M 4"]) -> Float[Array, "M C"]:
    return known


@_without_derivative.defjvp
def _refuse(primals: tuple, tangents: tuple) -> tuple:
    raise ValueError("levels merged for frames have no derivatives; differentiate what was merged")


def merge_levels(impostor: NeuralImpostor, max_megabytes: float = 256) -> NeuralImpostor:
    """The same impostor with its coarse levels merged, as many as fit (`encoding.merged`).

    For rendering only: frames become faster, but tables can no longer be trained, edited or saved. Host code.
    """
    encoding = impostor.config.encoding
    tables: HashTables | MergedTables = impostor.tables
    if isinstance(tables, MergedTables):
        return impostor
    tables = merged.merge_levels(impostor.tables, encoding, max_megabytes)
    order = merged.feature_order(tables, encoding)
    decoders = reorder_features(impostor.decoders, order)
    return dataclasses.replace(impostor, tables=tables, decoders=decoders)  # type: ignore[arg-type]


def check_unmerged(impostor: NeuralImpostor) -> None:
    """Raise ValueError where levels are merged: such tables cannot be trained, edited or saved."""
    tables: HashTables | MergedTables = impostor.tables
    if isinstance(tables, MergedTables):
        raise ValueError("this impostor's levels are merged for frames; pass the one that was merged")


def density(
    impostor: NeuralImpostor, tet_ids: Int[Array, " M"], point_features: Float[Array, "M C"]
) -> Float[Array, " M"]:
    """Density per unit of the density measure, from features (Eq. 7)."""
    return decode_density(impostor.decoders, point_features, impostor.decoder_index[tet_ids])


def radiance(
    impostor: NeuralImpostor,
    tet_ids: Int[Array, " M"],
    point_features: Float[Array, "M C"],
    direction_features: Float[Array, "M E"],
) -> Float[Array, "M 3"]:
    """Colour from features and encoded view direction (Eq. 7)."""
    return decode_appearance(
        impostor.decoders, point_features, direction_features, impostor.decoder_index[tet_ids]
    )


def only_decoders(impostor: NeuralImpostor) -> NeuralImpostor:
    """What `density` and `radiance` read: as `map_used`'s shared argument, the rest would cost gradients."""
    return dataclasses.replace(
        impostor,
        mesh=None,  # type: ignore[arg-type]
        tables=None,  # type: ignore[arg-type]
        occupied=None,
        embedding=None,
        rest_vertices=None,
        gates=(),
        paints=(),
    )


def rest_rotations(impostor: NeuralImpostor) -> Float[Array, "T 3 3"] | None:
    """How far each tet of the mesh has turned since it was at rest; None where it has not moved."""
    if impostor.rest_vertices is None:
        return None
    mesh = impostor.mesh
    rest, moved = (corners(vertices, mesh.tets) for vertices in (impostor.rest_vertices, mesh.vertices))
    return nearest_rotation(deformation_gradients(rest, moved))


def encode_directions(impostor: NeuralImpostor, directions: Float[Array, "R 3"]) -> Float[Array, "R E"]:
    """Spherical harmonics of the view directions f_d (Eq. 6)."""
    return spherical_harmonics(directions, impostor.config.decoder.sh_degree)
