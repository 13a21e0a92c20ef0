"""Wrinkles finer than a mesh: a cell that is compressed gives way as the sheet within it buckles.

A thin sheet hardly resists compression: it buckles. Wrinkles that are longer than two cells are the
mesh's own. A cell cannot take a shorter one, nor a fold across its middle, but by compressing its
membrane, hundreds of times as stiff as bending: the mesh locks. So the strain of a sample is
shortened by wrinkles that are not seen, L >= 0 (a symmetric matrix), which cost as much as the
shortest of them, of one cell's length: waves of wavenumber k and shortening L store the energy
B k^2 L, with the bending stiffness B, along either side of the cell. The energy that is left is

    min over L >= 0 of  W(E + L) + B (k1^2 L11 + k2^2 L22)

(the relaxed energy of tension fields, Pipkin 1986, with a price on wrinkles). The critical
stress B k^2 = B (2 pi / side)^2 grows without limit as cells shrink. Wrinkles do not begin at once
there, but from half of it on (a term of the cost that is convex, too; along the yarns that are less
stiff nearer to it), so that the stiffness has no jump: Newton's method goes to and fro over jumps.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s._util.once import once
from r2s.materials.bending import BendingLaw
from r2s.materials.membrane import MembraneLaw, stress_and_tangent
from r2s.materials.moving_tangents import jvp_of_moving, moves
from r2s.materials.wrinkle_limits import (
    ROOT,
    held_back,
    limited,
    limited_at,
    limited_slope,
    limits,
    of_principal,
    principal_of,
    slope_at,
)
from r2s.mesh.strain_samples import StrainSamples, on_samples
from r2s.mesh.vectors import (
    Matrix,
    Number,
    Vector,
    dot,
    inverse,
    product,
    solve,
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

Columns = Float[Array, "3 *sample"]
Tangents = Float[Array, "3 3 *sample"]
# A `Vector` is a symmetric matrix (11, 22, sqrt(2) 12), of one sample or of all side by side.
# Second and first derivative of the cost; a bound on the second; the unit; the most of wrinkles.
Problem = tuple[Matrix, Vector, Number, Number, Number]


class Prepared(NamedTuple):
    """The search for wrinkles without its strain, on the scales of `prepare_search`.

    - `quadratic`: second derivative of their cost.
    - `offset`, `by_strain`: its first derivative at no strain, and by strain.
    - `bound`: on the second derivative. `width`: their unit. `most`: of them, in this unit.
    """

    quadratic: Matrix
    offset: Vector
    by_strain: Matrix
    bound: Number
    width: Number
    most: Number


class Wrinkled(eqx.Module):
    """A membrane law whose compression gives way to wrinkles that the mesh does not show.

    What gives way is that of the law's stiffness at zero strain, all but `SHARE` of it.

    - `law`: the law of a sheet without them.
    - `critical`: compressive stress at which it buckles along warp and weft, [N/m].
    - `prepared`: what the search for wrinkles needs of that stiffness and stress.
    - `hidden`: wrinkles that are known already, from `search`; None: they are searched for.
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
            freed = _released(self.prepared, strain)
        else:
            freed = -_cost_of(self.hidden, _at_strain(self.prepared, _columns(strain)))
        return self.law.energy_density(strain) - (1 - SHARE) * freed

    def stress_and_tangent(
        self, strain: Float[Array, " 3"]
    ) -> tuple[Float[Array, " 3"], Float[Array, "3 3"]]:
        """First and second derivative [N/m] of `energy_density`, in closed form."""
        stress, tangent = stress_and_tangent(self.law, strain)
        known = self
        if self.hidden is None:
            known = with_wrinkles(self, _hidden(self.prepared, strain))
        relief, softening = given_way(known, strain)
        return stress + relief, tangent + softening


def given_way(law: Wrinkled, strain: Float[Array, "*sample 3"]) -> tuple[Columns, Tangents]:
    """What known wrinkles add to stress and tangent [N/m] of the law of one sample, or of all."""
    assert law.hidden is not None
    by_strain, hidden = law.prepared.by_strain, law.hidden
    problem = _at_strain(law.prepared, _columns(strain))
    principal = once(_principal_at, law.prepared, _columns(strain), hidden)
    slope = once(slope_at, principal, problem[-1])
    solved = once(lambda *system: inverse(_off_balance(*system)), slope, problem)
    scale = (1 - SHARE) * law.prepared.width**2
    relief = jnp.stack(times(transposed(by_strain), hidden))
    middle = once(product, solved, once(product, slope, by_strain))
    softer = product(transposed(by_strain), middle)
    softening = jnp.stack([jnp.stack(row) for row in softer])
    return scale[None] * relief, -(scale / law.prepared.bound)[None, None] * softening


