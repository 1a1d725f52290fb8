"""Train a Neural Impostor from posed images (nerf-synthetic format) and evaluate it on held-out views.

    python experiments/train.py --gin_configs=experiments/configs/mic.gin --data=DIR --workdir=out/mic

Writes cage.npz, config.gin, checkpoints/, log.csv, impostor.npz, metrics.json and pictures/*.png to the
workdir, and held-out PSNR every TrainConfig.eval_every steps to curve.json. A run that was cut off
continues from its last checkpoint when it is started again.
"""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path

from nimpostor_jax.config import ExperimentConfig
from nimpostor_jax.gin_flags import (
    add_flags,
    config_from_args,
    load_config,
    operative_config_text,
    run_cli,
    save_config,
)
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
    check_finished(config, workdir)
    own_cage = workdir / "cage.npz"
    cage = cage or (own_cage if own_cage.exists() else None)
    scene = prepare(config, data, cage=cage, cage_output=own_cage)
    curve = HeldOutCurve(scene, workdir / "curve.json") if config.train.eval_every else None
    impostor, progress = fit(scene, workdir=workdir, max_minutes=max_minutes, callback=curve)
    print(f"trained {progress.step} steps in {progress.seconds / 60:.1f} minutes")
    save_config(config, workdir)  # now: a refused run's folder keeps its own
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


def check_finished(config: ExperimentConfig, workdir: Path) -> None:
    """Raise ValueError where a finished run there has settings that would not be made up for by more steps.

    Nothing would be trained with the new ones, but config.gin would say so.
    """
    if not (workdir / "config.gin").exists():
        return
    names = ("steps", "log_every", "eval_every", "checkpoint_every")
    there = load_config([workdir / "config.gin"])
    train = dataclasses.replace(there.train, **{name: getattr(config.train, name) for name in names})
    there = dataclasses.replace(there, train=train, bake=config.bake, retrain=config.retrain)
    mine, theirs = (operative_config_text(each).splitlines() for each in (config, there))
    changed = [pair for pair in zip(mine, theirs, strict=True) if pair[0] != pair[1]]
    if changed:
        raise ValueError(
            f"{workdir} has a finished run with {changed[0][1]}, not {changed[0][0].split(' = ')[1]}; use "
            "another --workdir, remove it, or render it otherwise with experiments/evaluate.py"
        )


if __name__ == "__main__":
    run_cli(main)
