"""The sweep parallel in time against the sequential one, and against dense linear algebra."""

import functools
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import PROBLEMS
from test_riccati import dense, random_model

import jaxctrl as jc
from jaxctrl.linear import _parallel, _riccati, box_lqr, lqr, lqr_rollout

sequential = jax.jit(lqr)
parallel = jax.jit(lambda model, damping: lqr(model, damping, engine="parallel"))


@jax.jit
def unaided(model, damping):
    """Sweep in parallel, and return NaN where that would have been left to the other sweep."""

    shapes = jax.eval_shape(_riccati.lqr, model, damping)
    refused = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)
    refused = refused._replace(k=refused.k * jnp.nan)
    with mock.patch.object(_parallel._riccati, "lqr", lambda *_: refused):
        return _parallel.lqr(model, damping)


def assert_close(got, wanted, tolerance=1e-9):
    """Compare every array of two results, relative to the largest entry of each."""
    for name, a, b in zip(wanted._fields, got, wanted, strict=True):
        scale = np.max(np.abs(b), initial=0.0)
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * scale, err_msg=name)


@functools.cache
def local_model(name):
    problem, x0 = PROBLEMS[name]()
    us = jnp.broadcast_to(problem.plant.nominal_control, (problem.num_steps, problem.plant.nu))
    return jax.jit(jc.expand)(problem, problem.rollout(x0, us), us)


@pytest.mark.parametrize("T", [1, 8, 70])
@pytest.mark.parametrize("way", ["forth", "back"])
def test_scan_in_blocks_is_the_recursion(T, way):
    rng = np.random.default_rng(T)
    F, c = rng.normal(size=(T, 3, 3)) * 0.6, rng.normal(size=(T, 3))
    last = rng.normal(size=3)
    if way == "forth":
        x, wanted = np.zeros(3), [np.zeros(3)]
        for k in range(T):
            x = F[k] @ x + c[k]
            wanted.append(x)
        got = _parallel._affine_forth(jnp.asarray(F), jnp.asarray(c))
    else:
        x, wanted = last, [last]
        for k in reversed(range(T)):
            x = c[k] + F[k].T @ x
            wanted.insert(0, x)
        got = _parallel._affine_back(jnp.asarray(F), jnp.asarray(c), jnp.asarray(last))
    np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("seed", range(3))
