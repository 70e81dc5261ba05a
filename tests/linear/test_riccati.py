"""The sweeps against dense linear algebra: one KKT system, an enumerated box QP, Theorem 1."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

from jaxctrl import LocalModel
from jaxctrl._linalg import matmul, solve_positive
from jaxctrl.linear import (
    box_lqr,
    box_qp,
    costates,
    factorise,
    lqr,
    lqr_rollout,
    solve_factorised,
)
from jaxctrl.linear._interior_point import Box, advance, barrier, begin
from jaxctrl.linear._riccati import held_lqr


def random_model(seed, T=6, nx=4, nu=2, convex=True):
    rng = np.random.default_rng(seed)

    def normal(*shape):
        return rng.normal(size=shape)

    root = normal(T, nx + nu, nx + nu) * 0.5
    lzz = np.einsum("tij,tkj->tik", root, root) + 0.5 * np.eye(nx + nu)
    if not convex:
        lzz -= 0.6 * np.eye(nx + nu)
    end = normal(nx, nx)
    return LocalModel(
        *map(
            jnp.asarray,
            (
                normal(T, nx, nx) * 0.6,
                normal(T, nx, nu),
                normal(T, nx),
                normal(T, nu),
                lzz[:, :nx, :nx],
                lzz[:, nx:, :nx],
                lzz[:, nx:, nx:],
                normal(nx),
                end @ end.T,
            ),
        )
    )


def dense(model, dx0):
    """Return H, g and the cost function of the total cost as a quadratic in all controls."""

    def cost(dus):
        def body(carry, stage):
            dx, J = carry
            fx, fu, lx, lu, lxx, lux, luu, du = stage
            J += lx @ dx + lu @ du + 0.5 * (dx @ lxx @ dx + 2 * du @ lux @ dx + du @ luu @ du)
            return (fx @ dx + fu @ du, J), None

        (dx, J), _ = jax.lax.scan(body, (dx0, 0.0), (*model.stages[:-1], dus))
        return J + model.vx @ dx + 0.5 * dx @ model.vxx @ dx

    zero = jnp.zeros_like(model.lu)
    n = zero.size
    return jax.hessian(cost)(zero).reshape(n, n), jax.grad(cost)(zero).reshape(n), cost


@pytest.mark.parametrize("seed", range(3))
def test_sweep_solves_the_dense_kkt_system(seed):
    model = random_model(seed)
    dx0 = jnp.asarray(np.random.default_rng(seed).normal(size=4))
    H, g, _ = dense(model, dx0)
    wanted = -np.linalg.solve(H, g).reshape(model.lu.shape)
    sweep = lqr(model)
    assert sweep.ok
    _, dus = lqr_rollout(model, sweep.k, sweep.K, dx0)
    np.testing.assert_allclose(dus, wanted, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("step", [0.3, 1.0])
@pytest.mark.parametrize("damping", [0.0, 5.0])
def test_expected_change_equals_the_change_of_the_model(damping, step):
    model = random_model(3)
    _, _, cost = dense(model, jnp.zeros(4))
    sweep = lqr(model, damping)
    _, dus = lqr_rollout(model, step * sweep.k, sweep.K, jnp.zeros(4))
    expected = step * sweep.linear + step**2 * sweep.quadratic
    damped = cost(dus) + 0.5 * damping * jnp.sum(dus**2)
    np.testing.assert_allclose(damped, expected, rtol=1e-12)


def test_costates_give_the_gradient_of_the_total_cost():
    model = random_model(4)
    _, g, _ = dense(model, jnp.zeros(4))
    np.testing.assert_allclose(costates(model)[1].ravel(), g, rtol=1e-12)


def test_damping_solves_the_dense_damped_system_and_tends_to_the_gradient():
    model = random_model(5)
    H, g, _ = dense(model, jnp.zeros(4))
    d = jnp.asarray(np.random.default_rng(5).uniform(0.1, 3, model.lu.shape))
    sweep = lqr(model, d)
    _, dus = lqr_rollout(model, sweep.k, sweep.K, jnp.zeros(4))
    wanted = -np.linalg.solve(H + np.diag(d.ravel()), g)
    np.testing.assert_allclose(dus.ravel(), wanted, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(1e9 * lqr(model, 1e9).k.ravel(), -g, rtol=1e-5)


def test_indefinite_control_hessian_is_reported_with_its_step():
    model = random_model(6)
    model = model._replace(luu=model.luu.at[3].add(-1e3 * jnp.eye(2)))
    sweep = lqr(model)
    assert not sweep.ok
    assert int(sweep.failed) == 3
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(sweep))


def test_theorem_1_is_a_special_case():
    """Li (2006), eq. 4.12-4.18, against the shared sweep."""
    rng = np.random.default_rng(7)
    T, nx, nu = 8, 4, 2
    A, B = rng.normal(size=(T, nx, nx)) * 0.6, rng.normal(size=(T, nx, nu))
    Q, R, Qf = np.diag(rng.uniform(size=nx)), np.diag(0.5 + rng.uniform(size=nu)), np.eye(nx)
    xs, us, target = rng.normal(size=(T + 1, nx)), rng.normal(size=(T, nu)), rng.normal(size=nx)
    S, v = Qf, Qf @ (xs[-1] - target)
    want_k, want_K = np.zeros((T, nu)), np.zeros((T, nu, nx))
    for t in reversed(range(T)):
        H = B[t].T @ S @ B[t] + R
        K = np.linalg.solve(H, B[t].T @ S @ A[t])
        Kv, Ku = np.linalg.solve(H, B[t].T), np.linalg.solve(H, R)
        want_K[t], want_k[t] = -K, -Kv @ v - Ku @ us[t]
        closed = A[t] - B[t] @ K
        v = closed.T @ v - K.T @ R @ us[t] + Q @ xs[t]
        S = A[t].T @ S @ closed + Q
    model = LocalModel(
        *map(jnp.asarray, (A, B, xs[:-1] @ Q, us @ R)),
        lxx=jnp.broadcast_to(Q, (T, nx, nx)),
        lux=jnp.zeros((T, nu, nx)),
        luu=jnp.broadcast_to(R, (T, nu, nu)),
        vx=jnp.asarray(Qf @ (xs[-1] - target)),
        vxx=jnp.asarray(Qf),
    )
    sweep = lqr(model)
    np.testing.assert_allclose(sweep.K, want_K, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(sweep.k, want_k, rtol=1e-9, atol=1e-12)


def test_long_horizon_gain_is_the_algebraic_riccati_solution():
    rng = np.random.default_rng(8)
    A, B = rng.normal(size=(3, 3)) * 0.7, rng.normal(size=(3, 2))
    Q, R, T = np.eye(3), 0.4 * np.eye(2), 200
    P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    wanted = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)

    def repeat(a):
        return jnp.broadcast_to(jnp.asarray(a), (T, *a.shape))

    zeros = np.zeros
    model = LocalModel(
        *map(repeat, (A, B, zeros(3), zeros(2), Q, zeros((2, 3)), R)),
        vx=jnp.zeros(3),
        vxx=jnp.asarray(Q),
    )
    np.testing.assert_allclose(lqr(model).K[0], wanted, rtol=1e-9)


@pytest.mark.parametrize("n", [1, 2, 6, 9])
@pytest.mark.parametrize("seed", range(4))
def test_box_qp_equals_bounded_least_squares(seed, n):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    H, g = root @ root.T + 0.1 * np.eye(n), 3 * rng.normal(size=n)
    lower, upper = -rng.uniform(size=n), rng.uniform(size=n)
    L = np.linalg.cholesky(H)
    oracle = scipy.optimize.lsq_linear(
        L.T, -np.linalg.solve(L, g), (lower, upper), method="bvls", tol=1e-15
    ).x
    qp = box_qp(*map(jnp.asarray, (H, g, lower, upper)))
    assert qp.finished and qp.positive
    np.testing.assert_allclose(qp.x, oracle, atol=1e-8)
    gradient = np.asarray(g + H @ qp.x)
    assert (np.abs(gradient[np.asarray(qp.free)]) < 1e-10).all()


def test_box_qp_keeps_equal_bounds_and_infinite_ones():
    H, g = jnp.array([[2.0, 0.3], [0.3, 1.0]]), jnp.array([1.0, -4.0])
    fixed = box_qp(H, g, jnp.array([0.2, -jnp.inf]), jnp.array([0.2, jnp.inf]))
    np.testing.assert_allclose(fixed.x, [0.2, 4.0 - 0.06], rtol=1e-12)
    open_ = box_qp(H, g, jnp.full(2, -jnp.inf), jnp.full(2, jnp.inf))
    np.testing.assert_allclose(open_.x, -jnp.linalg.solve(H, g), rtol=1e-12)


def test_box_qp_reports_an_indefinite_hessian():
    qp = box_qp(jnp.diag(jnp.array([1.0, -1.0])), jnp.ones(2), -jnp.ones(2), jnp.ones(2))
    # The second control is pushed to its lower bound by the gradient and leaves the free set.
    assert jnp.isfinite(qp.x).all()
    bad = box_qp(-jnp.eye(2), 0.1 * jnp.ones(2), -jnp.ones(2), jnp.ones(2))
    assert not bad.positive


def test_box_sweep_with_wide_bounds_is_the_unbounded_sweep():
    model = random_model(9)
    wide = jnp.full(model.lu.shape, 1e6)
    (boxed, side), plain = box_lqr(model, -wide, wide, 0.1), lqr(model, 0.1)
    assert boxed.settled and (side == 0).all()
    for name in ("k", "K", "curvature", "linear", "quadratic"):
        np.testing.assert_allclose(getattr(boxed, name), getattr(plain, name), rtol=1e-9)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("width", [0.02, 0.2, 1.0])
def test_box_sweep_equals_the_dense_bounded_problem(seed, width):
    model = random_model(seed, T=12)
    H, g, _ = dense(model, jnp.zeros(4))
    rng = np.random.default_rng(seed)
    lower = -width * rng.uniform(size=model.lu.shape)
    upper = width * rng.uniform(size=model.lu.shape)
    L = np.linalg.cholesky(H)
    bounds = (lower.ravel(), upper.ravel())
    oracle = scipy.optimize.lsq_linear(
        L.T, -np.linalg.solve(L, g), bounds, method="bvls", tol=1e-15
    ).x
    sweep, side = box_lqr(model, jnp.asarray(lower), jnp.asarray(upper))
    _, dus = lqr_rollout(model, sweep.k, sweep.K, jnp.zeros(4))
    assert sweep.ok and sweep.settled
    np.testing.assert_allclose(dus.ravel(), oracle, atol=1e-8)
    assert (sweep.K[side != 0] == 0).all()
    np.testing.assert_allclose(
        sweep.linear + sweep.quadratic, g @ oracle + 0.5 * oracle @ H @ oracle, rtol=1e-8
    )


def test_box_sweep_from_a_wrong_guess_finds_the_same_set():
    model = random_model(10)
    tight = jnp.full(model.lu.shape, 0.05)
    sweep, side = box_lqr(model, -tight, tight)
    guess = jnp.where(jnp.arange(side.size).reshape(side.shape) % 2 == 0, 1.0, -1.0)
    again, same = box_lqr(model, -tight, tight, side=guess)
    np.testing.assert_array_equal(side, same)
    np.testing.assert_allclose(again.k, sweep.k, atol=1e-12)


def test_box_sweep_cut_short_is_finished_by_the_interior_point():
    model = random_model(10)
    tight = jnp.full(model.lu.shape, 0.05)
    whole, _ = box_lqr(model, -tight, tight)
    sweep, _ = box_lqr(model, -tight, tight, side=jnp.zeros_like(tight), max_sweeps=1)
    assert sweep.ok and sweep.settled
    np.testing.assert_allclose(
        sweep.linear + sweep.quadratic, whole.linear + whole.quadratic, rtol=1e-6
    )


def _interior_point(box):
    """Return the interior-point method's last point."""
    gradient = costates(box.model)[1]

    @jax.jit
    def step(point):
        weight, extra = barrier(box, point)
        damping = box.damping + weight
        end = held_lqr(box.model, box.movable, box.lower, damping, extra)
        return advance(box, point, end, weight, extra)

    point = begin(box, gradient, jnp.array(1.0))
    while not point.done:
        point = step(point)
    return point


