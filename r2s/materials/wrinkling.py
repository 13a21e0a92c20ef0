"""Wrinkles finer than a mesh: a cell that is compressed gives way as the sheet within it buckles.

A thin sheet hardly resists compression: it buckles. A mesh shows wrinkles that are longer than two
cells. For a shorter one, or a fold across its middle, a cell would have to compress its membrane,
hundreds of times as stiff as bending: the mesh locks. So the strain of a sample is shortened by
hidden wrinkles L >= 0 (a symmetric matrix) of one cell's length: waves of wavenumber k and
shortening L store the energy B k^2 L, with the bending stiffness B, along either side of the cell.
The energy of a sample is

    min over L >= 0 of  W(E + L) + B (k1^2 L11 + k2^2 L22)

(the relaxed energy of tension fields, Pipkin 1986, with a price on wrinkles). The critical
stress B k^2 = B (2 pi / side)^2 grows without limit as cells shrink. Wrinkles begin gradually from
half of it on (by another convex term of the cost; nearer to it along the less stiff yarns), so that
the stiffness has no jump, over which Newton's method would alternate.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s._util.arrays import once
from r2s.materials.bending import BendingLaw
from r2s.materials.membrane import MembraneLaw, stress_and_tangent
from r2s.mesh.strain_samples import StrainSamples, on_samples
from r2s.mesh.vectors import (
    Matrix,
    Number,
    Vector,
    add,
    dot,
    inverse,
    product,
    scale,
    solve,
    subtract,
    times,
    transposed,
)

SHARE = 0.05  # of the resistance to compression that stays, so that no state is left without any
CROSS = 0.98  # of the coupling at most, against which wrinkles are found
LEAST = 1e-3  # stiffness that wrinkles are found against, of the largest
ONSET = 0.5  # of the critical stress, on either side of it, over which wrinkles begin
FEWEST = 1e-5  # strain at which they begin at least, without bending
MOST = 0.4  # Green strain that they hide: a cell without length (0.5) would have bends without end
# Of 100,000 fabrics and strains at random none needs more than 10 solves in float64.
DESCENTS, SOLVES, CLOSE = 2, 12, 16  # the last in units of rounding
ROOT = 2**0.5

Columns = Float[Array, "3 *sample"]
Tangents = Float[Array, "3 3 *sample"]
# A `Vector` is a symmetric matrix (11, 22, sqrt(2) 12), of one sample or of all side by side.
Principal = tuple[Number, Number, Number, Number]  # see `_principal_of`


class Prepared(NamedTuple):
    """The search for wrinkles, on the scales of `prepare_search`.

    - `quadratic`: second derivative of their cost.
    - `offset`, `by_strain`: its first derivative at no strain, and by strain.
    - `bound`: on the second derivative. `width`: unit of wrinkles. `most`: of them, in this unit.
    """

    quadratic: Matrix
    offset: Vector
    by_strain: Matrix
    bound: Number
    width: Number
    most: Number


class Wrinkled(eqx.Module):
    """A membrane law with wrinkles that the mesh does not show.

    They release compression by the law's stiffness at zero strain, all but `SHARE` of it.

    - `law`: the law of a sheet without them.
    - `critical`: compressive stress at which it buckles along warp and weft, [N/m].
    - `prepared`: the search for wrinkles of that stiffness and stress.
    - `hidden`: known wrinkles, from `search`; None: they are searched for.
    """

    law: Any
    critical: Float[Array, "*batch 2"]
    prepared: Prepared
    hidden: Vector | None = None

    def at(self, strain: Float[Array, " 3"]) -> "Wrinkled":
        """Itself: it is the law of a time step already."""
        return self

    def energy_density(self, strain: Float[Array, " 3"]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a Green strain (E11, E22, 2 E12) [-].

        With known wrinkles the first derivative is right, since they are optimal, but no other.
        """
        if self.hidden is None:
            energy = released(self.prepared, strain)
        else:
            energy = -_cost(self.hidden, _at_strain(self.prepared, strain))
        return self.law.energy_density(strain) - (1 - SHARE) * energy


def split(law: Any) -> tuple[Any, Wrinkled | None]:
    """A law of samples without wrinkles, and the law itself where it has them."""
    return (law.law, law) if isinstance(law, Wrinkled) else (law, None)


