"""Put trained impostors together into one, and render an orbit around it.

    python experiments/edit_compose.py --workdirs out/ball out/spot --out=out/both
    python experiments/edit_compose.py --workdirs out/ball out/ball --transforms=places.json --out=out/both

places.json: one 4x4 matrix (rows) or null for each workdir. Without it, objects stand side by side, touching.
Writes to --out impostor.npz, compose.json (time of a frame together and of each alone), orbit.gif, frame.png.
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from edit_deform import load_run

from nimpostor_jax.edit.compose import compose
from nimpostor_jax.export.video import write_video
from nimpostor_jax.geometry.topology import world_vertices
from nimpostor_jax.gin_flags import add_flags, config_of_runs, run_cli, save_config
from nimpostor_jax.io.images import write_png
from nimpostor_jax.io.impostor_file import save_impostor
from nimpostor_jax.pipeline.evaluate import write_json
from nimpostor_jax.pipeline.prepare import use_all_cores
from nimpostor_jax.render.frame import frame_config, render_frame, to_image
from nimpostor_jax.types import Camera, NeuralImpostor


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--workdirs", required=True, type=Path, nargs="+", help="of training runs")
    parser.add_argument("--transforms", type=Path, help="JSON: a list of 4x4 matrices or nulls")
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--size", type=int, default=200, help="image width and height")
    parser.add_argument("--frames", type=int, default=12, help="of the animation; 0: none")
    add_flags(parser)
    args = parser.parse_args(argv)
    use_all_cores()
    if args.size < 8:
        raise ValueError(f"--size must be >= 8, got {args.size}")
    config = config_of_runs(args.workdirs, args)
    parts = [load_run(workdir, "DIR") for workdir in args.workdirs]
    transforms = read_transforms(args.transforms) if args.transforms else side_by_side(parts)
    whole = compose(parts, transforms)
    save_impostor(args.out / "impostor.npz", whole)
    save_config(config, args.out)  # with which other scripts render it
    cameras = around(whole, args.size, max(args.frames, 1))
    seconds = {}
    for name, impostor in {"together": whole, **{str(i): p for i, p in enumerate(parts)}}.items():
        camera = cameras[0] if impostor is whole else around(impostor, args.size, 1)[0]
        sized = frame_config(impostor, camera, config.render)
        render_frame(impostor, camera, sized)  # compiles
        start = time.perf_counter()
        frame = render_frame(impostor, camera, sized)
        seconds[name] = time.perf_counter() - start
        if impostor is whole:
            write_png(args.out / "frame.png", to_image(frame))
    numbers: dict[str, Any] = {"objects": len(parts), "tets": len(whole.mesh.tets), "seconds": seconds}
    write_json(args.out / "compose.json", numbers)
    if args.frames:
        sized = frame_config(whole, cameras[0], config.render)
        write_video(args.out / "orbit.gif", [to_image(render_frame(whole, c, sized)) for c in cameras], 10.0)
    print(f"{numbers}\nwrote {args.out}")


def read_transforms(path: Path) -> list[Any]:
    """A list from a JSON file; what is in it, `compose` checks."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is not valid JSON ({error})") from error
    if not isinstance(values, list):
        raise ValueError(f"{path}: expected a list of 4x4 matrices or nulls")
    return values


def side_by_side(parts: Sequence[NeuralImpostor]) -> list[np.ndarray]:
    """Each to the right of the one before, on the same ground."""
    matrices, edge = [], 0.0
    for part in parts:
        vertices = world_vertices(part.mesh)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        matrix = np.eye(4)
        matrix[:3, 3] = edge - low[0], -(low[1] + high[1]) / 2, -low[2]
        matrices.append(matrix)
        edge += high[0] - low[0]
    return matrices


def around(impostor: NeuralImpostor, size: int, count: int) -> list[Camera]:
    """Cameras on a circle about the vertical axis that see all of the cage."""
    vertices = world_vertices(impostor.mesh)
    center = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    distance = 3.2 * float(np.linalg.norm(vertices - center, axis=1).max())
    cameras = []
    for azimuth in np.linspace(-np.pi / 2, 1.5 * np.pi, count, endpoint=False):
        back = np.array([np.cos(azimuth) * 0.94, np.sin(azimuth) * 0.94, 0.34])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, center + distance * back], axis=1)
        cameras.append(
            Camera(
                camera_to_world=jnp.asarray(pose, jnp.float32),
                focal=jnp.full(2, 1.5 * size, jnp.float32),
                principal=jnp.full(2, size / 2, jnp.float32),
                width=size,
                height=size,
            )
        )
    return cameras


if __name__ == "__main__":
    run_cli(main)
