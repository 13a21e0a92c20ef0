"""The physics-informed network as an estimator: stiffness from markers and force of stretchings.

A network is trained on each pull (`r2s.estimation.pinn.training`); from it the motion in balance
and the stiffness that fits best (`r2s.estimation.pinn.balance`), with its covariance.
"""

import time
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from r2s.estimation.estimate import Estimate, Nuisance, without_standard_errors
from r2s.estimation.pinn.balance import Balanced, balance
from r2s.estimation.pinn.pulls import Pull, stacked
from r2s.estimation.pinn.training import NOISE, Recipe, Trained, chunks, train
from r2s.estimation.pinn.weak_form import DEGREES, weak_losses
from r2s.fabrics.parameters import ParameterSpace

QUICK = Recipe(losses=weak_losses, warm_up=200, adam=200, lbfgs=0)
# what the network is for here: a motion to begin with, and its accelerations
# what the plane leaves out: near the clamps the tension carries some of the weight, not the table
FRICTION_ERROR = 0.1  # [-]
# between a mesh of 33 x 33 vertices and the continuum, over four noise seeds of five fabrics
STIFFNESS_ERROR, COUPLING_ERROR = 0.006, 0.004  # relative; [-]


class Found(NamedTuple):
    """An estimate, and the fabric that the networks alone arrived at (without deviations)."""

    estimate: Estimate
    network: Estimate


def estimate(
    pulls: Sequence[Pull],
    space: ParameterSpace,
    recipe: Recipe = QUICK,
    *,
    noise: tuple[float, float] = NOISE,
    progress: bool = False,
    key: PRNGKeyArray,
) -> Found:
    """The fabric of one or several pulls of one fabric. Arguments as of `estimate_all`."""
    return estimate_all([pulls], [space], recipe, noise=noise, progress=progress, key=key)[0]


def estimate_all(
    pulls: Sequence[Sequence[Pull]],
    spaces: Sequence[ParameterSpace],
    recipe: Recipe = QUICK,
    *,
    noise: tuple[float, float] = NOISE,
    progress: bool = False,
    key: PRNGKeyArray,
) -> list[Found]:
    """The fabrics of as many pulls each, their networks trained together.

    `noise` of the markers [m] and of the force over its greatest [-] is where to begin: it is
    estimated along. Deviations come from noise, from how the estimate changes with the number of
    virtual displacements, and from what the model leaves out. What the pulls do not determine keeps
    the deviation of its range. Without force the deviation of the stiffness scale, among the
    `conditions`, says that it is not identifiable; ratios may be. With `progress` a bar on stderr.
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
    stack = lambda *leaves: jnp.stack(leaves)
    together = jax.tree.map(stack, *(stacked(list(some)) for some in pulls))
    trained = _trained(jax.tree.map(stack, *spaces), together, recipe, noise, progress, key)
    shared = (time.perf_counter() - began) / len(pulls)
    return [
        _found(trained, i, list(some), space, recipe, noise, shared)
        for i, (some, space) in enumerate(zip(pulls, spaces, strict=True))
    ]


def _trained(spaces, pulls, recipe, noise, progress, key) -> Trained:
    if not progress:
        return train(spaces, pulls, recipe, noise=noise, key=key)
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise ImportError("progress needs tqdm: pip install 'r2s[study]'") from error
    with tqdm(total=chunks(recipe), desc="networks", disable=None) as bar:

        def report(losses, places):
            del places
            bar.set_postfix(
                {name: f"{value.mean():.3g}" for name, value in losses._asdict().items()}
            )
            bar.update()

        return train(spaces, pulls, recipe, noise=noise, report=report, key=key)


def _found(trained: Trained, i: int, pulls, space, recipe, noise, seconds: float) -> Found:
    began = time.perf_counter()
    model = jax.tree.map(lambda leaf: leaf[i], trained.model)
    part = lambda j: jax.tree.map(lambda leaf: leaf[j], model.networks)
    networks = [part(j) for j in range(len(pulls))]
    squares = np.asarray(trained.losses.data)[i] * noise[0] ** 2
    history = np.stack([np.asarray(space.values(jnp.asarray(p, float))) for p in trained.places[i]])
    about = f"{len(pulls)} pull{'s' if len(pulls) > 1 else ''}"
    if pulls[0].force is None:
        about += ", no force: the scale of stiffness is not identifiable"
    form = "weak form" if recipe.losses is weak_losses else "strong form"
    network = without_standard_errors(
        f"pinn ({form}, {about})",
        space,
        model.place,
        float(squares[-1]),
        squares[:, None],
        history[:, None],
        seconds,
    )
    balanced = _balanced(space, networks, pulls, np.asarray(model.place), noise, recipe)
    seconds += time.perf_counter() - began
    return Found(_estimate(balanced, space, network, f"pinn ({about})", pulls, seconds), network)


def _balanced(space: ParameterSpace, networks, pulls, place, noise, recipe: Recipe) -> Balanced:
    """The estimate from the weak form, with what it owes to the number of virtual displacements."""
    found = balance(space, networks, pulls, place, noise[0], noise[1], recipe.strain, DEGREES)
    about = found.place, found.marker, found.force, recipe.strain
    fewer = DEGREES[0] - 1, DEGREES[1] - 1
    difference = balance(space, networks, pulls, *about, degrees=fewer).place - found.place
    more = np.outer(difference, difference) + np.diag(_unmodelled(space) ** 2)
    return found._replace(covariance=found.covariance + more)


def _unmodelled(space: ParameterSpace) -> np.ndarray:
    """Deviations of places in the space for what the model leaves out."""
    errors = {"friction": FRICTION_ERROR, "coupling": COUPLING_ERROR, "nu": COUPLING_ERROR}
    error = lambda r: STIFFNESS_ERROR if r.unit == "N/m" else errors.get(r.name, 0.0)
    length = lambda r: np.log(r.high / r.low) if r.log else r.high - r.low
    return np.array([error(r) / length(r) for r in space.ranges])


def _estimate(
    found: Balanced, space: ParameterSpace, network: Estimate, approach: str, pulls, seconds: float
) -> Estimate:
    lengths = np.array([np.log(r.high / r.low) if r.log else r.high - r.low for r in space.ranges])
    deviations = np.sqrt(np.diag(found.covariance))
    correlation = found.covariance / np.outer(deviations, deviations)
    values = lambda place: np.asarray(space.values(jnp.asarray(place, float)))
    history = np.concatenate(
        [network.history, np.stack([values(p) for p in found.places])[:, None]]
    )
    scale = np.array([r.unit == "N/m" for r in space.ranges]) * lengths
    conditions = [Nuisance("marker noise", "m", found.marker, np.nan)]
    if pulls[0].force is not None:
        conditions.append(Nuisance("force noise", "-", found.force, np.nan))
    if scale.any():
        weights = scale / np.count_nonzero(scale)
        stiff = values(found.place)[scale > 0]
        mean = float(np.exp(np.log(stiff).mean()))
        spread = float(np.sqrt(weights @ found.covariance @ weights))  # relative, since log
        conditions.append(Nuisance("stiffness scale", "N/m", mean, spread * mean))
    return Estimate(
        approach=approach if found.converged else approach[:-1] + ", not converged)",
        fabric=space(jnp.asarray(found.place, float)),
        ranges=space.ranges,
        values=values(found.place),
        standard_errors=lengths * deviations,
        correlation=correlation,
        nuisances=tuple(conditions),
        loss=float(found.losses[-1]),
        losses=np.concatenate([network.losses, found.losses[:, None]]),
        history=history,
        seconds=seconds,
    )
