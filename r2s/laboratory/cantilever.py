"""The cantilever test of bending (ASTM D1388, option A; Peirce 1930).

A strip is slid over an edge until the line from the edge to its tip falls by 41.5 degrees. The
shape is that of a heavy elastica, B psi'' = -density g s cos(psi), s from the tip: all strips have
the same one in units of (B / (density g))^(1/3), so that the overhang is that length times a
number. It is solved for; the standard takes half the overhang for the bending length, which is
right to 0.02 %. A strip is taken to bend as a cylinder, without curving across.
"""

from collections.abc import Sequence
from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.integrate import solve_ivp
from scipy.optimize import root_scalar

from r2s._util.units import GRAVITY
from r2s.materials.fabric import Fabric

SLOPE = np.radians(41.5)  # of the standard's plane [rad]
DEVIATION = 0.03  # relative, of an overhang


class Cantilever(eqx.Module):
    """Overhangs of strips of one direction.

    - `overhang`: mean over strips, sides and ends, [m].
    - `deviation`: standard error of the logarithm of that mean, [-].
    - `direction`: of the strip, from the warp, [rad]: 0, pi/2, or pi/4 for the bias.
    - `name`: for messages.
    """

    overhang: Float[Array, ""]
    deviation: Float[Array, ""]
    direction: float = eqx.field(static=True, default=0.0)
    name: str = eqx.field(static=True, default="cantilever")

    @classmethod
    def make(
        cls, overhangs: Sequence[float], direction: float = 0.0, name: str = "cantilever"
    ) -> "Cantilever":
        """From the readings [m] of one direction; see the fields.

        Their mean errs by `DEVIATION`, or by what the readings say where that is more.

        Raises `ValueError` that names the test: no reading, one that is none in metres, readings
        that differ by more than a factor of two.
        """
        read = np.asarray(overhangs, float)
        if read.ndim != 1 or not read.size or not np.isfinite(read).all() or not (read > 0).all():
            raise ValueError(f"{name}: overhangs must be positive [m], got {read.tolist()}")
        if read.max() > 0.5 or read.min() < 0.005:
            raise ValueError(
                f"{name}: overhangs of fabrics are 0.005 to 0.5 m, got {read.tolist()}: are they "
                "in centimetres, or bending lengths?"
            )
        if read.max() > 2 * read.min():
            raise ValueError(
                f"{name}: the readings differ by more than twice, {read.tolist()} m: are they of "
                "one direction?"
            )
        scatter = np.std(np.log(read), ddof=1) / np.sqrt(len(read)) if len(read) > 1 else 0.0
        spread = max(float(scatter), DEVIATION)
        mean = float(np.exp(np.mean(np.log(read))))
        return cls(jnp.asarray(mean, float), jnp.asarray(spread, float), direction, name)

    @property
    def count(self) -> int:
        """How many data it has."""
        return 1

    def residuals(self, fabric: Fabric) -> Float[Array, " 1"]:
        """How far a fabric's overhang is from the measured one, in standard deviations."""
        expected = overhang(fabric, self.direction)
        return jnp.log(expected / self.overhang)[None] / self.deviation


def overhang(fabric: Fabric, direction: float = 0.0, slope: float = SLOPE) -> Float[Array, ""]:
    """The overhang [m] at which a strip's tip has fallen by a slope [rad].

    `direction`: of the strip from the warp, [rad]. Of a law whose stiffness follows the curvature
    it takes that of the flat sheet.

    >>> from r2s.materials import presets
    >>> round(float(100 * overhang(presets.black_denim())), 1)  # [cm]
    3.6
    """
    stiffness = fabric.bending.stiffness_along(direction)
    return _in_lengths(float(slope)) * (stiffness / (fabric.density * GRAVITY)) ** (1 / 3)


@cache
def _in_lengths(slope: float) -> float:
    """The overhang in units of (B / (density g))^(1/3), [-]."""
    low, high = 1e-3, np.pi / 2 - 1e-3  # of the tip's own slope
    tip = root_scalar(lambda start: _hung(float(start))[1] - slope, bracket=(low, high)).root
    return _hung(float(tip))[0]


def _hung(tip: float) -> tuple[float, float]:
    """Length [-] and slope of the chord [rad] of a strip whose tip has a slope [rad]."""

    def along(s, state):
        psi, bent = state[:2]
        return [bent, -s * np.cos(psi), np.cos(psi), np.sin(psi)]

    def level(s, state):
        return state[0]

    level.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
    start = [tip, 0.0, 0.0, 0.0]
    found = solve_ivp(along, (0, 100), start, events=level, rtol=1e-9, atol=1e-12)
    _, _, run, drop = found.y[:, -1]
    return float(found.t[-1]), float(np.arctan2(drop, run))
