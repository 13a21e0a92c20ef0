"""The physics-informed network as an estimator: stiffness from markers and force of stretchings.

A network is trained on each pull (`r2s.estimation.pinn.training`). From it the motion in
equilibrium and the stiffness that fits best are found (`r2s.estimation.pinn.balance`).
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from r2s.estimation.estimate import Estimate, Nuisance
from r2s.estimation.pinn.balance import Fit, balance
from r2s.estimation.pinn.pulls import Pull, stacked
from r2s.estimation.pinn.training import NOISE, QUICK, Recipe, Trained, train
from r2s.estimation.pinn.weak_form import DEGREES
from r2s.materials.parameters import ParameterSpace

# near the clamps the tension carries some of the weight, which the model gives to the table
FRICTION_ERROR = 0.1  # [-]
# between a mesh of 33 x 33 vertices and the continuum, over four noise seeds of five fabrics
STIFFNESS_ERROR, COUPLING_ERROR = 0.006, 0.004  # relative; [-]
MODEL_ERRORS = {"friction": FRICTION_ERROR, "coupling": COUPLING_ERROR, "nu": COUPLING_ERROR}


def estimate(
    pulls: Sequence[Pull],
    space: ParameterSpace,
    recipe: Recipe = QUICK,
    *,
    progress: Callable[[int, float], None] | None = None,
    checkpoint: Path | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """The fabric of one or several pulls.

    The standard errors come from the noise, from the change of the estimate with the number of
    virtual displacements, from what the model leaves out, and from what stiffness changes between
    half the stretch and all of it (they are those of stiffness at small strain). A parameter that
    the pulls do not determine keeps the standard error of its range. Without a force the nuisance
    "stiffness scale" says that the scale is not identifiable; ratios of stiffness may be.

    - `recipe`: of the training.
    - `progress`: called with the number of each chunk of training and its loss [m^2].
    - `checkpoint`: a file from which a killed training goes on.

    Raises `ValueError` for pulls that do not go together, `RuntimeError` when the training diverges
    or no motion is in equilibrium.
    """
    began = time.perf_counter()
    trained = train(
        space, stacked(list(pulls)), recipe, report=progress, checkpoint=checkpoint, key=key
    )
    networks = [
        jax.tree.map(lambda leaf, i=i: leaf[i], trained.model.networks) for i in range(len(pulls))
    ]
    fit = balance(space, networks, pulls, trained.places[-1], NOISE, DEGREES)
    fewer = DEGREES[0] - 1, DEGREES[1] - 1
    change = balance(space, networks, pulls, fit.place, fit.noise, fewer).place - fit.place
    errors = [
        STIFFNESS_ERROR if r.unit == "N/m" else MODEL_ERRORS.get(r.name, 0.0) for r in space.ranges
    ]
    model = np.diag([(error / r.width) ** 2 for error, r in zip(errors, space.ranges, strict=True)])
    fit = fit._replace(covariance=fit.covariance + np.outer(change, change) + model + fit.law)
    words = f"{len(pulls)} pull{'s' if len(pulls) > 1 else ''}"
    if pulls[0].force is None:
        words += ", no force: the scale of stiffness is not identifiable"
    words += "" if fit.converged else ", not converged"
    return _estimate(f"pinn ({words})", fit, space, trained, pulls, began)


def _estimate(
    approach: str, fit: Fit, space: ParameterSpace, trained: Trained, pulls, began: float
) -> Estimate:
    lengths = np.array([bound.width for bound in space.ranges])
    errors = np.sqrt(np.diag(fit.covariance))
    places = np.concatenate([trained.places, fit.places, fit.place[None]])
    history = np.asarray(jax.vmap(space.values)(jnp.asarray(places, float)))
    nuisances = [Nuisance("marker noise", "m", fit.noise[0], np.nan)]
    if pulls[0].force is not None:
        nuisances.append(Nuisance("force noise", "-", fit.noise[1], np.nan))
    scale = np.array([r.unit == "N/m" for r in space.ranges]) * lengths
    if scale.any():
        weights = scale / np.count_nonzero(scale)
        mean = float(np.exp(np.log(history[-1][scale > 0]).mean()))
        spread = float(np.sqrt(weights @ fit.covariance @ weights))  # relative, since log
        nuisances.append(Nuisance("stiffness scale", "N/m", mean, spread * mean))
    return Estimate(
        approach=approach,
        fabric=space(jnp.asarray(fit.place, float)),
        ranges=space.ranges,
        values=history[-1],
        standard_errors=lengths * errors,
        correlation=fit.covariance / np.outer(errors, errors),
        nuisances=tuple(nuisances),
        loss=float(fit.losses[-1]),
        losses=np.concatenate([trained.losses * NOISE[0] ** 2, fit.losses])[:, None],
        history=history[:-1, None],
        seconds=time.perf_counter() - began,
        converged=fit.converged,
    )
