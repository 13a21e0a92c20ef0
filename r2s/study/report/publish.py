"""The report of a whole study and its tables: what is analysed, in which order, with which words."""

from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import jinja2
import pandas as pd
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from r2s.evaluation.statistics import LEVEL
from r2s.files import write_text
from r2s.study.configuration import MOTIONS, PAPER_CONFIGURATIONS
from r2s.study.motions import Motion
from r2s.study.report import opening, tables
from r2s.study.report.charts import colours_of, error_chart, interval_chart
from r2s.study.report.motion_figure import motion_figures
from r2s.study.statistics import comparisons, conclusions, factors, frame, means, paper, ranks
from r2s.study.verdicts import BEYOND, SURFACE

# The first that is there compares configurations: within the horizon, where one is known. What
# cameras did not see of a sheet counts for none of them. Hausdorff distances are those of outliers.
JUDGED_BY = (SURFACE, "chamfer_real_to_sim", "chamfer", "chamfer_cropped", paper.CHAMFER)
DISTANCES = (*JUDGED_BY[:-1], "chamfer_sim_to_real", "hausdorff")
MOST_MOTIONS = 15  # that are drawn
VERSIONS = ("r2s", "jax", "jaxlib", "equinox", "numpy", "scipy", "pandas", "statsmodels", "plotly")


class Section(NamedTuple):
    """A part of the report: paragraphs, tables by name with a caption, figures by title.

    `folded`: the figures are drawn when a reader opens them, for a browser has few 3-D contexts.
    """

    heading: str
    words: Sequence[str] = ()
    tables: Mapping[str, tuple[str, pd.DataFrame]] = {}
    figures: Mapping[str, go.Figure] = {}
    folded: bool = False


def publish(
    out: Path,
    results: pd.DataFrame,
    motions: Sequence[Motion] = (),
    parameters: pd.DataFrame | None = None,
    missing: Sequence[tuple[str, str]] = (),
    settings: Mapping[str, str] | None = None,
    paper_folder: Path | None = None,
    more: Iterable[Section] = (),
) -> dict[str, pd.DataFrame]:
    """Write `report.html` and `tables/` into `out`; returns the tables by name.

    - `results`: see `r2s.study.statistics.frame`. `motions`: recordings to draw.
    - `parameters`: what was estimated (`r2s.study.results.parameters`).
    - `missing`: cells that have no result, and why. `settings`: what the study was run with.
    - `paper_folder`: of the paper's tables, see `r2s.study.statistics.paper`.
    - `more`: further sections.

    Raises what `read_paper` raises, and OSError that names what cannot be written.
    """
    papers = paper.read_paper(paper_folder)
    every = frame.labelled(frame.without_undefined(results))
    fabrics = frame.fabrics_in_common(every)
    shared = every[every.fabric.isin(fabrics)]
    there = set(shared.metric)
    metric = next((each for each in JUDGED_BY if each in there), SURFACE)
    skip = frame.undecided(shared, SURFACE) if metric == SURFACE else []
    decided = shared[(shared.metric == metric) & ~shared.recording.isin(skip)]
    judged = conclusions.findings(decided, papers)
    colours = colours_of(
        [*every.configuration.cat.categories, *(label for each in motions for label in each.vertices)]
    )
    known = means.with_floor(shared, SURFACE)
    with_skill = known[known.baseline != "default"]
    picture, caption = opening.picture(with_skill, decided, metric, colours)
    sections = [
        *_skill(shared, every, known),
        _findings(judged, metric, skip),
        *_errors_over_time(motions[:MOST_MOTIONS], colours),
        *_motions(motions, colours),
        *_ranks_and_factors(decided, metric),
        *_parameters(parameters),
        *more,
        *_distances(shared, papers),
        *_missing(every, missing),
        _settings(settings or {}),
    ]
    sentences = opening.sentences(decided, with_skill, judged, len(fabrics), len(missing))
    first = Section(opening.QUESTION, sentences, figures={caption: picture} if picture else {})
    write_text(out / "report.html", render([first, *sections]))
    return _write_tables(out / "tables", sections)


def render(sections: Sequence[Section]) -> str:
    """The page as HTML."""
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True)
    environment.filters |= {"table": _html_table, "figure": _json_figure}
    template = environment.get_template("report.html.j2")
    return template.render(sections=sections, plotly=get_plotlyjs())


