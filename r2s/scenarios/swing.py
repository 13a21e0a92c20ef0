"""A sheet that hangs from a moving bar: measured swings, and smooth ones from a few numbers."""

import numpy as np
from jaxtyping import Float

from r2s.recordings.recording import SheetPlacement, corner
from r2s.scenarios import paths
from r2s.scenarios.paths import KNOT_RATE, Route
from r2s.scenarios.scenario import BAR
from r2s.scenarios.six import GRIP_HEIGHT, Experiment, Size, hanging

SIDE = 0.3  # [m]
NUM_FRAMES, INTERVAL = 50, 0.1  # [s]


def swing(
    size: Size = (SIDE, SIDE),
    *,
    route: Route | None = None,
    height: float = GRIP_HEIGHT,
    num_frames: int = NUM_FRAMES,
    interval: float = INTERVAL,
    sway: float = 0.1,
    turn: float = 30.0,
    frequency: float = 0.8,
) -> Experiment:
    """A sheet hangs from a bar along its warp, which goes to and fro and turns about the vertical.

    - `route`: of both ends of the bar; None: a smooth one of the numbers below.
    - `height`: of the bar above the table, [m].
    - `sway`: how far the bar goes out of the sheet's plane to either side, [m].
    - `turn`: how far it turns to either side, [degrees].
    - `frequency`: of both, [Hz].

    Raises `ValueError` for numbers that are negative, and a frequency too high for the knots.

    >>> swing((0.3, 0.3)).scenario((4, 4)).path.shape[1]  # vertices along the bar
    4
    """
    if num_frames < 2:
        raise ValueError(f"num_frames must be at least 2, found {num_frames}")
    paths.positive("s", interval=interval)
    sheet, times = hanging(size, height), np.arange(num_frames) * interval
    made = _route(sheet, float(times[-1]), sway, turn, frequency) if route is None else route
    return Experiment("swing", sheet, made, times, (0, num_frames - 1), clamps=BAR)


def _route(
    sheet: SheetPlacement, duration: float, sway: float, turn: float, frequency: float
) -> Route:
    """Both ends of the bar, at rest at first and in the end."""
    paths.not_negative("m", sway=sway)
    paths.not_negative("degrees", turn=turn)
    paths.positive("Hz", frequency=frequency)
    if frequency > paths.FASTEST:
        raise ValueError(f"frequency must be at most {paths.FASTEST:g} Hz, found {frequency}")
    times = np.linspace(0, duration, max(round(duration * KNOT_RATE), 2))
    swell = np.sin(np.pi * times / duration) ** 2
    phase = 2 * np.pi * frequency * times
    aside = sway * swell * np.sin(phase)
    angle = np.radians(turn) * swell * np.sin(phase + np.pi / 2)
    ends = np.array([corner(sheet, name) for name in sheet.held])
    return Route(times, _turned(ends, angle, aside))


def _turned(
    ends: Float[np.ndarray, "end 3"],
    angle: Float[np.ndarray, " knot"],
    aside: Float[np.ndarray, " knot"],
) -> Float[np.ndarray, "knot end 3"]:
    """Ends of a bar, turned about the vertical through its middle and moved along y, [m]."""
    middle = ends.mean(axis=0)
    cosine, sine, zero, one = np.cos(angle), np.sin(angle), 0 * angle, 0 * angle + 1
    turn = np.array([[cosine, -sine, zero], [sine, cosine, zero], [zero, zero, one]])
    moved = middle + np.einsum("ijk,ej->kei", turn, ends - middle)
    return moved + aside[:, None, None] * np.array([0.0, 1.0, 0.0])
