"""How long a movement takes that must be accurate: three laws, fitted and compared."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from .. import _samples

_WIDTH_IN_SD = 4.133  # sqrt(2 pi e)


def index_of_difficulty(amplitude: Any, width: Any) -> np.ndarray:
    """Compute the index of difficulty of an aimed movement.

    ID = log2(2 A / W)                                    (Fitts 1954; Li 2006, eq. 3.24)

    Arguments:
        amplitude: distance A [m] from start to centre of the target, any shape (...).
        width: width W [m] of the target along the movement, of a shape that broadcasts with it.
    Returns: ID [bit], (...).
    Raises: ValueError for numbers that are not finite or not above 0, or shapes that do not fit.
    """
    return np.log2(2 * _ratio(amplitude, width))


def effective_width(points: Any, direction: Any) -> np.ndarray:
    """Compute the width of the target that endpoints scatter over.

    W_e = 4.133 SD along the movement: 4.133 = sqrt(2 pi e) standard deviations, between whose
    ends 96 % of a normal distribution lie (Welford 1968; ISO 9241-9).

    Arguments:
        points: endpoints [m], (..., n, 2), n at least 2.
        direction: of the movement, (2,), of any length but 0.
    Returns: W_e [m], (...,), from the SD with divisor n - 1.
    Raises: ValueError for a wrong shape, a single point, numbers that are not finite, or a
        direction of length 0.
    """
    points = _samples.all_finite("points", _samples.path("points", points, 2))
    direction = _samples.shaped("direction", direction, (2,), "(2,)")
    length = np.linalg.norm(_samples.all_finite("direction", direction))
    if length == 0:
        raise ValueError("direction: a length above 0 is wanted, got 0")
    return _WIDTH_IN_SD * (points @ (direction / length)).std(axis=-1, ddof=1)


@dataclass(frozen=True)
class SpeedAccuracyLaw:
    """One law of movement time T, fitted.

    Fields:
        name: `logarithmic`, `linear` or `power`.
        formula: T with a and b, as text.
        a, b: its parameters; a [s], and b [s/bit], [s] or a pure number in this order of names.
        r_squared: share of the variance of T that the fit explains.
        cross_validated_error: RMS error [s] for conditions left out of the fit.
    """

    name: str
    formula: str
    a: float
    b: float
    r_squared: float
    cross_validated_error: float

    def predict(self, amplitude: Any, width: Any) -> np.ndarray:
        """Return T [s], (...), for amplitudes and widths [m], (...)."""
        return _LAWS[self.name].time(_ratio(amplitude, width), self.a, self.b)


@dataclass(frozen=True)
class SpeedAccuracyFits:
    """The laws fitted to the same movements, the lowest cross-validated error first.

    Printed, it is a table. `fits["power"]` is the law of that name.
    """

    laws: tuple[SpeedAccuracyLaw, ...]

    @property
    def best(self) -> SpeedAccuracyLaw:
        """The law with the lowest cross-validated error."""
        return self.laws[0]

    def __getitem__(self, name: str) -> SpeedAccuracyLaw:
        for law in self.laws:
            if law.name == name:
                return law
        raise KeyError(f"{name}: one of {', '.join(law.name for law in self.laws)} is wanted")

    def __str__(self) -> str:
        head = f"{'law':<12} {'T':<18} {'a':>9} {'b':>9} {'R^2':>7} {'error left out [s]':>19}"
        rows = [
            f"{law.name:<12} {law.formula:<18} {law.a:>9.4g} {law.b:>9.4g} {law.r_squared:>7.4f} "
            f"{law.cross_validated_error:>19.4g}"
            for law in self.laws
        ]
        return "\n".join([head, *rows])


@dataclass(frozen=True)
class _Law:
    formula: str
    time: Callable[[np.ndarray, float, float], np.ndarray]
    fit: Callable[[np.ndarray, np.ndarray], np.ndarray]


def _line(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return intercept and slope (2,) of the least-squares line."""
    return np.linalg.lstsq(np.stack([np.ones_like(x), x], axis=1), y, rcond=None)[0]