def tangents_on_samples(
    law: Any, strain: Float[Array, "element sample 3"]
) -> Float[Array, "element sample 3 3"]:
    """The stiffness [N/m] of every sample at its strain [-].

    Wrinkles are found for all side by side: their derivative takes a tenth of the time it takes
    sample by sample.
    """
    taut = law.law if isinstance(law, Wrinkled) else law
    tangent = on_samples(lambda law, strain: stress_and_tangent(law, strain)[1], taut, strain)
    if not isinstance(law, Wrinkled):
        return tangent
    prepared, flat = jax.tree.map(jnp.ravel, law.prepared), strain.reshape(-1, 3)
    row = Wrinkled(None, law.critical, prepared, _hidden(prepared, flat))
    softening = jnp.moveaxis(given_way(row, flat)[1], -1, 0)
    return tangent + softening.reshape(tangent.shape)


def stress_on_samples(
    law: Any, strain: Float[Array, "element sample 3"]
) -> Float[Array, "element sample 3"]:
    """The stress [N/m] of every sample at its strain [-]."""
    taut = law.law if isinstance(law, Wrinkled) else law
    stress = on_samples(lambda law, strain: jax.grad(law.energy_density)(strain), taut, strain)
    if not isinstance(law, Wrinkled):
        return stress
    prepared, flat = jax.tree.map(jnp.ravel, law.prepared), strain.reshape(-1, 3)
    # once: the stack would work out all of the derivatives for each of its numbers
    relief = jnp.stack(once(_relieved_at, prepared, flat), axis=-1)
    return stress + relief.reshape(stress.shape)


def search(law: Any, strain: Float[Array, "element sample 3"], start: Any = None) -> Any:
    """The wrinkles of all samples at a strain [-], for `Wrinkled.hidden`, without derivatives.

    Each is an array over all samples. None for a law that has none. A `start` near them, such as
    those at a strain close by, makes it shorter.
    """
    if not isinstance(law, Wrinkled):
        return None
    strain = jax.lax.stop_gradient(strain).reshape(-1, 3)
    prepared = jax.lax.stop_gradient(jax.tree.map(jnp.ravel, law.prepared))
    problem = _at_strain(prepared, _columns(strain))
    start = no_wrinkles(law) if start is None else start
    flat = _search(problem, jax.tree.map(jnp.ravel, start))
    return jax.tree.map(lambda leaf: leaf.reshape(law.prepared.width.shape), flat)


def no_wrinkles(law: Any) -> Any:
    """A start for `search`."""
    if not isinstance(law, Wrinkled):
        return None
    none = jnp.zeros_like(law.prepared.width)
    return none, none, none


def with_wrinkles(law: Any, hidden: Any) -> Any:
    """The law of all samples with wrinkles that `search` found."""
    return law if hidden is None else eqx.tree_at(_its_wrinkles, law, hidden, is_leaf=_is_none)


def _its_wrinkles(law: Wrinkled) -> Any:
    return law.hidden


def _is_none(leaf: Any) -> bool:
    return leaf is None


def membrane_on_samples(
    samples: StrainSamples,
    membrane: MembraneLaw,
    bending: BendingLaw,
    strain: Float[Array, "element sample 3"],
) -> Any:
    """The membrane law of every sample in a time step that starts near a strain [-].

    On cells that wrinkle these are `Wrinkled`. The bending stiffness is the mean of warp and
    weft.
    """
    laws = on_samples(membrane.at, strain)
    if samples.hidden_waves is None:
        return laws
    stiffness = on_samples(
        lambda law, none: jax.hessian(law.energy_density)(none), laws, 0 * strain
    )
    bent = (bending.stiffness_along(0.0) + bending.stiffness_along(jnp.pi / 2)) / 2
    critical = bent * samples.hidden_waves[:, None] ** 2
    critical = jnp.broadcast_to(critical, (*strain.shape[:2], 2))
    return Wrinkled(laws, critical, on_samples(prepare_search, stiffness, critical))


def released(
    stiffness: Float[Array, "3 3"], critical: Float[Array, " 2"], strain: Float[Array, " 3"]
) -> Number:
    """The energy per area [J/m^2] that wrinkles release, zero or more.

    - `stiffness`: against (E11, E22, 2 E12), positive definite, [N/m].
    - `critical`: compressive stress at which they begin along warp and weft, [N/m].
    - `strain`: (E11, E22, 2 E12) [-].
    """
    return _released(prepare_search(stiffness, critical), strain)


