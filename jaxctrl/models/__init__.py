"""Theories of what movements optimise, each applied to a task that is stated once.

models = [jc.models.MinimumEnergy(), jc.models.MinimumTorqueChange(), jc.models.MinimumJerk()]
comparison = jc.compare(models, task, x0)
print(comparison)
comparison.figure().savefig("models.pdf")
"""

from ._closed_form import (
    Path as Path,
    jerk_cost as jerk_cost,
    minimum_jerk as minimum_jerk,
    passing_times as passing_times,
)
from ._compare import Comparison as Comparison
from ._costs import (
    Balance as Balance,
    HandJerk as HandJerk,
    PolynomialJerkCost as PolynomialJerkCost,
    TorqueChange as TorqueChange,
)
from ._models import (
    AbstractModel as AbstractModel,
    MinimumEnergy as MinimumEnergy,
    MinimumJerk as MinimumJerk,
    MinimumTorqueChange as MinimumTorqueChange,
    WeightedSum as WeightedSum,
)
from ._times import OptimalTimes as OptimalTimes
