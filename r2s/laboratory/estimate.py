"""The fabric that best explains laboratory tests, and the prior that it gives to motions.

    by_tests = estimate((pull_along_warp, pull_along_weft, cantilever), on_cloth(density))
    space = informed(on_cloth(density), by_tests)      # for an estimate from motions beside them

The estimate has the least sum of squares of all tests' residuals and of the prior of the space. The
zero of each pull is a nuisance parameter, with the prior that its curve gives (`pull.rest_of`).
Standard errors are those of the linearised problem; where the tests scatter by more than they
should they grow by as much (Birge 1932).
"""

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array
from scipy.linalg import block_diag
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

from r2s.estimation.estimate import Estimate, Nuisance
from r2s.estimation.gauss_newton import MARGIN
from r2s.estimation.least_squares import BoundedGaussNewton
from r2s.estimation.method import Progress, tell
from r2s.laboratory.bending import Cantilever, Drape, overhang
from r2s.laboratory.pull import Pull
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import UNIFORM_DEVIATION, InformedSpace, ParameterSpace

Test = Pull | Cantilever | Drape

APPROACH = "laboratory tests"
STARTS = 8
TOLERANCE = 1e-4  # relative, of the sum of squares or of a step
MAX_STEPS = 60
SLACK = 0.02  # of a variance: information that a motion is not taken to add
IDENTIFIED = 0.5  # of the prior's standard error: below, tests identify a parameter
REACH = 5.0  # standard deviations of a zero, at most, that an estimate moves it by
POOR_FIT = 3.0  # standard deviations (root mean square), beyond which a test does not fit


class Fit(NamedTuple):
    """The name of a test, the rms of its residuals [standard deviations], and what was measured and
    is expected in `words`."""

    test: str
    errors: float
    words: str


def estimate(
    tests: Sequence[Test], space: ParameterSpace, progress: Progress | None = None
) -> Estimate:
    """The fabric of a space that explains some tests of it.

    Parameters on which no test depends stay at the prior mean. `progress` reports what is being
    done. Raises `ValueError` without a test, and `RuntimeError` where no specimen of a drape comes
    to rest.
    """
    if not tests:
        raise ValueError("no laboratory test")
    begun = time.perf_counter()
    tests = tuple(tests)
    quick = tuple(test for test in tests if not isinstance(test, Drape))
    start = _prior(tests, space)[0]
    if quick:
        others = np.tile(start, (STARTS - 1, 1))
        others[:, : space.dim] = np.random.default_rng(0).random((STARTS - 1, space.dim))
        ends = [_descend(quick, space, place) for place in (start, *others)]
        start = min(ends, key=lambda end: end[0])[1]
    tell(progress, "simulating drapes" if len(quick) < len(tests) else "fitting")
    loss, end, converged = _descend(tests, space, start)
    if not np.isfinite(loss):
        raise RuntimeError("no specimen of the drape test comes to rest: are its radii right?")
    place = jnp.asarray(end, float)
    covariance = _place_covariance(tests, space, place)
    every = np.sqrt(np.diag(covariance))
    zeros = _zeros(tests, end[space.dim :], every[space.dim :])
    deviation, place = every[: space.dim], place[: space.dim]
    covariance = covariance[: space.dim, : space.dim]
    values = np.asarray(space.values(place))
    return Estimate(
        approach=APPROACH,
        fabric=space(place),
        ranges=space.ranges,
        values=values,
        standard_errors=deviation * np.array([bound.width for bound in space.ranges]),
        correlation=covariance / np.outer(deviation, deviation),
        nuisances=zeros,
        loss=loss,
        losses=np.array([[loss]]),
        history=values[None, None],
        seconds=time.perf_counter() - begun,
        converged=converged,
        loss_unit="-",
    )


