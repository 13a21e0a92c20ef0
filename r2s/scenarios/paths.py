"""Paths of the grippers in the six scenarios, each made from a few numbers.

Their limits are in `LIMITS`. The speed of a path is continuous, and zero at both ends; numbers that
make no sense, or with which it would not be at rest after its `duration`, raise a `ValueError`.
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
    """The pinned corner goes up by `height` and towards the opposite one by `inward` [m].

    It moves for `moving` of `duration` [s].

    >>> from r2s.scenarios.standard import on_table
    >>> path = lift_path(on_table((0.3, 0.3), ("origin",)), 4.0, height=0.2, inward=0.0).path
    >>> np.asarray(path[-1, 0]).round(3).tolist()
    [0.0, 0.0, 0.201]
    """
    not_negative("m", height=height, inward=inward)
    positive("s", moving=moving)
    _ends(duration, "moving", moving)
    here, there = _corner(sheet), corner(sheet, OPPOSITE[sheet.pinned[0]])
    away = inward * _unit(there - here) + height * UP
    return _route(duration, lambda t: here + ease(t / moving)[:, None] * away)


def fold_path(
    sheet: SheetPlacement,
    duration: float,
    reach: float = 0.92,
    height: float = 0.3,
    moving: float = 2.5,
) -> Route:
    """The pinned corner goes over to the opposite one, on half an ellipse, in `moving` [s].

    It ends after the fraction `reach` [-] of the way; `height` [-] is the ellipse's over that way.
    """
    _share("reach", reach)
    not_negative("-", height=height)
    positive("s", moving=moving)
    _ends(duration, "moving", moving)
    here, there = _corner(sheet), corner(sheet, OPPOSITE[sheet.pinned[0]])
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

    By `strain` [-] times the sheet's length. The grippers are the pinned corners.
    """
    not_negative("-", strain=strain)
    positive("s", moving=moving)
    _ends(duration, "moving", moving)
    corners = np.array([corner(sheet, name) for name in sheet.pinned])
    pulled = np.array([name in ("warp", "opposite") for name in sheet.pinned], float)
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
    ends = np.array([corner(sheet, name) for name in sheet.pinned])
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
    if len(sheet.pinned) != 1:
        raise ValueError(f"this path is of one gripper, the sheet is pinned at {sheet.pinned}")
    return corner(sheet, sheet.pinned[0])


def _drawn_together(sheet: SheetPlacement, gap: float) -> Float[np.ndarray, "2 3"]:
    if len(sheet.pinned) != 2:
        raise ValueError(f"this path is of two grippers, the sheet is pinned at {sheet.pinned}")
    _share("gap", gap)
    corners = np.array([corner(sheet, name) for name in sheet.pinned])
    middle = corners.mean(axis=0)
    return middle + gap * (corners - middle)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