def given_way(law: Wrinkled, strain: Float[Array, "*sample 3"]) -> tuple[Columns, Tangents]:
    """What known wrinkles add to stress and tangent [N/m] of the law of one sample, or of all."""
    assert law.hidden is not None
    by_strain, hidden = law.prepared.by_strain, law.hidden
    problem = _at_strain(law.prepared, strain)
    principal = once(_principal, hidden, problem)
    slope = once(_limited_slope, principal, problem.most)
    solved = once(lambda *system: inverse(_off_balance(*system)), slope, problem)
    middle = once(product, solved, once(product, slope, by_strain))
    softer = product(transposed(by_strain), middle)
    softening = jnp.stack([jnp.stack(row) for row in softer])
    unit = (1 - SHARE) * law.prepared.width**2 / law.prepared.bound
    return jnp.stack(relieved(law.prepared, hidden)), -unit[None, None] * softening


def tangents_on_samples(
    law: Any, strain: Float[Array, "element sample 3"]
) -> Float[Array, "element sample 3 3"]:
    """The stiffness [N/m] of every sample at its strain [-].

    All wrinkles are found in one loop: their derivative takes a tenth of the time of a `vmap`.
    """
    taut, wrinkled = split(law)
    tangent = on_samples(lambda law, strain: stress_and_tangent(law, strain)[1], taut, strain)
    if wrinkled is None:
        return tangent
    prepared, flat = _in_a_row(wrinkled, strain)
    row = Wrinkled(None, wrinkled.critical, prepared, _hidden(prepared, flat))
    softening = jnp.moveaxis(given_way(row, flat)[1], -1, 0)
    return tangent + softening.reshape(tangent.shape)


def stress_on_samples(
    law: Any, strain: Float[Array, "element sample 3"]
) -> Float[Array, "element sample 3"]:
    """The stress [N/m] of every sample at its strain [-]."""
    taut, wrinkled = split(law)
    stress = on_samples(lambda law, strain: jax.grad(law.energy_density)(strain), taut, strain)
    if wrinkled is None:
        return stress
    # once: the stack would work out all of the derivatives for each of its numbers
    relief = once(lambda law, e: relieved(law, _hidden(law, e)), *_in_a_row(wrinkled, strain))
    return stress + jnp.stack(relief, axis=-1).reshape(stress.shape)


def search(law: Any, strain: Float[Array, "element sample 3"], start: Any = None) -> Any:
    """The wrinkles of all samples at a strain [-], for `Wrinkled.hidden`, without derivatives.

    Arrays over all samples; None for a law without them. A `start` near them shortens the search.
    """
    wrinkled = split(law)[1]
    if wrinkled is None:
        return None
    prepared, flat = jax.lax.stop_gradient(_in_a_row(wrinkled, strain))
    start = no_wrinkles(law) if start is None else start
    hidden = _search(_at_strain(prepared, flat), jax.tree.map(jnp.ravel, start))
    return jax.tree.map(lambda leaf: leaf.reshape(law.prepared.width.shape), hidden)


def no_wrinkles(law: Any) -> Any:
    """A start for `search`."""
    wrinkled = split(law)[1]
    return None if wrinkled is None else _none(wrinkled.prepared)


def with_wrinkles(law: Any, hidden: Any) -> Any:
    """The law of all samples with wrinkles that `search` found."""
    if hidden is None:
        return law
    return eqx.tree_at(lambda law: law.hidden, law, hidden, is_leaf=lambda leaf: leaf is None)


def membrane_on_samples(
    samples: StrainSamples,
    membrane: MembraneLaw,
    bending: BendingLaw,
    strain: Float[Array, "element sample 3"],
) -> Any:
    """The membrane law of every sample in a time step that starts near a strain [-].

    On cells that wrinkle these are `Wrinkled`.
    """
    laws = on_samples(membrane.at, strain)
    if samples.hidden_waves is None:
        return laws
    stiffness = on_samples(
        lambda law, none: jax.hessian(law.energy_density)(none), laws, 0 * strain
    )
    critical = mean_bending(bending) * samples.hidden_waves[:, None] ** 2
    critical = jnp.broadcast_to(critical, (*strain.shape[:2], 2))
    return Wrinkled(laws, critical, on_samples(prepare_search, stiffness, critical))


