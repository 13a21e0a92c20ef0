"""The report of a study: `report.html`, one file that works without a network, and its tables.

`report.html.j2` is the template of the page, and has its words.
"""

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from r2s._util.files import write_text
from r2s.estimation.default_spaces import FROM, fixed, with_law
from r2s.estimation.method import default_space
from r2s.metrics.prediction_error import METRICS, UNITS
from r2s.metrics.statistics import LEVEL
from r2s.study import conclusions
from r2s.study import results as frame
from r2s.study.configuration import MOTIONS, PAPER_CONFIGURATIONS
from r2s.study.ensembles import BEYOND, SURFACE, ensembles, judged_motions
from r2s.study.estimates import ESTIMATE, EstimateTask, method_of
from r2s.study.evaluations import EvaluationTask
from r2s.study.figures import (
    Motion,
    colours_of,
    error_chart,
    interval_chart,
    judged_recordings,
    motion_figures,
)
from r2s.study.plan import Plan
from r2s.study.recordings import SimulatedRecording, read
from r2s.study.tasks import Task, provenance, read_metadata, result_files, with_dependencies

# The first that is there compares configurations: within the horizon, where one is known. The
# parts of a sheet that cameras did not see do not count. Hausdorff distances are those of outliers.
JUDGED_BY = (SURFACE, "chamfer_real_to_sim", "chamfer", "chamfer_cropped", conclusions.CHAMFER)
DISTANCES = tuple(dict.fromkeys([*JUDGED_BY[:-1], *(m for m in METRICS if m not in UNITS)]))
MOST_MOTIONS = 15  # that are drawn
PRINTED = ("skill", "findings")  # the other tables are in files
VERSIONS = ("r2s", "jax", "jaxlib", "equinox", "numpy", "scipy", "pandas", "statsmodels", "plotly")
MISSING = "-"
LEAST = 2e-3  # [m]: the effect of mesh and step in a converged motion, mean up to the horizon

Tables = dict[str, pd.DataFrame]


def publish_study(
    tasks: Sequence[EvaluationTask],
    failed: Mapping[Task, str],
    out: Path,
    plan: Plan,
    source: str,
    paper: Path | None = None,
) -> None:
    """Write `results.csv`, `estimates/`, `tables/` and `report.html`, and print the main tables.

    - `failed`: tasks without a result, and why.
    - `source`: where the recordings are from, in words.
    - `paper`: a folder with the tables of the paper.
    """
    results = frame.collect(tasks, out)
    write_text(out / "results.csv", results.to_csv(index=False, lineterminator="\n"))
    for task in frame.estimates_made(tasks, out):
        with result_files(task, out) as files:
            if (files / ESTIMATE).exists():
                (out / "estimates").mkdir(exist_ok=True)
                write_text(out / f"estimates/{task.name}.json", (files / ESTIMATE).read_text())
    made_by = provenance([*ensembles(tasks), *tasks], out)
    settings = {"recordings": source}
    settings |= {f.name: str(getattr(plan, f.name)) for f in dataclasses.fields(plan)}
    settings |= {f"cells made by {by}": str(count) for by, count in made_by.items()}
    tables = publish(
        out,
        results,
        judged_recordings(tasks, out),
        making(tasks, out),
        [(f"{task.kind} {task.name}", reason) for task, reason in failed.items()],
        settings,
        paper,
    )
    for name in PRINTED:
        if name in tables:
            print(f"\n{tables[name].to_string(index=False)}")
    print(f"\n{out / 'report.html'} has the pictures, {out / 'results.csv'} every figure.")


