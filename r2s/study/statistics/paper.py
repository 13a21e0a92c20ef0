"""The tables of the paper (Ru et al. 2025), from a folder that the user has, beside ours.

Its numbers are not part of this package: the folder has `folding.csv`, `fling.csv` and
`shaking.csv`. Their header is `metric,fabric` and then one name for each configuration, such as
`diffcloud-diffsim-lifting`; `metric` is CD or HD.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from r2s.study.configuration import MOTIONS, Configuration

CITED = "Ru et al. 2025, tables"
SOLVERS = {"diffsim": "cloth", "difftaichi": "points"}
CHAMFER, HAUSDORFF = "paper_chamfer", "paper_hausdorff"
METRICS = {"CD": CHAMFER, "HD": HAUSDORFF}
COLUMNS = ["evaluated_on", "metric", "fabric", "configuration", "value"]


def read_paper(folder: Path | str | None) -> pd.DataFrame:
    """Read the paper's three tables as one with `COLUMNS`; it is empty without a folder.

    Lines of averages are left out. Raises FileNotFoundError, or a ValueError that names the file
    and what is wrong: another header, an unknown configuration or metric, a fabric given twice, a
    cell that is missing or no positive number.
    """
    tables = [] if folder is None else [_read(Path(folder), motion) for motion in MOTIONS]
    return (
        pd.concat([pd.DataFrame(columns=COLUMNS), *tables])
        if tables
        else pd.DataFrame(columns=COLUMNS)
    )


def _read(folder: Path, motion: str) -> pd.DataFrame:
    path = folder / f"{motion}.csv"
    try:
        table = pd.read_csv(path, dtype=str)
        if list(table.columns[:2]) != ["metric", "fabric"] or len(table.columns) < 3:
            raise ValueError(f"expected metric,fabric,COLUMNS, found {','.join(table.columns)}")
        if unknown := set(table.metric) - set(METRICS):
            raise ValueError(f"expected the metric CD or HD, found {min(unknown)!r}")
        table = table[table.fabric != "Average"]
        if (twice := table.duplicated(["metric", "fabric"])).any():
            raise ValueError(f"{' of '.join(table[twice].iloc[0, :2])} is given twice")
        found = table.melt(["metric", "fabric"], var_name="configuration")
        numbers = pd.to_numeric(found.value, errors="coerce")
        if not (is_right := (numbers > 0) & np.isfinite(numbers)).all():
            metric, fabric, _, text = found[~is_right].iloc[0]
            raise ValueError(f"{metric} of {fabric}: expected a number above zero, found {text!r}")
        labels = {name: _configuration(name).label for name in table.columns[2:]}
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    fabrics = found.fabric.str.strip().str.lower().str.replace(" ", "_")
    return found.assign(
        evaluated_on=motion,
        metric=found.metric.map(METRICS),
        fabric=fabrics,
        configuration=found.configuration.map(labels),
        value=numbers,
    )[COLUMNS]


def _configuration(name: str) -> Configuration:
    parts = name.split("-")
    if len(parts) != 3 or parts[1] not in SOLVERS:
        known = " or ".join(SOLVERS)
        raise ValueError(f"expected APPROACH-SIMULATOR-SCENARIO with {known}, found {name!r}")
    return Configuration(parts[0], SOLVERS[parts[1]], parts[2])


def average(
    paper: pd.DataFrame, motion: str, whose: Sequence[Configuration], metric: str = CHAMFER
) -> float:
    """The paper's mean over fabrics and configurations, [-]; NaN when one is not there."""
    part = paper[(paper.evaluated_on == motion) & (paper.metric == metric)]
    means = part.groupby("configuration").value.mean()
    labels = [each.label for each in whose]
    if not labels or not set(labels) <= set(means.index):
        return np.nan
    return float(means[labels].mean())


def beside_paper(results: pd.DataFrame, paper: pd.DataFrame, motion: str) -> pd.DataFrame:
    """The Chamfer distances of one motion in the paper's units [-], ours beside the paper's: a
    column a configuration, a line a fabric, last their mean; infinite where a run diverged.

    `results`: from `frame.labelled`.
    """
    own = results[(results.metric == CHAMFER) & (results.evaluated_on == motion)]
    own = own[own.baseline.isin(("", "default"))]
    ours = own.assign(value=own.value.where(~own.diverged, np.inf)).pivot_table(
        index="fabric", columns="configuration", values="value", observed=True
    )
    part = paper[(paper.evaluated_on == motion) & (paper.metric == CHAMFER)]
    theirs = part.pivot_table(index="fabric", columns="configuration", values="value")
    theirs.columns = [f"{label}, paper" for label in theirs.columns]
    ours.columns = list(map(str, ours.columns))
    table = pd.concat([ours, theirs], axis=1)
    table.loc["mean"] = table.mean()
    return table.rename_axis("fabric").reset_index()
