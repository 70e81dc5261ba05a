"""Checks of what a solve is given: finite numbers, and functions that return what they should."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._checks import is_concrete
from ._function import describe
from ._noise import diffusion
from ._problem import Problem
from ._sensor import reading, reading_noise
from ._terms import At


def check_finite(problem: Problem) -> None:
    """Raise ValueError naming the first concrete parameter that is not finite; bounds may be."""
    names = ("plant", "cost", "noise", "sensor")
    parts = {name: getattr(problem, name) for name in names}
    for path, leaf in jax.tree_util.tree_leaves_with_path(parts):
        name = parts_name(path)
        if not eqx.is_inexact_array(leaf) or not is_concrete(leaf) or "control_bounds" in name:
            continue
        if not np.isfinite(np.asarray(leaf)).all():
            raise ValueError(f"problem: {name} is not finite: {leaf}")


def parts_name(path) -> str:
    """Write a pytree path as `plant.m2`."""
    return jax.tree_util.keystr(path).replace("['", "").replace("']", "")


def check_functions(problem: Problem, x0: Array, us: Array) -> None:
    """Trace the plant and the cost once; their own exceptions pass, with a line of help."""
    for k, (name, _, (shape, wanted)) in enumerate(_calls(problem, x0, us[0])):
        out = _traced(problem, k, x0, us[0])
        got = getattr(out, "shape", None)
        if got is None:
            raise TypeError(
                f"{name}: returned a {type(out).__name__}, wanted one array {wanted}; jnp.array "
                "or jnp.stack makes it one"
            )
        if (got != shape) if shape is not None else len(got) != 1:
            raise ValueError(f"{name}: returned {got}, wanted {wanted}")
        if out.dtype != x0.dtype:
            raise TypeError(
                f"{name}: returned {out.dtype} from {x0.dtype} arguments; write constants as "
                "Python numbers, or give the arrays it uses to it as `params`"
            )


def _calls(problem: Problem, x: Array, u: Array) -> tuple[tuple[str, Callable, Any], ...]:
    """Return what a solve calls: names, functions without arguments, the shapes they return."""
    plant, t, terms = problem.plant, problem.ts[0], problem.terms
    scalar, i = ((), "()"), jnp.array(0)
    at = At(x, u, None, t, i, problem.dt, t)
    dynamics = problem.step if plant.discrete else plant
    return (
        ("plant", lambda: dynamics(x, u, t), (x.shape, f"({plant.nx},)")),
        *(
            ("noise", lambda noise=noise: _flat(diffusion(noise, plant, x, u, t)), (None, "(m,)"))
            for noise in (problem.noise,)
            if noise is not None
        ),
        *(
            call
            for sensor in (problem.sensor,)
            if sensor is not None
            for call in (
                ("sensor", lambda sensor=sensor: reading(sensor, plant, x, t), (None, "(ny,)")),
                (
                    "sensor",
                    lambda sensor=sensor: _flat(reading_noise(sensor, plant, x, t)),
                    (None, "(m,)"),
                ),
            )
        ),
        *((name, lambda rate=rate: rate(plant, at), scalar) for rate, name in terms.rates),
        *(
            (name, lambda rho=rho: rho(plant, at._replace(after=x)), (None, "(m,)"))
            for rho, name in terms.residuals
        ),
        *((name, lambda end=end: end(plant, x), scalar) for end, name in terms.ends),
        *(
            (name, lambda event=event: event(plant, x, i), scalar)
            for _, event, name in terms.events
        ),
    )


def _flat(F: Array) -> Array:
    return F.reshape(-1)


def _traced(problem: Problem, k: int, x: Array, u: Array) -> Any:
    """Return the shape of what the k-th of `_calls` returns.

    Raises TypeError when it uses a traced value that is no leaf of the problem: nothing would ask
    for the derivative with respect to it, which would come out as zero.
    """
    arrays, static = eqx.partition(problem, eqx.is_array)
    name = _calls(problem, x, u)[k][0]

    def function(arrays, x, u):
        return _calls(eqx.combine(arrays, static), x, u)[k][1]()

    try:
        jaxpr, out = jax.make_jaxpr(function, return_shape=True)(arrays, x, u)
    except Exception as error:
        error.add_note(f"raised while {name} was traced, with x {x.shape}, u {u.shape}")
        error.add_note(_advice(error))
        raise
    for const in jaxpr.consts:
        if not is_concrete(const):
            parts = {"plant": problem.plant, "noise": problem.noise, "sensor": problem.sensor}
            owner = parts.get(name, problem.cost)
            raise TypeError(
                f"{name}: {describe(owner)} uses a traced value, {jax.typeof(const)}, in a way "
                "that cannot be seen from outside, so that its derivative would be lost; make it "
                "a field of the class, or hand it to the function as `params=`"
            )
    return out


def _advice(error: Exception) -> str:
    """Say what usually mends an error in a user's function."""
    if isinstance(error, jax.errors.TracerArrayConversionError):
        return (
            "use jnp in the place of np: jnp.sin(x), jnp.linalg.norm(x); only what is a NumPy "
            "array from the start may go through NumPy"
        )
    if isinstance(error, jax.errors.TracerBoolConversionError):
        return "use jnp.where or jax.lax.cond where it depends on values of x, u or t"
    if isinstance(error, jax.errors.ConcretizationTypeError):
        return (
            "use jnp.sin(x) in the place of math.sin(x) or float(x), and jnp.where or jax.lax.cond "
            "where it depends on values; a JAX array that it closes over and whose value it needs "
            "may be a NumPy array or a Python number"
        )
    return (
        "it is called as dynamics(x, u, t), running(x, u, t), terminal(x) or event(x, i), with "
        "`params` as a last argument when these are given; the methods of a cost as rate(plant, "
        "at), residual(plant, at), end(plant, x), event(plant, x, j)"
    )
