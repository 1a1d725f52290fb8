"""Bake a trained run onto the faces of its tets, and compare it with the run on held-out views.

    python experiments/bake.py --data=DIR --workdir=out/mic --gin_bindings="BakeConfig.texels_per_pixel=1.0"

Best for runs trained with early integration (experiments/configs/ladder/feat_int.gin). Writes baked.npz,
baked.json (quality and frames a second, marched and rasterized) and baked/*.png to the workdir.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from nimpostor_jax.gin_flags import add_flags, config_of_run, run_cli
from nimpostor_jax.io.impostor_file import load_impostor, save_impostor
from nimpostor_jax.pipeline.bake import bake
from nimpostor_jax.pipeline.evaluate import camera_of, evaluate, write_json
from nimpostor_jax.pipeline.prepare import prepare_trained, use_all_cores
from nimpostor_jax.render.frame import Frame, for_frames, frame_config, render_frame
from nimpostor_jax.render.raster_frame import rasterize_frame

REPEATS = 5


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", required=True, help="the scene that the run was trained on")
    parser.add_argument("--workdir", required=True, type=Path, help="of a training run")
    add_flags(parser)
    args = parser.parse_args(argv)
    use_all_cores()
    config = config_of_run(args.workdir, args)
    impostor = load_impostor(args.workdir / "impostor.npz")
    scene = prepare_trained(config, args.data, impostor)
    start = time.perf_counter()
    baked = bake(impostor, scene, config.bake)
    seconds = time.perf_counter() - start
    save_impostor(args.workdir / "baked.npz", baked)
    background = config.data.background
    field = evaluate(impostor, scene.test, config.render, background=background)
    pictures = args.workdir / "baked"
    result = evaluate(baked, scene.test, config.render, background=background, pictures=pictures)

    quality = {"psnr_field": field["psnr"], "psnr": result["psnr"], "ssim": result["ssim"]}
    quality["bake_seconds"] = seconds
    write_json(args.workdir / "baked.json", quality)
    print(f"baked in {seconds:.0f} s: {field['psnr']:.2f} to {result['psnr']:.2f} dB")

    camera = camera_of(scene.test, 0)
    ready, textured = for_frames(impostor), for_frames(baked)
    ways: dict[str, Callable[[], Frame]] = {}
    for name, each, render in (
        ("field", ready, render_frame),
        ("baked, marched", textured, render_frame),
        ("baked, rasterized", textured, rasterize_frame),
    ):
        sized = frame_config(each, camera, config.render)
        ways[name] = lambda e=each, r=render, s=sized: r(e, camera, s)  # type: ignore[misc]
        ways[name]()  # compiles
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(REPEATS):
        for name, way in ways.items():
            start = time.perf_counter()
            way()
            times[name].append(time.perf_counter() - start)
    fps = {name: 1 / float(np.median(values)) for name, values in times.items()}
    write_json(args.workdir / "baked.json", quality | {"fps": fps})
    print(", ".join(f"{name}: {value:.2f} frames/s" for name, value in fps.items()))


if __name__ == "__main__":
    run_cli(main)
