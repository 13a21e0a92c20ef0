"""The estimate at the end of a search: its standard errors, and the checks of its recordings.

`sensitivity` and `evaluate_design` give the standard errors of a motion before it is recorded.
"""

import dataclasses
import inspect
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s import scenarios
from r2s.estimation import consistency, standard_errors
from r2s.estimation.descent import (
    DEFAULT,
    Diverged,
    Iteration,
    Run,
    Search,
    each_alone,
    has_arrived,
    is_stuck,
    multi_start,
    stacked,
)
from r2s.estimation.estimate import Agreement, Estimate
from r2s.estimation.gauss_newton import (
    MARGIN,
    Descent,
    is_finite,
    loss_from,
    normal_from,
    prior_weight,
    recording_weights,
)
from r2s.estimation.method import Budget, Progress, tell
from r2s.estimation.prediction import (
    Predicted,
    Prediction,
    Theta,
    explain,
    fabric_at,
    nuisances,
    predictions_at,
    remembering,
    theta_indices,
    theta_length,
)
from r2s.estimation.problem import Problem, Problems
from r2s.estimation.standard_errors import OtherMesh, covariance_at, mesh_error
from r2s.materials import presets
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import OrthotropicSpace
from r2s.scenarios import synthetic

NOISE = 3e-3  # [m], of a sensitivity: beyond which a distance is an outlier
NO_DERIVATIVE = "the derivative is not finite at the end of the search"
STUCK = "no step lowers the loss as its derivative says: the loss is rough there"


