"""Everything that a study has found, as tables, pictures, videos and one report."""

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

from tqdm import tqdm

from r2s.evaluation.statistics import LEVEL
from r2s.study import tables
from r2s.study.configuration import PAPER_CONFIGURATIONS
from r2s.study.report import opening, overlays
from r2s.study.report import sections as parts
from r2s.study.report.figures import Looks, looks_of
from r2s.study.report.motions import MotionComparison
from r2s.study.report.page import Section, write_report
from r2s.study.report.player import viewer
from r2s.study.report.sections import Keep
from r2s.study.rows import Row, by_metric, drop_undefined
from r2s.study.statistics.distances import in_common
from r2s.study.statistics.paper import read_paper
from r2s.study.statistics.parameters import Estimated, parameter_table
from r2s.study.statistics.result_array import ResultArray, configurations_of, result_array
from r2s.study.statistics.skills import deciding, with_floor
from r2s.study.tables import Table
from r2s.study.verdicts import SURFACE

TITLE = "A study of fabrics: from recordings to simulations"
# The first that is there compares configurations: within the horizon, where one is known. What
# cameras did not see of a sheet counts for none of them. Hausdorff distances are those of outliers,
# where there are any.
JUDGED_BY = (SURFACE, "chamfer_real_to_sim", "chamfer", "chamfer_cropped", "paper_chamfer")
METRIC_WORDS = {
    SURFACE: "the mean distance of a recording's points from the simulated surface (surface), in "
    "the frames before the recording's horizon where one is known"
}
MOST_IN_VIEWER = 15
VERSIONS = ("r2s", "jax", "jaxlib", "equinox", "numpy", "scipy", "matplotlib")