@pytest.mark.parametrize("seed", range(4))
def test_interior_point_takes_bounds_that_are_missing_or_equal(seed):
    model = random_model(seed, T=12)
    H, g, _ = dense(model, jnp.zeros(4))
    rng = np.random.default_rng(seed)
    lower = np.where(rng.uniform(size=model.lu.shape) < 0.3, -np.inf, -0.1)
    upper = np.where(rng.uniform(size=model.lu.shape) < 0.3, np.inf, 0.2)
    lower[3], upper[3] = 0.0, 0.0
    box = Box(model, 0 * model.lu, jnp.asarray(lower), jnp.asarray(upper))
    point = _interior_point(box)
    assert point.settled and point.count <= 20
    assert (point.dus >= lower - 1e-9).all() and (point.dus <= upper + 1e-9).all()
    np.testing.assert_array_equal(point.dus[3], 0.0)
    dus, low, high = point.dus.ravel(), point.lower_multiplier, point.upper_multiplier
    # Karush, Kuhn and Tucker's conditions, on the dense problem.
    slope = (g + H @ dus).reshape(lower.shape)
    movable = np.arange(12) != 3
    np.testing.assert_allclose((slope - low + high)[movable], 0, atol=1e-6 * np.abs(g).max())
    assert (low[np.isinf(lower)] == 0).all() and (high[np.isinf(upper)] == 0).all()
    value = g @ dus + 0.5 * dus @ H @ dus
    free = movable.repeat(2)
    L = np.linalg.cholesky(H[np.ix_(free, free)])
    bounds = (lower.ravel()[free], upper.ravel()[free])
    best = scipy.optimize.lsq_linear(L.T, -np.linalg.solve(L, g[free]), bounds, tol=1e-13).x
    wanted = g[free] @ best + 0.5 * best @ H[np.ix_(free, free)] @ best
    np.testing.assert_allclose(value, wanted, rtol=1e-5)


