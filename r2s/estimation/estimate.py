"""What an estimator gives back: a fabric, how well each number is known, and how it was found."""

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace, Range

IDENTIFIABLE = 0.025  # greatest standard error, relative or absolute: two of them are 5 %
DOUBT, FAR = 4.5, 3.0  # standard errors, and a factor, from which on a density is doubted
AT_BOUND = 5e-3  # of a range's width: an estimate that is nearer to an end has reached the bound
LEAST_EXPONENT = 0.05  # a parameter with a smaller share in a combination is not named


class Nuisance(NamedTuple):
    """A quantity of a recording that was estimated along with the fabric.

    - `name`, `unit`, `value`.
    - `standard_error`: in the same unit; NaN when there is none.
    """

    name: str
    unit: str
    value: float
    standard_error: float


class Contradiction(NamedTuple):
    """A recording that leads elsewhere than the others, see `r2s.estimation.agreement`.

    - `recording`: its index; of two the second, which may be the right one.
    - `parameter`: in which they are the most standard errors apart, `errors`, [-].
    - `values`: of that parameter, by this recording and by the others, in its unit.
    """

    recording: int
    parameter: str
    errors: float
    values: tuple[float, float]


UNLIKELY = 1e-4  # that recordings of one fabric lead so far apart by chance


class Agreement(NamedTuple):
    """Whether the recordings of an estimate tell of one fabric, see `r2s.estimation.agreement`.

    - `p`: how likely recordings of one fabric lead as far apart, [-].
    - `told`: of each recording, how many directions of the fabric's space it tells by itself, its
      mesh's error allowed for: one that tells none was not compared.
    - `contradiction`: the one that leads elsewhere than the others; None where all agree.
    - `density`: with which they would agree best, over the one that was given, [-], and the
      standard error of its logarithm: a first guess where some weigh the sheet, by a force, and
      others do not; where a force or another recording does not fit, of a descent
      (`r2s.estimation.agreement.with_density`). Else None.
    - `exact`: as `p`, were their meshes without error; None where nothing was excused.
    """

    p: float
    told: tuple[int, ...]
    contradiction: Contradiction | None
    density: tuple[float, float] | None = None
    exact: float | None = None

    @property
    def is_excused(self) -> bool:
        """Whether the recordings agree only as far as their meshes may err."""
        return self.exact is not None and self.exact < UNLIKELY <= self.p

    @property
    def doubts_density(self) -> bool:
        """Whether another density than the one given is far likelier."""
        if self.density is None:
            return False
        off, error = abs(np.log(self.density[0])), self.density[1]
        return bool(off > DOUBT * error and off > np.log(FAR))


class Misfit(NamedTuple):
    """Something of a recording that does not fit the fabric that was found, see
    `r2s.estimation.misfits`.

    - `recording`: its index. `what`: a marker, "force" or a nuisance.
    - `off`: how far, in `unit`: of a marker [m], of a force its share, of a nuisance the standard
      deviations of what was known of it.
    """

    recording: int
    what: str
    off: float
    unit: str


class Combination(NamedTuple):
    """A product of powers of parameters (for those on a linear scale: a sum) that is known.

    - `exponents`: of each parameter by name, the largest 1.
    - `value`: the product, in the units that follow.
    - `standard_error`: relative if all of them are logarithmic, [-].
    """

    exponents: dict[str, float]
    value: float
    standard_error: float


