"""train.step, train.losses and train.sharding: one step, on one and on two devices."""

import dataclasses
import functools
import itertools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from meshes import local_vertices
from numpy.testing import assert_allclose, assert_array_equal
from rays import as_rays, generic
from scenes import FIELD, RENDER

from nimpostor_jax import chunks
from nimpostor_jax.config import TrainConfig
from nimpostor_jax.field.impostor import init_impostor
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.renderer import render_rays
from nimpostor_jax.render.traverse import march_tables, traverse
from nimpostor_jax.train.losses import photometric
from nimpostor_jax.train.sharding import data_parallel, device_mesh, dividing_devices, over_rays, replicated
from nimpostor_jax.train.step import (
    RayBatch,
    init_state,
    learning_rate,
    loss_gradient,
    make_optimizer,
    occupied_cells,
    render_loss,
    train_step,
    trainable,
    update_thickness,
    with_parameters,
)

COUNT = 32
OPTIMIZER = make_optimizer()
RATE = jnp.asarray(2e-2)


@functools.cache
def scene():
    """An untrained impostor and a batch: the cage seen from outside as solid colour by direction."""
    impostor = init_impostor(jax.random.key(3), scenes.impostor().mesh, FIELD)
    rng = np.random.default_rng(0)
    origins, directions = generic(*local_vertices(impostor.mesh), rng, COUNT)
    world = np.asarray(impostor.mesh.center) + float(impostor.mesh.scale) * origins
    color = 0.5 + 0.4 * directions
    batch = RayBatch(
        rays=as_rays((world, directions)),
        target=jnp.asarray(np.column_stack([color, np.ones(COUNT)]), jnp.float32),
        background=jnp.asarray(rng.uniform(size=(COUNT, 3)), jnp.float32),
        jitter=jnp.asarray(rng.uniform(size=COUNT), jnp.float32),
    )
    return impostor, batch


NUMBERS = itertools.count()


@functools.cache
def stepper(gradient=loss_gradient):
    """The jitted step; a second trace is an error."""

    def step(state, impostor, batch, rate):
        return train_step(state, impostor, batch, rate, config=RENDER, optimizer=OPTIMIZER, gradient=gradient)

    step.__name__ = f"step_{next(NUMBERS)}"  # chex tells functions apart by where they are made, and by name
    return jax.jit(chex.assert_max_traces(step, n=1))


@pytest.fixture(autouse=True, scope="module")
def new_steps():
    """xdist may take a worker away from this module and back: conftest has freed its programs in between."""
    stepper.cache_clear()


def run(steps):
    impostor, batch = scene()
    state, losses = init_state(impostor, OPTIMIZER, cells_per_edge=4), []
    for _ in range(steps):
        state, metrics = stepper()(state, impostor, batch, RATE)
        losses.append(float(metrics["loss"]))
    return state, losses


def test_loss_falls_and_the_step_compiles_once():
    """`stepper` raises at a second trace."""
    _, losses = run(40)
    assert losses[-1] < 0.5 * losses[0]
    assert np.all(np.isfinite(losses))


def test_opacity_costs_what_the_batch_says():
    """The loss grows by the mean of cost times opacity; what is reported is the colours' error alone."""
    impostor, batch = scene()
    cost = jnp.linspace(0.0, 2.0, COUNT)
    parameters = trainable(impostor)
    loss = jax.jit(render_loss, static_argnames="config")
    free, reported = loss(parameters, impostor, batch, config=RENDER)
    dear, same = loss(parameters, impostor, batch.replace(opacity_cost=cost), config=RENDER)
    render = jax.jit(render_rays, static_argnames="config")
    opacity = render(impostor, batch.rays, RENDER, batch.jitter).opacity
    assert float(jnp.mean(cost * opacity)) > 0.01
    assert_allclose(dear - free, jnp.mean(cost * opacity), rtol=1e-4)  # float32, a difference of sums
    assert_allclose(same["loss"], reported["loss"], rtol=1e-6)


def test_steps_are_deterministic_and_counted():
    first, _ = run(2)
    again, _ = run(2)
    assert int(first.step) == 2
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        assert_array_equal(a, b)