def _fit_power(ratio: np.ndarray, duration: np.ndarray) -> np.ndarray:
    """Return a and b (2,) that minimise sum (T - a ratio^b)^2, from the line through logarithms."""
    log_ratio = np.log(ratio)
    log_a, b = _line(log_ratio, np.log(duration))
    fit = least_squares(
        lambda p: np.exp(p[0] + p[1] * log_ratio) - duration, [log_a, b], xtol=1e-12, ftol=1e-12
    )
    return np.array([np.exp(fit.x[0]), fit.x[1]])


_LAWS = {
    "logarithmic": _Law(
        "a + b log2(2A/W)",
        lambda ratio, a, b: a + b * np.log2(2 * ratio),
        lambda ratio, duration: _line(np.log2(2 * ratio), duration),
    ),
    "linear": _Law("a + b A/W", lambda ratio, a, b: a + b * ratio, _line),
    "power": _Law("a (A/W)^b", lambda ratio, a, b: a * ratio**b, _fit_power),
}


def _ratio(amplitude: Any, width: Any) -> np.ndarray:
    amplitude = _samples.positive("amplitude", amplitude, "(...)")
    width = _samples.positive("width", width, "(...)")
    try:
        return amplitude / width
    except ValueError:
        raise ValueError(
            f"width: shape {width.shape} given, wanted one that broadcasts with `amplitude` "
            f"{amplitude.shape}"
        ) from None


def fit_speed_accuracy(amplitude: Any, width: Any, duration: Any) -> SpeedAccuracyFits:
    """Fit three laws of movement time and compare them on conditions they have not seen.

    logarithmic: T = a + b log2(2 A / W)    (Fitts 1954; Li 2006, eq. 3.24)
    linear:      T = a + b A / W            (Schmidt et al. 1979)
    power:       T = a (A / W)^b

    Schmidt et al. found endpoints to scatter in proportion to mean speed, W_e = b A / T, hence
    T = b A / W_e. It is fitted with an intercept here, as Fitts' law is: each law then has two
    parameters, and none wins by having more. All three minimise the squared error of T itself.

    Cross-validation leaves out all movements of one ratio A / W at a time: every law here predicts
    one time for all of them, so that a repetition kept in the fit would give the answer away.

    Arguments:
        amplitude: A [m], (n,). width: W [m], (n,) or (); `effective_width` may be better.
        duration: T [s], (n,): one value for each movement or the mean of each condition.
    Returns: `SpeedAccuracyFits`, sorted by cross-validated error.
    Raises: ValueError for shapes that do not fit, numbers that are not finite or not above 0, or
        fewer than 4 different ratios A / W.
    """
    duration = _samples.positive("duration", duration, "(n,)")
    ratio = _ratio(amplitude, width)
    if ratio.ndim != 1 or duration.shape != ratio.shape:
        raise ValueError(
            f"duration: shape {duration.shape} given for `amplitude` / `width` of shape "
            f"{ratio.shape}, wanted (n,) for both"
        )
    _, condition = np.unique(np.round(np.log(ratio), 9), return_inverse=True)
    if condition.max() < 3:
        raise ValueError(
            f"amplitude: at least 4 different ratios to `width` are wanted, got "
            f"{condition.max() + 1}"
        )
    laws = [_fitted(name, ratio, duration, condition) for name in _LAWS]
    return SpeedAccuracyFits(tuple(sorted(laws, key=lambda law: law.cross_validated_error)))


def _fitted(
    name: str, ratio: np.ndarray, duration: np.ndarray, condition: np.ndarray
) -> SpeedAccuracyLaw:
    law = _LAWS[name]
    a, b = law.fit(ratio, duration)
    residuals = duration - law.time(ratio, a, b)
    spread = ((duration - duration.mean()) ** 2).sum()
    unseen = np.empty_like(duration)
    for left_out in range(condition.max() + 1):
        out = condition == left_out
        unseen[out] = law.time(ratio[out], *law.fit(ratio[~out], duration[~out]))
    error = np.sqrt(((duration - unseen) ** 2).mean())
    r_squared = 1 - (residuals**2).sum() / spread if spread > 0 else np.nan
    return SpeedAccuracyLaw(name, law.formula, float(a), float(b), float(r_squared), float(error))
