"""The parts of a report that compare configurations: findings, distances, ranks, and what matters."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from r2s.study.report import charts
from r2s.study.report.page import Section
from r2s.study.statistics import factors, findings, ranks, tables
from r2s.study.statistics.distances import METRICS, distance_tables, means
from r2s.study.statistics.paper import CITED, Paper, paper_tables
from r2s.study.statistics.result_array import LEVEL, ResultArray, by_motion
from r2s.study.tables import Row, Table

Publish = Callable[[str, Table], Table]  # keeps a table under a name, and returns it


def findings_section(
    rows_of: Mapping[str, Sequence[Row]],
    metrics: Sequence[str],
    results: ResultArray,
    paper: Paper,
    keep: Publish,
) -> list[Section]:
    """The conclusions of the paper, by each of `metrics`; in words by the first."""
    if not metrics:
        return [Section("Findings", ("There are no results yet.",))]
    found = {metric: findings.find(rows_of[metric], paper, metric) for metric in metrics}
    first = found[metrics[0]]
    words = [
        *_headlines(results),
        "Each conclusion of the paper is a test on these numbers. Ratios are of distances, or of "
        "what is named, with their interval; they are above 1 where the conclusion is right. All "
        "p are Wilcoxon's signed-rank test with Holm's correction.",
        *(findings.in_words(verdict) for verdict in first),
    ]
    if not paper:
        words.append("The tables of the paper were not given: its own numbers are not shown.")
    lines = tuple(
        (first[i].claim.words, *(found[metric][i].answer for metric in metrics))
        for i in range(len(first))
    )
    caption = f"Which conclusions of the paper ({CITED}) hold here, by metric"
    return [
        Section(
            "Findings",
            tuple(words),
            (
                keep("findings", Table(("conclusion", *metrics), lines, caption)),
                *(
                    keep(f"findings_{metric}", findings.finding_table(found[metric], metric))
                    for metric in metrics[:1]
                ),
            ),
        )
    ]


def _headlines(every: ResultArray) -> list[str]:
    """The best configurations of each motion, beside the default fabric."""
    found = []
    for motion, results in by_motion(every).items():
        each = means(results)
        scale, unit = (1e3, " mm") if results.unit == "m" else (1.0, "")
        shown = {
            configuration: f"{configuration.label} {tables.significant(scale * each.mean[i])}{unit} "
            f"({tables.significant(scale * each.low[i])} to "
            f"{tables.significant(scale * each.high[i])}"
            + (f"; {each.diverged[i]} of {each.runs[i]} diverged)" if each.diverged[i] else ")")
            for i, configuration in enumerate(results.configurations)
            if np.isfinite(each.mean[i])
        }
        order = [
            results.configurations[i]
            for i in np.argsort(each.mean)
            if results.configurations[i] in shown
        ]
        best = [shown[configuration] for configuration in order if configuration.approach][:3]
        defaults = [shown[configuration] for configuration in order if not configuration.approach]
        if best:
            compared = f"; {', '.join(defaults)}" if defaults else ""
            found.append(f"Least {every.metric} in {motion}: {', '.join(best)}{compared}.")
    return found


def distance_sections(
    out: Path, rows: Sequence[Row], results: ResultArray, paper: Paper, keep: Publish
) -> list[Section]:
    sections = []
    ours = [keep(name, table) for name, table in distance_tables(rows).items()]
    if ours:
        figures = _distance_chart(out, results) if results.metric in METRICS else ()
        sections.append(Section("Distances in millimetres", (), tuple(ours), figures))
    beside = [keep(name, table) for name, table in paper_tables(rows, paper).items()]
    if beside:
        words = (
            "Every cloud is centred on its first frame's centroid and divided by half of its first "
            "frame's largest radius; Chamfer distances are means of squares, both directions "
            "summed. That hides errors of size, and clouds that were seen in part are compared "
            "with whole sheets."
        )
        sections.append(Section("In the units of the paper", (words,), tuple(beside)))
    return sections


def _distance_chart(out: Path, results: ResultArray) -> tuple[tuple[Path, str], ...]:
    found = {
        motion: (each.configurations, means(each)) for motion, each in by_motion(results).items()
    }
    if not found:
        return ()
    path = charts.distance_chart(out / "figures" / "distances.png", found, results.metric)
    return ((path, f"Mean {results.metric} of every configuration, with {LEVEL:.0%} intervals."),)


def _parts(results: ResultArray) -> dict[str, ResultArray]:
    """Each motion, and all of them together where there are several."""
    parts = by_motion(results)
    return parts | ({"all motions": results} if len(parts) > 1 else {})


def rank_section(out: Path, results: ResultArray, keep: Publish) -> list[Section]:
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
        "Intervals reach rather too far to the middle, where estimates were repeated: resampled, "
        "their means scatter more."
    )
    return [Section("Ranks", (words,), shown, ((path, "Mean ranks with their intervals."),))]


def factor_section(out: Path, results: ResultArray, keep: Publish) -> list[Section]:
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
