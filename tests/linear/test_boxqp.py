"""The bounded quadratic program against all active sets, SciPy and differences; what it refuses."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from jaxctrl.linear import _boxqp, box_qp

SOLVE = jax.jit(jax.vmap(box_qp))
KINDS = ["plain", "stiff", "scaled", "nearly singular", "correlated", "integer", "degenerate"]


def curvatures(rng, n, m, kind):
    """Return m symmetric positive definite matrices, (m, n, n), and units of the variables."""
    A, units = rng.normal(size=(m, n, n)), np.ones((m, n))
    if kind == "stiff":
        Q, size = np.linalg.qr(A)[0], 10.0 ** rng.uniform(-10, 0, (m, n))
        H = np.einsum("mij,mj,mkj->mik", Q, size, Q)
    elif kind == "nearly singular":
        A = A[:, :, : max(1, n // 2)]
        H = A @ A.transpose(0, 2, 1) + 1e-6 * np.eye(n)
    elif kind == "correlated":
        sign = rng.choice([-1, 1], (m, n))
        H = (0.999 + 0.001 * np.eye(n)) * sign[:, :, None] * sign[:, None, :]
    elif kind == "integer":
        A = rng.integers(-2, 3, (m, n, n)).astype(float)
        H = A @ A.transpose(0, 2, 1) + np.eye(n)
    else:
        H = A @ A.transpose(0, 2, 1) + 0.1 * np.eye(n)
        if kind == "scaled":
            units = 10.0 ** rng.uniform(-5, 5, (m, n))
            H = H / units[:, :, None] / units[:, None, :]
    return 0.5 * (H + H.transpose(0, 2, 1)), units


def programs(rng, n, m, kind):
    """Return m random programs, H, g, lower, upper, with infinite and equal bounds among them."""
    H, units = curvatures(rng, n, m, kind)
    if kind == "integer":
        lower, upper = -rng.integers(0, 3, (m, n)) * 1.0, rng.integers(0, 3, (m, n)) * 1.0
        g = rng.integers(-6, 7, (m, n)) * 1.0
    else:
        offset = rng.normal(size=(m, n)) * (rng.uniform(size=(m, 1)) < 0.3)
        lower = units * (offset - 10.0 ** rng.uniform(-2, 1, (m, n)))
        upper = units * (offset + 10.0 ** rng.uniform(-2, 1, (m, n)))
        g = rng.normal(size=(m, n)) * 10.0 ** rng.uniform(-1, 2, (m, 1)) / units
    if kind == "degenerate":  # half the multipliers of the bounds are zero
        where = rng.integers(0, 3, (m, n))
        x = np.select([where == 0, where == 1], [lower, upper], 0.5 * (lower + upper))
        multipliers = np.choose(where, [1.0, -1.0, 0.0]) * rng.integers(0, 2, (m, n))
        g = multipliers - np.einsum("mij,mj->mi", H, x)
    chance = rng.uniform(size=(m, n))
    lower = np.where(chance < 0.1, -np.inf, lower)
    upper = np.where((chance > 0.05) & (chance < 0.15), np.inf, upper)
    return H, g, lower, np.where(chance > 0.95, lower, upper)


def value(H, g, x):
    return np.einsum("mi,mi->m", x, g) + 0.5 * np.einsum("mi,mij,mj->m", x, H, x)


def by_all_sets(H, g, lower, upper):
    """Return the least value over all 3^n sets of held variables whose solution is in the box."""
    m, n = g.shape
    best = np.full(m, np.inf)
    for side in itertools.product((-1, 0, 1), repeat=n):
        free = np.array(side) == 0
        x = np.where(free, 0.0, np.where(np.array(side) < 0, lower, upper))
        possible = np.isfinite(x).all(axis=1)
        x = np.where(np.isfinite(x), x, 0.0)
        if free.any():
            slope = g + np.einsum("mij,mj->mi", H, x)
            x[:, free] = -np.linalg.solve(H[:, free][:, :, free], slope[:, free, None])[..., 0]
        near = 1e-9 * (np.abs(x) + np.abs(x).max(axis=1, keepdims=True) * 1e-6)
        possible &= ((x >= lower - near) & (x <= upper + near)).all(axis=1)
        best = np.where(possible, np.minimum(best, value(H, g, np.clip(x, lower, upper))), best)
    return best


def by_least_squares(H, g, lower, upper):
    """Return the least value by SciPy's bounded least squares, one program after another."""
    found = []
    for H_, g_, low, high in zip(H, g, lower, upper, strict=True):
        d = 1 / np.sqrt(np.diag(H_))
        root = np.linalg.cholesky(H_ * np.outer(d, d))
        free, x = low < high, np.where(low < high, 0.0, low / d)
        aim = -np.linalg.solve(root, g_ * d) - root.T @ x
        if free.any():
            x[free] = scipy.optimize.lsq_linear(
                root.T[:, free], aim, ((low / d)[free], (high / d)[free]), method="bvls", tol=1e-15
            ).x
        x = np.clip(x * d, low, high)
        found.append(x @ g_ + 0.5 * x @ H_ @ x)
    return np.array(found)


