"""The result of an estimator: a fabric, its standard errors, its search; and its JSON object.

Estimates of versions 0.2.0 and 0.3.0 are read, too.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from r2s._util.checks import shown
from r2s.materials.fabric import Fabric
from r2s.materials.fabric_json import fabric_as_json, fabric_from_json
from r2s.materials.parameters import UNIFORM_DEVIATION, ParameterSpace, Range

FORMAT = "r2s-estimate/4"
FORMAT_0_2, FORMAT_0_3 = "r2s-estimate/2", "r2s-estimate/3"
NINETY = 1.645  # standard errors on either side of a 90 % interval
DOUBT, FAR = 4.5, 3.0  # standard errors, and a factor, from which on a density is doubted
AT_BOUND = 5e-3  # of a range's width: an estimate that is nearer to an end has reached the bound
NAMED = 3  # correlations that are printed, the largest


class Nuisance(NamedTuple):
    """A quantity of a recording that was estimated along with the fabric; its `standard_error` is
    NaN when there is none."""

    name: str
    unit: str
    value: float
    standard_error: float


class Contradiction(NamedTuple):
    """A recording that contradicts the others, see `r2s.estimation.consistency`.

    - `recording`: its index; of two the second, which may be the right one.
    - `parameter`: that with the largest difference, of so many standard `errors`, [-].
    - `values`: of that parameter, by this recording and by the others, in its unit.
    """

    recording: int
    parameter: str
    errors: float
    values: tuple[float, float]


UNLIKELY = 1e-4  # p-value below which recordings are not of one fabric


class Agreement(NamedTuple):
    """Whether the recordings of an estimate are of one fabric, see `r2s.estimation.consistency`.

    - `p`: p-value of their scatter, were they of one fabric, [-].
    - `determined`: number of directions of the fabric's space that each recording determines
      beyond the prior and the error of its mesh: without any it was not compared.
    - `contradiction`: the one that contradicts the others; None where all agree.
    - `density`: with which they would agree best, relative to the given one, [-], and the standard
      error of its logarithm; None: that was not estimated.
    - `exact`: as `p`, without the errors of their meshes; None where these are not estimated.
    """

    p: float
    determined: tuple[int, ...]
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
    """Something of a recording that does not fit the estimate, see `r2s.estimation.consistency`.

    - `recording`: its index. `what`: a marker, "force" or a nuisance parameter.
    - `off`: how far, in `unit`: of a marker [m], of a force its share, of a nuisance parameter its
      prior standard deviations.
    """

    recording: int
    what: str
    off: float
    unit: str


class Fit(NamedTuple):
    """How far an estimate's motion is from a recording, and what noise and mesh allow.

    - `recording`: its name.
    - `distance`: mean distance of its points from the simulated sheet, or of its markers from their
      places there, without outliers, [m].
    - `outliers`: share of them that the robust loss hardly counts, [-].
    - `noise`: the mean distance that the noise of its points alone gives, [m]
      (`r2s.recordings.checks`); NaN: unknown.
    - `mesh`: expected discretization error of this motion on the estimate's mesh, [m]
      (`r2s.scenarios.resolution.mesh_error`); NaN: unknown.
    """

    recording: str
    distance: float
    outliers: float
    noise: float = float("nan")
    mesh: float = float("nan")


@dataclass(frozen=True)
class Estimate:
    """The result of an estimator.

    - `approach`: which method, with its settings in words.
    - `fabric`; `ranges`, `values`: its parameters, in the units of the ranges.
    - `standard_errors`: relative where the range is logarithmic, else absolute; NaN from a method
      that gives none. The ranges count as a flat prior.
    - `prior_errors`: the same before any recording, from the prior; empty: that of the ranges alone
      (uniform).
    - `correlation`: of the parameters, [-].
    - `nuisances`: quantities of the recordings that were not known exactly.
    - `loss`: at the estimate, in its `loss_unit`: of PhysNet a distance on its map, [-].
    - `losses`, `history`: loss and parameters of every iteration and start. Losses of two stages of
      a descent do not compare: each counts other frames, or leaves outliers out.
    - `seconds`: how long it took, compilation included.
    - `converged`: whether the method stopped by its own criterion, and not by its budget. None:
      nothing was fitted, or a file of version 0.2.0 does not say.
    - `reached`: how many searches from different starts fit as well as this one, and how many were
      made; None: there was one. `unsure`: why the search may have ended in another minimum; or "".
    - `mesh_bias`: expected discretization error of each parameter, in the units of the standard
      errors, which include it; None: not estimated.
    - `shape`: vertices of the simulated sheet along warp and weft; None: unknown.
    - `refused`: a finer mesh that the fabric needs, and why it was not used; or "".
    - `misfits`: observations that do not fit. `fits`: distance of each recording from the
      estimate's motion; empty where that was not judged.
    - `shares`: of each recording in the loss, [-]; empty of one, or of a method without.
    - `agreement`: of several recordings; None: not judged, or no two determine the same.
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
    fits: tuple[Fit, ...] = ()
    shares: tuple[float, ...] = ()
    refused: str = ""
    reached: tuple[int, int] | None = None
    unsure: str = ""
    prior_errors: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))

    @property
    def at_bounds(self) -> dict[str, Literal["lower", "upper"]]:
        """Which parameters ended at a bound of their range, by name: the truth may lie beyond."""
        ends: dict[str, Literal["lower", "upper"]] = {}
        for bound, value in zip(self.ranges, self.values, strict=True):
            place = float(bound.to_unit(jnp.asarray(value, float)))
            if not AT_BOUND < place < 1 - AT_BOUND:
                ends[bound.name] = "lower" if place <= AT_BOUND else "upper"
        return ends

    @property
    def narrowing(self) -> Float[np.ndarray, " parameter"]:
        """Standard deviation of each parameter after the recordings over that before, [-].

        1: no information, or less than the prior's. NaN without standard errors.
        """
        prior = self.prior_errors
        if not len(prior):
            prior = np.array([bound.width * UNIFORM_DEVIATION for bound in self.ranges])
        return np.minimum(self.standard_errors / prior, 1)

    @property
    def intervals(self) -> Float[np.ndarray, "parameter 2"]:
        """90 % interval of each parameter in its unit, within its range; NaN without standard
        errors."""
        bounds, values = self.ranges, np.asarray(self.values, float)[:, None]
        off = np.outer(NINETY * self.standard_errors, [-1.0, 1.0])
        ends = np.where([[b.log] for b in bounds], values * np.exp(off), values + off)
        return np.clip(ends, [[b.low] for b in bounds], [[b.high] for b in bounds])

    def correlated(self, count: int = NAMED) -> list[tuple[str, str, float]]:
        """The pairs of parameters with the largest correlations, the largest first: near 1 or -1
        the recordings cannot separate them."""
        pairs = [
            (self.ranges[i].name, self.ranges[j].name, float(self.correlation[i, j]))
            for i, j in zip(*np.triu_indices(len(self.ranges), 1), strict=True)
            if np.isfinite(self.correlation[i, j])
        ]
        return sorted(pairs, key=lambda pair: -abs(pair[2]))[:count]


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
    return Estimate(
        approach=approach,
        fabric=space(place),
        ranges=space.ranges,
        values=np.asarray(space.values(place)),
        standard_errors=np.full(space.dim, np.nan),
        correlation=np.full((space.dim, space.dim), np.nan),
        nuisances=(),
        loss=loss,
        losses=losses,
        history=history,
        seconds=seconds,
        converged=converged,
        loss_unit=loss_unit,
    )


