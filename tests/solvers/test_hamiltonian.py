"""The controls that minimise the Hamiltonian, and that a program not solved is no minimum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl.linear import box_qp
from jaxctrl.solvers import _hamiltonian
from jaxctrl.solvers._hamiltonian import Hamiltonian

COUPLED = np.array([[13.1, 1, -2], [1, 14.1, -5], [-2, -5, 2.1]])


def hamiltonian(R, bounds=(-1.0, 1.0)):
    """Return that of x' = u with the cost u'Ru/2, or sum_i R_i u_i^2/2, from u = 0 down p."""
    plant = jc.FunctionPlant(lambda x, u, t: u, nx=3, nu=3, control_bounds=bounds)
    R = jnp.asarray(R)
    cost = jc.FunctionCost(running=lambda x, u, t: 0.5 * u @ (R @ u if R.ndim == 2 else R * u))
    return Hamiltonian(jc.Problem(plant, cost, num_steps=5, dt=0.1), jnp.zeros(3))


def test_coupled_controls_reach_their_minimum_in_the_box():
    p = jnp.array([-4.0, -5, 3])
    u, minimised = hamiltonian(COUPLED).minimiser(jnp.zeros(3), p, 0.0)
    free = np.linalg.solve(COUPLED[:2, :2], -(np.asarray(p)[:2] - COUPLED[:2, 2]))
    assert minimised
    np.testing.assert_allclose(u, [*free, -1.0], rtol=1e-12)


def test_a_program_that_did_not_finish_is_no_minimum(monkeypatch):
    """Even where what it returns looks like one."""

    def unfinished(*given):
        return box_qp(*given)._replace(finished=jnp.array(False))

    monkeypatch.setattr(_hamiltonian, "box_qp", unfinished)
    _, minimised = hamiltonian(COUPLED).minimiser(jnp.zeros(3), jnp.ones(3), 0.0)
    assert not minimised


@pytest.mark.parametrize(
    "R", [COUPLED - 5 * np.eye(3), np.array([1.0, -1.0, 1.0])], ids=["coupled", "separate"]
)
def test_a_concave_control_at_a_bound_is_no_minimum(R):
    """At one bound the gradient pushes outwards, but the other bound may be lower."""
    assert (R if R.ndim == 1 else np.linalg.eigvalsh(R)).min() < 0
    for key in range(20):
        p = 3 * jax.random.normal(jax.random.key(key), (3,))
        _, minimised = hamiltonian(R).minimiser(jnp.zeros(3), p, 0.0)
        assert not minimised


def test_a_control_without_a_price_is_at_its_bound():
    u, minimised = hamiltonian(np.zeros(3)).minimiser(
        jnp.zeros(3), jnp.array([5.0, -5.0, 5.0]), 0.0
    )
    assert minimised
    np.testing.assert_array_equal(u, [-1.0, 1.0, -1.0])
