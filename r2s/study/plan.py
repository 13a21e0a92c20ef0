"""The tasks of a study: configurations (approach, solver, scenario) by fabrics by motions."""

import dataclasses
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from r2s.estimation.method import default_space
from r2s.estimation.methods import METHODS
from r2s.estimation.physnet.method import TrainingBudget
from r2s.materials import presets
from r2s.scenarios.paths import ESTIMATION, EVALUATION
from r2s.study.configuration import (
    MOTIONS,
    ON_CLOTH,
    PAPER_CONFIGURATIONS,
    PUBLISHED_CONFIGURATIONS,
    TOGETHER_CONFIGURATIONS,
    Configuration,
)
from r2s.study.estimates import SOLVERS, Budgets, EstimateTask, TrainedNetwork
from r2s.study.evaluations import EvaluationTask
from r2s.study.mujoco import FABRIC as FLEX
from r2s.study.mujoco import SCENARIOS as IN_MUJOCO
from r2s.study.mujoco import MujocoRecording, mujoco_module
from r2s.study.recordings import (
    GivenRecording,
    Source,
    SyntheticRecording,
    TruthSettings,
    find_recordings,
    with_measured_tables,
)

ESTIMATED_FROM = ("lifting", "wind", "stretching")
DRAWS = 4  # samples of the prior, which are the default together
TOGETHER = 10  # recordings that one task evaluates
PULLS = (0.0, 45.0, 90.0)  # [degrees], of stretchings that are estimated from together
FEWER_FABRICS = 32  # at most, to train PhysNet's network on material points

FULL = (*PAPER_CONFIGURATIONS, *TOGETHER_CONFIGURATIONS) + tuple(
    Configuration(approach, solver, scenario)
    for approach, solvers in SOLVERS.items()
    for solver in solvers
    for scenario in ESTIMATED_FROM
    if (approach, solver, scenario) not in PAPER_CONFIGURATIONS
    and not METHODS[approach].refusal(solver, scenario)
)
FULL += PUBLISHED_CONFIGURATIONS
"""The configurations of the paper, those that it calls unsupported, those that it lacks, and its
own by published recipes; none that an approach refuses."""


@dataclass(frozen=True)
class Plan:
    """The settings of a study.

    - `configurations`, `fabrics`: what to estimate.
    - `repeats`: estimates of each, from other motions.
    - `judged`: motions of each of `MOTIONS` to evaluate on.
    - `truth`: how synthetic recordings are made. `budgets`: the costs of estimates.
    - `every`: 1 compares all frames that count, 3 every third.
    - `draws`: samples of the prior, which are the default together.
    """

    configurations: tuple[Configuration, ...]
    fabrics: tuple[str, ...]
    repeats: int
    judged: int
    truth: TruthSettings = TruthSettings()
    budgets: Budgets = Budgets()
    seed: int = 0
    every: int = 1
    draws: int = DRAWS


ALL = Plan(
    configurations=FULL,
    fabrics=(*presets.FIVE, FLEX),
    repeats=ESTIMATION,
    judged=EVALUATION // len(MOTIONS),
)
QUICK = Budgets(
    diffcp=METHODS["diffcp"].budget._replace(num_samples=4, num_starts=1),
    physnet=METHODS["physnet"].budget._replace(max_evaluations=40),
    training=TrainingBudget(fabrics=32, epochs=2, steps=40),
)
ONE_FABRIC = Plan(
    configurations=PAPER_CONFIGURATIONS,
    fabrics=("camel_ponte_roma",),
    repeats=1,
    judged=1,
    budgets=QUICK,
    every=3,
    draws=2,
)
SMALL = dataclasses.replace(
    ONE_FABRIC,
    configurations=(
        Configuration("diffcloud", "cloth", "lifting"),
        Configuration("diffcloud", "cloth", "wind"),
        TOGETHER_CONFIGURATIONS[0],
        Configuration("diffcp", "mpm", "lifting"),
        Configuration("physnet", "cloth", "lifting"),
        Configuration("pinn", "mpm", "stretching"),
        Configuration("pinn", "cloth", "stretching"),
    ),
    fabrics=("camel_ponte_roma", "grey_interlock", FLEX),
    judged=2,
    budgets=dataclasses.replace(
        QUICK,
        diffcloud=METHODS["diffcloud"].budget._replace(max_iterations=15),
        diffcp=QUICK.diffcp._replace(max_iterations=2),
    ),
)
PRESETS = {
    "one_fabric": ONE_FABRIC,
    "three_fabrics": SMALL,
    "paper": dataclasses.replace(ALL, configurations=PAPER_CONFIGURATIONS),
    "full": ALL,
}