def test_interior_point_says_where_the_problem_is_not_convex():
    model = random_model(0)
    concave = model._replace(luu=-100 * jnp.abs(model.luu))
    box = jnp.ones(model.lu.shape)
    point = _interior_point(Box(concave, 0 * box, -box, box))
    assert point.count == 1 and not point.settled and jnp.isfinite(point.dus).all()


def test_factorised_solve_equals_the_dense_system_with_controls_held():
    model = random_model(11, convex=True)
    rng = np.random.default_rng(11)
    free = rng.uniform(size=model.lu.shape) > 0.3
    b, held = rng.normal(size=model.lu.shape), rng.normal(size=model.lu.shape) * ~free
    H, _, _ = dense(model, jnp.zeros(4))
    f = free.ravel()
    wanted = held.ravel().copy()
    wanted[f] = -np.linalg.solve(H[np.ix_(f, f)], b.ravel()[f] + H[np.ix_(f, ~f)] @ wanted[~f])
    system = factorise(model, jnp.asarray(free))
    dxs, got = solve_factorised(system, jnp.asarray(b), jnp.asarray(held))
    assert system.ok.all()
    rolled, _ = lqr_rollout(model, got, jnp.zeros_like(system.K), jnp.zeros(4))
    np.testing.assert_allclose(dxs, rolled, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(got.ravel(), wanted, rtol=1e-8, atol=1e-11)


def test_factorised_solve_with_all_linear_terms_equals_the_dense_problem():
    # Offsets of the dynamics and a first state move the free minimiser as a shifted problem does.
    model = random_model(12, convex=True)
    rng = np.random.default_rng(12)
    offset, dx0 = rng.normal(size=model.lx.shape), rng.normal(size=4)
    system = factorise(model, jnp.ones(model.lu.shape, bool), 0.3)
    dxs, dus = solve_factorised(
        system,
        model.lu,
        jnp.zeros_like(model.lu),
        lx=model.lx,
        vx=model.vx,
        offset=jnp.asarray(offset),
        dx0=jnp.asarray(dx0),
    )

    def cost(dus):
        x, total = jnp.asarray(dx0), 0.15 * jnp.sum(dus**2)
        for k in range(len(dus)):
            u = dus[k]
            total += model.lx[k] @ x + model.lu[k] @ u + u @ model.lux[k] @ x
            total += 0.5 * (x @ model.lxx[k] @ x + u @ model.luu[k] @ u)
            x = model.fx[k] @ x + model.fu[k] @ u + offset[k]
        return total + model.vx @ x + 0.5 * x @ model.vxx @ x

    np.testing.assert_allclose(jax.grad(cost)(dus), 0, atol=1e-9)
    np.testing.assert_allclose(dxs[0], dx0)


@pytest.mark.parametrize("shapes", [((3, 4), (4, 2)), ((6, 17), (17, 9)), ((30, 5), (5,))])
def test_products_written_out_equal_the_librarys(shapes):
    rng = np.random.default_rng(0)
    A, B = (rng.normal(size=shape) for shape in shapes)
    np.testing.assert_allclose(matmul(jnp.asarray(A), jnp.asarray(B)), A @ B, rtol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 6, 12, 24])
