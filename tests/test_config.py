"""Static configs: validation, dictionaries, hashing, and the rule for the tables' size."""

import dataclasses
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nimpostor_jax.config import (
    CageConfig,
    DataConfig,
    DecoderConfig,
    EncodingConfig,
    ExperimentConfig,
    ImpostorConfig,
    MarchConfig,
    RenderConfig,
    SamplerConfig,
    TrainConfig,
)
from nimpostor_jax.config_dict import check_types, from_dict, to_dict

POSITIVE = st.floats(min_value=1e-6, max_value=1e6)
EXPERIMENTS = st.builds(
    ExperimentConfig,
    data=st.builds(
        DataConfig,
        resolution=st.none() | st.integers(8, 4000),
        background=st.sampled_from(["white", "black"]),
    ),
    cage=st.builds(CageConfig, target_tets=st.integers(6, 5000), margin=st.floats(0.001, 0.499)),
    impostor=st.builds(
        ImpostorConfig,
        encoding=st.builds(
            EncodingConfig,
            layout=st.sampled_from(["per_simplex", "per_tet"]),
            interpolation=st.sampled_from(["grid", "simplex"]),
            num_levels=st.integers(1, 8),
            growth=st.none() | st.floats(1.0, 2.0),
            log2_tet_table=st.none() | st.integers(1, 20),
        ),
        decoder=st.builds(DecoderConfig, sh_degree=st.integers(0, 4)),
    ),
    render=st.builds(
        RenderConfig,
        march=st.builds(MarchConfig, tile_size=st.none() | st.integers(1, 512)),
        sampler=st.builds(SamplerConfig, step=st.none() | POSITIVE, capacity_per_ray=st.integers(1, 256)),
        near=st.floats(0, 10),
    ),
    train=st.builds(TrainConfig, steps=st.integers(1, 10**6), learning_rate=POSITIVE),
)


@pytest.mark.parametrize(
    "cls, field, value",
    [
        (EncodingConfig, "layout", "per_face"),
        (EncodingConfig, "interpolation", "cubic"),
        (EncodingConfig, "num_levels", 0),
        (EncodingConfig, "num_levels", 26),  # 6144 > 4096
        (EncodingConfig, "features_per_level", 0),
        (EncodingConfig, "base_resolution", 0),
        (EncodingConfig, "growth", 0.99),
        (EncodingConfig, "growth", float("nan")),
        (EncodingConfig, "min_log2_tet_table", 12),  # above max_log2_tet_table
        (EncodingConfig, "log2_tet_table", 0),
        (EncodingConfig, "log2_tet_table", 21),
        (DecoderConfig, "density_hidden", 0),
        (DecoderConfig, "appearance_hidden", 0),
        (DecoderConfig, "appearance_layers", 0),
        (DecoderConfig, "sh_degree", -1),
        (DecoderConfig, "sh_degree", 5),
        (MarchConfig, "max_tets_per_ray", 0),
        (MarchConfig, "max_entries_per_ray", 0),
        (MarchConfig, "tile_size", 0),
        (SamplerConfig, "measure", "metres"),
        (SamplerConfig, "step", 0.0),
        (SamplerConfig, "step", float("inf")),
        (SamplerConfig, "step", float("nan")),
        (EncodingConfig, "log2_table_size", -1),
        (EncodingConfig, "log2_table_size", 27),
        (SamplerConfig, "cone_angle", -0.1),
        (SamplerConfig, "max_samples_per_ray", 0),
        (SamplerConfig, "capacity_per_ray", 0),
        (SamplerConfig, "capacity_per_ray", 257),  # above max_samples_per_ray
        (RenderConfig, "density_measure", "alpha"),
        (RenderConfig, "near", -1.0),
        (DataConfig, "resolution", 7),
        (DataConfig, "background", "random"),  # a reference image needs a fixed one
        (DataConfig, "test_every", 1),
        (CageConfig, "target_tets", 5),
        (CageConfig, "grid_resolution", 15),
        (CageConfig, "margin", 0.0),
        (CageConfig, "margin", 0.5),
        (CageConfig, "max_missed_share", 1.0),
        (TrainConfig, "steps", 0),
        (TrainConfig, "rays_per_batch", 0),
        (TrainConfig, "learning_rate", 0.0),
        (TrainConfig, "final_learning_rate", float("nan")),
        (TrainConfig, "warmup_steps", -1),
        (TrainConfig, "background", "grey"),
        (TrainConfig, "log_every", 0),
        (TrainConfig, "eval_every", -1),
        (TrainConfig, "checkpoint_every", 0),
    ],
)
def test_a_value_out_of_range_is_refused_by_name(cls, field, value):
    with pytest.raises(ValueError) as caught:
        cls(**{field: value})
    message = str(caught.value)
    assert message.startswith(f"{cls.__name__}.{field} must be ")
    assert message.endswith(repr(value))


