"""The sections of a report that compare configurations, whose tables are kept."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from r2s.evaluation.statistics import LEVEL
from r2s.study.report import charts
from r2s.study.report.figures import Looks
from r2s.study.report.page import Section
from r2s.study.rows import Row
from r2s.study.statistics import factors, findings, ranks
from r2s.study.statistics.distances import METRICS, distance_tables, means
from r2s.study.statistics.paper import CITED, Paper, paper_tables
from r2s.study.statistics.result_array import ResultArray, by_motion
from r2s.study.tables import Table, significant

NAMES = {METRICS[0]: "distance to the surface"}  # of metrics in a sentence
BETWEEN_SOLVERS = (
    "What is found between solvers is about the meshes that they predict on as much as about the "
    'approaches, whose estimates are simulated alike in the lines "(found on points)" of the table '
    "of skill. The true fabric itself is off by, on average,"
)
Keep = Callable[[str, Table], Table]  # writes a table under a name, and returns it


def findings_section(
    rows: Sequence[Row],
    metric: str,
    results: ResultArray,
    untold: Sequence[str],
    paper: Paper,
    keep: Keep,
) -> list[Section]:
    """The conclusions of the paper by one metric: answers by several would be several chances to
    find what is not there.

    `rows`: of the metric. `untold`: recordings that are not among these, since they tell no fabrics
    apart.
    """
    if not rows:
        return [Section("Findings", ("There are no results yet.",))]
    found = findings.find(rows, paper, metric)
    words = [
        *_headlines(results),
        "Each conclusion of the paper is a test on these numbers, meant for fabrics like these: "
        "the fabrics are the sample, and each has one number, however many recordings and "
        "estimates it rests on. Ratios are of distances, or of what is named, with their interval; "
        "they are above 1 where the conclusion is right. All p are Student's t test with Holm's "
        "correction.",
        *(findings.in_words(verdict) for verdict in found),
        *_solver_words(rows),
    ]
    if untold:
        words.insert(
            0,
            f"By the {NAMES.get(metric, metric)} recordings count here, and in ranks and "
            "factors below, in which the default is clearly above the floor. Not these "
            f"{len(untold)}, which tell no fabrics apart: {', '.join(untold)}.",
        )
    if not paper:
        words.append("The tables of the paper were not given: its own numbers are not shown.")
    lines = tuple((verdict.claim.words, verdict.answer) for verdict in found)
    caption = f"Which conclusions of the paper ({CITED}) hold here"
    shown = (
        keep("findings", Table(("conclusion", f"by {metric}"), lines, caption)),
        keep(f"findings_{metric}", findings.finding_table(found, metric)),
    )
    return [Section("Findings", tuple(words), shown)]


def _solver_words(rows: Sequence[Row]) -> list[str]:
    """What the true fabric itself is off by on either solver, where both predict: a comparison
    between them is one of their meshes where that differs."""
    errors: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        if row.baseline == "true" and np.isfinite(row.value):
            errors.setdefault(row.evaluated_on, {}).setdefault(row.solver, []).append(row.value)
    off = [
        f"{motion}: "
        + ", ".join(
            f"{significant(1e3 * float(np.mean(own)))} mm on {name}" for name, own in each.items()
        )
        for motion, each in errors.items()
        if len(each) > 1
    ]
    return [f"{BETWEEN_SOLVERS} {'; '.join(off)}."] if off else []


def _headlines(results: ResultArray) -> list[str]:
    """The best configurations of each motion, beside the default fabric."""
    scale, unit = (1e3, " mm") if results.unit == "m" else (1.0, "")
    found, name = [], NAMES.get(results.metric, results.metric)
    for motion, part in by_motion(results).items():
        numbers = zip(part.configurations, *(each.tolist() for each in means(part)), strict=True)
        best, defaults, lost = [], [], []
        for configuration, *lengths, _, diverged, runs in sorted(numbers, key=lambda each: each[1]):
            if diverged:
                lost.append(f"{configuration.label} ({diverged} of {runs})")
                continue
            mean, low, high = (significant(scale * length) for length in lengths)
            between = f" ({low} to {high})" if np.isfinite(lengths[1]) else ""
            words = f"{configuration.label} {mean}{unit}{between}"
            (best if configuration.approach else defaults).append(words)
        if best:
            compared = f"; {', '.join(defaults)}" if defaults else ""
            without = f". Not ranked, for runs diverged: {', '.join(lost)}" if lost else ""
            found.append(f"Least {name} in {motion}: {', '.join(best[:3])}{compared}{without}.")
    return found


def distance_sections(
    out: Path,
    rows: Sequence[Row],
    others: Mapping[str, Sequence[Row]],
    results: ResultArray,
    paper: Paper,
    looks: Looks,
    keep: Keep,
) -> list[Section]:
    """Distances in millimetres, and in the units of the paper beside its own.

    `others`: the rows of each fabric of which not every configuration has an estimate.
    """
    sections = []
    ours = tuple(keep(name, table) for name, table in distance_tables(rows).items())
    if ours:
        figures: tuple[tuple[Path, str], ...] = ()
        if results.metric in METRICS and results.trajectories:
            path, parts = out / "figures" / "distances.png", by_motion(results)
            charts.distance_chart(path, parts, results.metric, looks)
            caption = f"Mean {results.metric} of every configuration, with {LEVEL:.0%} intervals."
            figures = ((path, caption),)
        sections.append(Section("Distances in millimetres", (), ours, figures))
    for fabric, theirs in others.items():
        own = distance_tables(theirs)
        words = (
            f"Not every configuration has an estimate of {fabric.replace('_', ' ')}: it is in no "
            "mean above.",
        )
        shown = tuple(keep(f"{name}_{fabric}", table) for name, table in own.items())
        sections.append(Section(f"Distances of {fabric.replace('_', ' ')}", words, shown))
    beside = tuple(keep(name, table) for name, table in paper_tables(rows, paper).items())
    if beside:
        words = (
            "Every cloud is centred on its first frame's centroid and divided by half of its first "
            "frame's largest radius; Chamfer distances are means of squares, both directions "
            "summed. That hides errors of size, and clouds that were seen in part are compared "
            "with whole sheets."
        )
        sections.append(Section("In the units of the paper", (words,), beside))
    return sections


def _parts(results: ResultArray) -> dict[str, ResultArray]:
    """Each motion, and all of them together where there are several."""
    parts = by_motion(results)
    return parts | ({"all motions": results} if len(parts) > 1 else {})


def rank_section(out: Path, results: ResultArray, keep: Keep) -> list[Section]:
    """Mean ranks of the configurations."""
    found = {
        motion: ranked
        for motion, part in _parts(results).items()
        if (ranked := ranks.rank(part)) is not None
    }
    if not found:
        return []
    shown = (keep("ranks", ranks.rank_table(found, f"Ranks by {results.metric}")),)
    path = charts.rank_chart(out / "figures" / "ranks.png", found)
    words = (
        "Configurations are ranked within each recording, so that hard recordings count no more. "
        "What diverged is last."
    )
    return [Section("Ranks", (words,), shown, ((path, "Mean ranks with their intervals."),))]


def factor_section(out: Path, results: ResultArray, keep: Keep) -> list[Section]:
    """Shares of the variance that each factor of the study explains."""
    found = {
        motion: shares
        for motion, part in _parts(results).items()
        if (shares := factors.variance_shares(part)) is not None
    }
    if not found:
        return []
    shown = (keep("factors", factors.share_table(found, f"By {results.metric}")),)
    path = charts.share_chart(out / "figures" / "factors.png", found)
    words = (
        "How much of the variance of the logarithm of the distance each factor explains, whatever "
        "the order in which factors are looked at. The rest is interactions, such as a solver that "
        "is good for one fabric, and the spread of repeats."
    )
    caption = "Shares of the variance, by what was judged."
    return [Section("What matters", (words,), shown, ((path, caption),))]
