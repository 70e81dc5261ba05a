"""Pontryagin's boundary-value problem by collocation: SciPy's Newton method on meshes of our own.

Each round, `scipy.integrate.solve_bvp` solves the collocation equations (Lobatto IIIA, fourth
order; Ascher, Mattheij & Russell 1995) on a fixed mesh; the mesh is then refined where the residual
is too large, in the norm of BVP4C (Kierzenka & Shampine 2001): over each mesh interval, the root of
the integral of |r/(1 + |dy/ds|)|^2 over s = t/T. SciPy's own norm is that of the mean, which never
falls where the right-hand side jumps, as it does when a muscle's excitation crosses its activation.

States and costates are in units of their largest values along the present solution, computed anew
in each round: costates may be 1e-5 at the solution and 1 at the start, and residuals are judged
beside 1.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from scipy.integrate import solve_bvp

from .._jit import jit
from .._status import Reason
from ._hamiltonian import Hamiltonian

MAX_ROUNDS = 60
FEWEST = 64
"""The fewest nodes that are evaluated together; more are padded to a power of two."""
SHARE = 0.5
"""The share of the tolerance within which Newton's method is to solve the equations of a mesh."""
DIVERGED = 10.0
"""How many tolerances off Newton's method may end, without progress, on a mesh to be refined."""
DRIFT = 2.0
"""The factor by which a unit may have changed in the last round."""
SMALLEST_UNIT = 1e-6
"""The smallest unit of a state (costate) beside the largest one."""
FINEST = 1e-12
"""The shortest mesh interval, of the duration."""


class Path(NamedTuple):
    """States and costates ys (m, 2 nx) at the nodes s (m,) of a mesh from 0 to 1, s = t/T.

    `at` interpolates between them: it takes s (n,) and returns (n, 2 nx).
    """

    s: np.ndarray
    ys: np.ndarray
    at: Callable[[np.ndarray], np.ndarray]

    def sampled(self, s: np.ndarray) -> "Path":
        """Return the same path with other nodes."""
        return Path(s, self.at(s), self.at)


class Collocated(NamedTuple):
    """A path, why its computation ended, `RUNNING` for success, and how many rounds it took."""

    path: Path
    reason: Reason
    rounds: int


def collocate(
    hamiltonian: Hamiltonian, x0: np.ndarray, path: Path, tol: float, max_nodes: int
) -> Collocated:
    """Solve the boundary-value problem from a first guess, refining its mesh.

    Arguments:
        hamiltonian: whose canonical equations to solve.
        x0: the state at the start, (nx,).
        path: the first guess.
        tol: of the residual in each mesh interval, and of the boundary conditions.
        max_nodes: limit of the mesh.

    Returns: `Collocated`, with `RUNNING` when it is solved to the tolerance; else
    `BVP_MAX_NODES`, `BVP_SINGULAR` or `BVP_DIVERGED`.
    """
    last = np.inf
    for count in range(1, MAX_ROUNDS + 1):
        system = _System(hamiltonian, x0, _units(path.ys))
        with np.errstate(all="ignore"):
            found = solve_bvp(
                system.rates, system.ends, path.s, system.scaled(path.ys),
                fun_jac=system.rates_jacobian, bc_jac=system.ends_jacobian,
                tol=tol, bc_tol=tol, max_nodes=len(path.s),
            )  # fmt: skip
            errors, off = _residuals(system, found)
        if not (np.isfinite(found.y).all() and np.isfinite(errors).all() and np.isfinite(off)):
            return Collocated(path, Reason.BVP_DIVERGED, count)
        if found.status == 2:
            return Collocated(path, Reason.BVP_SINGULAR, count)
        path = Path(path.s, system.unscaled(found.y), system.unscaled_spline(found.sol))
        drift = np.max(np.abs(np.log(_units(path.ys) / system.units)))
        if max(errors.max(), off) <= tol:
            if drift <= np.log(DRIFT):
                return Collocated(path, Reason.RUNNING, count)
            continue
        if SHARE * tol < off <= 0.5 * last:
            last = off
            continue
        if off > DIVERGED * tol:
            return Collocated(path, Reason.BVP_DIVERGED, count)
        last = np.inf
        s = _refined(path.s, errors, tol)
        if len(s) > max_nodes or np.diff(s).min() < FINEST:
            return Collocated(path, Reason.BVP_MAX_NODES, count)
        path = path.sampled(s)
    return Collocated(path, Reason.BVP_DIVERGED, MAX_ROUNDS)


def controls(hamiltonian: Hamiltonian, s: np.ndarray, ys: np.ndarray) -> tuple:
    """Return the minimisers of H, (n, nu), at s (n,) and ys (n, 2 nx), and whether they are."""
    return _padded(_minimisers, hamiltonian, s, ys)


