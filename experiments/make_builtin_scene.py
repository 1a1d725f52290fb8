"""Make a small copy of a nerf-synthetic scene, as shipped in `nimpostor_jax/data`.

    python experiments/make_builtin_scene.py SCENE OUT [--resolution 100]

Pictures are averaged over exact pixel footprints in premultiplied alpha and stored as optimised
8-bit straight-alpha PNG. The copy is made beside OUT and moved there when it is whole.
"""

import argparse
import json
import os
import shutil
from pathlib import Path

import numpy as np

from nimpostor_jax.io.blender import load_blender
from nimpostor_jax.io.images import unpremultiply, write_png


def write_split(source: Path, target: Path, split: str, resolution: int) -> int:
    """Write one split's pictures and JSON; return the number of views."""
    posed = load_blender(source, split, resolution)
    centered = np.allclose(posed.principal, [0.5 * posed.width, 0.5 * posed.height])
    if not centered or not np.allclose(posed.focal, posed.focal[0, 0], rtol=1e-4):
        raise ValueError(f"{source}: 'camera_angle_x' alone cannot state the intrinsics of split {split!r}")
    frames = []
    for i, image in enumerate(posed.images):
        # The colour is divided by the alpha that is stored, so that their product is the average.
        alpha = np.rint(image[..., 3:] * 255.0) / 255.0
        straight = unpremultiply(np.concatenate([image[..., :3], alpha], axis=-1))
        write_png(target / split / f"r_{i}.png", straight, optimize=True)
        matrix = posed.camera_to_world[i].tolist()
        frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": matrix})
    angle = 2.0 * float(np.arctan(0.5 * posed.width / posed.focal[0, 0]))
    text = json.dumps({"camera_angle_x": angle, "frames": frames})
    (target / f"transforms_{split}.json").write_text(text + "\n", encoding="utf-8")
    return len(posed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", type=Path, help="folder with transforms_train.json and transforms_test.json")
    parser.add_argument("out", type=Path, help="folder to make; must not exist")
    parser.add_argument("--resolution", type=int, default=100, help="width in pixels (default: 100)")
    args = parser.parse_args()
    if args.out.exists():
        parser.error(f"{args.out} exists; remove it first")
    partial = args.out.with_name(f".{args.out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    counts = {s: write_split(args.scene, partial, s, args.resolution) for s in ("train", "test")}
    os.replace(partial, args.out)
    size = sum(path.stat().st_size for path in args.out.rglob("*") if path.is_file())
    print(f"{args.out}: {counts['train']} train + {counts['test']} test views, {size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
