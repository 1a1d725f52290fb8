"""From photographs without masks to a trained Neural Impostor.

    python experiments/capture.py --data=DIR --workdir=out/thing --max_minutes=15

DIR holds a transforms.json (instant-ngp, nerfstudio), a COLMAP model (sparse/0, images/), or images alone;
distortion, COLMAP models and images alone need pycolmap (pip install -e '.[capture]'). Writes
scene/, an ordinary dataset folder with undistorted images and backgrounds, then cage.npz, then what train.py
writes: the other scripts take --data=WORKDIR/scene. What is there already is used when it is started again.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from train import train

from nimpostor_jax.gin_flags import add_flags, load_config, run_cli
from nimpostor_jax.io.mesh_files import save_tets
from nimpostor_jax.pipeline.capture import box_region, captured_cage, check_coarse, make_scene
from nimpostor_jax.pipeline.prepare import settings_of, use_all_cores
from nimpostor_jax.render.sampling import with_step

CONFIGS = Path(__file__).parent / "configs"


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", required=True, type=Path, help="a folder of photographs")
    parser.add_argument("--workdir", required=True, type=Path, help="where everything is written")
    parser.add_argument(
        "--box",
        type=float,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="the object's surroundings, in the poses' world; default: where the cameras look",
    )
    parser.add_argument(
        "--max_minutes", type=float, help="fit the training's schedule to a time budget instead of steps"
    )
    parser.add_argument(
        "--coarse_bindings",
        nargs="*",
        action="extend",
        default=[],
        metavar="CLASS.FIELD=VALUE",
        help="of the coarse fit that finds the object, e.g. TrainConfig.steps=800",
    )
    add_flags(parser)
    args = parser.parse_args(argv)
    if args.max_minutes is not None and not args.max_minutes > 0:
        raise ValueError(f"--max_minutes must be > 0, got {args.max_minutes}")
    region = None if args.box is None else box_region(args.box)
    config = load_config([CONFIGS / "capture.gin", *args.gin_configs], args.gin_bindings)
    coarse = load_config([CONFIGS / "capture_coarse.gin"], args.coarse_bindings)
    for each in (config, coarse):
        with_step(each.render, each.impostor.encoding)  # asks for a step where there must be one

    use_all_cores()
    folder, region = make_scene(args.data, args.workdir, config, region)
    check_coarse(coarse, args.workdir)
    cage = args.workdir / "cage.npz"
    if not cage.exists():
        built = captured_cage(folder, region, config, coarse, args.workdir)
        save_tets(cage, *built, settings_of(config.cage))
    train(config, folder, args.workdir, cage=cage, max_minutes=args.max_minutes)


if __name__ == "__main__":
    run_cli(main)
