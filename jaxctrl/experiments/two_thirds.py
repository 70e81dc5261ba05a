"""The two-thirds power law on closed paths that are traced optimally, with the timing left free.

Speed and radius of curvature obey v = c r^(1/3) (Lacquaniti, Terzuolo & Viviani 1983; Li 2006, eq.
3.25-3.26). A reference that runs round an ellipse harmonically has the law built in, and one of
constant speed has its absence built in: here the path is given in space alone, and the optimum
chooses when to be where, under the least energy of the torque arm and of the six muscles, or the
least jerk of a hand without an arm. Beside them: constant-speed references, the same paths at a
uniform phase, and smoothed noise, all through the same estimator. Paths, weights and durations are
our choice.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import xarray

import jaxctrl as jc

from . import _closed_paths as shapes
from ._free_timing import ClosedPath, OnPath, PathCost, StepOnPath
from ._planned import check_active_state
from ._result import Result, named
from ._two_thirds_claims import claims as claims
from ._two_thirds_figure import MODELS, figure as figure, law_of

WAYS = {
    "torque": ((1.0,),),
    "muscle": ((1 / 3, 1.0), (0.03, 0.1, 1 / 3, 1.0)),
    "jerk": ((1.0,),),
}
"""Ways to a path's optimum: shares of the path weight, each traced from the solution before. With
muscles one way or the other may end with an arm that whirls; the cheaper end is kept."""

REFERENCE_WEIGHTS = (0.1, 1.0, 10.0, 100.0)


@dataclass(frozen=True)
class Config:
    """Settings: duration [s], steps, and how many ellipses and scribbles, each how often traced.

    `path_weight` [1/(m^2 s)] keeps the hand on the path, `effort` and `jerk` weigh what movement
    costs; `trim` is the fraction of each record that is left out at either end; `tightest` the
    largest curvature of a scribble [1/m]; `fastest` bounds the rate of the phase, as a multiple of
    its mean; `null_seeds` counts the scribbles of noise; `active_state` is the muscles', "linear",
    "brown" or "brown-fixed".
    """

    duration: float = 3.0
    num_steps: int = 240
    ellipses: int = 8
    ellipse_turns: int = 3
    scribbles: int = 8
    scribble_turns: int = 2
    harmonics: int = 3
    tightest: float = 300.0
    path_weight: float = 30.0
    effort: float = 1e-4
    jerk: float = 1e-7
    fastest: float = 5.0
    trim: float = 1 / 6
    null_seeds: int = 100
    active_state: str = "linear"

    def __post_init__(self):
        check_active_state(self.active_state)

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with fewer, shorter and coarser records."""
        return cls(
            duration=2.0,
            num_steps=80,
            ellipses=2,
            ellipse_turns=2,
            scribbles=1,
            scribble_turns=1,
            trim=0.25,
            null_seeds=20,
        )


def _body(model: str, config: Config) -> tuple[jc.AbstractHand, jc.OfInner, jc.AbstractIntegrator]:
    """Return the plant of a model, what it costs to move it, and how it is integrated."""
    if model == "jerk":
        cost = jc.models.PolynomialJerkCost(config.jerk, 0.0)  # pyright: ignore[reportCallIssue]
        return jc.plants.FreeHand(), jc.OfInner(cost), jc.plants.PolynomialJerk()  # pyright: ignore[reportCallIssue]
    arm = jc.plants.TorqueArm()
    if model == "muscle":
        arm = jc.plants.MuscleArm(active_state=config.active_state)  # pyright: ignore[reportArgumentType]
    cost = jc.tasks.Effort(config.effort)  # pyright: ignore[reportCallIssue]
    return arm, jc.OfInner(cost), jc.RK4()  # pyright: ignore[reportCallIssue]


def _start(body: jc.AbstractHand, hand):
    """Return the state (nx,) of a body whose hand rests at a position (2,)."""
    if isinstance(body, jc.plants.FreeHand):
        return body.at_rest(hand)
    assert isinstance(body, jc.plants.TorqueArm | jc.plants.MuscleArm)
    return body.at_rest(*body.inverse_kinematics(hand))


