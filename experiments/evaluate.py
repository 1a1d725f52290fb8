"""Evaluate a trained run on its held-out views: writes metrics.json and pictures to the workdir.

python experiments/evaluate.py --data=DIR --workdir=out/mic
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from nimpostor_jax.gin_flags import add_flags, config_of_run, run_cli
from nimpostor_jax.io.blender import load_scene
from nimpostor_jax.io.impostor_file import load_impostor
from nimpostor_jax.io.scenes import resolve_scene
from nimpostor_jax.pipeline.evaluate import evaluate, write_json
from nimpostor_jax.pipeline.prepare import use_all_cores


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--data", required=True, help="a nerf-synthetic folder, or a built-in scene: fluffy_ball"
    )
    parser.add_argument("--workdir", required=True, type=Path, help="of a training run")
    add_flags(parser)
    args = parser.parse_args(argv)
    use_all_cores()
    config = config_of_run(args.workdir, args)
    impostor = load_impostor(args.workdir / "impostor.npz")
    _, test = load_scene(resolve_scene(args.data), config.data)
    result = evaluate(
        impostor,
        test,
        config.render,
        background=config.data.background,
        pictures=args.workdir / "pictures",
    )
    file = args.workdir / "metrics.json"
    if file.exists():  # what training noted beside its own evaluation
        noted = json.loads(file.read_text(encoding="utf-8"))
        result |= {name: noted[name] for name in ("steps", "train_seconds") if name in noted}
    write_json(file, result)


if __name__ == "__main__":
    run_cli(main)
