"""Charts of a study, each one PNG: mean ranks, shares of the variance, distances.

Needs matplotlib: pip install 'r2s[study]'. Each function returns `path`, and raises OSError that
names it when it cannot be written.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from r2s.evaluation.statistics import LEVEL, SIGNIFICANCE
from r2s.study.report.figures import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    SKY,
    VERMILION,
    Figure,
    Looks,
    save,
)
from r2s.study.statistics.distances import means
from r2s.study.statistics.factors import REST, Shares
from r2s.study.statistics.ranks import Ranks
from r2s.study.statistics.result_array import ResultArray

SHARE_COLOURS = (BLUE, ORANGE, GREEN, GREY, SKY, VERMILION)


def rank_chart(path: Path | str, ranks: Mapping[str, Ranks]) -> Path:
    """Mean ranks with intervals, a results each, the best at the top.

    The bar below is as long as two mean ranks must be apart to be told from each other.
    """
    count = max(len(each.configurations) for each in ranks.values())
    across = min(2, len(ranks))
    down = -(-len(ranks) // across)
    size = (5.6 * across, 0.4 + (1.5 + 0.3 * count) * down)
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for axes in panels[len(ranks) :]:
        axes.remove()
    for axes, (title, each) in zip(panels, ranks.items(), strict=False):
        order = np.argsort(each.mean, kind="stable")
        places = np.arange(len(order))
        axes.hlines(places, each.low[order], each.high[order], color=BLUE, linewidth=5, alpha=0.35)
        axes.plot(each.mean[order], places, "o", color=BLUE, markersize=6)
        axes.set_yticks(places, [each.configurations[i].label for i in order], fontsize=8.5)
        axes.set(xlabel="mean rank (1 is best)", xlim=(0.7, len(order) + 0.3))
        axes.set_title(f"{title}: {each.fabrics} fabrics", fontsize=11)
        start, below = 1.0, len(order) - 0.1
        axes.plot([start, start + each.difference], [below, below], "|-", color=VERMILION)
        text = f"critical difference {each.difference:.2f} ({100 * SIGNIFICANCE:.0f} %, Nemenyi)"
        axes.text(start, below + 0.2, text, fontsize=7.5, color=VERMILION, va="top")
        axes.set_ylim(len(order) + 0.6, -0.6)
        axes.grid(axis="x", alpha=0.3)
    figure.suptitle(f"Ranks of the configurations, with {LEVEL:.0%} intervals", fontsize=12)
    return save(figure, path)


def share_chart(path: Path | str, shares: Mapping[str, Shares]) -> Path:
    """Draw shares of the variance of the log distance, grouped by factor."""
    factors = list(dict.fromkeys(name for each in shares.values() for name in each.factors))
    factors.sort(key=lambda name: name == REST)  # last
    figure = Figure(figsize=(max(6.5, 1.3 * len(factors) + 1.5), 4.2), layout="constrained")
    axes = figure.add_subplot()
    width = 0.84 / max(1, len(shares))
    for i, (title, each) in enumerate(shares.items()):
        where = np.array([factors.index(name) for name in each.factors], float)
        where += (i - (len(shares) - 1) / 2) * width
        axes.bar(where, 100 * each.share, 0.92 * width, label=title, color=SHARE_COLOURS[i % 6])
    axes.set_xticks(range(len(factors)), factors)
    axes.set_ylabel("share of the variance [%]")
    axes.set_title("What the logarithm of the distance depends on")
    axes.axhline(0, color="black", linewidth=0.8)
    axes.grid(axis="y", alpha=0.3)
    axes.set_axisbelow(True)
    options: dict[str, Any] = {"loc": "outside lower center", "ncols": max(1, len(shares))}
    figure.legend(frameon=False, fontsize=9, **options)
    return save(figure, path)


def distance_chart(
    path: Path | str, parts: Mapping[str, ResultArray], title: str, looks: Looks
) -> Path:
    """Draw the mean distances of all configurations, a panel for each motion, on one scale."""
    found = {motion: means(part) for motion, part in parts.items()}
    order = list(dict.fromkeys(c for part in parts.values() for c in part.configurations))
    size = (2.6 + 2.9 * len(found), 1.6 + 0.34 * len(order))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(1, len(found), squeeze=False, sharey=True)[0]
    # Intervals of few fabrics are wide: the scale is that of the means.
    finite = [2e3 * each.mean[np.isfinite(each.mean)] for each in found.values()]
    right = 1.12 * max((float(values.max()) for values in finite if len(values)), default=1.0)
    for axes, (motion, each) in zip(panels, found.items(), strict=True):
        for i, configuration in enumerate(parts[motion].configurations):
            place = order.index(configuration)
            if not np.isfinite(each.mean[i]):
                text = f"{each.diverged[i]}/{each.runs[i]} diverged"
                axes.text(0.02 * right, place, text, fontsize=8, va="center", color=VERMILION)
                continue
            low, mean, high = 1e3 * each.low[i], 1e3 * each.mean[i], 1e3 * each.high[i]
            colour = looks[configuration.label].colour
            axes.hlines(place, low, high, color=colour, linewidth=5, alpha=0.4)
            axes.plot(mean, place, "o", color=colour, markersize=6)
        axes.set(xlabel="distance [mm]", xlim=(0, right), ylim=(len(order) - 0.4, -0.6))
        axes.set_title(motion, fontsize=11)
        axes.grid(axis="x", alpha=0.3)
    panels[0].set_yticks(range(len(order)), [c.label for c in order], fontsize=8.5)
    figure.suptitle(title, fontsize=12)
    return save(figure, path)
