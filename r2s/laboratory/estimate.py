"""The fabric that laboratory tests tell, and what they add to what motions tell.

    found = estimate((pull_along_warp, pull_along_weft, cantilever), on_cloth(density))
    space = informed(on_cloth(density), found)      # for an estimate from motions beside them

The estimate has the least sum of squares of all tests' residuals and of the prior of the space.
Standard errors are those of the linearised problem; where the tests scatter by more than they
should they grow by as much (Birge 1932).
"""

import time
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import least_squares
from scipy.stats import chi2

from r2s.estimation.estimate import Estimate
from r2s.estimation.gauss_newton import MARGIN
from r2s.estimation.method import Progress, tell
from r2s.fabrics.fabric import Fabric
from r2s.fabrics.informed_space import InformedSpace
from r2s.fabrics.parameters import UNIFORM_DEVIATION, ParameterSpace
from r2s.laboratory.cantilever import Cantilever, overhang
from r2s.laboratory.drape import Drape
from r2s.laboratory.pull import Pull

Test = Pull | Cantilever | Drape

APPROACH = "laboratory tests"
STARTS = 8
ENOUGH = 1e-4  # relative, of the sum of squares or of a step: there a descent ends
FAILED = 1e6  # of every residual, where a specimen of a drape does not come to rest
SLACK = 0.02  # of a variance: less than that a motion does not add to what tests tell
TOLD = 0.5  # of the prior's standard error: tests tell what they know better than that
POOR_FIT = 3.0  # standard deviations (root mean square), beyond which a test does not fit


class Fit(NamedTuple):
    """How an estimate fits one test.

    - `test`: its name. `errors`: root mean square of its residuals, in standard deviations.
    - `words`: measured and expected.
    """

    test: str
    errors: float
    words: str


def estimate(
    tests: Sequence[Test], space: ParameterSpace, progress: Progress | None = None
) -> Estimate:
    """The fabric of a space that explains some tests of it.

    Where tests have no part in a parameter it stays at the prior of the space. `progress` is told
    the number of evaluations and the loss, a mean square of residuals, [-].

    Raises `ValueError` without a test, and `RuntimeError` where no specimen of a drape comes to
    rest.
    """
    if not tests:
        raise ValueError("no laboratory test")
    begun = time.perf_counter()
    quick = tuple(test for test in tests if not isinstance(test, Drape))
    start = np.asarray(space.prior()[0])
    if quick:
        others = np.random.default_rng(0).random((STARTS - 1, space.dim))
        ends = [_descend(quick, space, each, progress) for each in (start, *others)]
        start = min(ends, key=lambda end: end.cost).x
    tell(progress, "simulating drapes" if len(quick) < len(tests) else "fitting")
    found = _descend(tuple(tests), space, start, progress)
    if np.any(found.fun == FAILED):
        raise RuntimeError("no specimen of the drape test comes to rest: are its radii right?")
    covariance = np.linalg.inv(_precision(tests, space, found.fun, found.jac))
    deviation = np.sqrt(np.diag(covariance))
    widths = np.array([bound.width for bound in space.ranges])
    place, loss = jnp.asarray(found.x, float), 2 * found.cost / max(len(found.fun), 1)
    values = np.asarray(space.values(place))
    return Estimate(
        approach=APPROACH,
        fabric=space(place),
        ranges=space.ranges,
        values=values,
        standard_errors=deviation * widths,
        correlation=covariance / np.outer(deviation, deviation),
        nuisances=(),
        loss=loss,
        losses=np.array([[loss]]),
        history=values[None, None],
        seconds=time.perf_counter() - begun,
        converged=bool(found.status > 0),
        loss_unit="-",
    )


def informed(space: ParameterSpace, found: Estimate) -> InformedSpace:
    """The space with what an estimate from laboratory tests knows of its places as their prior."""
    widths = np.array([bound.width for bound in space.ranges])
    covariance = _covariance(found, widths)
    place = space.to_unit(found.fabric)
    precision = jnp.asarray(np.linalg.inv(covariance), float)
    return InformedSpace.make(space, place, precision, measured=True)