def worst_residual(H, g, lower, upper, x):
    """Return by how many eps of its terms each program's conditions of a minimum are off."""
    r = g + np.einsum("mij,mj->mi", H, x)
    size = np.abs(g) + np.einsum("mij,mj->mi", np.abs(H), np.abs(x))
    off = np.where((x > lower) & (r > 0), r, 0.0) + np.where((x < upper) & (r < 0), -r, 0.0)
    return (off / np.where(size > 0, size, 1.0)).max() / np.finfo(float).eps


def check(kind, n, m, seed):
    given = programs(np.random.default_rng([seed, n]), n, m, kind)
    H, g, lower, upper = given
    qp = jax.tree.map(np.asarray, SOLVE(*given))
    assert qp.finished.all() and qp.positive.all()
    assert ((qp.x >= lower) & (qp.x <= upper)).all()
    assert worst_residual(*given, qp.x) <= 101
    size = value(np.abs(H), np.abs(g), np.abs(qp.x))
    count = m if n <= 4 else 10
    oracle = by_all_sets if n <= 4 else by_least_squares
    wanted = oracle(*(part[:count] for part in given))
    assert (value(H, g, qp.x)[:count] - wanted <= 1e-14 * size[:count]).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [1, 2, 3, 4, 6, 8])
def test_every_random_program_is_solved_to_round_off(n, kind):
    check(kind, n, 200, 0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", range(1, 9))
def test_a_hundred_thousand_programs_are_solved_to_round_off(n, kind):
    check(kind, n, 1800, 1)


def test_no_point_inside_a_bound_is_taken_for_the_minimum():
    """Newton's steps, projected on the box, stopped at a projected gradient of 1.3."""
    H = np.array([[13.1, 1, -2], [1, 14.1, -5], [-2, -5, 2.1]])
    g = np.array([-4.0, -5, 3])
    qp = box_qp(H, g, -np.ones(3), np.ones(3))
    free = np.linalg.solve(H[:2, :2], -(g[:2] - H[:2, 2]))
    assert qp.finished
    np.testing.assert_allclose(qp.x, [*free, -1.0], rtol=1e-13)
    np.testing.assert_array_equal(qp.free, [True, True, False])


def test_sets_that_cycle_are_left_one_variable_at_a_time(monkeypatch):
    """Changing all that is wrong at once leads back to the same sets here."""
    H = np.array([[15.0, 7, 14, -1], [7, 16, 14, 9], [14, 14, 20, 5], [-1, 9, 5, 10]])
    given = (H, np.array([-2.0, -3, 3, 3]), -np.ones(4), np.ones(4))
    qp = box_qp(*given)
    assert qp.finished
    wanted = by_all_sets(*(part[None] for part in given))
    np.testing.assert_allclose(value(H[None], given[1][None], np.asarray(qp.x)[None]), wanted)
    monkeypatch.setattr("jaxctrl.linear._boxqp.PATIENCE", 1000)
    assert not _boxqp.box_qp(*given).finished


def test_crossed_bounds_are_refused_and_traced_ones_do_not_finish():
    H, g = jnp.eye(2), jnp.ones(2)
    lower, upper = jnp.array([0.0, 1.0]), jnp.array([1.0, -1.0])
    with pytest.raises(ValueError, match=r"lower <= upper is wanted, got 1.0 > -1.0 at index 1"):
        box_qp(H, g, lower, upper)
    assert not jax.jit(box_qp)(H, g, lower, upper).finished


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("which", range(4))
def test_what_is_not_finite_does_not_finish(which, bad):
    given = [np.eye(2), np.ones(2), -np.ones(2), np.ones(2)]
    given[which] = given[which] * np.array([1.0, bad]) if which else np.full((2, 2), bad)
    if which >= 2 and np.isinf(bad):
        return  # bounds may be infinite
    assert not _boxqp.box_qp(*given).finished


def test_too_few_steps_do_not_finish():
    H, g, lower, upper = (part[0] for part in programs(np.random.default_rng(3), 8, 1, "plain"))
    enough = box_qp(H, g, lower, upper)
    assert enough.finished and enough.num_steps > 1
    assert not box_qp(H, g, lower, upper, max_steps=int(enough.num_steps) - 1).finished


@pytest.mark.parametrize("seed", range(4))
def test_derivatives_are_those_of_the_minimiser(seed):
    H, g, lower, upper = (p[0] for p in programs(np.random.default_rng(seed), 5, 1, "plain"))
    lower, upper = np.maximum(lower, -1e3), np.minimum(upper, 1e3)

    def solve(H, g, lower, upper):
        return box_qp(0.5 * (H + H.T), g, lower, upper).x

    minimiser = jax.jit(solve)
    forward = jax.jit(jax.jacfwd(solve, argnums=(0, 1, 2, 3)))(H, g, lower, upper)
    reverse = jax.jit(jax.jacrev(solve, argnums=(0, 1, 2, 3)))(H, g, lower, upper)
    for a, b, which in zip(forward, reverse, range(4), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
        given = [H, g, lower, upper]
        for i in np.ndindex(given[which].shape):
            if which >= 2 and lower[i] == upper[i]:
                continue
            ends = []
            for h in (1e-6, -1e-6):
                moved = [part.copy() for part in given]
                moved[which][i] += h
                ends.append(minimiser(*moved))
            np.testing.assert_allclose(
                a[(..., *i)], (ends[0] - ends[1]) / 2e-6, atol=2e-7, rtol=1e-5
            )


def test_second_derivatives_are_differences_of_the_first():
    H, g = jnp.array([[2.0, 0.3], [0.3, 1.0]]), jnp.array([1.0, -4.0])

    @jax.jit
    def first(s):
        low, high = -jnp.ones(2), jnp.full(2, jnp.inf)
        return jax.jacrev(lambda s: box_qp(H * (1 + s**2), g, low, high).x)(s)

    difference = (first(0.5 + 1e-6) - first(0.5 - 1e-6)) / 2e-6
    np.testing.assert_allclose(jax.jit(jax.jacfwd(first))(0.5), difference, atol=1e-8)


def test_derivatives_of_what_did_not_finish_are_nan():
    solve = jax.jit(jax.jacfwd(lambda g: box_qp(jnp.eye(2), g, jnp.ones(2), -jnp.ones(2)).x))
    assert jnp.isnan(solve(jnp.ones(2))).all()


def test_float32_is_certified_by_its_own_round_off(float32):
    for kind in ("plain", "scaled", "integer", "degenerate"):
        given = [p.astype(np.float32) for p in programs(np.random.default_rng(7), 4, 300, kind)]
        qp = SOLVE(*given)
        assert qp.x.dtype == jnp.float32
        assert qp.finished.all()
        given = [p.astype(np.float64) for p in given]
        off = worst_residual(*given, np.asarray(qp.x, np.float64))
        assert off * np.finfo(float).eps <= 110 * np.finfo(np.float32).eps
