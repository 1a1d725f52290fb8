"""The README's code, run from its first line to its last in small."""

import re
from pathlib import Path

import numpy as np
import pytest

import nimpostor_jax as ni
from nimpostor_jax.gin_flags import save_config
from nimpostor_jax.io.scenes import builtin_scene

README = Path(__file__).resolve().parents[1] / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
# Smaller than what the README asks for; every piece must be there to be replaced.
SMALL = {
    '"DataConfig.resolution=100", "TrainConfig.steps=300"': ", ".join(
        f'"{binding}"'
        for binding in (
            "DataConfig.resolution=32", "CageConfig.target_tets=100", "CageConfig.grid_resolution=48",
            "EncodingConfig.num_levels=3", "TrainConfig.steps=20", "TrainConfig.rays_per_batch=512",
            "RetrainConfig.feature_steps=5", "RetrainConfig.render_steps=5",
            "RetrainConfig.max_lost_share=0.5",  # so short a training leaves something everywhere
            "BakeConfig.fit_rays=20000", "BakeConfig.novel_views=4", "BakeConfig.refine_steps=10",
        )
    ),
    "image_pixels(100, 100).reshape(-1, 2)[4000:5000]": "image_pixels(32, 32).reshape(-1, 2)[400:500]",
    "range(100)": "range(3)",
    "target_tets=500": "target_tets=150, grid_resolution=48",
}  # fmt: skip


@pytest.mark.slow
def test_the_readmes_code_runs_from_top_to_bottom(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = list(BLOCKS)
    for long, short in SMALL.items():
        assert sum(long in block for block in code) == 1, long
        code = [block.replace(long, short) for block in code]
    names: dict = {}
    for block in code:
        if "out/mic" in block:  # what scripts leave
            run = tmp_path / "out" / "mic"
            run.mkdir(parents=True)
            (tmp_path / "DIR").symlink_to(builtin_scene("fluffy_ball"))
            save_config(names["config"], run)
            ni.save_impostor(run / "impostor.npz", names["impostor"])
            baked = ni.bake(names["impostor"], names["scene"], names["config"].bake)
            ni.save_impostor(run / "baked.npz", baked)
        exec(compile(block, "README.md", "exec"), names)
    assert names["picture"].shape == (32, 32, 3)
    assert float(names["value"]) < 0.2  # of squared colour: what is trained further does not fall apart
    assert bool(names["status"].converged)
    for each in ("edited", "dragged", "family", "finer", "plain", "other"):
        frame = ni.render_frame(names[each], names["camera"], names["config"].render)
        assert np.isfinite(frame.color).all() and frame.opacity.max() > 0.5, each