def informed(space: ParameterSpace, by_tests: Estimate) -> InformedSpace:
    """The space with an estimate from laboratory tests as its prior."""
    precision = jnp.asarray(np.linalg.inv(_covariance(by_tests)), float)
    return InformedSpace.make(space, space.to_unit(by_tests.fabric), precision, measured=True)


def consistency(by_tests: Estimate, by_motions: Estimate) -> float:
    """The p-value of an estimate from motions, given that of the tests that are its prior, [-].

    The difference has the covariance of `by_tests` less that of `by_motions` (Hausman, Econometrica
    46, 1978), and the error of the mesh, where that was estimated. In directions that the motions
    did not improve, the errors of mesh and law are independent: there the covariances add. Only
    parameters that the tests identify count.
    """
    ranges = by_tests.ranges
    widths = np.array([bound.width for bound in ranges])
    which = np.flatnonzero(by_tests.standard_errors < IDENTIFIED * UNIFORM_DEVIATION * widths)
    if not len(which):
        return 1.0

    def place(estimate: Estimate) -> np.ndarray:
        pairs = zip(ranges, estimate.values, strict=True)
        return np.array([float(bound.to_unit(jnp.asarray(v, float))) for bound, v in pairs])

    off = (place(by_motions) - place(by_tests))[which]
    before, after = (_covariance(one)[np.ix_(which, which)] for one in (by_tests, by_motions))
    variances, axes = np.linalg.eigh(before - after)
    sums = np.einsum("ij,ik,kj->j", axes, before + after, axes)
    variances = np.where(variances > SLACK * np.max(np.linalg.eigvalsh(before)), variances, sums)
    if by_motions.mesh_bias is not None:
        variances = variances + (axes**2).T @ (by_motions.mesh_bias / widths)[which] ** 2
    return float(chi2.sf(np.sum((axes.T @ off) ** 2 / variances), len(off)))


def _covariance(estimate: Estimate) -> np.ndarray:
    """Of the place in the unit cube."""
    deviation = estimate.standard_errors / np.array([bound.width for bound in estimate.ranges])
    return estimate.correlation * np.outer(deviation, deviation)


def fits(tests: Sequence[Test], fabric: Fabric) -> list[Fit]:
    """How a fabric fits each test."""
    return [_fit(test, fabric) for test in tests]


def _fit(test: Test, fabric: Fabric) -> Fit:
    shift = 0.0
    if isinstance(test, Pull) and test.zero_deviation > 0:
        deviation = float(test.zero_deviation)

        def squares(z: float) -> float:  # z: standard deviations
            return float(np.sum(np.asarray(_residuals_of(test, fabric, z * deviation)) ** 2)) + z**2

        shift = deviation * float(minimize_scalar(squares, bounds=(-REACH, REACH)).x)
    residuals = np.asarray(_residuals_of(test, fabric, shift))
    errors = float(np.sqrt(np.sum(residuals**2) / test.count))
    if isinstance(test, Pull):
        most, largest = float(test.stretch.max()) - 1, float(test.tension.max())
        share, rest = float(test.misfit(fabric, shift)), 1e3 * (float(test.zero) + shift)
        words = f"up to {largest:.3g} N/m at {most:.1%}: off by {share:.1%} of that (rms)"
        words += f", at rest at an extension of {rest:.3g} mm"
    elif isinstance(test, Cantilever):
        measured, expected = float(test.overhang), float(overhang(fabric, test.direction))
        words = f"overhang {1e3 * measured:.1f} mm measured, {1e3 * expected:.1f} mm expected"
    else:
        measured = float(test.coefficient)
        expected = measured + float(residuals[0] * test.deviation)  # not to simulate it again
        words = f"coefficient {measured:.3f} measured, {expected:.3f} expected"
    return Fit(test.name, errors, words)


@eqx.filter_jit
def _residuals_of(test: Test, fabric: Fabric, shift: Array | float) -> Array:
    shift = jnp.asarray(shift, float)
    return test.residuals(fabric, shift) if isinstance(test, Pull) else test.residuals(fabric)