def mean_bending(bending: BendingLaw) -> Float[Array, ""]:
    """The bending stiffness [N m] of wrinkles: the mean of warp and weft."""
    return (bending.stiffness_along(0.0) + bending.stiffness_along(jnp.pi / 2)) / 2


def follow(law: Prepared, strain: Vector, hidden: Vector) -> Vector:
    """The scaled wrinkles at a strain by one Newton step from those nearby."""
    # in stages: XLA works each of a stage's results out from the beginning
    problem = law._replace(offset=add(times(law.by_strain, strain), law.offset))
    principal = once(_principal, hidden, problem)
    slope, short = once(_off, principal, hidden, law.most)
    matrix = once(_off_balance, slope, law)
    return once(lambda *parts: subtract(parts[2], solve(*parts[:2])), matrix, short, hidden)


def relieved(law: Prepared, hidden: Vector) -> Vector:
    """What scaled wrinkles take off the compressive stress (S11, S22, S12), [N/m]."""
    return scale((1 - SHARE) * law.width**2, times(transposed(law.by_strain), hidden))


@eqx.filter_custom_jvp
def released(prepared: Prepared, strain: Float[Array, " 3"]) -> Number:
    """The energy per area [J/m^2] that wrinkles release at a strain [-], zero or more."""
    return -_cost(_hidden(prepared, strain), _at_strain(prepared, strain))


@released.def_jvp
def _released_jvp(primals, tangents):
    # the wrinkles are optimal, so their change does not count (it does in the next derivative);
    # but those at their limit change with it
    (prepared, strain), hidden = primals, _hidden(*primals)

    def at_this_limit(moved, strain):
        return -_cost(hidden, _at_strain(moved, strain)._replace(most=prepared.most))

    value, change = eqx.filter_jvp(at_this_limit, primals, tangents)
    if tangents[0].most is not None:
        held = _held_back(_principal(hidden, _at_strain(prepared, strain)), prepared.most)
        change = change + prepared.width**2 * prepared.bound * held * tangents[0].most
    return value, change


def _cost(hidden: Vector, problem: Prepared) -> Number:
    """What hidden wrinkles cost [J/m^2], on the scales of `prepare_search`."""
    mean, radius, _, _ = _principal_of(hidden)
    edges = _limit_cost(mean + radius, problem.most) + _limit_cost(mean - radius, problem.most)
    slope = times(problem.quadratic, hidden)
    stored = dot(hidden, slope) / 2 + dot(problem.offset, hidden)
    return problem.width**2 * (stored + problem.bound * edges)


@jax.jit
def prepare_search(stiffness: Float[Array, "3 3 ..."], critical: Float[Array, "2 ..."]) -> Prepared:
    """The search, from the stiffness [N/m] against (E11, E22, 2 E12) and the compressive stress
    [N/m] at which wrinkles begin along warp and weft.

    Wrinkles are scaled along warp and weft by fourth roots of their stiffness, which keeps them
    symmetric and positive, and brings all fabrics to one scale. Their unit is that of their onset.
    """
    (c11, c12, c13), (_, c22, c23), (_, _, c33) = (tuple(row) for row in stiffness)
    # laws by table may have no stiffness along one of them
    softest = LEAST**2 * (c11 + c22 + c33) + jnp.finfo(c11.dtype).tiny ** 0.5
    # of wrinkles (11, 22, sqrt(2) 12), [sqrt(m / N)]
    warp, weft = (jax.lax.rsqrt(jnp.maximum(c, softest)) for c in (c11, c22))
    bias = ROOT * jnp.sqrt(warp * weft)  # with 2 E12
    least = FEWEST / (warp * weft)
    first_critical, second_critical = (jnp.maximum(stress, least) for stress in critical)
    coupling = jnp.clip(c12 * warp * weft, -CROSS, CROSS)
    first, second = c13 * warp * bias, c23 * weft * bias
    along, across = c11 * warp * warp + LEAST, c22 * weft * weft + LEAST
    last = c33 * bias * bias + LEAST
    quadratic = (along, coupling, first), (coupling, across, second), (first, second, last)
    sums = [abs(row[0]) + abs(row[1]) + abs(row[2]) for row in quadratic]
    bound = jnp.maximum(jnp.maximum(sums[0], sums[1]), sums[2])
    width = ONSET * jnp.minimum(first_critical * warp, second_critical * weft) / bound
    most = jnp.maximum(MOST / jnp.maximum(warp, weft) / width, 2)
    one, two, three = (
        (unit * row[0] / width, unit * row[1] / width, unit * row[2] / width)
        for unit, row in zip((warp, weft, bias), stiffness, strict=True)
    )
    offset = warp * first_critical / width, weft * second_critical / width, 0 * width
    return Prepared(quadratic, offset, (one, two, three), bound, width, most)


