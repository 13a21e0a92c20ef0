"""The six scenarios of the study, each a function of the sheet's size and the grippers' path.

An experiment is independent of mesh and solver: `Experiment.scenario` puts it on a mesh. The
grippers follow a `route` that was recorded, or a smooth path (`r2s.scenarios.paths`).
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import PRNGKeyArray

from r2s._util.units import not_negative, positive
from r2s.recordings.recording import SheetPlacement
from r2s.scenarios.paths import (
    Route,
    draw,
    fling_path,
    fold_path,
    hold_path,
    lift_path,
    pull_path,
    shake_path,
    swing_path,
)
from r2s.scenarios.scenario import BAR, CLAMPS, CLEARANCE, Experiment

SIDE = 0.45  # [m], the study's sheets
NUM_FRAMES = 60
INTERVAL, STRETCHING_INTERVAL = 1 / 15, 1 / 30  # [s]
SWING_SIDE, SWING_FRAMES, SWING_INTERVAL = 0.3, 50, 0.1  # [m], -, [s]: those of public swings
GRIP_HEIGHT = 0.7  # [m] above the table, of a hanging sheet's grippers
FARTHEST = 20.0  # [m] from the origin, of grippers
ALL_CORNERS = ("origin", "weft", "warp", "opposite")
Size = tuple[float, float]


def lifting(
    size: Size = (SIDE, SIDE),
    pinned: str = "origin",
    *,
    route: Route | None = None,
    num_frames: int = NUM_FRAMES,
    interval: float = INTERVAL,
    **path: float,
) -> Experiment:
    """A sheet lies flat on the table; a corner is lifted. The second half of the frames counts.

    `path`: see `lift_path`. The left corner is the "origin" or the "weft".

    >>> scenario = lifting((0.3, 0.3), height=0.2).scenario((5, 5))
    >>> scenario.start.shape, scenario.num_frames
    ((25, 3), 60)
    """
    sheet, used = on_table(size, (pinned,)), (num_frames // 2, num_frames - 1)
    moved = _moved("lifting", lift_path, sheet, route, num_frames, interval, path)
    return moved._replace(frames_used=used)


def folding(
    size: Size = (SIDE, SIDE),
    pinned: str = "origin",
    *,
    route: Route | None = None,
    num_frames: int = NUM_FRAMES,
    interval: float = INTERVAL,
    **path: float,
) -> Experiment:
    """A sheet lies flat on the table; a corner is brought onto the opposite one: `fold_path`."""
    sheet = on_table(size, (pinned,))
    return _moved("folding", fold_path, sheet, route, num_frames, interval, path)


def stretching(
    size: Size = (SIDE, SIDE),
    *,
    route: Route | None = None,
    height: float = CLEARANCE,
    num_frames: int = NUM_FRAMES,
    interval: float = STRETCHING_INTERVAL,
    **path: float,
) -> Experiment:
    """A sheet lies on the table, clamped at both ends of its warp; one is pulled, and held.

    Its force is `r2s.scenarios.clamp_force`. At a `height` [m] above the table the sheet sags in
    the air instead, until it is pulled taut. A `route` is that of the corners (origin, weft, warp,
    opposite). `path`: see `pull_path`.
    """
    sheet = on_table(size, ALL_CORNERS, height)
    moved = _moved("stretching", pull_path, sheet, route, num_frames, interval, path)
    return moved._replace(clamps=CLAMPS)


def wind(
    size: Size = (SIDE, SIDE),
    speed: float = 2.5,
    aside: float = 0.0,
    *,
    route: Route | None = None,
    height: float = GRIP_HEIGHT,
    num_frames: int = NUM_FRAMES,
    interval: float = INTERVAL,
    **path: float,
) -> Experiment:
    """A sheet hangs from its top corners; a fan blows on its middle, `speed` [m/s] on its axis.

    `aside` [degrees] is how far the wind turns from straight on. `path`: see `hold_path`.
    """
    not_negative("m/s", speed=speed)
    if not abs(aside) <= 90:
        raise ValueError(f"aside must be from -90 to 90 [degrees], found {aside}")
    angle = np.radians(aside)
    blows = (float(speed * np.sin(angle)), float(speed * np.cos(angle)), 0.0)
    moved = _moved("wind", hold_path, hanging(size, height), route, num_frames, interval, path)
    return moved._replace(wind=blows)


def fling(
    size: Size = (SIDE, SIDE),
    *,
    route: Route | None = None,
    height: float = GRIP_HEIGHT,
    num_frames: int = NUM_FRAMES,
    interval: float = INTERVAL,
    **path: float,
) -> Experiment:
    """A sheet hangs from its top corners, which rapidly go forward and back: `fling_path`."""
    return _moved("fling", fling_path, hanging(size, height), route, num_frames, interval, path)


def shaking(
    size: Size = (SIDE, SIDE),
    *,
    route: Route | None = None,
    height: float = GRIP_HEIGHT,
    num_frames: int = NUM_FRAMES,
    interval: float = INTERVAL,
    **path: float,
) -> Experiment:
    """A sheet hangs from its top corners, of which one goes up and down: `shake_path`."""
    return _moved("shaking", shake_path, hanging(size, height), route, num_frames, interval, path)


def swing(
    size: Size = (SWING_SIDE, SWING_SIDE),
    *,
    route: Route | None = None,
    height: float = GRIP_HEIGHT,
    num_frames: int = SWING_FRAMES,
    interval: float = SWING_INTERVAL,
    **path: float,
) -> Experiment:
    """A sheet hangs from a bar along its warp, which sways and turns; not of the study.

    A `route` is that of both ends of the bar. `path`: see `swing_path`.

    >>> swing((0.3, 0.3)).scenario((4, 4)).path.shape[1]  # vertices along the bar
    4
    """
    moved = _moved("swing", swing_path, hanging(size, height), route, num_frames, interval, path)
    return moved._replace(clamps=BAR)


SCENARIOS: dict[str, Callable[..., Experiment]] = {
    "lifting": lifting,
    "wind": wind,
    "stretching": stretching,
    "folding": folding,
    "fling": fling,
    "shaking": shaking,
}


def varied(
    name: str, number: int, size: Size = (SIDE, SIDE), *, key: PRNGKeyArray
) -> list[Experiment]:
    """`number` experiments of a scenario, their numbers drawn within `r2s.scenarios.paths.LIMITS`.

    The study has `ESTIMATION` of each to estimate from and `EVALUATION` to judge by:
    split a key, so that they differ.
    """
    return [SCENARIOS[name](size, **numbers) for numbers in draw(name, number, key=key)]


def on_table(size: Size, pinned: tuple[str, ...], height: float = CLEARANCE) -> SheetPlacement:
    """A sheet of `size` [m], horizontal at a `height` [m], warp along x and weft along y."""
    not_negative("m", height=height)
    return SheetPlacement(size, (0.0, 0.0, height), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), pinned)


def hanging(size: Size, height: float) -> SheetPlacement:
    """A sheet of `size` [m], vertical, held by the ends of its warp at a `height` [m], along x."""
    positive("m", height=height)
    pinned = ("origin", "warp")
    return SheetPlacement(size, (0.0, 0.0, height), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0), pinned)


def _moved(
    name: str,
    made: Callable[..., Route],
    sheet: SheetPlacement,
    route: Route | None,
    num_frames: int,
    interval: float,
    path: dict[str, float],
) -> Experiment:
    """An experiment all of whose frames count, on a `route` or on the path `made` of numbers."""
    if num_frames < 2:
        raise ValueError(f"num_frames must be at least 2, found {num_frames}")
    positive("s", interval=interval)
    if route is not None and path:
        raise ValueError(f"{name}: a route is given, which {', '.join(path)} would not change")
    times = np.arange(num_frames) * interval
    route = made(sheet, times[-1], **path) if route is None else route
    if (far := float(np.abs(route.path).max())) > FARTHEST:
        raise ValueError(f"{name}: the grippers go {far:g} m far: lengths are in metres")
    return Experiment(name, sheet, route, times, (0, num_frames - 1))
