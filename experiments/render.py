"""Render an orbit around a trained impostor, optionally deformed: PNG frames and a video.

python experiments/render.py --data=DIR --workdir=out/mic --frames=60 --video=orbit.mp4
python experiments/render.py --data=DIR --workdir=out/mic --deformation=bend.json
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nimpostor_jax.edit.deform import deform
from nimpostor_jax.export.video import check_video, write_video
from nimpostor_jax.gin_flags import add_flags, config_of_run, run_cli
from nimpostor_jax.io.blender import load_scene
from nimpostor_jax.io.deformations import load_deformation
from nimpostor_jax.io.images import write_png
from nimpostor_jax.io.impostor_file import load_impostor
from nimpostor_jax.io.scenes import resolve_scene
from nimpostor_jax.pipeline.evaluate import orbit
from nimpostor_jax.pipeline.prepare import use_all_cores
from nimpostor_jax.render.frame import for_frames, frame_config, render_frame, to_image


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", required=True, help="the scene that gives the orbit its lens and distance")
    parser.add_argument("--workdir", required=True, type=Path, help="of a training run")
    parser.add_argument("--deformation", type=Path, help='JSON such as {"name": "twist", "k": 0.9}')
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--size", type=int, help="image width in pixels; default: the scene's")
    parser.add_argument("--fps", type=float, default=20.0)
    parser.add_argument(
        "--video", help="file in the workdir: .mp4 or .gif; default: orbit.mp4, or the deformation's name"
    )
    add_flags(parser)
    args = parser.parse_args(argv)
    use_all_cores()
    if args.frames < 1:
        raise ValueError(f"--frames must be >= 1, got {args.frames}")
    video = Path(args.video or ("orbit" if args.deformation is None else args.deformation.stem) + ".mp4")
    check_video(video, args.fps)
    config = config_of_run(args.workdir, args)
    impostor = load_impostor(args.workdir / "impostor.npz")
    if args.deformation is not None:
        impostor = deform(impostor, load_deformation(args.deformation))
    train, _ = load_scene(resolve_scene(args.data), config.data)
    impostor = for_frames(impostor)
    cameras = orbit(train, args.frames, size=args.size)
    sized = frame_config(impostor, cameras[0], config.render)
    background = 1.0 if config.data.background == "white" else 0.0
    folder = args.workdir / "frames" / video.stem
    for earlier in folder.glob("[0-9]*.png"):
        earlier.unlink()  # frames beyond this video's would be taken for its end
    frames = []
    for i, camera in enumerate(cameras):
        frames.append(to_image(render_frame(impostor, camera, sized), background))
        write_png(folder / f"{i:04d}.png", frames[-1])
    write_video(args.workdir / video, np.stack(frames), args.fps)
    print(f"wrote {args.workdir / video} and {len(frames)} frames in {folder}")


if __name__ == "__main__":
    run_cli(main)