def test_accelerators_take_the_same_step(x64, monkeypatch):
    """They sum in another order, in whole buffers; float64, so that nothing else differs."""
    exact = jax.tree.map(lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x, scene())
    state = init_state(exact[0], OPTIMIZER, cells_per_edge=4)
    state = dataclasses.replace(state, last_seen=state.last_seen.at[::3].set(-100))  # some cells are empty

    def step():
        take = functools.partial(train_step, config=RENDER, optimizer=OPTIMIZER, forget_after=4)
        return jax.jit(take)(state, *exact, RATE)  # a new function, which is traced anew

    here, metrics = step()
    monkeypatch.setattr(chunks, "CPU_CHUNK", 16)
    in_chunks, _ = step()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    there, same_metrics = step()
    assert metrics["loss"] > 1e-3
    for theirs in (in_chunks, there):
        chex.assert_trees_all_close(here, theirs, rtol=1e-9, atol=1e-12)
    chex.assert_trees_all_close(metrics, same_metrics, rtol=1e-9)


def test_every_parameter_group_is_trained():
    impostor, _ = scene()
    state, _ = run(2)
    before = trainable(impostor)
    for name in ("features", "decoders"):
        for old, new in zip(
            jax.tree.leaves(before[name]), jax.tree.leaves(state.parameters[name]), strict=True
        ):
            assert np.any(np.asarray(old) != np.asarray(new))


def test_cells_that_no_ray_sees_are_forgotten_and_found_again():
    impostor, batch = scene()
    config = dataclasses.replace(RENDER, min_weight=1e-3)
    step = jax.jit(
        functools.partial(train_step, config=config, optimizer=OPTIMIZER, forget_after=3), donate_argnums=()
    )
    state, shares = init_state(impostor, OPTIMIZER, cells_per_edge=4), []
    for _ in range(6):
        state, metrics = step(state, impostor, batch, RATE)
        shares.append(float(np.mean(occupied_cells(state, 3))))
    assert set(metrics) == {"loss", "overflow", "coarsened"}
    assert shares[:2] == [1, 1]
    assert 0 < shares[-1] < 1  # 32 rays do not pass through all cells
    blind = dataclasses.replace(state, last_seen=jnp.full_like(state.last_seen, -100))
    all_looking = dataclasses.replace(batch, jitter=jnp.zeros_like(batch.jitter))
    after, _ = step(blind, impostor, all_looking, RATE)
    assert np.mean(occupied_cells(after, 3)) > 0


@pytest.mark.parametrize("bias, kept", [(-20.0, 0), (3.0, 1)])
def test_cells_without_density_become_empty(bias, kept):
    """What is not found thins out by 5 % an update, from 0.02 to below 0.01 after 14; what is found stays."""
    impostor, _ = scene()
    impostor = scenes.constant_density(impostor, bias)
    state = init_state(impostor, OPTIMIZER, 4, "density")
    assert np.all(occupied_cells(state, 1))
    update = jax.jit(functools.partial(update_thickness, sampler=RENDER.sampler))
    for i in range(20):
        state = update(jax.random.key(i), state, impostor)
    shares = np.mean(occupied_cells(state, 1))
    assert shares > 0.9 if kept else shares == 0


def test_a_trained_impostor_goes_on_with_its_cells():
    """Empty ones stay so, however long cells are kept, and the step compiles once."""
    impostor, batch = scene()
    cells = np.arange(len(impostor.mesh.tets) * 20).reshape(-1, 20) % 3 == 0
    state = init_state(dataclasses.replace(impostor, occupied=jnp.asarray(cells)), OPTIMIZER, 8)
    assert_array_equal(occupied_cells(state, 1_000_000), cells)
    step = stepper()
    for _ in range(2):
        state, _ = step(state, impostor, batch, RATE)


def test_large_cages_get_fewer_cells(monkeypatch):
    impostor, _ = scene()
    monkeypatch.setattr("nimpostor_jax.train.step.MAX_CELLS", 200)
    num_tets = len(impostor.mesh.tets)
    shape = init_state(impostor, OPTIMIZER, cells_per_edge=16).last_seen.shape
    assert shape[0] == num_tets
    assert num_tets * shape[1] <= 200


