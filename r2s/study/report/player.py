"""A viewer of judged recordings in a report: clouds and simulated sheets, turned and played.

An HTML fragment without links: a canvas, its script, and the positions, rounded to whole STEPs
around the middle of each recording.
"""

import base64
import json
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from r2s.study.report.figures import Looks
from r2s.study.report.motions import MotionComparison
from r2s.study.report.player_script import SCRIPT, STYLE

STEP = 1e-4  # [m], to which positions are rounded
LARGEST = 32767  # steps from the middle
ABSENT = -32768  # where a simulation diverged, or left the picture
BUDGET = 950_000  # characters of positions for each recording
FEWEST_POINTS, MOST_POINTS = 150, 800  # of a cloud, in a frame


def viewer(comparisons: Sequence[MotionComparison], looks: Looks, name: str = "viewer") -> str:
    """The fragment, for `Section.html`; the text is empty without anything to show.

    - `looks`: of all labels of `comparisons`.
    - `name`: the id of its element, another one for each viewer of a page.

    Of long or fine recordings every second frame is kept, or fewer, and of clouds as many points as
    there is room for.
    """
    if not comparisons:
        return ""
    labels = list(dict.fromkeys(label for each in comparisons for label in each.motions))
    content = {
        "step": STEP,
        "absent": ABSENT,
        "labels": labels,
        "colours": [looks[label].colour for label in labels],
        "recordings": [_packed(each) for each in comparisons],
    }
    # "<" would end the element that holds it.
    text = json.dumps(content, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    choices = "".join(
        f'<option value="{i}">{escape(_title(each))}</option>' for i, each in enumerate(comparisons)
    )
    return (
        f'<style>{STYLE}</style>\n<div class="viewer" id="{escape(name)}">\n'
        f'<div class="controls"><label>Recording <select>{choices}</select></label>\n'
        '<button type="button">Play</button>\n'
        '<input type="range" min="0" value="0" step="1" aria-label="frame">\n'
        "<output></output></div>\n"
        '<canvas tabindex="0" role="img" aria-label="recorded points and simulated sheets">'
        '</canvas>\n<div class="legend"></div>\n'
        f'<p class="hint">Drag to turn, pinch or scroll to zoom, double-click to go back; arrow '
        f"keys and + - do the same. Positions are rounded to {1e3 * STEP:g} mm.</p>\n"
        f'<script type="application/json">{text}</script>\n'
        f"<script>{SCRIPT.replace('VIEWER_NAME', json.dumps(name))}</script>\n</div>\n"
    )


def _title(comparison: MotionComparison) -> str:
    return (
        f"{comparison.evaluated_on}, {comparison.fabric.replace('_', ' ')} ({comparison.recording})"
    )


def _packed(comparison: MotionComparison) -> dict[str, Any]:
    frames, points = _kept(comparison)
    generator = np.random.default_rng(0)
    clouds = [generator.permutation(_finite(comparison.clouds[i]))[:points] for i in frames]
    middle, radius = _around(clouds, [x[frames] for x in comparison.motions.values()])
    return {
        "recording": comparison.recording,
        "times": [round(float(comparison.times[i]), 4) for i in frames],
        "middle": [round(float(value), 4) for value in middle],
        "radius": round(float(radius), 4),
        "counts": [len(cloud) for cloud in clouds],
        "points": _encoded(np.concatenate(clouds), middle),
        "faces": {k: _base64(np.asarray(f, "<u2")) for k, f in comparison.faces.items()},
        "sheets": {label: _encoded(x[frames], middle) for label, x in comparison.motions.items()},
    }


def _kept(comparison: MotionComparison) -> tuple[np.ndarray, int]:
    """Which frames, and how many points of each, fit into the budget."""
    vertices = sum(x.shape[1] for x in comparison.motions.values())
    for stride in range(1, len(comparison.times) + 1):
        frames = np.arange(0, len(comparison.times), stride)
        room = BUDGET / 8 / len(frames) - vertices  # 3 numbers of 2 bytes are 8 characters
        if room >= FEWEST_POINTS:
            return frames, int(min(room, MOST_POINTS))
    return np.arange(1), FEWEST_POINTS


def _around(clouds: list[np.ndarray], sheets: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """The middle [m], and a radius that holds most points, and sheets that did not fly off."""
    dots = np.concatenate(clouds) if any(map(len, clouds)) else np.zeros((1, 3))
    low, high = np.percentile(dots, [1, 99], axis=0)
    reach = max(float((high - low).max()), 0.1)
    for sheet in sheets:
        near = sheet.reshape(-1, 3)
        near = near[((near > low - reach / 2) & (near < high + reach / 2)).all(axis=1)]
        if len(near):
            low, high = np.minimum(low, near.min(axis=0)), np.maximum(high, near.max(axis=0))
    return (low + high) / 2, float(np.linalg.norm(high - low)) / 2


def _finite(cloud: np.ndarray) -> np.ndarray:
    return cloud[np.isfinite(cloud).all(axis=1)]


def _encoded(positions: np.ndarray, middle: np.ndarray) -> str:
    steps = np.round((positions - np.round(middle, 4)) / STEP)
    inside = (np.abs(steps) <= LARGEST).all(axis=-1, keepdims=True)  # False for NaN
    return _base64(np.where(inside, np.nan_to_num(steps), ABSENT).astype("<i2"))


def _base64(numbers: np.ndarray) -> str:
    return "base64," + base64.b64encode(np.ascontiguousarray(numbers).tobytes()).decode("ascii")