def publish(
    out: Path,
    rows: Sequence[Row],
    motions: Sequence[MotionComparison] = (),
    parameters: Mapping[str, Sequence[Estimated]] | None = None,
    missing: Sequence[tuple[str, str]] = (),
    settings: Mapping[str, str] | None = None,
    paper_folder: Path | str | None = None,
    more: Sequence[tuple[str, str, Mapping[str, Table]]] = (),
) -> list[Table]:
    """Write `report.html`, `tables/`, `figures/` and `videos/` into `out`; returns the tables.

    - `motions`: recordings to draw, with the motions of the configurations.
    - `parameters`: what was estimated, in lists by name.
    - `missing`: cells that have no result, and why.
    - `settings`: what the study was run with.
    - `paper_folder`: of the tables to set beside ours (`paper.read_paper`).
    - `more`: further sections: heading, words, and tables by name.

    Whatever is not there is left out, or said to be missing. Raises what `read_paper` raises, and
    OSError that names what cannot be written.
    """
    paper = read_paper(paper_folder)
    written: list[Table] = []

    def keep(name: str, table: Table) -> Table:
        written.append(table)
        return tables.publish(out / "tables", name, table)

    for folder in ("figures", "videos"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    rows, undefined = drop_undefined(rows)
    shared, others = in_common(rows)
    told, untold = deciding(shared, SURFACE)
    rows_of = by_metric(told)
    metrics = [metric for metric in JUDGED_BY if metric in rows_of]
    metric = metrics[0] if metrics else JUDGED_BY[0]
    results, decided = result_array(shared, metric), result_array(told, metric)
    looks = looks_of(
        [
            *(configuration.label for configuration in configurations_of(rows)),
            *(label for each in motions for label in each.motions),
            *(each.label for each in configurations_of(with_floor(rows, SURFACE))),
        ]
    )
    sections = [
        *opening.picture_sections(out, motions, looks),
        *opening.skill_sections(out, shared, others, looks, keep),
        *parts.findings_section(rows_of.get(metric, []), metric, decided, untold, paper, keep),
        *parts.rank_section(out, decided, keep),
        *parts.factor_section(out, decided, keep),
        *_moving(out, motions, looks),
        *_parameters(parameters or {}, keep),
        *(
            Section(
                heading,
                (words,) if words else (),
                tuple(keep(name, table) for name, table in theirs.items()),
            )
            for heading, words, theirs in more
            if theirs
        ),
        *parts.distance_sections(out, shared, others, results, paper, looks, keep),
        *_missing(rows, missing, keep),
        _settings(settings or {}, keep),
    ]
    intro = _intro(result_array(rows, results.metric), missing, undefined)
    write_report(out / "report.html", TITLE, intro, sections)
    return written


def _intro(
    results: ResultArray, missing: Sequence[tuple[str, str]], undefined: Mapping[str, int]
) -> str:
    estimates = [c for c in results.configurations if c.approach]
    text = (
        f"Fabrics are estimated from one motion and judged on others that the estimate never saw: "
        f"{len(estimates)} configurations (approach, solver, and what it was estimated from), "
        f"{len(results.fabrics)} fabrics, {len(results.trajectories)} judged recordings, "
        f"{results.present.sum()} simulations of these and the default, of which "
        f"{results.diverged.sum()} diverged; "
        f"{len(missing)} cells are missing."
    )
    what = METRIC_WORDS.get(results.metric, results.metric)
    how = (
        f"Configurations are compared by {what}. A simulation that diverged is a result: "
        f"it is counted, ranks last, and what has one has no mean. Intervals are of {LEVEL:.0%}, "
        "for fabrics like these on motions like these: the fabrics are the sample (Student's t), "
        "and what motions and repeated estimates contribute to all of them alike is added. An "
        "estimate that was made once has no repeats: then the interval does not have what the "
        "recording that it was made from contributes to all fabrics alike."
    )
    if undefined:
        counts = ", ".join(f"{count} of {metric}" for metric, count in undefined.items())
        how += (
            f" Values that are not defined though the simulation went well are left out: {counts}."
        )
    return f"{text}\n\n{how}"


def _moving(out: Path, motions: Sequence[MotionComparison], looks: Looks) -> list[Section]:
    """A video of each motion, and the viewer."""
    if not motions:
        return []
    first = {each.evaluated_on: each for each in reversed(motions)}
    filmed = tqdm(overlays.in_order(first.values()), "videos", disable=None)
    videos = [overlays.video(out / "videos", each, looks) for each in filmed]
    words = [
        "Videos of all configurations side by side: "
        + ", ".join(f"videos/{path.name}" for path in videos)
        + "."
    ]
    left_out = len(motions) - MOST_IN_VIEWER
    if left_out > 0:
        words.append(f"{left_out} more recordings are not in it.")
    return [Section("Viewer", tuple(words), html=viewer(motions[:MOST_IN_VIEWER], looks))]


def _parameters(parameters: Mapping[str, Sequence[Estimated]], keep: Keep) -> list[Section]:
    shown = tuple(
        keep(
            f"parameters_{name}",
            parameter_table(found, f"Parameters ({name}): value ± standard deviation"),
        )
        for name, found in parameters.items()
        if found
    )
    return [Section("Parameters", (), shown)] if shown else []


def _missing(rows: Sequence[Row], missing: Sequence[tuple[str, str]], keep: Keep) -> list[Section]:
    absent = [c.label for c in PAPER_CONFIGURATIONS if c not in configurations_of(rows)]
    if not (absent or missing):
        return []
    words = f"Configurations of the paper that have no result here: {', '.join(absent)}."
    table = Table(("cell", "reason"), tuple(missing), "Cells without a result, and why")
    shown = (keep("missing", table),) if missing else ()
    return [Section("What is missing", (words,) if absent else (), shown)]


def _settings(settings: Mapping[str, str], keep: Keep) -> Section:
    versions = {f"version of {name}": version(name) for name in VERSIONS}
    lines = tuple({**settings, **versions}.items())
    return Section("Settings", (), (keep("settings", Table(("setting", "value"), lines, "")),))
