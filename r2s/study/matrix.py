"""Which cells a study has: columns (approach, solver, scenario) by fabrics by motions."""

import dataclasses
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from r2s import presets
from r2s.study.estimates import SOLVERS, Estimated, Spent, Trained
from r2s.study.evaluations import Judged
from r2s.study.truths import Given, Made, Making, Source, given, strain_dependent

UNSEEN = ("folding", "fling", "shaking")
ESTIMATED_FROM = ("lifting", "wind", "stretching")
TOGETHER = 10  # recordings in a cell that judges
PULLS = (0.0, 45.0, 90.0)  # [degrees], from which PINN estimates together


class Column(NamedTuple):
    """An approach on a solver, and the scenario that it estimates from."""

    approach: str
    solver: str
    scenario: str


PAPER = (
    Column("diffcloud", "cloth", "lifting"),
    Column("diffcloud", "cloth", "wind"),
    Column("diffcp", "points", "lifting"),
    Column("physnet", "cloth", "lifting"),
    Column("physnet", "cloth", "wind"),
    Column("physnet", "points", "lifting"),
    Column("pinn", "points", "stretching"),
    Column("pinn", "cloth", "stretching"),
)
"""The eight of the study."""

FULL = PAPER + tuple(
    column
    for approach, solvers in SOLVERS.items()
    for solver in solvers
    for scenario in ESTIMATED_FROM
    if (column := Column(approach, solver, scenario)) not in PAPER
    # the network maps what a camera sees, or what markers do; see README for its limits on clouds
    and not (approach == "pinn" and solver == "points" and scenario != "stretching")
)
"""And those that it calls unsupported."""


@dataclass(frozen=True)
class Plan:
    """A study of synthetic recordings.

    - `columns`, `fabrics`: which. - `repeats`: estimates of each, from other motions.
    - `judged`: motions of each of `UNSEEN` to judge by. - `making`, `spent`, `seed`.
    """

    columns: tuple[Column, ...]
    fabrics: tuple[str, ...]
    repeats: int
    judged: int
    making: Making = Making()
    spent: Spent = Spent()
    seed: int = 0


LITTLE = Spent(fabrics=32, epochs=2, steps=40, calls=40)
SMALL = Plan(
    columns=tuple(
        Column(*names)
        for names in (
            ("diffcloud", "cloth", "lifting"),
            ("diffcloud", "cloth", "wind"),
            ("diffcp", "points", "lifting"),
            ("physnet", "cloth", "lifting"),
            ("pinn", "points", "stretching"),
            ("pinn", "cloth", "stretching"),
        )
    ),
    fabrics=("camel_ponte_roma", "grey_interlock"),
    repeats=1,
    judged=2,
    spent=LITTLE,
)
PRESETS = {
    "small": SMALL,
    "paper": Plan(PAPER, tuple(presets.FIVE), repeats=40, judged=40, making=Making(layers=True)),
    "full": Plan(FULL, tuple(presets.FIVE), repeats=40, judged=40, making=Making(layers=True)),
}


def synthetic(plan: Plan) -> list[Judged]:
    """The cells that judge of a study of synthetic recordings; they need all others.

    Raises `ValueError` for an unknown fabric.
    """
    found = []
    for fabric in plan.fabrics:
        density = float(strain_dependent(fabric, plan.making).density)
        unseen = {
            scenario: tuple(
                Made(fabric, scenario, number, True, plan.making, plan.seed)
                for number in range(plan.judged)
            )
            for scenario in UNSEEN
        }
        estimates = [
            _estimated(column, fabric, density, plan, repeat)
            for column in plan.columns
            for repeat in range(plan.repeats)
        ]
        found += _judged(estimates, fabric, density, unseen)
    return found


def recorded(folder: Path, density: float, columns: tuple[Column, ...], plan: Plan) -> list[Judged]:
    """Likewise of the recordings in a folder, with an areal density to assume [kg/m^2].

    A repeat is a recording. Judged by scenarios of `UNSEEN` of the same fabric and trial (of all
    trials where that trial has none), also with the estimate of another fabric. Raises what
    `truths.given` raises, and `ValueError` when no column has a recording to estimate from, or
    none is there to judge by.
    """
    every = given(folder)
    seen = [r for r in every if r.scenario in {column.scenario for column in columns}]
    unseen = [r for r in every if r.scenario in UNSEEN]
    if not seen or not unseen:
        raise ValueError(
            f"{folder}: nothing to estimate from ({', '.join(ESTIMATED_FROM)}) or to judge by "
            f"({', '.join(UNSEEN)}); found {sorted({r.scenario for r in every})}"
        )
    found: list[Judged] = []
    for column in columns:
        own = [r for r in seen if r.scenario == column.scenario]
        estimates = [_from_given(column, r, density, plan, i) for i, r in enumerate(own)]
        for index, (recording, estimate) in enumerate(zip(own, estimates, strict=True)):
            by = _by_scenario(_of_trial(unseen, recording))
            found += _judged([estimate], recording.fabric, density, by)
            other = _other_fabric(own, index)
            if other is not None:
                about = column.solver, density, recording.fabric
                found += [Judged(estimates[other], *about, r, True) for r in by.values()]
    return found


def _judged(estimates, fabric: str, density: float, unseen) -> list[Judged]:
    """Cells for estimates of a fabric, and for the default fabric on each solver."""
    solvers = dict.fromkeys(estimate.solver for estimate in estimates)
    whose = [(None, solver) for solver in solvers] + [(e, e.solver) for e in estimates]
    return [
        Judged(estimate, solver, density, fabric, recordings[first : first + TOGETHER])
        for estimate, solver in whose
        for recordings in unseen.values()
        for first in range(0, len(recordings), TOGETHER)
    ]


def _estimated(column: Column, fabric: str, density: float, plan: Plan, repeat: int) -> Estimated:
    make = lambda angle: Made(
        fabric, column.scenario, repeat, False, plan.making, plan.seed, angle=angle
    )
    several = column.approach == "pinn" and column.scenario == "stretching"
    sources = tuple(make(angle) for angle in (PULLS if several else (None,)))
    return _estimate(column, fabric, sources, density, plan, repeat)


def _from_given(column: Column, recording: Given, density: float, plan: Plan, repeat: int):
    return _estimate(column, recording.fabric, (recording,), density, plan, repeat)


def _estimate(
    column: Column, fabric: str, sources: tuple[Source, ...], density: float, plan: Plan, repeat
) -> Estimated:
    spent, network = plan.spent, None
    if column.approach == "physnet":
        on_points = dataclasses.replace(spent, fabrics=min(spent.fabrics, 32))
        spent = on_points if column.solver == "points" else spent
        network = Trained(column.solver, column.scenario, spent, plan.seed)
    about = column.approach, column.solver, fabric, sources, density
    return Estimated(*about, spent, network, repeat)


def _by_scenario(recordings: list[Given]) -> dict[str, tuple[Given, ...]]:
    found: dict[str, tuple[Given, ...]] = defaultdict(tuple)
    for recording in recordings:
        found[recording.scenario] += (recording,)
    return dict(found)


def _of_trial(unseen: list[Given], recording: Given) -> list[Given]:
    same = [r for r in unseen if r.fabric == recording.fabric]
    trial = [r for r in same if r.trial == recording.trial]
    return trial or same


def _other_fabric(recordings: list[Given], index: int) -> int | None:
    """The next recording of another fabric, going round."""
    order = [(index + step) % len(recordings) for step in range(1, len(recordings))]
    mine = recordings[index].fabric
    return next((i for i in order if recordings[i].fabric != mine), None)
