"""The report of a whole study: what is analysed, in which order and words, and its tables."""

from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import pandas as pd

from r2s._util.files import write_text
from r2s.metrics.statistics import LEVEL
from r2s.study.configuration import MOTIONS, PAPER_CONFIGURATIONS
from r2s.study.motions import Motion
from r2s.study.report import opening
from r2s.study.report.charts import colours_of, error_chart
from r2s.study.report.motion_figure import motion_figures
from r2s.study.report.page import Section, render
from r2s.study.report.tables import mean_table, recording_table, skill_table
from r2s.study.statistics import comparisons, conclusions, factors, frame, means, paper, ranks
from r2s.study.verdicts import BEYOND, SURFACE

# The first that is there compares configurations: within the horizon, where one is known. What
# cameras did not see of a sheet counts for none of them. Hausdorff distances are those of outliers.
JUDGED_BY = (SURFACE, "chamfer_real_to_sim", "chamfer", "chamfer_cropped", paper.CHAMFER)
DISTANCES = (*JUDGED_BY[:-1], "chamfer_sim_to_real", "hausdorff")
MOST_MOTIONS = 15  # that are drawn
VERSIONS = ("r2s", "jax", "jaxlib", "equinox", "numpy", "scipy", "pandas", "statsmodels", "plotly")
INTERVAL = f"means over fabrics, with {LEVEL:.0%} intervals for fabrics like these"


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
    metric = next((each for each in JUDGED_BY if each in set(shared.metric)), SURFACE)
    skip = frame.undecided(shared, SURFACE) if metric == SURFACE else []
    decided = shared[(shared.metric == metric) & ~shared.recording.isin(skip)]
    judged = conclusions.findings(decided, papers)
    drawn = [label for each in motions for label in each.vertices]
    colours = colours_of([*every.configuration.cat.categories, *drawn])
    known = means.with_floor(shared, SURFACE)
    with_skill = known[known.baseline != frame.DEFAULT]
    sentences = opening.sentences(decided, with_skill, judged, len(fabrics), len(missing))
    sections = [
        Section(
            opening.QUESTION,
            sentences,
            figures=opening.picture(with_skill, decided, metric, colours),
        ),
        _skill(shared, every, known),
        _findings(judged, metric, skip),
        *_motions(motions, colours),
        _ranks_and_factors(decided, metric),
        _parameters(parameters),
        *more,
        _distances(shared, papers),
        _missing(every, missing),
        _settings(settings or {}),
    ]
    sections = [each for each in sections if each.words or each.tables]
    tables = {name: table for each in sections for name, (_, table) in each.tables.items()}
    (out / "tables").mkdir(parents=True, exist_ok=True)
    for old in (out / "tables").glob("*.csv"):
        old.unlink()
    for name, table in tables.items():
        text = table.to_csv(index=False, lineterminator="\n")
        write_text(out / "tables" / f"{name}.csv", text)
    write_text(out / "report.html", render(sections))
    return tables


def _skill(shared: pd.DataFrame, every: pd.DataFrame, known: pd.DataFrame) -> Section:
    """Error, floor and skill by configuration; and what is compared beyond the horizon."""
    if known.empty:
        return Section("Skill", ("No recording has a floor and a horizon: no skill is known.",))
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
    found = {
        "skill": (
            f"Error up to the horizon, floor and skill: {INTERVAL}",
            skill_table(means.means(known), means.skills(known)),
        ),
        "learned": (
            "How much nearer than the middle of the prior (ratio of its error to theirs)",
            comparisons.learned(known, SURFACE),
        ),
        "skill_by_fabric": ("The same by fabric", _by_fabric(means.with_floor(every, SURFACE))),
    }
    beyond = shared[shared.metric.str.startswith(BEYOND)]
    for motion in frame.motions(beyond):
        table = mean_table(beyond[beyond.evaluated_on == motion], "metric")
        text = f"{motion}, differences to the recording from the horizon on: {INTERVAL}"
        found[f"beyond_{motion}"] = text, table
    return Section("Skill", words, {name: each for name, each in found.items() if len(each[1])})


def _by_fabric(known: pd.DataFrame) -> pd.DataFrame:
    keys = ["fabric", "evaluated_on", "configuration"]
    found = known.groupby(keys, observed=True)[["value", "floor", "skill"]].mean()
    found["diverged"] = known.groupby(keys, observed=True).diverged.sum()
    millimetres = {"error [mm]": 1e3 * found.value, "floor [mm]": 1e3 * found.floor}
    return found.assign(**millimetres).drop(columns=["value", "floor"]).reset_index()


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
    return Section("The paper's conclusions", words, {"findings": ("Comparisons", judged)})


