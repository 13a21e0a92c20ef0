"""Everything that a study has found, as tables, pictures, videos and one report."""

from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from r2s.fabrics.parameters import Range
from r2s.study import tables
from r2s.study.report import comparisons, overlays
from r2s.study.report.comparisons import Publish
from r2s.study.report.motions import MotionComparison
from r2s.study.report.page import Section, write_report
from r2s.study.report.player import viewer
from r2s.study.statistics.paper import read_paper
from r2s.study.statistics.result_array import (
    LEVEL,
    MOTIONS,
    PAPER_CONFIGURATIONS,
    ResultArray,
    by_metric,
    configurations_of,
    defined,
    result_array,
)
from r2s.study.tables import Row, Table, parameter_table

Entry = tuple[str, tuple[Range, ...], Any, Any, Any, Any]  # of tables.parameter_table

TITLE = "A study of fabrics: from recordings to simulations"
# The first compares configurations: what cameras did not see of a sheet counts for none of them. Hausdorff
# distances are those of outliers, where there are any.
JUDGED_BY = ("chamfer_real_to_sim", "chamfer", "chamfer_cropped", "paper_chamfer")
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
    shown: Sequence[MotionComparison] = (),
    parameters: Mapping[str, Sequence[Entry]] | Sequence[Entry] = (),
    missing: Sequence[tuple[str, str]] = (),
    settings: Mapping[str, str] | None = None,
    paper_folder: Path | str | None = None,
    costs: Sequence[Mapping[str, Any]] = (),
    more: Sequence[tuple[str, str, Sequence[tuple[str, Table]]]] = (),
) -> list[Table]:
    """Write `report.html`, `tables/`, `figures/` and `videos/` into `out`; returns the tables.

    - `shown`: recordings to draw, with the motions of the configurations.
    - `parameters`: entries of `tables.parameter_table`, or several lists of them by name.
    - `missing`: cells that have no result, and why. - `settings`: what the study was run with.
    - `paper_folder`: of the tables to set beside ours (`paper.read_paper`).
    - `costs`: what cells of a kind took, any keys.
    - `more`: sections of one's own: heading, words, and tables by name.

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
    rows, undefined = defined(rows)
    rows_of = by_metric(rows)
    metrics = [metric for metric in JUDGED_BY if metric in rows_of]
    results = (
        result_array(rows_of[metrics[0]], metrics[0]) if metrics else result_array([], JUDGED_BY[0])
    )
    sections = [
        *comparisons.findings_section(rows_of, metrics, results, paper, keep),
        *comparisons.distance_sections(out, rows, results, paper, keep),
        *comparisons.rank_section(out, results, keep),
        *comparisons.factor_section(out, results, keep),
        *_motions(out, shown),
        *_parameters(parameters, keep),
        *_missing(rows, missing, keep),
        *_costs(costs, keep),
        *(
            Section(heading, (words,), tuple(keep(name, table) for name, table in theirs))
            for heading, words, theirs in more
            if theirs
        ),
        _settings(settings or {}, keep),
    ]
    write_report(out / "report.html", TITLE, _intro(results, missing, undefined), {}, sections)
    return list(written.values())


def _intro(
    results: ResultArray, missing: Sequence[tuple[str, str]], undefined: Mapping[str, int]
) -> str:
    fabrics = len({t.fabric for t in results.trajectories})
    lost, runs = (
        int((results.present & ~np.isfinite(results.values)).sum()),
        int(results.present.sum()),
    )
    estimates = [
        configuration for configuration in results.configurations if configuration.approach
    ]
    text = (
        f"Fabrics are estimated from one motion and judged on others that the estimate never saw: "
        f"{len(estimates)} configurations (approach, solver, and what it was estimated from), {fabrics} "
        f"fabrics, {len(results.trajectories)} judged recordings, {runs} simulations, of which "
        f"{lost} diverged; {len(missing)} cells are missing."
    )
    how = (
        f"Configurations are compared by {results.metric}. A simulation that diverged is a result: it is "
        f"counted, ranks last, and is in no mean. Intervals are of {LEVEL:.0%}, a bootstrap over "
        "recordings and over repeats of an estimate; the fabrics are given, so that they say "
        "nothing about other fabrics. An estimate that was made once has no repeats: then its "
        "interval does not have its spread."
    )
    if undefined:
        counts = ", ".join(f"{count} of {metric}" for metric, count in undefined.items())
        how += (
            f" Values that are not defined though the simulation went well are left out: {counts}."
        )
    return f"{text}\n\n{how}"


def _motions(out: Path, shown: Sequence[MotionComparison]) -> list[Section]:
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
            f"{fabric.replace('_', ' ')}: a late frame of each motion, every configuration's sheet over "
            "the recorded points, which are alone at the right."
        )
        pictures.append((path, caption))
    order = {motion: i for i, motion in enumerate(MOTIONS)}
    filmed_of = {each.evaluated_on: each for each in reversed(chosen)}
    filmed = sorted(filmed_of.values(), key=lambda each: order.get(each.evaluated_on, len(order)))
    names = [
        overlays.video(out / "videos", each).name for each in tqdm(filmed, "videos", disable=None)
    ]
    words = f"Videos of all configurations side by side: {', '.join(f'videos/{name}' for name in names)}."
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
    absent = [c.label for c in PAPER_CONFIGURATIONS if c not in configurations_of(rows)]
    if not (absent or missing):
        return []
    words = f"Configurations of the paper that have no result here: {', '.join(absent)}."
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
