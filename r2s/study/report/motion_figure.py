"""Motions as 3-D plotly figures with a time slider: recorded points and simulated sheets."""

from collections.abc import Mapping, Sequence

import numpy as np
import plotly.graph_objects as go

from r2s.study.configuration import REFERENCES
from r2s.study.motions import Motion, deciding_frame
from r2s.study.report.charts import RED

BUDGET = 7_000_000  # characters of all positions of a page
CHARACTERS = 7  # of a coordinate in millimetres to a tenth, such as "-123.4,"
FEWEST_POINTS, MOST_POINTS = 150, 800  # of a cloud, in a frame
NOW = {"mode": "immediate", "frame": {"duration": 0, "redraw": True}, "transition": {"duration": 0}}


def motion_figures(motions: Sequence[Motion], colours: Mapping[str, str]) -> list[go.Figure]:
    """A figure for each motion; together they have at most `BUDGET`.

    Of long or fine recordings every second frame is kept, or fewer, and of clouds as many points
    as there is room for. The slider begins at `deciding_frame`.
    """
    return [_figure(each, colours, BUDGET // len(motions)) for each in motions]


def _figure(motion: Motion, colours: Mapping[str, str], budget: int) -> go.Figure:
    frames, count = _kept(motion, budget)
    generator = np.random.default_rng(0)
    clouds = [generator.permutation(_finite(motion.clouds[i]))[:count] for i in frames]
    start = int(np.argmin(np.abs(frames - deciding_frame(motion))))
    traces = [
        go.Scatter3d(mode="markers", marker={"size": 1.5, "color": RED}, name="recorded points"),
        *(_sheet(motion, label, colours[label], i == 0) for i, label in enumerate(motion.vertices)),
    ]
    data = [
        [_positions(cloud), *(_vertices(x[: i + 1]) for x in motion.vertices.values())]
        for i, cloud in zip(frames, clouds, strict=True)
    ]
    names = [f"{motion.times[i]:.2f} s" for i in frames]
    steps = [{"method": "animate", "label": name, "args": [[name], NOW]} for name in names]
    figure = go.Figure(
        [trace.update(own) for trace, own in zip(traces, data[start], strict=True)],
        frames=[
            go.Frame(
                name=name, data=[{"type": t.type, **x} for t, x in zip(traces, own, strict=True)]
            )
            for name, own in zip(names, data, strict=True)
        ],
    )
    play = {"method": "animate", "label": "Play", "args": [None, {**NOW, "fromcurrent": True,
            "frame": {"duration": 80, "redraw": True}}]}  # fmt: skip
    pause = {"method": "animate", "label": "Pause", "args": [[None], NOW]}
    return figure.update_layout(
        height=620,
        title=f"{motion.evaluated_on}, {motion.fabric.replace('_', ' ')} ({motion.recording})",
        scene=_scene(clouds, [x[frames] for x in motion.vertices.values()]),
        sliders=[{"active": start, "steps": steps, "currentvalue": {"prefix": "time: "}}],
        updatemenus=[{"type": "buttons", "direction": "left", "x": 0, "y": 1.08,
                      "buttons": [play, pause]}],
    )  # fmt: skip


def _kept(motion: Motion, budget: int) -> tuple[np.ndarray, int]:
    """Which frames, and how many points of each, fit into a budget of characters."""
    vertices = sum(x.shape[1] for x in motion.vertices.values())
    count = len(motion.times)
    for stride in range(1, count + 1):
        frames = np.arange(0, count, stride)
        room = budget / CHARACTERS / 3 / (len(frames) + 1) - vertices
        if room >= FEWEST_POINTS:
            return frames, int(min(room, MOST_POINTS))
    return np.arange(1), FEWEST_POINTS


def _sheet(motion: Motion, label: str, colour: str, is_first: bool) -> go.Mesh3d:
    """An empty sheet; the first configuration and the true fabric are shown, others on a click."""
    i, j, k = (np.asarray(corner, np.uint16) for corner in motion.faces[label].T)
    shown = True if is_first or label.startswith(REFERENCES["true"]) else "legendonly"
    return go.Mesh3d(i=i, j=j, k=k, name=label, color=colour, showlegend=True, visible=shown,
                     hoverinfo="name", flatshading=True)  # fmt: skip


def _vertices(x: np.ndarray) -> dict:
    """The last vertices of a motion; where it diverged, those before it, not visible."""
    is_known = np.isfinite(x).all(axis=(1, 2))
    last = x[is_known][-1] if is_known.any() else np.zeros_like(x[0])
    return {**_positions(last), "opacity": 0.75 if is_known[-1] else 0.0}


def _positions(points: np.ndarray) -> dict:
    # lists, for plotly does not say that frames may have its packed arrays
    return dict(zip("xyz", np.round(1e3 * points.T, 1).tolist(), strict=True))


def _finite(cloud: np.ndarray) -> np.ndarray:
    return cloud[np.isfinite(cloud).all(axis=1)]


def _scene(clouds: Sequence[np.ndarray], sheets: Sequence[np.ndarray]) -> dict:
    """Axes [mm] that hold most points, and sheets that did not fly off."""
    dots = np.concatenate(clouds) if any(map(len, clouds)) else np.zeros((1, 3))
    low, high = np.percentile(dots, [1, 99], axis=0)
    reach = max(float((high - low).max()) / 2, 0.05)
    for sheet in sheets:
        near = sheet[((sheet > low - reach) & (sheet < high + reach)).all(axis=-1)]
        low, high = np.min([low, *near], axis=0), np.max([high, *near], axis=0)
    low, high = 1e3 * (low - 0.02 * reach), 1e3 * (high + 0.02 * reach)
    size = high - low
    axes = {
        f"{name}axis": {"range": [float(a), float(b)], "title": f"{name} [mm]"}
        for name, a, b in zip("xyz", low, high, strict=True)
    }
    ratio = dict(zip("xyz", (size / size.max()).tolist(), strict=True))
    return {**axes, "aspectmode": "manual", "aspectratio": ratio}
