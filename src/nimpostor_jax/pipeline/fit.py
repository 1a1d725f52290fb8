"""The training run: batches, steps, progress, logs and checkpoints.

A run that is killed and started again continues from its last checkpoint and ends with the same parameters:
batches are functions of seed and step, and the learning rate of step and schedule.
"""

import csv
import dataclasses
import hashlib
import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm.auto import tqdm

from nimpostor_jax.config import RenderConfig, TrainConfig
from nimpostor_jax.io.atomic import atomic_path
from nimpostor_jax.io.blender import PosedImages
from nimpostor_jax.io.checkpoint import (
    cage_fingerprint,
    latest_step,
    load_metadata,
    restore_checkpoint,
    save_checkpoint,
)
from nimpostor_jax.pipeline.prepare import Log, Scene
from nimpostor_jax.render.capacity import MAX_GROWTH, grow_march
from nimpostor_jax.train.pool import draw_batch
from nimpostor_jax.train.sharding import data_parallel, device_mesh, dividing_devices, over_rays, replicated
from nimpostor_jax.train.step import (
    TrainState,
    init_state,
    is_finite,
    learning_rate,
    loss_gradient,
    make_optimizer,
    occupied_cells,
    train_step,
    update_thickness,
    with_parameters,
)
from nimpostor_jax.types import NeuralImpostor

LOG_FIELDS = (
    "step",
    "seconds",
    "loss",
    "psnr",
    "rays_per_second",
    "learning_rate",
    "overflow",
    "coarsened",
)
# Share of a batch's rays that may be left out before the buffers grow: what only they see would not be
# trained, since rays that do not fit once never do.
MAX_OVERFLOW = 1e-3


@dataclasses.dataclass
class Progress:
    """How far a run is: what a schedule needs, and what a checkpoint keeps beside the state."""

    step: int = 0
    seconds: float = 0.0  # of training, without compilation and evaluation
    growths: int = 0  # how often the buffers were doubled

    def share(self, config: TrainConfig, max_minutes: float | None) -> float:
        """Position in the schedule, 1 at its end: by steps, or by time where minutes are given."""
        if max_minutes is not None:
            return self.seconds / (60 * max_minutes)
        return self.step / config.steps


def fit(
    scene: Scene,
    *,
    workdir: str | Path | None = None,
    max_minutes: float | None = None,
    callback: Callable[[NeuralImpostor, int], None] | None = None,
    log: Log = print,
) -> tuple[NeuralImpostor, Progress]:
    """Train a prepared scene's impostor; returns it trained, and how long that took.

    With a `workdir`, writes `log.csv` and checkpoints there and resumes from them. `max_minutes` replaces
    `TrainConfig.steps`: the schedule then follows the clock. `callback(impostor, step)` runs every
    `TrainConfig.eval_every` steps. Raises FloatingPointError where the loss or a parameter is not finite,
    before that is saved or returned.
    """
    config = scene.config.train
    devices = dividing_devices(config.rays_per_batch)
    optimizer = make_optimizer()
    state = init_state(scene.impostor, optimizer, config.cells_per_edge, config.occupancy)
    progress = Progress()
    checkpoints = Path(workdir) / "checkpoints" if workdir is not None else None
    identity = {"cage": cage_fingerprint(scene.impostor.mesh), "pictures": _fingerprint(scene.train)}
    if checkpoints is not None and latest_step(checkpoints) is not None:
        state, step = restore_checkpoint(checkpoints, state, scene.config, metadata=identity)
        saved = load_metadata(checkpoints, step)
        progress = Progress(step=step, seconds=saved["seconds"], growths=saved["growths"])
        log(f"resuming {checkpoints} at step {step}")

    impostor, gradient, place = scene.impostor, loss_gradient, (lambda batch: batch)
    if len(devices) > 1:
        mesh = device_mesh(devices)
        state, impostor = jax.device_put((state, impostor), replicated(mesh))
        gradient = data_parallel(mesh)
        place = partial(jax.device_put, device=over_rays(mesh))  # of a batch; the pool is not copied
    state = jax.tree.map(jnp.copy, state)  # steps consume their state; the scene's arrays stay the caller's
    render = scene.render
    for _ in range(progress.growths):
        render = _grow(render)
    step_function = partial(
        train_step, optimizer=optimizer, forget_after=config.forget_after, gradient=gradient
    )
    compiled = jax.jit(step_function, static_argnames="config", donate_argnums=0)
    update = jax.jit(partial(update_thickness, sampler=render.sampler), donate_argnums=1)
    has_updated = False
    key = jax.random.key(config.seed + 1)
    records = _LogFile(Path(workdir) / "log.csv" if workdir is not None else None, progress.step)
    bar = tqdm(
        total=None if max_minutes else config.steps,
        initial=progress.step,
        unit="step",
        disable=None,
    )

    def save() -> None:
        _check_finite(state, progress.step)
        if checkpoints is not None and latest_step(checkpoints) != progress.step:
            metadata = {**identity, "seconds": progress.seconds, "growths": progress.growths}
            save_checkpoint(checkpoints, progress.step, state, scene.config, metadata=metadata)

    clock = None  # starts after the first step of this process, which compiles
    try:
        while (done := progress.share(config, max_minutes)) < 1:
            drawn = draw_batch(key, progress.step, scene.pool, config.rays_per_batch, config.background)
            batch = place(drawn)
            if config.occupancy == "density" and progress.step % _OCCUPANCY_EVERY == 0:
                state = update(key, state, impostor)
                if not has_updated and clock is not None:  # a resumed run's first one, which compiles
                    jax.block_until_ready(state)
                    clock = time.perf_counter()
                has_updated = True
            rate = learning_rate(config, done, progress.step)
            state, metrics = compiled(state, impostor, batch, jnp.asarray(rate, jnp.float32), config=render)
            progress.step += 1
            bar.update()
            regular = progress.step % config.log_every == 0
            logged = regular or clock is None
            stops = (_SYNC_EVERY, config.checkpoint_every, config.eval_every or _SYNC_EVERY)
            if logged or any(progress.step % every == 0 for every in stops):
                jax.block_until_ready(metrics)  # before the clock is read, which what follows stops
            now = time.perf_counter()
            progress.seconds += now - clock if clock is not None else 0.0
            if logged:
                record = records.write(progress, metrics, rate, config.rays_per_batch)
                bar.set_postfix({k: f"{record[k]:.4g}" for k in ("loss", "psnr", "rays_per_second")})
            clock = time.perf_counter()
            # At steps that do not depend on where a process began
            lost = regular and record["overflow"] > MAX_OVERFLOW and progress.step > config.warmup_steps
            if lost and progress.growths < MAX_GROWTH:
                render = _grow(render)
                progress.growths += 1
                clock = None  # the next step compiles
                log(f"step {progress.step}: {record['overflow']:.1%} of the rays overflowed; larger buffers")
            if progress.step % config.checkpoint_every == 0:
                save()
                clock = clock and time.perf_counter()
            if callback is not None and config.eval_every and progress.step % config.eval_every == 0:
                # A copy, which the callback may keep: the next step consumes the state.
                callback(jax.tree.map(jnp.copy, _trained(scene, state, devices)), progress.step)
                clock = clock and time.perf_counter()
        save()
    finally:
        bar.close()
        records.close()
    return _trained(scene, state, devices), progress


