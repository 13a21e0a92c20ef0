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
import optimistix
from jaxtyping import Array, Float
from scipy.stats import chi2

from r2s.estimation.estimate import Estimate
from r2s.estimation.gauss_newton import MARGIN
from r2s.estimation.least_squares import BoundedGaussNewton
from r2s.estimation.method import Progress, tell
from r2s.laboratory.cantilever import Cantilever, overhang
from r2s.laboratory.drape import Drape
from r2s.laboratory.pull import Pull
from r2s.materials.fabric import Fabric
from r2s.materials.informed_space import InformedSpace
from r2s.materials.parameters import UNIFORM_DEVIATION, ParameterSpace

Test = Pull | Cantilever | Drape

APPROACH = "laboratory tests"
STARTS = 8
ENOUGH = 1e-4  # relative, of the sum of squares or of a step: there a descent ends
MOST = 60  # steps
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
    the number of steps and the loss, a mean square of residuals, [-].

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
        start = min(ends, key=lambda end: end.loss).place
    tell(progress, "simulating drapes" if len(quick) < len(tests) else "fitting")
    found = _descend(tuple(tests), space, start, progress)
    if not np.isfinite(found.loss):
        raise RuntimeError("no specimen of the drape test comes to rest: are its radii right?")
    place = jnp.asarray(found.place, float)
    value, slope = (np.asarray(x, np.float64) for x in _linearised(tuple(tests), space, place))
    covariance = np.linalg.inv(_precision(tests, space, value, slope))
    deviation = np.sqrt(np.diag(covariance))
    widths = np.array([bound.width for bound in space.ranges])
    values = np.asarray(space.values(place))
    return Estimate(
        approach=APPROACH,
        fabric=space(place),
        ranges=space.ranges,
        values=values,
        standard_errors=deviation * widths,
        correlation=covariance / np.outer(deviation, deviation),
        nuisances=(),
        loss=found.loss,
        losses=np.array([[found.loss]]),
        history=values[None, None],
        seconds=time.perf_counter() - begun,
        converged=found.converged,
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
        seen, told = float(test.overhang), float(overhang(fabric, test.direction))
        words = f"overhang {1e3 * seen:.1f} mm measured, {1e3 * told:.1f} mm expected"
    else:
        seen = float(test.coefficient)
        told = seen + float(residuals[0] * test.deviation)  # not to simulate it again
        words = f"coefficient {seen:.3f} measured, {told:.3f} expected"
    return Fit(test.name, errors, words)


@eqx.filter_jit
def _residuals_of(test: Test, fabric: Fabric) -> Float[Array, " residual"]:
    return test.residuals(fabric)


class _End(NamedTuple):
    place: np.ndarray
    loss: float  # mean square of the residuals, of the prior's too, [-]
    converged: bool


def _descend(
    tests: tuple[Test, ...], space: ParameterSpace, start, progress: Progress | None
) -> _End:
    """Where a descent of `BoundedGaussNewton` within the cube ends."""
    mean, precision = space.prior()
    solver = BoundedGaussNewton(
        rtol=ENOUGH, atol=ENOUGH, low=MARGIN, high=1 - MARGIN, mean=mean, precision=precision
    )
    place, given = jnp.clip(jnp.asarray(start, float), MARGIN, 1 - MARGIN), (tests, space)
    state = solver.init(_residuals, place, given, {}, None, None, frozenset())
    size = len(jax.eval_shape(_residuals, place, given)[0]) + space.dim
    for count in range(1, MOST + 1):
        place, state, is_done, result = _step(solver, place, given, state)
        if progress is not None:
            progress(count, 2 * float(state.loss) / size)
        if is_done:
            break
    is_good = bool(is_done) and bool(result == optimistix.RESULTS.successful)
    return _End(np.asarray(place), 2 * float(state.loss) / size, is_good)


@eqx.filter_jit
def _step(solver: BoundedGaussNewton, place: Float[Array, " dim"], given, state):
    place, state, _ = solver.step(_residuals, place, given, {}, state, frozenset())
    return place, state, *solver.terminate(_residuals, place, given, {}, state, frozenset())


def _residuals(u: Float[Array, " dim"], given: tuple[tuple[Test, ...], ParameterSpace]):
    tests, space = given
    return jnp.concatenate([test.residuals(space(u)) for test in tests]), None


@eqx.filter_jit
def _linearised(tests: tuple[Test, ...], space: ParameterSpace, u: Float[Array, " dim"]):
    """Residuals of tests, and their derivative in a place."""
    value, slope = jax.linearize(lambda u: _residuals(u, (tests, space))[0], u)
    return value, jax.vmap(slope, out_axes=1)(jnp.eye(len(u), dtype=u.dtype))


def _precision(
    tests: Sequence[Test], space: ParameterSpace, value: np.ndarray, slope: np.ndarray
) -> np.ndarray:
    """Of a place: what the tests say, less where they scatter by more than they should, and the
    prior of the space. From the residuals, and their derivative."""
    left = sum(test.count for test in tests) - np.linalg.matrix_rank(slope)
    scatter = max(1.0, float(value @ value) / max(int(left), 1))
    return slope.T @ slope / scatter + np.asarray(space.prior()[1], np.float64)
