"""Whether a search ends at the same fabric from elsewhere, and the best of where it ends.

A loss over a motion has several minima, and a descent says nothing of those that it did not see.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation import gauss_newton, standard_errors
from r2s.estimation.compiled import loss_from
from r2s.estimation.descent import Search, search
from r2s.estimation.method import Budget, Progress, tell
from r2s.fabrics.parameters import ParameterSpace

# standard errors, by which ends of one minimum differ at most: a search that is to confirm another
# stops within half of one
ALIKE = 1.0
MOST = 3  # searches, where the first two differ

_weight = eqx.filter_jit(gauss_newton.prior_weight)
_sandwich = eqx.filter_jit(standard_errors.sandwich_of)


def look_again(
    found: Search, budget: Budget, *, progress: Progress | None = None, key: PRNGKeyArray
) -> Search:
    """The best of a search and of others from elsewhere, with how many of them ended there.

    The second starts at the prior mean, a third, where these two differ, at a draw of the prior.
    All count the same points, with the scale of the outliers of the best fit. A search that
    diverges counts as one that ended elsewhere. The other arguments are those of
    `r2s.estimation.descent.search`; a killed run looks again from the beginning.
    """
    problems, ends, looks = found.problems, [found], 1
    once = budget._replace(coarse=0, starts=1, near=False, leads_on=True)
    more = {"derive": found.derive, "progress": progress, "key": key}
    while looks < MOST:
        start = _start(problems[0].space, looks, key)
        looks += 1
        try:
            words = f"search {looks}, from another start"
            ends.append(search(problems, once, start=start, words=words, **more))
        except RuntimeError as error:
            if isinstance(error, jax.errors.JaxRuntimeError):  # out of memory, say
                raise
            tell(progress, f"search {looks} diverged")
        losses = _losses(ends, budget)
        best = ends[int(np.argmin(losses))]
        alike = sum(_is_alike(best, each) for each in ends)
        if alike > 1:
            break
    if best is not found:
        to_the_end = once._replace(shares=(), near=True, leads_on=False)
        best = search(problems, to_the_end, start=best.theta, words="its end", **more)
        ends.append(best)
    seconds = sum(each.seconds for each in ends)
    return best._replace(seconds=seconds, reached=(alike, looks))


def _start(space: ParameterSpace, number: int, key: PRNGKeyArray) -> Float[Array, " dim"]:
    """The prior mean, and from the second on draws of the prior."""
    mean, precision = space.prior()
    if number > 1:
        draw = jr.normal(jr.fold_in(key, number), mean.shape, float)
        mean = mean + jnp.linalg.solve(jnp.linalg.cholesky(precision).T, draw)
    return jnp.clip(mean, gauss_newton.MARGIN, 1 - gauss_newton.MARGIN)


def _losses(ends: list[Search], budget: Budget) -> list[float]:
    """The losses [m^2] of all points at some ends, beyond one scale for all."""
    scale = min((each.best.scale for each in ends), key=float)
    found = []
    for each in ends:
        predicted = each.derive(each.problems, each.theta, budget.width)
        found.append(loss_from(each.problems, [seen for seen, _ in predicted], scale))
    return found


def _is_alike(best: Search, other: Search) -> bool:
    """Whether two searches ended at one fabric, as far as the first knows it."""
    end, fabric = best.best, slice(best.problems[0].space.dim)
    covariance, _ = _sandwich(best.problems, end, _weight(best.problems, end.normal))
    errors = np.sqrt(np.diag(np.asarray(covariance)))[fabric]
    off = np.abs(np.asarray(other.theta) - np.asarray(end.theta))[fabric]
    return bool(np.all(off <= ALIKE * errors))