_SYNC_EVERY = 8  # steps that may be under way at once
_OCCUPANCY_EVERY = 16  # steps, as in Instant-NGP


def _fingerprint(views: PosedImages) -> str:
    """Identifies training views by their cameras and every fourth pixel of every fourth row."""
    digest = hashlib.sha256()
    pictures = [views.images] if views.backgrounds is None else [views.images, views.backgrounds]
    thinned = [each[:, ::4, ::4] for each in pictures]
    for values in (*thinned, views.camera_to_world, views.focal, views.principal):
        digest.update(np.ascontiguousarray(values, "<f4").tobytes())
    return digest.hexdigest()[:16]


def _check_finite(state: TrainState, step: int) -> None:
    if not is_finite(state.parameters):
        raise FloatingPointError(
            f"parameters are not finite after step {step}; lower TrainConfig.learning_rate, and remove the "
            "folder or go on from its last checkpoint, which is from before"
        )


def _trained(scene: Scene, state: TrainState, devices: Sequence[jax.Device]) -> NeuralImpostor:
    occupied = occupied_cells(state, scene.config.train.forget_after)
    parameters, occupied = jax.device_put((state.parameters, occupied), devices[0])
    return dataclasses.replace(with_parameters(scene.impostor, parameters), occupied=occupied)


def _grow(config: RenderConfig) -> RenderConfig:
    """Twice the slots of every buffer; those that rays share do not become as large as if all needed most."""
    sampler, march = config.sampler, config.march
    most, shared = sampler.max_samples_per_ray, march.capacity_per_ray
    capacity = min(most, 2 * (sampler.capacity_per_ray or most))
    grown = grow_march(config)
    return dataclasses.replace(
        grown,
        march=dataclasses.replace(grown.march, capacity_per_ray=shared and 2 * shared),
        sampler=dataclasses.replace(sampler, capacity_per_ray=capacity, occupied_per_ray=None),
    )


class _LogFile:
    """`log.csv`, one line every `log_every` steps; a resumed run drops lines beyond its checkpoint."""

    def __init__(self, path: Path | None, step: int):
        self._file = None
        self._last = (step, time.perf_counter())
        if path is None:
            return
        kept = []
        if path.exists() and step > 0:
            with path.open(newline="") as file:  # a killed process may have left part of a line
                whole = [row for row in csv.DictReader(file) if None not in row.values()]
            kept = [row for row in whole if int(row["step"]) <= step]
        with atomic_path(path) as partial, partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, LOG_FIELDS)
            writer.writeheader()
            writer.writerows(kept)
        self._file = path.open("a", newline="")
        self._writer = csv.DictWriter(self._file, LOG_FIELDS)

    def write(self, progress: Progress, metrics: dict, rate: float, rays: int) -> dict[str, float]:
        """Record a step; waits for its metrics."""
        values = {name: float(np.asarray(value)) for name, value in metrics.items()}
        if not math.isfinite(values["loss"]):
            raise FloatingPointError(
                f"the loss is {values['loss']} at step {progress.step}; lower TrainConfig.learning_rate"
            )
        now = time.perf_counter()
        steps, seconds = progress.step - self._last[0], now - self._last[1]
        self._last = (progress.step, now)
        record = {
            "step": progress.step,
            "seconds": round(progress.seconds, 3),
            "loss": values["loss"],
            "psnr": -10 * math.log10(max(values["loss"], 1e-12)),
            "rays_per_second": rays * steps / max(seconds, 1e-9),
            "learning_rate": rate,
            "overflow": values["overflow"],
            "coarsened": values["coarsened"],
        }
        if self._file is not None:
            self._writer.writerow(record)
            self._file.flush()
        return record

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