def configuration_named(text: str) -> Configuration:
    """The configuration written as "diffcloud-cloth-lifting". Raises `ValueError` that says why its
    approach refuses it, or names all configurations."""
    names = {"-".join(configuration): configuration for configuration in FULL}
    if text not in names:
        approach, *others = text.rsplit("-", 2)
        if approach in METHODS and len(others) == 2:
            if reason := METHODS[approach].refusal(*others):
                raise ValueError(f"no configuration {text!r}: {reason}")
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
    """A plan with other settings; None or empty leaves a setting unchanged. Raises `ValueError` for
    numbers below 1 and unknown configurations, and what `with_measured_tables` raises."""
    for name, number in (("repeats", repeats), ("judged", judged)):
        if number is not None and number < 1:
            raise ValueError(f"{name} must be at least 1, got {number}")
    truth = with_measured_tables(plan.truth, Path(materials)) if materials else plan.truth
    return dataclasses.replace(
        plan,
        configurations=tuple(map(configuration_named, configurations or ())) or plan.configurations,
        fabrics=tuple(fabrics or plan.fabrics),
        repeats=repeats or plan.repeats,
        judged=judged or plan.judged,
        truth=truth,
        seed=seed,
    )


def synthetic(plan: Plan) -> list[EvaluationTask]:
    """The evaluations of a study of synthetic recordings, which depend on all other tasks; of
    MuJoCo's sheet for the scenarios that it supports. Raises `ValueError` for an unknown fabric."""

    def recording(fabric: str, scenario: str, number: int, **settings):
        if fabric == FLEX:
            return MujocoRecording(fabric, scenario, number, seed=plan.seed, **settings)
        settings["truth"] = plan.truth
        return SyntheticRecording(fabric, scenario, number, seed=plan.seed, **settings)

    evaluations = []
    for fabric in plan.fabrics:
        unseen = [
            tuple(recording(fabric, scenario, i, unseen=True) for i in range(plan.judged))
            for scenario in MOTIONS
        ]
        density = float(unseen[0][0].material.density)
        estimates = []
        for configuration in plan.configurations:
            if fabric == FLEX and not set(configuration.scenarios) <= set(IN_MUJOCO):
                continue
            for repeat in range(plan.repeats):
                sources = tuple(
                    recording(fabric, scenario, repeat, **pull)
                    for scenario in configuration.scenarios
                    for pull in _pulls(configuration, scenario)
                )
                estimates.append(_estimate(configuration, sources, density, plan, repeat))
        evaluations += _evaluations(estimates, fabric, density, unseen, plan)
    return evaluations


def check_simulators(tasks: Iterable[EvaluationTask]) -> None:
    """Raise `ImportError`, before anything is made, where tasks need MuJoCo and it is missing."""
    if any(isinstance(source, MujocoRecording) for task in tasks for source in task.recordings):
        try:
            mujoco_module()
        except ImportError as error:
            raise ImportError(f"{error}, or leave {FLEX} out of --fabrics") from error


def _pulls(configuration: Configuration, scenario: str) -> list[dict[str, float]]:
    """The angles of the pulls of a scenario; one without an angle is a standard motion."""
    is_pulled = configuration.approach == "pinn" or len(configuration.scenarios) > 1
    return [{"angle": angle} for angle in PULLS if is_pulled and scenario == "stretching"] or [{}]


