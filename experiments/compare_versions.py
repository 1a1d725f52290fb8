"""Train with an earlier version of this repository and with this one, in turns: time of a step, and quality.

    python experiments/compare_versions.py --base=dd56a68 --data=DIR --cage=cage.npz --steps=500

The earlier version is checked out beside, and both run `experiments/train.py` with the same cage, steps and
seed, a process each. Step times are medians over the log's lines; compilation is not in them.
"""

import argparse
import contextlib
import csv
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from nimpostor_jax.gin_flags import run_cli
from nimpostor_jax.pipeline.evaluate import write_json

ROOT = Path(__file__).resolve().parents[1]
LOG_EVERY = 50


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--base", required=True, help="commit of the earlier version")
    parser.add_argument("--data", required=True, type=Path, help="a nerf-synthetic folder")
    parser.add_argument("--cage", required=True, type=Path, help="a cage that both versions read")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/versions.json"))
    parser.add_argument("--gin_configs", default=str(ROOT / "experiments/configs/mic.gin"))
    args = parser.parse_args(argv)
    if args.steps < 3 * LOG_EVERY:
        parser.error(f"--steps must be at least {3 * LOG_EVERY}: a line is logged every {LOG_EVERY}")
    with tempfile.TemporaryDirectory() as folder, checked_out(args.base, Path(folder) / "base") as base:
        found: dict[str, list[dict[str, float]]] = {"base": [], "this": []}
        for turn in range(args.rounds):
            for name, root in (("base", base), ("this", ROOT)):
                row = train(root, Path(folder) / f"{name}{turn}", args)
                print(f"{name}: {row['step_ms']:.1f} ms a step, {row['psnr']:.2f} dB", flush=True)
                found[name].append(row)
    medians = {
        name: {key: float(np.median([row[key] for row in rows])) for key in rows[0]}
        for name, rows in found.items()
    }
    ratio = medians["base"]["step_ms"] / medians["this"]["step_ms"]
    about = {"base": args.base, "steps": args.steps, "runs": found, "faster": ratio}
    write_json(args.out, about | medians)
    print(f"{ratio:.2f} times as fast; wrote {args.out}")


@contextlib.contextmanager
def checked_out(commit: str, folder: Path) -> Iterator[Path]:
    """A commit's files in a folder of their own."""
    git = ["git", "-C", str(ROOT), "worktree"]
    added = subprocess.run([*git, "add", "--detach", str(folder), commit], capture_output=True, text=True)
    if added.returncode:
        raise ValueError(f"--base={commit}: {added.stderr.strip().splitlines()[-1]}")
    try:
        yield folder
    finally:
        subprocess.run([*git, "remove", "--force", str(folder)], check=True)


def train(root: Path, workdir: Path, args: argparse.Namespace) -> dict[str, float]:
    """One training run of the version at `root`: milliseconds a step, and held-out PSNR."""
    command = [sys.executable, str(root / "experiments/train.py"), f"--gin_configs={args.gin_configs}"]
    command += [f"--data={args.data.resolve()}", f"--cage={args.cage.resolve()}", f"--workdir={workdir}"]
    command += ["--gin_bindings", f"TrainConfig.steps={args.steps}", f"TrainConfig.log_every={LOG_EVERY}"]
    environment = os.environ | {"PYTHONPATH": str(root / "src")}
    subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)
    metrics = json.loads((workdir / "metrics.json").read_text(encoding="utf-8"))
    return {"step_ms": step_ms(workdir / "log.csv"), "psnr": metrics["psnr"]}


def step_ms(log: Path) -> float:
    """Milliseconds a step: the median over a log's lines, each of `LOG_EVERY` steps."""
    with open(log, newline="", encoding="utf-8") as file:
        seconds = [float(row["seconds"]) for row in csv.DictReader(file) if int(row["step"]) % LOG_EVERY == 0]
    return float(np.median(np.diff(seconds))) * 1e3 / LOG_EVERY


if __name__ == "__main__":
    run_cli(main)