def _columns(strain: Float[Array, "*sample 3"]) -> Vector:
    return strain[..., 0], strain[..., 1], strain[..., 2]


def _in_a_row(law: Wrinkled, strain: Array) -> tuple[Prepared, Float[Array, "row 3"]]:
    """The search of all samples side by side, and their strains."""
    return jax.tree.map(jnp.ravel, law.prepared), strain.reshape(-1, 3)


def _at_strain(prepared: Prepared, strain: Float[Array, "*sample 3"]) -> Prepared:
    """The search at a strain, which its offset then includes."""
    moved = times(prepared.by_strain, _columns(strain))
    return prepared._replace(offset=add(moved, prepared.offset))


def _none(prepared: Prepared) -> Vector:
    none = jnp.zeros_like(prepared.width)
    return none, none, none


@eqx.filter_custom_jvp
def _hidden(prepared: Prepared, strain: Float[Array, "*sample 3"]) -> Vector:
    """The scaled wrinkles that release most, of one sample or of all in a row."""
    return _search(_at_strain(prepared, strain), _none(prepared))


def _search(problem: Prepared, start: Vector) -> Vector:
    """The scaled wrinkles from a start, by descents, then by a semismooth Newton method."""
    close = CLOSE * jnp.finfo(problem.most.dtype).eps

    def descent(hidden, _):
        return _limited(_principal(hidden, problem), problem.most), None

    def improve(state):
        hidden, _, count = state
        slope, short = _off(_principal(hidden, problem), hidden, problem.most)
        off = sum(abs(part) for part in short) / (1 + sum(abs(part) for part in hidden))
        new = subtract(hidden, solve(_off_balance(slope, problem), short))
        return new, jnp.max(off), count + 1

    def is_rough(state):
        return (state[1] > close) & (state[2] < SOLVES)

    hidden, _ = jax.lax.scan(descent, start, length=DESCENTS)
    far = jnp.full((), jnp.inf, problem.most.dtype)
    return jax.lax.while_loop(is_rough, improve, (hidden, far, 0))[0]


@_hidden.def_jvp
def _hidden_jvp(primals, tangents):
    """By the implicit function theorem, from what the wrinkles solve."""
    problem, hidden = _at_strain(*primals), _hidden(*primals)
    principal, most = _principal(hidden, problem), problem.most
    _, change = eqx.filter_jvp(lambda *at: _descended(hidden, _at_strain(*at)), primals, tangents)
    slope = _limited_slope(principal, most)
    right = times(slope, change)
    if tangents[0].most is not None:
        at_most = _of_principal(lambda value: jnp.clip((value - most + 1) / 2, 0, 1), principal)
        right = add(right, scale(tangents[0].most, at_most))
    return hidden, solve(_off_balance(slope, problem), right)


def _descended(hidden: Vector, problem: Prepared) -> Vector:
    slope = add(times(problem.quadratic, hidden), problem.offset)
    return subtract(hidden, jax.tree.map(lambda part: part / problem.bound, slope))


def _principal(hidden: Vector, problem: Prepared) -> Principal:
    return _principal_of(_descended(hidden, problem))


def _off(principal: Principal, hidden: Vector, most: Number) -> tuple[Matrix, Vector]:
    """The derivative of the limited descent, and how far hidden wrinkles are from it."""
    return _limited_slope(principal, most), subtract(hidden, _limited(principal, most))