def _trace(model: str, waves, turns, config: Config) -> dict[str, np.ndarray]:
    """Trace every path (n, harmonics, 2, 2) with its timing free; arrays lead with the path."""
    body, moving, rule = _body(model, config)
    dt = config.duration / config.num_steps

    def problem(wave, turns, weight):
        path, mean = (
            ClosedPath(jnp.array(shapes.CENTRE), wave),
            2 * jnp.pi * turns / config.duration,
        )
        plant = OnPath(body, path, turns=turns, rate=mean, fastest=config.fastest * mean)
        cost = PathCost(weight) + moving  # pyright: ignore[reportCallIssue]
        step = StepOnPath(rule)
        return jc.Problem(plant, cost, num_steps=config.num_steps, dt=dt, integrator=step)

    starts = [jnp.append(_start(body, shapes.curve(wave, np.zeros(1))[0]), 0.0) for wave in waves]
    starts, ends = jnp.stack(starts), []
    for way in WAYS[model]:
        controls = None
        for share in way:
            weights = jnp.full(len(waves), share * config.path_weight)
            problems = jax.vmap(problem)(waves, turns, weights)
            solved = jc.solve_batch(problems, jc.ILQR(), starts, controls, max_steps=1000)
            controls = solved.us
        ends.append(solved)
    solved = _cheapest(ends)
    one = jax.tree.map(lambda leaf: leaf[0], problems).plant
    phase = np.asarray(solved.xs[..., -1])
    hand = np.asarray(jax.vmap(jax.vmap(one.hand))(solved.xs))
    velocity = np.asarray(jax.vmap(jax.vmap(one.hand_velocity))(solved.xs))
    wanted = np.array([shapes.curve(w, s) for w, s in zip(waves, phase, strict=True)])
    mean = 2 * np.pi * turns / config.duration
    return {
        "hand": hand,
        "velocity": velocity,
        "phase": phase,
        "miss": np.linalg.norm(hand - wanted, axis=-1),
        "rate": np.asarray(solved.us[..., -1]) / mean[:, None],
        "converged": np.asarray(solved.status.ok),
    }


def _cheapest(ends: list[jc.Solution]) -> jc.Solution:
    """Return, lane by lane, the cheapest of several batches; what did not converge costs most."""
    costs = jnp.stack([jnp.where(end.status.ok, end.cost, jnp.inf) for end in ends])
    chosen, lane = jnp.argmin(costs, axis=0), jnp.arange(costs.shape[1])
    return jax.tree.map(lambda *leaves: jnp.stack(leaves)[chosen, lane], *ends)


