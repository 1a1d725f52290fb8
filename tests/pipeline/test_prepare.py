"""pipeline.prepare: what the scene says about the config."""

import pytest

from nimpostor_jax.config import ExperimentConfig
from nimpostor_jax.pipeline.prepare import fit_levels


@pytest.mark.parametrize("pixels, levels", [(100.0, 14), (20.0, 10), (0.1, 1)])
def test_levels_with_cells_below_half_a_pixel_are_left_out(pixels, levels):
    """Resolutions 1, 2, 3, ..., 128 on an edge of so many pixels."""
    said = []
    config = fit_levels(ExperimentConfig(), pixels, said.append)
    assert config.impostor.encoding.num_levels == levels
    assert f"the finest of {levels} levels" in said[0]
    assert ("14 were asked for" in said[0]) == (levels < 14)