def _html_table(table: pd.DataFrame) -> str:
    return table.to_html(index=False, border=0, na_rep=tables.MISSING, classes="sortable")


def _json_figure(figure: go.Figure) -> str:
    text = figure.update_layout(template="plotly_white").to_json() or ""
    return text.replace("<", "\\u003c")  # "<" would end the element that holds it


def _write_tables(folder: Path, sections: Iterable[Section]) -> dict[str, pd.DataFrame]:
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.csv"):
        old.unlink()
    found = {name: table for each in sections for name, (_, table) in each.tables.items()}
    for name, table in found.items():
        write_text(folder / f"{name}.csv", table.to_csv(index=False, lineterminator="\n"))
    return found


def _skill(shared: pd.DataFrame, every: pd.DataFrame, known: pd.DataFrame) -> list[Section]:
    """Error, floor and skill by configuration; and what is compared beyond the horizon."""
    if known.empty:
        words = "No recording has a floor and a horizon, so no skill is known."
        return [Section("Skill", (words,))]
    words = [
        "Skill is (default - error) / (default - floor): 1 where the prediction is as near as the "
        "truth itself is known, 0 for the mean of random fabrics of the same weight (the default). "
        "It is not known where the default is not clearly above the floor. A run that diverged has "
        "an infinite error and a skill of minus infinity.",
        "The true fabric has the truth's stiffness at small strain. The middle of the prior is the "
        "best guess by the weight alone: what is not better than that has learned nothing.",
    ]
    if left_out := sorted(set(every.fabric) - set(shared.fabric)):
        words.append(
            f"Not every configuration has an estimate of {', '.join(left_out)}, which no mean "
            "counts; the table by fabric has all."
        )
    interval = f"means over fabrics, with {LEVEL:.0%} intervals for fabrics like these"
    found = {
        "skill": (
            f"Error up to the horizon, floor and skill: {interval}",
            tables.skill_table(means.means(known), means.skills(known)),
        )
    }
    learned = comparisons.learned(known, SURFACE)
    if len(learned):
        text = (
            "Error over that of the middle of the prior (below 1: better), with p (Student's t "
            "over fabrics, Holm's correction over this table) and in how many fabrics"
        )
        found["learned"] = text, tables.learned_table(learned)
    found["skill_by_fabric"] = "The same by fabric", tables.by_fabric(
        means.with_floor(every, SURFACE)
    )
    beyond = shared[shared.metric.str.startswith(BEYOND)]
    for motion in frame.motions(beyond):
        part = beyond[beyond.evaluated_on == motion]
        text = f"{motion}, differences to the recording from the horizon on: {interval}"
        found[f"beyond_{motion}"] = text, tables.mean_table(part, "metric")
    return [Section("Skill", words, found)]


def _findings(judged: pd.DataFrame, metric: str, skip: Sequence[str]) -> Section:
    words = [
        f"Each conclusion of the paper (Ru et al. 2025) is tested on {metric} over fabrics: each "
        "has one number, however many recordings and estimates it rests on. Ratios are above 1 "
        "where the conclusion is right; p is Student's t test with Holm's correction. Runs that "
        "diverged have no ratio, and nothing is found in favour of a side that has any.",
        *(f"{answer.capitalize()}: {x}" for x, answer in comparisons.answers(judged).items()),
    ]
    if skip:
        words.append(
            f"{len(skip)} recordings do not discriminate between fabrics and count neither here "
            f"nor in ranks and factors: {', '.join(skip)}."
        )
    table = tables.finding_table(judged)
    return Section("The paper's conclusions", words, {"findings": ("Comparisons", table)})


def _errors_over_time(motions: Sequence[Motion], colours: Mapping[str, str]) -> list[Section]:
    if not motions:
        return []
    words = (
        "The mean distance of the recorded points from each simulated surface. Within the shaded "
        "floor no approach is nearer than another; beyond the horizon an error says nothing about "
        "a fabric. Lines are dashed for material points; bands are the range of estimates or draws."
    )
    charts = {f"{m.evaluated_on}, {m.fabric}": error_chart(m, colours) for m in motions}
    return [Section("Error over time", (words,), figures=charts)]