def _follow(waves, turns, config: Config) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Track constant-speed references with the torque arm; arrays lead with weight and path."""
    arm, dt = jc.plants.TorqueArm(), config.duration / config.num_steps
    points = np.array(
        [
            shapes.at_constant_speed(w, n, config.num_steps)
            for w, n in zip(waves, turns, strict=True)
        ]
    )

    def problem(points, weight):
        task = jc.tasks.track(
            arm,
            points,
            config.duration,
            num_steps=config.num_steps,
            path_weight=weight,
            effort=config.effort,
        )
        return jc.Problem(arm, task.cost, num_steps=config.num_steps, dt=dt, integrator=jc.RK4())

    weights = np.repeat(REFERENCE_WEIGHTS, len(waves))
    repeated = np.tile(points, (len(REFERENCE_WEIGHTS), 1, 1))
    problems = jax.vmap(problem)(jnp.array(repeated), jnp.array(weights))
    starts = jnp.stack([_start(arm, path[0]) for path in repeated])
    solved = jc.solve_batch(problems, jc.ILQR(), starts)
    hand = np.asarray(jax.vmap(jax.vmap(arm.hand))(solved.xs))
    velocity = np.asarray(jax.vmap(jax.vmap(arm.hand_velocity))(solved.xs))
    shape = (len(REFERENCE_WEIGHTS), *points.shape)
    return hand.reshape(shape), velocity.reshape(shape), np.asarray(solved.status.ok)


def run(config: Config) -> Result:
    """Trace all paths with all models; arrays lead with the model and the path."""
    names, waves = shapes.ellipses(config.ellipses, config.harmonics)
    more, random = shapes.scribbles(config.scribbles, config.harmonics, config.tightest)
    names, waves = names + more, np.concatenate([waves, random])
    turns = np.repeat(
        [float(config.ellipse_turns), float(config.scribble_turns)],
        [config.ellipses, config.scribbles],
    )
    ts = np.linspace(0, config.duration, config.num_steps + 1)
    traced = [_trace(model, waves, turns, config) for model in MODELS]
    at, following, followed = _follow(waves, turns, config)
    found = {name: np.stack([part[name] for part in traced]) for name in traced[0]}
    failed = [
        f"{model}, {name}: the solve did not converge"
        for model, oks in zip(MODELS, found["converged"], strict=True)
        for name, ok in zip(names, oks, strict=True)
        if not ok
    ]
    failed += ["a constant-speed reference: the solve did not converge"] * (not followed.all())
    mean = 2 * np.pi * turns / config.duration
    phases = [rate * ts for rate in mean]
    uniform = np.array([shapes.curve(w, s) for w, s in zip(waves, phases, strict=True)])
    pace = np.array(
        [r * shapes.curve(w, s, 1) for w, s, r in zip(waves, phases, mean, strict=True)]
    )
    laws = [
        [law_of(h, v, ts, config.trim) for h, v in zip(hand, velocity, strict=True)]
        for hand, velocity in zip(found["hand"], found["velocity"], strict=True)
    ]
    null = jc.analysis.power_law_null(
        config.duration,
        config.num_steps / config.duration,
        6 / config.duration,
        extent=shapes.EXTENT,
        trim=config.trim,
        num_seeds=config.null_seeds,
    )
    controls = {
        "uniform": [
            law_of(h, v, ts, config.trim).exponent for h, v in zip(uniform, pace, strict=True)
        ],
        "reference": [
            [law_of(h, v, ts, config.trim).exponent for h, v in zip(*pair, strict=True)]
            for pair in zip(at, following, strict=True)
        ],
        "null": null.exponents,
    }
    data = _dataset(config, names, ts, found, laws, controls)
    data["path"] = (("curve", "sample", "axis"), _outlines(waves), named("path", "m"))
    return Result(data, config, "; ".join(failed))


def _outlines(waves: np.ndarray) -> np.ndarray:
    return np.array([shapes.curve(wave, np.linspace(0, 2 * np.pi, 401)) for wave in waves])


def _dataset(config: Config, names, ts, found, laws, controls) -> xarray.Dataset:
    """Label the records, what the estimator found in each, and the controls."""
    each, record = ("model", "curve"), ("model", "curve", "time")
    return xarray.Dataset(
        {
            "hand": ((*record, "axis"), found["hand"], named("hand position", "m")),
            "velocity": ((*record, "axis"), found["velocity"], named("hand velocity", "m/s")),
            "phase": (record, found["phase"], named("phase along the path", "rad")),
            "miss": (record, found["miss"], named("distance of the hand from the path", "m")),
            "rate": (
                ("model", "curve", "step"),
                found["rate"],
                named("rate of the phase, as a multiple of its mean", "1"),
            ),
            "exponent": (
                each,
                np.array([[law.exponent for law in row] for row in laws]),
                named("exponent of the radius of curvature", "1"),
            ),
            "r_squared": (
                each,
                np.array([[law.r_squared for law in row] for row in laws]),
                named("share of the variance explained", "1"),
            ),
            "uniform": (
                "curve",
                np.array(controls["uniform"]),
                named("exponent of the path at a uniform phase", "1"),
            ),
            "reference": (
                ("weight", "curve"),
                np.array(controls["reference"]),
                named("exponent of the torque arm that tracks a constant speed", "1"),
            ),
            "null": ("seed", controls["null"], named("exponent of smoothed noise", "1")),
        },
        coords={
            "model": ("model", list(MODELS), {"long_name": "model"}),
            "curve": ("curve", names, {"long_name": "path"}),
            "time": ("time", ts, named("time", "s")),
            "axis": ("axis", ["x", "y"], {"long_name": "axis"}),
            "weight": ("weight", list(REFERENCE_WEIGHTS), named("path weight", "1/(m^2 s)")),
        },
    )