def _off_balance(slope: Matrix, problem: Prepared) -> Matrix:
    """The derivative of the wrinkles' equation, hidden = limited(descended), in them."""
    columns = [times(slope, row) for row in problem.quadratic]  # the matrix is symmetric

    def entry(i, j):
        return columns[j][i] / problem.bound - slope[i][j] + (1.0 if i == j else 0.0)

    one, two, three = ((entry(i, 0), entry(i, 1), entry(i, 2)) for i in range(3))
    return one, two, three


def _principal_of(matrix: Vector) -> Principal:
    """Mean and radius of the principal values; cosine and sine of twice the first one's angle."""
    mean, half, shear = (matrix[0] + matrix[1]) / 2, (matrix[0] - matrix[1]) / 2, matrix[2] / ROOT
    squared = half**2 + shear**2
    has_axes = squared > jnp.finfo(squared.dtype).tiny
    length = jnp.sqrt(jnp.where(has_axes, squared, 1))
    radius = jnp.where(has_axes, length, 0)
    return mean, radius, jnp.where(has_axes, half / length, 1), shear / length


def _between(value: Number, most: Number) -> Number:
    """The value between none and most; parabolas from 1 before these to 1 beyond."""
    low = jnp.where(value < 1, jnp.clip(value + 1, 0, 2) ** 2 / 4, value)
    return jnp.where(value > most - 1, most - jnp.clip(most + 1 - value, 0, 2) ** 2 / 4, low)


def _between_slope(value: Number, most: Number) -> Number:
    return jnp.clip((value + 1) / 2, 0, 1) * jnp.clip((most + 1 - value) / 2, 0, 1)


def _limit_cost(value: Number, most: Number) -> Number:
    """The convex function between none and most whose proximal map is `_between`."""
    left = most - value
    return _edge(value) + jnp.where(left < 1, _edge(left) + 1 / 6, 0)


def _held_back(principal: Principal, most: Number) -> Number:
    """By how much the principal values of `_limited` fall short of those before, near the most."""
    mean, radius, _, _ = principal
    parts = (
        jnp.where(v > most - 1, v - _between(v, most), 0) for v in (mean + radius, mean - radius)
    )
    return sum(parts, start=jnp.zeros_like(mean))


def _edge(inside: Number) -> Number:
    inside = jnp.clip(inside, 0, 1)
    root = jnp.sqrt(jnp.where(inside > 0, inside, 1))
    return jnp.where(inside > 0, 4 / 3 * inside * root - inside - inside**2 / 2, 0)


def _of_principal(function: Callable[[Number], Number], principal: Principal) -> Vector:
    """The matrix with a function of its principal values."""
    mean, radius, cosine, sine = principal
    high, low = function(mean + radius), function(mean - radius)
    middle, half = (high + low) / 2, (high - low) / 2
    return middle + half * cosine, middle - half * cosine, ROOT * half * sine


def _limited(principal: Principal, most: Number) -> Vector:
    """The nearest matrix whose principal values are between none and most, its edges rounded."""
    return _of_principal(lambda value: _between(value, most), principal)


def _limited_slope(principal: Principal, most: Number) -> Matrix:
    """The derivative of `_limited` in the matrix."""
    mean, radius, cosine, sine = principal
    high, low = mean + radius, mean - radius
    along, across = (_between_slope(value, most) for value in (high, low))
    # differences of almost equal values are lost in rounding
    is_round = radius <= jnp.finfo(radius.dtype).eps ** (1 / 3) * (1 + abs(mean))
    quotient = (_between(high, most) - _between(low, most)) / jnp.where(is_round, 1, 2 * radius)
    turned = jnp.where(is_round, (along + across) / 2, quotient)
    parts = (
        (along, ((1 + cosine) / 2, (1 - cosine) / 2, sine / ROOT)),
        (across, ((1 - cosine) / 2, (1 + cosine) / 2, -sine / ROOT)),
        (turned, (-sine / ROOT, sine / ROOT, cosine)),
    )

    def entry(i, j):
        terms = [weight * axis[i] * axis[j] for weight, axis in parts]
        return terms[0] + terms[1] + terms[2]

    a, b, c, d, e, f = (entry(*at) for at in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    return (a, b, c), (b, d, e), (c, e, f)
