"""What an estimator is given: a recording to be explained by a member of a space."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s.estimation import initial_shape
from r2s.fabrics.parameters import ParameterSpace
from r2s.geometry.mesh import Mesh
from r2s.geometry.surface import nearest
from r2s.recordings.recording import Recording, subsample
from r2s.scenarios.scenario import Scenario, from_recording

FORCE_SCALE = 0.02  # [m/N]: a load cell is good to 10 mN where a marker is to 0.2 mm


class NuisancePrior(NamedTuple):
    """How far what was written down of an experiment may be off: standard deviations; 0: exact.

    It is estimated along with the fabric, so that an error of calibration is not taken for a
    property of the fabric.

    - `shift`, `turn`: of the cameras' frame against the grippers', [m], and about the vertical
      through the first gripper, [rad].
    - `time`: how much later than theirs the cameras' clock is, [s].
    - `density`: of the sheet, relative, where it was not weighed.
    - `air`: the force of the air at its speed (its density, its drag), relative.
    """

    shift: float = 0.015
    turn: float = 0.15
    time: float = 0.0
    density: float = 0.0
    air: float = 0.0

    @property
    def scales(self) -> tuple[float, ...]:
        """The deviations in the order of `SHARED` and `OWN`."""
        return (self.density, self.air, *(self.shift,) * 3, self.turn, self.time)


USUAL = NuisancePrior()
WIND = 0.1  # of its force: 5 % of its speed, or as much as is known of a fabric's drag
SHARED: tuple[str, ...] = ("density", "air")  # by all recordings of a fabric
OWN: tuple[str, ...] = ("shift x", "shift y", "shift z", "turn", "time")  # of one recording
UNITS = {"shift x": "m", "shift y": "m", "shift z": "m", "turn": "rad", "time": "s"}


def default_nuisance_prior(scenario: Scenario) -> NuisancePrior:
    """What is in doubt if nothing is said: the cameras' place, and the force of a wind that blows.

    A sheet in wind weighs the air against its density to a part in five thousand. Were both taken
    as exact, an error of 1 % in either could be explained by half the stiffness.
    """
    return USUAL._replace(air=0.0 if scenario.wind is None else WIND)


class Clouds(eqx.Module):
    """Points [m] of the frames that count, and which of them are there."""

    points: Float[Array, "frame point 3"]
    mask: Bool[Array, "frame point"]


class Markers(eqx.Module):
    """Places printed on the sheet: where they were seen [m], and which vertices are around them."""

    positions: Float[Array, "frame marker 3"]
    seen: Bool[Array, "frame marker"]
    vertices: Int[Array, "marker 3"]
    weights: Float[Array, "marker 3"]


class Force(eqx.Module):
    """What pulled at the clamp at the frames that count [N], along `directions`; where measured."""

    values: Float[Array, "frame direction"]
    seen: Bool[Array, " frame"]
    directions: Float[Array, "direction 3"]


class Problem(eqx.Module):
    """A recording to be explained by a member of a space.

    - `scenario`: how the sheet is held and moved.
    - `family`: the fabrics to choose from.
    - `frames`: which frames of the scenario count.
    - `clouds`, `markers`, `force`: what was seen in them; None: it was not.
    - `solver`: what simulates; None: the cloth, in the scenario's steps.
    - `doubt`: how far the experiment may be off what was written down.
    """

    scenario: Scenario
    space: ParameterSpace
    frames: tuple[int, ...] = eqx.field(static=True)
    clouds: Clouds | None = None
    markers: Markers | None = None
    force: Force | None = None
    solver: Any = None
    nuisance_prior: NuisancePrior = eqx.field(static=True, default=USUAL)

    @classmethod
    def make(
        cls,
        recording: Recording,
        space: ParameterSpace,
        *,
        num_points: int = 300,
        voxel: float | None = None,
        shape: tuple[int, int] = (9, 9),
        seed: int = 0,
        nuisance_prior: NuisancePrior | None = None,
        solver: Any = None,
        as_seen: bool = True,
    ) -> "Problem":
        """A problem from a recording, its clouds thinned to `num_points` a frame.

        `voxel` [m] as of `r2s.recordings.recording.subsample`, `shape` the vertices of the
        simulated sheet. Where markers were tracked they count instead of the clouds, and the force
        on the pulled clamp counts where it was measured. `nuisance_prior` is by default
        `default_nuisance_prior`. A sheet that hangs starts in the shape that the first cloud shows,
        see `r2s.estimation.initial_shape`, unless not `as_seen`: then flat. Raises `ValueError`
        when a marker is not seen in the first frame, or lies off the sheet there.
        """
        scenario = from_recording(recording, shape)
        first, last = recording.info.frames_used
        frames = slice(first, last + 1)
        markers = _markers(recording, scenario.scene.mesh, frames)
        clouds = None
        if markers is None:
            thinned = subsample(recording, num_points, voxel, seed)
            clouds = Clouds(thinned.points[frames], thinned.mask[frames])
            if as_seen and scenario.brake is not None and first == 0:
                middle = space(jnp.full(space.dim, 0.5, float))
                scenario = initial_shape.as_seen(scenario, middle, clouds.points[0], clouds.mask[0])
        return cls(
            scenario,
            space,
            tuple(range(first, last + 1)),
            clouds,
            markers,
            _force(recording, frames) if recording.info.scenario == "stretching" else None,
            solver,
            default_nuisance_prior(scenario) if nuisance_prior is None else nuisance_prior,
        )


def window(problem: Problem, first: int, last: int) -> Problem:
    """The problem with only those of its frames count that lie within `first` to `last`.

    Raises `ValueError` when none does.
    """
    kept = [i for i, frame in enumerate(problem.frames) if first <= frame <= last]
    if not kept:
        raise ValueError(
            f"no frame from {first} to {last} counts: the problem has {problem.frames[0]} to "
            f"{problem.frames[-1]}"
        )
    index = jnp.array(kept)
    pick = lambda part, names: (
        None
        if part is None
        else dataclasses.replace(part, **{name: getattr(part, name)[index] for name in names})
    )
    return dataclasses.replace(
        problem,
        frames=tuple(problem.frames[i] for i in kept),
        clouds=pick(problem.clouds, ("points", "mask")),
        markers=pick(problem.markers, ("positions", "seen")),
        force=pick(problem.force, ("values", "seen")),
    )


def beginning(problem: Problem, share: float) -> Problem:
    """The problem with nothing seen after a share of the frames in which something was.

    One frame at least is kept. Of the same shapes, so that what is compiled for the problem serves
    this one.
    """

    def hide(part: Any, name: str) -> Any:
        if part is None:
            return None
        seen = getattr(part, name)
        number = jnp.cumsum(jnp.any(seen.reshape(len(seen), -1), axis=1)).astype(float)
        early = number <= jnp.maximum(jnp.round(share * number[-1]), 1)
        return dataclasses.replace(
            part, **{name: seen & early.reshape(-1, *(1,) * (seen.ndim - 1))}
        )

    return dataclasses.replace(
        problem,
        clouds=hide(problem.clouds, "mask"),
        markers=hide(problem.markers, "seen"),
        force=hide(problem.force, "seen"),
    )


def _markers(recording: Recording, mesh: Mesh, frames: slice) -> Markers | None:
    """The markers, which are taken to lie on the sheet at rest where the first frame shows them."""
    if recording.markers is None or recording.markers_seen is None:
        return None
    sheet, seen = recording.info.sheet, np.asarray(recording.markers_seen)
    if not seen[0].all():
        lost = np.flatnonzero(~seen[0]).tolist()
        raise ValueError(f"{recording.info.name}, frame 0: markers {lost} are not seen at rest")
    offset = np.asarray(recording.markers[0]) - np.asarray(sheet.origin)
    material = offset @ np.array([sheet.warp, sheet.weft]).T
    flat = lambda places: jnp.pad(jnp.asarray(places, float), ((0, 0), (0, 1)))
    face, weights = nearest(flat(material), flat(mesh.rest), mesh.faces)
    away = np.linalg.norm(
        np.einsum("mk,mki->mi", weights, np.asarray(mesh.rest)[np.asarray(mesh.faces)[face]])
        - material,
        axis=1,
    )
    if away.max() > 0.01:
        worst = int(away.argmax())
        raise ValueError(
            f"{recording.info.name}, frame 0: marker {worst} lies {1e3 * away[worst]:.0f} mm off "
            "the sheet: check the sheet's size and place [m] and the markers' plane"
        )
    return Markers(recording.markers[frames], jnp.asarray(seen[frames]), mesh.faces[face], weights)


def _force(recording: Recording, frames: slice) -> Force | None:
    """The force at the frames; a log of numbers is along the warp, along which the clamp pulls."""
    if recording.force is None or recording.force_times is None:
        return None
    log = np.asarray(recording.force, float)
    scalar = log.ndim == 1
    times = np.asarray(recording.times)[frames]
    columns = log[:, None] if scalar else log
    at = lambda column: np.interp(times, np.asarray(recording.force_times), column)
    values = np.stack([at(column) for column in columns.T], axis=1)
    directions = np.array([recording.info.sheet.warp]) if scalar else np.eye(3)
    seen = jnp.ones(len(values), bool)
    return Force(jnp.asarray(values, float), seen, jnp.asarray(directions, float))
