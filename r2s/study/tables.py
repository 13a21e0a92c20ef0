"""Tables of a report: means with their intervals as text, and how the study was made."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pandas as pd

from r2s.estimation.default_spaces import FROM, fixed, with_law
from r2s.estimation.method import default_space
from r2s.study.configuration import ON_CLOTH
from r2s.study.ensembles import ensembles, judged_motions
from r2s.study.estimates import EstimateTask, method_of
from r2s.study.evaluations import EvaluationTask
from r2s.study.recordings import SimulatedRecording, SyntheticRecording, read, true_fabric
from r2s.study.results import CONFIGURATION, means, motions
from r2s.study.tasks import read_metadata, with_dependencies

MISSING = "-"
LEAST = 2e-3  # [m]: the effect of mesh and step in a converged motion, mean up to the horizon
TRUTHS = (
    "Recordings for evaluation: horizon; floor, and mean distances up to the horizon by cause: "
    "0.1 % more stiffness, grippers moved by 0.2 mm, a finer mesh, half the step, and settling "
    "again in the start of predictions. A recording is converged where mesh and step together "
    f"move it by less than {1e3 * LEAST:g} mm, and chaotic where stiffness or path move it by more"
)
DATA = (
    "What every approach reads of its recordings: a difference between approaches may be one "
    "between their data or priors"
)
RANGES = "Ranges of estimated parameters, and fixed values. Truths: geometric mean at small strain"


def significant(value: float) -> str:
    """A number with three significant digits, without an exponent from 1e-4 up to 1e6."""
    rounded = float(f"{value:.3g}")
    if 1e3 <= abs(rounded) < 1e6:  # "g" would write 1.23e+03
        return f"{rounded:.0f}"
    return f"{rounded:#.3g}".removesuffix(".")


def millimetres(metres: float) -> str:
    """A length [m] in millimetres to a tenth; below one to a hundredth."""
    return f"{1e3 * metres:.1f}" if abs(metres) >= 0.995e-3 else f"{1e3 * metres:.2f}"


def mean_text(row: pd.Series, write: Callable[[float], str]) -> str:
    """A mean with its interval, from a row of `means`; where runs diverged how many, and the
    median."""
    if row.diverged:
        median = f", median {write(row['median'])}" if np.isfinite(row["median"]) else ""
        return f"{row.diverged:.0f} of {row.runs:.0f} diverged{median}"
    ends = f" [{write(row.low)}, {write(row.high)}]" if row.low < row.high else ""
    return write(row["mean"]) + ends


def skill_table(errors: pd.DataFrame, skills: pd.DataFrame) -> pd.DataFrame:
    """Error, floor and skill by motion, a line a configuration; from `means` and `skills` of
    `r2s.study.results`."""
    columns: dict[str, dict[str, str]] = {}
    for (label, motion), row in skills.iterrows():
        skill = mean_text(row, "{:.2f}".format) if row.runs > 0 else "not known"
        if str(label).startswith("default "):
            skill = "0"
        elif 0 < row.known < row.judged:
            skill += f", known in {row.known:.0f} of {row.judged:.0f}"
        texts = {
            "error [mm]": mean_text(errors.loc[(label, motion)], millimetres),
            "floor [mm]": f"{1e3 * row.floor:.2f}",
            "skill": skill,
        }
        for name, text in texts.items():
            columns.setdefault(f"{motion}: {name}", {})[str(label)] = text
    order = dict.fromkeys(map(str, skills.index.get_level_values("configuration")))
    return _by_configuration(pd.DataFrame(columns), order)


def mean_table(results: pd.DataFrame, column: str) -> pd.DataFrame:
    """Means with intervals, a line a configuration, a column for each value of `column`
    ("evaluated_on" or "metric"); metres are in millimetres."""
    columns = {}
    names = motions(results) if column == "evaluated_on" else dict.fromkeys(results.metric)
    for name in names:
        part = results[results[column] == name].assign(evaluated_on=name)
        unit = part.unit.iloc[0]
        write = millimetres if unit == "m" else significant
        columns[f"{name} [{'mm' if unit == 'm' else unit}]"] = {
            str(label): mean_text(row, write) for (label, _), row in means(part).iterrows()
        }
    return _by_configuration(pd.DataFrame(columns), results.configuration.cat.categories)


def _by_configuration(table: pd.DataFrame, order: Iterable[str]) -> pd.DataFrame:
    table = table.reindex([label for label in order if label in table.index]).fillna(MISSING)
    return table.rename_axis("configuration").reset_index()


def recording_table(results: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Errors [mm] in each given recording, with their references.

    Only given recordings have an estimate of another fabric. Of an estimate the first repeat
    counts, of the default all samples.
    """
    own = results[(results.metric == metric) & (results.baseline != ON_CLOTH)]
    whose = own[own.baseline == "other_fabric"][CONFIGURATION].drop_duplicates()
    place, tables = ["evaluated_on", "fabric", "recording"], [pd.DataFrame()]
    for configuration in whose.itertuples(index=False):
        is_own = (own[CONFIGURATION] == list(configuration)).all(axis=1)
        part = own[is_own | (own.approach == "") & own.solver.isin(("", configuration.solver))]
        part = part[(part.baseline == "default") | ~part.duplicated([*place, "baseline"])]
        table = 1e3 * part.pivot_table(index=place, columns="baseline", values="value")
        table = table.rename(columns={"": "estimate"}).reset_index().rename_axis(columns=None)
        tables.append(table.assign(configuration=" ".join(configuration)))
    return pd.concat(tables)