def _motions(motions: Sequence[Motion], colours: Mapping[str, str]) -> list[Section]:
    shown = motions[:MOST_MOTIONS]
    if not shown:
        return []
    names = [f"{each.evaluated_on}, {each.fabric} ({each.recording})" for each in shown]
    errors = [error_chart(each, colours) for each in shown]
    words = (
        "The mean distance of the recorded points from each simulated surface. Within the shaded "
        "floor no approach is nearer than another; beyond the horizon an error says nothing about "
        "a fabric. Lines are dashed for material points; bands are the range of estimates or draws."
    )
    turn = (
        "Recorded points and simulated sheets: open a motion, move the slider, turn the view; a "
        "click in the legend shows or hides a sheet."
    )
    if len(motions) > len(shown):
        turn += f" {len(motions) - len(shown)} more recordings are not shown."
    figures = dict(zip(names, motion_figures(shown, colours), strict=True))
    return [
        Section("Error over time", (words,), figures=dict(zip(names, errors, strict=True))),
        Section("Motions", (turn,), figures=figures, folded=True),
    ]


def _ranks_and_factors(decided: pd.DataFrame, metric: str) -> Section:
    parts = {m: decided[decided.evaluated_on == m] for m in frame.motions(decided)}
    parts |= {"all motions": decided} if len(parts) > 1 else {}
    ranked = {name: r for name, part in parts.items() if (r := ranks.rank(part)) is not None}
    found = {}
    if ranked:
        tests = "; ".join(f"{name}: {ranks.in_words(each)}" for name, each in ranked.items())
        table = pd.concat({name: each.table for name, each in ranked.items()}, names=["motion"])
        text = f"Mean ranks by {metric} with {LEVEL:.0%} intervals, and how often first. {tests}"
        found["ranks"] = text, table.reset_index()
    shares = factors.variance_shares(decided)
    if shares is not None:
        text = (
            f"Shares of the variance of log {metric} that each factor explains alone, and adds to "
            "the others (adjusted for degrees of freedom)"
        )
        found["factors"] = text, shares
    return Section("Ranks and factors", (), found)


def _parameters(parameters: pd.DataFrame | None) -> Section:
    groups = () if parameters is None else parameters.groupby("solver")
    text = f"with {LEVEL:.0%} intervals, and the truth where it is known"
    found = {
        f"parameters_{solver}": (f"Estimates on {solver}, {text}", means.parameter_intervals(part))
        for solver, part in groups
    }
    return Section("Parameters", (), found)


def _distances(shared: pd.DataFrame, papers: pd.DataFrame) -> Section:
    found = {}
    for metric in DISTANCES:
        own = shared[(shared.metric == metric) & shared.evaluated_on.isin(MOTIONS)]
        if len(own):
            found[metric] = f"{metric}: {INTERVAL}", mean_table(own, "evaluated_on")
    one_by_one = recording_table(shared, "chamfer_real_to_sim")
    if len(one_by_one):
        found["recordings"] = "chamfer_real_to_sim [mm] of every recording", one_by_one
    for motion in MOTIONS:
        table = paper.beside_paper(shared, papers, motion)
        if len(table.columns) > 1:
            cited = f"; paper: {paper.CITED}" if len(papers) else ""
            text = f"Chamfer distance on {motion} in the units of the paper [-]{cited}"
            found[f"{motion}_{paper.CHAMFER}"] = text, table
    return Section("All distances", (), found)


def _missing(every: pd.DataFrame, missing: Sequence[tuple[str, str]]) -> Section:
    there = frame.configurations(every)
    absent = [each.label for each in PAPER_CONFIGURATIONS if each not in there]
    words = f"Configurations of the paper that have no result here: {', '.join(absent)}."
    table = pd.DataFrame(list(missing), columns=["cell", "reason"])
    found = {"missing": ("Cells without a result, and why", table)} if missing else {}
    return Section("What is missing", (words,) if absent else (), found)


def _settings(settings: Mapping[str, str]) -> Section:
    lines = [*settings.items(), *((f"version of {name}", version(name)) for name in VERSIONS)]
    table = pd.DataFrame(lines, columns=["setting", "value"])
    return Section("Settings", (), {"settings": ("", table)})
