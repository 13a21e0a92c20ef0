"""How far PhysNet's estimates of one recording are from the truth, beside a random search."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from r2s.estimation.physnet import estimator, preprocess
from r2s.estimation.physnet.dataset import Settings, kept_frames
from r2s.estimation.physnet.pull_force import pull_force
from r2s.estimation.physnet.training import Training
from r2s.scenarios import synthetic
from r2s.scenarios.six import Experiment

Place = Float[np.ndarray, " dim"]


def errors(
    trained: Training,
    settings: Settings,
    experiment: Experiment,
    place: Place,
    number: int,
    calls: int,
    folder: Path,
) -> dict[str, Place]:
    """Of an estimate by so many simulations from clouds (of a stretching from its force, too, and
    beside that from clouds alone), and of the nearest of as many at random: by parameter, as a
    share of its range."""
    space, key = settings.space, jax.random.key(number)
    seen = synthetic.record(
        experiment, space(jnp.asarray(place, float)), "unseen", shape=settings.shape, key=key
    )
    frames = kept_frames(experiment.frames_used, settings.num_frames)
    images = preprocess.of_clouds(trained.view, seen, frames)
    scenario, pull = experiment.scenario(settings.shape), pull_force(seen, frames)
    found = {}
    for name, force in {"": pull, " by images alone": None}.items():
        if name and pull is None:
            continue
        sighting = estimator.Sighting.make(scenario, images, frames, space, trained, pull=force)
        path = folder / f"search{name.replace(' ', '_')}_{number}.npz"
        estimate = estimator.estimate(sighting, num_calls=calls, path=path)
        found[f"median error{name}"] = np.abs(np.asarray(space.to_unit(estimate.fabric)) - place)
        drawn = np.asarray(jax.random.uniform(key, (calls, space.dim), float))
        away = estimator.objective(sighting, calls)(drawn)
        found[f"of random search{name}"] = np.abs(drawn[np.nanargmin(away)] - place)
    return found
