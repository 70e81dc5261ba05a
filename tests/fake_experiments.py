"""Small experiments for the tests; as a script, the command line with these instead of the real.

python fake_experiments.py run all --out results
"""

import ctypes
import os
import resource
import sys
import time
import types
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Config:
    seed: int = 0
    gain: float = 0.5
    label: str = "reach"
    noisy: bool = True

    def __post_init__(self):
        if self.gain < 0:
            raise ValueError("gain must not be negative")

    @classmethod
    def quick(cls):
        return cls(seed=1)


def result(config, size=5, failure=""):
    import xarray

    from jaxctrl.experiments._result import Result

    values = np.random.default_rng(config.seed).normal(size=(size, 2))
    values[0] = np.nan
    data = xarray.Dataset(
        {"hand": (("time", "axis"), values, {"units": "m", "long_name": "position of the hand"})},
        {
            "time": ("time", 0.01 * np.arange(size), {"units": "s", "long_name": "time"}),
            "axis": ("axis", ["x", "y"], {"long_name": "axis in space"}),
        },
    )
    return Result(data, config, failure)


def figure(result):
    from matplotlib.figure import Figure

    return Figure(figsize=(1, 1))


def claims(result):
    from jaxctrl.experiments._result import Claim

    return [
        Claim("the path is straight", "fig. 1", "< 1 m", "0.2 m", True),
        Claim("the hand\nstops", "eq. 2", "0 m/s", "0.1 m/s", np.bool_(False), "θ drifts"),
    ]


def wait_in_c(config):
    """Block where no Python signal handler runs, as a long XLA computation does."""
    ctypes.CDLL(None).sleep(60)
    return result(config)


def wait_once(config):
    """Wait to be killed the first time, finish the second time."""
    if os.environ.get("FAKE_WAIT"):
        time.sleep(60)
    return result(config)


def wait_while_saving(result):
    """Return a figure that waits to be killed while it is written."""
    drawn = figure(result)
    if os.environ.get("FAKE_WAIT"):

        def savefig(*_, **__):
            print("saving", file=sys.stderr, flush=True)
            time.sleep(60)

        drawn.savefig = savefig
    return drawn


def need_application_settings(config):
    """Fail unless the command line has prepared JAX and matplotlib."""
    import jax
    import matplotlib

    ready = jax.config.jax_enable_x64 and matplotlib.get_backend().lower() == "agg"
    return result(config, failure="" if ready else "not in float64 with Agg")


def raise_error(config):
    raise RuntimeError("the arm fell off\nand more")


def fake(run=result, figure=figure, claims=claims):
    return types.SimpleNamespace(Config=Config, run=run, figure=figure, claims=claims)


FAKES = {
    "good": fake(),
    "last": fake(),
    "waits": fake(wait_once),
    "saves": fake(figure=wait_while_saving),
    "stuck": fake(wait_in_c),
    "precise": fake(need_application_settings),
    "raises": fake(raise_error),
    "fails": fake(lambda config: result(config, failure="ILQR stopped at its maximum of steps")),
    "large": fake(lambda config: result(config, size=200_000)),
}


def install(names, registry, modules):
    """Put these fakes where the real experiments are.

    Arguments:
        registry: `jaxctrl.experiments.EXPERIMENTS`.
        modules: `sys.modules`.
    """
    registry.clear()
    for name in names:
        registry[name] = (f"fake_{name}", f"What {name} does")
        modules[f"fake_{name}"] = FAKES[name]


def main():
    from jaxctrl import cli, experiments

    install(os.environ["FAKE_NAMES"].split(), experiments.EXPERIMENTS, sys.modules)
    if "FAKE_LIMIT" in os.environ:  # a disk that is full after so many bytes of one file
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(os.environ["FAKE_LIMIT"]),) * 2)
    cli.main()


if __name__ == "__main__":
    main()
