"""Plotly figures of a report: means, errors over time, and motions in 3-D with a time slider."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import plotly.express as px
import plotly.graph_objects as go
from jaxtyping import Bool, Float

from r2s.mesh.mesh import rectangle
from r2s.metrics.horizon import within
from r2s.recordings.recording import cloud
from r2s.study.configuration import MOTIONS, ON_CLOTH, REFERENCES, as_configuration, is_reference
from r2s.study.ensembles import Judged, judged_motions
from r2s.study.evaluations import EvaluationTask, read_predictions
from r2s.study.recordings import Source, read

# Okabe and Ito's colours, which the colour-blind can distinguish, and then darker ones.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7", "#B8A800", "#5D3A9B",
           "#994F00", "#006CD1", "#40B0A6", "#7D7D00")  # fmt: skip
INK, BROWN, GREY, SAND, RED = "#202020", "#8a6d5a", "#8c8c8c", "#ecdcb0", "#c4004f"
OF_REFERENCES = {REFERENCES["true"]: INK, REFERENCES["middle"]: BROWN}
ABOVE = 1.1  # of the largest error that is shown, the upper end of a chart
RUNAWAY = 2.0  # times the largest error of a reference: what is farther off is out of the chart
DRAWN = 9  # vertices along a side that are drawn
BUDGET = 7_000_000  # characters of all positions of a page
CHARACTERS = 7  # of a coordinate in millimetres to a tenth, such as "-123.4,"
POINTS = 300  # of a cloud, in a frame
NOW = {"mode": "immediate", "frame": {"duration": 0, "redraw": True}, "transition": {"duration": 0}}


class Motion(NamedTuple):
    """A recording and the simulations of its motion, at the frames that count.

    - `times`: of the frames, [s]. `clouds`: the points of each frame, [m].
    - `vertices`: of each configuration, by its label, on a grid [m]; not finite where it diverged.
      Of several runs (estimates, or samples of the default) the first.
    - `errors`: the distances of the points from the sheets of all runs, [m].
    - `floor`: the accuracy of the recording, [m]. `horizon`: the time up to which it discriminates
      between fabrics, [s]. None: not known.
    """

    fabric: str
    evaluated_on: str
    recording: str
    times: Float[np.ndarray, " frame"]
    clouds: Sequence[Float[np.ndarray, "_ 3"]]
    vertices: Mapping[str, Float[np.ndarray, "frame row column 3"]]
    errors: Mapping[str, Float[np.ndarray, "run frame"]]
    floor: Float[np.ndarray, " frame"] | None = None
    horizon: float | None = None

    @property
    def title(self) -> str:
        return f"{self.evaluated_on}, {self.fabric.replace('_', ' ')} ({self.recording})"

    @property
    def inside(self) -> Bool[np.ndarray, " frame"]:
        """Which frames are before the horizon; all, where none is known."""
        return within(self.times, np.inf if self.horizon is None else self.horizon)

    @property
    def mean_errors(self) -> dict[str, Float[np.ndarray, " frame"]]:
        """The mean over runs, [m]; infinite where one of them has diverged."""
        return {
            label: np.where(np.isfinite(runs), runs, np.inf).mean(axis=0)
            for label, runs in self.errors.items()
        }


def judged_recordings(tasks: Sequence[EvaluationTask], folder: Path) -> list[Motion]:
    """The first recording of each fabric and motion with its finished simulations by all
    configurations, references and defaults, in the order of `MOTIONS`. Estimates come first, the
    default last."""
    groups: dict[Source, dict[str, list[EvaluationTask]]] = defaultdict(lambda: defaultdict(list))
    for task in tasks:
        if task.is_made(folder):
            label = as_configuration(task.configuration, task.baseline).label
            groups[task.recordings[0]][label].append(task)
    first = {(source.fabric, source.scenario): source for source in reversed(groups)}
    sources = [source for source in groups if source in first.values()]
    sources.sort(key=lambda source: MOTIONS.index(source.scenario))
    known = judged_motions(tasks, folder)
    return [_motion(source, groups[source], known.get(source), folder) for source in sources]


def _motion(
    source: Source, group: Mapping[str, list[EvaluationTask]], judged: Judged | None, folder: Path
) -> Motion:
    recording = read(source, folder)
    first, last = recording.info.frames_used
    rank = {"": 0, ON_CLOTH: 0, "true": 1, "middle": 2, "default": 3}
    errors, vertices = {}, {}
    for label, tasks in sorted(group.items(), key=lambda item: rank[item[1][0].baseline]):
        runs = [read_predictions(task, folder)[source.name] for task in tasks]
        errors[label] = np.stack([run.distances for run in runs])
        shape = tasks[0].shape
        every = max((shape[0] - 1) // (DRAWN - 1), 1)
        x = runs[0].x[first : last + 1].reshape(-1, *shape, 3)
        vertices[label] = x[:, ::every, ::every]
    return Motion(
        fabric=source.fabric,
        evaluated_on=source.scenario,
        recording=source.name,
        times=np.asarray(recording.times)[first : last + 1],
        clouds=tuple(cloud(recording, frame) for frame in range(first, last + 1)),
        vertices=vertices,
        errors=errors,
        floor=None if judged is None else judged.floor,
        horizon=None if judged is None else judged.horizon,
    )


def colours_of(labels: Iterable[str]) -> dict[str, str]:
    """The colour of each label, one for a whole page; references are dark, brown and grey."""
    labels, colours = list(dict.fromkeys(labels)), cycle(COLOURS)
    return {
        label: next((c for name, c in OF_REFERENCES.items() if label.startswith(name)), GREY)
        if is_reference(label)
        else next(colours)
        for label in labels
    }


def interval_chart(
    means: pd.DataFrame, colours: Mapping[str, str], title: str, marks: Mapping[float, str]
) -> go.Figure:
    """Means with their intervals, a panel a motion, a line a configuration; no mean is drawn of
    which a run diverged.

    `means`: from `r2s.study.results.means`. `marks`: values with a vertical line.
    """
    table = means.reset_index()
    table["configuration"] = table.configuration.astype(str)
    table["mean"] = table["mean"].where(np.isfinite(table["mean"]))  # or a run diverged
    table = table.assign(above=table.high - table["mean"], below=table["mean"] - table.low)
    labels = list(dict.fromkeys(table.configuration))
    figure = px.scatter(
        table,
        x="mean",
        y="configuration",
        facet_col="evaluated_on",
        error_x="above",
        error_x_minus="below",
        color="configuration",
        color_discrete_map=dict(colours),
        category_orders={"configuration": labels},
        labels={"mean": title, "configuration": "", "evaluated_on": "motion"},
        height=140 + 32 * len(labels),
    )
    for value, words in marks.items():
        figure.add_vline(value, line_dash="dot", annotation_text=words)
    return figure.update_layout(showlegend=False)


def error_chart(motion: Motion, colours: Mapping[str, str]) -> go.Figure:
    """The mean error [mm] of each configuration's runs against time, until one of them diverged.

    The floor is shaded; beyond the horizon the chart is pale.
    """
    times, means, figure = motion.times, motion.mean_errors, go.Figure()
    # errors that run away do not widen the chart
    finite = {
        label: float(np.max(mean, where=np.isfinite(mean), initial=0.0))
        for label, mean in means.items()
    }
    known = max((e for label, e in finite.items() if is_reference(label)), default=0.0)
    top = 1e3 * ABOVE * min(max(finite.values(), default=0.0), RUNAWAY * known or np.inf) or 1.0
    if motion.floor is not None:
        floor = np.minimum(1e3 * motion.floor, 2 * top)  # an infinite one fills the chart
        shade = {"mode": "none", "fill": "tozeroy", "fillcolor": SAND, "name": "floor"}
        figure.add_scatter(x=times, y=floor, **shade)
    for label, mean in means.items():
        runs, dash = motion.errors[label], "dash" if "mpm" in label.split() else "solid"
        diverged = int((~np.isfinite(runs).all(axis=1)).sum())
        words = f"{label} ({diverged} of {len(runs)} diverged)" if diverged else label
        y = np.where(np.isfinite(mean), 1e3 * mean, np.nan)
        line = {"color": colours[label], "dash": dash}
        figure.add_scatter(x=times, y=y, mode="lines", line=line, name=words)
    if motion.horizon is not None and np.isfinite(motion.horizon):
        end = max(times[-1], motion.horizon)
        figure.add_vrect(motion.horizon, end, fillcolor="white", opacity=0.65, line_width=0)
        words = f"horizon {motion.horizon:.2f} s"
        figure.add_vline(motion.horizon, line_color=RED, annotation_text=words)
    figure.update_xaxes(title="time [s]", range=[times[0], max(times[-1], times[0] + 1e-3)])
    figure.update_yaxes(title="distance to the simulated surface [mm]", range=[0, top])
    return figure.update_layout(title=motion.title, height=460)


def motion_figures(motions: Sequence[Motion], colours: Mapping[str, str]) -> list[go.Figure]:
    """A 3-D figure with a time slider for each motion, with as many frames as `BUDGET` allows; the
    slider begins at the last frame before the horizon."""
    return [_figure(motion, colours, BUDGET // len(motions)) for motion in motions]


def _figure(motion: Motion, colours: Mapping[str, str], budget: int) -> go.Figure:
    positions = POINTS + sum(x[0].size // 3 for x in motion.vertices.values())
    most = max(budget // (3 * CHARACTERS * positions) - 1, 1)  # one is drawn at first
    count = len(motion.times)
    frames = list(range(0, count, math.ceil(count / most)))
    generator = np.random.default_rng(0)
    finite = [motion.clouds[i][np.isfinite(motion.clouds[i]).all(axis=1)] for i in frames]
    clouds = [generator.permutation(points)[:POINTS] for points in finite]
    data = [
        [
            {"type": "scatter3d", **_positions(cloud)},
            *({"type": "mesh3d", **_vertices(x[: i + 1])} for x in motion.vertices.values()),
        ]
        for i, cloud in zip(frames, clouds, strict=True)
    ]
    start = max(int(motion.inside[frames].sum()) - 1, 0)
    points = {"mode": "markers", "marker": {"size": 1.5, "color": RED}, "name": "recorded points"}
    looks = [points, *(_look(motion, label, colours[label]) for label in motion.vertices)]
    names = [f"{motion.times[i]:.3f} s" for i in frames]
    figure = go.Figure(
        [look | own for look, own in zip(looks, data[start], strict=True)],
        frames=[go.Frame(name=name, data=own) for name, own in zip(names, data, strict=True)],
    )
    steps = [{"method": "animate", "label": name, "args": [[name], NOW]} for name in names]
    times = np.asarray(motion.times)[frames]
    moving = NOW | {"fromcurrent": True, "frame": {"duration": 80, "redraw": True}}
    buttons = [
        {
            "method": "animate",
            "label": "Play",
            "args": [[names[i] for i in _evenly(times)], moving],
        },
        {"method": "animate", "label": "Pause", "args": [[None], NOW]},
    ]
    return figure.update_layout(
        height=620,
        title=motion.title,
        scene=_scene(clouds),
        sliders=[{"active": start, "steps": steps, "currentvalue": {"prefix": "time: "}}],
        updatemenus=[
            {"type": "buttons", "direction": "left", "x": 0, "y": 1.1, "buttons": buttons}
        ],
    )


def _evenly(times: np.ndarray) -> list[int]:
    """Which frame is shown at even times: one before a gap for as long as that is."""
    gap = np.median(np.diff(times)) if len(times) > 1 else 1.0
    even = np.arange(times[0], times[-1] + gap / 2, gap)
    return (np.searchsorted(times, even + gap / 2, side="right") - 1).tolist()


def _look(motion: Motion, label: str, colour: str) -> dict:
    """Of a sheet; the first configuration and the true fabric are visible, others on a click."""
    faces = rectangle((1.0, 1.0), motion.vertices[label].shape[1:3]).faces
    corners = zip("ijk", np.asarray(faces, np.uint16).T, strict=True)
    is_shown = label == next(iter(motion.vertices)) or label.startswith(REFERENCES["true"])
    legend = {"name": label, "showlegend": True, "visible": True if is_shown else "legendonly"}
    return dict(corners) | legend | {"color": colour, "flatshading": True, "hoverinfo": "name"}


def _vertices(x: np.ndarray) -> dict:
    """The last vertices of a motion; where it diverged, those before it, not visible."""
    is_known = np.all(np.isfinite(x), axis=(1, 2, 3))
    last = x[is_known][-1] if is_known.any() else np.zeros_like(x[0])
    return {**_positions(last.reshape(-1, 3)), "opacity": 0.75 if is_known[-1] else 0.0}


def _positions(points: np.ndarray) -> dict:
    # lists: plotly does not document its packed arrays for frames
    return dict(zip("xyz", np.round(1e3 * points.T, 1).tolist(), strict=True))


def _scene(clouds: Sequence[np.ndarray]) -> dict:
    """Axes [mm] around most of the points: neither outliers nor sheets that fly off widen them."""
    dots = np.concatenate(clouds) if any(map(len, clouds)) else np.zeros((1, 3))
    low, high = 1e3 * np.percentile(dots, [1, 99], axis=0)
    margin = max(0.2 * float((high - low).max()), 50.0)
    axes = {
        f"{name}axis": {"range": [float(a - margin), float(b + margin)], "title": f"{name} [mm]"}
        for name, a, b in zip("xyz", low, high, strict=True)
    }
    return {**axes, "aspectmode": "data"}
