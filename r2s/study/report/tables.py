"""Tables of a report that hold text: means with their intervals, side by side by motion."""

from collections.abc import Callable, Iterable

import numpy as np
import pandas as pd

from r2s.study.configuration import ON_CLOTH
from r2s.study.statistics.frame import CONFIGURATION, motions
from r2s.study.statistics.means import means

MISSING = "-"


def significant(value: float) -> str:
    """A number with three significant digits, without an exponent from 1e-4 up to 1e6."""
    rounded = float(f"{value:.3g}")
    if 1e3 <= abs(rounded) < 1e6:  # "g" would write 1.23e+03
        return f"{rounded:.0f}"
    return f"{rounded:#.3g}".removesuffix(".")


def mean_text(row: pd.Series, write: Callable[[float], str]) -> str:
    """A mean with its interval, from a row of `means`; where runs diverged how many, and the
    median."""
    if row.diverged:
        median = f", median {write(row['median'])}" if np.isfinite(row["median"]) else ""
        return f"{row.diverged:.0f} of {row.runs:.0f} diverged{median}"
    ends = f" [{write(row.low)}, {write(row.high)}]" if row.low < row.high else ""
    return write(row["mean"]) + ends


def millimetres(metres: float) -> str:
    """A length [m] in millimetres to a tenth; below one to a hundredth."""
    return f"{1e3 * metres:.1f}" if abs(metres) >= 0.995e-3 else f"{1e3 * metres:.2f}"


def skill_table(errors: pd.DataFrame, skills: pd.DataFrame) -> pd.DataFrame:
    """Error, floor and skill by motion, a line a configuration; from `means.means` and
    `means.skills`."""
    columns: dict[str, dict[str, str]] = {}
    for (label, motion), row in skills.iterrows():
        skill = mean_text(row, "{:.2f}".format) if row.runs > 0 else "not known"
        if str(label).startswith("default "):
            skill = "0"
        elif 0 < row.known < row.judged:
            skill += f", known in {row.known:.0f} of {row.judged:.0f}"
        cells = {
            "error [mm]": mean_text(errors.loc[(label, motion)], millimetres),
            "floor [mm]": f"{1e3 * row.floor:.2f}",
            "skill": skill,
        }
        for name, text in cells.items():
            columns.setdefault(f"{motion}: {name}", {})[str(label)] = text
    order = dict.fromkeys(map(str, skills.index.get_level_values("configuration")))
    return _by_configuration(pd.DataFrame(columns), order)


def mean_table(results: pd.DataFrame, column: str) -> pd.DataFrame:
    """Means with intervals, a line a configuration, a column for each value of `column`
    ("evaluated_on" or "metric"); metres are in millimetres."""
    columns = {}
    names = motions(results) if column == "evaluated_on" else dict.fromkeys(results.metric)
    for name in names:
        part = results[results[column] == name].assign(evaluated_on=name)
        unit = part.unit.iloc[0]
        write = millimetres if unit == "m" else significant
        columns[f"{name} [{'mm' if unit == 'm' else unit}]"] = {
            str(label): mean_text(row, write) for (label, _), row in means(part).iterrows()
        }
    return _by_configuration(pd.DataFrame(columns), results.configuration.cat.categories)


def _by_configuration(table: pd.DataFrame, order: Iterable[str]) -> pd.DataFrame:
    """A table of text by configuration, in some order, with that as its first column."""
    table = table.reindex([label for label in order if label in table.index]).fillna(MISSING)
    return table.rename_axis("configuration").reset_index()


def recording_table(results: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Errors [mm] in given recordings one by one, beside what they are compared with.

    Recordings that are given have an estimate of another fabric beside their own; there are none
    of synthetic ones. Of an estimate the first repeat counts, of the default all draws.
    """
    own = results[(results.metric == metric) & (results.baseline != ON_CLOTH)]
    whose = own[own.baseline == "other_fabric"][CONFIGURATION].drop_duplicates()
    place, found = ["evaluated_on", "fabric", "recording"], [pd.DataFrame()]
    for configuration in whose.itertuples(index=False):
        is_own = (own[CONFIGURATION] == list(configuration)).all(axis=1)
        part = own[is_own | (own.approach == "") & own.solver.isin(("", configuration.solver))]
        part = part[(part.baseline == "default") | ~part.duplicated([*place, "baseline"])]
        table = 1e3 * part.pivot_table(index=place, columns="baseline", values="value")
        table = table.rename(columns={"": "estimate"}).reset_index().rename_axis(columns=None)
        found.append(table.assign(configuration=" ".join(configuration)))
    return pd.concat(found)
