"""From a scene on disk to something trainable: views, cage, pool of pixels, buffers of the right size."""

import ctypes
import dataclasses
import json
import os
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float, Int

from nimpostor_jax.config import CageConfig, ExperimentConfig, RenderConfig
from nimpostor_jax.config_dict import to_dict
from nimpostor_jax.field.impostor import init_impostor
from nimpostor_jax.geometry.topology import build_tet_mesh, world_vertices
from nimpostor_jax.io.blender import PosedImages, check_masks, load_scene
from nimpostor_jax.io.mesh_files import cage_settings, load_tets, save_tets
from nimpostor_jax.io.scenes import resolve_scene
from nimpostor_jax.preprocess.cage import Cage, cage_from_images
from nimpostor_jax.preprocess.tetrahedralize import box_tets
from nimpostor_jax.preprocess.validate import (
    check_coverage,
    edge_lengths,
    missed_foreground,
    quality_report,
    signed_volumes,
)
from nimpostor_jax.render.capacity import fit_capacities
from nimpostor_jax.render.sampling import with_step
from nimpostor_jax.render.traverse import march_tables
from nimpostor_jax.train.pool import PixelPool, build_pool, draw_batch
from nimpostor_jax.train.sharding import num_cores
from nimpostor_jax.types import NeuralImpostor

Log = Callable[[str], None]

PROBE_RAYS = 8192  # that buffers are measured on
MIN_CELL = 0.5  # pixels across a cell of the finest level
# XLA's CPU back end compiles a loop whose body touches fewer bytes into one function, instead of calling one
# for each operation. This takes in the march of a tile of rays, but no loop over chunks of samples.
SMALL_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=10000000"


def use_all_cores() -> None:
    """Give XLA's CPU back end one device a core, over which training, frames and baking are spread.

    Loops, gathers and scatters of one device run on one core. Call before any other use of jax; without
    effect on accelerators or where the number of devices has been chosen already. Small loops are compiled as
    a whole, unless `XLA_FLAGS` has such options. On Linux, memory that is freed stays with the process.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_force_host_platform_device_count" not in flags:
        jax.config.update("jax_num_cpu_devices", num_cores())
    if "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {SMALL_LOOPS}".strip()
    _keep_freed_memory()


def _keep_freed_memory() -> None:
    """Let glibc reuse large blocks: XLA takes buffers anew for each call, and fresh pages cost up to half.

    One arena, because glibc gives other threads' arenas back whenever a block needs more than 64 MiB.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library, or Windows
        return
    mallopt(ctypes.c_int(-8), ctypes.c_int(1))  # M_ARENA_MAX
    mallopt(ctypes.c_int(-4), ctypes.c_int(0))  # M_MMAP_MAX
    mallopt(ctypes.c_int(-1), ctypes.c_int(2**31 - 1))  # M_TRIM_THRESHOLD


def warn_of_slow_scatter() -> None:
    """Warn on GPUs whose jaxlib compiles scatter-add, the tables' gradient, into a slow loop (jax#38806)."""
    version = tuple(int(part) for part in jax.lib.__version__.split(".")[:3])
    if jax.default_backend() == "gpu" and (0, 10, 2) <= version <= (0, 11, 0):
        warnings.warn(
            f"jaxlib {jax.lib.__version__} trains hash tables hundreds of times too slowly on GPUs; "
            "install 0.11.1 or newer (Python 3.12 or newer)",
            stacklevel=2,
        )


@dataclasses.dataclass(frozen=True)
class Scene:
    """A prepared scene: what training starts from."""

    config: ExperimentConfig
    train: PosedImages
    test: PosedImages
    impostor: NeuralImpostor  # untrained
    pool: PixelPool
    render: RenderConfig  # with buffers that fit the training rays


def prepare(
    config: ExperimentConfig,
    data: str | Path,
    *,
    cage: str | Path | None = None,
    cage_output: str | Path | None = None,
    log: Log = print,
) -> Scene:
    """Read a scene (a folder or a built-in name), read or build its cage, initialise the impostor.

    The cage is saved as `cage_output`, unless there is one. All input is checked before anything long starts.

    Raises:
        FileNotFoundError, ValueError: a sampler that needs a step and has none (`sampling.with_step`),
            missing or inconsistent data, empty masks, a bad cage, or a cage that more than
            `CageConfig.max_missed_share` of the foreground's rays miss.
    """
    warn_of_slow_scatter()
    with_step(config.render, config.impostor.encoding)  # asks for a step where there must be one
    if cage is not None:
        load_tets(cage)  # before pictures are decoded
        if cage_output is not None and Path(cage) == Path(cage_output):  # an earlier run's own
            check_built(cage, config.cage)
    train, test = load_scene(resolve_scene(data), config.data)
    log(f"{data}: {len(train)} training views, {len(test)} test views, {train.width} x {train.height}")
    built = load_cage(config, train, cage, cage_output, log)
    return prepare_views(config, train, test, built, log)


