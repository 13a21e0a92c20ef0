"""Which cells a study has: configurations (approach, solver, scenario) by fabrics by motions."""

import dataclasses
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from r2s.estimation.method import default_space
from r2s.estimation.methods import METHODS
from r2s.estimation.physnet.method import TrainingBudget
from r2s.materials import presets
from r2s.scenarios.standard import ESTIMATION, EVALUATION
from r2s.study.configuration import (
    MOTIONS,
    PAPER_CONFIGURATIONS,
    PUBLISHED_CONFIGURATIONS,
    TOGETHER_CONFIGURATIONS,
    Configuration,
)
from r2s.study.estimates import SOLVERS, Budgets, EstimateCell, TrainedNetwork
from r2s.study.evaluations import MIDDLE, EvaluationCell
from r2s.study.mujoco_cells import FABRIC as FLEX
from r2s.study.mujoco_cells import SCENARIOS as IN_MUJOCO
from r2s.study.mujoco_cells import MujocoRecording
from r2s.study.mujoco_sheet import Material, mujoco_module
from r2s.study.sources import (
    GivenRecording,
    Source,
    SyntheticRecording,
    TruthSettings,
    find_recordings,
    strain_dependent,
    with_measured_tables,
)

ESTIMATED_FROM = ("lifting", "wind", "stretching")
DRAWS = 4  # of the prior, which are the default together
TOGETHER = 10  # recordings that one cell judges
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

    - `configurations`, `fabrics`: which to estimate.
    - `repeats`: estimates of each, from other motions.
    - `judged`: motions of each of `MOTIONS` to judge by.
    - `truth`: how synthetic recordings are made. `budgets`: what estimates may cost.
    - `every`: 1 compares all frames that count, 3 every third.
    - `draws`: of the prior, which are the default together.
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
    truth=TruthSettings(self_contact=True),
)
ONE_FABRIC = Plan(
    configurations=PAPER_CONFIGURATIONS,
    fabrics=("camel_ponte_roma",),
    repeats=1,
    judged=1,
    budgets=Budgets(
        diffcp=METHODS["diffcp"].budget._replace(coarse=4, starts=1),
        physnet=METHODS["physnet"].budget._replace(evaluations=40),
        training=TrainingBudget(fabrics=32, epochs=2, steps=40),
    ),
    every=3,
    draws=2,
)
SMALL = Plan(
    configurations=(
        Configuration("diffcloud", "cloth", "lifting"),
        Configuration("diffcloud", "cloth", "wind"),
        TOGETHER_CONFIGURATIONS[0],
        Configuration("diffcp", "points", "lifting"),
        Configuration("physnet", "cloth", "lifting"),
        Configuration("pinn", "points", "stretching"),
        Configuration("pinn", "cloth", "stretching"),
    ),
    fabrics=("camel_ponte_roma", "grey_interlock", FLEX),
    repeats=1,
    judged=2,
    budgets=Budgets(
        diffcloud=METHODS["diffcloud"].budget._replace(iterations=15),
        diffcp=METHODS["diffcp"].budget._replace(coarse=4, starts=1, iterations=2),
        physnet=METHODS["physnet"].budget._replace(evaluations=40),
        training=TrainingBudget(fabrics=32, epochs=2, steps=40),
    ),
    every=3,
    draws=2,
)
PRESETS = {
    "one_fabric": ONE_FABRIC,
    "three_fabrics": SMALL,
    "paper": dataclasses.replace(ALL, configurations=PAPER_CONFIGURATIONS),
    "full": ALL,
}


def configuration_named(text: str) -> Configuration:
    """The configuration written as "diffcloud-cloth-lifting".

    Raises `ValueError` that says why for one that its approach refuses, and names all there are for
    any other.
    """
    names = {"-".join(each): each for each in FULL}
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
    """A plan with other settings; None, or nothing, leaves one as it is.

    - `configurations`: their names, such as "diffcloud-cloth-lifting".
    - `materials`: a folder of measured tables, see `TruthSettings`.

    Raises `ValueError` for numbers below 1 and unknown names, and what `with_measured_tables`
    raises.
    """
    for name, number in (("repeats", repeats), ("judged", judged)):
        if number is not None and number < 1:
            raise ValueError(f"{name} must be at least 1, got {number}")
    chosen, truth = tuple(fabrics or plan.fabrics), plan.truth
    return dataclasses.replace(
        plan,
        configurations=tuple(map(configuration_named, configurations or ())) or plan.configurations,
        fabrics=chosen,
        repeats=plan.repeats if repeats is None else repeats,
        judged=plan.judged if judged is None else judged,
        truth=with_measured_tables(truth, Path(materials)) if materials else truth,
        seed=seed,
    )