def apart(told: Estimate, found: Estimate) -> float:
    """How likely it is by chance that an estimate lies as far from what tests alone told, [-].

    `found` has the tests as its prior, so that the difference has the covariance of `told` less its
    own (Hausman, Econometrica 46, 1978); and the error of its mesh, where that was judged. In
    directions that it knows no better than the tests do, its own errors are others, of its mesh or
    its law: there the covariances add. Counted are the parameters that the tests tell.
    """
    ranges = told.ranges
    widths = np.array([bound.width for bound in ranges])
    told_by = np.flatnonzero(told.standard_errors < TOLD * UNIFORM_DEVIATION * widths)
    if not len(told_by):
        return 1.0
    places = [
        np.array(
            [float(r.to_unit(jnp.asarray(v, float))) for r, v in zip(ranges, e.values, strict=True)]
        )
        for e in (told, found)
    ]
    off = (places[1] - places[0])[told_by]
    before, after = (_covariance(each, widths)[np.ix_(told_by, told_by)] for each in (told, found))
    sizes, axes = np.linalg.eigh(before - after)
    both = np.einsum("ij,ik,kj->j", axes, before + after, axes)
    sizes = np.where(sizes > SLACK * np.max(np.linalg.eigvalsh(before)), sizes, both)
    if found.mesh_bias is not None:
        sizes = sizes + (axes**2).T @ (found.mesh_bias / widths)[told_by] ** 2
    return float(chi2.sf(np.sum((axes.T @ off) ** 2 / sizes), len(off)))


def _covariance(estimate: Estimate, widths: np.ndarray) -> np.ndarray:
    deviation = estimate.standard_errors / widths
    return estimate.correlation * np.outer(deviation, deviation)


def fits(tests: Sequence[Test], fabric: Fabric) -> list[Fit]:
    """How a fabric fits each test."""
    return [_fit(test, fabric) for test in tests]


def _fit(test: Test, fabric: Fabric) -> Fit:
    residuals = np.asarray(_residuals_of(test, fabric))
    errors = float(np.sqrt(np.sum(residuals**2) / test.count))
    if isinstance(test, Pull):
        most, force = float(test.stretch.max()) - 1, float(test.tension.max())
        share = float(test.misfit(fabric))
        words = f"up to {force:.3g} N/m at {most:.1%}: off by {share:.1%} of that (rms)"
    elif isinstance(test, Cantilever):
        seen, told = float(test.overhang), float(overhang(fabric, test.direction, test.slope))
        words = f"overhang {1e3 * seen:.1f} mm measured, {1e3 * told:.1f} mm expected"
    else:
        seen = float(test.coefficient)
        told = seen + float(residuals[0] * test.deviation)  # not to simulate it again
        words = f"coefficient {seen:.3f} measured, {told:.3f} expected"
    return Fit(test.name, errors, words)


@eqx.filter_jit
def _residuals_of(test: Test, fabric: Fabric) -> Float[Array, " residual"]:
    return test.residuals(fabric)


def _descend(tests: tuple[Test, ...], space: ParameterSpace, start, progress: Progress | None):
    """The result of scipy's trust region reflective method within the cube."""
    told: list[float] = []

    def at(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, slope = _linearised(tests, space, jnp.asarray(u, float))
        told.append(float(value @ value) / len(value))
        if progress is not None:
            progress(len(told), min(told))
        bad = not np.isfinite(value).all() or not np.isfinite(slope).all()  # a drape that failed
        value, slope = np.asarray(value, np.float64), np.asarray(slope, np.float64)
        return (np.full_like(value, FAILED), np.zeros_like(slope)) if bad else (value, slope)

    kept: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def once(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if u.tobytes() not in kept:
            kept[u.tobytes()] = at(u)
        return kept[u.tobytes()]

    inside = np.clip(np.asarray(start, np.float64), 2 * MARGIN, 1 - 2 * MARGIN)
    return least_squares(
        lambda u: once(u)[0],
        inside,
        jac=lambda u: once(u)[1],  # pyright: ignore[reportArgumentType]  # its stubs know text only
        bounds=(MARGIN, 1 - MARGIN),
        ftol=ENOUGH,
        xtol=ENOUGH,
        max_nfev=60,
    )


@eqx.filter_jit
def _linearised(tests: tuple[Test, ...], space: ParameterSpace, u: Float[Array, " dim"]):
    """Residuals of tests and prior, and their derivative in a place."""

    def residuals(u):
        mean, precision = space.prior()
        beyond = jnp.linalg.cholesky(precision).T @ (u - mean)
        value = jnp.concatenate([*(test.residuals(space(u)) for test in tests), beyond])
        return value, value

    slope, value = jax.jacfwd(residuals, has_aux=True)(u)
    return value, slope


def _precision(
    tests: Sequence[Test], space: ParameterSpace, value: np.ndarray, slope: np.ndarray
) -> np.ndarray:
    """Of a place: what the tests say, less where they scatter by more than they should, and the
    prior of the space. From the residuals of both, and their derivative."""
    value, slope = value[: -space.dim], slope[: -space.dim]
    left = sum(test.count for test in tests) - np.linalg.matrix_rank(slope)
    scatter = max(1.0, float(value @ value) / max(int(left), 1))
    return slope.T @ slope / scatter + np.asarray(space.prior()[1], np.float64)