def test_positive_systems_are_solved_and_indefinite_ones_flagged(n):
    rng = np.random.default_rng(n)
    root = rng.normal(size=(n, n))
    A, B = root @ root.T + 0.1 * np.eye(n), rng.normal(size=(n, 3))
    X, ok = solve_positive(jnp.asarray(A), jnp.asarray(B))
    assert ok
    np.testing.assert_allclose(X, np.linalg.solve(A, B), rtol=1e-8, atol=1e-10)
    _, ok = solve_positive(jnp.asarray(A - 2 * np.linalg.eigvalsh(A)[0] * np.eye(n)), B)
    assert not ok


def test_derivatives_of_a_positive_solve_are_those_of_the_inverse():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(4, 4))
    A, B = jnp.asarray(root @ root.T + np.eye(4)), jnp.asarray(rng.normal(size=(4, 2)))
    for mode in (jax.jacfwd, jax.jacrev):
        got = mode(lambda A: solve_positive(0.5 * (A + A.T), B)[0])(A)
        wanted = mode(lambda A: jnp.linalg.solve(0.5 * (A + A.T), B))(A)
        np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-11)


def unstable_model(seed, T=25):
    """An unstable plant, growing by a quarter a step, and tight bounds, some without room."""
    rng = np.random.default_rng(seed)
    n = rng.standard_normal
    root, end = n((T, 6, 6)), n((4, 4))
    lzz = root @ root.transpose(0, 2, 1) / 6
    luu = lzz[:, 4:, 4:] + 1e-3 * np.eye(2)
    dynamics = 1.25 * np.eye(4) + 0.1 * n((T, 4, 4)), 0.3 * n((T, 4, 2))
    blocks = n((T, 4)), n((T, 2)), lzz[:, :4, :4], lzz[:, 4:, :4], luu, n(4), end @ end.T
    low, high = rng.random((2, T, 2))
    bounds = -0.03 * low * (low > 0.2), 0.03 * high * (high > 0.2)
    return LocalModel(*map(jnp.asarray, (*dynamics, *blocks))), *map(jnp.asarray, bounds)


