"""Table 2: quality and speed of the steps from Instant-NGP in a box to a baked, rasterized impostor.

    python experiments/table2.py --scene DIR [DIR ...] --out=out/table2 --resolution 200 400
    python experiments/table2.py --scene fluffy_ball --out=out/table2 --quick

Every method is trained with the same cage, steps and batch, one after another; what an earlier run trained
is reused, or refused where its settings, pictures or cage were others. Without `--cage` one is built in
the scene's folder in `--out`, or taken from there. Writes table2.json (`rows`), .csv, .md, and a picture of
every method.
`speedup` compares the training times, without compiling, of NGP-Bounded and the method to the same PSNR on
some held-out views: the lower of the two that they end with.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from ladder import (
    METHODS,
    QUICK,
    QUICK_RESOLUTION,
    Row,
    bake_or_reuse,
    cage_of,
    config_of,
    scene_name,
    seconds_to,
    train_or_reuse,
    write_picture,
    write_table,
)

from nimpostor_jax.gin_flags import add_flags, run_cli
from nimpostor_jax.pipeline.prepare import use_all_cores
from nimpostor_jax.train.sharding import num_cores

# PSNR and SSIM, averages over the paper's scenes; training minutes on its GPU.
PAPER = {
    "nerf-synthetic": {
        "NGP-Bounded": (36.545, 0.9810, 40.09),
        "BaryEnc": (36.473, 0.9809, 36.72),
        "BarySpl": (36.423, 0.9813, 30.63),
        "FeatInt": (34.530, 0.9764, 29.17),
        "Baked": (33.796, 0.9695, None),
    },
    "plush": {
        "NGP-Bounded": (32.708, 0.9474, 44.65),
        "BaryEnc": (32.843, 0.9470, 32.51),
        "BarySpl": (32.915, 0.9477, 29.91),
        "FeatInt": (32.797, 0.9393, 28.74),
        "Baked": (32.249, 0.9370, None),
    },
}
COLUMNS = (
    "scene", "resolution", "method", "psnr", "ssim", "lpips", "train_seconds", "speedup", "fps", "parameters",
    "paper_psnr", "paper_ssim", "paper_speedup",
)  # fmt: skip


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", nargs="+", required=True, help="nerf-synthetic folders, or fluffy_ball")
    parser.add_argument("--out", type=Path, required=True, help="folder of tables, pictures and trained runs")
    parser.add_argument("--resolution", type=int, nargs="+", default=[200], help="image widths")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--no_bake", action="store_true", help="leave the baked impostor out")
    parser.add_argument("--cage", type=Path, nargs="*", default=[], help="of each scene; default: built")
    parser.add_argument("--quick", action="store_true", help="small and short, to try the script")
    add_flags(parser)
    args = parser.parse_args(argv)
    if args.cage and len(args.cage) != len(args.scene):
        raise ValueError(f"{len(args.cage)} cages for {len(args.scene)} scenes; give one each, or none")
    use_all_cores()
    bindings = [*(QUICK if args.quick else ()), *args.gin_bindings]
    folders = [args.out / scene_name(scene) for scene in args.scene]
    if len(set(folders)) < len(folders):
        raise ValueError(f"scenes need folders of different names, got {args.scene}")
    resolutions = [QUICK_RESOLUTION] if args.quick else args.resolution
    config = config_of(args.methods[0], resolutions[0], args.gin_configs, bindings)
    given = args.cage or [None] * len(folders)
    cages = [cage_of(*each, config, args.quick) for each in zip(args.scene, given, folders, strict=True)]
    rows: list[Row] = []
    refused: dict[str, ValueError] = {}
    for scene, folder, cage in zip(args.scene, folders, cages, strict=True):
        for resolution in resolutions:
            place = folder / f"{resolution}"
            of_scene: list[Row] = []
            for method in args.methods:
                config = config_of(method, resolution, args.gin_configs, bindings)
                trained = train_or_reuse(method, config, scene, cage, place / method)
                of_scene.append(trained.row)
                if method == "FeatInt" and not args.no_bake:
                    source = trained
            views = trained.scene.test
            del trained  # pictures and pixels, which baking needs the memory of
            known = rows + compared(of_scene)
            write_table(args.out / "table2", known, COLUMNS, notes(known))
            if "FeatInt" in args.methods and not args.no_bake:
                try:
                    of_scene.append(bake_or_reuse(source, place / "Baked")[1])
                except ValueError as error:  # of this scene: the others need not wait
                    refused[f"{scene} at {resolution}: {error}"] = error
                    print(f"no row of {scene} at {resolution}: {error}")
                del source
            rows += compared(of_scene)
            runs = [place / row["method"] for row in of_scene]
            write_picture(folder / f"{resolution}.png", views, runs)
            write_table(args.out / "table2", rows, COLUMNS, notes(rows))
    if refused:
        message = f"{len(refused)} of the baked rows are missing; {'; '.join(refused)}"
        raise ValueError(message) from next(iter(refused.values()))


def compared(rows: Sequence[Row]) -> list[Row]:
    """The methods' rows, beside the paper's and with their training times against NGP-Bounded's."""
    rows = [dict(row) for row in rows]
    furry = any(name in rows[0]["scene"] for name in ("plush", "fluffy"))
    paper = PAPER["plush" if furry else "nerf-synthetic"]
    curves = {row["method"]: row["curve"] for row in rows if row.get("curve")}
    for row in rows:
        row["paper_psnr"], row["paper_ssim"], minutes = paper[row["method"]]
        if minutes is not None:
            row["paper_speedup"] = paper["NGP-Bounded"][2] / minutes
        if "NGP-Bounded" in curves and row["method"] in curves:
            both = curves["NGP-Bounded"], curves[row["method"]]
            target = min(curve[-1][1] for curve in both)
            theirs, ours = (seconds_to(curve, target) for curve in both)
            row["speedup"] = theirs / ours if theirs and ours else None
    return rows


def notes(rows: Sequence[Row]) -> str:
    """What the figures hold for."""
    steps, rays = ({row[key] for row in rows} for key in ("steps", "rays_per_batch"))
    return (
        f"{sorted(steps)} steps of {sorted(rays)} rays on {num_cores()} cores; "
        "fps: whole frames of held-out views. The paper's figures are averages over its scenes, 800x800."
    )


if __name__ == "__main__":
    run_cli(main)
