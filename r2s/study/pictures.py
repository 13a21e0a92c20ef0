"""The pictures and the report of a study, from its results."""

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from r2s.estimators import gauss_newton
from r2s.estimators.problem import OWN, SHARED
from r2s.family import OrthotropicFamily
from r2s.files import write_text
from r2s.recording import Recording, cloud
from r2s.scenario import from_recording
from r2s.study import figures, tables
from r2s.study.pairs import EVALUATED_ON
from r2s.study.report import Section, write_report
from r2s.study.run import Judged, problem_of
from r2s.study.tables import Row, Table

METRICS = (
    "chamfer_real_to_sim",
    "chamfer_cropped",
    "chamfer_sim_to_real",
    "chamfer",
    "hausdorff",
    "paper_chamfer",
    "paper_hausdorff",
)
LINE_POINTS = 7  # along each parameter


def picture(out: Path, judged: Judged) -> tuple[tuple[Path, str], ...]:
    """Overlays of both motions and traces of the estimate, as PNG in `out/figures`."""
    folder = out / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    name, estimate = judged.pair.lift.info.name, judged.estimate
    shown = [
        (_overlay(folder, judged, recording), _overlay_caption(recording))
        for recording in (judged.pair.lift, judged.pair.fold)
    ]
    traces = figures.traces(
        folder / f"{name}_traces.png",
        estimate.losses,
        estimate.history,
        estimate.ranges,
        _truth(judged),
        f"{name}: loss and parameters",
    )
    return (*shown, (traces, f"{name}: loss and parameters of every start, by iteration."))


def _overlay(folder: Path, judged: Judged, recording: Recording) -> Path:
    info = recording.info
    frames = np.linspace(*info.frames_used, 5).round().astype(int)
    return figures.overlay(
        folder / f"{info.name}.png",
        [cloud(recording, int(frame)) for frame in frames],
        judged.before[info.scenario][frames],
        judged.after[info.scenario][frames],
        np.asarray(from_recording(recording).scene.mesh.faces),
        np.asarray(recording.times)[frames],
        info.name,
    )


def _overlay_caption(recording: Recording) -> str:
    seen = "unseen by the estimate" if recording.info.scenario == EVALUATED_ON else "estimated from"
    return (
        f"{recording.info.name} ({seen}): cloud over simulated sheet, with the default fabric "
        "above and the estimate below."
    )


def _truth(judged: Judged) -> np.ndarray | None:
    """The true parameters, where the fabric is known and the estimate has the same parameters."""
    truth, family = judged.pair.truth, OrthotropicFamily.make(judged.pair.density)
    if truth is None or judged.estimate.ranges != family.ranges:
        return None
    return np.asarray(family.values(family.locate(truth)))


def line_picture(out: Path, judged: Judged) -> tuple[Path, str] | None:
    """The loss along each parameter through the estimate; None for another family's estimate."""
    problem, estimate = problem_of(judged.pair), judged.estimate
    family = problem.family
    if estimate.ranges != family.ranges:
        return None
    losses_of = eqx.filter_jit(
        lambda problem, unknowns: jax.lax.map(
            lambda unknown: gauss_newton.loss_at((problem,), unknown), unknowns
        )
    )
    centre = np.asarray(family.locate(estimate.fabric))
    found = {c.name: c.value for c in estimate.conditions}
    names = zip((*SHARED, *OWN), problem.doubt.scales, strict=True)
    rest = np.array([found[name] / scale if scale else 0.0 for name, scale in names])
    places = np.linspace(0.02, 0.98, LINE_POINTS)
    lines = []
    for index, bound in enumerate(family.ranges):
        unknowns = np.tile(np.concatenate([centre, rest]), (LINE_POINTS, 1))
        unknowns[:, index] = places
        losses = np.asarray(losses_of(problem, jnp.asarray(unknowns, float)))
        lines.append((bound, np.asarray(bound.value(jnp.asarray(places, float))), losses))
    name = judged.pair.lift.info.name
    path = out / "figures" / f"{name}_lines.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    truth = _truth(judged)
    figures.loss_lines(path, lines, estimate.values, truth, f"{name}: loss along each parameter")
    return path, (
        f"{name}: the loss along each parameter, the others as estimated. Where it is flat, the "
        "motion does not determine the parameter."
    )


