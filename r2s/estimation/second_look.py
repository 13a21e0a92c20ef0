"""Whether a search ends at the same fabric from elsewhere, and the best of where it ends.

A loss over a motion has several minima, and a descent says nothing of those that it did not see.
"""

from functools import partial

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation import gauss_newton
from r2s.estimation.compiled import loss_from
from r2s.estimation.descent import Search, search
from r2s.estimation.method import Budget, Progress, tell
from r2s.materials.parameters import ParameterSpace

ALIKE = 1.02  # times the least loss, within which two ends fit alike
LIKELY = 1.25  # times that, within which an end shows how far apart minima of a rough loss lie
MOST = 3  # searches, where the first two differ


def look_again(
    found: Search, budget: Budget, *, progress: Progress | None = None, key: PRNGKeyArray
) -> Search:
    """The best of a search and of others from elsewhere, with how many of them fit as well.

    These start at draws of the prior; there is a third where the first two differ. All count the
    same points, with the scale of the outliers of the best fit. Where they end apart but fit nearly
    alike, little tells these fabrics apart, and the standard errors hold that. A search that
    diverges counts as one that ended elsewhere. The other arguments are those of
    `r2s.estimation.descent.search`; a killed run looks again from the beginning.
    """
    problems, ends, looks = found.problems, [found], 1
    once = budget._replace(coarse=0, starts=1, near=False, leads_on=True)
    again = partial(search, problems, derive=found.derive, progress=progress, key=key)
    while looks < MOST:
        start = _draw(problems[0].space, jr.fold_in(key, looks))
        looks += 1
        try:
            words = f"search {looks}, from another start"
            ends.append(again(once, start=start, words=words))
        except RuntimeError as error:
            if isinstance(error, jax.errors.JaxRuntimeError):  # out of memory, say
                raise
            tell(progress, f"search {looks} diverged")
        losses = _losses(ends, budget)
        best = ends[int(np.argmin(losses))]
        alike = sum(loss <= ALIKE * min(losses) for loss in losses)
        if alike > 1:
            break
    likely = [e for e, loss in zip(ends, losses, strict=True) if loss <= LIKELY * min(losses)]
    others = tuple(each.theta for each in likely if each is not best)
    if best is not found:
        to_the_end = once._replace(shares=(), near=True, leads_on=False)
        best = again(to_the_end, start=best.theta, words="its end")
        ends.append(best)
    lost = f"none of {looks - 1} searches from other starts fits as well"
    return best._replace(
        seconds=sum(each.seconds for each in ends),
        others=others,
        reached=(alike, looks),
        unsure="" if alike > 1 else lost,
    )


def _draw(space: ParameterSpace, key: PRNGKeyArray) -> Float[Array, " dim"]:
    """A place that is drawn from the prior."""
    mean, precision = space.prior()
    draw = jr.normal(key, mean.shape, float)
    place = mean + jnp.linalg.solve(jnp.linalg.cholesky(precision).T, draw)
    return jnp.clip(place, gauss_newton.MARGIN, 1 - gauss_newton.MARGIN)


def _losses(ends: list[Search], budget: Budget) -> list[float]:
    """The losses [m^2] of all points at some ends, beyond one scale for all."""
    scale = min((each.best.scale for each in ends), key=float)
    found = []
    for each in ends:
        predicted = each.derive(each.problems, each.theta, budget.width)
        found.append(loss_from(each.problems, [seen for seen, _ in predicted], scale))
    return found