def publish(
    out: Path,
    results: pd.DataFrame,
    motions: Sequence[Motion] = (),
    making: Mapping[str, pd.DataFrame] | None = None,
    missing: Sequence[tuple[str, str]] = (),
    settings: Mapping[str, str] | None = None,
    paper_folder: Path | None = None,
) -> Tables:
    """Write `report.html` and `tables/` into `out`; returns the tables by name.

    - `results`: see `r2s.study.results`. `motions`: recordings to draw.
    - `making`: tables of what was estimated, and how (`making`).
    - `missing`: tasks without a result, and why. `settings`: those of the study.
    - `paper_folder`: the paper's tables, see `r2s.study.conclusions`.

    Raises what `read_paper` raises, and OSError that names what cannot be written.
    """
    papers = conclusions.read_paper(paper_folder)
    every = frame.labelled(frame.without_undefined(results))
    shared = every[every.fabric.isin(frame.fabrics_in_common(every))]
    metric = next((name for name in JUDGED_BY if (shared.metric == name).any()), SURFACE)
    skip = frame.undecided(shared, SURFACE) if metric == SURFACE else []
    decided = shared[(shared.metric == metric) & ~shared.recording.isin(skip)]
    judged = conclusions.findings(decided)
    versions = {f"version of {name}": version(name) for name in VERSIONS}
    tables = {
        **_skill(shared, every),
        "findings": judged,
        **(making or {}),
        **_distances(shared, papers),
        "missing": pd.DataFrame(missing, columns=["cell", "reason"]),
        "settings": pd.DataFrame(
            [*{**(settings or {}), **versions}.items()], columns=["setting", "value"]
        ),
    }
    tables = {name: table for name, table in tables.items() if len(table)}
    shown = motions[:MOST_MOTIONS]
    drawn = [label for motion in shown for label in motion.vertices]
    colours = colours_of([*every.configuration.cat.categories, *drawn])
    titles = [motion.title for motion in shown]
    page = {
        "tables": tables,
        "facts": _facts(decided, shared),
        "chart": _chart(shared, decided, metric, colours),
        "errors": dict(zip(titles, (error_chart(m, colours) for m in shown), strict=True)),
        "sheets": dict(zip(titles, motion_figures(shown, colours), strict=True)),
        "hidden": len(motions) - len(shown),
        "answers": conclusions.answers(judged),
        "metric": metric,
        "skip": skip,
        "failed": len(missing),
        "left_out": sorted(set(every.fabric) - set(shared.fabric)),
        "absent": [c.label for c in PAPER_CONFIGURATIONS if c not in frame.configurations(every)],
        "level": f"{LEVEL:.0%}",
        "least": f"{1e3 * LEAST:g} mm",
        "cited": conclusions.CITED if len(papers) else "",
    }
    (out / "tables").mkdir(parents=True, exist_ok=True)
    for old in (out / "tables").glob("*.csv"):
        old.unlink()
    for name, table in tables.items():
        text = table.to_csv(index=False, lineterminator="\n")
        write_text(out / "tables" / f"{name}.csv", text)
    write_text(out / "report.html", _html(page))
    return tables


def _html(page: Mapping[str, Any]) -> str:
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True)
    environment.filters |= {"table": _html_table, "figure": _json_figure}
    return environment.get_template("report.html.j2").render(page, plotly=get_plotlyjs())


def _html_table(table: pd.DataFrame) -> str:
    form = {"float_format": significant, "na_rep": MISSING}
    table = table.replace("", np.nan).dropna(axis=1, how="all")
    return table.to_html(index=False, border=0, classes="sortable", **form)


def _json_figure(figure: go.Figure) -> str:
    text = figure.update_layout(template="plotly_white").to_json() or ""
    return text.replace("<", "\\u003c")  # "<" would end the element that holds it


def _means(shared: pd.DataFrame, decided: pd.DataFrame) -> tuple[pd.DataFrame, bool]:
    """The mean skills, or where none is known the mean distances; and whether they are skills."""
    known = frame.with_floor(shared, SURFACE)
    known = known[known.skill.notna()]
    return (frame.means(known, "skill"), True) if len(known) else (frame.means(decided), False)


def _chart(
    shared: pd.DataFrame, decided: pd.DataFrame, metric: str, colours: Mapping[str, str]
) -> go.Figure | None:
    means, is_skill = _means(shared, decided)
    if means.empty:
        return None
    if is_skill:
        return interval_chart(means, colours, "skill [-]", {0.0: "default", 1.0: "floor"})
    return interval_chart(means, colours, f"{metric} [m]", {})


