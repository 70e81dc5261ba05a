"""The history of a solver: padded lanes, whole iterations, the right scale."""

import numpy as np
import pytest

from jaxctrl import plot


def padded(length, size=40, rate=0.5, floor=0.0):
    values = np.full(size, np.nan)
    values[:length] = floor + np.exp(-rate * np.arange(length))
    return values


def test_padded_lanes_are_drawn_as_given_over_iterations_from_zero():
    costs = np.stack([padded(12), padded(30)])
    figure = plot.convergence(costs, gradient=costs**2, labels=["iLQR", "DDP"])
    for ax, values in zip(figure.axes, (costs, costs**2), strict=True):
        for line, lane in zip(ax.lines, values, strict=True):
            np.testing.assert_array_equal(line.get_xdata(), np.arange(40))
            np.testing.assert_array_equal(line.get_ydata(), lane)
        assert ax.get_yscale() == "log"
    assert figure.axes[-1].get_xlabel() == "iteration"
    assert figure.axes[-1].get_xlim()[1] < 31


@pytest.mark.parametrize("length", [1, 2, 3, 12, 40])
def test_the_iteration_axis_has_whole_numbers_only(length):
    figure = plot.convergence(padded(length))
    figure.draw_without_rendering()
    ticks = figure.axes[0].get_xticks()
    np.testing.assert_array_equal(ticks, np.round(ticks))


def test_the_scale_is_logarithmic_where_that_can_be_read():
    def scale(values):
        return plot.convergence(values).axes[0].get_yscale()

    assert scale(padded(30)) == "log"
    assert scale(padded(30) - 0.5) == "linear"
    assert scale(padded(30, floor=1.0)) == "linear"
    assert scale(np.zeros(5)) == "linear"


def test_an_exact_zero_is_seen_on_a_logarithmic_scale():
    values = padded(30)
    values[10:20] = 0.0
    figure = plot.convergence(padded(30), lam=values)
    ax = figure.axes[1]
    figure.draw_without_rendering()
    assert ax.get_ylim()[0] < 0.0 and ax.get_ylabel() == "λ [–]"
    heights = ax.transData.transform([(0, value) for value in (0.0, np.nanmin(values[values > 0]))])
    assert heights[1, 1] - heights[0, 1] > 5


def test_of_many_lanes_the_one_of_lowest_last_cost_stands_out():
    costs = np.stack([padded(20 + i % 7, floor=0.1 + abs(i - 41)) for i in range(100)])
    costs[3] = np.nan
    ax = plot.convergence(costs).axes[0]
    (best,) = [line for line in ax.lines if line.get_label() == "lowest cost"]
    np.testing.assert_array_equal(best.get_ydata(), costs[41])
    assert [text.get_text() for text in ax.get_legend().texts] == ["99 others", "lowest cost"]


def test_a_trace_of_another_shape_than_the_cost_is_refused():
    with pytest.raises(ValueError, match=r"step: shape \(39,\) given, wanted \(40,\)"):
        plot.convergence(padded(9), step=np.ones(39))
    with pytest.raises(ValueError, match="lam: no finite sample"):
        plot.convergence(padded(9), lam=np.full(40, np.nan))
    with pytest.raises(ValueError, match="labels: 1 given, wanted 2"):
        plot.convergence(np.ones((2, 5)), labels=["a"])