@dataclass(frozen=True)
class Estimate:
    """What an estimator found.

    - `approach`: which method, with its settings in words.
    - `fabric`: the estimate.
    - `ranges`, `values`: its parameters, in the units of the ranges.
    - `standard_errors`: relative where the range is logarithmic, else absolute; NaN from a method
      that gives none. The ranges count as a flat prior.
    - `correlation`: of the parameters, [-].
    - `nuisances`: quantities of the recordings that were not known exactly.
    - `loss`: at the estimate, in its `loss_unit`: of PhysNet a distance on its map, [-].
    - `losses`, `history`: loss and parameters of every iteration and start. The losses of two
      stages of a descent do not compare: each counts other frames, or leaves outliers out.
    - `seconds`: how long it took, compilation included.
    - `converged`: whether the method stopped by its own criterion; False when its budget ended it,
      or no other search ended there. None: nothing was fitted, or a file of version 0.2.0 does not
      say.
    - `reached`: how many searches from different starts fit as well as this one, and how many were
      made; None: there was one. `unsure`: why the search may have ended in another minimum; "": no
      search says so.
    - `mesh_bias`: how far each parameter is expected to be off for its mesh alone, as the standard
      errors, which hold it (`r2s.estimation.mesh_bias`). None: that was not judged.
    - `shape`: vertices of the simulated sheet along warp and weft; None: it has none, or a file
      does not say.
    - `refused`: a finer mesh that the fabric needs, and why it was not taken; "": there is none.
    - `misfits`: what of the recordings does not fit. `left_out`: of each the share that counts for
      little or nothing, [-]; none where that was not judged.
    - `shares`: of each recording in the loss, [-]; none of one, or where a method has no shares.
    - `agreement`: of several recordings; None: that was not judged, or no two tell of the same.
    """

    approach: str
    fabric: Fabric
    ranges: tuple[Range, ...]
    values: np.ndarray
    standard_errors: np.ndarray
    correlation: np.ndarray
    nuisances: tuple[Nuisance, ...]
    loss: float
    losses: np.ndarray
    history: np.ndarray
    seconds: float
    converged: bool | None
    loss_unit: str = "m^2"
    mesh_bias: np.ndarray | None = None
    shape: tuple[int, int] | None = None
    agreement: Agreement | None = None
    misfits: tuple[Misfit, ...] = ()
    left_out: tuple[float, ...] = ()
    shares: tuple[float, ...] = ()
    refused: str = ""
    reached: tuple[int, int] | None = None
    unsure: str = ""

    @property
    def at_bounds(self) -> dict[str, Literal["lower", "upper"]]:
        """Which parameters ended at a bound of their range, by name: the truth may lie beyond."""
        found: dict[str, Literal["lower", "upper"]] = {}
        for bound, value in zip(self.ranges, self.values, strict=True):
            place = float(bound.to_unit(jnp.asarray(value, float)))
            if place <= AT_BOUND:
                found[bound.name] = "lower"
            elif place >= 1 - AT_BOUND:
                found[bound.name] = "upper"
        return found

    @property
    def identifiable(self) -> np.ndarray:
        """Which parameters the recording determines: to 5 % (or 0.05) with 95 % confidence.

        None that ended at a bound: the truth may lie beyond, and no error here says how far.
        """
        return (self.standard_errors < IDENTIFIABLE) & self._inside

    @property
    def _inside(self) -> np.ndarray:
        """Which parameters did not end at a bound."""
        at_bounds = self.at_bounds
        return np.array([each.name not in at_bounds for each in self.ranges], bool)

    @property
    def combinations(self) -> list[Combination]:
        """Combinations of parameters that are identifiable although the parameters are not.

        Eigenvectors of the parameters' covariance, on the scales of their ranges, whose standard
        error is at most `IDENTIFIABLE`; the best known first.
        """
        known = np.isfinite(self.standard_errors) & self._inside
        index = np.flatnonzero(known & ~self.identifiable)
        if len(index) < 2:
            return []
        scale = self.standard_errors[index]
        covariance = self.correlation[np.ix_(index, index)] * np.outer(scale, scale)
        squares, vectors = np.linalg.eigh(covariance)
        found = []
        for square, vector in zip(squares, vectors.T, strict=True):
            vector = vector / vector[np.argmax(np.abs(vector))]
            standard_error = float(np.sqrt(max(square, 0)) * np.linalg.norm(vector))
            if standard_error < IDENTIFIABLE:
                powers = [(int(i), float(power)) for i, power in zip(index, vector, strict=True)]
                found.append(_combination(self, powers, standard_error))
        return found