def _facts(decided: pd.DataFrame, shared: pd.DataFrame) -> dict[str, Any]:
    """What was done, and by motion the configuration with the best mean of those of which no run
    diverged."""
    own = decided[decided.baseline == frame.ESTIMATE]
    means, is_skill = _means(shared, decided)
    table = means.reset_index()
    table = table[np.isfinite(table["mean"]) & table.configuration.isin(own.configuration)]
    best = []
    for motion, rows in table.groupby("evaluated_on", sort=False):
        row = rows.loc[rows["mean"].idxmax() if is_skill else rows["mean"].idxmin()]
        number = mean_text(row, "{:.2f}".format if is_skill else "{:.3g}".format)
        best.append(f"{row.configuration} in {motion} ({number})")
    return {
        "is_skill": is_skill,
        "best": best,
        "configurations": len(frame.configurations(decided)),
        "fabrics": shared.fabric.nunique(),
        "recordings": decided.recording.nunique(),
        "motions": frame.motions(decided),
        "predictions": len(own),
        "diverged": int(own.diverged.sum()),
    }


def _skill(shared: pd.DataFrame, every: pd.DataFrame) -> Tables:
    """Error, floor and skill by configuration; and features of the motion beyond the horizon."""
    known = frame.with_floor(shared, SURFACE)
    if known.empty:
        return {}
    keys = ["fabric", "evaluated_on", "configuration"]
    of_fabric = frame.with_floor(every, SURFACE).groupby(keys, observed=True)
    means = of_fabric[["skill", "value", "floor"]].mean()
    means[["value", "floor"]] *= 1e3
    means["diverged"] = of_fabric.diverged.sum()
    beyond = shared[shared.metric.str.startswith(BEYOND)]
    return {
        "skill": skill_table(frame.means(known), frame.skills(known)),
        "learned": conclusions.learned(known, SURFACE),
        "skill_by_fabric": means.rename(
            columns={"value": "error [mm]", "floor": "floor [mm]"}
        ).reset_index(),
        **{
            f"beyond_{motion}": mean_table(beyond[beyond.evaluated_on == motion], "metric")
            for motion in frame.motions(beyond)
        },
    }


def _distances(shared: pd.DataFrame, papers: pd.DataFrame) -> Tables:
    own = shared[shared.evaluated_on.isin(MOTIONS)]
    known = [metric for metric in DISTANCES if (own.metric == metric).any()]
    tables = {m: mean_table(own[own.metric == m], "evaluated_on") for m in known}
    for motion in MOTIONS:
        table = conclusions.beside_paper(shared, papers, motion)
        if len(table.columns) > 1:
            tables[f"{motion}_{conclusions.CHAMFER}"] = table
    return tables


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
    names = frame.motions(results) if column == "evaluated_on" else dict.fromkeys(results.metric)
    for name in names:
        part = results[results[column] == name].assign(evaluated_on=name)
        unit = part.unit.iloc[0]
        write = millimetres if unit == "m" else significant
        columns[f"{name} [{'mm' if unit == 'm' else unit}]"] = {
            str(label): mean_text(row, write) for (label, _), row in frame.means(part).iterrows()
        }
    return _by_configuration(pd.DataFrame(columns), results.configuration.cat.categories)


def _by_configuration(table: pd.DataFrame, order: Iterable[str]) -> pd.DataFrame:
    table = table.reindex([label for label in order if label in table.index]).fillna(MISSING)
    return table.rename_axis("configuration").reset_index()


def making(tasks: Sequence[EvaluationTask], folder: Path) -> Tables:
    """What was estimated and how, by name."""
    return {
        "parameters": frame.parameters(tasks, folder),
        "truths": truth_table(tasks, folder),
        "data": data_table(frame.estimates_made(tasks, folder), folder),
        "ranges": range_table(tasks),
        "costs": cost_table(tasks, folder),
    }


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
        for bound in space.ranges:
            row = (bound.name, bound.unit, bound.low, bound.high, FROM.get(bound.name))
            rows.append((solver, *row))
        for density in dict.fromkeys(task.density for task in own):
            for value in fixed(default_space(solver, density)):
                row = (value.name, value.unit, value.value, value.value, value.origin)
                rows.append((solver, *row))
    header = ["solver", "parameter", "unit", "low", "high", "from"]
    return pd.DataFrame(rows, columns=header).drop_duplicates()


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
