"""The same descents with gradients that are made smoother in one way or another.

Every descent begins at one of the same random places and searches nowhere else. What a choice finds
is judged as it is, and after the usual descent from there (exact, at the end without outliers).
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import measure
import numpy as np
from estimators import SAME
from jaxtyping import Array
from matplotlib.figure import Figure
from roughness_tools import POINTS, Damped, kept, losses_at, normal_at, picture, table, unknown_of
from roughness_windows import restarted

from r2s import scenarios
from r2s.estimation import gauss_newton
from r2s.estimation.descent import CLOSE, INITIAL_DAMPING, Budget, descend
from r2s.estimation.gauss_newton import GROWTH, MARGIN, Descent, Normal
from r2s.estimation.problem import Problem, beginning, window
from r2s.fabrics import presets
from r2s.fabrics.parameters import OrthotropicSpace
from r2s.scenarios import synthetic

STARTS, ITERATIONS = 6, 12
FABRICS = ("grey_interlock",)
NUM_FRAMES, MOVING = 30, 1.2  # of a lift, and for how long the gripper moves [s]
SETTLED = 22  # the frame from which the sheet hangs still
WIDTHS = (0.02, 0.1)  # of secants, of the range
MORE = 5.0  # times the damping
FIRST = 0.25  # share of the frames
SEEN = 1e-3  # [m]: error of an observed vertex
BATCH, SPREAD = 8, 0.03  # places over which a gradient is averaged, and their deviation [range]


Gradient = Callable[[Problem, Array], Normal]  # at an unknown


class Choice(NamedTuple):
    """A problem in place of the given one, and how the gradient in it is taken."""

    problem: Callable[[Problem], Problem]
    gradient: Gradient


def main(out: Path, small: bool) -> None:
    """All choices."""
    rows = []
    for fabric in FABRICS:
        rows += compared(out, fabric, 1 if small else STARTS, 1 if small else None)
    table(out / "choices.csv", f"descents from {STARTS} random starts, lift of 2 s", rows)
    picture(drawn(rows), out / "choices.png")


def choices(fabric: str) -> dict[str, Choice]:
    """By name."""
    same = lambda p: p
    truth = presets.FIVE[fabric]()
    return {
        "exact slopes": Choice(same, exact),
        f"secants, {WIDTHS[0]:g} of the range": Choice(same, secants(WIDTHS[0])),
        f"first {FIRST:.0%} of the frames": Choice(lambda p: beginning(p, FIRST), exact),
        "settled frames only": Choice(lambda p: window(p, SETTLED, 99), exact),
        f"{MORE:g} times the damping": Choice(more_damped, exact),
        f"mean of {BATCH} places": Choice(same, mean),
        f"secants, {WIDTHS[1]:g} of the range": Choice(same, secants(WIDTHS[1])),
        "5 x 5 vertices": Choice(lambda p: problem_of(fabric, (5, 5)), exact),
        "windows from true states": Choice(lambda p: restarted(p, truth), exact),
        f"windows, states seen to {1e3 * SEEN:g} mm": Choice(
            lambda p: restarted(p, truth, SEEN), exact
        ),
    }


def problem_of(fabric: str, shape: tuple[int, int] = (9, 9)) -> Problem:
    """A short lift of a preset, on a mesh of some vertices; recorded on 9 x 9."""
    experiment = scenarios.lifting(num_frames=NUM_FRAMES, moving=MOVING)
    truth = presets.FIVE[fabric]()
    recording = synthetic.record(experiment, truth, fabric, key=jax.random.key(0))
    space = Damped.make(OrthotropicSpace.make(float(truth.density)), 1.0)
    return Problem.make(recording, space, num_points=POINTS, shape=shape)


def compared(out: Path, fabric: str, starts: int, first: int | None) -> list[measure.Row]:
    """A row a choice, of the `first` choices; None: of all."""
    problem = problem_of(fabric)
    best = kept(out / f"choice_{fabric}_truth.npz", lambda: reference(problem, fabric))
    rows = []
    for number, (name, choice) in enumerate([*choices(fabric).items()][:first]):
        path = out / f"choice_{fabric}_{number}.npz"
        found = kept(path, lambda choice=choice: attempts(problem, choice, starts))
        row: measure.Row = {"fabric": fabric, "choice": name}
        row |= judged(problem, best, found["places"], found["losses"], "")
        row["cpu_s"] = np.median(found["seconds"])
        row |= judged(problem, best, found["ends"], found["end_losses"], ", then usual")
        row["cpu_s, both"] = np.median(found["seconds"] + found["end_seconds"])
        rows.append(row)
    return rows


def reference(problem: Problem, fabric: str) -> dict:
    """What the usual descent from the truth determines, and its loss [m^2]."""
    start = problem.space.to_unit(presets.FIVE[fabric]())
    found = descend(problem, Budget(0, 1), start=start, key=jax.random.key(0))
    end = np.asarray(problem.space.to_unit(found.fabric))
    values = np.asarray(problem.space.values(start))
    return {
        "determined": found.identifiable,
        "truth": values,
        "loss": losses_at(problem, end[None])[0],
    }


def judged(
    problem: Problem, best, places: np.ndarray, losses: np.ndarray, when: str
) -> measure.Row:
    """Shares of the starts that end well, and the median of their worst error."""
    log = np.array([bound.log for bound in problem.space.ranges])
    values = np.array([problem.space.values(jnp.asarray(p, float)) for p in places])
    wrong = np.where(log, values / np.where(log, best["truth"], 1) - 1, values - best["truth"])
    worst = np.abs(wrong[:, best["determined"]]).max(axis=1)
    return {
        f"within 5 %{when}": f"{np.sum(worst <= 0.05)}/{len(places)}",
        f"arrived{when}": f"{np.sum(losses <= SAME * best['loss'])}/{len(places)}",
        f"median worst error{when}": np.median(worst),
    }


def attempts(problem: Problem, choice: Choice, starts: int) -> dict:
    """Ends [range], their losses [m^2], CPU seconds: of the choice, and after the usual descent."""
    rows = []
    assumed = choice.problem(problem)
    for number in range(starts):
        key = jax.random.key(100 + number)
        start = jax.random.uniform(key, (problem.space.dim,), float)
        measure.progress(f"start {number}")
        clock = time.process_time()
        place = descended(assumed, choice.gradient, start)
        seconds, clock = time.process_time() - clock, time.process_time()
        end = usual(problem, place)
        rows.append((place, seconds, end, time.process_time() - clock))
    places, seconds, ends, end_seconds = (np.array(column) for column in zip(*rows, strict=True))
    return {
        "places": places,
        "losses": losses_at(problem, places),
        "seconds": seconds,
        "ends": ends,
        "end_losses": losses_at(problem, ends),
        "end_seconds": end_seconds,
    }


def usual(problem: Problem, place: np.ndarray) -> np.ndarray:
    """Where the default descent ends that begins at a place, and nowhere else."""
    start, budget = jnp.asarray(place, float), Budget(0, 1, ITERATIONS, around=0)
    found = descend(problem, budget, start=start, key=jax.random.key(0))
    return np.clip(np.asarray(problem.space.to_unit(found.fabric)), MARGIN, 1 - MARGIN)


def descended(problem: Problem, gradient: Gradient, start: Array) -> np.ndarray:
    """Where Levenberg and Marquardt's descent ends with some gradient, all points counting."""
    problems, value = (problem,), lambda number: jnp.asarray(number, float)
    unknown = unknown_of(problem, jnp.clip(start, MARGIN, 1 - MARGIN))
    rest = value(INITIAL_DAMPING), value(GROWTH), value(0.0), jnp.asarray(0)
    now = Descent(unknown, gradient(problem, unknown), *rest)
    for _ in range(ITERATIONS):
        prior = _weight(problems, now.normal)
        if float(_remaining(problems, now, prior)) < CLOSE * float(prior):
            break
        trial = _propose(problems, now, prior)
        now = _accept(problems, now, trial, gradient(problem, trial), prior)
    return np.asarray(now.theta[: problem.space.dim])


