"""From photographs without masks to a dataset folder and a cage (the role that NSR plays in the paper).

A coarse field is fitted in the region that the cameras look at, before the surroundings estimated from what
misses it; where the field takes light, there is the object, and an envelope around that is the cage.
"""

import dataclasses
import json
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy import ndimage

from nimpostor_jax.config import ExperimentConfig, RenderConfig
from nimpostor_jax.config_dict import to_dict
from nimpostor_jax.field import impostor as field
from nimpostor_jax.io.atomic import atomic_folder
from nimpostor_jax.io.blender import load_blender
from nimpostor_jax.io.capture import common_crops, read_capture, write_backgrounds, write_views
from nimpostor_jax.io.transforms import check_near_origin, read_json
from nimpostor_jax.pipeline.evaluate import write_json
from nimpostor_jax.pipeline.fit import fit
from nimpostor_jax.pipeline.prepare import Log, Scene, prepare_views
from nimpostor_jax.preprocess.cage import Cage, cage_from_grid
from nimpostor_jax.preprocess.surroundings import (
    Region,
    Surroundings,
    estimate_surroundings,
    pixel_directions,
    region_from_cameras,
)
from nimpostor_jax.preprocess.tetrahedralize import box_tets
from nimpostor_jax.preprocess.visual_hull import OccupancyGrid
from nimpostor_jax.render.camera import pixel_rays
from nimpostor_jax.render.composite import sample_weights
from nimpostor_jax.render.renderer import render_samples, sample_densities
from nimpostor_jax.train.pool import PixelPool
from nimpostor_jax.types import NeuralImpostor

RECORD = "capture.json"  # in the dataset folder: where it came from
# Of all pictures together. Training holds 28 bytes of each, and 50 more of those that meet the cage.
_MAX_PIXELS = 100_000_000
_SURROUNDINGS_WIDTH = 256  # pixels of the pictures from which the surroundings are read
_LOOK = 16  # pixels between the rays that look for the region
_SEARCH_VOXELS = 64  # along the region, while the object's box is sought
_MIN_LIGHT = 0.1  # of a ray's light that a voxel takes in at least ...
_MIN_VIEWS = 3  # ... so many views, to be the object's
_MIN_PART = 0.05  # of the main component's voxels: smaller ones are floaters
_RAYS = 4096  # at once
_MAX_RAYS = 600_000  # that look for voxels
_NEAR_WALL = 1.5  # voxels
_VOXEL_PIXELS = 0.75  # across the finest voxel


def make_scene(
    data: str | Path,
    workdir: Path,
    config: ExperimentConfig,
    region: Region | None = None,
    log: Log = print,
) -> tuple[Path, Region]:
    """Write `workdir`/scene, an ordinary dataset folder with backgrounds, from a folder of photographs.

    Every `DataConfig.test_every`-th view is held out. A folder that is there already is taken as it is where
    it was made from the same input. `region`, in the world of the given poses, is else found from cameras.
    """
    folder = workdir / "scene"
    asked = {"data": str(Path(data).expanduser().resolve()), "test_every": config.data.test_every}
    asked["box"] = None if region is None else region.bounds.tolist()
    if folder.exists():
        record = _read_record(folder)
        if {key: record.get(key) for key in asked} != asked:
            raise ValueError(
                f"{folder} was made from other input ({record}); remove {workdir} or use another --workdir"
            )
        log(f"{folder}: made already")
        lower, upper = np.array(record["bounds"])
        return folder, Region(lower, upper, record["is_ball"])
    later = [name for name in ("coarse", "cage.npz", "checkpoints") if (workdir / name).exists()]
    if later:  # they would be taken for this capture's
        raise ValueError(
            f"{workdir} has no scene, but {', '.join(later)} of an earlier one; remove {workdir} or use "
            "another --workdir"
        )
    capture = read_capture(data, workdir, log)
    crops, width, height = common_crops(capture, log)
    if config.data.resolution is None:
        width, height = affordable_size(width, height, len(capture.paths), log)
    elif config.data.resolution > width:
        raise ValueError(
            f"DataConfig.resolution = {config.data.resolution}, but what all undistorted images have in "
            f"common is {width} pixels wide; lower it"
        )
    lenses = [crop.intrinsics(width, height) for crop in crops]
    focal, principal = (np.array(values) for values in zip(*lenses, strict=True))
    check_near_origin(capture.camera_to_world, focal, capture.source)
    if region is None:
        names = [str(path) for path in capture.paths]
        region = region_from_cameras(capture.camera_to_world, focal, principal, width, height, names)
    check_seen(region, capture.camera_to_world, focal, principal, width, height)
    log(f"region of interest {np.round(region.bounds, 4).tolist()}; images {width} x {height}")
    is_test = np.arange(len(capture.paths)) % config.data.test_every == 0
    with atomic_folder(folder) as partial:
        for split, chosen in (("train", ~is_test), ("test", is_test)):
            write_views(capture, partial, np.flatnonzero(chosen), split, crops, (width, height))
        train = load_blender(partial, "train", min(width, _SURROUNDINGS_WIDTH))
        surroundings = estimate_surroundings(
            train.images[..., :3], train.camera_to_world, train.focal, train.principal, region
        )
        log(f"surroundings: {surroundings.known_share:.0%} of what is behind the region was seen past it")
        for split, chosen in (("train", ~is_test), ("test", is_test)):
            cameras = (capture.camera_to_world[chosen], focal[chosen], principal[chosen])
            write_backgrounds(partial, split, _backgrounds(*cameras, width, height, surroundings))
        bounds = {"bounds": region.bounds.tolist(), "is_ball": region.is_ball}
        write_json(partial / RECORD, asked | bounds)
    return folder, region