def test_two_devices_give_the_step_of_one():
    impostor, batch = scene()
    mesh = device_mesh(jax.devices()[:2])
    assert mesh.size == 2
    state = init_state(impostor, OPTIMIZER, cells_per_edge=4)
    single, single_metrics = stepper()(state, impostor, batch, RATE)
    placed, shared = jax.device_put((state, impostor), replicated(mesh))
    split = jax.device_put(batch, over_rays(mesh))
    double, double_metrics = stepper(data_parallel(mesh))(placed, shared, split, RATE)
    for name, value in single_metrics.items():
        assert_allclose(double_metrics[name], value, rtol=1e-5)
    # Adam's first step is the gradient's sign times the rate: compare what it is made of, the first moments,
    # which are sums over rays in another order.
    assert_array_equal(single.last_seen, double.last_seen)
    for a, b in zip(jax.tree.leaves(single.optimizer), jax.tree.leaves(double.optimizer), strict=True):
        assert_allclose(b, a, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize(
    "rays, cores, most, expected",
    [(4096, 16, None, 16), (4096, 12, None, 8), (4096, 6, 3, 2), (1001, 4, None, 1)],
)
def test_a_batch_is_shared_evenly_by_as_many_devices_as_can(rays, cores, most, expected):
    devices = [object() for _ in range(cores)]
    assert list(dividing_devices(rays, at_most=most, devices=devices)) == devices[:expected]


def test_the_loss_is_that_of_the_blended_colours():
    color = jnp.array([[1.0, 0, 0], [0, 0, 0], [9, 9, 9]])
    target = jnp.array([[0.0, 0, 0], [0, 0, 1], [0, 0, 0]])
    assert_allclose(photometric(color, target, jnp.array([False, False, False])), (1 + 1 + 243) / 9)
    assert_allclose(photometric(color, target, jnp.array([False, False, True])), 2 / 9)


def test_a_perfect_target_has_no_loss():
    impostor, batch = scene()
    output = jax.jit(render_rays, static_argnames="config")(impostor, batch.rays, RENDER, batch.jitter)
    target = jnp.column_stack([output.color, output.opacity])
    state = init_state(impostor, OPTIMIZER, cells_per_edge=4)
    _, metrics = stepper()(state, impostor, dataclasses.replace(batch, target=target), RATE)
    assert metrics["loss"] < 1e-10  # float32 roundings, squared


def test_overflowed_rays_are_ignored_and_reported():
    """A ray that does not fit must not teach: its target changes neither loss nor gradient."""
    impostor, batch = scene()
    config = dataclasses.replace(RENDER, march=dataclasses.replace(RENDER.march, max_tets_per_ray=3))
    march = jax.jit(traverse, static_argnames="config")
    local = to_local(impostor.mesh, batch.rays)
    lost = np.asarray(march(march_tables(impostor.mesh), local, config.march).overflow)
    assert 0 < lost.sum() < COUNT
    gradient = jax.jit(loss_gradient, static_argnames="config")
    batch = dataclasses.replace(batch, opacity_cost=jnp.zeros(COUNT))
    other = dataclasses.replace(
        batch,
        target=jnp.where(lost[:, None], 7.0, batch.target),
        opacity_cost=jnp.where(lost, 5.0, batch.opacity_cost),
    )
    slope, metrics = gradient(trainable(impostor), impostor, batch, config=config)
    other_slope, other_metrics = gradient(trainable(impostor), impostor, other, config=config)
    assert_allclose(metrics["overflow"], lost.mean())
    assert metrics["loss"] == other_metrics["loss"]
    for a, b in zip(jax.tree.leaves(slope), jax.tree.leaves(other_slope), strict=True):
        assert_array_equal(a, b)


def test_parameters_go_out_and_in():
    impostor, _ = scene()
    parameters = jax.tree.map(lambda x: x + 1, trainable(impostor))
    changed = with_parameters(impostor, parameters)
    for a, b in zip(jax.tree.leaves(trainable(changed)), jax.tree.leaves(parameters), strict=True):
        assert_array_equal(a, b)
    assert changed.mesh is impostor.mesh


def test_learning_rate_warms_up_and_decays():
    config = TrainConfig(learning_rate=1e-2, final_learning_rate=1e-4, warmup_steps=9)
    assert learning_rate(config, 0.0, 0) == pytest.approx(1e-3)
    assert learning_rate(config, 0.0, 9) == pytest.approx(1e-2)
    assert learning_rate(config, 0.5, 500) == pytest.approx(1e-3)
    assert learning_rate(config, 1.0, 1000) == pytest.approx(1e-4)
    assert learning_rate(config, 7.0, 1000) == pytest.approx(1e-4)