def exact(problem: Problem, unknown: Array) -> Normal:
    """By forward mode."""
    return normal_at((problem,), unknown)


def secants(width: float) -> Gradient:
    """Over a width [range], which is traced, so that all compile once."""
    traced: Any = jnp.asarray(width, float)
    return lambda problem, unknown: normal_at((problem,), unknown, 0.0, traced)


def mean(problem: Problem, unknown: Array) -> Normal:
    """Over `BATCH` places around: randomised smoothing.

    They lie always alike around, so that the mean is a function that one can descend.
    """
    dim = problem.space.dim
    around = SPREAD * jax.random.normal(jax.random.key(5), (BATCH, dim), float)
    places = jnp.clip(unknown[None, :dim] + around, MARGIN, 1 - MARGIN)
    normals = [exact(problem, unknown.at[:dim].set(place)) for place in places]
    return jax.tree.map(lambda *leaves: sum(leaves) / BATCH, *normals)


_propose = eqx.filter_jit(gauss_newton.propose)
_accept = eqx.filter_jit(gauss_newton.accept)
_remaining = eqx.filter_jit(gauss_newton.remaining)
_weight = eqx.filter_jit(gauss_newton.prior_weight)


def more_damped(problem: Problem) -> Problem:
    """The problem of one who takes all fabrics to be damped `MORE` times as much."""
    assert isinstance(problem.space, Damped)
    return dataclasses.replace(problem, space=Damped.make(problem.space.space, MORE))


def drawn(rows: list[measure.Row]) -> Figure:
    """Starts that arrive, by the choice alone and after the usual descent, with CPU seconds."""
    fabrics = list(dict.fromkeys(row["fabric"] for row in rows))
    figure = Figure(figsize=(6.5 * len(fabrics), 4.4), layout="constrained")
    axes = figure.subplots(1, len(fabrics), squeeze=False)[0]
    share = lambda text: int(text.split("/")[0]) / int(text.split("/")[1])
    bars = (-0.2, "", "C0", "as it is"), (0.2, ", then usual", "C2", "then the usual descent")
    for at, fabric in zip(axes, fabrics, strict=True):
        members = [row for row in rows if row["fabric"] == fabric]
        heights = np.arange(len(members))
        for offset, when, colour, word in bars:
            shares = [share(row[f"within 5 %{when}"]) for row in members]
            at.barh(heights + offset, shares, 0.38, color=colour, label=word)
            seconds = [row["cpu_s, both" if when else "cpu_s"] for row in members]
            for height, part, cpu in zip(heights + offset, shares, seconds, strict=True):
                at.text(part + 0.01, height, f"{cpu:.1f} s", va="center", fontsize=7)
        at.set_yticks(heights, [row["choice"] for row in members], fontsize=8)
        at.invert_yaxis()
        at.set_xlim(0, 1.15)
        at.set_xlabel("starts whose determined parameters end within 5 % [-]", fontsize=8)
        at.set_title(f"{fabric.replace('_', ' ')}; median CPU time a start beside", fontsize=9)
    figure.legend(fontsize=8, loc="outside lower center", ncols=2)
    return figure
