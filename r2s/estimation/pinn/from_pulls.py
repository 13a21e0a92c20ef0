"""The physics-informed network as an estimator: stiffness from markers and force of stretchings.

A network is trained on each pull (`r2s.estimation.pinn.training`). From it the motion in balance
and the stiffness that fits best are found, with their covariance (`r2s.estimation.pinn.balance`).
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from r2s.estimation.estimate import Estimate, Nuisance, point_estimate
from r2s.estimation.pinn.balance import Balanced, balance
from r2s.estimation.pinn.losses import Losses
from r2s.estimation.pinn.network import Network
from r2s.estimation.pinn.pulls import Pull, stacked
from r2s.estimation.pinn.training import NOISE, Recipe, Trained, train
from r2s.estimation.pinn.weak_form import DEGREES, weak_losses
from r2s.fabrics.parameters import ParameterSpace

# the balance needs no more of a network than a motion to begin with, and its accelerations
QUICK = Recipe(losses=weak_losses, warm_up=200, adam=200, lbfgs=0)
# near the clamps the tension carries some of the weight, which the model gives to the table
FRICTION_ERROR = 0.1  # [-]
# between a mesh of 33 x 33 vertices and the continuum, over four noise seeds of five fabrics
STIFFNESS_ERROR, COUPLING_ERROR = 0.006, 0.004  # relative; [-]


class Found(NamedTuple):
    """An estimate, and the fabric that the networks alone arrived at, without standard errors."""

    estimate: Estimate
    network: Estimate


def estimate(
    pulls: Sequence[Pull],
    space: ParameterSpace,
    recipe: Recipe = QUICK,
    *,
    noise: tuple[float, float] = NOISE,
    progress: Callable[[int, float], None] | None = None,
    checkpoint: Path | None = None,
    key: PRNGKeyArray,
) -> Found:
    """The fabric of one or several pulls of one fabric; see `estimate_all` for the arguments."""
    return estimate_all(
        [pulls], [space], recipe, noise=noise, progress=progress, checkpoint=checkpoint, key=key
    )[0]


def estimate_all(
    pulls: Sequence[Sequence[Pull]],
    spaces: Sequence[ParameterSpace],
    recipe: Recipe = QUICK,
    *,
    noise: tuple[float, float] = NOISE,
    progress: Callable[[int, float], None] | None = None,
    checkpoint: Path | None = None,
    key: PRNGKeyArray,
) -> list[Found]:
    """The fabrics of as many pulls each, their networks trained together.

    The standard errors come from the noise, from the change of the estimate with the number of
    virtual displacements, from what the model leaves out, and from what stiffness changes between
    half the stretch and all of it (they are those of stiffness at small strain). A parameter that
    the pulls do not determine keeps the standard error of its range. Without a force the nuisance
    "stiffness scale" says that the scale is not identifiable; ratios of stiffness may be.

    - `pulls`, `spaces`: of each fabric; as many pulls of each, and spaces of the same ranges.
    - `recipe`: of the training.
    - `noise`: of the markers [m], and of the force over its greatest [-], to begin with. It is
      estimated along.
    - `progress`: called with the number of each chunk of training and its loss [m^2].
    - `checkpoint`: a file from which a killed training goes on.

    Raises `ValueError` for pulls that do not go together, `RuntimeError` when the training or the
    balance diverges.
    """
    if not pulls or len(pulls) != len(spaces):
        raise ValueError(f"{len(pulls)} fabrics were pulled, but {len(spaces)} spaces given")
    if len({len(some) for some in pulls}) > 1:
        raise ValueError(f"as many pulls of each fabric are needed, got {[len(p) for p in pulls]}")
    if len({space.ranges for space in spaces}) > 1:
        raise ValueError("the spaces must have the same ranges")
    began = time.perf_counter()

    def report(chunk: int, losses: Losses) -> None:
        if progress is not None:
            progress(chunk, float(losses.data.mean()) * noise[0] ** 2)

    trained = train(
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *spaces),
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *(stacked(list(some)) for some in pulls)),
        recipe,
        noise=noise,
        report=report,
        checkpoint=checkpoint,
        key=key,
    )
    shared = (time.perf_counter() - began) / len(pulls)
    return [
        _found(trained, i, list(some), space, recipe, noise, shared)
        for i, (some, space) in enumerate(zip(pulls, spaces, strict=True))
    ]


def _found(
    trained: Trained,
    which: int,
    pulls: list[Pull],
    space: ParameterSpace,
    recipe: Recipe,
    noise: tuple[float, float],
    seconds: float,
) -> Found:
    """The estimate of one of the fabrics that were trained in `seconds`."""
    began = time.perf_counter()
    model = jax.tree.map(lambda leaf: leaf[which], trained.model)
    words = f"{len(pulls)} pull{'s' if len(pulls) > 1 else ''}"
    if pulls[0].force is None:
        words += ", no force: the scale of stiffness is not identifiable"
    form = "weak form" if recipe.losses is weak_losses else "strong form"
    squares = np.asarray(trained.losses.data)[which] * noise[0] ** 2
    network = point_estimate(
        f"pinn ({form}, {words})",
        space,
        model.place,
        float(squares[-1]),
        squares[:, None],
        np.stack([_values(space, place) for place in trained.places[which]])[:, None],
        seconds,
    )
    networks = [jax.tree.map(lambda leaf, j=j: leaf[j], model.networks) for j in range(len(pulls))]
    balanced = _balanced(space, networks, pulls, np.asarray(model.place), noise, recipe)
    seconds += time.perf_counter() - began
    words += "" if balanced.converged else ", not converged"
    return Found(_estimate(balanced, space, network, f"pinn ({words})", pulls, seconds), network)


def _balanced(
    space: ParameterSpace,
    networks: list[Network],
    pulls: list[Pull],
    place: np.ndarray,
    noise: tuple[float, float],
    recipe: Recipe,
) -> Balanced:
    """The estimate from the weak form. Its covariance counts the number of virtual displacements,
    by the change with one degree less each way, what the model leaves out, and what stiffness
    changes with the stretch."""
    found = balance(space, networks, pulls, place, *noise, recipe.strain, DEGREES)
    degrees = DEGREES[0] - 1, DEGREES[1] - 1
    fewer = balance(
        space, networks, pulls, found.place, found.marker, found.force, recipe.strain, degrees
    )
    difference = fewer.place - found.place
    more = np.outer(difference, difference) + np.diag(_unmodelled(space) ** 2) + found.law
    return found._replace(covariance=found.covariance + more)


def _values(space: ParameterSpace, place: np.ndarray) -> np.ndarray:
    return np.asarray(space.values(jnp.asarray(place, float)))


def _lengths(space: ParameterSpace) -> np.ndarray:
    """Lengths of the ranges, on the scale of each."""
    return np.array([np.log(r.high / r.low) if r.log else r.high - r.low for r in space.ranges])


def _unmodelled(space: ParameterSpace) -> np.ndarray:
    """Standard errors of places in the space, for what the model leaves out."""
    errors = {"friction": FRICTION_ERROR, "coupling": COUPLING_ERROR, "nu": COUPLING_ERROR}
    error = [STIFFNESS_ERROR if r.unit == "N/m" else errors.get(r.name, 0.0) for r in space.ranges]
    return np.array(error) / _lengths(space)


def _estimate(
    found: Balanced, space: ParameterSpace, network: Estimate, approach: str, pulls, seconds: float
) -> Estimate:
    lengths, errors = _lengths(space), np.sqrt(np.diag(found.covariance))
    values = _values(space, found.place)
    steps = np.stack([_values(space, place) for place in found.places])[:, None]
    nuisances = [Nuisance("marker noise", "m", found.marker, np.nan)]
    if pulls[0].force is not None:
        nuisances.append(Nuisance("force noise", "-", found.force, np.nan))
    scale = np.array([r.unit == "N/m" for r in space.ranges]) * lengths
    if scale.any():
        weights = scale / np.count_nonzero(scale)
        mean = float(np.exp(np.log(values[scale > 0]).mean()))
        spread = float(np.sqrt(weights @ found.covariance @ weights))  # relative, since log
        nuisances.append(Nuisance("stiffness scale", "N/m", mean, spread * mean))
    return Estimate(
        approach=approach,
        fabric=space(jnp.asarray(found.place, float)),
        ranges=space.ranges,
        values=values,
        standard_errors=lengths * errors,
        correlation=found.covariance / np.outer(errors, errors),
        nuisances=tuple(nuisances),
        loss=float(found.losses[-1]),
        losses=np.concatenate([network.losses, found.losses[:, None]]),
        history=np.concatenate([network.history, steps]),
        seconds=seconds,
        converged=found.converged,
    )
