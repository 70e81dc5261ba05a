"""Plants that users write: every natural spelling of their attributes, through both solvers."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

import jaxctrl as jc


def move(m, x, u):
    return jnp.stack([x[1], u[0] / m - 0.5 * jnp.sin(x[0])])


class AbstractMass(jc.AbstractPlant):
    nx: ClassVar[int] = 2
    nu: ClassVar[int] = 1
    m: eqx.AbstractVar[Array]

    def __call__(self, x, u, t):
        return move(self.m, x, u)


class Documented(jc.AbstractPlant):
    nx: ClassVar[int] = 2
    nu: ClassVar[int] = 1
    m: Array = eqx.field(converter=jc.array_leaf, default=1.0)
    control_bounds = (-1.0, 1.0)

    def __call__(self, x, u, t):
        return move(self.m, x, u)


class NothingButSizes(jc.AbstractPlant):
    nx = 2
    nu = 1
    m: Array = eqx.field(converter=jc.array_leaf, default=1.0)

    def __call__(self, x, u, t):
        return move(self.m, x, u)


class Unbounded(AbstractMass):
    m: Array = eqx.field(converter=jc.array_leaf, default=1.0)
    control_bounds = None


class ClassArrays(AbstractMass):
    m: Array = eqx.field(converter=jc.array_leaf, default=1.0)
    control_bounds: ClassVar[Any] = (np.array([-1.0]), [1.0])
    nominal_control: ClassVar[Any] = np.zeros(1)
    discrete: ClassVar[bool] = False


class OneSided(AbstractMass):
    m: Array = eqx.field(converter=jc.array_leaf, default=1.0)
    control_bounds = (-np.inf, 1)
    nominal_control = 0


class OfNumbers(AbstractMass):
    control_bounds: tuple
    m: Array = eqx.field(converter=jc.array_leaf)


class OfNumbersAfter(AbstractMass):
    m: Array = eqx.field(converter=jc.array_leaf, default=1.0)
    control_bounds: tuple | None = (-1.0, 1.0)
    nominal_control: Array | float = 0.0


class ByProperty(AbstractMass):
    m: Array = eqx.field(converter=jc.array_leaf, default=1.0)
    strength: Array = eqx.field(converter=jc.array_leaf, default=1.0)

    @property
    def control_bounds(self):
        return -self.strength, self.strength

    @property
    def nominal_control(self):
        return 0.0 * self.strength


class ByInit(jc.AbstractPlant):
    nx: int = eqx.field(static=True)
    nu: int = eqx.field(static=True)
    discrete: bool = eqx.field(static=True)
    m: Array
    control_bounds: Any
    nominal_control: Any

    def __init__(self, m=1.0):
        self.nx, self.nu, self.discrete = 2, 1, False
        self.m = jnp.asarray(m)
        self.control_bounds = [jnp.full(1, -1.0), jnp.full(1, 1.0)]
        self.nominal_control = jnp.zeros(1)

    def __call__(self, x, u, t):
        return move(self.m, x, u)


PLANTS = [
    Documented(), NothingButSizes(), Unbounded(), ClassArrays(), OneSided(),
    OfNumbers((-1.0, 1.0), 1.0), OfNumbersAfter(), OfNumbersAfter(control_bounds=None),
    ByProperty(), ByInit(),
]  # fmt: skip
IDS = [f"{type(plant).__name__}-{i}" for i, plant in enumerate(PLANTS)]


def limits(plant):
    """The bounds that the class above states."""
    if isinstance(plant, OneSided):
        return -np.inf, 1.0
    free = isinstance(plant, NothingButSizes | Unbounded) or plant.control_bounds is None
    return None if free else (-1.0, 1.0)


def problem_of(plant, m, dt=0.1):
    """A swing of 0.8 s by a plant of mass m, so hard that bounds of 1 bind."""
    plant = eqx.tree_at(lambda plant: plant.m, plant, m)
    return jc.Problem(plant, jc.QuadraticCost(R=0.1, Qf=30.0), num_steps=8, dt=dt)


def of_function(m, strength):
    return jc.FunctionPlant(
        lambda x, u, t, m: move(m, x, u),
        nx=2,
        nu=1,
        params=m,
        control_bounds=(-strength, strength),
    )


X0 = np.array([1.0, 0.3])
TWO = jnp.array([1.0, 1.4]), jnp.array([1.0, 0.9])


def slopes(make, solver):
    """Return a function of masses and strengths: solutions and slopes of the cost by both."""

    def cost(m, strength):
        plant = make(m, strength)
        problem = jc.Problem(plant, jc.QuadraticCost(R=0.1, Qf=30.0), num_steps=8, dt=0.1)
        solution = jc.solve(problem, solver, X0)
        return solution.cost, solution

    return jax.jit(jax.vmap(jax.value_and_grad(cost, argnums=(0, 1), has_aux=True)))


@pytest.mark.parametrize("solver", [jc.ILQR(), jc.DDP()], ids=["ILQR", "DDP"])
@pytest.mark.parametrize("plant", PLANTS, ids=IDS)
def test_every_spelling_goes_through_the_solvers(plant, solver):
    """In a batch, compiled, with gradients; traced alone, as that is where spellings failed."""
    traced = jax.eval_shape(slopes(lambda m, _: eqx.tree_at(lambda p: p.m, plant, m), solver), *TWO)
    assert traced[0][1].us.shape == (2, 8, 1)


@pytest.mark.parametrize("solver", [jc.ILQR(), jc.DDP()], ids=["ILQR", "DDP"])
def test_bounds_that_are_a_property_are_kept_and_have_gradients(solver):
    (_, got), got_slopes = slopes(ByProperty, solver)(*TWO)
    (_, want), wanted_slopes = slopes(of_function, solver)(*TWO)
    assert got.status.ok.all() and jnp.array_equal(jnp.abs(got.us).max(axis=(1, 2)), TWO[1])
    np.testing.assert_allclose(got.us, want.us, rtol=1e-12)
    np.testing.assert_allclose(got_slopes, wanted_slopes, rtol=1e-12)
    assert (jnp.abs(jnp.array(got_slopes)) > 0.1).all()


def test_the_documented_plant_is_solved_without_jit():
    plant = Documented()
    solution = jc.solve(problem_of(plant, plant.m), jc.ILQR(), X0)
    assert solution.status.ok and jnp.max(jnp.abs(solution.us)) == 1


@pytest.mark.parametrize("plant", PLANTS, ids=IDS)
def test_bounds_nominal_control_and_kind_are_those_of_the_class(plant):
    problem, bounds = problem_of(plant, jnp.array(1.0)), limits(plant)
    assert plant.discrete is False
    np.testing.assert_array_equal(problem.nominal_controls, np.zeros((8, 1)))
    if bounds is None:
        assert problem.bounds is None
    else:
        for got, want in zip(problem.bounds, bounds, strict=True):
            np.testing.assert_array_equal(got, np.full((8, 1), want))


def test_a_plant_of_float32_is_solved_in_float32_though_its_class_says_python_numbers():
    for plant in (Documented(), NothingButSizes()):
        problem = problem_of(plant, jnp.float32(1.0), dt=jnp.float32(0.1))
        cost = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), problem.cost)
        problem = eqx.tree_at(lambda p: p.cost, problem, cost)
        solution = jax.eval_shape(lambda p: jc.solve(p, jc.ILQR(), X0.astype(np.float32)), problem)
        assert solution.us.dtype == jnp.float32


def test_integers_of_numpy_are_integers():
    jc.Problem(spoilt(nx=np.int64(2)), jc.QuadraticCost(), num_steps=3)


def spoilt(**attributes):
    return type("Spoilt", (Documented,), attributes)()


def test_what_does_not_fit_is_refused_by_its_name_and_with_a_hint():
    class TracedSize(jc.AbstractPlant):
        nx: int = 2
        nu: ClassVar[int] = 1

        def __call__(self, x, u, t):
            return x

    for plant, error, match in (
        (TracedSize(), TypeError, r"TracedSize\.nx: got a field .* `nx: ClassVar"),
        (spoilt(nu=0), ValueError, r"Spoilt\.nu: an integer of at least 1 is wanted, got 0"),
        (spoilt(nx=2.0), ValueError, r"Spoilt\.nx: an integer of at least 1 is wanted, got 2\.0"),
        (spoilt(nx=True), ValueError, r"Spoilt\.nx: an integer"),
        (spoilt(discrete="no"), TypeError, r"Spoilt\.discrete: True or False is wanted"),
        (spoilt(control_bounds=1.0), ValueError, r"Spoilt\.control_bounds: a pair"),
        (spoilt(control_bounds=(0.0, [1.0, 2.0])), ValueError, r"the upper bound has shape \(2,\)"),
        (spoilt(control_bounds=(1.0, -1.0)), ValueError, "lower <= upper is wanted"),
        (spoilt(control_bounds=lambda self: None), TypeError, "got a method; @property"),
        (spoilt(nominal_control=np.zeros(2)), ValueError, r"nominal_control: shape \(2,\)"),
        (spoilt(nominal_control="zero"), TypeError, r"nominal_control: numbers are wanted"),
    ):
        with pytest.raises(error, match=match):
            jc.Problem(plant, jc.QuadraticCost(), num_steps=3)
