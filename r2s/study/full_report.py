"""Everything that a study has found, as tables, pictures, videos and one report."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from r2s.family import Range
from r2s.study import charts, factors, findings, overlays, ranks, tables
from r2s.study.distances import METRICS, distance_tables, means
from r2s.study.panel import (
    LEVEL,
    MOTIONS,
    PAPER_COLUMNS,
    Panel,
    by_metric,
    by_motion,
    columns_of,
    make_panel,
)
from r2s.study.paper import CITED, Paper, paper_tables, read_paper
from r2s.study.report import Section, write_report
from r2s.study.shown import Shown
from r2s.study.tables import Row, Table, parameter_table
from r2s.study.viewer import viewer

Entry = tuple[str, tuple[Range, ...], Any, Any, Any, Any]  # of tables.parameter_table
Publish = Callable[[str, Table], Table]

TITLE = "A study of fabrics: from recordings to simulations"
JUDGED_BY = ("chamfer", "chamfer_cropped", "chamfer_real_to_sim", "paper_chamfer", "hausdorff")
MOST_IN_VIEWER = 15
VERSIONS = ("r2s", "jax", "jaxlib", "equinox", "numpy", "scipy", "matplotlib")
HEADINGS = {
    "seconds": "CPU seconds in all",
    "each": "CPU seconds of one (median)",
    "peak_memory_MB": "peak memory [MB]",
}


def publish(
    out: Path,
    rows: Sequence[Row],
    shown: Sequence[Shown] = (),
    parameters: Mapping[str, Sequence[Entry]] | Sequence[Entry] = (),
    missing: Sequence[tuple[str, str]] = (),
    settings: Mapping[str, str] | None = None,
    paper_folder: Path | str | None = None,
    costs: Sequence[Mapping[str, Any]] = (),
) -> list[Table]:
    """Write `report.html`, `tables/`, `figures/` and `videos/` into `out`; returns the tables.

    - `shown`: recordings to draw, with the motions of the columns.
    - `parameters`: entries of `tables.parameter_table`, or several lists of them by name.
    - `missing`: cells that have no result, and why. - `settings`: what the study was run with.
    - `paper_folder`: of the tables to set beside ours (`paper.read_paper`).
    - `costs`: what cells of a kind took, any keys.

    Whatever is not there is left out, or said to be missing. Raises what `read_paper` raises, and
    OSError that names what cannot be written.
    """
    paper = read_paper(paper_folder)
    written: dict[str, Table] = {}

    def keep(name: str, table: Table) -> Table:
        written[name] = table
        return tables.publish(out / "tables", name, table)

    for folder in ("figures", "videos"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    rows_of = by_metric(rows)
    metrics = [metric for metric in JUDGED_BY if metric in rows_of]
    panel = make_panel(rows_of[metrics[0]], metrics[0]) if metrics else make_panel([], JUDGED_BY[0])
    sections = [
        *_findings(rows_of, metrics, panel, paper, keep),
        *_distances(out, rows, panel, paper, keep),
        *_ranks(out, panel, keep),
        *_factors(out, panel, keep),
        *_motions(out, shown),
        *_parameters(parameters, keep),
        *_missing(rows, missing, keep),
        *_costs(costs, keep),
        _settings(settings or {}, keep),
    ]
    write_report(out / "report.html", TITLE, _intro(panel, missing), {}, sections)
    return list(written.values())


def _intro(panel: Panel, missing: Sequence[tuple[str, str]]) -> str:
    fabrics = len({t.fabric for t in panel.trajectories})
    lost, runs = int((panel.present & ~np.isfinite(panel.values)).sum()), int(panel.present.sum())
    estimates = [column for column in panel.columns if column.approach]
    text = (
        f"Fabrics are estimated from one motion and judged on others that the estimate never saw: "
        f"{len(estimates)} columns (approach, solver, and what it was estimated from), {fabrics} "
        f"fabrics, {len(panel.trajectories)} judged recordings, {runs} simulations, of which "
        f"{lost} diverged; {len(missing)} cells are missing."
    )
    how = (
        f"Columns are compared by {panel.metric}. A simulation that diverged is a result: it is "
        f"counted, ranks last, and is in no mean. Intervals are of {LEVEL:.0%}, a bootstrap over "
        "recordings and over repeats of an estimate; the fabrics are given, so that they say "
        "nothing about other fabrics. An estimate that was made once has no repeats: then its "
        "interval does not have its spread."
    )
    return f"{text}\n\n{how}"


def _findings(
    rows_of: Mapping[str, Sequence[Row]],
    metrics: Sequence[str],
    panel: Panel,
    paper: Paper,
    keep: Publish,
) -> list[Section]:
    """The conclusions of the paper, by each of `metrics`; in words by the first."""
    if not metrics:
        return [Section("Findings", ("There are no results yet.",))]
    found = {metric: findings.find(rows_of[metric], paper, metric) for metric in metrics}
    first = found[metrics[0]]
    words = [
        *_headlines(panel),
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


def _headlines(every: Panel) -> list[str]:
    """The best columns of each motion, beside the default fabric."""
    found = []
    for motion, panel in by_motion(every).items():
        each = means(panel)
        scale, unit = (1e3, " mm") if panel.unit == "m" else (1.0, "")
        shown = {
            column: f"{column.label} {tables.significant(scale * each.mean[i])}{unit} "
            f"({tables.significant(scale * each.low[i])} to "
            f"{tables.significant(scale * each.high[i])}"
            + (f"; {each.diverged[i]} of {each.runs[i]} diverged)" if each.diverged[i] else ")")
            for i, column in enumerate(panel.columns)
            if np.isfinite(each.mean[i])
        }
        order = [panel.columns[i] for i in np.argsort(each.mean) if panel.columns[i] in shown]
        best = [shown[column] for column in order if column.approach][:3]
        defaults = [shown[column] for column in order if not column.approach]
        if best:
            compared = f"; {', '.join(defaults)}" if defaults else ""
            found.append(f"Least {every.metric} in {motion}: {', '.join(best)}{compared}.")
    return found


def _distances(
    out: Path, rows: Sequence[Row], panel: Panel, paper: Paper, keep: Publish
) -> list[Section]:
    sections = []
    ours = [keep(name, table) for name, table in distance_tables(rows).items()]
    if ours:
        figures = _distance_chart(out, panel) if panel.metric in METRICS else ()
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


def _distance_chart(out: Path, panel: Panel) -> tuple[tuple[Path, str], ...]:
    found = {motion: (each.columns, means(each)) for motion, each in by_motion(panel).items()}
    if not found:
        return ()
    path = charts.distance_chart(out / "figures" / "distances.png", found, panel.metric)
    return ((path, f"Mean {panel.metric} of every column, with {LEVEL:.0%} intervals."),)


def _parts(panel: Panel) -> dict[str, Panel]:
    """Each motion, and all of them together where there are several."""
    parts = by_motion(panel)
    return parts | ({"all motions": panel} if len(parts) > 1 else {})


def _ranks(out: Path, panel: Panel, keep: Publish) -> list[Section]:
    found = {
        motion: ranked
        for motion, part in _parts(panel).items()
        if (ranked := ranks.rank(part)) is not None
    }
    if not found:
        return []
    shown = (keep("ranks", ranks.rank_table(found, f"Ranks by {panel.metric}")),)
    path = charts.rank_chart(out / "figures" / "ranks.png", found)
    words = "Columns are ranked within each recording, so that hard recordings count no more."
    return [Section("Ranks", (words,), shown, ((path, "Mean ranks with their intervals."),))]


def _factors(out: Path, panel: Panel, keep: Publish) -> list[Section]:
    found = {
        motion: shares
        for motion, part in _parts(panel).items()
        if (shares := factors.variance_shares(part)) is not None
    }
    if not found:
        return []
    shown = (keep("factors", factors.share_table(found, f"By {panel.metric}")),)
    path = charts.share_chart(out / "figures" / "factors.png", found)
    words = (
        "How much of the variance of the logarithm of the distance each factor explains, whatever "
        "the order in which factors are looked at. The rest is interactions, such as a solver that "
        "is good for one fabric, and the spread of repeats."
    )
    caption = "Shares of the variance, by what was judged."
    return [Section("What matters", (words,), shown, ((path, caption),))]


def _motions(out: Path, shown: Sequence[Shown]) -> list[Section]:
    """Overlays of each fabric, a video of each motion, and the viewer."""
    if not shown:
        return []
    first = {(each.fabric, each.evaluated_on): each for each in reversed(shown)}
    chosen = [each for each in shown if each is first[each.fabric, each.evaluated_on]]
    pictures = []
    for fabric in dict.fromkeys(each.fabric for each in chosen):
        path = out / "figures" / f"motions_{fabric}.png"
        overlays.overview(path, [each for each in chosen if each.fabric == fabric])
        caption = (
            f"{fabric.replace('_', ' ')}: a late frame of each motion, every column's sheet over "
            "the recorded points, which are alone at the right."
        )
        pictures.append((path, caption))
    order = {motion: i for i, motion in enumerate(MOTIONS)}
    by_motion = {each.evaluated_on: each for each in reversed(chosen)}
    filmed = sorted(by_motion.values(), key=lambda each: order.get(each.evaluated_on, len(order)))
    names = [
        overlays.video(out / "videos", each).name for each in tqdm(filmed, "videos", disable=None)
    ]
    words = f"Videos of all columns side by side: {', '.join(f'videos/{name}' for name in names)}."
    turned = chosen[:MOST_IN_VIEWER]
    left_out = len(shown) - len(turned)
    note = (f"{left_out} more recordings are not in it.",) if left_out else ()
    return [
        Section("Motions", (words,), (), tuple(pictures)),
        Section("Viewer", note, html=viewer(turned)),
    ]


def _parameters(
    parameters: Mapping[str, Sequence[Entry]] | Sequence[Entry], keep: Publish
) -> list[Section]:
    lists = parameters if isinstance(parameters, Mapping) else {"": parameters}
    shown = []
    for name, entries in lists.items():
        if not entries:
            continue
        about = f" ({name})" if name else ""
        table = parameter_table(entries, f"Parameters{about}: value ± standard deviation")
        shown.append(keep(f"parameters_{name}".rstrip("_"), table))
    return [Section("Parameters", (), tuple(shown))] if shown else []


def _missing(
    rows: Sequence[Row], missing: Sequence[tuple[str, str]], keep: Publish
) -> list[Section]:
    absent = [c.label for c in PAPER_COLUMNS if c not in columns_of(rows)]
    if not (absent or missing):
        return []
    words = f"Columns of the paper that have no result here: {', '.join(absent)}."
    table = Table(("cell", "reason"), tuple(missing), "Cells without a result, and why")
    shown = (keep("missing", table),) if missing else ()
    return [Section("What is missing", (words,) if absent else (), shown)]


def _costs(costs: Sequence[Mapping[str, Any]], keep: Publish) -> list[Section]:
    if not costs:
        return []
    names = list(dict.fromkeys(name for each in costs for name in each))
    header = tuple(HEADINGS.get(name, name.replace("_", " ")) for name in names)
    lines = tuple(tuple(_plain(each.get(name)) for name in names) for each in costs)
    table = Table(header, lines, "What it took, compilation included")
    return [Section("Costs", (), (keep("costs", table),))]


def _plain(value: Any) -> str:
    if value is None:
        return tables.MISSING
    is_real = isinstance(value, float | np.floating)
    return tables.significant(float(value)) if is_real else str(value)


def _settings(settings: Mapping[str, str], keep: Publish) -> Section:
    every: Iterable[tuple[str, str]] = (
        *settings.items(),
        *((f"version of {name}", version(name)) for name in VERSIONS),
    )
    lines = tuple((name, str(value)) for name, value in every)
    return Section("Settings", (), (keep("settings", Table(("setting", "value"), lines, "")),))