def affordable_size(width: int, height: int, count: int, log: Log = print) -> tuple[int, int]:
    """The size of so many pictures, all of which training holds in memory: `_MAX_PIXELS` at most."""
    share = _MAX_PIXELS / (width * height * count)
    if share >= 1:
        return width, height
    small = max(1, int(width * share**0.5))
    log(
        f"{count} images of {width} x {height} are reduced to {small} pixels in width, for memory; "
        "DataConfig.resolution asks for another, in a new --workdir"
    )
    return small, max(1, round(height * small / width))


def box_region(box: Sequence[float]) -> Region:
    """The region (x0, y0, z0, x1, y1, z1). Raises ValueError where it is not a box with volume."""
    corners = np.asarray(box, np.float64)
    if corners.shape != (6,) or not np.isfinite(corners).all() or (corners[:3] >= corners[3:]).any():
        raise ValueError(f"--box must be x0 y0 z0 x1 y1 z1 with x0 < x1, y0 < y1, z0 < z1, got {list(box)}")
    return Region(corners[:3], corners[3:])


def _read_record(folder: Path) -> dict[str, Any]:
    path = folder / RECORD
    if not path.is_file():
        raise ValueError(f"{folder} is not a capture's (no {RECORD}); remove it or use another --workdir")
    return json.loads(path.read_text(encoding="utf-8"))


