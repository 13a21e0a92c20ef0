"""The six scenarios of the study, each a function of the sheet's size and the grippers' path.

An experiment does not know how it will be simulated: `Experiment.scenario` puts it on a mesh. The
grippers follow a `route` that was recorded, or a smooth path made from a few numbers, whose limits
are in `LIMITS`. The speed of a path is continuous, and zero at both ends; numbers that make no
sense, or with which it would not be at rest after its `duration`, raise a `ValueError`.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from scipy.spatial.transform import Rotation

from r2s._util.units import not_negative, positive
from r2s.recordings.recording import SheetPlacement, corner
from r2s.scenarios.scenario import BAR, CLAMPS, CLEARANCE, Scenario, from_placement

KNOT_RATE = 120.0  # [1/s]: in a fling of 20 m/s^2 the speed jumps by 0.17 m/s from knot to knot
UP = np.array([0.0, 0.0, 1.0])
OPPOSITE = {"origin": "opposite", "opposite": "origin", "warp": "weft", "weft": "warp"}
TABLE_GAP = 0.01  # [m], between the table and a corner that was folded over
FASTEST = KNOT_RATE / 10  # [1/s], of an oscillation: ten knots a period show its shape


class Route(NamedTuple):
    """Where grippers go, linear between knots: times [s], and positions [m] of each gripper."""

    times: Float[np.ndarray, " knot"]
    path: Float[np.ndarray, "knot gripper 3"]


LIMITS: dict[str, dict[str, tuple[float, float]]] = {
    "lifting": {"height": (0.15, 0.4), "inward": (0.0, 0.2), "moving": (1.5, 3.0)},
    "wind": {"gap": (0.85, 1.0), "speed": (1.5, 3.5), "aside": (-20.0, 20.0)},
    "stretching": {"strain": (0.01, 0.06), "moving": (0.5, 1.5)},
    "folding": {"reach": (0.75, 0.97), "height": (0.2, 0.4), "moving": (1.5, 3.0)},
    "fling": {"gap": (0.85, 1.0), "forward": (0.2, 0.45), "there": (0.4, 0.7), "back": (0.5, 0.9)},
    "shaking": {"gap": (0.85, 1.0), "amplitude": (0.03, 0.08), "frequency": (1.0, 2.0)},
}
"""Of each number of each scenario, between which it is drawn; units: see the functions."""

ESTIMATION, EVALUATION = 40, 120  # motions of each scenario in the study


def draw(scenario: str, number: int, *, key: PRNGKeyArray) -> list[dict[str, float]]:
    """`number` sets of a scenario's numbers, uniform in their limits, the same in any precision.

    Raises `ValueError` for an unknown scenario.
    """
    if scenario not in LIMITS:
        raise ValueError(f"a scenario is one of {list(LIMITS)}, got {scenario!r}")
    limits = LIMITS[scenario]
    low, high = np.array(list(limits.values())).T
    places = np.asarray(jr.uniform(key, (number, len(limits)), jnp.float32), np.float64)
    return [dict(zip(limits, row, strict=True)) for row in (low + places * (high - low)).tolist()]


def ease(progress: Float[np.ndarray, " knot"]) -> Float[np.ndarray, " knot"]:
    """From 0 to 1 while `progress` does, at rest before and after; 1.5 times as fast midway."""
    progress = np.clip(progress, 0, 1)
    return progress**2 * (3 - 2 * progress)


def lift_path(
    sheet: SheetPlacement,
    duration: float,
    height: float = 0.35,
    inward: float = 0.15,
    moving: float = 2.5,
) -> Route:
    """The held corner goes up by `height` and towards the opposite one by `inward` [m].

    It moves for `moving` of `duration` [s].

    >>> path = lift_path(on_table((0.3, 0.3), ("origin",)), 4.0, height=0.2, inward=0.0).path
    >>> np.asarray(path[-1, 0]).round(3).tolist()
    [0.0, 0.0, 0.201]
    """
    not_negative("m", height=height, inward=inward)
    positive("s", moving=moving)
    _ends(duration, "moving", moving)
    here, there = _corner(sheet), corner(sheet, OPPOSITE[sheet.held[0]])
    away = inward * _unit(there - here) + height * UP
    return _route(duration, lambda t: here + ease(t / moving)[:, None] * away)


def fold_path(
    sheet: SheetPlacement,
    duration: float,
    reach: float = 0.92,
    height: float = 0.3,
    moving: float = 2.5,
) -> Route:
    """The held corner goes over to the opposite one, on half an ellipse, in `moving` [s].

    It ends after the fraction `reach` [-] of the way; `height` [-] is the ellipse's over that way.
    """
    _share("reach", reach)
    not_negative("-", height=height)
    positive("s", moving=moving)
    _ends(duration, "moving", moving)
    here, there = _corner(sheet), corner(sheet, OPPOSITE[sheet.held[0]])
    across = reach * (there - here)
    up = height * float(np.linalg.norm(across)) * UP

    def at(t):
        done = ease(t / moving)
        angle = np.pi * done
        over = (1 - np.cos(angle))[:, None] / 2 * across + np.sin(angle)[:, None] * up
        return here + over + TABLE_GAP * done[:, None] * UP

    return _route(duration, at)


def pull_path(
    sheet: SheetPlacement, duration: float, strain: float = 0.04, moving: float = 1.0
) -> Route:
    """Two clamps from corner to corner: that at the warp's end is pulled in `moving` [s].

    By `strain` [-] times the sheet's length. The grippers are the held corners.
    """
    not_negative("-", strain=strain)
    positive("s", moving=moving)
    _ends(duration, "moving", moving)
    corners = np.array([corner(sheet, name) for name in sheet.held])
    pulled = np.array([name in ("warp", "opposite") for name in sheet.held], float)
    away = strain * sheet.size[0] * np.outer(pulled, sheet.warp)
    return _route(duration, lambda t: corners + ease(t / moving)[:, None, None] * away)


def hold_path(sheet: SheetPlacement, duration: float, gap: float = 0.95) -> Route:
    """Two grippers that stay, apart by `gap` [-] times the way between their corners."""
    corners = _drawn_together(sheet, gap)
    return _route(duration, lambda t: corners + 0 * t[:, None, None])


def fling_path(
    sheet: SheetPlacement,
    duration: float,
    gap: float = 0.95,
    forward: float = 0.35,
    there: float = 0.5,
    back: float = 0.6,
    wait: float = 0.3,
) -> Route:
    """Two grippers go `forward` [m] in `there` [s] and come back in `back` [s], after `wait` [s].

    Forward is horizontal, 90 degrees to the left of the direction from the first to the second
    gripper. The greatest acceleration is 6 forward / there^2.
    """
    not_negative("m", forward=forward)
    positive("s", there=there, back=back)
    not_negative("s", wait=wait)
    _ends(duration, "wait + there + back", wait + there + back)
    corners = _drawn_together(sheet, gap)
    direction = np.cross(UP, _unit(corners[1] - corners[0]))

    def at(t):
        away = ease((t - wait) / there) - ease((t - wait - there) / back)
        return corners + forward * away[:, None, None] * direction

    return _route(duration, at)


def shake_path(
    sheet: SheetPlacement,
    duration: float,
    gap: float = 0.95,
    amplitude: float = 0.06,
    frequency: float = 1.5,
    fade: float = 0.5,
    still: float = 0.5,
) -> Route:
    """Two grippers, of which the second goes up and down by `amplitude` [m], `frequency` [1/s].

    The amplitude rises and falls in `fade` [s]; the last `still` of `duration` [s] is at rest.
    """
    not_negative("m", amplitude=amplitude)
    _check_frequency(frequency)
    positive("s", fade=fade)
    not_negative("s", still=still)
    _ends(duration, "2 fade + still", 2 * fade + still)
    corners = _drawn_together(sheet, gap)
    which = np.array([[0.0], [1.0]]) * UP

    def at(t):
        strength = ease(t / fade) * ease((duration - still - t) / fade)
        height = amplitude * strength * np.sin(2 * np.pi * frequency * t)
        return corners + height[:, None, None] * which

    return _route(duration, at)


def swing_path(
    sheet: SheetPlacement,
    duration: float,
    sway: float = 0.1,
    turn: float = 30.0,
    frequency: float = 0.8,
) -> Route:
    """Both ends of a bar, which goes out of the sheet's plane by `sway` [m] to either side, and
    turns about the vertical through its middle by `turn` [degrees], both at `frequency` [1/s]."""
    not_negative("m", sway=sway)
    not_negative("degrees", turn=turn)
    _check_frequency(frequency)
    ends = np.array([corner(sheet, name) for name in sheet.held])
    middle = ends.mean(axis=0)

    def at(t):
        swell, phase = np.sin(np.pi * t / duration) ** 2, 2 * np.pi * frequency * t
        angle = np.radians(turn) * swell * np.cos(phase)
        turned = Rotation.from_rotvec(np.outer(angle, UP)).as_matrix()
        aside = (sway * swell * np.sin(phase))[:, None, None] * np.array([0.0, 1.0, 0.0])
        return middle + np.einsum("kij,ej->kei", turned, ends - middle) + aside

    return _route(duration, at)


def _check_frequency(frequency: float) -> None:
    positive("1/s", frequency=frequency)
    if frequency > FASTEST:
        raise ValueError(f"frequency must be at most {FASTEST:g} 1/s, found {frequency}")


def _share(name: str, value: float) -> None:
    if not 0 < value <= 1:
        raise ValueError(f"{name} must be above 0 and at most 1 [-], found {value}")


def _ends(duration: float, what: str, needed: float) -> None:
    """The path is at rest when it ends."""
    if needed > duration + 1e-9:
        raise ValueError(
            f"{what} is {needed:g} s, but the path ends after {duration:g} s: move faster, or "
            "take more frames"
        )


def _route(duration: float, at: Callable[[np.ndarray], np.ndarray]) -> Route:
    """A function of time [s], at knots `1 / KNOT_RATE` apart or less that end at `duration`."""
    positive("s", duration=duration)
    times = np.linspace(0, duration, int(np.ceil(duration * KNOT_RATE - 1e-9)) + 1)
    path = at(times)
    return Route(times, path[:, None] if path.ndim == 2 else path)


def _corner(sheet: SheetPlacement) -> Float[np.ndarray, "3"]:
    if len(sheet.held) != 1:
        raise ValueError(f"this path is of one gripper, the sheet is held at {sheet.held}")
    return corner(sheet, sheet.held[0])


def _drawn_together(sheet: SheetPlacement, gap: float) -> Float[np.ndarray, "2 3"]:
    if len(sheet.held) != 2:
        raise ValueError(f"this path is of two grippers, the sheet is held at {sheet.held}")
    _share("gap", gap)
    corners = np.array([corner(sheet, name) for name in sheet.held])
    middle = corners.mean(axis=0)
    return middle + gap * (corners - middle)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


SIDE = 0.45  # [m], the study's sheets
NUM_FRAMES = 60
INTERVAL, STRETCHING_INTERVAL = 1 / 15, 1 / 30  # [s]
SWING_SIDE, SWING_FRAMES, SWING_INTERVAL = 0.3, 50, 0.1  # [m], -, [s]: those of public swings
GRIP_HEIGHT = 0.7  # [m] above the table, of a hanging sheet's grippers
ALL_CORNERS = ("origin", "weft", "warp", "opposite")
Size = tuple[float, float]


class Experiment(NamedTuple):
    """What is done to a sheet, for any fabric and any solver.

    - `sheet`: where it is at rest, and which corners the grippers hold; `route`: their path.
    - `times`: of the frames, [s]. `frames_used`: the first and the last frame that count.
    - `wind`: of a fan in front of the sheet's middle, from the first frame on, [m/s]; None: none.
    - `clamps`: pairs of held corners between which the whole side is held.
    - `table_height`: [m].
    """

    name: str
    sheet: SheetPlacement
    route: Route
    times: Float[np.ndarray, " frame"]
    frames_used: tuple[int, int]
    wind: tuple[float, float, float] | None = None
    clamps: tuple[tuple[str, str], ...] = ()
    table_height: float = 0.0

    def scenario(
        self,
        shape: tuple[int, int] = (9, 9),
        self_contact: bool = False,
        elements: str = "wrinkling",
    ) -> Scenario:
        """On a mesh of `shape` vertices along warp and weft, made of `elements`
        (`r2s.mesh.mesh.rectangle`); with `self_contact` it does not pass through itself."""
        return from_placement(
            self.sheet,
            self.table_height,
            jnp.asarray(self.route.path, float),
            jnp.asarray(self.route.times, float),
            self.times,
            shape,
            elements=elements,
            clamps=self.clamps,
            wind=self.wind,
            self_contact=self_contact,
        )


def lifting(
    size: Size = (SIDE, SIDE),
    held: str = "origin",
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
    done = _moved("lifting", on_table(size, (held,)), route, num_frames, interval, path)
    return done._replace(frames_used=(num_frames // 2, num_frames - 1))


def folding(
    size: Size = (SIDE, SIDE),
    held: str = "origin",
    *,
    route: Route | None = None,
    num_frames: int = NUM_FRAMES,
    interval: float = INTERVAL,
    **path: float,
) -> Experiment:
    """A sheet lies flat on the table; a corner is brought onto the opposite one: `fold_path`."""
    return _moved("folding", on_table(size, (held,)), route, num_frames, interval, path)


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
    return _moved("stretching", sheet, route, num_frames, interval, path)._replace(clamps=CLAMPS)


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
    done = _moved("wind", hanging(size, height), route, num_frames, interval, path)
    return done._replace(wind=blows)


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
    return _moved("fling", hanging(size, height), route, num_frames, interval, path)


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
    return _moved("shaking", hanging(size, height), route, num_frames, interval, path)


def swing(
    size: Size = (SWING_SIDE, SWING_SIDE),
    *,
    route: Route | None = None,
    height: float = GRIP_HEIGHT,
    num_frames: int = SWING_FRAMES,
    interval: float = SWING_INTERVAL,
    **path: float,
) -> Experiment:
    """A sheet hangs from a bar along its warp, which goes to and fro and turns; not of the study.

    A `route` is that of both ends of the bar. `path`: see `swing_path`.

    >>> swing((0.3, 0.3)).scenario((4, 4)).path.shape[1]  # vertices along the bar
    4
    """
    sheet = hanging(size, height)
    return _moved("swing", sheet, route, num_frames, interval, path)._replace(clamps=BAR)


SIX: dict[str, Callable[..., Experiment]] = {
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
    """`number` experiments of a scenario, their numbers drawn within `LIMITS`.

    The study has `ESTIMATION` of each to estimate from and `EVALUATION` to judge by:
    split a key, so that they differ.
    """
    return [SIX[name](size, **numbers) for numbers in draw(name, number, key=key)]


def on_table(size: Size, held: tuple[str, ...], height: float = CLEARANCE) -> SheetPlacement:
    """A sheet of `size` [m], horizontal at a `height` [m], warp along x and weft along y."""
    not_negative("m", height=height)
    return SheetPlacement(size, (0.0, 0.0, height), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), held)


def hanging(size: Size, height: float) -> SheetPlacement:
    """A sheet of `size` [m], vertical, held by the ends of its warp at a `height` [m], along x."""
    positive("m", height=height)
    held = ("origin", "warp")
    return SheetPlacement(size, (0.0, 0.0, height), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0), held)


_PATHS: dict[str, Callable[..., Route]] = {
    "lifting": lift_path,
    "wind": hold_path,
    "stretching": pull_path,
    "folding": fold_path,
    "fling": fling_path,
    "shaking": shake_path,
    "swing": swing_path,
}


def _moved(
    name: str,
    sheet: SheetPlacement,
    route: Route | None,
    num_frames: int,
    interval: float,
    path: dict[str, float],
) -> Experiment:
    """An experiment all of whose frames count: on a `route`, or on the path of these numbers."""
    if num_frames < 2:
        raise ValueError(f"num_frames must be at least 2, found {num_frames}")
    positive("s", interval=interval)
    if route is not None and path:
        raise ValueError(f"{name}: a route is given, which {', '.join(path)} would not change")
    times = np.arange(num_frames) * interval
    route = _PATHS[name](sheet, times[-1], **path) if route is None else route
    return Experiment(name, sheet, route, times, (0, num_frames - 1))
