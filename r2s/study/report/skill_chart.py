"""A chart of skills by configuration.

Needs matplotlib: pip install 'r2s[study]'.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from r2s.evaluation.statistics import LEVEL
from r2s.study.configuration import Configuration
from r2s.study.report.figures import INK, VERMILION, Figure, Looks, save
from r2s.study.statistics.skills import Skill

LEFT, RIGHT = -1.5, 1.25  # ends of the scale


def skill_chart(
    path: Path | str, found: Mapping[str, Mapping[Configuration, Skill]], looks: Looks
) -> Path:
    """Draw the skill of every configuration with its interval, a panel for each motion.

    What lies below the scale is an arrow; what diverged, and what is not told, is said in words.
    Returns `path`; an OSError names it.
    """
    order = [c for c in dict.fromkeys(c for each in found.values() for c in each) if c.approach]
    size = (2.6 + 2.9 * len(found), 1.5 + 0.34 * len(order))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(1, len(found), squeeze=False, sharey=True)[0]
    for axes, (motion, skills) in zip(panels, found.items(), strict=True):
        for place, configuration in enumerate(order):
            if configuration in skills:
                _draw(axes, place, skills[configuration], looks[configuration.label].colour)
        axes.axvline(0, color=INK, linewidth=1, linestyle=":")
        axes.axvline(1, color=INK, linewidth=1, linestyle="--")
        axes.set(xlabel="skill [-]", xlim=(LEFT, RIGHT), ylim=(len(order) - 0.4, -0.6))
        axes.set_title(motion, fontsize=11)
        axes.grid(axis="x", alpha=0.3)
    panels[0].set_yticks(range(len(order)), [c.label for c in order], fontsize=8.5)
    title = f"Skill with {LEVEL:.0%} intervals: 0 is the default fabric, 1 the floor"
    figure.suptitle(title, fontsize=12)
    return save(figure, path)


def _draw(axes: Any, place: int, skill: Skill, colour: str) -> None:
    text: dict[str, Any] = {"fontsize": 8, "va": "center"}
    if not skill.runs:
        axes.text(LEFT + 0.05, place, "not told", **text)
    elif skill.diverged:
        words = f"{skill.diverged}/{skill.runs} diverged"
        axes.text(LEFT + 0.05, place, words, color=VERMILION, **text)
    else:
        if np.isfinite(skill.low):
            ends = np.clip([skill.low, skill.high], LEFT, RIGHT)
            axes.hlines(place, *ends, color=colour, linewidth=5, alpha=0.4)
        if skill.mean < LEFT:
            axes.plot(LEFT + 0.06, place, "<", color=colour, markersize=8)
            axes.text(LEFT + 0.16, place, f"{skill.mean:.1f}", **text)
        else:
            axes.plot(min(skill.mean, RIGHT), place, "o", color=colour, markersize=6)
