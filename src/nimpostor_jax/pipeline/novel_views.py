"""Pictures that an impostor renders of itself from between the cameras of a scene."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from tqdm.auto import tqdm

from nimpostor_jax.config import RenderConfig
from nimpostor_jax.io.blender import PosedImages
from nimpostor_jax.pipeline.evaluate import camera_of
from nimpostor_jax.render.frame import frame_config, render_frame
from nimpostor_jax.types import NeuralImpostor

NEIGHBOURS = 6  # of a camera; a new one lies between it and two of them
MIN_COSINE = 0.5  # of directions of view: means of cameras that face each other would lie in the object


def with_novel_views(
    views: PosedImages, impostor: NeuralImpostor, count: int, config: RenderConfig, seed: int = 0
) -> PosedImages:
    """The views and `count` more from between their cameras, as the impostor shows them.

    Lenses are those of views. Where the views have backgrounds, the new ones stand before plain colours.
    """
    if not count:
        return views
    rng = np.random.default_rng(seed)
    poses = poses_between(views.camera_to_world, count, rng)
    lenses = rng.integers(len(views), size=count)
    size = views.images.shape[1:3]
    backgrounds = None
    if views.backgrounds is not None:  # colours of all kinds, so that what is opaque shows
        plain = rng.uniform(size=(count, 1, 1, 3)).astype(views.backgrounds.dtype)
        backgrounds = np.broadcast_to(plain, (count, *size, 3))
        backgrounds = np.concatenate([views.backgrounds, backgrounds])
    first = len(views)
    images = np.empty((first + count, *size, 4), views.images.dtype)
    images[:first] = views.images
    both = PosedImages(
        images=images,
        camera_to_world=np.concatenate([views.camera_to_world, poses]),
        focal=np.concatenate([views.focal, views.focal[lenses]]),
        principal=np.concatenate([views.principal, views.principal[lenses]]),
        names=views.names + tuple(f"between_{i}" for i in range(count)),
        has_alpha=np.concatenate([views.has_alpha, np.full(count, backgrounds is None)]),
        backgrounds=backgrounds,
    )
    sized = frame_config(impostor, camera_of(both, first), config)
    for i in tqdm(range(first, first + count), desc="novel views", unit="view", disable=None):
        frame = render_frame(impostor, camera_of(both, i), sized)
        images[i] = np.concatenate([frame.color, frame.opacity[..., None]], axis=-1)
        if backgrounds is not None:
            images[i, ..., :3] += (1 - frame.opacity[..., None]) * backgrounds[i]
            images[i, ..., 3] = 1
    return both


def poses_between(
    camera_to_world: Float[np.ndarray, "N 4 4"], count: int, rng: np.random.Generator
) -> Float[np.ndarray, "count 4 4"]:
    """Poses between random cameras and two each of their `NEIGHBOURS`, by random weights that add up to 1.

    Neighbours are near in place, measured in the spread of all places, and in direction of view, within
    60 degrees of it.
    """
    places, rotations = camera_to_world[:, :3, 3], camera_to_world[:, :3, :3]
    spread = np.linalg.norm(places - places.mean(axis=0), axis=1).max()
    keys = np.concatenate([places / max(spread, 1e-12), rotations[:, :, 2]], axis=1)
    distances = np.linalg.norm(keys[:, None] - keys, axis=-1)
    alike = rotations[:, :, 2] @ rotations[:, :, 2].T > MIN_COSINE
    near = np.argsort(np.where(alike, distances, np.inf), axis=1)[:, : NEIGHBOURS + 1]  # itself first
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose in poses:
        camera = rng.integers(len(near))
        others = near[camera, 1:]
        others = others[alike[camera, others]]
        chosen = np.concatenate([[camera], rng.permutation(others)[:2]])
        weights = rng.dirichlet(np.ones(len(chosen)))
        pose[:3, 3] = weights @ places[chosen]
        pose[:3, :3] = Rotation.from_matrix(rotations[chosen]).mean(weights).as_matrix()
    return poses