def as_json(estimate: Estimate) -> dict[str, Any]:
    """An estimate with units, for a file; numbers that are not finite are None (null)."""
    parameters = {}
    columns = estimate.values, estimate.intervals, estimate.standard_errors, estimate.narrowing
    for bound, value, interval, error, ratio in zip(estimate.ranges, *columns, strict=True):
        parameters[bound.name] = {
            "value": _plain(value),
            "unit": bound.unit,
            "interval_90": _plain(interval),
            "standard_error": _plain(error),
            "standard_error_is": "relative" if bound.log else "absolute",
            "posterior_over_prior": _plain(ratio),
            "bounds": [bound.low, bound.high],
        }
    return {
        "format": FORMAT,
        "approach": estimate.approach,
        "converged": estimate.converged,
        "at_bounds": estimate.at_bounds,
        "parameters": parameters,
        "correlation": _plain(estimate.correlation),
        "fabric": fabric_as_json(estimate.fabric),
        **{name: _plain(getattr(estimate, name)) for name in PLAIN},
    }


PLAIN = (
    *("shape", "refused", "reached", "unsure", "mesh_bias", "agreement", "shares", "misfits"),
    *("fits", "nuisances", "loss", "loss_unit", "seconds", "losses", "history"),
)
NEEDED = ("approach", "correlation", "nuisances", "loss", "seconds", "converged", "loss_unit")


