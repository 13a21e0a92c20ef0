"""Wrinkles finer than a mesh: a cell that is compressed gives way as the sheet within it buckles.

A thin sheet hardly resists compression: it buckles. Wrinkles that are longer than two cells are the
mesh's own. A cell cannot take a shorter one, nor a fold across its middle, but by compressing its
membrane, hundreds of times as stiff as bending: the mesh locks. So the strain of a sample is
shortened by wrinkles that are not seen, L >= 0 (a symmetric matrix), which cost as much as the
shortest of them, of one cell's length: waves of wavenumber k and shortening L store the energy
B k^2 tr L, with the bending stiffness B. The energy that is left is

    min over L >= 0 of  W(E + L) + B k^2 tr L

(the relaxed energy of tension fields, Pipkin 1986, with a price on wrinkles). Below the critical
stress B k^2 = B (2 pi / cell)^2 nothing changes, and that grows without limit as cells shrink.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.geometry.strain_samples import StrainSamples
from r2s.laws.bending import BendingLaw
from r2s.laws.membrane import MembraneLaw

SHARE = 0.05  # of the resistance to compression that stays, so that no state is left without any
CROSS = 0.98  # of the coupling at most, against which wrinkles are found
LEAST = 1e-3  # stiffness that wrinkles are found against, of the largest
ROOT = 2**0.5
DESCENTS, SOLVES = 2, 6  # to rounding in 200,000 random cases of float64

Symmetric = Float[Array, " 3"]  # (11, 22, sqrt(2) 12): its squares add up to the matrix's
Matrix = Float[Array, "3 3"]


class Wrinkled(eqx.Module):
    """A membrane law whose compression gives way to wrinkles that the mesh does not show.

    What gives way is that of the law's stiffness at zero strain, all but `SHARE` of it.

    - `law`: the law of a sheet without them.
    - `stiffness`: its second derivative at zero strain, [N/m].
    - `critical`: compressive stress at which it buckles, [N/m].
    """

    law: MembraneLaw
    stiffness: Matrix
    critical: Float[Array, ""]

    def energy_density(self, strain: Float[Array, " 3"]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a Green strain (E11, E22, 2 E12) [-]."""
        freed = released(self.stiffness, self.critical, strain)
        return self.law.energy_density(strain) - (1 - SHARE) * freed


def membrane_on_samples(
    samples: StrainSamples,
    membrane: MembraneLaw,
    bending: BendingLaw,
    strain: Float[Array, "element sample 3"],
) -> Any:
    """The membrane law of every sample in a time step that starts near a strain [-].

    On quadrilaterals these are `Wrinkled`. The bending stiffness is the mean along warp and weft.
    """
    laws = jax.vmap(jax.vmap(membrane.at))(strain)
    if samples.hidden_waves is None:
        return laws
    zero = jnp.zeros_like(strain)
    stiffness = jax.vmap(jax.vmap(lambda law, none: jax.hessian(law.energy_density)(none)))
    bent = (bending.stiffness_along(0.0) + bending.stiffness_along(jnp.pi / 2)) / 2
    critical = bent * samples.hidden_waves[:, None] ** 2
    return Wrinkled(laws, stiffness(laws, zero), jnp.broadcast_to(critical, strain.shape[:2]))


@jax.custom_jvp
def released(
    stiffness: Matrix, critical: Float[Array, ""], strain: Float[Array, " 3"]
) -> Float[Array, ""]:
    """The energy per area [J/m^2] that wrinkles release, zero or more.

    - `stiffness`: against (E11, E22, 2 E12), positive definite, [N/m].
    - `critical`: compressive stress at which they begin, [N/m].
    - `strain`: (E11, E22, 2 E12) [-].
    """
    return -_cost(_hidden(stiffness, critical, strain), stiffness, critical, strain)


@released.defjvp
def _released_jvp(primals, tangents):
    # the hidden strain is optimal, so its change does not count (it does in the next derivative)
    hidden = _hidden(*primals)
    value, change = jax.jvp(lambda *given: -_cost(hidden, *given), primals, tangents)
    return value, change


def _cost(hidden: Symmetric, stiffness: Matrix, critical, strain) -> Float[Array, ""]:
    """What hidden wrinkles cost [J/m^2], on the scales of `_scales`."""
    quadratic, linear, _ = _problem(stiffness, critical, strain)
    return hidden @ quadratic @ hidden / 2 + linear @ hidden


