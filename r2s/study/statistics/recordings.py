"""Tables of recorded data: each recording's error beside what it is compared with."""

from collections.abc import Sequence

import numpy as np

from r2s.study.configuration import ON_CLOTH, Configuration
from r2s.study.rows import BASELINES, Row
from r2s.study.tables import MISSING, Table

METRIC = "chamfer_real_to_sim"  # in metres, shown in millimetres


def recording_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """A table for each configuration and scenario: a line a recording, last their means.

    Beside each recording's error stand those of the other `BASELINES` that there are. There are
    tables of given recordings alone, where an estimate is judged by what belongs to it. Where
    several estimates are judged by one recording, the first counts.
    """
    configurations = dict.fromkeys(
        Configuration(row.approach, row.solver, row.estimated_from)
        for row in rows
        if row.approach and row.baseline == "other_fabric"
    )
    found = {}
    for configuration in configurations:
        theirs = [row for row in rows if row.metric == METRIC and _belongs(row, configuration)]
        for scenario in dict.fromkeys(row.evaluated_on for row in theirs):
            table = _table(configuration, [r for r in theirs if r.evaluated_on == scenario])
            found[f"{'_'.join(configuration)}_on_{scenario}"] = table
    return found


def _belongs(row: Row, configuration: Configuration) -> bool:
    """Whether a row is of a configuration, or of what it is compared with."""
    approach, solver, scenario = configuration
    source = row.approach, row.estimated_from
    return (
        row.baseline != ON_CLOTH
        and source in ((approach, scenario), ("", ""))
        and row.solver in (solver, "")
    )


def _table(configuration: Configuration, rows: Sequence[Row]) -> Table:
    every: dict[tuple[str, str], dict[str, list[float]]] = {}
    for row in rows:
        places = every.setdefault((row.fabric, row.recording), {})
        places.setdefault(row.baseline, []).append(row.value)
    # of estimates the first, of the default all draws
    errors = {
        which: {
            baseline: float(np.mean(values if baseline == "default" else values[:1]))
            for baseline, values in found.items()
        }
        for which, found in every.items()
    }
    lines = list(errors.values())
    names = [each for each in BASELINES if each != ON_CLOTH]  # all are on one solver
    of_all = [_mean([each[name] for each in lines if name in each]) for name in names]
    return Table(
        header=("fabric", "recording", *(f"{BASELINES[name]} [mm]" for name in names)),
        rows=(
            *((*which, *_cells(line, names)) for which, line in errors.items()),
            ("mean", "", *of_all),
        ),
        caption=f"{configuration.label}: {METRIC} [mm] on {rows[0].evaluated_on}",
        foot=1,
    )


def _cells(line: dict[str, float], names: Sequence[str]) -> list[str]:
    return [_shown(line[name]) if name in line else MISSING for name in names]


def _mean(values: Sequence[float]) -> str:
    """The mean; where some diverged how many, for what is left says nothing of them."""
    lost = int((~np.isfinite(values)).sum())
    if lost:
        return f"{lost} of {len(values)} diverged"
    return _shown(float(np.mean(values))) if len(values) else MISSING


def _shown(value: float) -> str:
    return f"{1e3 * value:.1f}" if np.isfinite(value) else "diverged"