def _plain(value: Any) -> Any:
    """A field as JSON has it: arrays and tuples as lists, named tuples as objects."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, np.ndarray):
        plain = value.astype(object)
        plain[~np.isfinite(value)] = None
        return plain.tolist()
    if hasattr(value, "_asdict"):
        return {name: _plain(part) for name, part in value._asdict().items()}
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def from_json(stored: dict[str, Any]) -> Estimate:
    """The estimate that `as_json` made, or that versions 0.2.0 and 0.3.0 wrote.

    What was left out of `losses` and `history` is empty. Raises `ValueError` when the object is of
    another format or its fabric is none, `KeyError` when a key is missing.
    """
    if stored.get("format") == FORMAT_0_2:
        stored = upgraded(stored)
    if stored.get("format") not in (FORMAT, FORMAT_0_3):
        raise ValueError(f"expected an estimate of format {FORMAT}, got {stored.get('format')}")
    parameters = stored["parameters"]
    ranges = tuple(
        Range(name, p["unit"], *p["bounds"], log=p["standard_error_is"] == "relative")
        for name, p in parameters.items()
    )
    fields = {"losses": np.zeros(0), "history": np.zeros(0)}
    fields |= {name: stored[name] for name in NEEDED}
    fields |= {name: stored[name] for name in PLAIN if stored.get(name) is not None}
    return Estimate(
        fabric=fabric_from_json(stored["fabric"]),
        ranges=ranges,
        values=_numbers([p["value"] for p in parameters.values()]),
        standard_errors=_numbers([p["standard_error"] for p in parameters.values()]),
        prior_errors=_prior_errors(parameters),
        **{name: READERS.get(name, lambda value: value)(part) for name, part in fields.items()},
    )


def _prior_errors(parameters: dict[str, Any]) -> np.ndarray:
    """Standard error over posterior over prior; empty of version 0.3.0, which has no such ratio."""
    pairs = [(p["standard_error"], p.get("posterior_over_prior")) for p in parameters.values()]
    if not all(error and ratio for error, ratio in pairs):
        return np.zeros(0)
    return np.array([error / ratio for error, ratio in pairs])


def _rows(kind: Callable[..., Any], rows: Sequence[dict[str, Any]]) -> tuple[Any, ...]:
    """Named tuples of a kind; null is NaN."""
    return tuple(
        kind(*(np.nan if row[name] is None else row[name] for name in kind._fields)) for row in rows
    )


def _agreement(stored: dict[str, Any]) -> Agreement:
    odd, density = stored["contradiction"], stored["density"]
    if odd is not None:
        odd = Contradiction(**odd | {"values": tuple(odd["values"])})
    density = None if density is None else tuple(density)
    determined = stored.get("determined") or stored["told"]  # until 0.3.0
    return Agreement(stored["p"], tuple(determined), odd, density, stored.get("exact"))


def _numbers(values: Any) -> np.ndarray:
    try:
        return np.array(values, dtype=float)  # None becomes NaN
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"expected numbers, found {shown(values)}") from error


READERS: dict[str, Callable[[Any], Any]] = {
    **dict.fromkeys(("correlation", "mesh_bias", "losses", "history"), _numbers),
    **dict.fromkeys(("shape", "reached", "shares"), tuple),
    "loss": lambda value: np.nan if value is None else value,
    "agreement": _agreement,
    "misfits": partial(_rows, Misfit),
    "fits": partial(_rows, Fit),
    "nuisances": partial(_rows, Nuisance),
}


def upgraded(stored: dict[str, Any]) -> dict[str, Any]:
    """An estimate's JSON object of version 0.2.0 in the keys of this version.

    Version 0.2.0 said only of the physics-informed network, in words, whether it had converged.
    """
    renamed = {"deviation": "standard_error", "deviation_is": "standard_error_is"}

    def rename(entry: dict[str, Any]) -> dict[str, Any]:
        return {renamed.get(key, key): value for key, value in entry.items()}

    new = {key: value for key, value in stored.items() if key != "conditions"}
    approach, fabric = stored["approach"], stored["fabric"]
    new |= {
        "format": FORMAT,
        "converged": "not converged" not in approach if approach.startswith("pinn") else None,
        "parameters": {name: rename(entry) for name, entry in stored["parameters"].items()},
        "nuisances": [rename(entry) for entry in stored["conditions"]],
        "fabric": _fabric_0_2(fabric) if "C11" in fabric else fabric,
    }
    return new | {"at_bounds": from_json(new).at_bounds}


def _fabric_0_2(stored: dict[str, Any]) -> dict[str, Any]:
    """The flat form of a fabric of constant stiffness, as `r2s.materials.fabric_json` has it."""
    membrane = {name.lower(): stored[name] for name in ("C11", "C12", "C22", "C33")}
    bending = {"stiffness": stored["bending"], "poissons_ratio": stored["bending_poissons_ratio"]}
    others = ("density", "damping", "friction", "thickness", "mass_damping")
    return {
        **{name: stored[name] for name in others},
        "membrane": {"law": "OrthotropicMembrane", **membrane},
        "bending": {"law": "PlateBending", **bending},
    }
