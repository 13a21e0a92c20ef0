"""How far an estimate would go on a finer mesh: one step of Gauss-Newton with that mesh's motion.

The prediction is made on another mesh, its derivative is that of the mesh of the estimate, laid
onto the other's vertices. Where the meshes agree on the fabric the step is next to nothing. From
that mesh it is extrapolated to one without end (Richardson), by the order of the error in
`r2s.scenarios.resolution`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s.estimation import compiled, normal_equations
from r2s.estimation.bounded import bounded_step, only_held, room
from r2s.estimation.compiled import Derive, loss_from, predictions_at
from r2s.estimation.gauss_newton import (
    MARGIN,
    Descent,
    Problems,
    prior_terms,
    prior_weight,
    recording_weights,
    theta_indices,
    theta_length,
)
from r2s.estimation.prediction import Prediction, Sensitivity, Theta
from r2s.estimation.problem import Problem, motion_alone
from r2s.fabrics.informed_space import InformedSpace
from r2s.geometry.surface import nearest
from r2s.kept import kept
from r2s.scenarios.resolution import ORDER

RISE, HALVINGS = 2.0, 6  # of a loss, and of the step that raises it by more
RCOND = 1e-6  # of the recordings' information: less than that is none

_equations = kept(normal_equations.normal_equations_of)


class OtherMesh(NamedTuple):
    """- `problems`: the same recordings on another mesh.
    - `factor`: from a step to that mesh to one to a mesh without end, see `factor`.
    """

    problems: Problems
    factor: float

    @property
    def is_finer(self) -> bool:
        """Whether its cells are shorter: a coarser mesh says how far, but hardly where to."""
        return self.factor > 0


def factor(ratio: float) -> float:
    """From a step to a mesh whose cells are `ratio` times as long, to one to a mesh without end."""
    return 1 / (1 - ratio**ORDER)


def coarser_of(
    problems: Problems, other: OtherMesh | None
) -> tuple[Problems, tuple[OtherMesh, ...]]:
    """The recordings on the coarser of two meshes, and each on another beside it, for what takes
    many motions: on the finest, in its short steps, those of a lift take many times as long. Pulls
    stay on their own mesh."""
    if other is None:
        return problems, ()
    if other.is_finer:
        return problems, tuple(OtherMesh((there,), other.factor) for there in other.problems)
    coarse, beside = [], []
    for own, there in zip(problems, other.problems, strict=True):
        coarse.append(own if own.is_pulled else there)
        pair = (there, other.factor) if own.is_pulled else (own, factor(0.5))
        beside.append(OtherMesh((pair[0],), pair[1]))
    return tuple(coarse), tuple(beside)


def mesh_bias(
    problems: Problems,
    other: OtherMesh,
    end: Descent,
    prior: Array,
    predicted: Sequence[tuple[Prediction, Sensitivity]],
) -> Float[np.ndarray, " theta"]:
    """How far theta is from where meshes without end would lead, as far as one step says.

    The Gauss-Newton step on the own mesh is subtracted, since a descent seldom ends at the very
    minimum. Where a motion fails, or the step is longer than the range, it is the whole range: the
    mesh tells nothing then. What a bound holds is held in both steps.

    - `prior`: its weight, see `r2s.estimation.gauss_newton.prior_weight`.
    - `predicted`: at the end, with its derivative (`r2s.estimation.compiled.derivatives_at`).
    """
    size = theta_length(problems)
    gradients, matrices = np.zeros((2, size)), np.zeros((2, size, size))
    for which, share in enumerate(recording_weights(problems)):
        index = theta_indices(problems, which)
        here, there, theta = problems[which], other.problems[which], end.theta[index]
        seen, slope = predicted[which]
        laid = _laid_onto(here, there, slope)
        finer = compiled.predicted(motion_alone(there), theta)
        for side, each in enumerate([(here, seen, slope), (there, finer, laid)]):
            found = _equations(*each, end.scale)
            gradients[side, index] += share * np.asarray(found.scores).sum(axis=0)
            matrix = share * np.asarray(found.matrices).sum(axis=0)
            matrices[side][np.ix_(index, index)] += matrix
    off, precision = (np.asarray(part) for part in prior_terms(problems, end.theta))
    least = float(prior) * precision
    limits = only_held(room(problems, end.theta))
    own, others = (
        bounded_step(gradients[side] + least @ off, matrices[side] + least, limits)
        for side in (0, 1)
    )
    bias = other.factor * (others - own)
    return np.clip(np.where(np.isfinite(bias), bias, 1.0), -1, 1)


def alone(
    problems: Problems,
    others: Sequence[OtherMesh],
    ends: Sequence[Descent],
    derive: Derive,
    width: float | None = None,
) -> list[Float[np.ndarray, " theta"]]:
    """The `mesh_bias` of the end of a descent in each recording alone; of none where there is no
    other mesh, or no such end.

    - `others`: of each recording alone. `derive`, `width`: see `r2s.estimation.compiled`.
    """
    found: list[Float[np.ndarray, " theta"]] = []
    if not others or not ends:
        return found
    for problem, other, end in zip(problems, others, ends, strict=True):
        own, prior = (problem,), prior_weight((problem,), end.normal)
        found.append(mesh_bias(own, other, end, prior, derive(own, end.theta, width)))
    return found


def _laid_onto(here: Problem, there: Problem, slope: Sensitivity) -> Sensitivity:
    """A derivative on one mesh at the vertices of another."""
    meshes = here.scenario.scene.mesh, there.scenario.scene.mesh
    own, other = (jnp.pad(mesh.rest, ((0, 0), (0, 1))) for mesh in meshes)
    face, weights = nearest(other, own, meshes[0].faces)
    corners = meshes[0].faces[face]
    laid = jnp.einsum("vk,fvkiu->fviu", weights, slope.x[:, corners])
    return Sensitivity(laid, slope.force)


class Weighed(NamedTuple):
    """Where an estimate lies once its mesh's error counts as an error of the recordings.

    - `theta`: there. `covariance`: of it. `bias`: of its mesh that is left.
    """

    theta: Float[np.ndarray, " theta"]
    covariance: Float[np.ndarray, "theta theta"]
    bias: Float[np.ndarray, " theta"]


def weighed(
    problems: Problems,
    end: Descent,
    prior: Array,
    covariance: Float[np.ndarray, "theta theta"],
    bias: Float[np.ndarray, " theta"],
) -> Weighed:
    """An estimate that trusts its prior more where it errs, from one that took its recordings as
    exact but for their noise.

    A descent weighs recordings and prior by the noise. The standard errors know more: how far the
    mesh leads astray, and how rough the loss is. What is left of the recordings' information with
    these is what `covariance` has beyond the prior, and the prior is added to that anew (the model
    discrepancy of Kennedy and O'Hagan 2001, linear about the end).

    - `prior`: its weight, see `r2s.estimation.gauss_newton.prior_weight`.
    - `covariance`: of the end with all errors. `bias`: of its mesh, as `mesh_bias` gives it.
    """
    off, known = (np.asarray(part, np.float64) for part in prior_terms(problems, end.theta))
    told = np.asarray(end.normal.matrix, np.float64) / float(prior)
    slope = np.asarray(end.normal.gradient, np.float64) / float(prior)
    alone = np.linalg.lstsq(told, -slope, rcond=RCOND)[0]  # to where recordings alone lead
    root = np.linalg.cholesky(known)
    inner = np.linalg.solve(root, np.linalg.inv(covariance))
    sizes, axes = np.linalg.eigh(np.linalg.solve(root, inner.T))
    axes = root @ axes
    left = (axes * np.maximum(sizes - 1, 0)[None]) @ axes.T
    errors = np.linalg.inv(left + known)
    way = bounded_step(known @ off - left @ alone, left + known, room(problems, end.theta))
    theta = np.asarray(end.theta, np.float64) + way
    led = np.linalg.lstsq(told, (told + known) @ bias, rcond=RCOND)[0]
    return Weighed(theta, errors, errors @ left @ led)


class Settled(NamedTuple):
    """An estimate at the end of its descents.

    - `theta`: there. `seen`: what is predicted there. `loss`: [m^2].
    - `covariance`: of it. `bias`: of its mesh, which it holds; None: that was not judged.
    """

    theta: Theta
    seen: list[Prediction]
    loss: float
    covariance: Float[np.ndarray, "theta theta"]
    bias: Float[np.ndarray, " theta"] | None = None


def settled(
    problems: Problems,
    end: Descent,
    prior: Array,
    at: Settled,
    bias: Float[np.ndarray, " theta"],
    moves: bool,
) -> Settled:
    """An estimate at the end of its descents, with what its mesh errs.

    Where something is known of the fabric beforehand, it goes where `weighed` leads, and what is
    left of that way counts as an error. Beside a coarser mesh, which says how far the own one errs,
    but hardly where to, it does not move. Its errors are then those without the prior or those
    where `weighed` leads with the whole way, in each direction the smaller.

    - `prior`, `bias`: as in `weighed`. `at`: the end, without its mesh's error.
    """
    covariance = at.covariance + np.outer(bias, bias)
    if not isinstance(problems[0].space, InformedSpace):
        return at._replace(covariance=covariance, bias=bias)
    to = weighed(problems, end, prior, covariance, bias)
    if moves:
        theta, seen, loss, left = on_the_way(problems, end, to.theta, at.loss)
        return Settled(theta, seen, loss, to.covariance + np.outer(left, left), to.bias)
    way = to.theta - np.asarray(end.theta, np.float64)
    errors = _smaller(covariance, to.covariance + np.outer(way, way))
    most = np.sqrt(np.diag(errors))
    return at._replace(covariance=errors, bias=np.clip(bias, -most, most))


def _smaller(
    one: Float[np.ndarray, "theta theta"], other: Float[np.ndarray, "theta theta"]
) -> Float[np.ndarray, "theta theta"]:
    """The smaller of two covariances in each direction in which both have no correlation."""
    root = np.linalg.cholesky(one)
    sizes, axes = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, other).T))
    axes = root @ axes
    return (axes * np.minimum(sizes, 1)[None]) @ axes.T


def inside(problems: Problems, theta: Float[np.ndarray, " theta"]) -> Theta:
    """Theta with the fabric's place within the unit cube."""
    is_fabric = np.arange(len(theta)) < problems[0].space.dim
    return jnp.asarray(np.where(is_fabric, np.clip(theta, MARGIN, 1 - MARGIN), theta), float)


def on_the_way(
    problems: Problems, end: Descent, place: Float[np.ndarray, " theta"], before: float
) -> tuple[Theta, list[Prediction], float, Float[np.ndarray, " theta"]]:
    """How far to go from the end of a descent to where `weighed` leads, what is predicted there,
    the loss, and the way that is left; `before` is the loss at the end.

    The step is linear. Where parameters trade against each other along a bent valley (how much a
    yarn stiffens, and where) it leaves that, so it is halved until the loss is at most `RISE` times
    what it was with what the Gauss-Newton matrix says that it rises; after `HALVINGS` it is none.
    """
    step = np.asarray(place, np.float64) - np.asarray(end.theta, np.float64)
    slope = np.asarray(end.normal.gradient, np.float64)
    matrix = np.asarray(end.normal.matrix, np.float64)
    for share in (*(0.5**i for i in range(HALVINGS)), 0.0):
        theta = inside(problems, np.asarray(end.theta, np.float64) + share * step)
        seen = predictions_at(problems, theta)
        loss = loss_from(problems, seen)
        told = share * slope @ step + share**2 * step @ matrix @ step / 2
        if loss <= RISE * (before + max(told, 0.0)):
            break
    return theta, seen, loss, (1 - share) * step
