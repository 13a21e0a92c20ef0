"""Plotly charts of a report: skill, mean distances, error over time."""

from collections.abc import Iterable, Mapping

import numpy as np
import pandas as pd
import plotly.graph_objects as go
from plotly.colors import hex_to_rgb
from plotly.subplots import make_subplots

from r2s.study.configuration import REFERENCES, is_reference
from r2s.study.motions import Motion

# Okabe and Ito's colours, which the colour-blind can tell apart, and then darker ones.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7", "#B8A800", "#5D3A9B",
           "#994F00", "#006CD1", "#40B0A6", "#7D7D00")  # fmt: skip
INK, BROWN, GREY, SAND, RED = "#202020", "#8a6d5a", "#8c8c8c", "#ecdcb0", "#c4004f"
OF_REFERENCES = {REFERENCES["true"]: INK, REFERENCES["middle"]: BROWN}
ABOVE = 1.1  # of the largest error that is shown, the upper end of a chart
RUNAWAY = 2.0  # times the largest error of a reference: what is farther off is out of the chart


def colours_of(labels: Iterable[str]) -> dict[str, str]:
    """The colour of each label, one for a whole page; references are dark, brown and grey."""
    found: dict[str, str] = {}
    for label in dict.fromkeys(labels):
        if is_reference(label):
            own = [colour for name, colour in OF_REFERENCES.items() if label.startswith(name)]
            found[label] = own[0] if own else GREY
        else:
            count = sum(not is_reference(each) for each in found)
            found[label] = COLOURS[count % len(COLOURS)]
    return found


def interval_chart(
    means: pd.DataFrame, colours: Mapping[str, str], title: str, marks: Mapping[float, str]
) -> go.Figure:
    """Means with their intervals, a panel a motion, a line a configuration.

    `means`: from `r2s.study.statistics.means.means`. `marks`: values with a vertical line.
    """
    motions = list(dict.fromkeys(means.index.get_level_values("evaluated_on")))
    labels = list(dict.fromkeys(map(str, means.index.get_level_values("configuration"))))
    figure = make_subplots(1, len(motions), shared_yaxes=True, subplot_titles=motions)
    finite = means["mean"][np.isfinite(means["mean"])]
    low = min([*marks, *finite, 0.0])
    for column, motion in enumerate(motions, 1):
        for label, row in means.xs(motion, level="evaluated_on").iterrows():
            label = str(label)
            if row.diverged or not np.isfinite(row["mean"]):
                words = f"{row.diverged:.0f} of {row.runs:.0f} runs diverged"
                style = {"mode": "text", "text": [words], "textposition": "middle right"}
                shown = go.Scatter(x=[low], y=[label], textfont_color=RED, **style)
            else:
                ends = {"array": [row.high - row["mean"]], "arrayminus": [row["mean"] - row.low]}
                known = {"error_x": {"type": "data", **ends}} if np.isfinite(row.low) else {}
                marker = {"color": colours[label], "size": 10}
                shown = go.Scatter(
                    x=[row["mean"]], y=[label], mode="markers", marker=marker, **known
                )
            figure.add_trace(shown.update(showlegend=False, name=label), 1, column)
        for value, words in marks.items():
            figure.add_vline(value, line_dash="dot", annotation_text=words, row=1, col=column)
    reach = max([*marks, *finite, 0.0]) - low or 1.0
    figure.update_xaxes(title=title, range=[low - 0.15 * reach, low + 1.15 * reach])
    figure.update_yaxes(categoryorder="array", categoryarray=labels[::-1])
    return figure.update_layout(height=140 + 32 * len(labels), margin_l=260)


def error_chart(motion: Motion, colours: Mapping[str, str]) -> go.Figure:
    """The mean error [mm] of each configuration's runs against time, with their range.

    The floor is shaded; beyond the horizon the chart is pale. A line ends with a cross where one of
    its runs diverged.
    """
    times, top = motion.times, _top(motion)
    figure = go.Figure()
    if motion.floor is not None:
        floor = np.minimum(1e3 * motion.floor, 2 * top)  # an infinite one fills the chart
        shade = {"mode": "none", "fill": "tozeroy", "fillcolor": SAND, "name": "floor"}
        figure.add_scatter(x=times, y=floor, **shade)
    for label, mean in motion.mean_errors.items():
        runs, dash = motion.errors[label], "dash" if "points" in label.split() else "solid"
        line, group = {"color": colours[label], "dash": dash}, {"legendgroup": label}
        if len(runs) > 1:
            ends = np.where(np.isfinite(runs), 1e3 * runs, np.inf)
            low, high = (np.minimum(end(ends, axis=0), 2 * top) for end in (np.min, np.max))
            band = {"x": [*times, *times[::-1]], "y": [*high, *low[::-1]], "fill": "toself"}
            pale = f"rgba{(*hex_to_rgb(colours[label]), 0.18)}"
            hidden = {"showlegend": False, "hoverinfo": "skip"}
            figure.add_scatter(**band, mode="none", fillcolor=pale, **hidden, **group)
        lost = int((~np.isfinite(runs).all(axis=1)).sum())
        words = f"{label} ({lost} of {len(runs)} diverged)" if lost else label
        known = np.isfinite(mean)
        y = np.where(known, 1e3 * mean, np.nan)
        figure.add_scatter(x=times, y=y, mode="lines", line=line, name=words, **group)
        if lost and known.any():
            last = np.flatnonzero(known)[-1:]
            cross = {"symbol": "x", "size": 10, "color": colours[label]}
            place = {"x": times[last], "y": np.minimum(y[last], top)}
            figure.add_scatter(**place, mode="markers", marker=cross, showlegend=False, **group)
    if motion.horizon is not None and np.isfinite(motion.horizon):
        end = max(times[-1], motion.horizon)
        figure.add_vrect(motion.horizon, end, fillcolor="white", opacity=0.65, line_width=0)
        words = f"horizon {motion.horizon:.2f} s"
        figure.add_vline(motion.horizon, line_color=RED, annotation_text=words)
    figure.update_xaxes(title="time [s]", range=[times[0], max(times[-1], times[0] + 1e-3)])
    figure.update_yaxes(title="distance to the simulated surface [mm]", range=[0, top])
    title = f"{motion.evaluated_on}, {motion.fabric.replace('_', ' ')} ({motion.recording})"
    return figure.update_layout(title=title, height=460)


def _top(motion: Motion) -> float:
    """The upper end of the chart, [mm]: what runs away does not widen it."""

    def largest(labels: Iterable[str]) -> float:
        runs = np.concatenate([np.zeros(1), *(motion.errors[label].ravel() for label in labels)])
        return float(runs[np.isfinite(runs)].max())

    references = largest(label for label in motion.errors if is_reference(label))
    every = largest(motion.errors)
    return 1e3 * ABOVE * (min(every, RUNAWAY * references) if references else every) or 1.0
