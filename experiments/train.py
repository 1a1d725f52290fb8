"""Train a Neural Impostor from posed images (nerf-synthetic format) and evaluate it on held-out views.

    python experiments/train.py --gin_configs=experiments/configs/mic.gin --data=DIR --workdir=out/mic

Writes cage.npz, config.gin, checkpoints/, log.csv, impostor.npz, metrics.json and pictures/*.png to the
workdir, and held-out PSNR every TrainConfig.eval_every steps to curve.json. A run that was cut off
continues from its last checkpoint when it is started again.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from nimpostor_jax.config import ExperimentConfig
from nimpostor_jax.gin_flags import add_flags, config_from_args, operative_config_text, run_cli
from nimpostor_jax.io.atomic import atomic_path
from nimpostor_jax.io.impostor_file import save_impostor
from nimpostor_jax.pipeline.curve import HeldOutCurve
from nimpostor_jax.pipeline.evaluate import evaluate, write_json
from nimpostor_jax.pipeline.fit import fit
from nimpostor_jax.pipeline.prepare import prepare, use_all_cores


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--data", required=True, help="a nerf-synthetic folder, or a built-in scene: fluffy_ball"
    )
    parser.add_argument("--workdir", required=True, type=Path, help="where everything is written")
    parser.add_argument("--cage", type=Path, help="a cage (.npz, .vtk, .vtu, .msh); without it, one is built")
    parser.add_argument(
        "--max_minutes", type=float, help="fit the schedule to a time budget instead of steps"
    )
    add_flags(parser)
    args = parser.parse_args(argv)
    if args.max_minutes is not None and not args.max_minutes > 0:
        raise ValueError(f"--max_minutes must be > 0, got {args.max_minutes}")
    config = config_from_args(args)

    use_all_cores()
    train(config, args.data, args.workdir, args.cage, args.max_minutes)


def train(
    config: ExperimentConfig, data: str | Path, workdir: Path, cage: Path | None, max_minutes: float | None
) -> None:
    """Prepare, train, evaluate and save a run."""
    own_cage = workdir / "cage.npz"
    cage = cage or (own_cage if own_cage.exists() else None)
    scene = prepare(config, data, cage=cage, cage_output=own_cage)
    curve = HeldOutCurve(scene, workdir / "curve.json") if config.train.eval_every else None
    impostor, progress = fit(scene, workdir=workdir, max_minutes=max_minutes, callback=curve)
    print(f"trained {progress.step} steps in {progress.seconds / 60:.1f} minutes")
    with atomic_path(workdir / "config.gin") as path:  # a refused run's folder keeps its own
        path.write_text(operative_config_text(config), encoding="utf-8")
    save_impostor(workdir / "impostor.npz", impostor)
    result = evaluate(
        impostor,
        scene.test,
        config.render,
        background=config.data.background,
        pictures=workdir / "pictures",
    )
    result |= {"steps": progress.step, "train_seconds": progress.seconds}
    write_json(workdir / "metrics.json", result)


if __name__ == "__main__":
    run_cli(main)
