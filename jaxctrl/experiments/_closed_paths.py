"""Ellipses and scribbles for the hand to trace, as Fourier series, and their plain timings."""

import numpy as np

CENTRE = (0.0, 0.4)
"""Where all paths lie: in front of the shoulder [m]."""

ASPECTS = (0.35, 0.5, 0.65, 0.8)
"""Ratios of the half axes of the ellipses."""

HALF_AXES = (0.08, 0.05)
"""Longer half axes [m]: the first for one round of aspects, the second for the next."""

EXTENT = 0.05
"""RMS distance [m] of a scribble from its centre, were it traced at a uniform phase."""


def ellipses(count: int, harmonics: int) -> tuple[list[str], np.ndarray]:
    """Return names and coefficients (count, harmonics, 2, 2) of ellipses in all directions."""
    found, labels = np.zeros((count, harmonics, 2, 2)), []
    for i in range(count):
        turn, which = divmod(i, len(ASPECTS))
        half, aspect = HALF_AXES[turn % len(HALF_AXES)], ASPECTS[which]
        tilt = np.pi / 4 * ((which + 2 * turn) % 4)
        axis = half * np.array([np.cos(tilt), np.sin(tilt)])
        found[i, 0] = axis, aspect * np.array([-axis[1], axis[0]])
        labels.append(f"ellipse {100 * half:.0f} x {100 * half * aspect:.1f} cm")
    return labels, found


def scribbles(count: int, harmonics: int, tightest: float) -> tuple[list[str], np.ndarray]:
    """Return names and coefficients (count, harmonics, 2, 2) of random closed curves.

    Coefficients are normal, with standard deviations that fall as k^-1.5. Of the seeds 0, 1, ...
    those are taken whose curve bends nowhere more than `tightest` [1/m].
    """
    found, labels, seed = [], [], 0
    k = np.arange(1, harmonics + 1)[:, None, None]
    while len(found) < count:
        wave = np.random.default_rng(seed).standard_normal((harmonics, 2, 2)) * k**-1.5
        wave *= EXTENT / np.sqrt(0.5 * (wave**2).sum())
        if sharpest(wave) < tightest:
            found.append(wave)
            labels.append(f"scribble {seed}")
        seed += 1
    return labels, np.array(found).reshape(-1, harmonics, 2, 2)


def curve(wave: np.ndarray, phase: np.ndarray, order: int = 0) -> np.ndarray:
    """Return a path (n, 2) [m] at phases (n,) [rad], or its derivative of an order by the phase."""
    k = np.arange(1, len(wave) + 1)
    angles = np.multiply.outer(phase, k) + order * np.pi / 2
    terms = np.stack([np.cos(angles), np.sin(angles)], axis=-1) * (k[:, None] ** order)
    return np.einsum("nkc,kca->na", terms, wave) + (np.array(CENTRE) if order == 0 else 0.0)


def sharpest(wave: np.ndarray) -> float:
    """Return the largest curvature [1/m] of a path."""
    phase = np.linspace(0, 2 * np.pi, 2000)
    v, a = curve(wave, phase, 1), curve(wave, phase, 2)
    turn = v[:, 0] * a[:, 1] - v[:, 1] * a[:, 0]
    return float(np.abs(turn / np.linalg.norm(v, axis=1) ** 3).max())


def at_constant_speed(wave: np.ndarray, turns: float, num_steps: int) -> np.ndarray:
    """Return positions (num_steps + 1, 2) [m] of a path traced a number of times at one speed."""
    phase = np.linspace(0, 2 * np.pi * turns, 2000 * max(1, round(turns)))
    steps = np.linalg.norm(np.diff(curve(wave, phase), axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    return curve(wave, np.interp(np.linspace(0, length[-1], num_steps + 1), length, phase))
