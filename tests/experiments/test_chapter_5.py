"""The parts of the experiments of chapter 5, one by one."""

import numpy as np
import xarray
from numpy.testing import assert_allclose

import jaxctrl as jc
from jaxctrl.experiments import Result, _chapter_5 as shared, fig_5_7, fig_5_8, named


def test_a_cosine_is_found_again_and_two_lobes_are_not_explained():
    angles = shared.angles(16)
    means = np.stack([0.2 + 0.1 * np.cos(angles - 1.0), np.cos(2 * angles)], axis=1)
    towards, explained = fig_5_7._tuning(angles, means[None])
    assert_allclose(towards[0, 0], 1.0)
    assert_allclose(explained[0], [1.0, 0.0], atol=1e-12)


def test_directions_are_apart_by_at_most_half_a_turn():
    assert fig_5_7._apart(350.0, 10.0) == 20.0
    assert fig_5_7._apart(0.0, 180.0) == 180.0
    assert fig_5_7._apart(90.0, 315.0) == 135.0


def costs(difference, error):
    """Make a result of two directions with given differences of costs, A - C and C - B."""
    both, count = ("controller", "direction"), 2
    values = {
        "cost": (both, np.ones((3, count)), named("cost", "1")),
        "end_cov": ((*both, "axis", "other"), np.ones((3, count, 2, 2)), named("cov", "m^2")),
        "difference": (("pair", "direction"), np.array(difference), named("difference", "1")),
        "difference_error": (("pair", "direction"), np.array(error), named("error", "1")),
    }
    coords = shared.Reaches(directions=count, num_steps=2).coordinates("other") | {
        "controller": ("controller", ["A", "B", "C"], {"long_name": "controller"}),
        "pair": ("pair", ["A - C", "C - B"], {"long_name": "pair"}),
    }
    return Result(xarray.Dataset(values, coords=coords), fig_5_8.Config())


def test_orders_of_costs_are_judged_by_intervals():
    judged = fig_5_8.claims(costs([[3.0, 2.0], [3.0, 0.1]], np.ones((2, 2))))
    assert [claim.holds for claim in judged] == [True, True, True, False]
    assert "too few" in judged[3].note and "nearest at 180 degrees" in judged[3].measured
    judged = fig_5_8.claims(costs([[3.0, -3.0], [-3.0, -4.0]], np.ones((2, 2))))
    assert [claim.holds for claim in judged] == [False] * 4
    assert "too few" in judged[0].note
    assert all("other way round" in claim.note for claim in judged[1:])


def test_two_peaks_are_no_bell():
    time = np.linspace(0, 1, 101)
    speed = np.stack([np.sin(np.pi * time), np.sin(2 * np.pi * time) ** 2])
    data = xarray.Dataset({"speed": (("direction", "time"), speed)}, coords={"time": time})
    claim = shared.bells(data, "nowhere", "two bumps")
    assert not claim.holds and claim.note == "two bumps"
    assert "1 of 2" in claim.measured
    assert shared.bells(data.isel(direction=[0]), "nowhere").holds


def test_ellipses_have_the_axes_of_the_covariance():
    figure = jc.plot.panels()[0]
    ax = figure.axes[0]
    shared.draw_ellipse(ax, np.zeros(2), np.diag([1e-6, 4e-6]), 10.0)
    (ellipse,) = ax.patches
    half = 1000 * np.sqrt(-2 * np.log(0.05)) * np.array([2e-3, 1e-3])  # [cm], ten times too large
    assert_allclose([ellipse.width, ellipse.height], 2 * half)
    assert_allclose(abs(ellipse.angle), 90.0)
    assert_allclose(shared.spread(np.diag([1e-6, 4e-6])), np.sqrt(5e-6))
