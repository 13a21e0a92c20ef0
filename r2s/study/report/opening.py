"""What a report begins with: error over time, sheets at the frames that decide, skill."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from r2s.study.configuration import MOTIONS
from r2s.study.report import overlays
from r2s.study.report.error_over_time import error_picture
from r2s.study.report.figures import Looks
from r2s.study.report.motions import MotionComparison, deciding_frame
from r2s.study.report.page import Section
from r2s.study.report.sections import Keep
from r2s.study.report.skill_chart import skill_chart
from r2s.study.report.skill_table import (
    beyond_tables,
    learned_table,
    needed_table,
    skill_table,
)
from r2s.study.rows import Row
from r2s.study.statistics.skills import skills, with_floor
from r2s.study.tables import Table
from r2s.study.verdicts import BEYOND, SURFACE

NO_FLOOR = (
    "Recordings that have no ensemble of truths have neither floor nor horizon, and no skill is "
    "told of them: "
)
OVER_TIME = (
    "The mean distance of a recording's points from each simulated surface. Within the sand-"
    "coloured floor no approach can be told to be nearer; beyond the horizon, pale here, an error "
    "says nothing about a fabric. Lines are dashed for material points; where there are several "
    "estimates, or draws of the default, they are the mean of all, in their range."
)
SHEETS = (
    "Before the horizon, the frame at which what is compared is farthest apart in error: the "
    "configurations, or where there is one alone, it and the fabrics to compare with. Of several "
    "estimates or draws the sheet is that of the one in the middle, the number the mean error of "
    "all. The recorded points are alone in the last panel."
)


def picture_sections(out: Path, motions: Sequence[MotionComparison], looks: Looks) -> list[Section]:
    """A picture of error over time, and of the sheets, for each recording of `motions`."""
    if not motions:
        return []
    errors, sheets, left_out = [], [], []
    for each in overlays.in_order(motions):
        frame, name = deciding_frame(each), f"{each.evaluated_on}_{each.fabric}".replace("/", "_")
        what = f"{each.evaluated_on}, {each.fabric.replace('_', ' ')}"
        path = error_picture(out / "figures" / f"errors_{name}.png", each, looks, frame)
        errors.append((path, f"{what} ({each.recording}): {_horizon_words(each)}."))
        if frame is None:
            left_out.append(each.recording)
            continue
        path = overlays.sheets(out / "figures" / f"sheets_{name}.png", each, frame, looks)
        sheets.append((path, f"{what}: at {each.times[frame]:.2f} s; {_horizon_words(each)}."))
    unknown = [each.recording for each in motions if each.horizon is None]
    words = [OVER_TIME] + ([f"{NO_FLOOR}{_names(unknown)}."] if unknown else [])
    shown = [SHEETS]
    if left_out:
        shown.append(f"No frame can be compared before the horizon of {_names(left_out)}.")
    return [
        Section("Error over time", tuple(words), figures=tuple(errors), beside=True),
        Section("Sheets at the frames that decide", tuple(shown), figures=tuple(sheets)),
    ]


def _horizon_words(comparison: MotionComparison) -> str:
    if comparison.horizon is None:
        return "no horizon is known"
    if comparison.horizon == float("inf"):
        return "the horizon is never reached"
    return f"the horizon is at {comparison.horizon:.2f} s"


def skill_sections(
    out: Path, rows: Sequence[Row], others: Mapping[str, Sequence[Row]], looks: Looks, keep: Keep
) -> list[Section]:
    """Error, floor and skill by approach; and what is compared beyond the horizon.

    `others`: the rows of each fabric of which not every configuration has an estimate, and that is
    not in `rows`: each has a table of its own.
    """
    known = with_floor(rows, SURFACE)
    judged = {row.recording for row in rows if row.metric == SURFACE}
    without = judged - {row.recording for row in known}
    if not known:
        # Where pictures are shown they say so.
        return []
    found = {motion: skills(known, motion) for motion in MOTIONS}
    found = {motion: each for motion, each in found.items() if each}
    fabrics = list(dict.fromkeys(row.fabric for row in known))
    words = [
        f"Fabrics that have floors: {_names(fabrics)}. Rows of the true fabric have the truth's "
        "stiffness at small strain, constant, on that solver: an estimate of what stiffness is on "
        "average, or of laws that change with the strain, may come nearer. The default knows the "
        "fabric's weight alone, and its "
        "draws show by how much that varies; the middle of the prior is the best guess by it. "
        "Where an approach knows that prior (DIFFCLOUD on the cloth), it has learned what it has "
        "beyond that: the second table."
    ]
    if len(fabrics) < 2:
        words.append("There are no intervals: one fabric has no spread between fabrics.")
    apart = {fabric: with_floor(theirs, SURFACE) for fabric, theirs in others.items()}
    if others:
        words.append(
            f"Not every configuration has an estimate of {_names(list(others))}: what has a floor "
            "has a table of its own."
        )
    if without:
        words.append(
            f"Not among these are {len(without)} recordings that have no frame before a horizon, "
            f"or no ensemble of truths: {_names(sorted(without))}."
        )
    path = skill_chart(out / "figures" / "skill.png", found, looks)
    tables = {"skill": skill_table(known, SURFACE), "learned": learned_table(known, SURFACE),
              "skill_needed": needed_table(known)}  # fmt: skip
    for fabric, theirs in apart.items():
        tables[f"skill_{fabric}"] = _of_fabric(fabric, theirs) if theirs else None
    shown = tuple(keep(name, table) for name, table in tables.items() if table)
    caption = "Skill of every configuration: 0 is the default, 1 the floor."
    sections = [Section("Skill", tuple(words), shown, ((path, caption),))]
    beyond = tuple(keep(name, table) for name, table in beyond_tables(rows, BEYOND).items())
    if beyond:
        text = (
            "From the horizon on motions are out of phase whatever the fabric. What is compared "
            "there are extents, sag, area covered seen from above, speed and mean frequency: the "
            "differences between simulation and recording, means over those frames. They have no "
            "floor, so whether a difference says something of a fabric is told by the rows of the "
            "true fabric and the default beside it. Folds begin here where their layers touch, "
            "which predictions do not have."
        )
        sections.append(Section("Beyond the horizon", (text,), beyond))
    return sections


def _of_fabric(fabric: str, rows: Sequence[Row]) -> Table:
    table = skill_table(rows, SURFACE)
    return replace(table, caption=f"Of {fabric} alone. {table.caption}")


def _names(names: Sequence[str], most: int = 12) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