@pytest.mark.parametrize(
    "config, field",
    [
        (TrainConfig(steps=True), "TrainConfig.steps"),
        (TrainConfig(steps=2.0), "TrainConfig.steps"),
        (TrainConfig(learning_rate=True), "TrainConfig.learning_rate"),
        (MarchConfig(tile_size=2.0), "MarchConfig.tile_size"),
        (EncodingConfig(init_scale="0.1"), "EncodingConfig.init_scale"),
        (RenderConfig(march=SamplerConfig()), "RenderConfig.march"),
        (ExperimentConfig(train=TrainConfig(seed="0")), "TrainConfig.seed"),  # nested
    ],
)
def test_a_wrong_type_is_named(config, field):
    with pytest.raises(TypeError, match=f"^{field} must be "):
        check_types(config)


def test_right_types_pass():
    check_types(ExperimentConfig())
    check_types(TrainConfig(learning_rate=1))  # a whole number for a float
    check_types(MarchConfig(tile_size=1))


@given(EXPERIMENTS)
def test_dictionaries_round_trip_through_json(config):
    assert from_dict(ExperimentConfig, json.loads(json.dumps(to_dict(config)))) == config


def test_missing_keys_take_the_default():
    config = from_dict(ExperimentConfig, {"train": {"steps": 3}})
    assert config == ExperimentConfig(train=TrainConfig(steps=3))


@pytest.mark.parametrize(
    "values, name",
    [
        ({"trian": {}}, "ExperimentConfig has no field 'trian'"),
        ({"train": {"stesp": 3}}, "TrainConfig has no field 'stesp'"),
        ({"render": {"march": {"tiles": 3}}}, "MarchConfig has no field 'tiles'"),
    ],
)
def test_unknown_keys_are_refused_by_name(values, name):
    with pytest.raises(ValueError, match=name):
        from_dict(ExperimentConfig, values)


@given(EXPERIMENTS)
def test_equal_configs_hash_alike(config):
    # What jit's cache relies on: an equal config must not recompile.
    copy = from_dict(ExperimentConfig, to_dict(config))
    assert copy is not config
    assert hash(copy) == hash(config)


def test_different_configs_differ():
    assert ExperimentConfig(train=TrainConfig(steps=3)) != ExperimentConfig()
    assert len({TrainConfig(), TrainConfig(), TrainConfig(steps=3)}) == 2


def test_configs_are_frozen_and_take_keywords_only():
    with pytest.raises(dataclasses.FrozenInstanceError):
        TrainConfig().steps = 3  # type: ignore[misc]
    with pytest.raises(TypeError):
        TrainConfig(3)  # type: ignore[misc]


# H' = H - floor(log2 T + 1), H = 19: floor(9.20) = 9, floor(10.09) = 10, floor(11.78) = 11.
@pytest.mark.parametrize("num_tets, log2", [(294, 10), (545, 9), (1754, 8)])
def test_table_size_rule(num_tets, log2):
    assert EncodingConfig(log2_table_size=19).tet_table_size(num_tets) == 2**log2


def test_table_size_is_clipped_and_can_be_set():
    assert EncodingConfig().tet_table_size(1) == 2**11
    assert EncodingConfig().tet_table_size(10**6) == 2**8
    assert EncodingConfig(max_log2_tet_table=9).tet_table_size(294) == 2**9
    assert EncodingConfig(min_log2_tet_table=9).tet_table_size(1754) == 2**9
    assert EncodingConfig(log2_tet_table=5).tet_table_size(294) == 2**5


@pytest.mark.parametrize(
    "num_tets, budget",
    [(6, 6 << 11), (294, 1 << 19), (2000, 1 << 19), (10_000, 10_000 << 8)],
)
def test_a_level_has_the_whole_budget_within_the_range_of_each_tet(num_tets, budget):
    assert EncodingConfig().level_budget(num_tets) == budget
    assert EncodingConfig(log2_tet_table=5).level_budget(num_tets) == num_tets << 5


@given(st.integers(1, 10**6))
def test_table_size_never_grows_with_the_mesh(num_tets):
    encoding = EncodingConfig()
    assert encoding.tet_table_size(num_tets + 1) <= encoding.tet_table_size(num_tets)


def test_resolutions_and_feature_dim():
    assert EncodingConfig(num_levels=6).resolutions == (1, 2, 3, 4, 6, 8)
    assert EncodingConfig(num_levels=4, base_resolution=5).resolutions == (5, 10, 15, 20)
    assert EncodingConfig(num_levels=4, growth=2.0).resolutions == (1, 2, 4, 8)
    assert EncodingConfig(growth=2.0).resolutions[-1] == 4096  # the paper's growth alone may be asked for
    # round(2 * 1.5**l) = 2, 3, 4.5 -> 4 (to even), 6.75 -> 7
    encoding = EncodingConfig(num_levels=4, base_resolution=2, growth=1.5, features_per_level=3)
    assert encoding.resolutions == (2, 3, 4, 7)
    assert encoding.feature_dim == 12