@pytest.mark.parametrize("max_sweeps", [12, 1])
@pytest.mark.parametrize("seed", [0, 4, 8, 12])
def test_gains_are_those_of_the_bounds_that_the_controls_are_at(seed, max_sweeps):
    """Where sets cycle, as they did for controls without room, too; with one sweep they all do."""
    model, lower, upper = unstable_model(seed)
    sweep, side = box_lqr(model, lower, upper, max_sweeps=max_sweeps)
    assert sweep.ok and sweep.settled and not jnp.isnan(side).any()
    assert (lower == upper).sum() > 0 and (side != 0).sum() > 20
    held = held_lqr(model, side == 0, jnp.where(side < 0, lower, upper), 0 * lower)
    np.testing.assert_allclose(sweep.K, held.K, atol=1e-9 * float(jnp.abs(held.K).max()))
    assert (sweep.K[side != 0] == 0).all()
    dus = lqr_rollout(model, sweep.k, sweep.K, jnp.zeros(4))[1]
    H, g, _ = dense(model, jnp.zeros(4))
    slope = (g + H @ np.asarray(dus).ravel()).reshape(lower.shape)
    if max_sweeps == 12:  # exact: the conditions of the minimum on the dense problem
        assert ((dus >= lower - 1e-12) & (dus <= upper + 1e-12)).all()
        size = 1e-9 * np.abs(slope).max()
        assert (np.abs(slope[side == 0]) <= size).all() and (slope * side <= size).all()
    else:  # an interior point's
        exact = box_lqr(model, lower, upper)[0]
        wanted = lqr_rollout(model, exact.k, exact.K, jnp.zeros(4))[1]
        np.testing.assert_allclose(dus, wanted, atol=5e-3 * float(jnp.abs(dus).max()))


def test_only_the_symmetric_part_of_a_block_counts():
    model = random_model(5)
    rng = np.random.default_rng(5)

    def skewed(block):
        A = jnp.asarray(rng.normal(size=block.shape))
        return block + A - A.mT

    skew = model._replace(lxx=skewed(model.lxx), luu=skewed(model.luu), vxx=skewed(model.vxx))
    room = 0.3 * jnp.ones(model.lu.shape)
    for solve in (
        lqr,
        lambda m: lqr(m, engine="parallel"),
        lambda m: box_lqr(m, -room, room)[0],
    ):
        wanted, got = solve(model), solve(skew)
        np.testing.assert_allclose(got.K, wanted.K, atol=1e-11)
        np.testing.assert_allclose(got.k, wanted.k, atol=1e-11)
    with pytest.raises(ValueError, match=r"lower <= upper is wanted, got 0.3 > -0.3 at index \(0"):
        box_lqr(model, room, -room)
