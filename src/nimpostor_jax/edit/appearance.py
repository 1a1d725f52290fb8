"""Blending and appearance (Sec. 4.3, Fig. 7): colours inside a pattern, materials, parts of one colour.

Live, as Boolean operations are: nothing is trained, and everything follows the cage. `remesh.consolidate`
turns the result into a plain field. Density is sculpted by `boolean.gated`.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from nimpostor_jax.config import ImpostorConfig
from nimpostor_jax.edit.boolean import fixed_to
from nimpostor_jax.field.impostor import init_impostor
from nimpostor_jax.field.solids import CLOSED, MIXED, OPEN
from nimpostor_jax.types import NeuralImpostor, Paint, Solid, TetMesh


def recolored(impostor: NeuralImpostor, solid: Solid, color: ArrayLike) -> NeuralImpostor:
    """The impostor with its colours multiplied by `color` [3] inside a solid, both as they stand.

    Raises ValueError for a colour that is not three finite numbers >= 0.
    """
    return _painted(impostor, solid, color, None, 0.0)


def with_material(
    impostor: NeuralImpostor, solid: Solid, material: NeuralImpostor, share: float = 1.0
) -> NeuralImpostor:
    """The impostor with a share of its colours inside a solid taken from another field, in the same place.

    Outside of the material's cage its colour is black: place it with `compose`. Raises ValueError for a share
    outside of [0, 1].
    """
    if not 0 <= share <= 1:
        raise ValueError(f"share must be in [0, 1], got {share}")
    return _painted(impostor, solid, (1, 1, 1), material, share)


def _painted(
    impostor: NeuralImpostor, solid: Solid, color: ArrayLike, source: NeuralImpostor | None, share: float
) -> NeuralImpostor:
    dtype, values = impostor.mesh.vertices.dtype, _checked_color(color)
    corners, full, empty = fixed_to(impostor, solid)
    paint = Paint(
        solid=solid,
        corners=corners,
        states=jnp.asarray(np.select([full, empty], [CLOSED, OPEN], MIXED), jnp.int32),
        color=jnp.asarray(values, dtype),
        source=source,
        share=jnp.asarray(share, dtype),
    )
    return dataclasses.replace(impostor, paints=(*impostor.paints, paint))


def _checked_color(color: ArrayLike) -> np.ndarray:
    values = np.asarray(color, np.float64)
    if values.shape != (3,) or not np.isfinite(values).all() or (values < 0).any():
        raise ValueError(f"a colour must be three finite numbers >= 0, got {np.asarray(color).tolist()}")
    return values


def uniform(mesh: TetMesh, color: ArrayLike, density: float, config: ImpostorConfig) -> NeuralImpostor:
    """An impostor of one colour, in (0, 1), and one density per barycentric unit: raw material for solids.

    Raises ValueError for a colour outside of (0, 1) or a density that is not positive.
    """
    values = _checked_color(color)
    if not np.all((values > 0) & (values < 1)):
        raise ValueError(f"the colour must be in (0, 1), got {values.tolist()}")
    if not 0 < density < np.inf:
        raise ValueError(f"density must be positive, got {density}")
    made = init_impostor(jax.random.key(0), mesh, config)
    decoders = jax.tree.map(jnp.zeros_like, made.decoders)
    for name, bias in (("density", np.log([density])), ("appearance", np.log(values / (1 - values)))):
        decoders[name][-1]["bias"] += jnp.asarray(bias, jnp.float32)
    tables = dataclasses.replace(made.tables, features=jnp.zeros_like(made.tables.features))
    return dataclasses.replace(made, tables=tables, decoders=decoders)
