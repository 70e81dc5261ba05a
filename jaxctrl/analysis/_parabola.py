"""Where a sampled curve turns, between its samples."""

import numpy as np


def vertex(ts: np.ndarray, values: np.ndarray, index: int) -> tuple[float, float]:
    """Return time and height of the vertex of the parabola through three samples.

    The three are (index - 1, index, index + 1); times (N,) need not be evenly spaced. The sample
    itself comes back at either end of the record, where the three lie on a line, and where the
    sample is not the highest or lowest of the three.
    """
    here = float(ts[index]), float(values[index])
    if not 0 < index < len(ts) - 1:
        return here
    before, after = ts[index] - ts[index - 1], ts[index + 1] - ts[index]
    rise = (values[index] - values[index - 1]) / before
    fall = (values[index + 1] - values[index]) / after
    if rise * fall > 0 or rise == fall:
        return here
    bend = (fall - rise) / (before + after)
    slope = (rise * after + fall * before) / (before + after)
    return float(here[0] - slope / (2 * bend)), float(here[1] - slope**2 / (4 * bend))