def _residuals(place: Array, args: tuple[tuple[Test, ...], ParameterSpace]) -> Array:
    """Of all tests at a place: that of a fabric in the unit cube, then the zero of each pull, 0 to
    1 for `REACH` standard deviations on either side."""
    tests, space = args
    fabric, zeros = space(place[: space.dim]), iter(place[space.dim :])
    shifts = [_shift(t, next(zeros)) if isinstance(t, Pull) else 0.0 for t in tests]
    pairs = zip(tests, shifts, strict=True)
    return jnp.concatenate([_residuals_of(test, fabric, shift) for test, shift in pairs])


def _shift(pull: Pull, place: Any) -> Any:
    """Of its zero [m], from 0 to 1."""
    return (2 * place - 1) * REACH * pull.zero_deviation


def _prior(tests: Sequence[Test], space: ParameterSpace) -> tuple[np.ndarray, np.ndarray]:
    """Mean and precision of a place, see `_residuals`."""
    mean, precision = (np.asarray(number, float) for number in space.prior())
    pulls = sum(isinstance(test, Pull) for test in tests)
    return (
        np.append(mean, np.full(pulls, 0.5)),
        block_diag(precision, (2 * REACH) ** 2 * np.eye(pulls)),
    )


def _zeros(
    tests: Sequence[Test], places: np.ndarray, deviations: np.ndarray
) -> tuple[Nuisance, ...]:
    """The zero of each pull whose own is uncertain."""
    rows = zip([t for t in tests if isinstance(t, Pull)], places, deviations, strict=True)
    return tuple(
        Nuisance(
            f"zero of {pull.name.rsplit(': ', 1)[-1]}",
            "m",
            float(pull.zero + _shift(pull, place)),
            float(_shift(pull, 0.5 + deviation)),
        )
        for pull, place, deviation in rows
        if pull.zero_deviation > 0
    )


def _descend(
    tests: tuple[Test, ...], space: ParameterSpace, start: np.ndarray
) -> tuple[float, np.ndarray, bool]:
    """The least squares from a start within the unit cube: the mean square of the residuals and of
    those of the prior, [-]; the place; and whether it converged."""
    mean, precision = (jnp.asarray(number, float) for number in _prior(tests, space))
    low, high = MARGIN, 1 - MARGIN
    solver = BoundedGaussNewton(
        rtol=TOLERANCE, atol=TOLERANCE, low=low, high=high, mean=mean, precision=precision
    )
    place, args = jnp.clip(jnp.asarray(start, float), low, high), (tests, space)
    solution = optimistix.least_squares(
        _residuals, solver, place, args, max_steps=MAX_STEPS, throw=False
    )
    size = len(jax.eval_shape(_residuals, place, args)) + len(start)
    converged = bool(solution.result == optimistix.RESULTS.successful)
    return 2 * float(solution.stats["loss"]) / size, np.asarray(solution.value), converged


@eqx.filter_jit
def _linearised(tests: tuple[Test, ...], space: ParameterSpace, u: Array):
    """Residuals of tests, and their derivative in a place."""
    value, slope = jax.linearize(lambda u: _residuals(u, (tests, space)), u)
    return value, jax.vmap(slope, out_axes=1)(jnp.eye(len(u), dtype=u.dtype))


def _place_covariance(tests: tuple[Test, ...], space: ParameterSpace, place: Array) -> np.ndarray:
    """From tests, which count less where they scatter by more than they should, and the prior."""
    value, slope = (np.asarray(x, np.float64) for x in _linearised(tests, space, place))
    mean, precision = _prior(tests, space)
    free = sum(test.count for test in tests) - np.linalg.matrix_rank(slope[:, : space.dim])
    off = 2 * REACH * (np.asarray(place, np.float64) - mean)[space.dim :]
    scatter = max(1.0, float(value @ value + off @ off) / max(int(free), 1))
    return np.linalg.inv(slope.T @ slope / scatter + precision)
