"""The main job on the built-in scene, in minutes: cage from images, training, held-out PSNR, two animations.

python experiments/demo.py --workdir=out/demo
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nimpostor_jax.edit.deform import deform, twist
from nimpostor_jax.export.video import write_gif
from nimpostor_jax.gin_flags import add_flags, load_config, run_cli, save_config
from nimpostor_jax.io.impostor_file import save_impostor
from nimpostor_jax.pipeline.evaluate import evaluate, orbit, write_json
from nimpostor_jax.pipeline.fit import fit
from nimpostor_jax.pipeline.prepare import prepare, use_all_cores
from nimpostor_jax.render.frame import frame_config, render_frame, to_image

CONFIG = Path(__file__).parent / "configs" / "fluffy_ball.gin"
FRAMES = 24
TWIST = 0.9  # radians per unit of height, at the animation's extremes


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workdir", required=True, type=Path, help="where everything is written")
    parser.add_argument("--minutes", type=float, default=2.0, help="of training")
    add_flags(parser)
    args = parser.parse_args(argv)
    if not args.minutes > 0:
        raise ValueError(f"--minutes must be > 0, got {args.minutes}")
    config = load_config([CONFIG, *(args.gin_configs or [])], args.gin_bindings or [])
    started = time.perf_counter()
    use_all_cores()
    cage = args.workdir / "cage.npz"
    scene = prepare(config, "fluffy_ball", cage=cage if cage.exists() else None, cage_output=cage)
    save_config(config, args.workdir)
    impostor, progress = fit(scene, max_minutes=args.minutes)
    print(f"trained {progress.step} steps in {progress.seconds / 60:.1f} minutes")
    save_impostor(args.workdir / "impostor.npz", impostor)
    result = evaluate(impostor, scene.test, config.render, pictures=args.workdir / "pictures")
    write_json(args.workdir / "metrics.json", result)

    cameras = orbit(scene.train, FRAMES)
    sized = frame_config(impostor, cameras[0], config.render)
    turntable = [to_image(render_frame(impostor, camera, sized)) for camera in cameras]
    write_gif(args.workdir / "turntable.gif", np.stack(turntable), 12)
    swings = TWIST * np.sin(np.linspace(0, 2 * np.pi, FRAMES, endpoint=False))
    twisted = [to_image(render_frame(deform(impostor, twist(k)), cameras[0], sized)) for k in swings]
    write_gif(args.workdir / "twist.gif", np.stack(twisted), 12)
    print(f"held-out PSNR {result['psnr']:.2f} dB after {progress.seconds:.0f} s of training")
    print(f"turntable: {args.workdir / 'turntable.gif'}")
    print(f"deformed:  {args.workdir / 'twist.gif'}")
    print(f"{time.perf_counter() - started:.0f} s in all")


if __name__ == "__main__":
    run_cli(main)
