"""SciPy's L-BFGS-B with gradients by JAX: what most people would try first."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

import jaxctrl as jc
from jaxctrl.stopwatch import repeated, take

from .programs import Program

LIMIT = 5000
RULE = 1e-6
"""It is told to stop so near, relatively, to the cost where it ends when it is not: our rule."""


def minimised(problem: jc.Problem, x0: Any, start: Any) -> Program:
    """Return L-BFGS-B, jitted cost and gradient together, the cost scaled to 1 at the start.

    A first run with no tolerance finds where it ends; the timed ones stop 1e-6 above that.
    """
    shape = np.shape(start)
    u0 = np.ravel(np.asarray(start, float))

    @jax.jit
    @jax.value_and_grad
    def cost(flat):
        return jc.simulate(problem, jc.OpenLoop(flat.reshape(shape)), x0).cost

    scale = 1.0

    def function(flat):
        value, slope = cost(jnp.asarray(flat))
        return float(value) * scale, np.asarray(slope, float) * scale

    first = take(repeated(lambda: function(u0))).wall
    scale = 1 / max(abs(function(u0)[0]), 1e-30)
    bounds = None
    if problem.bounds is not None:
        lower, upper = (np.broadcast_to(np.asarray(b), shape).ravel() for b in problem.bounds)
        bounds = list(zip(lower, upper, strict=True))
    options = {"maxiter": LIMIT, "maxfun": 2 * LIMIT, "ftol": 0.0, "gtol": 0.0, "maxcor": 20}
    end = minimize(function, u0, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    last: list[Any] = []

    def stop(intermediate_result):
        if intermediate_result.fun <= end.fun + RULE * abs(end.fun):
            raise StopIteration

    def call() -> None:
        last[:] = [
            minimize(
                function, u0, jac=True, method="L-BFGS-B", bounds=bounds, options=options,
                callback=stop,
            )
        ]  # fmt: skip

    def found() -> tuple[np.ndarray, dict[str, Any]]:
        return last[0].x.reshape(shape), {"iterations": int(last[0].nit)}

    return Program("SciPy L-BFGS-B (JAX gradient)", call, found, {"first_s": first})
