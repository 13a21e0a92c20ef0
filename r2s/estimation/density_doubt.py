"""Would recordings that do not fit one fabric do so with another density of the sheet?

A sheet that is taken to be ten times as heavy needs ten times the stiffness to hang as it was
recorded, and then pulls far harder than its load cell showed. Where `is_asked` says so, a descent
in all recordings whose density is `freed` tells which it would be.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from r2s.estimation.agreement import HARDLY, weighing
from r2s.estimation.estimate import Agreement, Misfit
from r2s.estimation.gauss_newton import Descent, Problems, prior_weight
from r2s.estimation.misfits import FORCE
from r2s.estimation.prediction import Theta
from r2s.estimation.standard_errors import sandwich_of


def is_asked(problems: Problems, found: Agreement | None, misfits: Sequence[Misfit]) -> bool:
    """Whether some of several recordings weigh the sheet, and they or a force do not fit."""
    if len(problems) < 2 or not any(weighing(problems)):
        return False
    is_apart = found is not None and (found.contradiction is not None or found.doubts_density)
    return is_apart or any(each.what == FORCE for each in misfits)


def freed(problems: Problems, theta: Theta) -> tuple[Problems, Theta]:
    """The problems with a density of which only the order is known, and a theta in its units."""
    place, given = problems[0].space.dim, problems[0].nuisance_prior.density
    loose = tuple(
        dataclasses.replace(p, nuisance_prior=p.nuisance_prior._replace(density=HARDLY))
        for p in problems
    )
    return loose, theta.at[place].multiply(given / HARDLY)


def with_density(found: Agreement | None, loose: Problems, end: Descent) -> Agreement | None:
    """An agreement with the density at the end of a descent in problems that are `freed`, over the
    one that was given, and the standard error of its logarithm. None stays None where that density
    is not doubted."""
    place = loose[0].space.dim
    covariance, _ = sandwich_of(loose, end, prior_weight(loose, end.normal))
    error = HARDLY * float(np.sqrt(covariance[place, place]))
    density = float(np.exp(HARDLY * float(end.theta[place]))), error
    judged = (found or Agreement(1.0, (0,) * len(loose), None))._replace(density=density)
    return judged if found or judged.doubts_density else None
