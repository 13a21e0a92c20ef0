"""Tables of a report, as text: made from the tables of numbers that the analysis returns."""

from collections.abc import Callable

import numpy as np
import pandas as pd
from scipy.stats import norm

from r2s.evaluation.statistics import LEVEL
from r2s.study.configuration import ON_CLOTH
from r2s.study.statistics.comparisons import UNKNOWN
from r2s.study.statistics.frame import motions
from r2s.study.statistics.means import means
from r2s.study.statistics.ranks import Ranks

MISSING = "-"


def significant(value: float) -> str:
    """A number with three significant digits, without an exponent from 1e-4 up to 1e6."""
    rounded = float(f"{value:.3g}")
    if 1e3 <= abs(rounded) < 1e6:  # "g" would write 1.23e+03
        return f"{rounded:.0f}"
    return f"{rounded:#.3g}".removesuffix(".")


def millimetres(metres: float) -> str:
    """A length [m] in millimetres to a tenth; below one to a hundredth."""
    return f"{1e3 * metres:.1f}" if abs(metres) >= 0.995e-3 else f"{1e3 * metres:.2f}"


def mean_text(row: pd.Series, write: Callable[[float], str]) -> str:
    """A mean with its interval, of a row of `means`; where runs diverged how many."""
    if row.isna().all() or not row.runs > 0:
        return MISSING
    if row.diverged:
        median = f", median {write(row['median'])}" if np.isfinite(row["median"]) else ""
        return f"{row.diverged:.0f} of {row.runs:.0f} diverged{median}"
    return _with_ends(row["mean"], row.low, row.high, write)


def _with_ends(value: float, low: float, high: float, write: Callable[[float], str]) -> str:
    return write(value) + (f" [{write(low)}, {write(high)}]" if low < high else "")


def skill_table(errors: pd.DataFrame, skills: pd.DataFrame) -> pd.DataFrame:
    """Error, floor and skill by motion, a line a configuration; from `means.means` and
    `means.skills`."""
    columns: dict[str, dict[str, str]] = {}
    for (label, motion), row in skills.iterrows():
        skill = "not known" if not row.runs > 0 else mean_text(row, "{:.2f}".format)
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
    order = list(dict.fromkeys(map(str, skills.index.get_level_values("configuration"))))
    found = pd.DataFrame(columns).reindex(order).fillna(MISSING)
    return found.rename_axis("configuration").reset_index()


def by_fabric(results: pd.DataFrame) -> pd.DataFrame:
    """Mean errors [mm] and skills of each fabric, from what `means.with_floor` returns."""
    keys = ["fabric", "evaluated_on", "configuration"]
    own = results.assign(value=results.value.where(~results.diverged, np.inf))
    found = own.groupby(keys, observed=True)[["value", "floor", "skill"]].mean().reset_index()
    for name in ("value", "floor"):
        found[name] = found[name].map(lambda x: millimetres(x) if np.isfinite(x) else "diverged")
    found["skill"] = found.skill.map(lambda x: MISSING if np.isnan(x) else f"{x:.2f}")
    return found.rename(
        columns={"evaluated_on": "motion", "value": "error [mm]", "floor": "floor [mm]"}
    )


def mean_table(results: pd.DataFrame, column: str) -> pd.DataFrame:
    """Means with intervals, a line a configuration, a column for each value of `column`
    ("evaluated_on" or "metric"); metres are in millimetres."""
    parts = {}
    for name in motions(results) if column == "evaluated_on" else list(dict.fromkeys(results.metric)):
        part = results[results[column] == name]
        is_length = set(part.unit) == {"m"}
        found = means(part.assign(evaluated_on=name))
        unit = "mm" if is_length else part.unit.iloc[0]
        write = millimetres if is_length else significant
        texts = found.apply(mean_text, axis=1, write=write) if len(found) else {}
        parts[f"{name} [{unit}]"] = texts.droplevel("evaluated_on")
    found = pd.DataFrame({name: each.astype(object) for name, each in parts.items()})
    return found.fillna(MISSING).rename_axis("configuration").reset_index()


def finding_table(judged: pd.DataFrame) -> pd.DataFrame:
    """What `comparisons.judge` found, in text."""
    rows = []
    for row in judged.itertuples():
        is_known, lost = not row.lacking, (row.diverged_smaller, row.diverged_larger)
        needed = MISSING
        if is_known and row.answer == UNKNOWN:
            ends = [f"{n:.0f}" if np.isfinite(n) else "over 1000" for n in
                    (row.needed, row.fewest, row.most)]  # fmt: skip
            needed = f"{ends[0]} ({ends[1]} to {ends[2]})" if row.fabrics > 1 else "not known"
        rows.append({
            "conclusion": row.conclusion,
            "comparison": row.comparison,
            "answer": row.answer if is_known else f"{row.answer}: {row.lacking}",
            "ratio": f"{row.ratio:.2f}" if np.isfinite(row.ratio) and is_known else MISSING,
            f"{LEVEL:.0%} interval": f"{row.low:.2f} to {row.high:.2f}" if row.low < row.high
            else MISSING,
            "p (Holm)": f"{row.p_holm:.2g}" if np.isfinite(row.p_holm) else MISSING,
            "fabrics that agree": f"{row.agreeing} of {row.fabrics}" if is_known else MISSING,
            "diverged": f"{lost[0]} and {lost[1]}" if any(lost) else MISSING,
            "fabrics needed": needed,
            "paper (CD)": f"{row.paper_smaller:.3f} against {row.paper_larger:.3f}"
            if np.isfinite(row.paper_smaller) else MISSING,
        })  # fmt: skip
    return pd.DataFrame(rows)