def _combination(
    estimate: Estimate, powers: list[tuple[int, float]], standard_error: float
) -> Combination:
    powers = [(i, power) for i, power in powers if abs(power) >= LEAST_EXPONENT]
    value = 1.0
    for i, power in powers:
        number = float(estimate.values[i])
        value *= number**power if estimate.ranges[i].log else float(np.exp(power * number))
    named = {estimate.ranges[i].name: round(power, 2) for i, power in powers}
    return Combination(named, value, standard_error)


def point_estimate(
    approach: str,
    space: ParameterSpace,
    place: Any,
    loss: float,
    losses: np.ndarray,
    history: np.ndarray,
    seconds: float,
    converged: bool = False,
    loss_unit: str = "m^2",
) -> Estimate:
    """An estimate at a `place` of the space's unit cube, from a method without standard errors.

    The other arguments are the fields of `Estimate`.
    """
    nothing = np.full(space.dim, np.nan)
    return Estimate(
        approach=approach,
        fabric=space(place),
        ranges=space.ranges,
        values=np.asarray(space.values(place)),
        standard_errors=nothing,
        correlation=np.full((space.dim, space.dim), np.nan),
        nuisances=(),
        loss=loss,
        losses=losses,
        history=history,
        seconds=seconds,
        converged=converged,
        loss_unit=loss_unit,
    )


def describe(estimate: Estimate) -> list[str]:
    """Lines for people: each parameter, combination and nuisance, and how the search ended."""
    lines = []
    rows = zip(
        estimate.ranges,
        estimate.values,
        estimate.standard_errors,
        estimate.identifiable,
        strict=True,
    )
    for bound, value, standard_error, identifiable in rows:
        spread = f"{standard_error:.1%}" if bound.log else f"{standard_error:.3f}"
        word = "identifiable" if identifiable else "not identifiable"
        if not np.isfinite(standard_error):
            spread, word = "", "no standard error"
        side = estimate.at_bounds.get(bound.name)
        limit = bound.low if side == "lower" else bound.high
        end = f", at its {side} bound {limit:g}" if side else ""
        unit = "" if bound.unit == "-" else f" {bound.unit}"
        lines.append(f"{bound.name:14s}{value:10.4g}{unit:6s} +- {spread:8s}{word}{end}")
    if estimate.shape is not None:
        lines.append(f"mesh: {estimate.shape[0]} x {estimate.shape[1]} vertices")
    if estimate.mesh_bias is not None:
        pairs = zip(estimate.ranges, estimate.mesh_bias, strict=True)
        parts = [f"{r.name} {b:.0%}" if r.log else f"{r.name} {b:.2f}" for r, b in pairs]
        lines.append(f"of the errors the mesh makes: {', '.join(parts)}")
    for found in estimate.combinations:
        powers = " ".join(f"{name}^{power:g}" for name, power in found.exponents.items())
        lines.append(f"known to {found.standard_error:.1%}: {powers}")
    for name, unit, value, standard_error in estimate.nuisances:
        unit = "" if unit == "-" else f" {unit}"
        spread = f" +- {standard_error:.2g}" if np.isfinite(standard_error) else ""
        lines.append(f"{name:14s}{value:10.4g}{unit:6s}{spread}")
    if estimate.converged is not None:
        words = "yes" if estimate.converged else "no, the budget ended the search"
        if estimate.unsure:
            words = f"no, not sure: {estimate.unsure}"
        elif estimate.reached is not None:
            ended, searches = estimate.reached
            words += f", {ended} of {searches} searches from different starts fit as well"
        lines.append(f"converged: {words}")
        named = ", ".join(f"{name} ({side})" for name, side in estimate.at_bounds.items())
        warned = f"warning: at a bound, beyond which the truth may lie: {named}"
        lines.append(warned if named else "at a bound: none")
    return lines
