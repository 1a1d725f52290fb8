"""Held-out PSNR while an impostor trains."""

import json
from pathlib import Path

import numpy as np

from nimpostor_jax.config import RenderConfig
from nimpostor_jax.io.images import composite
from nimpostor_jax.metrics import psnr
from nimpostor_jax.pipeline.evaluate import MAX_PSNR, camera_of, composite_frame, write_json
from nimpostor_jax.pipeline.prepare import Log, Scene
from nimpostor_jax.render.frame import frame_config, render_frame
from nimpostor_jax.types import NeuralImpostor

MAX_VIEWS = 4


class HeldOutCurve:
    """A callback of `fit`: the mean PSNR on at most `MAX_VIEWS` of a scene's held-out views.

    `points` are (step, decibels) at multiples of `TrainConfig.eval_every`, in `file` as JSON too. Those that
    a run which was cut off left there are kept up to the step at which it goes on.
    """

    def __init__(self, scene: Scene, file: Path, *, log: Log = print):
        count = min(MAX_VIEWS, len(scene.test))
        self._views = scene.test.select(np.linspace(0, len(scene.test) - 1, count).astype(int))
        self._scene, self._file, self._log = scene, file, log
        self._config: RenderConfig | None = None
        try:
            saved = json.loads(file.read_text(encoding="utf-8")) if file.exists() else []
        except ValueError as error:
            raise ValueError(f"{file} is damaged ({error}); remove it") from error
        every = max(1, scene.config.train.eval_every)  # other steps are those of a run with other settings
        self.points: list[tuple[int, float]] = [(step, value) for step, value in saved if step % every == 0]

    def __call__(self, impostor: NeuralImpostor, step: int) -> None:
        """Measure and note a point."""
        views, config = self._views, self._scene.config
        # Buffers of the first time, so that nothing compiles again: cells become fewer, and what overflows is
        # rendered again.
        if self._config is None:
            self._config = frame_config(impostor, camera_of(views, 0), config.render)
        values = []
        for i in range(len(views)):
            behind = views.background(i, config.data.background)
            image = composite_frame(render_frame(impostor, camera_of(views, i), self._config), behind)
            values.append(min(psnr(image, composite(views.images[i], behind)), MAX_PSNR))
        mean = float(np.mean(values))
        self.points = [point for point in self.points if point[0] < step] + [(step, mean)]
        write_json(self._file, self.points)
        self._log(f"step {step}: PSNR {mean:.2f} dB on {len(views)} held-out views")
