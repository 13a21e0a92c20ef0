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
    data = [
        [
            {"type": "scatter3d", **_positions(cloud)},
            *({"type": "mesh3d", **_vertices(x[: i + 1])} for x in motion.vertices.values()),
        ]
        for i, cloud in zip(frames, clouds, strict=True)
    ]
    start = int(np.argmin(np.abs(frames - deciding_frame(motion))))
    points = {"mode": "markers", "marker": {"size": 1.5, "color": RED}, "name": "recorded points"}
    looks = [points, *(_look(motion, label, colours[label]) for label in motion.vertices)]
    names = [f"{motion.times[i]:.2f} s" for i in frames]
    figure = go.Figure(
        [look | own for look, own in zip(looks, data[start], strict=True)],
        frames=[go.Frame(name=name, data=own) for name, own in zip(names, data, strict=True)],
    )
    steps = [{"method": "animate", "label": name, "args": [[name], NOW]} for name in names]
    moving = NOW | {"fromcurrent": True, "frame": {"duration": 80, "redraw": True}}
    buttons = [
        {"method": "animate", "label": "Play", "args": [None, moving]},
        {"method": "animate", "label": "Pause", "args": [[None], NOW]},
    ]
    return figure.update_layout(
        height=620,
        title=f"{motion.evaluated_on}, {motion.fabric.replace('_', ' ')} ({motion.recording})",
        scene=_scene(clouds, [x[frames] for x in motion.vertices.values()]),
        sliders=[{"active": start, "steps": steps, "currentvalue": {"prefix": "time: "}}],
        updatemenus=[
            {"type": "buttons", "direction": "left", "x": 0, "y": 1.1, "buttons": buttons}
        ],
    )


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


def _look(motion: Motion, label: str, colour: str) -> dict:
    """Of a sheet; the first configuration and the true fabric are shown, others on a click."""
    corners = zip("ijk", np.asarray(motion.faces[label], np.uint16).T, strict=True)
    is_first = label == next(iter(motion.vertices))
    is_shown = is_first or label.startswith(REFERENCES["true"])
    legend = {"name": label, "showlegend": True, "visible": True if is_shown else "legendonly"}
    return dict(corners) | legend | {"color": colour, "flatshading": True, "hoverinfo": "name"}


def _vertices(x: np.ndarray) -> dict:
    """The last vertices of a motion; where it diverged, those before it, not visible."""
    is_known = np.all(np.isfinite(x), axis=(1, 2))
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
        is_near = np.all((sheet > low - reach) & (sheet < high + reach), axis=-1)
        near = sheet[is_near]
        low, high = np.min([low, *near], axis=0), np.max([high, *near], axis=0)
    low, high = 1e3 * (low - 0.02 * reach), 1e3 * (high + 0.02 * reach)
    size = high - low
    axes = {
        f"{name}axis": {"range": [float(a), float(b)], "title": f"{name} [mm]"}
        for name, a, b in zip("xyz", low, high, strict=True)
    }
    ratio = dict(zip("xyz", (size / size.max()).tolist(), strict=True))
    return {**axes, "aspectmode": "manual", "aspectratio": ratio}