def _motions(motions: Sequence[Motion], colours: Mapping[str, str]) -> list[Section]:
    shown = motions[:MOST_MOTIONS]
    if not shown:
        return []
    words = ["Recorded points and simulated sheets: open a motion, move the slider, turn the view; "
             "a click in the legend shows or hides a sheet."]  # fmt: skip
    if len(motions) > len(shown):
        words.append(f"{len(motions) - len(shown)} more recordings are not shown.")
    names = [f"{each.evaluated_on}, {each.fabric} ({each.recording})" for each in shown]
    figures = dict(zip(names, motion_figures(shown, colours), strict=True))
    return [Section("Motions", words, figures=figures, folded=True)]


def _ranks_and_factors(decided: pd.DataFrame, metric: str) -> list[Section]:
    parts = {m: decided[decided.evaluated_on == m] for m in frame.motions(decided)}
    parts |= {"all motions": decided} if len(parts) > 1 else {}
    found = {}
    ranked = {name: r for name, part in parts.items() if (r := ranks.rank(part)) is not None}
    if ranked:
        tests = "; ".join(
            f"{name}: {len(r.table)} configurations, {r.recordings} recordings, {r.fabrics} fabrics"
            + (f", Friedman's p {r.p:.2g}" if r.p == r.p else "")
            + f", critical difference {r.difference:.2f}"
            + (f", left out {', '.join(r.left_out)}" if r.left_out else "")
            for name, r in ranked.items()
        )
        text = f"Mean rank by {metric} with {LEVEL:.0%} interval, how often the best. {tests}"
        found["ranks"] = text, tables.rank_table(ranked)
    shares = factors.variance_shares(decided)
    if shares is not None:
        text = (
            f"Shares of the variance of log {metric} that each factor explains alone, and adds to "
            "the others (adjusted for degrees of freedom)"
        )
        found["factors"] = text, shares.round(3)
    return [Section("Ranks and factors", (), found)] if found else []


def _parameters(parameters: pd.DataFrame | None) -> list[Section]:
    if parameters is None or parameters.empty:
        return []
    found = {
        f"parameters_{solver}": (
            f"Estimates on {solver}, with {LEVEL:.0%} intervals, and the truth where it is known",
            tables.parameter_table(part),
        )
        for solver, part in parameters.groupby("solver")
    }
    return [Section("Parameters", (), found)]


def _distances(shared: pd.DataFrame, papers: pd.DataFrame) -> list[Section]:
    found = {}
    for metric in DISTANCES:
        own = shared[(shared.metric == metric) & shared.evaluated_on.isin(MOTIONS)]
        if len(own):
            found[metric] = f"{metric}: means over fabrics", tables.mean_table(own, "evaluated_on")
    one_by_one = tables.recording_table(shared, "chamfer_real_to_sim")
    if len(one_by_one):
        found["recordings"] = "chamfer_real_to_sim [mm] of every recording", one_by_one
    for motion in MOTIONS:
        table = paper.beside_paper(shared, papers, motion)
        if len(table.columns) > 1:
            cited = f"; paper: {paper.CITED}" if len(papers) else ""
            text = f"Chamfer distance on {motion} in the units of the paper [-]{cited}"
            found[f"{motion}_{paper.CHAMFER}"] = text, table.round(3)
    return [Section("All distances", (), found)] if found else []


def _missing(every: pd.DataFrame, missing: Sequence[tuple[str, str]]) -> list[Section]:
    there = frame.configurations(every)
    absent = [each.label for each in PAPER_CONFIGURATIONS if each not in there]
    words = f"Configurations of the paper that have no result here: {', '.join(absent)}."
    table = pd.DataFrame(list(missing), columns=["cell", "reason"])
    found = {"missing": ("Cells without a result, and why", table)} if missing else {}
    if not (absent or missing):
        return []
    return [Section("What is missing", (words,) if absent else (), found)]


def _settings(settings: Mapping[str, str]) -> Section:
    lines = [*settings.items(), *((f"version of {name}", version(name)) for name in VERSIONS)]
    table = pd.DataFrame(lines, columns=["setting", "value"])
    return Section("Settings", (), {"settings": ("", table)})
