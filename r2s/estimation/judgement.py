"""The estimate at the end of a search: its standard errors, and what contradicts it.

`sensitivity` and `evaluate_design` give the standard errors of a motion before it is recorded.
"""

import dataclasses
import inspect
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s import scenarios
from r2s.estimation import mesh_bias
from r2s.estimation.consistency import (
    agreement,
    asks_for_density,
    fits,
    misfits,
    with_density,
    with_free_density,
)
from r2s.estimation.descent import DEFAULT, Iteration, Search, has_arrived, multi_start, stacked
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
from r2s.estimation.mesh_bias import OtherMesh, coarser_of
from r2s.estimation.method import Budget, Progress, tell
from r2s.estimation.prediction import (
    Derive,
    Theta,
    derivatives_at,
    explain,
    fabric_at,
    nuisances,
    predictions_at,
    theta_indices,
    theta_length,
)
from r2s.estimation.problem import Problem, Problems
from r2s.estimation.standard_errors import covariance_at, model_error
from r2s.materials import presets
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import OrthotropicSpace
from r2s.scenarios import synthetic

NOISE = 3e-3  # [m], of a sensitivity: beyond which a distance is an outlier
NO_DERIVATIVE = "the derivative is not finite at the end of the search"


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
    found = multi_start(
        problems, budget, start=start, checkpoint=checkpoint, progress=progress, key=key
    )
    return with_uncertainty(
        found, budget, approach=approach, checkpoint=checkpoint, progress=progress, key=key
    )