def prepare_views(
    config: ExperimentConfig, train: PosedImages, test: PosedImages, cage: Cage, log: Log = print
) -> Scene:
    """A scene from views and a cage in memory. Raises ValueError where no pixel hits the cage."""
    vertices, tets = cage
    mesh = build_tet_mesh(vertices, tets)
    pool, missed = build_pool(
        mesh, train.cameras, train.images, config.render.march, train.backgrounds
    )
    hits = f"{len(pool.views):,} training rays hit the cage"
    log(f"{hits}; {missed:.4%} of opaque pixels do not" if train.show_masks else hits)
    key = jax.random.key(config.train.seed)
    config = fit_levels(config, pixels_per_edge(vertices, tets, train), log)
    impostor = init_impostor(key, mesh, config.impostor)
    entries = np.diff(impostor.tables.layout.starts).tolist()
    log(f"{len(tets)} tets, {sum(entries):,} table entries in {len(entries)} levels {entries}")
    probe = draw_batch(key, 0, pool, PROBE_RAYS, "white")
    entries = pool.entries.slots
    march = dataclasses.replace(config.render.march, max_entries_per_ray=entries)
    render = with_step(dataclasses.replace(config.render, march=march), config.impostor.encoding)
    render = fit_capacities(mesh, march_tables(mesh), probe.rays, render)
    return Scene(config=config, train=train, test=test, impostor=impostor, pool=pool, render=render)


def prepare_trained(
    config: ExperimentConfig, data: str | Path, impostor: NeuralImpostor, log: Log = print
) -> Scene:
    """A scene in the cage of an impostor at rest that was trained on it. Errors as `prepare`."""
    train, test = load_scene(resolve_scene(data), config.data)
    cage = world_vertices(impostor.mesh), np.asarray(impostor.mesh.tets)
    return prepare_views(config, train, test, cage, log)


def fit_levels(config: ExperimentConfig, edge: float, log: Log = print) -> ExperimentConfig:
    """The config without levels whose cells are narrower than `MIN_CELL` pixels: nothing could train them.

    `edge` is the length of an edge in pixels.
    """
    encoding = config.impostor.encoding
    kept = [n for n in encoding.resolutions if edge / n >= MIN_CELL] or encoding.resolutions[:1]
    log(
        f"the finest of {len(kept)} levels has cells {edge / kept[-1]:.2f} pixels wide"
        + (f"; {encoding.num_levels} were asked for" if len(kept) < encoding.num_levels else "")
    )
    encoding = dataclasses.replace(encoding, num_levels=len(kept))
    return dataclasses.replace(config, impostor=dataclasses.replace(config.impostor, encoding=encoding))


def pixels_per_edge(
    vertices: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"], views: PosedImages
) -> float:
    """Median length of the cage's edges, weighted by their tets' volume, in pixels at the median distance.

    Samples are where volume is: of many cages most tets make a skin of small ones.
    """
    center = vertices[np.unique(tets)].mean(axis=0)  # a file may have points that no tet uses
    distances = np.linalg.norm(views.camera_to_world[:, :3, 3] - center, axis=1)
    pixel = np.median(distances) / np.median(views.focal)
    edges = edge_lengths(vertices, tets).reshape(-1)
    order = np.argsort(edges)
    volumes = np.repeat(np.abs(signed_volumes(vertices, tets)), 6)[order]
    below = np.cumsum(volumes) - volumes / 2
    return float(np.interp(volumes.sum() / 2, below, edges[order]) / pixel)


def load_cage(
    config: ExperimentConfig,
    train: PosedImages,
    cage: str | Path | None,
    cage_output: str | Path | None,
    log: Log,
) -> Cage:
    """The given cage file, checked against the views' foreground; or one built from the views' masks.

    Where the config asks for a box, that around the given file's vertices. Raises ValueError where
    `cage_output` is there and is another cage.
    """
    if cage is None:
        check_masks(train)
        vertices, tets = cage_from_images(train, config.cage, log)
    else:
        vertices, tets = load_tets(cage)
        if config.cage.shape == "box":
            used = vertices[np.unique(tets)]
            vertices, tets = box_tets(np.stack([used.min(axis=0), used.max(axis=0)]))
        if train.show_masks:
            views = (train.camera_to_world, train.focal, train.principal)
            missed = missed_foreground(vertices, tets, train.masks, *views)
            log(f"{cage}: {quality_report(vertices, tets)}; {missed}")
            check_coverage(missed, config.cage.max_missed_share, train.names, str(cage))
    if cage_output is not None and Path(cage_output).exists():
        of_run = load_tets(cage_output)
        same = len(of_run[0]) == len(vertices) and np.array_equal(of_run[1], tets)
        if not (same and np.allclose(of_run[0], vertices)):
            raise ValueError(f"{cage_output} is another cage than {cage}; remove it or use another folder")
    elif cage_output is not None:
        save_tets(cage_output, vertices, tets, settings_of(config.cage) if cage is None else None)
        log(f"cage saved as {cage_output}")
    return vertices, tets


def settings_of(config: CageConfig) -> str:
    """What the file of a cage that was built says of itself (`save_tets`)."""
    values = to_dict(config)
    del values["max_missed_share"]  # asked again of every set of views
    return json.dumps(values)


def check_built(path: str | Path, config: CageConfig) -> None:
    """Raise ValueError where a cage was built with other settings; cages from elsewhere do not say."""
    there = json.loads(cage_settings(path) or "{}")
    for name, value in json.loads(settings_of(config)).items():
        if there.get(name, value) != value:
            raise ValueError(
                f"{path} was built with CageConfig.{name} = {there[name]!r}, not {value!r}; "
                "remove it, or use another folder"
            )
