"""Which cells a study has: configurations (approach, solver, scenario) by fabrics by motions."""

import dataclasses
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from r2s.fabrics import presets
from r2s.scenarios.paths import ESTIMATION, EVALUATION
from r2s.study.estimates import SOLVERS, Budgets, EstimateCell, TrainedNetwork, family_of
from r2s.study.evaluations import EvaluationCell
from r2s.study.sources import (
    GivenRecording,
    Source,
    SyntheticRecording,
    TruthSettings,
    given,
    measured,
    strain_dependent,
)
from r2s.study.statistics.result_array import MOTIONS, PAPER_CONFIGURATIONS, Configuration

ESTIMATED_FROM = ("lifting", "wind", "stretching")
TOGETHER = 10  # recordings in a cell that judges
PULLS = (0.0, 45.0, 90.0)  # [degrees], from which PINN estimates together


FULL = PAPER_CONFIGURATIONS + tuple(
    Configuration(approach, solver, scenario)
    for approach, solvers in SOLVERS.items()
    for solver in solvers
    for scenario in ESTIMATED_FROM
    if (approach, solver, scenario) not in PAPER_CONFIGURATIONS
    # the network's maps of lifts and winds are balanced as an orthotropic sheet alone
    and not (approach == "pinn" and solver == "points" and scenario != "stretching")
)
"""The configurations of the study, and those that it calls unsupported."""


@dataclass(frozen=True)
class Plan:
    """A study of synthetic recordings.

    - `configurations`, `fabrics`: which. - `repeats`: estimates of each, from other motions.
    - `judged`: motions of each of `MOTIONS` to judge by. - `truth_settings`, `spent`, `seed`.
    - `every`: 1 compares all frames that count, 3 every third.
    """

    configurations: tuple[Configuration, ...]
    fabrics: tuple[str, ...]
    repeats: int
    judged: int
    truth_settings: TruthSettings = TruthSettings()
    spent: Budgets = Budgets()
    seed: int = 0
    every: int = 1