def with_uncertainty(
    found: Search,
    budget: Budget,
    *,
    approach: str = "diffcloud",
    other_mesh: OtherMesh | None = None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """The estimate at the end of a search, with its standard errors and checks.

    - `other_mesh`: by which its discretization error is estimated, a part of the standard errors
      (`mesh_bias.correct`). If it is coarser, places around the end, each recording alone and a
      density are tried on it.
    - `checkpoint`: of the search; that of a descent for the density is beside it.
    """
    began, problems = time.perf_counter(), found.problems
    best, prior = found.best, prior_weight(problems, found.best.normal)
    predicted = found.derive(problems, best.theta, budget.secant_width)
    coarse, beside = coarser_of(problems, other_mesh)
    around = jax.random.fold_in(key, 1)
    covariance = covariance_at(problems, budget, best, around, tried_on=coarse, derive=found.derive)
    if found.others:  # that fit nearly as well
        off = np.asarray(jnp.stack(found.others) - best.theta[None], np.float64)
        covariance = covariance + off.T @ off / len(off)
    of_law, seen = model_error(problems, best, prior, predicted), [each for each, _ in predicted]
    covariance, bias = covariance + np.outer(of_law, of_law), None
    if other_mesh is not None:
        by = mesh_bias.mesh_error(problems, other_mesh, best, predicted)
        theta, covariance, bias = mesh_bias.correct(
            problems, other_mesh, best, prior, covariance, by
        )
        if theta is not best.theta:
            best, seen = dataclasses.replace(best, theta=theta), predictions_at(problems, theta)
    seconds = found.seconds + time.perf_counter() - began
    unsure = found.unsure if is_finite(found.best.normal) else NO_DERIVATIVE
    converged = has_arrived(found, budget) and not unsure
    loss = loss_from(problems, seen)
    estimate = collect(
        problems, best, found.rows, covariance, approach, seconds, converged, loss, bias
    )
    try:
        alone = each_alone(coarse, budget, best.theta, key, found.derive, progress)
    except RuntimeError as error:  # on the coarser mesh, of a fabric of the finer one
        if isinstance(error, jax.errors.JaxRuntimeError):  # out of memory, say
            raise
        tell(progress, "a recording alone diverged: not compared")
        alone = []
    shares = tuple(float(each) for each in recording_weights(problems)) if alone else ()
    biases = mesh_bias.alone(coarse, beside, alone, found.derive, budget.secant_width)
    agreed = agreement(coarse, alone, biases) if alone else None
    missed = misfits(problems, best.theta, seen)
    if asks_for_density(problems, agreed, missed):
        path = checkpoint and checkpoint.with_suffix(".density.npz")
        agreed = _with_density(agreed, coarse, budget, best.theta, path, progress, key)
    return dataclasses.replace(
        estimate,
        agreement=agreed,
        shares=shares,
        misfits=missed,
        fits=fits(problems, seen, float(best.scale)),
        reached=found.reached,
        unsure=unsure,
    )


def each_alone(
    problems: Problems,
    budget: Budget,
    theta: Theta,
    key: PRNGKeyArray,
    derive: Derive | None = None,
    progress: Progress | None = None,
) -> list[Descent]:
    """The ends of descents in each of several recordings alone, from a theta of all of them."""
    if len(problems) < 2:
        return []
    alone = _from_near(budget)._replace(is_intermediate=True)
    return [
        multi_start(
            (problem,),
            alone,
            start=theta[theta_indices(problems, which)],
            progress=progress,
            derive=derive,
            words=f"recording {which + 1} of {len(problems)} alone",
            key=key,
        ).best
        for which, problem in enumerate(problems)
    ]


def _from_near(budget: Budget) -> Budget:
    """A budget for one descent of all frames, from a start near its end."""
    one = budget._replace(num_samples=0, num_starts=1, frame_fractions=())
    return one._replace(warm_start=True, is_intermediate=False)


def _with_density(
    agreed: Agreement | None,
    problems: Problems,
    budget: Budget,
    theta: Theta,
    checkpoint: Path | None,
    progress: Progress | None,
    key: PRNGKeyArray,
) -> Agreement | None:
    """The agreement with the density that all recordings lead to; as it is where they diverge."""
    loose, start = with_free_density(problems, theta)
    try:
        end = multi_start(
            loose,
            _from_near(budget),
            start=start,
            checkpoint=checkpoint,
            progress=progress,
            words="which density would fit",
            key=key,
        ).best
    except RuntimeError:
        return agreed
    return with_density(agreed, loose, end)


def collect(
    problems: Problems,
    best: Descent,
    rows: list[Iteration],
    covariance: Float[np.ndarray, "theta theta"],
    approach: str,
    seconds: float,
    converged: bool | None,
    loss: float,
    bias: Float[np.ndarray, " theta"] | None = None,
) -> Estimate:
    """The estimate at the best end of some iterations, from its covariance.

    `bias` is that of its mesh, which the covariance holds already.
    """
    space = problems[0].space
    of_fabric = covariance[: space.dim, : space.dim]
    deviation = np.sqrt(np.diag(of_fabric))
    descents = stacked(rows)
    values_of = jax.vmap(jax.vmap(space.values))
    widths = np.array([bound.width for bound in space.ranges])
    return Estimate(
        approach=approach,
        fabric=fabric_at(problems[0], best.theta[theta_indices(problems, 0)]),
        ranges=space.ranges,
        values=np.asarray(space.values(best.theta[: space.dim])),
        standard_errors=deviation * widths,
        mesh_bias=None if bias is None else np.abs(bias[: space.dim]) * widths,
        correlation=of_fabric / np.outer(deviation, deviation),
        nuisances=nuisances(problems, np.asarray(best.theta), np.sqrt(np.diag(covariance))),
        loss=loss,
        losses=np.asarray(descents.normal.loss),
        history=np.asarray(values_of(jnp.asarray(descents.theta[..., : space.dim]))),
        seconds=seconds,
        converged=converged,
    )


def sensitivity(problems: Problem | Problems, fabric: Fabric) -> Estimate:
    """Standard errors that recordings would give, were a fabric the true one.

    Nothing is fitted: it takes nine simulations with their derivatives. Make the recordings with
    `r2s.scenarios.synthetic.record` from the motion in question and the cameras that there are.
    Raises `RuntimeError` when the simulation diverges.
    """
    problems = (problems,) if isinstance(problems, Problem) else problems
    space = problems[0].space
    place = jnp.clip(space.to_unit(fabric), MARGIN, 1 - MARGIN)
    theta = jnp.concatenate([place, jnp.zeros(theta_length(problems) - space.dim, float)])
    scale = jnp.asarray(NOISE, float)
    predicted = derivatives_at(problems, theta)
    normal = normal_from(problems, theta, predicted, scale)
    if not np.isfinite(float(normal.loss)):
        why = explain(problems[0], theta[theta_indices(problems, 0)])
        raise RuntimeError(f"the simulation of the motion {why or 'has a loss that is not finite'}")
    zero = jnp.zeros((), float)
    end = Descent(theta, normal, zero, zero, scale, jnp.zeros((), int))
    covariance = covariance_at(problems, DEFAULT, end, jax.random.key(0), is_truth=True)
    loss = loss_from(problems, [seen for seen, _ in predicted])
    return collect(problems, end, [[end]], covariance, "sensitivity", 0.0, None, loss)


def evaluate_design(
    scenario: str, fabric: str, numbers: dict[str, float], noise: float = 1e-3, seed: int = 0
) -> Estimate:
    """The `sensitivity` of a motion that nobody has made yet.

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
        known = inspect.signature(getattr(scenarios, scenario)).parameters
        raise ValueError(f"{scenario}: {error}; it takes {', '.join(known)}") from None
    chosen = presets.FIVE[fabric]()
    seen = synthetic.sensing(experiment)._replace(noise=noise)
    key = jax.random.key(seed)
    recording = synthetic.record(experiment, chosen, fabric, seen=seen, key=key)
    space = OrthotropicSpace.make(float(chosen.density))
    return sensitivity(Problem.make(recording, space), chosen)