def tables_of_the_making(
    tasks: Sequence[EvaluationTask], estimates: Sequence[EstimateTask], folder: Path
) -> dict[str, tuple[str, pd.DataFrame]]:
    """How a study was made, by name with a caption; `estimates`: the finished ones."""
    tables = {
        "truths": (TRUTHS, truth_table(tasks, folder)),
        "data": (DATA, data_table(estimates, folder)),
        "ranges": (RANGES, range_table(tasks)),
        "costs": ("Time and memory, compilation included", cost_table(tasks, folder)),
    }
    return {name: (caption, table) for name, (caption, table) in tables.items() if len(table)}


def truth_table(tasks: Sequence[EvaluationTask], folder: Path) -> pd.DataFrame:
    """How accurately each recording is known: horizon, floor by cause [mm] and a verdict."""
    rows = []
    for source, judged in judged_motions(tasks, folder).items():
        row: dict[str, Any] = {"recording": source.name, "horizon [s]": judged.horizon}
        if not judged.inside.any():
            rows.append(row | {"verdict": "no frame is known"})
            continue
        lengths = {"floor": float(judged.floor[judged.inside].mean())}
        lengths |= {c: float(each[:, judged.inside].mean()) for c, each in judged.causes.items()}
        row |= {f"{name} [mm]": 1e3 * length for name, length in lengths.items()}
        row["verdict"] = verdict(*(lengths[c] for c in ("stiffness", "path", "mesh", "step")))
        if isinstance(source, SimulatedRecording) and source.has_layers:
            row["verdict"] = "not known: ensemble without self-contact"
        rows.append(row)
    return pd.DataFrame(rows)


def verdict(stiffness: float, path: float, mesh: float, step: float) -> str:
    """Whether a truth is converged, from the mean distances of its ensemble [m]."""
    if np.hypot(stiffness, path) > LEAST:
        return "chaotic"
    rest = float(np.hypot(mesh, step))
    return "converged" if rest <= LEAST else f"not converged: {1e3 * rest:.1f} mm"


def data_table(estimates: Iterable[EstimateTask], folder: Path) -> pd.DataFrame:
    """What each approach reads of its recordings, by the first estimate."""
    rows = {}
    for task in estimates:
        place = f"{task.approach} on {task.solver}", task.scenario
        if place in rows or not all(source.is_made(folder) for source in task.sources):
            continue
        recordings = [read(source, folder) for source in task.sources]
        reads = [method_of(task).reads(recording) for recording in recordings]
        rows[place] = {
            "approach": place[0],
            "motion": place[1],
            "recordings": len(recordings),
            "frames": ", ".join(dict.fromkeys(str(len(data.frames)) for data in reads)),
            "clouds": any(data.points != 0 for data in reads),
            "markers": any(data.markers for data in reads),
            "force of grippers": any(data.force for data in reads),
            "prior": "fabrics" if task.informed else "flat",
            "laws": task.law_from(recordings),
        }
    return pd.DataFrame(list(rows.values()))


def range_table(tasks: Iterable[EvaluationTask]) -> pd.DataFrame:
    """A line for each parameter of each solver, and for each fixed value."""
    # estimates on points are predicted on the cloth, too
    tasks = [c for c in tasks if c.estimate is not None and c.solver == c.estimate.solver]
    rows = []
    for solver in dict.fromkeys(task.solver for task in tasks):
        own = [task for task in tasks if task.solver == solver]
        laws = {task.estimate.law for task in own if task.estimate is not None}
        law = "linear" if laws <= {"linear"} else "stiffening+softening"
        space = with_law(default_space(solver, own[0].density), law)
        sources = [source for task in own for source in task.recordings]
        synthetic = [source for source in sources if isinstance(source, SyntheticRecording)]
        names = dict.fromkeys(source.fabric for source in synthetic if not source.truth.materials)
        units = [space.to_unit(true_fabric(name, law)) for name in names]
        mean = np.mean(units, axis=0) if units else np.full(space.dim, np.nan)
        middle = space.values(jnp.full(space.dim, 0.5, float))
        truths = space.values(jnp.asarray(mean, float))
        for bound, half, truth in zip(space.ranges, middle.tolist(), truths.tolist(), strict=True):
            numbers = (bound.low, bound.high, half, truth)
            rows.append((solver, bound.name, bound.unit, *numbers, FROM.get(bound.name)))
        for density in dict.fromkeys(task.density for task in own):
            for value in fixed(default_space(solver, density)):
                row = (solver, value.name, value.unit, *(value.value,) * 3, np.nan, value.origin)
                rows += [row] if row not in rows else []
    header = ["solver", "parameter", "unit", "low", "high", "middle", "truths", "from"]
    return pd.DataFrame(rows, columns=header)


def cost_table(tasks: Sequence[EvaluationTask], folder: Path) -> pd.DataFrame:
    """The costs of the finished tasks, their dependencies and ensembles, by compilation group."""
    groups = defaultdict(list)
    for task in with_dependencies([*ensembles(tasks), *tasks]):
        if task.is_made(folder):
            groups[task.compilation_group].append(read_metadata(task, folder))
    rows = []
    for group, noted in groups.items():
        seconds = [metadata["cpu_seconds"] for metadata in noted]
        memory = max(metadata["peak_memory_MB"] for metadata in noted)
        rows.append((group, len(noted), sum(seconds), float(np.median(seconds)), memory))
    times = ["CPU seconds in all", "CPU seconds of one (median)"]
    return pd.DataFrame(rows, columns=["kind", "count", *times, "peak memory [MB]"])
