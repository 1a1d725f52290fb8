"""Data parallelism around the pure step: rays are split over devices, everything else is replicated."""

import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from nimpostor_jax.config import RenderConfig
from nimpostor_jax.train.step import Metrics, Parameters, RayBatch, loss_gradient
from nimpostor_jax.types import NeuralImpostor

AXIS = "rays"


def num_cores() -> int:
    """Cores that this process may use; where the system does not say which, all."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def device_mesh(devices: Sequence[jax.Device] | None = None) -> Mesh:
    """A one-dimensional mesh over all (or the given) devices."""
    devices = devices or jax.local_devices()
    return jax.make_mesh((len(devices),), (AXIS,), axis_types=(AxisType.Auto,), devices=devices)


def dividing_devices(
    num_rays: int, *, at_most: int | None = None, devices: Sequence[jax.Device] | None = None
) -> Sequence[jax.Device]:
    """The first of the local (or the given) devices: as many as can share a batch of rays evenly."""
    devices = devices or jax.local_devices()
    most = min(len(devices), at_most or len(devices))
    return devices[: max(n for n in range(1, most + 1) if num_rays % n == 0)]


def data_parallel(mesh: Mesh) -> Callable[..., tuple[Parameters, Metrics]]:
    """`loss_gradient` with the batch's rays split over the mesh; gradients and metrics are averaged.

    Marching and packing then stay within a device: their loops and buffers know nothing of the others.
    The number of rays must be a multiple of the number of devices.
    """

    def gradient(
        parameters: Parameters, impostor: NeuralImpostor, batch: RayBatch, config: RenderConfig
    ) -> tuple[Parameters, Metrics]:
        @partial(jax.shard_map, mesh=mesh, in_specs=(P(), P(), P(AXIS)), out_specs=P(), check_vma=False)
        def shard(
            parameters: Parameters, impostor: NeuralImpostor, batch: RayBatch
        ) -> tuple[Parameters, Metrics]:
            return jax.lax.pmean(loss_gradient(parameters, impostor, batch, config), AXIS)

        return shard(parameters, impostor, batch)

    return gradient


def sums_by_device(mesh: Mesh, add: Callable[..., Any]) -> Callable[..., Any]:
    """`add(sums, *shared, batch, config)`, where each device adds its share of the rays to sums of its own.

    These have a leading axis over devices. The number of rays must be a multiple of that of devices.
    """

    def add_all(sums: Any, *arguments: Any, config: RenderConfig) -> Any:
        specs = (P(AXIS), *[P()] * (len(arguments) - 1), P(AXIS))

        @partial(jax.shard_map, mesh=mesh, in_specs=specs, out_specs=P(AXIS), check_vma=False)
        def shard(sums: Any, *arguments: Any) -> Any:
            own = jax.tree.map(lambda x: x[0], sums)
            return jax.tree.map(lambda x: x[None], add(own, *arguments, config))

        return shard(sums, *arguments)

    return add_all


def replicated(mesh: Mesh) -> NamedSharding:
    """Sharding of state and impostor."""
    return NamedSharding(mesh, P())


def over_rays(mesh: Mesh) -> NamedSharding:
    """Sharding of batches, and of what each device has of its own."""
    return NamedSharding(mesh, P(AXIS))