def learned_table(judged: pd.DataFrame) -> pd.DataFrame:
    """What `comparisons.learned` found, in text: the error over that of the prior's middle."""
    texts = [
        row.lacking
        or _with_ends(1 / row.ratio, 1 / row.high, 1 / row.low, "{:.2f}".format)
        + (f", p {row.p_holm:.2g}" if np.isfinite(row.p_holm) else "")
        + f"; {row.agreeing} of {row.fabrics}"
        + (f"; diverged: {row.diverged_smaller} and {row.diverged_larger}"
           if row.diverged_smaller or row.diverged_larger else "")
        for row in judged.itertuples()
    ]  # fmt: skip
    found = judged.assign(text=texts).pivot(index="conclusion", columns="comparison", values="text")
    found = found.loc[judged.conclusion.unique(), judged.comparison.unique()].fillna("not known")
    return found.rename_axis("configuration").rename_axis(columns=None).reset_index()


def rank_table(found: dict[str, Ranks]) -> pd.DataFrame:
    """Mean ranks by motion with their intervals, and how often a configuration is the best."""

    def text(row: pd.Series) -> str:
        mean = _with_ends(row["mean"], row.low, row.high, "{:.2f}".format)
        return f"{mean}, {row['first']:.0%}"

    columns = {}
    for motion, ranks in found.items():
        columns[motion] = ranks.table.apply(text, axis=1).astype(object)
        columns[motion].index = columns[motion].index.astype(str)
    order = dict.fromkeys(label for each in reversed(columns.values()) for label in each.index)
    return pd.DataFrame(columns).reindex(list(order)).fillna(MISSING).rename_axis("configuration").reset_index()


def parameter_table(parameters: pd.DataFrame) -> pd.DataFrame:
    """Estimates with their intervals and truths: a line an estimate, a column a parameter.

    `parameters`: from `r2s.study.results.parameters`.
    """
    reach = norm.ppf((1 + LEVEL) / 2) * parameters.standard_error
    factor = np.exp(reach.clip(upper=50))
    low = np.where(parameters.is_log, parameters.value / factor, parameters.value - reach)
    high = np.where(parameters.is_log, parameters.value * factor, parameters.value + reach)
    texts = []
    for row, *ends in zip(parameters.itertuples(), low, high, strict=True):
        text = _with_ends(row.value, *ends, significant) if row.is_identifiable else (
            f"not identified (best fit {significant(row.value)})"
        )  # fmt: skip
        texts.append(text + ("" if np.isnan(row.truth) else f"; truth {significant(row.truth)}"))
    units = [f" [{unit}]" if unit not in ("", "-") else "" for unit in parameters.unit]
    named = parameters.assign(text=texts, name=parameters.parameter + units)
    found = named.pivot(index="recording", columns="name", values="text")
    found = found.loc[named.recording.unique(), named.name.unique()].fillna(MISSING)
    return found.rename_axis(columns=None).reset_index()


def recording_table(results: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Errors [mm] in given recordings one by one, beside what they are compared with.

    Recordings that are given have an estimate of another fabric beside their own; there are none
    of synthetic ones. Of an estimate the first repeat counts, of the default all draws.
    """
    own = results[(results.metric == metric) & (results.baseline != ON_CLOTH)]
    estimates = own[own.approach != ""].copy()
    whose = estimates[estimates.baseline == "other_fabric"]
    keys = ["approach", "solver", "estimated_from"]
    found = []
    for configuration in whose[keys].drop_duplicates().itertuples(index=False):
        is_own = (own[keys] == list(configuration)).all(axis=1)
        beside = (own.approach == "") & own.solver.isin(("", configuration.solver))
        part = own[is_own | beside]
        place = ["evaluated_on", "fabric", "recording"]
        part = part[(part.baseline == "default") | ~part.duplicated([*place, "baseline"])]
        table = part.pivot_table(index=place, columns="baseline", values="value", dropna=False)
        table = (1e3 * table).rename(columns={"": "estimate"}).dropna(how="all").round(1)
        label = " ".join(configuration)
        found.append(table.reset_index().assign(configuration=label).rename_axis(columns=None))
    return pd.concat(found) if found else pd.DataFrame()
