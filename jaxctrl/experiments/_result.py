"""What an experiment returns: labelled arrays, and what a publication claims about them."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # so that `jaxctrl --help` imports nothing heavy
    import xarray


@dataclass(frozen=True, eq=False)
class Result:
    """Hold the arrays of one experiment, with names and units, and the settings that gave them.

    Arguments:
        data: every variable and coordinate has the attribute `long_name`, and every numeric one
            `units` ("1" for a pure number). Device arrays become NumPy arrays.
        config: the `Config` of the experiment that was run.
        failure: why the result cannot be trusted, such as the message of a solver that has not
            converged; empty when all is well. The files are written all the same, and the
            command line reports the experiment as failed.

    Raises: ValueError naming a variable that lacks its name or its units.
    """

    data: "xarray.Dataset"
    config: Any
    failure: str = ""

    def __post_init__(self):
        object.__setattr__(self, "data", self.data.as_numpy())
        for name, variable in self.data.variables.items():
            wanted = ["long_name"] + ["units"] * (variable.dtype.kind in "biufc")
            for attribute in wanted:
                if not variable.attrs.get(attribute):
                    raise ValueError(f"variable {name!r} of the result has no {attribute!r}")


@dataclass(frozen=True)
class Claim:
    """Hold what a publication states, what was measured, and whether the statement holds.

    A claim that does not hold is shown as such: it is a finding and no error.

    Arguments:
        statement: the claim in one sentence.
        source: where it is made, such as a figure, table or equation.
        expected: the published value, with its unit.
        measured: the value found here, with its unit.
        holds: whether the two agree; an array's truth value becomes a bool.
        note: why it does not hold, or with what reservation it does.
    """

    statement: str
    source: str
    expected: str
    measured: str
    holds: bool
    note: str = ""

    def __post_init__(self):
        # NaN, which is true to Python, holds nothing.
        object.__setattr__(self, "holds", bool(self.holds) and bool(self.holds == self.holds))


def named(long_name: str, units: str) -> dict[str, str]:
    """Return the attributes that every variable of a `Result` has: its name in words and its units.

    xarray.Variable("time", ts, named("time", "s"))
    """
    return {"long_name": long_name, "units": units}