ALL = Plan(
    FULL, tuple(presets.FIVE), ESTIMATION, EVALUATION // len(MOTIONS), TruthSettings(layers=True)
)
LITTLE = Budgets(
    coarse=16,
    starts=2,
    iterations=15,
    points_coarse=4,
    points_starts=1,
    points_iterations=2,
    calls=40,
    fabrics=32,
    epochs=2,
    steps=40,
)
SMALL = Plan(
    configurations=tuple(
        Configuration(*names)
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
    every=3,
)
PRESETS = {
    "small": SMALL,
    "paper": dataclasses.replace(ALL, configurations=PAPER_CONFIGURATIONS),
    "full": ALL,
}


def named(text: str) -> Configuration:
    """The configuration written as "diffcloud-cloth-lifting"; `ValueError` says which there are."""
    names = {"-".join(each): each for each in FULL}
    if text not in names:
        raise ValueError(f"no configuration {text!r}; there are {', '.join(names)}")
    return names[text]


def with_changes(
    plan: Plan,
    configurations: Sequence[str] | None = None,
    fabrics: Sequence[str] | None = None,
    repeats: int | None = None,
    judged: int | None = None,
    materials: str = "",
    seed: int = 0,
) -> Plan:
    """A plan with other configurations, fabrics, numbers, measured tables or another seed; None: as it is.

    Raises `ValueError` for numbers below 1, and what `truths.measured` raises.
    """
    for name, number in (("repeats", repeats), ("judged", judged)):
        if number is not None and number < 1:
            raise ValueError(f"{name} must be at least 1, got {number}")
    chosen, truth_settings = tuple(fabrics or plan.fabrics), plan.truth_settings
    return dataclasses.replace(
        plan,
        configurations=plan.configurations
        if not configurations
        else tuple(map(named, configurations)),
        fabrics=chosen,
        repeats=plan.repeats if repeats is None else repeats,
        judged=plan.judged if judged is None else judged,
        truth_settings=truth_settings
        if not materials
        else measured(truth_settings, Path(materials), chosen),
        seed=seed,
    )


def synthetic(plan: Plan) -> list[EvaluationCell]:
    """The cells that judge of a study of synthetic recordings; they need all others.

    Raises `ValueError` for an unknown fabric.
    """
    found = []
    for fabric in plan.fabrics:
        density = float(strain_dependent(fabric, plan.truth_settings).density)
        unseen = {
            scenario: tuple(
                SyntheticRecording(fabric, scenario, number, True, plan.truth_settings, plan.seed)
                for number in range(plan.judged)
            )
            for scenario in MOTIONS
        }
        estimates = [
            _estimated(configuration, fabric, density, plan, repeat)
            for configuration in plan.configurations
            for repeat in range(plan.repeats)
        ]
        found += _judged(estimates, fabric, density, unseen, plan.every)
    return found


def recorded(folder: Path, density: float, plan: Plan) -> list[EvaluationCell]:
    """Likewise of the recordings in a folder, with an areal density to assume [kg/m^2]: those
    configurations of the plan that have recordings to estimate from.

    A repeat is a recording. Judged by `MOTIONS` of the same fabric and trial (of all trials where
    that trial has none), also with the estimate of another fabric. Raises what `truths.given`
    raises, and `ValueError` for a density that is none, when no configuration has a recording to estimate
    from, or none is there to judge by.
    """
    family_of("cloth", density)
    configurations = plan.configurations
    # clouds of real cameras need all of the search, and there are few frames to judge by
    search = {name: getattr(Budgets, name) for name in ("coarse", "starts", "iterations")}
    plan = dataclasses.replace(plan, spent=dataclasses.replace(plan.spent, **search), every=1)
    every = given(folder)
    seen = [
        r
        for r in every
        if r.scenario in {configuration.estimated_from for configuration in configurations}
    ]
    unseen = [r for r in every if r.scenario in MOTIONS]
    if not seen or not unseen:
        raise ValueError(
            f"{folder}: nothing to estimate from ({', '.join(ESTIMATED_FROM)}) or to judge by "
            f"({', '.join(MOTIONS)}); found {sorted({r.scenario for r in every})}"
        )
    found: list[EvaluationCell] = []
    for configuration in configurations:
        own = [r for r in seen if r.scenario == configuration.estimated_from]
        estimates = [_from_given(configuration, r, density, plan, i) for i, r in enumerate(own)]
        for index, (recording, estimate) in enumerate(zip(own, estimates, strict=True)):
            by = _by_scenario(_of_trial(unseen, recording))
            found += _judged([estimate], recording.fabric, density, by, plan.every)
            other = _other_fabric(own, index)
            if other is not None:
                about = configuration.solver, density, recording.fabric
                found += [
                    EvaluationCell(estimates[other], *about, r, True, plan.every)
                    for r in by.values()
                ]
    return list(dict.fromkeys(found))  # configurations share the default fabric


def _judged(estimates, fabric: str, density: float, unseen, every: int) -> list[EvaluationCell]:
    """Cells for estimates of a fabric, and for the default fabric on each solver."""
    solvers = dict.fromkeys(estimate.solver for estimate in estimates)
    of = lambda solver: (solver, density, fabric)
    whose = [(None, of(solver)) for solver in solvers] + [(e, of(e.solver)) for e in estimates]
    return [
        EvaluationCell(estimate, *about, recordings[first : first + TOGETHER], every=every)
        for estimate, about in whose
        for recordings in unseen.values()
        for first in range(0, len(recordings), TOGETHER)
    ]


def _estimated(
    configuration: Configuration, fabric: str, density: float, plan: Plan, repeat: int
) -> EstimateCell:
    make = lambda angle: SyntheticRecording(
        fabric,
        configuration.estimated_from,
        repeat,
        False,
        plan.truth_settings,
        plan.seed,
        angle=angle,
    )
    several = configuration.approach == "pinn" and configuration.estimated_from == "stretching"
    sources = tuple(make(angle) for angle in (PULLS if several else (None,)))
    return _estimate(configuration, fabric, sources, density, plan, repeat)


def _from_given(
    configuration: Configuration, recording: GivenRecording, density: float, plan: Plan, repeat: int
):
    return _estimate(configuration, recording.fabric, (recording,), density, plan, repeat)


def _estimate(
    configuration: Configuration,
    fabric: str,
    sources: tuple[Source, ...],
    density: float,
    plan: Plan,
    repeat,
) -> EstimateCell:
    spent, network = plan.spent, None
    if configuration.approach == "physnet":
        on_points = dataclasses.replace(spent, fabrics=min(spent.fabrics, 32))
        spent = on_points if configuration.solver == "points" else spent
        network = TrainedNetwork(
            configuration.solver, configuration.estimated_from, spent, plan.seed
        )
    about = configuration.approach, configuration.solver, fabric, sources, density
    return EstimateCell(*about, spent, network, repeat)


def _by_scenario(recordings: list[GivenRecording]) -> dict[str, tuple[GivenRecording, ...]]:
    found: dict[str, tuple[GivenRecording, ...]] = defaultdict(tuple)
    for recording in recordings:
        found[recording.scenario] += (recording,)
    return dict(found)


def _of_trial(unseen: list[GivenRecording], recording: GivenRecording) -> list[GivenRecording]:
    same = [r for r in unseen if r.fabric == recording.fabric]
    trial = [r for r in same if r.trial == recording.trial]
    return trial or same


def _other_fabric(recordings: list[GivenRecording], index: int) -> int | None:
    """The next recording of another fabric, going round."""
    order = [(index + step) % len(recordings) for step in range(1, len(recordings))]
    mine = recordings[index].fabric
    return next((i for i in order if recordings[i].fabric != mine), None)
