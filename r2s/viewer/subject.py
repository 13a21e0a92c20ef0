"""What a page with sliders shows: a motion, the space of fabrics, and what a recording saw."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from r2s.estimation.problem import Clouds
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace
from r2s.metrics.losses import masked_mean, surface_residuals
from r2s.recordings.recording import Recording, subsample
from r2s.scenarios import Experiment
from r2s.scenarios.scenario import Scenario, from_recording, rollout
from r2s.solvers.simulate import Trajectory

MOST_POINTS = 1500  # of a cloud: more change neither the picture nor the distance


class Subject(eqx.Module):
    """A motion that any member of a space can make.

    - `scenario`: the motion.
    - `space`: the fabrics that the sliders reach.
    - `clouds`: points of a recording, in all its frames; None: there is none.
    - `frames_used`: the first and the last frame that count.
    """

    scenario: Scenario
    space: ParameterSpace
    clouds: Clouds | None = None
    frames_used: tuple[int, int] = eqx.field(static=True, default=(0, 0))


class Moved(NamedTuple):
    """A motion of a subject.

    - `motion`: positions, and whether and why it failed.
    - `error`: mean distance [m] from the recorded points to the sheet in each frame; NaN where
      there are none, or the simulation diverged.
    """

    motion: Trajectory
    error: Float[Array, " frame"]

    @property
    def x(self) -> Float[Array, "frame vertex 3"]:
        """Positions [m]."""
        return self.motion.x

    @property
    def ok(self) -> Bool[Array, " frame"]:
        """Whether the positions of each frame are finite."""
        return self.motion.ok


def of_recording(
    recording: Recording, space: ParameterSpace, shape: tuple[int, int] = (9, 9)
) -> Subject:
    """The motion of a recording, on a mesh of `shape` vertices; raises as `from_recording`."""
    seen = subsample(recording, MOST_POINTS, None, 0)
    clouds = Clouds(seen.points, seen.mask)
    return Subject(from_recording(recording, shape), space, clouds, recording.info.frames_used)


def of_experiment(
    experiment: Experiment, space: ParameterSpace, shape: tuple[int, int] = (9, 9)
) -> Subject:
    """A motion that nobody recorded."""
    return Subject(experiment.scenario(shape), space, None, experiment.frames_used)


def place(subject: Subject, fabric: Fabric) -> Float[Array, " dim"]:
    """Where a fabric lies in the subject's space, at its bounds when beyond them."""
    return jnp.clip(subject.space.to_unit(fabric), 0, 1)


@eqx.filter_jit
def move(subject: Subject, u: Float[Array, " dim"]) -> Moved:
    """The motion of the member at `u`, and how far the recording is from it.

    A cloud's distance is that of `chamfer_real_to_sim`, but to the surface itself.
    """
    motion = rollout(subject.scenario, subject.space(u))
    if subject.clouds is None:
        return Moved(motion, jnp.full(motion.ok.shape, jnp.nan))
    faces = subject.scenario.scene.mesh.faces

    def distance(frame):
        points, mask, x = frame
        return masked_mean(surface_residuals(points, mask, x, faces)[0], mask)

    error = jax.lax.map(distance, (subject.clouds.points, subject.clouds.mask, motion.x))
    return Moved(motion, jnp.where(motion.ok, error, jnp.nan))


def error_used(subject: Subject, moved: Moved) -> Float[Array, ""]:
    """The mean error [m] over the frames that count; NaN when one of them has none."""
    first, last = subject.frames_used
    return jnp.mean(moved.error[first : last + 1])