def follow(law: Prepared, strain: Vector, hidden: Vector) -> Vector:
    """The scaled wrinkles at a strain by one Newton step from those nearby."""
    # in stages: XLA works each of a stage's results out from the beginning
    problem = law.quadratic, law.offset, law.bound, law.width, law.most
    principal = once(_principal_at, law, strain, hidden)
    slope, short = once(_off, law, principal, hidden)
    matrix = once(_off_balance, slope, problem)
    return once(_followed, matrix, short, hidden)


def _principal_at(law: Prepared, strain: Vector, hidden: Vector):
    return principal_of(_descended(hidden, _at_strain(law, strain)))


def _off(law: Prepared, principal, hidden: Vector):
    within = limited_at(principal, law.most)
    one, two, three = (a - b for a, b in zip(hidden, within, strict=True))
    return slope_at(principal, law.most), (one, two, three)


def _followed(matrix: Matrix, short: Vector, hidden: Vector) -> Vector:
    one, two, three = (a - b for a, b in zip(hidden, solve(matrix, short), strict=True))
    return one, two, three


def relieved(law: Prepared, hidden: Vector) -> Vector:
    """What scaled wrinkles take off the compressive stress (S11, S22, S12), [N/m]."""
    one, two, three = times(transposed(law.by_strain), hidden)
    unit = (1 - SHARE) * law.width**2
    return unit * one, unit * two, unit * three


def _relieved_at(prepared: Prepared, strain: Float[Array, "*sample 3"]) -> Vector:
    return relieved(prepared, _hidden(prepared, strain))


@jax.custom_jvp
def _released(prepared: Prepared, strain: Float[Array, " 3"]) -> Number:
    problem = _at_strain(prepared, _columns(strain))
    return -_cost_of(_hidden(prepared, strain), problem)


def _released_jvp(primals, tangents):
    # the hidden strain is optimal, so its change does not count (it does in the next derivative),
    # but where it is the most that there is, it goes with that
    (prepared, strain), hidden = primals, _hidden(*primals)
    _, _, _, bound, width, most = prepared
    problem = _at_strain(prepared, _columns(strain))
    value = -_cost_of(hidden, problem)
    change = jnp.zeros_like(value)
    if moves(tangents[0]):

        def released_and_most(prepared):
            quadratic, linear, bound, width, _ = _at_strain(prepared, _columns(strain))
            return -_cost_of(hidden, (quadratic, linear, bound, width, most)), prepared.most

        _, (fixed, more) = jvp_of_moving(released_and_most, prepared, tangents[0])
        held = held_back(_descended(hidden, problem), most)
        change = fixed + width**2 * bound * held * more
    if moves(tangents[1]):
        release = times(transposed(prepared.by_strain), hidden)
        change = change - width**2 * dot(release, _columns(tangents[1]))
    return value, change


_released.defjvp(_released_jvp, symbolic_zeros=True)


def _cost_of(hidden: Vector, problem: Problem) -> Number:
    """What hidden wrinkles cost [J/m^2], on the scales of `prepare_search`."""
    quadratic, linear, bound, width, most = problem
    mean, radius, _, _ = principal_of(hidden)
    edges = limits(mean + radius, most) + limits(mean - radius, most)
    slope = times(quadratic, hidden)
    return width**2 * (dot(hidden, slope) / 2 + dot(linear, hidden) + bound * edges)


@jax.jit
def prepare_search(stiffness: Float[Array, "3 3 ..."], critical: Float[Array, "2 ..."]) -> Prepared:
    """What the search needs of a law.

    Wrinkles are scaled along warp and weft by fourth roots of their stiffness, which keeps them
    symmetric and positive, and makes all fabrics alike. Their unit is that of their onset.
    """
    (c11, c12, c13), (_, c22, c23), (_, _, c33) = (tuple(row) for row in stiffness)
    warp, weft, bias = _scales(stiffness)
    least = FEWEST / (warp * weft)
    first_critical, second_critical = (jnp.maximum(each, least) for each in critical)
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
        (row[0] / width, row[1] / width, row[2] / width) for row in _by_strain(stiffness)
    )
    offset = warp * first_critical / width, weft * second_critical / width, 0 * width
    return Prepared(quadratic, offset, (one, two, three), bound, width, most)


def _columns(strain: Float[Array, "*sample 3"]) -> Vector:
    return strain[..., 0], strain[..., 1], strain[..., 2]


def _at_strain(prepared: Prepared, strain: Vector) -> Problem:
    """Second and first derivative of the cost without wrinkles; a bound on the second; the unit;
    the most of them in this unit.
    """
    quadratic, offset, by_strain, bound, width, most = prepared
    one, two, three = (a + b for a, b in zip(times(by_strain, strain), offset, strict=True))
    return quadratic, (one, two, three), bound, width, most


