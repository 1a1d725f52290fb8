"""How `peers.py` times ours and another library on the same inputs, and the inputs that comparisons share.

A comparison is a function of a `Work` that imports its peer, prepares both sides and returns a `Match`. Where
the peer cannot be imported or started, the row says so. Both sides use all cores where they can: ours by one
XLA device a core (`use_all_cores`) with the items split over them, peers by their own threads. `ours_threads`
and `peer_threads` state it; a peer with 1 is written for one thread. `ratio` is ours_ms / peer_ms: below 1,
ours is faster.
"""

import contextlib
import dataclasses
import tempfile
import time
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import numpy as np
import trimesh
from jax.sharding import PartitionSpec as P

from nimpostor_jax.config import RenderConfig
from nimpostor_jax.geometry.topology import build_tet_mesh
from nimpostor_jax.preprocess.validate import orient_tets
from nimpostor_jax.render.camera import image_pixels, pixel_rays, tile_order
from nimpostor_jax.train.sharding import AXIS, device_mesh, num_cores, over_rays, replicated
from nimpostor_jax.types import Camera, NeuralImpostor, Rays, TetMesh

Row = dict[str, Any]
CORES = num_cores()
SPLIT = P(AXIS)


class Absent(Exception):
    """The peer is installed but cannot run here; the message says why."""


@dataclasses.dataclass(frozen=True)
class Work:
    """How much each comparison computes. Counts are multiples of powers of two (`devices_for`)."""

    repeats: int = 7
    min_seconds: float = 0.5  # of all repeats: short calls are repeated more often
    points: int = 1 << 18  # point queries
    slow_points: int = 1 << 15  # the same, of peers that take microseconds each
    rays: int = 1 << 16
    slow_rays: int = 1 << 13
    checked_rays: int = 1 << 12  # whose length inside the cage is computed in float64
    frame_size: int = 800  # pixels on a side
    batches: tuple[int, ...] = tuple(1 << k for k in range(12, 21, 2))  # rays a call
    encoded: int = 1 << 16  # points
    num_levels: int = 16
    log2_table: int = 19
    cage: Callable[[], tuple[np.ndarray, np.ndarray]] | None = None  # None: `ball`
    trained: tuple[NeuralImpostor, Camera, RenderConfig] | None = None  # rendered beside the untrained ball


@dataclasses.dataclass(frozen=True)
class Match:
    """Two calls for the same result. Each returns when its result is there."""

    ours: Callable[[], Any]
    peer: Callable[[], Any] | None  # None: a target without a peer
    describe: Callable[[Any, Any], Row] = lambda ours, peer: {}  # agreement, from both results
    ours_threads: int = CORES
    peer_threads: int = CORES


Comparison = Callable[[Work], Match]


def compare(name: str, comparison: Comparison, work: Work) -> Row:
    """A row of medians, compile (first call) times and agreement; or of the reason why there is no peer.

    CPU times stand beside wall times: they tell more where other programs run too.
    """
    try:
        match = comparison(work)
    except (ImportError, Absent) as error:
        return {"name": name, "absent": f"{type(error).__name__}: {error}"}
    sides = {"ours": match.ours, "peer": match.peer}
    results: dict[str, Any] = dict.fromkeys(sides)
    clocks: dict[str, list[tuple[float, float]]] = {side: [] for side in sides}
    began, turns = np.inf, 0
    while turns <= work.repeats or time.perf_counter() - began < work.min_seconds:
        for side, call in sides.items():  # in turns: whatever else the machine does meets both
            if call is None:
                continue
            if clocks[side]:
                call()  # untimed: caches that the other side has filled, its threads that still look for work
            start, used = time.perf_counter(), time.process_time()
            results[side] = call()
            clocks[side].append((time.perf_counter() - start, time.process_time() - used))
        began, turns = min(began, time.perf_counter()), turns + 1
    wall, cpu, first = {}, {}, {}
    for side, times in clocks.items():
        if not times:
            continue
        wall[side], cpu[side] = np.median(times[1:], axis=0).tolist()
        first[side] = max(0.0, times[0][0] - wall[side])
    row: Row = {"name": name, "ours_ms": 1e3 * wall["ours"], "ours_cpu_ms": 1e3 * cpu["ours"]}
    if match.peer:
        row |= {"peer_ms": 1e3 * wall["peer"], "peer_cpu_ms": 1e3 * cpu["peer"]}
        row |= {"ratio": wall["ours"] / wall["peer"], "peer_threads": match.peer_threads}
        row |= {"peer_compile_s": first["peer"]}
    row |= {"ours_threads": devices_for(match.ours_threads), "compile_s": first["ours"]}
    row |= match.describe(results["ours"], results["peer"])
    if "segments" in row:
        row["ns_per_segment"] = 1e9 * wall["ours"] / row["segments"]
        row["cpu_ns_per_segment"] = 1e9 * cpu["ours"] / row["segments"]
    return row


def devices_for(threads: int) -> int:
    """Devices that ours uses for so many threads: a power of two, which divides the numbers of items."""
    return 1 << min(threads, jax.local_device_count()).bit_length() - 1


def spread(
    function: Callable[[Any, Any], Any], shared: Any, items: Any, out_specs: Any = SPLIT, threads: int = CORES
) -> Callable[[], Any]:
    """`function(shared, items)` with the items split over devices, one a thread; inputs are in place."""
    mesh = device_mesh(jax.local_devices()[: devices_for(threads)])
    shared, items = jax.device_put(shared, replicated(mesh)), jax.device_put(items, over_rays(mesh))
    split = partial(jax.shard_map, mesh=mesh, check_vma=False)
    call = jax.jit(split(function, in_specs=(P(), SPLIT), out_specs=out_specs))
    return lambda: jax.block_until_ready(call(shared, items))


# ---- what is compared on -----------------------------------------------------------------------------------


@cache
def ball() -> tuple[np.ndarray, np.ndarray]:
    """About 1,150 tets in the unit sphere; fTetWild's count differs a little from call to call."""
    import pytetwild

    surface = trimesh.creation.icosphere(subdivisions=2)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):  # it leaves a file where it runs
        vertices, tets = pytetwild.tetrahedralize(surface.vertices, surface.faces, edge_length_fac=0.25)[:2]
    return vertices, orient_tets(tets, vertices)


def cage_of(work: Work) -> tuple[np.ndarray, np.ndarray, TetMesh]:
    """Vertices, tets and mesh of the cage that most comparisons share."""
    vertices, tets = (work.cage or ball)()
    return vertices, tets, build_tet_mesh(vertices, tets)


def front_camera(size: int) -> Camera:
    """Pinhole at z = 2.6 that looks down -z, with a focal length of its width."""
    pose = np.eye(4, dtype=np.float32)
    pose[2, 3] = 2.6
    return Camera(
        camera_to_world=pose,
        focal=np.full(2, size, np.float32),
        principal=np.full(2, size / 2, np.float32),
        width=size,
        height=size,
    )


def frame_rays(size: int) -> Rays:
    """World rays of all pixels of `front_camera`, tile by tile."""
    pixels = image_pixels(size, size).reshape(-1, 2)[tile_order(size, size)]
    return jax.jit(pixel_rays)(front_camera(size), pixels)


def random_rays(count: int) -> Rays:
    """World rays through pairs of random points around the unit ball: no two are neighbours."""
    rng = np.random.default_rng(0)
    origins = rng.normal(size=(count, 3))
    origins *= 2.6 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-0.7, 0.7, (count, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return Rays(origins=origins.astype(np.float32), directions=directions.astype(np.float32))