def _problem(stiffness: Matrix, critical, strain) -> tuple[Matrix, Symmetric, Array]:
    """Second and first derivative of the cost without wrinkles; a bound on the second.

    Wrinkles are scaled along warp and weft by fourth roots of their stiffness, which keeps them
    symmetric and positive, and makes all fabrics alike.
    """
    warp, weft = stiffness[0, 0] ** -0.5, stiffness[1, 1] ** -0.5
    to_strain = jnp.stack([warp, weft, ROOT * jnp.sqrt(warp * weft)])  # with 2 E12
    scaled = stiffness * to_strain * to_strain[:, None]
    limit = jnp.array([[1, CROSS, 1], [CROSS, 1, 1], [1, 1, jnp.inf]], scaled.dtype)
    quadratic = jnp.clip(scaled, -limit, limit) + LEAST * jnp.eye(3, dtype=scaled.dtype)
    price = critical * jnp.stack([warp, weft, jnp.zeros_like(warp)])
    bound = jnp.max(jnp.sum(jnp.abs(quadratic), axis=1))
    return quadratic, to_strain * (stiffness @ strain) + price, bound


@jax.custom_jvp
def _hidden(stiffness: Matrix, critical, strain) -> Symmetric:
    """The scaled wrinkles that release most: projected descents, then a semismooth Newton method."""
    quadratic, linear, bound = _problem(stiffness, critical, strain)

    def descent(hidden, _):
        return _positive(hidden - (quadratic @ hidden + linear) / bound), None

    def solve(hidden, _):
        before = hidden - (quadratic @ hidden + linear) / bound
        slope = _positive_slope(before)
        matrix = jnp.eye(3, dtype=slope.dtype) - slope + slope @ quadratic / bound
        return hidden - _solve3(matrix, hidden - _positive(before)), None

    hidden, _ = jax.lax.scan(descent, jnp.zeros_like(linear), length=DESCENTS, unroll=True)
    hidden, _ = jax.lax.scan(solve, hidden, length=SOLVES, unroll=True)
    return hidden


@_hidden.defjvp
def _hidden_jvp(primals, tangents):
    """By the implicit function theorem, from what the wrinkles solve."""
    hidden = _hidden(*primals)

    def before(*given):
        quadratic, linear, bound = _problem(*given)
        return hidden - (quadratic @ hidden + linear) / bound

    quadratic, _, bound = _problem(*primals)
    unprojected, change = jax.jvp(before, primals, tangents)
    slope = _positive_slope(unprojected)
    matrix = jnp.eye(3, dtype=slope.dtype) - slope + slope @ quadratic / bound
    return hidden, _solve3(matrix, slope @ change)


def _principal(matrix: Symmetric) -> tuple[Array, Array, Array, Array]:
    """Mean and radius of the principal values; cosine and sine of twice the first one's angle."""
    mean, half, shear = (matrix[0] + matrix[1]) / 2, (matrix[0] - matrix[1]) / 2, matrix[2] / ROOT
    squared = half**2 + shear**2
    has_axes = squared > jnp.finfo(squared.dtype).tiny
    radius = jnp.where(has_axes, jnp.sqrt(jnp.where(has_axes, squared, 1)), 0)
    length = jnp.where(has_axes, radius, 1)
    return mean, radius, jnp.where(has_axes, half / length, 1), shear / length


def _positive(matrix: Symmetric) -> Symmetric:
    """The nearest matrix without negative principal values."""
    mean, radius, cosine, sine = _principal(matrix)
    high, low = jnp.maximum(mean + radius, 0), jnp.maximum(mean - radius, 0)
    half = (high - low) / 2
    return (high + low) / 2 * jnp.array([1.0, 1, 0]) + half * jnp.stack(
        [cosine, -cosine, ROOT * sine]
    )


def _positive_slope(matrix: Symmetric) -> Matrix:
    """The derivative of `_positive`."""
    mean, radius, cosine, sine = _principal(matrix)
    high, low = mean + radius, mean - radius
    along, across = (high > 0) * 1.0, (low > 0) * 1.0
    width = jnp.where(radius > 0, 2 * radius, 1)
    turned = (jnp.maximum(high, 0) - jnp.maximum(low, 0)) / width
    turned = jnp.where(radius > 0, turned, along)
    sum_, difference = jnp.array([1.0, 1, 0]), jnp.stack([cosine, -cosine, ROOT * sine])
    first, second = (sum_ + difference) / 2, (sum_ - difference) / 2
    third = jnp.stack([-sine, sine, ROOT * cosine]) / ROOT
    return (
        along * jnp.outer(first, first)
        + across * jnp.outer(second, second)
        + turned * jnp.outer(third, third)
    )


def _solve3(matrix: Matrix, right: Symmetric) -> Symmetric:
    """The solution of three equations, without a call per sample into LAPACK."""
    rows = jnp.stack(
        [
            jnp.cross(matrix[1], matrix[2]),
            jnp.cross(matrix[2], matrix[0]),
            jnp.cross(matrix[0], matrix[1]),
        ]
    )
    return right @ rows / (matrix[0] @ rows[0])