def synthetic(plan: Plan) -> list[EvaluationCell]:
    """The evaluations of a study of synthetic recordings, which need all other cells.

    The sheet of MuJoCo has the configurations whose scenario it knows. Raises `ValueError` for an
    unknown fabric.
    """

    def recording(fabric: str, scenario: str, number: int, is_unseen: bool, angle=None) -> Source:
        if fabric == FLEX:
            return MujocoRecording(scenario, number, is_unseen, plan.seed)
        return SyntheticRecording(
            fabric, scenario, number, is_unseen, plan.truth, plan.seed, angle=angle
        )

    found = []
    for fabric in plan.fabrics:
        density = _density(fabric, plan.truth)
        unseen = [
            tuple(recording(fabric, scenario, number, True) for number in range(plan.judged))
            for scenario in MOTIONS
        ]
        estimates = []
        for configuration in plan.configurations:
            if fabric == FLEX and not set(configuration.scenarios) <= set(IN_MUJOCO):
                continue
            for repeat in range(plan.repeats):
                sources = tuple(
                    recording(fabric, scenario, repeat, False, angle)
                    for scenario in configuration.scenarios
                    for angle in _angles(configuration, scenario)
                )
                estimates.append(_estimate(configuration, sources, density, plan, repeat))
        found += _evaluations(estimates, fabric, density, unseen, plan)
    return found


def check_simulators(cells: Iterable[EvaluationCell]) -> None:
    """Raise `ImportError`, before anything is made, where cells need MuJoCo and it is missing."""
    if any(isinstance(source, MujocoRecording) for cell in cells for source in cell.recordings):
        try:
            mujoco_module()
        except ImportError as error:
            raise ImportError(f"{error}, or leave {FLEX} out of --fabrics") from error


def _angles(configuration: Configuration, scenario: str) -> tuple[float | None, ...]:
    """To the warp [degrees], of the stretchings of a scenario; None: one along the warp, as the
    other approaches take it."""
    is_pulled = configuration.approach == "pinn" or len(configuration.scenarios) > 1
    return PULLS if is_pulled and scenario == "stretching" else (None,)


def _density(fabric: str, truth: TruthSettings) -> float:
    """Areal density as weighed, [kg/m^2]."""
    if fabric == FLEX:
        return Material().density
    return float(strain_dependent(fabric, truth).density)


def recorded(folder: Path, density: float, plan: Plan) -> list[EvaluationCell]:
    """The evaluations of a study of the recordings in a folder.

    - `density`: areal density to assume, [kg/m^2].
    - `plan`: gives configurations, of which those count that have recordings to estimate from, and
      budgets.

    A repeat is a recording. An estimate is judged by those `MOTIONS` of the same fabric and trial
    (of all trials where that trial has none) that it has not seen, and beside the estimate of
    another fabric. Raises what `find_recordings` raises, and `ValueError` for a density that is
    none, when no configuration has a recording to estimate from, or none is there to judge by.
    """
    default_space("cloth", density)  # refuses a density that is none
    # clouds of real cameras need all of the search, and there are few frames to judge by
    budgets = dataclasses.replace(plan.budgets, diffcloud=METHODS["diffcloud"].budget)
    plan = dataclasses.replace(plan, budgets=budgets, every=1)
    recordings = find_recordings(folder)
    wanted = {each for c in plan.configurations for each in c.scenarios}
    seen = [r for r in recordings if r.scenario in wanted]
    unseen = [r for r in recordings if r.scenario in MOTIONS]
    if not seen or not unseen:
        raise ValueError(
            f"{folder}: nothing to estimate from ({', '.join(ESTIMATED_FROM)}) or to judge by "
            f"({', '.join(MOTIONS)}); found {sorted({r.scenario for r in recordings})}"
        )
    found: list[EvaluationCell] = []
    for configuration in plan.configurations:
        sources = _together(seen, configuration.scenarios)
        estimates = [
            _estimate(configuration, each, density, plan, repeat)
            for repeat, each in enumerate(sources)
        ]
        own = [each[0] for each in sources]
        for index, (recording, estimate) in enumerate(zip(own, estimates, strict=True)):
            others = [r for r in _of_trial(unseen, recording) if r not in estimate.sources]
            judged = _by_scenario(others)
            found += _evaluations([estimate], recording.fabric, density, judged, plan)
            other = _other_fabric(own, index)
            if other is not None:
                found += [
                    EvaluationCell(
                        estimate=estimates[other],
                        solver=configuration.solver,
                        density=density,
                        fabric=recording.fabric,
                        recordings=together,
                        other=True,
                        every=plan.every,
                    )
                    for together in judged
                ]
    return list(dict.fromkeys(found))  # configurations share the default fabric


