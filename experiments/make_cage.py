"""Build a tet cage from the alpha masks of posed images, or around a closed surface mesh.

python experiments/make_cage.py --data=DIR --out=cage.npz --gin_bindings="CageConfig.target_tets=350"
python experiments/make_cage.py --surface=MESH.obj --out=cage.vtu
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from nimpostor_jax.gin_flags import add_flags, config_from_args, run_cli
from nimpostor_jax.io.blender import check_masks, load_scene
from nimpostor_jax.io.mesh_files import check_cage_path, save_tets
from nimpostor_jax.io.scenes import resolve_scene
from nimpostor_jax.preprocess.cage import cage_from_images, cage_from_surface


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--data", help="a nerf-synthetic folder, or a built-in scene: fluffy_ball")
    source.add_argument("--surface", type=Path, help="a closed triangle mesh")
    parser.add_argument("--allow_self_intersections", action="store_true", help="of the surface")
    parser.add_argument("--out", required=True, type=Path, help="cage file: .npz, .vtk, .vtu or .msh")
    add_flags(parser)
    args = parser.parse_args(argv)
    check_cage_path(args.out)
    config = config_from_args(args)
    if args.surface is not None:
        cage = cage_from_surface(
            args.surface, config.cage, allow_self_intersections=args.allow_self_intersections
        )
    else:
        train, _ = load_scene(resolve_scene(args.data), config.data)
        check_masks(train)
        cage = cage_from_images(train, config.cage)
    save_tets(args.out, *cage)
    print(f"wrote {args.out}")


if __name__ == "__main__":
    run_cli(main)
