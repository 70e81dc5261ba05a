"""Figure 5.6 of Li (2006): methods compared on manipulators with one link, two, and more.

`Chain(n)`: n equal thin rods in the plane, 0.63 m and 2.4 kg together. The thesis states neither
the links nor the movement: here all joints turn alike, by 0.6 rad together, in 0.5 s, for the cost
(4.20) with the stopping term and a price on the joint rates on the way, without which light outer
links crack like whips, and no method comes to an end. DDP is the textbook's: ours would take ILQR's
own steps. The friction is 0.05 N m s/rad for two links and falls as 1/n^3, as the links' inertia:
held at 0.05, six links are stiffer than a step of 10 ms of explicit Euler allows.

ILQG minimises the expected cost under motor noise, the others the cost without noise. So each is
timed to within 1 % of the best of its own cost: the first time when its iterate is there. Times are
warm medians of processor time on one core, in turns.
"""

from dataclasses import dataclass
from functools import partial

import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

import jaxctrl as jc

from ._chapter_4 import Case, timed
from ._result import Claim, Result, named

METHODS = {
    "ILQR": jc.ILQR,
    "ILQG": jc.ILQG,
    "DDP": partial(jc.DDP, start="exact"),
    "CG": jc.ConjugateGradient,
}
OURS = ("ILQR", "ILQG")
FROM, TO = 1.2, 1.8
"""The sum of the joint angles at the start and at the end [rad]."""
DURATION = 0.5
NEAR = 1e-2
"""How far above the best cost a method may be when its time is taken, relatively."""