def test_parallel_sweep_solves_the_dense_kkt_system(seed):
    model = random_model(seed)
    H, g, _ = dense(model, jnp.zeros(4))
    d = jnp.asarray(np.random.default_rng(seed).uniform(0.1, 3, model.lu.shape))
    sweep = unaided(model, d)
    _, dus = lqr_rollout(model, sweep.k, sweep.K, jnp.zeros(4))
    wanted = -np.linalg.solve(H + np.diag(d.ravel()), g)
    np.testing.assert_allclose(dus.ravel(), wanted, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(sweep.gradient.ravel(), g, rtol=1e-12)
    assert_close(sweep, sequential(model, d), 1e-11)


@pytest.mark.parametrize("kind", ["indefinite", "zero"])
def test_control_hessians_need_not_be_positive_where_the_problem_is_convex(kind):
    model = random_model(5)
    d = jnp.zeros_like(model.lu)
    if kind == "indefinite":
        model = model._replace(luu=model.luu.at[2, 0, 0].add(-3.0))
    else:
        model = model._replace(luu=0 * model.luu, lux=0 * model.lux)
    assert np.linalg.eigvalsh(model.luu[2])[0] <= 0
    H, g, _ = dense(model, jnp.zeros(4))
    assert np.linalg.eigvalsh(H)[0] > 0
    sweep = unaided(model, d)
    _, dus = lqr_rollout(model, sweep.k, sweep.K, jnp.zeros(4))
    np.testing.assert_allclose(dus.ravel(), -np.linalg.solve(H, g), rtol=1e-8, atol=1e-11)


@pytest.mark.parametrize("kind", ["not convex", "not finite"])
def test_what_the_parallel_sweep_cannot_do_ends_as_the_sequential_one(kind):
    model = random_model(6)
    broken = {
        "not convex": {"luu": model.luu.at[3].add(-1e3 * jnp.eye(2))},
        "not finite": {"lx": model.lx.at[2, 1].set(jnp.nan)},
    }[kind]
    model, none = model._replace(**broken), jnp.zeros_like(model.lu)
    got, wanted = parallel(model, none), sequential(model, none)
    assert not unaided(model, none).ok
    for a, b in zip(got, wanted, strict=True):
        np.testing.assert_array_equal(a, b)
    assert bool(got.ok) == (kind != "not convex")
    assert int(got.failed) == (3 if kind == "not convex" else -1)
    assert int(got.nonfinite) == (2 if kind == "not finite" else -1)


@pytest.mark.parametrize("name", ["pendulum", "muscle arm, via"])
def test_both_sweeps_agree_on_the_packages_models(name):
    model = local_model(name)
    for damping in (0.0, 0.1):
        assert_close(unaided(model, damping), sequential(model, damping))


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_both_sweeps_agree_on_every_model(name):
    model = local_model(name)
    # Of eight links the sequential sweep itself is known to 1.3e-9 (against long doubles).
    tolerance = 5e-9 if "chain of 8" in name else 1e-9
    for damping in (0.0, 0.1):
        wanted = sequential(model, damping)
        if not wanted.ok:  # the obstacle's cost is not convex along the nominal movement
            assert "obstacle" in name and damping == 0 and not unaided(model, damping).ok
            continue
        assert_close(unaided(model, damping), wanted, tolerance)


def test_sweeps_agree_over_a_long_unstable_horizon():
    """Without feedback a deviation grows by e^60 in 20 s."""
    problem = jc.tasks.swing_up(jc.plants.Pendulum(), 20.0, num_steps=2000)
    us = jnp.zeros((2000, 1))
    xs = jnp.zeros((2001, 2))
    model = jax.jit(jc.expand)(problem, xs, us)
    model = model._replace(vx=jnp.array([0.3, -0.2]))
    assert_close(unaided(model, 0.0), sequential(model, 0.0))


def test_sweeps_with_held_controls_agree():
    model = random_model(7, T=20)
    rng = np.random.default_rng(7)
    free = jnp.asarray(rng.uniform(size=model.lu.shape) > 0.4)
    held, extra, d = (jnp.asarray(rng.uniform(size=model.lu.shape)) for _ in range(3))
    got, wanted = (
        jax.jit(engine.held_lqr)(model, free, held, d, extra) for engine in (_parallel, _riccati)
    )
    assert_close(got, wanted, 1e-11)
    assert (got.K[~free] == 0).all() and (got.slope[free] == 0).all()


def test_box_sweeps_agree():
    model = random_model(8, T=20)
    tight = jnp.full(model.lu.shape, 0.05)
    (got, side), (wanted, same) = (
        jax.jit(box_lqr, static_argnames="engine")(model, -tight, tight, 0.1, engine=engine)
        for engine in ("parallel", "sequential")
    )
    assert got.settled and 0 < (side != 0).sum() < side.size
    np.testing.assert_array_equal(side, same)
    assert_close(got, wanted, 1e-10)


def test_lanes_of_a_batch_do_not_disturb_one_another():
    models = [random_model(seed) for seed in range(3)]
    models[1] = models[1]._replace(luu=models[1].luu - 1e3 * jnp.eye(2))
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *models)
    none = jnp.zeros_like(batch.lu)
    got = jax.jit(jax.vmap(parallel))(batch, none)
    np.testing.assert_array_equal(got.ok, [True, False, True])
    for lane, model in enumerate(models):
        wanted = sequential(model, none[lane])
        assert_close(jax.tree.map(lambda a, lane=lane: a[lane], got), wanted, 1e-11)


def test_float32_is_as_exact_as_the_sequential_sweep():
    model = jax.tree.map(lambda a: a.astype(jnp.float32), local_model("muscle arm, via"))
    exact = sequential(jax.tree.map(lambda a: a.astype(jnp.float64), model), 0.0)
    none = jnp.zeros_like(model.lu)
    for name in ("k", "K"):
        wanted = getattr(exact, name)
        errors = [
            float(jnp.max(jnp.abs(getattr(sweep(model, none), name) - wanted)))
            for sweep in (unaided, sequential)
        ]
        assert errors[0] <= 3 * errors[1] <= 3e-5 * float(jnp.max(jnp.abs(wanted)))


@pytest.mark.parametrize(
    "name",
    [
        "torque arm, reach",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("pendulum", "pendulum, bounded", "muscle arm, bounded hard")
        ),
    ],
)
def test_solvers_take_the_same_steps_with_either_sweep(name):
    problem, x0 = PROBLEMS[name]()
    got, wanted = (
        jax.jit(lambda x0, sweep=sweep: jc.solve(problem, jc.ILQR(sweep=sweep), x0))(x0)
        for sweep in ("parallel", "sequential")
    )
    assert got.status.ok and got.num_steps == wanted.num_steps
    np.testing.assert_allclose(got.cost, wanted.cost, rtol=1e-9)
    np.testing.assert_allclose(got.us, wanted.us, atol=1e-6 * float(jnp.abs(wanted.us).max()))


@pytest.mark.parametrize("solver", [jc.ILQR, jc.DDP])
def test_unknown_sweeps_are_refused_with_the_choices(solver):
    with pytest.raises(ValueError, match="'sequential', 'parallel' is wanted, got 'paralel'"):
        solver(sweep="paralel")
    with pytest.raises(ValueError, match="'sequential', 'parallel'"):
        lqr(random_model(0), engine="dense")
