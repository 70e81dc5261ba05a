"""Variability over trials: ellipses of endpoints, and the uncontrolled manifold."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from .. import _samples


@dataclass(frozen=True, eq=False)
class Ellipse:
    """An ellipse around points in the plane.

    Fields:
        centre: mean of the points [m], (2,).
        half_axes: longer and shorter half axis [m], (2,).
        angle: direction of the longer one [rad], from +x counter-clockwise, in (-pi/2, pi/2].
        area: [m^2].
        covariance: of the points [m^2], (2, 2), with divisor n - 1.
    """

    centre: np.ndarray
    half_axes: np.ndarray
    angle: float
    area: float
    covariance: np.ndarray


def endpoint_ellipse(points: Any, *, coverage: float = 0.95) -> Ellipse:
    """Draw the ellipse that holds a fraction of normally distributed points.

    (p - centre)' C^-1 (p - centre) = q,    q the chi-square quantile with 2 degrees of freedom

    C is taken as known: of few points the ellipse holds less than `coverage` of new ones.

    Arguments:
        points: endpoints [m], (n, 2), n at least 3.
        coverage: the fraction, above 0 and below 1.
    Returns: `Ellipse`; its half axes are the roots of q times the eigenvalues of C.
    Raises: ValueError for a wrong shape, fewer than 3 points, one that is not finite, or a
        coverage outside (0, 1).
    """
    points = _samples.shaped("points", points, (None, 2), "(n, 2)")
    _samples.all_finite("points", points)
    if len(points) < 3:
        raise ValueError(f"points: at least 3 are wanted, got {len(points)}")
    if not 0 < coverage < 1:
        raise ValueError(f"coverage: a fraction above 0 and below 1 is wanted, got {coverage}")
    covariance = np.cov(points, rowvar=False)
    variances, axes = np.linalg.eigh(covariance)
    half_axes = np.sqrt(chi2.ppf(coverage, 2) * np.maximum(variances[::-1], 0.0))
    x, y = axes[:, 1] * (-1 if axes[0, 1] < 0 or (axes[0, 1] == 0 and axes[1, 1] < 0) else 1)
    area = float(np.pi * half_axes.prod())
    return Ellipse(points.mean(axis=0), half_axes, float(np.arctan2(y, x)), area, covariance)


@dataclass(frozen=True, eq=False)
class UncontrolledManifold:
    """Variance over trials along redundant and along task directions.

    Fields, each a scalar () or one value for each instant (N,):
        redundant: variance per degree of freedom that leaves the task variable as it is.
        task: variance per degree of freedom that changes it. Both in the unit of the samples
            squared, such as rad^2.
        ratio: redundant / task; above 1 where variability is kept out of the task. Infinite where
            the task does not vary, NaN where nothing does.
    """

    redundant: np.ndarray
    task: np.ndarray
    ratio: np.ndarray


def uncontrolled_manifold(samples: Any, jacobian: Any) -> UncontrolledManifold:
    """Split the variance over trials into what the task feels and what it does not.

    V_red  = sum_i |P d_i|^2 / ((n - m) (trials - 1)),    d_i = x_i - mean x
    V_task = sum_i |(1 - P) d_i|^2 / (m (trials - 1)),    P the projection on the null space of J

    after Scholz & Schöner (1999), who divide by the number of trials: the ratio is the same. It
    depends on the units of the samples: give all n of them in one unit, such as joint angles.

    Arguments:
        samples: x, (trials, n), or (trials, N, n) for N instants.
        jacobian: J = d task / d x at the mean posture, (m, n), or (N, m, n) for N instants.
    Returns: `UncontrolledManifold`. Variances at the round-off of the samples count as zero.
    Raises: ValueError for shapes that do not fit, fewer than 2 trials, m >= n, numbers that are
        not finite, or a Jacobian of rank below m.
    """
    samples = _samples.numbers("samples", samples, "(trials, n) or (trials, N, n)")
    if samples.ndim not in (2, 3) or not samples.size:
        raise ValueError(
            f"samples: shape {samples.shape} given, wanted (trials, n) or (trials, N, n)"
        )
    if len(samples) < 2:
        raise ValueError(f"samples: at least 2 trials are wanted, got {len(samples)}")
    _samples.all_finite("samples", samples)
    n = samples.shape[-1]
    wanted = ("m", n) if samples.ndim == 2 else (samples.shape[1], "m", n)
    tangent = _task_basis(jacobian, wanted)
    m = tangent.shape[-2]
    centred = samples - samples.mean(axis=0)
    felt = np.einsum("...mn,t...n->t...m", tangent, centred)
    unfelt = centred - np.einsum("...mn,t...m->t...n", tangent, felt)
    round_off = (8 * n * np.finfo(float).eps * np.abs(samples).max()) ** 2

    def variance(parts: np.ndarray, freedom: int) -> np.ndarray:
        value = (parts**2).sum(axis=(0, -1)) / (freedom * (len(samples) - 1))
        return np.where(value > round_off, value, 0.0)

    redundant, task = variance(unfelt, n - m), variance(felt, m)
    with np.errstate(divide="ignore", invalid="ignore"):
        return UncontrolledManifold(redundant, task, redundant / task)


def _task_basis(jacobian: Any, wanted: tuple[str | int, ...]) -> np.ndarray:
    """Return an orthonormal basis of the row space of J, of its shape (..., m, n)."""
    shape = f"({', '.join(map(str, wanted))})"
    jacobian = _samples.numbers("jacobian", jacobian, shape)
    fits = jacobian.ndim == len(wanted) and jacobian.size and all(
        want in ("m", size) for size, want in zip(jacobian.shape, wanted, strict=True)
    )  # fmt: skip
    if not fits:
        raise ValueError(f"jacobian: shape {jacobian.shape} given, wanted {shape}")
    m, n = jacobian.shape[-2:]
    if m >= n:
        raise ValueError(f"jacobian: fewer rows than columns are wanted, got {m} of {n} columns")
    _samples.all_finite("jacobian", jacobian)
    _, gains, basis = np.linalg.svd(jacobian, full_matrices=False)
    if (gains[..., -1] <= gains[..., 0] * n * np.finfo(float).eps).any():
        raise ValueError(f"jacobian: rank {m} is wanted, got a lower one")
    return basis