def _scales(stiffness) -> Vector:
    """Of wrinkles (11, 22, sqrt(2) 12), [sqrt(m / N)]."""
    c11, c22, c33 = stiffness[0, 0], stiffness[1, 1], stiffness[2, 2]
    # laws by table may have no stiffness along one of them
    least = LEAST**2 * (c11 + c22 + c33) + jnp.finfo(c11.dtype).tiny ** 0.5
    warp, weft = (jax.lax.rsqrt(jnp.maximum(c, least)) for c in (c11, c22))
    return warp, weft, ROOT * jnp.sqrt(warp * weft)  # with 2 E12


def _by_strain(stiffness) -> Matrix:
    """The derivative of the cost's slope in the strain, times the unit of wrinkles."""
    one, two, three = (
        (scale * stiffness[i, 0], scale * stiffness[i, 1], scale * stiffness[i, 2])
        for i, scale in enumerate(_scales(stiffness))
    )
    return one, two, three


@jax.custom_jvp
def _hidden(prepared: Prepared, strain: Float[Array, "*sample 3"]) -> Vector:
    """The scaled wrinkles that release most: descents, then a semismooth Newton method.

    Of one sample, or of all in a row.
    """
    none = jnp.zeros_like(prepared.width)
    return _search(_at_strain(prepared, _columns(strain)), (none, none, none))


def _search(problem: Problem, start: Vector) -> Vector:
    """The scaled wrinkles, from a start: of one sample, or of all in arrays."""
    most = problem[-1]
    close = CLOSE * jnp.finfo(most.dtype).eps

    def descent(hidden, _):
        return limited(_descended(hidden, problem), most), None

    def improve(state):
        hidden, _, count = state
        before = _descended(hidden, problem)
        short = tuple(a - b for a, b in zip(hidden, limited(before, most), strict=True))
        change = solve(_system(before, problem), short)
        off = sum(abs(part) for part in short) / (1 + sum(abs(part) for part in hidden))
        new = tuple(a - b for a, b in zip(hidden, change, strict=True))
        return new, jnp.max(off), count + 1

    def goes_on(state):
        return (state[1] > close) & (state[2] < SOLVES)

    hidden, _ = jax.lax.scan(descent, start, length=DESCENTS)
    return jax.lax.while_loop(goes_on, improve, (hidden, jnp.full((), jnp.inf, most.dtype), 0))[0]


def _hidden_jvp(primals, tangents):
    """By the implicit function theorem, from what the wrinkles solve."""
    (prepared, strain), hidden = primals, _hidden(*primals)
    problem = _at_strain(prepared, _columns(strain))
    before, most = _descended(hidden, problem), prepared.most
    slope = limited_slope(before, most)
    none = jnp.zeros_like(hidden[0])
    right: Vector = none, none, none
    if moves(tangents[1]):
        change = times(prepared.by_strain, _columns(tangents[1]))
        one, two, three = (-each / prepared.bound for each in times(slope, change))
        right = one, two, three
    if moves(tangents[0]):

        def limit(prepared):
            problem = _at_strain(prepared, _columns(strain))
            return _descended(hidden, problem), prepared.most

        _, (change, more) = jvp_of_moving(limit, prepared, tangents[0])
        at_most = of_principal(
            lambda value: jnp.clip((value - most + 1) / 2, 0, 1), principal_of(before)
        )
        parts = zip(right, times(slope, change), at_most, strict=True)
        one, two, three = (a + b + more * c for a, b, c in parts)
        right = one, two, three
    return hidden, solve(_off_balance(slope, problem), right)


_hidden.defjvp(_hidden_jvp, symbolic_zeros=True)


def _descended(hidden: Vector, problem) -> Vector:
    quadratic, linear, bound, _, _ = problem
    slope = times(quadratic, hidden)
    one, two, three = (h - (s + f) / bound for h, s, f in zip(hidden, slope, linear, strict=True))
    return one, two, three


@jax.jit
def _system(before: Vector, problem) -> Matrix:
    """The derivative of the wrinkles' equation, hidden = limited(descended), in them."""
    return _off_balance(limited_slope(before, problem[-1]), problem)


def _off_balance(slope: Matrix, problem: Problem) -> Matrix:
    quadratic, _, bound, _, _ = problem
    columns = [times(slope, row) for row in quadratic]  # the matrix is symmetric

    def entry(i, j):
        return columns[j][i] / bound - slope[i][j] + (1.0 if i == j else 0.0)

    one, two, three = ((entry(i, 0), entry(i, 1), entry(i, 2)) for i in range(3))
    return one, two, three
