"""What all pictures share: colours, limits, and how a figure is written.

Needs matplotlib: pip install 'r2s[study]'.
"""

import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from r2s.files import write_bytes
from r2s.study.configuration import REFERENCES, is_reference

try:
    # The object API alone: pyplot would keep every figure, and choose a backend for the caller.
    from matplotlib.colors import to_rgba as to_rgba
    from matplotlib.figure import Figure as Figure
    from matplotlib.ticker import MaxNLocator as MaxNLocator
    from matplotlib.ticker import NullLocator as NullLocator
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection as Poly3DCollection
except ImportError as error:
    raise ImportError("figures need matplotlib: pip install 'r2s[study]'") from error

# Okabe and Ito's colours, which the colour-blind can tell apart.
BLUE, ORANGE, GREEN, VERMILION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
SKY, GREY = "#56B4E9", "#8c8c8c"
INK, SAND = "#202020", "#ecdcb0"  # of the true fabric, and of a floor
BROWN = "#8a6d5a"  # of the middle of the prior
# One for each configuration, the same in every picture: Okabe and Ito's, and then darker.
LABEL_COLOURS = (BLUE, ORANGE, GREEN, VERMILION, SKY, "#CC79A7", "#B8A800", "#5D3A9B",
                 "#994F00", "#006CD1", "#40B0A6", "#7D7D00")  # fmt: skip
OF_REFERENCES = {REFERENCES["true"]: INK, REFERENCES["middle"]: BROWN}
MOST_DOTS = 1500  # a panel; more would hide the cloth


def save(figure: Figure, path: Path | str) -> Path:
    """Write a figure as PNG, whole or not at all."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    write_bytes(path, buffer.getvalue())
    return Path(path)


class Look(NamedTuple):
    """How a configuration is drawn: its colour, and its line, dashed for material points."""

    colour: str
    line: str


def looks_of(labels: Iterable[str]) -> dict[str, Look]:
    """The look of each label, one for a whole page: colours in the order of the configurations; the
    true fabric is dark, the middle of the prior brown and the default grey, whatever their order.
    """
    found, count = dict[str, Look](), 0
    for label in labels:
        if label in found:
            continue
        colour = next((own for name, own in OF_REFERENCES.items() if label.startswith(name)), GREY)
        if not is_reference(label):
            colour, count = LABEL_COLOURS[count % len(LABEL_COLOURS)], count + 1
        found[label] = Look(colour, "--" if "points" in label.split() else "-")
    return found


Looks = Mapping[str, Look]


def thin(cloud: np.ndarray) -> np.ndarray:
    """At most `MOST_DOTS` finite points of a cloud, chosen at random, always the same."""
    return np.random.default_rng(0).permutation(cloud[np.isfinite(cloud).all(axis=1)])[:MOST_DOTS]


def inside(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> Any:
    """Which points lie in a box; not those that are not finite."""
    return ((points >= low) & (points <= high)).all(axis=1)


def limits(dots: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The corners [m] of the box around the cloths and most of the dots."""
    low, high = np.percentile(dots, [1, 99], axis=0)
    # A cloth may be out of the cloud by half of its width; what is beyond flew off.
    reach = max(0.5 * float((high - low).max()), 0.05)
    near = vertices[inside(vertices, low - reach, high + reach)]
    low, high = np.min([low, *near], axis=0), np.max([high, *near], axis=0)
    return low - 0.04 * reach - 1e-3, high + 0.04 * reach + 1e-3
