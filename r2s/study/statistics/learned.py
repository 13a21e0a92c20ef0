"""What an estimate adds to knowing the weight alone: its error beside that of the prior's middle.

An approach that knows the prior of fabrics can do as well as its middle by learning nothing, so
this and not the skill (which is told against random draws of that prior) says what a recording
has taught.
"""

from collections.abc import Sequence

from r2s.study.configuration import REFERENCES, Configuration
from r2s.study.rows import Row
from r2s.study.statistics.hypotheses import Claim, Verdict, compare, judge
from r2s.study.statistics.result_array import by_motion, result_array


def learned(rows: Sequence[Row], metric: str) -> dict[Configuration, dict[str, Verdict]]:
    """By configuration and motion: whether its errors are below those of the prior's middle on the
    same solver, in the recordings that tell a skill; corrected for all that is compared here.

    `rows`: what `r2s.study.statistics.skills.with_floor` returns. The true fabric is among the
    configurations: it says what there is to learn. What has no middle beside it is left out.
    """
    told = result_array([row for row in rows if row.skill is not None], metric)
    compared = [
        (configuration, motion, compare(motion, results, [configuration], [middle]))
        for motion, results in by_motion(told).items()
        for configuration in results.configurations
        if configuration.approach not in ("", REFERENCES["middle"])
        and (middle := Configuration(REFERENCES["middle"], configuration.solver, ""))
        in results.configurations
    ]
    verdicts = judge([Claim("", (comparison,)) for *_, comparison in compared])
    found: dict[Configuration, dict[str, Verdict]] = {}
    for (configuration, motion, _), verdict in zip(compared, verdicts, strict=True):
        found.setdefault(configuration, {})[motion] = verdict
    return {each: found[each] for each in told.configurations if each in found}
