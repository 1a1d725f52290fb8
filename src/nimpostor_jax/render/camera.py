"""Pinhole cameras and rays. OpenGL axes: the camera looks down -z, y is up; pixel centres lie at + 0.5."""

from functools import cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nimpostor_jax.geometry.intersect import rounded
from nimpostor_jax.types import Camera, Rays, TetMesh

TILE = 16  # pixels on a tile's side


def pixel_rays(camera: Camera, pixels: Float[Array, "*batch 2"]) -> Rays:
    """World-space rays through pixel positions (x right, y down, in pixels; a pixel's centre is at + 0.5).

    Camera fields broadcast against the pixels' leading axes. Differentiable in the camera and the pixels. The
    same bits wherever it is compiled: entries that were found for a pixel hold for its ray in other programs.
    """
    # By the reciprocal, as XLA divides by what is one for all pixels, and not by what each has its own of.
    offset = (pixels - camera.principal) * (1 / camera.focal)
    x, y = offset[..., 0], -offset[..., 1]
    rotation = camera.camera_to_world[..., :3, :3]
    across, up = rounded(rotation[..., 0] * x[..., None]), rounded(rotation[..., 1] * y[..., None])
    directions = across + up - rotation[..., 2]
    squares = rounded(directions * directions)
    norm = jnp.sqrt(squares[..., 0] + squares[..., 1] + squares[..., 2])
    origins = jnp.broadcast_to(camera.camera_to_world[..., :3, 3], directions.shape)
    return Rays(origins=origins, directions=directions / norm[..., None])


def image_pixels(height: int, width: int) -> Float[Array, "height width 2"]:
    """Centres of all pixels of an image."""
    y, x = jnp.meshgrid(jnp.arange(height) + 0.5, jnp.arange(width) + 0.5, indexing="ij")
    return jnp.stack([x, y], axis=-1)


@cache
def tile_order(height: int, width: int) -> Int[np.ndarray, " pixels"]:
    """Pixel indices tile by tile: rays that are neighbours in the list are neighbours in the image.

    Traversal culls and marches consecutive rays together, so rays of an image should come in this order.
    """
    y, x = np.mgrid[0:height, 0:width]
    keys = ((x % TILE).ravel(), (y % TILE).ravel(), (x // TILE).ravel(), (y // TILE).ravel())
    order = np.lexsort(keys).astype(np.int32)  # the same with and without x64
    order.flags.writeable = False  # kept for the next frame
    return order


def to_local(mesh: TetMesh, rays: Rays) -> Rays:
    """World rays in the mesh's own frame; t shrinks by `mesh.scale`, directions keep length 1."""
    return Rays(origins=(rays.origins - mesh.center) / mesh.scale, directions=rays.directions)