class _System:
    """The boundary-value problem in scaled variables, as SciPy wants it: time comes last."""

    def __init__(self, hamiltonian: Hamiltonian, x0: np.ndarray, units: np.ndarray):
        self.hamiltonian, self.x0, self.units = hamiltonian, x0, units
        self.duration = float(hamiltonian.problem.duration)
        self.nx = len(x0)

    def scaled(self, ys):
        return (ys / self.units).T

    def unscaled(self, z):
        return z.T * self.units

    def unscaled_spline(self, spline):
        return lambda s: self.unscaled(spline(s))

    def rates(self, s, z):
        rates = _padded(_rates, self.hamiltonian, s, self.unscaled(z))
        return self.duration * self.scaled(rates)

    def rates_jacobian(self, s, z):
        slopes = _padded(_rate_slopes, self.hamiltonian, s, self.unscaled(z))
        return np.moveaxis(self.duration * slopes * self.units / self.units[:, None], 0, 2)

    def ends(self, first, last):
        """Return x(0) - x0 and p(T) - dh/dx(x(T)), scaled, (2 nx,)."""
        nx, units = self.nx, self.units
        slope, _ = self._final(last)
        return np.concatenate([first[:nx] - self.x0 / units[:nx], last[nx:] - slope / units[nx:]])

    def ends_jacobian(self, first, last):
        nx, units = self.nx, self.units
        _, curvature = self._final(last)
        by_first, by_last = np.zeros((2, 2 * nx, 2 * nx))
        by_first[:nx, :nx] = by_last[nx:, nx:] = np.eye(nx)
        by_last[nx:, :nx] = -curvature * units[:nx] / units[nx:, None]
        return by_first, by_last

    def _final(self, last):
        x = np.asarray(last[: self.nx] * self.units[: self.nx], _dtype(self.hamiltonian))
        return (np.asarray(part, float) for part in _final_terms(self.hamiltonian, x))


def _residuals(system: _System, found) -> tuple[np.ndarray, float]:
    """Return the residual of each interval, and by how much the equations themselves are off."""
    h = np.diff(found.x)
    middle = found.x[:-1] + 0.5 * h
    rates = system.rates(middle, found.sol(middle))
    gap = np.linalg.norm((found.sol(middle, 1) - rates) / (1 + np.abs(rates)), axis=0)
    ends = np.abs(system.ends(found.y[:, 0], found.y[:, -1]))
    return np.sqrt(h) * found.rms_residuals, max((np.sqrt(h) * gap).max(), ends.max())


def _refined(s: np.ndarray, errors: np.ndarray, tol: float) -> np.ndarray:
    """Halve the intervals whose residual is too large, or cut them in three if a hundred times."""
    h = np.diff(s)
    halved, cut = (errors > tol) & (errors < 100 * tol), errors >= 100 * tol
    start, h3 = s[:-1], h / 3
    new = (start[halved] + h[halved] / 2, start[cut] + h3[cut], start[cut] + 2 * h3[cut])
    return np.sort(np.concatenate([s, *new]))


def _units(ys: np.ndarray) -> np.ndarray:
    """Return the largest value of each state and costate, none far below that of its kind."""
    units = np.abs(ys).max(axis=0)
    for kind in np.split(units, 2):
        np.maximum(kind, SMALLEST_UNIT * kind.max(), out=kind)
    return np.where(units > 0, units, 1.0)


def _dtype(hamiltonian: Hamiltonian):
    return hamiltonian.problem.dt.dtype


def _padded(function, hamiltonian: Hamiltonian, s: np.ndarray, ys: np.ndarray):
    """Evaluate at s (n,), ys (n, 2 nx), padded so that few sizes are compiled; in double."""
    n, dtype = len(s), _dtype(hamiltonian)
    index = np.minimum(np.arange(max(FEWEST, 1 << (n - 1).bit_length())), n - 1)
    t = s * float(hamiltonian.problem.duration)
    out = function(hamiltonian, t[index].astype(dtype), ys[index].astype(dtype))

    def take(array):
        array = np.asarray(array)[:n]
        return array if array.dtype == bool else array.astype(float)

    return jax.tree.map(take, out)


@jit
def _rates(hamiltonian: Hamiltonian, ts, ys):
    return jax.vmap(hamiltonian.rates)(ts, ys)


@jit
def _rate_slopes(hamiltonian: Hamiltonian, ts, ys):
    return jax.vmap(jax.jacfwd(hamiltonian.rates, argnums=1))(ts, ys)


@jit
def _minimisers(hamiltonian: Hamiltonian, ts, ys):
    nx = ys.shape[1] // 2
    return jax.vmap(hamiltonian.minimiser)(ys[:, :nx], ys[:, nx:], ts)


@jit
def _final_terms(hamiltonian: Hamiltonian, x):
    return hamiltonian.final_slope(x), jax.jacfwd(hamiltonian.final_slope)(x)