def summaries(judged: Sequence[Judged], rows: Sequence[Row], out: Path) -> list[Table]:
    """The tables of a study; also written to `out` as CSV and Markdown."""
    entries = [
        (j.pair.lift.info.name, j.estimate.ranges, j.estimate.values, j.estimate.deviations,
         j.estimate.determined, _truth(j))
        for j in judged
    ]  # fmt: skip
    shown = {f"{metric}_{EVALUATED_ON}": tables.pivot(rows, metric, EVALUATED_ON)
             for metric in METRICS}  # fmt: skip
    shown["parameters"] = tables.parameter_table(entries)
    folder = out / "tables"
    folder.mkdir(parents=True, exist_ok=True)
    for name, table in shown.items():
        write_text(folder / f"{name}.csv", tables.csv_text(table))
        write_text(folder / f"{name}.md", tables.markdown(table))
    return list(shown.values())


def publish(
    out: Path,
    judged: Sequence[Judged],
    rows: Sequence[Row],
    settings: dict[str, str],
    intro: str,
) -> list[Table]:
    """Tables, pictures and `report.html` of a study in `out`; returns the tables."""
    shown = summaries(judged, rows, out)
    drawn = [(j, picture(out, j)) for j in judged]
    lines = line_picture(out, judged[0])
    findings = Section("Results", _findings(judged, rows), tuple(shown), (_bars(out, rows),))
    sections = [findings]
    if lines is not None:
        sections.append(Section("How the loss sees the parameters", (), (), (lines,)))
    for item, pictures in drawn:
        sections.append(Section(item.pair.lift.info.name, (_took(item),), (), pictures))
    versions = {name: version(name) for name in ("r2s", "jax", "jaxlib", "equinox", "numpy")}
    write_report(out / "report.html", "r2s study", intro, settings | versions, sections)
    return shown


def _took(item: Judged) -> str:
    estimate = item.estimate
    return (
        f"{estimate.approach}: {estimate.seconds:.0f} s, compilation included where it was the "
        f"first; source: {item.pair.lift.info.source}."
    )


def _bars(out: Path, rows: Sequence[Row]) -> tuple[Path, str]:
    labels = {"": "estimate", "default": "default fabric", "other_fabric": "other fabric",
              "repeatability": "repeatability"}  # fmt: skip
    metric = METRICS[0]
    chosen = [r for r in rows if r.metric == metric and r.evaluated_on == EVALUATED_ON]
    names = list(dict.fromkeys(row.recording for row in chosen))
    values = {(row.recording, row.baseline): 1e3 * row.value for row in chosen}
    groups = {
        label: np.array([values.get((name, baseline), np.nan) for name in names])
        for baseline, label in labels.items()
    }
    folder = out / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    path = figures.bars(
        folder / "errors.png", names, groups, "real to simulation [mm]", "Error on the unseen fold"
    )
    return path, "Mean distance from the recording to the simulation in the unseen fold."


def _findings(judged: Sequence[Judged], rows: Sequence[Row]) -> tuple[str, ...]:
    """What the numbers say, in words."""
    mean = lambda baseline, metric: float(np.mean([
        row.value for row in rows
        if (row.baseline, row.metric, row.evaluated_on) == (baseline, metric, EVALUATED_ON)
    ] or [np.nan]))  # fmt: skip
    one_sided, both = METRICS[0], "chamfer_cropped"
    better = 1 - mean("", one_sided) / mean("default", one_sided)
    found = [
        f"Mean error on the unseen fold, recording to simulation: {1e3 * mean('', one_sided):.1f} "
        f"mm with the estimate, {1e3 * mean('default', one_sided):.1f} mm with the default fabric, "
        f"{1e3 * mean('other_fabric', one_sided):.1f} mm with the estimate of another fabric. The "
        f"estimate is {abs(better):.0%} {'below' if better >= 0 else 'above'} the default.",
        f"Both directions, above the height at which the recording is cut off: "
        f"{1e3 * mean('', both):.1f} mm, against {1e3 * mean('repeatability', both):.1f} mm "
        "between two trials of a fabric.",
    ]
    for item in judged:
        estimate = item.estimate
        if not np.any(np.isfinite(estimate.deviations)):
            continue
        names = [bound.name for bound in estimate.ranges]
        known = [n for n, d in zip(names, estimate.determined, strict=True) if d]
        rest = [n for n in names if n not in known]
        found.append(
            f"{item.pair.lift.info.name} determines {', '.join(known) or 'none of them'}; it does "
            f"not determine {', '.join(rest) or 'nothing else'}."
        )
        found += _unphysical(estimate)
    return tuple(found)


def _unphysical(estimate) -> list[str]:
    """Which parameters ended at a bound of their range."""
    places = [
        (np.log(v / b.low) / np.log(b.high / b.low)) if b.log else (v - b.low) / (b.high - b.low)
        for b, v in zip(estimate.ranges, estimate.values, strict=True)
    ]
    at_bound = [b.name for b, p in zip(estimate.ranges, places, strict=True) if not 0.01 < p < 0.99]
    return [f"At a bound of its range: {', '.join(at_bound)}."] if at_bound else []