def recorded(folder: Path, density: float, plan: Plan) -> list[EvaluationTask]:
    """The evaluations of a study of the recordings in a folder.

    `density`: areal density to assume, [kg/m^2]. `plan`: gives budgets and configurations.

    Each recording is a repeat. An estimate is evaluated on those `MOTIONS` of the same fabric and
    trial (of all trials where that trial has none) that it has not seen. Raises what
    `find_recordings` raises, and `ValueError` for a density that is not positive, and without
    recordings to estimate from or to evaluate on.
    """
    default_space("cloth", density)  # raises for a density that is not positive
    # clouds of real cameras need the whole search, and there are few frames to evaluate on
    budgets = dataclasses.replace(plan.budgets, diffcloud=METHODS["diffcloud"].budget)
    plan = dataclasses.replace(plan, budgets=budgets, every=1)
    recordings = find_recordings(folder)
    wanted = {scenario for c in plan.configurations for scenario in c.scenarios}
    sources = [r for r in recordings if r.scenario in wanted]
    unseen = [r for r in recordings if r.scenario in MOTIONS]
    if not sources or not unseen:
        raise ValueError(
            f"{folder}: nothing to estimate from ({', '.join(ESTIMATED_FROM)}) or to judge by "
            f"({', '.join(MOTIONS)}); found {sorted({r.scenario for r in recordings})}"
        )
    evaluations: list[EvaluationTask] = []
    for configuration in plan.configurations:
        for repeat, group in enumerate(_together(sources, configuration.scenarios)):
            fabric, trial = group[0].fabric, group[0].trial
            same = [r for r in unseen if r.fabric == fabric]
            same = [r for r in same if r.trial == trial] or same
            judged = [
                tuple(r for r in same if r.scenario == motion and r not in group)
                for motion in MOTIONS
            ]
            estimate = _estimate(configuration, group, density, plan, repeat)
            evaluations += _evaluations([estimate], fabric, density, judged, plan)
    return list(dict.fromkeys(evaluations))  # configurations share the default fabric


def _evaluations(
    estimates: Sequence[EstimateTask],
    fabric: str,
    density: float,
    judged: Sequence[tuple[Source, ...]],
    plan: Plan,
) -> list[EvaluationTask]:
    """Evaluations of estimates of a fabric on their solver and on the cloth. First come, on all of
    these, the default's samples, the prior mean, and the true fabric where it is known.

    `judged`: the recordings of each scenario.
    """
    if not estimates:
        return []
    solvers = dict.fromkeys(("cloth", *(estimate.solver for estimate in estimates)))
    is_known = all(r.small_strain_fabric is not None for group in judged for r in group)
    references = [*(("default", i) for i in range(plan.draws)), ("middle", 0)]
    references += [("true", 0)] if is_known else []
    whose: list[tuple[EstimateTask | None, str, str, int]] = []
    whose += [(None, solver, *reference) for solver in solvers for reference in references]
    whose += [(estimate, estimate.solver, "", 0) for estimate in estimates]
    whose += [(each, "cloth", ON_CLOTH, 0) for each in estimates if each.solver != "cloth"]
    return [
        EvaluationTask(estimate, solver, density, fabric, part, baseline, draw, plan.every)
        for estimate, solver, baseline, draw in whose
        for group in judged
        for part in (group[i : i + TOGETHER] for i in range(0, len(group), TOGETHER))
    ]


def _estimate(
    configuration: Configuration,
    sources: tuple[Source, ...],
    density: float,
    plan: Plan,
    repeat: int,
) -> EstimateTask:
    approach, solver, scenario = configuration
    # a plan does not change published recipes
    own = METHODS[approach].budget if configuration.is_published else None
    network = None
    if "network" in METHODS[approach].options():
        training = plan.budgets.training
        if solver == "mpm":
            fewer = min(training.fabrics, FEWER_FABRICS)
            training = dataclasses.replace(training, fabrics=fewer)
        network = TrainedNetwork(solver, scenario, training, plan.seed)
    as_commands_do = (approach, solver) == ("diffcloud", "cloth")  # `r2s estimate`
    return EstimateTask(
        approach,
        solver,
        sources[0].fabric,
        sources,
        density,
        own or getattr(plan.budgets, approach),
        network,
        repeat,
        informed=as_commands_do,
        law="identified" if as_commands_do else "linear",
    )


def _together(
    recordings: Iterable[GivenRecording], scenarios: Sequence[str]
) -> list[tuple[GivenRecording, ...]]:
    """The recordings of each estimate: each recording of one scenario alone, those of several
    scenarios by fabric and trial, if all scenarios are among them."""
    if len(scenarios) == 1:
        return [(recording,) for recording in recordings if recording.scenario == scenarios[0]]
    trials: dict[tuple[str, str], list[GivenRecording]] = defaultdict(list)
    for recording in recordings:
        if recording.scenario in scenarios:
            trials[recording.fabric, recording.trial].append(recording)
    return [
        tuple(sorted(group, key=lambda recording: scenarios.index(recording.scenario)))
        for group in trials.values()
        if {recording.scenario for recording in group} == set(scenarios)
    ]