@dataclass(frozen=True)
class Config:
    """Settings: most links, motor noise [s^(1/2)], price of the joint rates [s/rad^2], time steps,
    limit of iterations, and repetitions of each timing.

    The noise is weaker than elsewhere: at 0.02 s^(1/2) six links, whose torques counteract each
    other, are hardly moved at all.
    """

    links: int = 6
    motor_noise: float = 0.005
    rate_weight: float = 1e-2
    num_steps: int = 50
    max_steps: int = 500
    repeats: int = 9

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with two links at most."""
        return cls(links=2, max_steps=50, repeats=2)


def case_of(links: int, config: Config, noisy: bool) -> Case:
    """Return the movement of a chain."""
    chain = jc.plants.Chain(links)
    task = jc.tasks.posture(
        chain, jnp.full(links, TO / links), DURATION, num_steps=config.num_steps,
        motor_noise=config.motor_noise if noisy else None,
    )  # fmt: skip
    rates = jnp.concatenate([jnp.zeros(links), jnp.full(links, config.rate_weight)])
    return Case(task + jc.QuadraticCost(Q=rates, R=0.0), chain.at_rest(FROM / links))


def run(config: Config) -> Result:
    """Time every method on every chain; arrays lead with the method and the number of links."""
    links = np.arange(1, config.links + 1)
    columns = [_compare(int(n), config) for n in links]
    seconds, near, iterations, cost = (
        np.stack(values, axis=1) for values in zip(*columns, strict=True)
    )
    dims = ("solver", "links")
    missing = {"missing": "NaN where the method never comes within 1 % of the best cost"}
    data = xarray.Dataset(
        {
            "seconds": (
                (*dims, "turn"),
                seconds,
                named("warm processor time to within 1 % of the best cost", "s") | missing,
            ),
            "near": (dims, near, named("iterations to there", "1") | missing),
            "iterations": (dims, iterations, named("iterations until the method stops", "1")),
            "cost": (dims, cost, named("last cost, for ILQG the expected one", "1")),
        },
        coords={
            "solver": ("solver", list(METHODS), {"long_name": "solver"}),
            "links": ("links", links, named("number of links", "1")),
        },
    )
    return Result(data, config)


def _compare(links: int, config: Config) -> tuple[np.ndarray, ...]:
    """Return of each method the times (solver, turn), iterations to there and to the end, cost."""
    runs, ends, counts = [], [], []
    for name, method in METHODS.items():
        case = case_of(links, config, noisy=name == "ILQG")
        to = timed(case, method())
        us = jnp.asarray(case.problem.nominal_controls)
        runs.append(partial(to, us))
        cost, count = to(us, config.max_steps, 1)
        ends.append(float(cost))
        counts.append(int(count))
    best = min(cost for name, cost in zip(METHODS, ends, strict=True) if name != "ILQG")
    near = [
        _first_near(to, count, end if name == "ILQG" else best)
        for name, to, count, end in zip(METHODS, runs, counts, ends, strict=True)
    ]
    there = [i for i, count in enumerate(near) if np.isfinite(count)]
    calls = [partial(runs[i], int(near[i])) for i in there]
    seconds = np.full((len(METHODS), config.repeats), np.nan)
    seconds[there] = jc.stopwatch.in_turns(calls, config.repeats).cpu.T
    return seconds, np.array(near), np.array(counts), np.array(ends)


def _first_near(to, count: int, best: float) -> float:
    """Return the first iterate, of `count`, within 1 % of the best cost, NaN if none is."""

    def there(i: int) -> bool:
        return float(to(i, 1)[0]) <= best * (1 + NEAR)

    if not there(count):
        return np.nan
    low, high = -1, count  # costs fall, so that halving finds it
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if there(middle) else (middle, high)
    return float(high)


def figure(result: Result) -> Figure:
    """Draw times, iterations and costs against the number of links."""
    data = result.data
    fig, axes = jc.plot.panels(1, 3, size=(7.2, 3.0))
    seconds = 1e3 * data.seconds.median("turn").values
    with jc.plot.style():
        for i, (name, marker) in enumerate(zip(data.solver.values, "osvx", strict=True)):
            look = {
                "color": f"C{i}", "marker": marker, "markersize": 4, "label": name,
                "linestyle": ("-", "--", ":", "-.")[i],
            }  # fmt: skip
            for ax, values in zip(
                axes[0], (seconds[i], data.near.values[i], data.cost.values[i]), strict=True
            ):
                ax.semilogy(data.links.values, values, **look)
        for ax, title, label in zip(
            axes[0],
            ("A  time", "B  iterations", "C  last cost"),
            ("time to within 1 % [ms]", "iterations to within 1 %", "cost (ILQG: expected) [1]"),
            strict=True,
        ):
            ax.set_title(title, loc="left")
            ax.set_xlabel("links")
            ax.set_ylabel(label)
            ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return fig


def claims(result: Result) -> list[Claim]:
    """Compare the growth of times, and costs."""
    data = result.data
    rivals = [name for name in METHODS if name not in OURS]
    found = [_slower(data, mine, rival) for mine in OURS for rival in rivals]
    ilqr, ddp = (data.cost.sel(solver=name).values for name in ("ILQR", "DDP"))
    apart = np.abs(ilqr / ddp - 1).max()
    found.append(
        Claim(
            "ILQR and DDP end at one cost, whatever the number of links",
            "the same problem has both",
            f"within {NEAR:g}",
            f"at most {apart:.2g} apart; iterations of ILQR "
            f"{_list(data.iterations.sel(solver='ILQR').values)}, of DDP "
            f"{_list(data.iterations.sel(solver='DDP').values)}",
            apart <= NEAR,
            "" if apart <= NEAR else "They end in different local optima.",
        )
    )
    return found


def _slower(data: xarray.Dataset, mine: str, rival: str) -> Claim:
    """Compare by what factor two methods' times grow from the fewest links to the most."""
    median = data.seconds.median("turn")
    own, other = (median.sel(solver=name).values for name in (mine, rival))
    growth, others = own[-1] / own[0], other[-1] / other[0]
    lost = not np.isfinite(others)
    holds = bool(np.isfinite(growth) and (lost or growth <= others))
    return Claim(
        f"The time of {mine} grows more slowly with the number of links than that of {rival}",
        "Li (2006), fig. 5.6",
        "slower",
        f"from {data.links.values[0]} to {data.links.values[-1]} links {_factor(growth)}, "
        f"{rival} {_factor(others)}; {mine} {_list(1e3 * own)} ms in "
        f"{_list(data.near.sel(solver=mine).values)} iterations, {rival} {_list(1e3 * other)} ms "
        f"in {_list(data.near.sel(solver=rival).values)}",
        holds,
        "" if holds else "Here it does not: see the iterations.",
    )


def _factor(growth: float) -> str:
    return f"{growth:.3g} times as long" if np.isfinite(growth) else "never within 1 %"


def _list(values: np.ndarray) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