def descend(
    problems: Problem | Problems,
    budget: Budget = DEFAULT,
    *,
    approach: str = "diffcloud",
    start: Float[Array, " dim"] | None = None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """The fabric that explains one recording, or several of one fabric.

    - `approach`: how the estimate names its method.
    - `start`: in the unit cube, among the coarse places; None: the mean of the space's prior.
    - `checkpoint`: a file of the state after every iteration, from which the same run resumes.
    - `progress`: called with the iteration and the best loss [m^2].
    - `key`: of the other coarse places.

    The estimate has converged when the best descent arrived in the last stage
    (`r2s.estimation.descent.has_arrived`). Raises `RuntimeError` when all simulations diverge,
    `ValueError` for no starts, for an odd number of places around the end, and for shares that do
    not rise between 0 and 1.
    """
    problems = (problems,) if isinstance(problems, Problem) else problems
    run = Run(budget, key, remembering(), checkpoint, progress)
    return with_uncertainty(multi_start(problems, run, start=start), run, approach)


def with_uncertainty(
    search: Search, run: Run, approach: str = "diffcloud", other_mesh: OtherMesh | None = None
) -> Estimate:
    """The estimate at the end of a search, with its standard errors and checks.

    - `other_mesh`: by which its discretization error is estimated, a part of the standard errors
      (`standard_errors.with_mesh_error`). If it is coarser, places around the end, each recording
      alone and a density are tried on it.
    """
    began, problems, width = time.perf_counter(), search.problems, run.budget.secant_width
    best, prior = search.best, prior_weight(problems, search.best.normal)
    predicted = run.derive(problems, best.theta, width)
    predictions = [prediction for prediction, _ in predicted]
    coarse, beside = standard_errors.coarser_of(problems, other_mesh)
    moved = () if other_mesh is None else predictions_at(other_mesh.problems, best.theta)
    key = jax.random.fold_in(run.key, 1)
    covariance = covariance_at(problems, run.budget, best, key, tried_on=coarse, derive=run.derive)
    if search.others:  # that fit nearly as well
        off = np.asarray(jnp.stack(search.others) - best.theta[None], np.float64)
        covariance = covariance + off.T @ off / len(off)
    of_law, bias = standard_errors.model_error(problems, best, prior, predicted), None
    covariance = covariance + np.outer(of_law, of_law)
    if other_mesh is not None:
        error = mesh_error(problems, other_mesh, best, predicted, moved)
        theta, covariance, bias = standard_errors.with_mesh_error(
            problems, other_mesh, best, prior, covariance, error
        )
        if theta is not best.theta:
            best = dataclasses.replace(best, theta=theta)
            predictions = predictions_at(problems, theta)
    seconds = search.seconds + time.perf_counter() - began
    if not is_finite(search.best.normal):
        unsure = NO_DERIVATIVE
    else:
        unsure = search.unsure or (STUCK if is_stuck(search) else "")
    loss = loss_from(problems, predictions)
    estimate = _collected(problems, best, search.rows, covariance, approach, loss, bias)
    agreed = _agreed_by_slopes(problems, search.best, predicted, other_mesh, moved)
    if agreed is not None and not consistency.is_sure(agreed):
        agreed = _agreed_by_descents(coarse, beside, run, best.theta)
    misfits = consistency.misfits(problems, best.theta, predictions)
    if consistency.asks_for_density(problems, agreed, misfits):
        agreed = consistency.with_density(agreed, coarse, run, best.theta)
    return dataclasses.replace(
        estimate,
        seconds=seconds,
        converged=has_arrived(search) and not unsure,
        agreement=agreed,
        shares=tuple(float(share) for share in recording_weights(problems))
        if len(problems) > 1
        else (),
        misfits=misfits,
        fits=consistency.fits(problems, predictions, float(best.scale)),
        reached=search.reached,
        unsure=unsure,
    )


def _agreed_by_slopes(
    problems: Problems,
    end: Descent,
    predicted: Predicted,
    other_mesh: OtherMesh | None,
    moved: Sequence[Prediction],
) -> Agreement | None:
    """Whether several recordings agree, by the derivative of each at the end of all.

    - `predicted`, `moved`: there, on this mesh and another.
    """
    if len(problems) < 2:
        return None
    ends, biases = [], []
    for which, (problem, pair) in enumerate(zip(problems, predicted, strict=True)):
        own = end.theta[theta_indices(problems, which)]
        ends.append(consistency.by_slopes(problem, own, [pair], end.scale))
        if other_mesh is not None:
            other = OtherMesh((other_mesh.problems[which],), other_mesh.factor)
            here = dataclasses.replace(end, theta=own)
            biases.append(mesh_error((problem,), other, here, [pair], moved[which : which + 1])[0])
    return consistency.agreement(problems, ends, biases)


def _agreed_by_descents(
    problems: Problems, others: Sequence[OtherMesh], run: Run, theta: Theta
) -> Agreement | None:
    """Whether several recordings agree, by a descent in each alone from a theta of all.

    - `others`: each recording on another mesh.
    """
    try:
        ends = each_alone(problems, run, theta, "checked")
    except Diverged:  # on the coarser mesh, of a fabric of the finer one
        tell(run.progress, "a recording alone diverged: not compared")
        return None
    width = run.budget.secant_width
    biases = [
        mesh_error((problem,), other, end, run.derive((problem,), end.theta, width))[0]
        for problem, other, end in zip(problems, others, ends, strict=False)
    ]
    return consistency.agreement(problems, ends, biases)


def _collected(
    problems: Problems,
    end: Descent,
    rows: list[Iteration],
    covariance: Float[np.ndarray, "theta theta"],
    approach: str,
    loss: float,
    bias: Float[np.ndarray, " theta"] | None = None,
) -> Estimate:
    """The estimate at an end of some iterations, from its covariance, which includes the `bias` of
    its mesh."""
    space = problems[0].space
    of_fabric = covariance[: space.dim, : space.dim]
    deviation = np.sqrt(np.diag(of_fabric))
    descents = stacked(rows)
    values_of = jax.vmap(jax.vmap(space.values))
    widths = np.array([bound.width for bound in space.ranges])
    return Estimate(
        approach=approach,
        fabric=fabric_at(problems[0], end.theta[theta_indices(problems, 0)]),
        ranges=space.ranges,
        values=np.asarray(space.values(end.theta[: space.dim])),
        standard_errors=deviation * widths,
        mesh_bias=None if bias is None else np.abs(bias[: space.dim]) * widths,
        correlation=of_fabric / np.outer(deviation, deviation),
        nuisances=nuisances(problems, np.asarray(end.theta), np.sqrt(np.diag(covariance))),
        loss=loss,
        losses=np.asarray(descents.normal.loss),
        history=np.asarray(values_of(jnp.asarray(descents.theta[..., : space.dim]))),
        seconds=0.0,
        converged=None,
    )


def sensitivity(problems: Problem | Problems, fabric: Fabric) -> Estimate:
    """Standard errors that recordings would give, were a fabric the true one.

    Nothing is fitted: it takes nine simulations with their derivatives. Make the recordings with
    `r2s.scenarios.synthetic.record` from the motion in question and the available cameras. Raises
    `RuntimeError` when the simulation diverges.
    """
    problems = (problems,) if isinstance(problems, Problem) else problems
    space = problems[0].space
    place = jnp.clip(space.to_unit(fabric), MARGIN, 1 - MARGIN)
    theta = jnp.concatenate([place, jnp.zeros(theta_length(problems) - space.dim, float)])
    scale = jnp.asarray(NOISE, float)
    derive = remembering()
    predicted = derive(problems, theta, None)
    normal = normal_from(problems, theta, predicted, scale)
    if not np.isfinite(float(normal.loss)):
        why = explain(problems[0], theta[theta_indices(problems, 0)])
        raise RuntimeError(f"the simulation of the motion {why or 'has a loss that is not finite'}")
    zero = jnp.zeros((), float)
    end = Descent(theta, normal, zero, zero, scale, jnp.zeros((), int))
    covariance = covariance_at(
        problems, DEFAULT, end, jax.random.key(0), is_truth=True, derive=derive
    )
    loss = loss_from(problems, [prediction for prediction, _ in predicted])
    return _collected(problems, end, [[end]], covariance, "sensitivity", loss)


def evaluate_design(
    scenario: str, fabric: str, numbers: dict[str, float], noise: float = 1e-3, seed: int = 0
) -> Estimate:
    """The `sensitivity` of a planned motion.

    - `scenario`, `numbers`: the motion, one of `r2s.scenarios.SCENARIOS` and its arguments.
    - `fabric`: a preset, which counts as the true fabric.
    - `noise`: of the clouds, [m]; `seed`: of the noise.

    Raises `ValueError` for a scenario, preset or number that does not exist, and for numbers out of
    range.
    """
    if scenario not in scenarios.SCENARIOS:
        raise ValueError(f"a scenario is one of {', '.join(scenarios.SCENARIOS)}, got {scenario!r}")
    if fabric not in presets.FIVE:
        raise ValueError(f"a preset is one of {', '.join(presets.FIVE)}, got {fabric!r}")
    if not noise >= 0:
        raise ValueError(f"noise must not be negative [m], got {noise:g}")
    try:
        experiment = scenarios.SCENARIOS[scenario](**numbers)
    except TypeError as error:
        names = inspect.signature(getattr(scenarios, scenario)).parameters
        raise ValueError(f"{scenario}: {error}; it takes {', '.join(names)}") from None
    truth = presets.FIVE[fabric]()
    seen = synthetic.sensing(experiment)._replace(noise=noise)
    key = jax.random.key(seed)
    recording = synthetic.record(experiment, truth, fabric, seen=seen, key=key)
    space = OrthotropicSpace.make(float(truth.density))
    return sensitivity(Problem.make(recording, space), truth)
