"""Give a trained impostor another cage, by exact subdivision and by two-stage local retraining.

    python experiments/edit_remesh.py --data=DIR --workdir=out/spot --cage=other.npz
    python experiments/edit_remesh.py --data=DIR --workdir=out/spot --subdivide     # the upper half, 1 to 8
    python experiments/edit_remesh.py --data=DIR --workdir=out/spot                 # a cage made anew

Held-out views judge the field before and after. Writes to --out (default: WORKDIR/remesh) remesh.json
(`seconds` of the edit without `compile_seconds`), impostor.npz, cage.npz, before_after.png (truth, before,
after, their difference times 4) and orbit.gif.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from compile_clock import CompileClock
from edit_deform import load_run

from nimpostor_jax import metrics
from nimpostor_jax.edit.remesh import transfer
from nimpostor_jax.edit.subdivide import subdivide
from nimpostor_jax.export.video import write_video
from nimpostor_jax.geometry.topology import world_vertices
from nimpostor_jax.gin_flags import add_flags, config_of_run, run_cli, save_config
from nimpostor_jax.io.blender import check_masks, load_scene
from nimpostor_jax.io.images import composite, write_png
from nimpostor_jax.io.impostor_file import save_impostor
from nimpostor_jax.io.mesh_files import load_tets, save_tets
from nimpostor_jax.io.scenes import resolve_scene
from nimpostor_jax.pipeline.evaluate import MAX_PSNR, camera_of, composite_frame, evaluate, orbit, write_json
from nimpostor_jax.pipeline.prepare import use_all_cores
from nimpostor_jax.preprocess.cage import cage_from_images
from nimpostor_jax.preprocess.validate import check_tets
from nimpostor_jax.render.frame import frame_config, render_frame, to_image


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", required=True, help="the scene of the run")
    parser.add_argument("--workdir", required=True, type=Path, help="of a training run")
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--cage", type=Path, help="the new cage; without it, one is built from the masks")
    how.add_argument("--subdivide", action="store_true", help="cut the upper half's tets into eight instead")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--frames", type=int, default=12, help="of the animation; 0: none")
    add_flags(parser)
    args = parser.parse_args(argv)
    use_all_cores()
    config, old = config_of_run(args.workdir, args), load_run(args.workdir, args.data)
    out = args.out or args.workdir / "remesh"
    train, test = load_scene(resolve_scene(args.data), config.data)
    if args.cage is not None:
        cage = load_tets(args.cage)
        check_tets(*cage, str(args.cage))
    elif not args.subdivide:
        check_masks(train)
        cage = cage_from_images(train, config.cage)
    clock, start = CompileClock(), time.perf_counter()
    if args.subdivide:
        middles = world_vertices(old.mesh)[np.asarray(old.mesh.tets)].mean(axis=1)
        region = middles[:, 2] > np.median(middles[:, 2])
        new, steps = subdivide(old, 1, region), 0
    else:
        new = transfer(old, *cage, config.render, config.retrain)
        steps = config.retrain.render_steps
    seconds, compiling = time.perf_counter() - start, clock.seconds
    save_tets(out / "cage.npz", world_vertices(new.mesh), np.asarray(new.mesh.tets))
    save_impostor(out / "impostor.npz", new)
    save_config(config, out)  # with which other scripts render it

    camera = camera_of(test, 0)
    images, background = [], config.data.background
    behind = test.background(0, background)
    for impostor in (old, new):
        sized = frame_config(impostor, camera, config.render)
        images.append(composite_frame(render_frame(impostor, camera, sized), behind))
    panel = [composite(test.images[0], behind), *images, np.clip(4 * np.abs(images[0] - images[1]), 0, 1)]
    write_png(out / "before_after.png", np.concatenate(panel, axis=1))
    before, after = (evaluate(each, test, config.render, background=background) for each in (old, new))
    result = {
        "psnr_before": before["psnr"],
        "psnr_after": after["psnr"],
        "ssim_before": before["ssim"],
        "ssim_after": after["ssim"],
        "psnr_to_before": min(metrics.psnr(*images), MAX_PSNR),
        "tets_before": len(old.mesh.tets),
        "tets_after": len(new.mesh.tets),
        "parameters_before": int(old.tables.features.size),
        "parameters_after": int(new.tables.features.size),
        "seconds": seconds - compiling,
        "compile_seconds": compiling,
        "render_steps": steps,
    }
    write_json(out / "remesh.json", result)
    if args.frames:
        cameras = orbit(train, args.frames)
        sized = frame_config(new, cameras[0], config.render)
        write_video(out / "orbit.gif", [to_image(render_frame(new, each, sized)) for each in cameras], 10.0)
    print("\n".join(f"{name}: {value:.5g}" for name, value in result.items()) + f"\nwrote {out}")


if __name__ == "__main__":
    run_cli(main)