def _evaluations(
    estimates: Sequence[EstimateCell],
    fabric: str,
    density: float,
    judged: Iterable[tuple[Source, ...]],
    plan: Plan,
) -> list[EvaluationCell]:
    """Cells for estimates of a fabric on their solver and on the cloth, and first, on all of these,
    for the draws that are the default, the middle of their prior, and the true fabric where it is
    known.

    `judged`: the recordings of each scenario.
    """
    if not estimates:
        return []
    # the cloth always: what is estimated on points is judged on it, too
    solvers = dict.fromkeys(("cloth", *(estimate.solver for estimate in estimates)))
    judged = list(judged)
    is_known = all(each.small_strain_fabric is not None for group in judged for each in group)
    whose: list[tuple[EstimateCell | None, str, int | None]] = []
    for solver in solvers:
        whose += [(None, solver, draw) for draw in (*range(plan.draws), MIDDLE)]
        whose += [(None, solver, None)] if is_known else []
    whose += [(each, each.solver, None) for each in estimates]
    whose += [(each, "cloth", None) for each in estimates if each.solver != "cloth"]
    return [
        EvaluationCell(
            estimate,
            solver,
            density,
            fabric,
            recordings[first : first + TOGETHER],
            draw=draw,
            every=plan.every,
        )
        for estimate, solver, draw in whose
        for recordings in judged
        for first in range(0, len(recordings), TOGETHER)
    ]


def _estimate(
    configuration: Configuration,
    sources: tuple[Source, ...],
    density: float,
    plan: Plan,
    repeat: int,
) -> EstimateCell:
    approach, solver, scenario = configuration
    # published recipes are what they are, whatever a plan cuts
    kept = configuration.is_published
    budget = METHODS[approach].budget if kept else getattr(plan.budgets, approach)
    network = None
    if "network" in METHODS[approach].options():
        training = plan.budgets.training
        if solver == "points":
            fewer = min(training.fabrics, FEWER_FABRICS)
            training = dataclasses.replace(training, fabrics=fewer)
        network = TrainedNetwork(solver, scenario, training, plan.seed)
    fabric = sources[0].fabric
    as_commands_do = (approach, solver) == ("diffcloud", "cloth")  # `r2s estimate`
    return EstimateCell(
        approach,
        solver,
        fabric,
        sources,
        density,
        budget,
        network,
        repeat,
        prior="fabrics" if as_commands_do else "flat",
        resolves=as_commands_do,
        law="told" if as_commands_do else "linear",
    )


def _by_scenario(recordings: Iterable[GivenRecording]) -> list[tuple[GivenRecording, ...]]:
    found: Mapping[str, list[GivenRecording]] = defaultdict(list)
    for recording in recordings:
        found[recording.scenario].append(recording)
    return [tuple(together) for together in found.values()]


def _together(
    recordings: Iterable[GivenRecording], scenarios: Sequence[str]
) -> list[tuple[GivenRecording, ...]]:
    """The recordings of each estimate: those of one scenario each alone, those of several by fabric
    and trial, where all of them are there."""
    if len(scenarios) == 1:
        return [(each,) for each in recordings if each.scenario == scenarios[0]]
    trials: Mapping[tuple[str, str], list[GivenRecording]] = defaultdict(list)
    for each in recordings:
        if each.scenario in scenarios:
            trials[each.fabric, each.trial].append(each)
    return [
        tuple(sorted(every, key=lambda each: scenarios.index(each.scenario)))
        for every in trials.values()
        if {each.scenario for each in every} == set(scenarios)
    ]


def _of_trial(unseen: list[GivenRecording], recording: GivenRecording) -> list[GivenRecording]:
    same = [r for r in unseen if r.fabric == recording.fabric]
    return [r for r in same if r.trial == recording.trial] or same


def _other_fabric(recordings: Sequence[GivenRecording], index: int) -> int | None:
    """The next recording of another fabric, going round."""
    order = [(index + step) % len(recordings) for step in range(1, len(recordings))]
    fabric = recordings[index].fabric
    return next((i for i in order if recordings[i].fabric != fabric), None)