def check_seen(
    region: Region,
    camera_to_world: Float[np.ndarray, "N 4 4"],
    focal: Float[np.ndarray, "N 2"],
    principal: Float[np.ndarray, "N 2"],
    width: int,
    height: int,
) -> None:
    """Raise ValueError where no camera sees the region, by one ray in a square of `_LOOK` pixels a side."""
    small = max(1, width // _LOOK), max(1, height // _LOOK)
    zoom = np.array(small) / [width, height]
    for pose, lens, center in zip(camera_to_world, focal * zoom, principal * zoom, strict=True):
        if not region.is_missed(pose[:3, 3], pixel_directions(pose, lens, center, *small)).all():
            return
    raise ValueError(
        f"no camera sees the region {np.round(region.bounds, 4).tolist()}; give another --box, in the poses' "
        "world"
    )


def _backgrounds(
    camera_to_world: Float[np.ndarray, "N 4 4"],
    focal: Float[np.ndarray, "N 2"],
    principal: Float[np.ndarray, "N 2"],
    width: int,
    height: int,
    surroundings: Surroundings,
) -> Iterator[Float[np.ndarray, "H W 3"]]:
    for pose, lens, center in zip(camera_to_world, focal, principal, strict=True):
        yield surroundings(pixel_directions(pose, lens, center, width, height))


def captured_cage(
    folder: Path,
    region: Region,
    config: ExperimentConfig,
    coarse: ExperimentConfig,
    workdir: Path,
    log: Log = print,
) -> Cage:
    """A cage around what a coarse field, fitted in the region, finds there.

    `coarse` configures the fit (NGP-Bounded), whose checkpoints go to `workdir`/coarse; `config.cage` the
    cage. Raises ValueError where the field finds nothing, where that folder's fit has another configuration,
    or as in `cage_from_grid`.
    """
    check_coarse(coarse, workdir)
    write_json(workdir / "coarse" / "config.json", to_dict(coarse))
    width = read_json(folder, folder / "transforms_train.json")["w"]
    train = load_blender(folder, "train", min(coarse.data.resolution or width, width))
    scene = prepare_views(coarse, train, train, box_tets(region.bounds), log)
    impostor, progress = fit(scene, workdir=workdir / "coarse", log=log)
    log(f"coarse fit: {progress.step} steps in {progress.seconds:.0f} s")
    grid = object_grid(scene, impostor, region, config.cage.grid_resolution, log)
    return cage_from_grid(grid, config.cage, log)


def check_coarse(coarse: ExperimentConfig, workdir: Path) -> None:
    """Raise ValueError where the coarse fit there, and the cage made from it, had another configuration."""
    settings = workdir / "coarse" / "config.json"
    values = json.loads(json.dumps(to_dict(coarse)))
    if settings.exists() and json.loads(settings.read_text(encoding="utf-8")) != values:
        raise ValueError(
            f"{settings.parent} has a fit with other --coarse_bindings; remove it, and {workdir / 'cage.npz'}"
        )


def object_grid(
    scene: Scene, impostor: NeuralImpostor, region: Region, resolution: int, log: Log = print
) -> OccupancyGrid:
    """Voxels of the object in the region: those that take light of training rays in several views.

    What no ray sees, in solids or beyond walls, does not count, whatever density it has. Found in a coarse
    grid first, then in one of `resolution` voxels along the object. Raises ValueError where there is nothing.
    """
    grid = _main_parts(_lit_voxels(scene, impostor, region.bounds, _SEARCH_VOXELS), region)
    log(f"object in {np.round(grid.bounds, 4).tolist()}")
    pad = 2 * grid.voxel_size
    bounds = np.stack(
        [np.maximum(grid.bounds[0] - pad, region.lower), np.minimum(grid.bounds[1] + pad, region.upper)]
    )
    # Voxels much finer than a pixel would be missed by most rays.
    distance = np.median(np.linalg.norm(scene.train.camera_to_world[:, :3, 3] - bounds.mean(axis=0), axis=1))
    pixel = float(distance / np.median(scene.train.focal))
    finest = int(np.ceil((bounds[1] - bounds[0]).max() / (_VOXEL_PIXELS * pixel)))
    return _main_parts(_lit_voxels(scene, impostor, bounds, max(16, min(resolution, finest))), region)


def _lit_voxels(
    scene: Scene, impostor: NeuralImpostor, bounds: Float[np.ndarray, "2 3"], resolution: int
) -> OccupancyGrid:
    """Cubes that take `_MIN_LIGHT` of a ray in `_MIN_VIEWS` views; `resolution` along the longest side."""
    size = float((bounds[1] - bounds[0]).max()) / resolution
    shape = np.maximum(np.ceil((bounds[1] - bounds[0]) / size - 1e-9).astype(int), 1)
    origin = bounds.mean(axis=0) - 0.5 * size * (shape - 1)
    pool = scene.pool
    needed = min(_MIN_VIEWS, max(1, len(scene.train) // 4))
    # In random order, so that chunks need buffers like training's batches.
    order = np.random.default_rng(0).permutation(_pixels_towards(scene, bounds))[:_MAX_RAYS]
    pairs = []
    for start in range(0, len(order), _RAYS):
        chosen = np.resize(order[start : start + _RAYS], _RAYS)
        found = _light(impostor, pool, chosen, scene.render)
        owners, points, light = (np.asarray(x) for x in found)
        index = np.floor((points - origin) / size + 0.5).astype(np.int64)
        used = (light > 0) & ((index >= 0) & (index < shape)).all(axis=1)
        voxel = np.ravel_multi_index(tuple(index[used].T), tuple(shape))
        # What the samples of one ray in one voxel take together.
        keys, inverse = np.unique(owners[used].astype(np.int64) * shape.prod() + voxel, return_inverse=True)
        taken = np.bincount(inverse, light[used], minlength=len(keys)) >= _MIN_LIGHT
        views = np.asarray(pool.views)[chosen][keys[taken] // shape.prod()]
        pairs.append(views * shape.prod() + keys[taken] % shape.prod())
    seen = np.unique(np.concatenate(pairs)) % shape.prod()
    votes = np.bincount(seen, minlength=shape.prod()).reshape(shape)
    return OccupancyGrid(votes >= needed, origin, size)


def _pixels_towards(scene: Scene, bounds: Float[np.ndarray, "2 3"]) -> Int[np.ndarray, " P"]:
    """Which of the pool's pixels look through a box."""
    box, train = Region(*bounds), scene.train
    pixels, views = np.asarray(scene.pool.pixels), np.asarray(scene.pool.views)
    found = []
    for view in range(len(train)):
        chosen = np.flatnonzero(views == view)
        pose, x, y = train.camera_to_world[view], *pixels[chosen].T
        directions = pixel_directions(
            pose, train.focal[view], train.principal[view], train.width, train.height
        )
        found.append(chosen[~box.is_missed(pose[:3, 3], directions[y, x])])
    return np.concatenate(found)


@partial(jax.jit, static_argnames="config")
def _light(
    impostor: NeuralImpostor, pool: PixelPool, chosen: Int[Array, " R"], config: RenderConfig
) -> tuple[Int[Array, " M"], Float[Array, "M 3"], Float[Array, " M"]]:
    """Ray, world position and share of the ray's light of each visible sample of the chosen pixels."""
    cameras = jax.tree.map(lambda x: x[pool.views[chosen]], pool.cameras)
    rays = pixel_rays(cameras, pool.pixels[chosen] + 0.5)
    entries = pool.entries.of(chosen)
    _, samples = render_samples(impostor, rays, config, entries=entries)
    features = field.features(impostor, samples.tet_ids, samples.lambdas, samples.num_used)
    sigmas = sample_densities(impostor, samples.tet_ids, features, samples.num_used)
    light = sample_weights(sigmas * samples.deltas, samples.rays, samples.num_used)
    mesh = impostor.mesh
    corners = mesh.vertices[mesh.tets[samples.tet_ids]]
    points = mesh.center + mesh.scale * jnp.einsum("mi,mix->mx", samples.lambdas, corners)
    return samples.rays, points, jnp.where(samples.deltas > 0, light, 0)


def _main_parts(grid: OccupancyGrid, region: Region) -> OccupancyGrid:
    """The component that is largest around the region's centre, and others that are no floaters.

    Floaters are small, or at the region's walls, where a field puts what the surroundings do not explain.
    """
    labels, count = ndimage.label(grid.occupied, np.ones((3, 3, 3)))
    if not count:
        raise ValueError(
            "the coarse fit finds nothing opaque in the region of interest: give the object's box with "
            "--box, more steps or resolution with --coarse_bindings, both in a new --workdir, or masks "
            "(RGBA) and experiments/train.py"
        )
    centers = grid.centers
    label = labels[grid.occupied]
    half = 0.5 * (region.upper - region.lower)
    off = np.abs(centers - region.bounds.mean(axis=0)) / half
    central = np.bincount(label, np.clip(1 - off.max(axis=1), 0, 1) ** 2, minlength=count + 1)
    main = int(np.argmax(central))
    sizes = np.bincount(label, minlength=count + 1)
    at_wall = np.zeros(count + 1, bool)
    at_wall[label[((1 - off) * half < _NEAR_WALL * grid.voxel_size).any(axis=1)]] = True
    keep = (sizes >= _MIN_PART * sizes[main]) & ~at_wall
    keep[main] = True
    keep[0] = False
    return dataclasses.replace(grid, occupied=keep[labels])
