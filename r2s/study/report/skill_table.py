"""Tables of error, floor and skill by approach, and of what is compared beyond the horizon."""

from collections.abc import Sequence

import numpy as np

from r2s.evaluation.horizon import CLEAR
from r2s.evaluation.statistics import LEVEL, SIGNIFICANCE
from r2s.study.configuration import MOTIONS
from r2s.study.rows import Row, by_metric
from r2s.study.statistics.distances import cells_of, millimetres, with_references
from r2s.study.statistics.hypotheses import Verdict
from r2s.study.statistics.learned import learned
from r2s.study.statistics.result_array import configurations_of, on_motion, result_array
from r2s.study.statistics.skills import Draws, Skill, draws, mean_floor, skills
from r2s.study.tables import MISSING, Table, significant


def skill_table(rows: Sequence[Row], metric: str) -> Table:
    """A line a configuration, a reference and the default; by motion error, floor and skill.

    `rows`: what `r2s.study.statistics.skills.with_floor` returns, in metres.
    """
    motions = [motion for motion in MOTIONS if any(row.evaluated_on == motion for row in rows)]
    lines = {c: [c.label] for c in configurations_of(rows)}
    for motion in motions:
        errors = cells_of(on_motion(result_array(rows, metric), motion))
        told = skills(rows, motion)
        for configuration, line in lines.items():
            if configuration not in errors:
                line += [MISSING] * 3
                continue
            error, own = errors[configuration], skill_words(told[configuration])
            if not configuration.approach:
                spread = draws(rows, motion, configuration)
                error, own = _with_draws(error, spread)
            line += [error, f"{1e3 * mean_floor(rows, motion, configuration):.2f}", own]
    header = [
        f"{motion}: {what}" for motion in motions for what in ("error [mm]", "floor [mm]", "skill")
    ]
    caption = (
        f"Error ({metric}, within the horizon), floor and skill: means over fabrics of the means "
        f"over recordings and repeats, with {LEVEL:.0%} intervals for fabrics like these, where "
        "there are two or more. Skill is (default - error) / (default - floor), 1 at the floor and "
        f"0 for the default; it is not told where the default is not above {CLEAR:g} times the "
        "floor. A run that diverged has an infinite error and a skill of minus infinity."
    )
    return Table(("configuration", *header), tuple(map(tuple, lines.values())), caption)


def needed_table(rows: Sequence[Row]) -> Table:
    """How many fabrics would tell each skill from the default's."""
    motions = [motion for motion in MOTIONS if any(row.evaluated_on == motion for row in rows)]
    found = {motion: skills(rows, motion) for motion in motions}
    lines = [
        (c.label, *(_needed_words(found[m][c]) if c in found[m] else MISSING for m in motions))
        for c in configurations_of(rows)
        if c.approach
    ]
    caption = (
        f"Fabrics that would tell a skill like this from zero, the default's (p < {SIGNIFICANCE}, "
        "power 80 %), with the spread between fabrics as it was found, and with the ends of its "
        "own interval; of how many there are."
    )
    return Table(("configuration", *motions), tuple(lines), caption)


def learned_table(rows: Sequence[Row], metric: str) -> Table | None:
    """What estimates add to the middle of the prior; None where it does not stand beside them."""
    found = learned(rows, metric)
    motions = [motion for motion in MOTIONS if any(motion in each for each in found.values())]
    if not motions:
        return None
    lines = [
        (configuration.label, *(_learned_words(of_motion.get(motion)) for motion in motions))
        for configuration, of_motion in found.items()
    ]
    caption = (
        f"Error ({metric}, within the horizon) over that of the middle of the prior on the same "
        f"solver: geometric means over fabrics with {LEVEL:.0%} intervals, p (Student's t over "
        "fabrics, Holm's correction over this table), and in how many fabrics the error is the "
        "smaller one. Below 1, the recording has taught more than the fabric's weight tells. Of "
        "recordings in which skill is told; runs that diverged have no ratio, and are counted."
    )
    return Table(("configuration", *motions), tuple(lines), caption)


def beyond_tables(rows: Sequence[Row], prefix: str) -> dict[str, Table]:
    """By motion: how much each configuration's motion differs, from the horizon on, in what does
    not depend on the phase.

    `prefix`: of the metrics that count, whose names go on with that of the feature.
    """
    chosen = with_references(row for row in rows if row.metric.startswith(prefix))
    chosen = [row for row in chosen if row.baseline in ("", "default")]
    found = {}
    for motion in MOTIONS:
        rows_of = by_metric(row for row in chosen if row.evaluated_on == motion)
        if not rows_of:
            continue
        columns, header = [], []
        for metric, theirs in rows_of.items():
            results = result_array(theirs, metric)
            columns.append(cells_of(results))
            header.append(
                f"{metric.removeprefix(prefix)} [{'mm' if results.unit == 'm' else results.unit}]"
            )
        lines = [
            (c.label, *(column.get(c, MISSING) for column in columns))
            for c in configurations_of(chosen)
            if any(c in column for column in columns)
        ]
        recordings = {row.recording for row in chosen if row.evaluated_on == motion}
        caption = (
            f"{motion}, from the horizon on (of {len(recordings)} recordings): how much simulation "
            f"and recording differ, mean and {LEVEL:.0%} interval over fabrics"
        )
        found[f"beyond_{motion}"] = Table(("configuration", *header), tuple(lines), caption)
    return found


def skill_words(found: Skill) -> str:
    """A skill and its interval, where there is one; what diverged, and where it is not told."""
    if not found.runs:
        return "not told"
    part = f", told in {found.told} of {found.judged}" if found.told < found.judged else ""
    if found.diverged:
        lost = f"{found.diverged} of {found.runs} diverged"
        return f"{_number(found.mean)} ({lost}, median {_number(found.median)}){part}"
    ends = f" [{_number(found.low)}, {_number(found.high)}]" if found.low < found.high else ""
    return f"{_number(found.mean)}{ends}{part}"


def _learned_words(verdict: Verdict | None) -> str:
    if verdict is None:
        return "not told"
    (comparison,), (p,) = verdict.claim.comparisons, verdict.corrected
    if comparison.lacking:
        return comparison.lacking
    low, high = (1 / end for end in reversed(comparison.ends))
    ends = f" [{low:.2f}, {high:.2f}], p {p:.2g}" if np.isfinite(low) else ""
    own, middles = comparison.diverged
    lost = f"; diverged: {own} and {middles}" if own or middles else ""
    return (
        f"{1 / comparison.ratio:.2f}{ends}; {comparison.agreeing} of {comparison.found.units}{lost}"
    )


def _needed_words(found: Skill) -> str:
    if not found.runs:
        return "not told"
    if found.diverged:
        return f"{found.diverged} of {found.runs} diverged"
    if found.found.units < 2:
        return "the spread takes two fabrics or more"
    likely, fewest, most = map(_count, found.needed)
    return f"{likely} ({fewest} to {most}); {found.found.units} are there"


def _count(number: float) -> str:
    return f"{number:.0f}" if np.isfinite(number) else "above 1000"


def _with_draws(error: str, spread: Draws) -> tuple[str, str]:
    """The default's error with the spread of its draws, and that of its skill around zero."""
    low, high = (
        millimetres(1e3 * end) if np.isfinite(end) else "diverged" for end in spread.errors
    )
    least, most = map(_number, spread.skills)
    told = "not told" if np.isnan(spread.skills[0]) else f"0; draws {least} to {most}"
    return f"{error}; draws {low} to {high}", told


def _number(value: float) -> str:
    return significant(value) if abs(value) >= 100 and np.isfinite(value) else f"{value:.2f}"
