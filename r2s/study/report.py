"""The report of a study: `report.html`, one file that works without a network, and its tables.

`report.html.j2` is the template of the page.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import jinja2
import numpy as np
import pandas as pd
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from r2s._util.files import write_text
from r2s.metrics.prediction_error import METRICS, UNITS
from r2s.metrics.statistics import LEVEL
from r2s.study import comparisons, conclusions
from r2s.study import results as frame
from r2s.study import tables as text_tables
from r2s.study.configuration import MOTIONS, PAPER_CONFIGURATIONS
from r2s.study.ensembles import BEYOND, SURFACE, ensembles
from r2s.study.estimates import ESTIMATE
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
from r2s.study.tables import MISSING, mean_table, mean_text, significant
from r2s.study.tasks import Task, provenance, result_files

# The first that is there compares configurations: within the horizon, where one is known. The
# parts of a sheet that cameras did not see do not count. Hausdorff distances are those of outliers.
JUDGED_BY = (SURFACE, "chamfer_real_to_sim", "chamfer", "chamfer_cropped", conclusions.CHAMFER)
DISTANCES = tuple(dict.fromkeys([*JUDGED_BY[:-1], *(m for m in METRICS if m not in UNITS)]))
MOST_MOTIONS = 15  # that are drawn
PRINTED = ("skill", "findings")  # the other tables are in files
VERSIONS = ("r2s", "jax", "jaxlib", "equinox", "numpy", "scipy", "pandas", "statsmodels", "plotly")
INTERVAL = f"means over fabrics, with {LEVEL:.0%} intervals for fabrics like these"
QUESTION = (
    "Which approach, on which solver and from which recording, estimates a fabric that moves as "
    "the real one does?"
)

Tables = dict[str, tuple[str, pd.DataFrame]]  # by name, with a caption


class Section(NamedTuple):
    """A part of the report: paragraphs, tables by name with a caption, figures by title.

    `folded`: figures are drawn when a reader opens them, as browsers have few 3-D contexts.
    """

    heading: str
    words: Sequence[str] = ()
    tables: Mapping[str, tuple[str, pd.DataFrame]] = {}
    figures: Mapping[str, go.Figure] = {}
    folded: bool = False


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
    results, estimates = frame.collect(tasks, out), frame.estimates_made(tasks, out)
    frame.write_results(out / "results.csv", results)
    for task in estimates:
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
        frame.parameters(tasks, out),
        [(f"{task.kind} {task.name}", reason) for task, reason in failed.items()],
        settings,
        paper,
        text_tables.tables_of_the_making(tasks, estimates, out),
    )
    for name in PRINTED:
        if name in tables:
            print(f"\n{tables[name].to_string(index=False)}")
    print(f"\n{out / 'report.html'} has the pictures, {out / 'results.csv'} every figure.")


def publish(
    out: Path,
    results: pd.DataFrame,
    motions: Sequence[Motion] = (),
    parameters: pd.DataFrame | None = None,
    missing: Sequence[tuple[str, str]] = (),
    settings: Mapping[str, str] | None = None,
    paper_folder: Path | None = None,
    making: Tables | None = None,
) -> dict[str, pd.DataFrame]:
    """Write `report.html` and `tables/` into `out`; returns the tables by name.

    - `results`: see `r2s.study.results`. `motions`: recordings to draw.
    - `parameters`: the estimates (`r2s.study.results.parameters`).
    - `missing`: tasks without a result, and why. `settings`: those of the study.
    - `paper_folder`: the paper's tables, see `r2s.study.conclusions`.
    - `making`: tables of how the study was made.

    Raises what `read_paper` raises, and OSError that names what cannot be written.
    """
    papers = conclusions.read_paper(paper_folder)
    every = frame.labelled(frame.without_undefined(results))
    fabrics = frame.fabrics_in_common(every)
    shared = every[every.fabric.isin(fabrics)]
    metric = next((name for name in JUDGED_BY if name in set(shared.metric)), SURFACE)
    skip = frame.undecided(shared, SURFACE) if metric == SURFACE else []
    decided = shared[(shared.metric == metric) & ~shared.recording.isin(skip)]
    judged = conclusions.findings(decided, papers)
    drawn = [label for motion in motions for label in motion.vertices]
    colours = colours_of([*every.configuration.cat.categories, *drawn])
    known = frame.with_floor(shared, SURFACE)
    with_skill = known[known.skill.notna()]
    column, part = ("skill", with_skill) if len(with_skill) else ("value", decided)
    means = frame.means(part, column)
    lines = [
        *(settings or {}).items(),
        *((f"version of {name}", version(name)) for name in VERSIONS),
    ]
    opening = [_done(decided, len(fabrics), len(missing)), _best(means, part, column)]
    opening += [_significance(judged, len(fabrics))]
    sections = [
        Section(QUESTION, opening, figures=_chart(means, column, metric, colours)),
        _skill(shared, every, known),
        _findings(judged, metric, skip),
        *_motions(motions, colours),
        Section("Ranks", (), _ranks(decided, metric)),
        Section("Parameters", (), _parameters(parameters)),
        Section("How it was made", (), making or {}),
        Section("All distances", (), _distances(shared, papers)),
        _missing(every, missing),
        Section(
            "Settings", (), {"settings": ("", pd.DataFrame(lines, columns=["setting", "value"]))}
        ),
    ]
    sections = [section for section in sections if section.words or section.tables]
    tables = {name: table for section in sections for name, (_, table) in section.tables.items()}
    (out / "tables").mkdir(parents=True, exist_ok=True)
    for old in (out / "tables").glob("*.csv"):
        old.unlink()
    for name, table in tables.items():
        text = table.to_csv(index=False, lineterminator="\n")
        write_text(out / "tables" / f"{name}.csv", text)
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True)
    environment.filters |= {"table": _html_table, "figure": _json_figure}
    template = environment.get_template("report.html.j2")
    write_text(out / "report.html", template.render(sections=sections, plotly=get_plotlyjs()))
    return tables


def _html_table(table: pd.DataFrame) -> str:
    form = {"float_format": significant, "na_rep": MISSING}
    table = table.replace("", np.nan).dropna(axis=1, how="all")
    return table.to_html(index=False, border=0, classes="sortable", **form)


def _json_figure(figure: go.Figure) -> str:
    text = figure.update_layout(template="plotly_white").to_json() or ""
    return text.replace("<", "\\u003c")  # "<" would end the element that holds it


def _chart(
    means: pd.DataFrame, column: str, metric: str, colours: Mapping[str, str]
) -> dict[str, go.Figure]:
    """The mean skills, or where none is known the mean distances, by the title of the chart."""
    if means.empty:
        return {}
    what, unit, marks = f"Mean {metric}", f"{metric} [m]", {}
    if column == "skill":
        what, unit, marks = "Skill", "skill [-]", {0.0: "default", 1.0: "floor"}
    title = f"{what} in motions that no estimate has seen, with {LEVEL:.0%} intervals"
    return {title: interval_chart(means, colours, unit, marks)}


def _done(decided: pd.DataFrame, fabrics: int, missing: int) -> str:
    own = decided[decided.baseline == ""]
    of_fabrics = f"{fabrics} {'fabric' if fabrics == 1 else 'fabrics'}"
    are_missing = "cell of the study is" if missing == 1 else "cells of the study are"
    return (
        f"{len(frame.configurations(decided))} configurations (approach, solver, source) estimated "
        f"{of_fabrics} and were evaluated on {decided.recording.nunique()} recordings of "
        f"{', '.join(frame.motions(decided)) or 'no motion'}, which no estimate has seen. Of "
        f"{len(own)} predictions {int(own.diverged.sum())} diverged; {missing} {are_missing} "
        "missing."
    )


def _best(means: pd.DataFrame, part: pd.DataFrame, column: str) -> str:
    """The configuration with the best mean by motion, of those of which no run diverged."""
    labels = set(part[part.baseline == ""].configuration)
    best = []
    for motion in frame.motions(part):
        table = means.xs(motion, level="evaluated_on")
        table = table[np.isfinite(table["mean"]) & table.index.isin(labels)]
        if len(table):
            label = table["mean"].idxmax() if column == "skill" else table["mean"].idxmin()
            write = "{:.2f}".format if column == "skill" else "{:.3g}".format
            best.append(f"{label} in {motion} ({mean_text(table.loc[label], write)})")
    if not best:
        return "No configuration has a result that could be compared."
    what = "The highest mean skill" if column == "skill" else "The smallest mean distance"
    return f"{what} has {'; '.join(best)}."


def _significance(judged: pd.DataFrame, fabrics: int) -> str:
    if fabrics < 2:
        return (
            "One fabric decides nothing between approaches: differences between them may be those "
            "of this fabric, and there are no intervals and no tests."
        )
    answers = list(comparisons.answers(judged).values())
    return (
        f"Of the paper's {len(answers)} conclusions {answers.count(comparisons.HOLDS)} hold "
        f"and {answers.count(comparisons.HOLDS_NOT)} do not; "
        f"{answers.count(comparisons.UNKNOWN)} cannot be decided from {fabrics} fabrics."
    )


def _skill(shared: pd.DataFrame, every: pd.DataFrame, known: pd.DataFrame) -> Section:
    """Error, floor and skill by configuration; and features of the motion beyond the horizon."""
    if known.empty:
        return Section("Skill", ("No recording has a floor and a horizon: no skill is known.",))
    words = [
        "Skill is (default - error) / (default - floor): 1 where the error is as small as the "
        "accuracy of the truth, 0 for the mean of random fabrics of the same weight (the default). "
        "It is not known where the default is not clearly above the floor. A run that diverged has "
        "an infinite error and a skill of minus infinity.",
        "The true fabric has the truth's stiffness at small strain. The prior mean is the best "
        "guess from the weight alone: an approach that is not better has learned nothing.",
    ]
    if left_out := sorted(set(every.fabric) - set(shared.fabric)):
        words.append(
            f"Not every configuration has an estimate of {', '.join(left_out)}: means do not "
            "include it, the table by fabric does."
        )
    table = text_tables.skill_table(frame.means(known), frame.skills(known))
    tables: Tables = {
        "skill": (f"Error up to the horizon, floor and skill: {INTERVAL}", table),
        "learned": (
            "Error of the prior mean over that of each configuration",
            comparisons.learned(known, SURFACE),
        ),
        "skill_by_fabric": ("Skill by fabric", _by_fabric(frame.with_floor(every, SURFACE))),
    }
    beyond = shared[shared.metric.str.startswith(BEYOND)]
    for motion in frame.motions(beyond):
        table = mean_table(beyond[beyond.evaluated_on == motion], "metric")
        text = f"{motion}, differences to the recording beyond the horizon: {INTERVAL}"
        tables[f"beyond_{motion}"] = text, table
    return Section("Skill", words, {name: t for name, t in tables.items() if len(t[1])})


def _by_fabric(known: pd.DataFrame) -> pd.DataFrame:
    keys = ["fabric", "evaluated_on", "configuration"]
    means = known.groupby(keys, observed=True)[["value", "floor", "skill"]].mean()
    means["diverged"] = known.groupby(keys, observed=True).diverged.sum()
    millimetres = {"error [mm]": 1e3 * means.value, "floor [mm]": 1e3 * means.floor}
    return means.assign(**millimetres).drop(columns=["value", "floor"]).reset_index()


def _findings(judged: pd.DataFrame, metric: str, skip: Sequence[str]) -> Section:
    words = [
        f"Each conclusion of the paper (Ru et al. 2025) is tested on {metric}, with one number for "
        "each fabric. Ratios are above 1 where the conclusion is right; p is Student's t test with "
        "Holm's correction. Runs that diverged have no ratio, and nothing is concluded in favour "
        "of a side that has any.",
        *(f"{answer.capitalize()}: {x}" for x, answer in comparisons.answers(judged).items()),
    ]
    if skip:
        words.append(
            f"{len(skip)} recordings do not discriminate between fabrics and count neither here "
            f"nor in ranks: {', '.join(skip)}."
        )
    return Section("The paper's conclusions", words, {"findings": ("Comparisons", judged)})


def _motions(motions: Sequence[Motion], colours: Mapping[str, str]) -> list[Section]:
    shown = motions[:MOST_MOTIONS]
    if not shown:
        return []
    titles = [motion.title for motion in shown]
    errors = {motion.title: error_chart(motion, colours) for motion in shown}
    words = (
        "Mean distance of the recorded points from each simulated surface. Differences within the "
        "shaded floor are not significant; beyond the horizon an error says nothing about a "
        "fabric. Lines are dashed for material points, and end where a run diverged."
    )
    turn = (
        "Recorded points and simulated sheets: open a motion, move the slider, turn the view; a "
        "click in the legend shows or hides a sheet."
    )
    if len(motions) > len(shown):
        turn += f" {len(motions) - len(shown)} more recordings are not shown."
    figures = dict(zip(titles, motion_figures(shown, colours), strict=True))
    return [
        Section("Error over time", (words,), figures=errors),
        Section("Motions", (turn,), figures=figures, folded=True),
    ]


def _ranks(decided: pd.DataFrame, metric: str) -> Tables:
    parts = {m: decided[decided.evaluated_on == m] for m in frame.motions(decided)}
    parts |= {"all motions": decided} if len(parts) > 1 else {}
    ranked = {m: r for m, part in parts.items() if (r := comparisons.rank(part)) is not None}
    if not ranked:
        return {}
    tests = "; ".join(f"{motion}: {ranks.words}" for motion, ranks in ranked.items())
    table = pd.concat({motion: ranks.table for motion, ranks in ranked.items()}, names=["motion"])
    text = f"Mean ranks by {metric} with {LEVEL:.0%} intervals, and how often first. {tests}"
    return {"ranks": (text, table.reset_index())}


def _parameters(parameters: pd.DataFrame | None) -> Tables:
    groups = () if parameters is None else parameters.groupby("solver")
    text = f"with {LEVEL:.0%} intervals, and the truth where it is known"
    return {
        f"parameters_{solver}": (f"Estimates on {solver}, {text}", part.drop(columns="solver"))
        for solver, part in groups
    }


def _distances(shared: pd.DataFrame, papers: pd.DataFrame) -> Tables:
    tables: Tables = {}
    for metric in DISTANCES:
        own = shared[(shared.metric == metric) & shared.evaluated_on.isin(MOTIONS)]
        if len(own):
            tables[metric] = f"{metric}: {INTERVAL}", mean_table(own, "evaluated_on")
    one_by_one = text_tables.recording_table(shared, "chamfer_real_to_sim")
    if len(one_by_one):
        tables["recordings"] = "chamfer_real_to_sim [mm] of every recording", one_by_one
    for motion in MOTIONS:
        table = conclusions.beside_paper(shared, papers, motion)
        if len(table.columns) > 1:
            cited = f"; paper: {conclusions.CITED}" if len(papers) else ""
            text = f"Chamfer distance on {motion} in the units of the paper [-]{cited}"
            tables[f"{motion}_{conclusions.CHAMFER}"] = text, table
    return tables


def _missing(every: pd.DataFrame, missing: Sequence[tuple[str, str]]) -> Section:
    known = frame.configurations(every)
    absent = [c.label for c in PAPER_CONFIGURATIONS if c not in known]
    words = f"Configurations of the paper that have no result here: {', '.join(absent)}."
    table = pd.DataFrame(list(missing), columns=["cell", "reason"])
    tables = {"missing": ("Cells without a result, and why", table)} if missing else {}
    return Section("What is missing", (words,) if absent else (), tables)
