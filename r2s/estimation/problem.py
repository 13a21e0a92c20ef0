"""The inverse problem: a recording to be explained by a fabric of a parameter space."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from r2s._util.checks import check_kinds
from r2s.estimation.hanging_start import start_as_seen
from r2s.estimation.method import DataRequirements, frames_that_count
from r2s.materials.parameters import ParameterSpace
from r2s.mesh.mesh import Mesh
from r2s.mesh.surface import nearest
from r2s.recordings.recording import (
    MeasurementUncertainty,
    Recording,
    at_rest,
    check_covered,
    gripper_positions,
    subsample,
)
from r2s.recordings.views import Views, taken_by
from r2s.scenarios.resolution import mpm_cloth
from r2s.scenarios.scenario import Scenario, finely_saved, from_recording

POINTS = 300  # at most, of a cloud
TARGETS = 1200  # at most, of a cloud that the sheet must lie near
SPACING = 0.012  # [m], of the samples of such a sheet
ON_SHEET = 0.01  # [m], within which a marker must lie in the first frame
BETWEEN = 3  # frames after the last observed one, for the interpolation in time
CLOCK = 4.0  # standard deviations, by which a clock may be early
# the mask of each kind of observation
MASKS = {"clouds": "mask", "markers": "seen", "force": "seen", "expected": "mask"}
FORCE_SCALE = 0.02  # [m/N]: a load cell is good to 10 mN where a marker is to 0.2 mm


class NuisancePrior(NamedTuple):
    """Standard deviations of the recorded conditions of an experiment; 0: exact.

    Their errors are estimated along with the fabric, so that they do not bias it.

    - `shift`: of the cameras' frame against the grippers', [m]; of each axis, or one for all.
    - `turn`: of the same, about the vertical through the first gripper, [rad].
    - `time`: delay of the cameras' clock behind the grippers', [s].
    - `density`, `size`: of the sheet (its side length), relative.
    - `air`: of the force of the air at its speed (its density, its drag), relative.
    """

    shift: float | tuple[float, float, float] = 0.015
    turn: float = 0.15
    time: float = 0.0
    density: float = 0.0
    air: float = 0.0
    size: float = 0.0

    @property
    def shifts(self) -> tuple[float, float, float]:
        """The standard deviations of the shift along x, y and z, [m]."""
        return self.shift if isinstance(self.shift, tuple) else (self.shift, self.shift, self.shift)

    @property
    def scales(self) -> tuple[float, ...]:
        """The standard deviations in the order of `SHARED` and `OWN`."""
        return (self.density, self.air, self.size, *self.shifts, self.turn, self.time)


USUAL = NuisancePrior()
WIND = 0.1  # of the wind's force: 5 % of its speed, or the uncertainty of a fabric's drag
SHARED: tuple[str, ...] = ("density", "air", "size")  # nuisances of all recordings of a fabric
OWN: tuple[str, ...] = ("shift x", "shift y", "shift z", "turn", "time")  # of each recording
UNITS = {"shift x": "m", "shift y": "m", "shift z": "m", "turn": "rad", "time": "s"}


def default_nuisance_prior(
    scenario: Scenario, doubt: MeasurementUncertainty | None = None
) -> NuisancePrior:
    """The nuisances of a recording: the cameras' place, and the force of a wind.

    `doubt`: the recording's own standard deviations; None: the usual ones.

    A sheet in wind determines the ratio of air to density to a part in five thousand. Were both
    exact, an error of 1 % in either could be explained by half the stiffness.
    """
    own = USUAL if doubt is None else NuisancePrior(doubt.shift, doubt.turn, doubt.time)
    size, air = (0.0, 0.0) if doubt is None else (doubt.size, doubt.air)
    return own._replace(air=air or (0.0 if scenario.wind is None else WIND), size=size)


class Clouds(eqx.Module):
    """Points [m] of the frames that count; the mask tells points from padding."""

    points: Float[Array, "frame point 3"]
    mask: Bool[Array, "frame point"]


class Markers(eqx.Module):
    """Markers on the sheet: positions [m], in which frames seen, and the vertices around them."""

    positions: Float[Array, "frame marker 3"]
    seen: Bool[Array, "frame marker"]
    vertices: Int[Array, "marker 3"]
    weights: Float[Array, "marker 3"]


class ImageObservation(eqx.Module):
    """Samples of the sheet that must lie near the clouds where cameras see them.

    - `views`: the cameras, and the processing of their points; `taken`: by which of them.
    - `vertices`, `weights`: samples of the sheet, off its borders.
    - `grippers`: in the frames that count, [m].
    - `targets`, `mask`: denser clouds of these frames, [m], and which points are no padding.
    - `apart`: largest distance of a place among the points of a frame from the nearest, [m].
    """

    views: Views = eqx.field(static=True)
    taken: Bool[Array, "frame camera"]
    vertices: Int[Array, "sample 3"]
    weights: Float[Array, "sample 3"]
    grippers: Float[Array, "frame gripper 3"]
    targets: Float[Array, "frame target 3"]
    mask: Bool[Array, "frame target"]
    apart: Float[Array, " frame"]


class Force(eqx.Module):
    """Force on the clamp [N] at the frames that count, along `directions`, where measured."""

    values: Float[Array, "frame direction"]
    seen: Bool[Array, " frame"]
    directions: Float[Array, "direction 3"]


class Problem(eqx.Module):
    """A recording to be explained by a fabric of a parameter space.

    - `scenario`: how the sheet is held and moved.
    - `space`: the fabrics to choose from.
    - `frames`: which frames of the scenario count.
    - `clouds`, `markers`, `force`: the observations in them; None: there are none.
    - `expected`: which parts of the sheet must be observed; None: the cameras are unknown.
    - `wanted`: how many frames of the scenario have to be simulated; None: all. (Those that its
      recorded frames may lie between, see `r2s.scenarios.scenario.Scenario`.)
    - `weight`: of a frame beside those of other recordings of the fabric, [1/m^2] (only ratios
      count): one over the variance of a distance; None: 1, of all recordings.
    - `solver`: None: the cloth.
    - `nuisance_prior`: standard deviations of the recorded conditions.
    """

    scenario: Scenario
    space: ParameterSpace
    frames: tuple[int, ...] = eqx.field(static=True)
    clouds: Clouds | None = None
    markers: Markers | None = None
    force: Force | None = None
    solver: Any = None
    nuisance_prior: NuisancePrior = eqx.field(static=True, default=USUAL)
    expected: ImageObservation | None = None
    wanted: Int[Array, ""] | None = None
    weight: Float[Array, ""] | None = None

    @property
    def is_pulled(self) -> bool:
        """Whether it is a pull whose force was recorded: a taut sheet."""
        return self.force is not None

    @classmethod
    def make(
        cls,
        recording: Recording,
        space: ParameterSpace,
        *,
        num_points: int = POINTS,
        shape: tuple[int, int] = (9, 9),
        seed: int = 0,
        nuisance_prior: NuisancePrior | None = None,
        as_seen: bool = True,
    ) -> "Problem":
        """The problem of a recording: from tracked markers, else clouds, and a pull's force.

        - `num_points`, `seed`: how clouds are thinned (`r2s.recordings.recording.subsample`).
        - `shape`: vertices of the simulated sheet along warp and weft.
        - `nuisance_prior`: by default `default_nuisance_prior`.
        - `as_seen`: a sheet that hangs starts in the shape of its first cloud; else flat.

        Raises `ValueError` when a marker is not seen in the first frame, or lies off the sheet
        there.
        """
        call = "Problem.make(recording, space)"
        check_kinds(call, recording=(recording, Recording), space=(space, ParameterSpace))
        scales = (nuisance_prior or USUAL).scales
        if not all(math.isfinite(scale) and scale >= 0 for scale in scales):
            raise ValueError(f"standard deviations must not be negative, found {nuisance_prior}")
        scenario = from_recording(recording, shape)
        first, last = recording.info.frames_used
        frames = slice(first, last + 1)
        markers = _markers(recording, scenario.scene.mesh, frames)
        clouds, expected = None, None
        if markers is None:
            expected = _expected(recording, scenario, frames, seed)
            thinned = subsample(recording, num_points, None, seed)
            clouds = Clouds(thinned.points[frames], thinned.mask[frames])
            begins = first == 0 and at_rest(recording)[0]
            if as_seen and scenario.brake is not None and begins:
                middle = space(jnp.full(space.dim, 0.5, float))
                scenario = start_as_seen(scenario, middle, clouds.points[0], clouds.mask[0])
        nuisances = nuisance_prior or default_nuisance_prior(scenario, recording.info.doubt)
        if nuisances.time:  # frames of a clock that is late lie between those simulated
            scenario = finely_saved(scenario)
        return cls(
            scenario,
            space,
            tuple(range(first, last + 1)),
            clouds,
            markers,
            force_at(recording, frames) if recording.info.scenario == "stretching" else None,
            nuisance_prior=nuisances,
            expected=expected,
        )


Problems = tuple[Problem, ...]


def problems_on_mpm(
    recordings: Sequence[Recording], space: ParameterSpace, shape: tuple[int, int]
) -> Problems:
    """The problems of recordings, simulated by material points of a mesh of `shape` vertices,
    stable for all of the space.

    The sheet's size is exact, since points are laid out for one size. A sheet that hangs starts
    flat: points do not settle into the shape of its first cloud.
    """
    stiffest = space(jnp.ones(space.dim, float))  # limits the time step
    problems = []
    for recording in recordings:
        problem = Problem.make(recording, space, shape=shape, as_seen=False)
        sheet = mpm_cloth(problem.scenario, stiffest)
        background = dataclasses.replace(sheet.background, forward_mode=False)
        exact_size = problem.nuisance_prior._replace(size=0.0)
        solver = dataclasses.replace(sheet, background=background)
        problems.append(dataclasses.replace(problem, solver=solver, nuisance_prior=exact_size))
    return tuple(problems)


def read_by_problem(recording: Recording) -> DataRequirements:
    """What `Problem.make` reads of a recording."""
    has_markers = recording.markers is not None
    is_pulled = recording.info.scenario == "stretching"
    return DataRequirements(
        frames_that_count(recording),
        points=0 if has_markers else POINTS if recording.info.views is None else TARGETS,
        markers=has_markers,
        force=is_pulled and recording.force is not None,
    )


def check_shared(problems: Sequence[Problem]) -> None:
    """Raise `ValueError` when recordings have different standard deviations, other than 0, of a
    nuisance that they share."""
    for i, name in enumerate(SHARED):
        scales = {problem.nuisance_prior.scales[i] for problem in problems} - {0}
        if len(scales) > 1:
            raise ValueError(
                f"the {name} of a fabric is in doubt by {sorted(scales)} in recordings that are "
                "estimated from together: give one deviation"
            )


def motion_alone(problem: Problem) -> Problem:
    """The problem without its observations, on which no prediction depends but for its end.

    Without a force it is not simulated beyond the last observed frame.
    """
    wanted = None if problem.force is not None else _wanted(problem)
    observed = dict.fromkeys(("clouds", "markers", "expected", "weight"))
    return dataclasses.replace(problem, wanted=wanted, **observed)


def _wanted(problem: Problem) -> Int[Array, ""]:
    """The number of simulated frames up to the last observed one, on the cameras' clock."""
    masks = []
    if problem.clouds is not None:
        masks.append(jnp.any(problem.clouds.mask, axis=1))
    if problem.markers is not None:
        masks.append(jnp.any(problem.markers.seen, axis=1))
    if not masks:
        return jnp.asarray(problem.scenario.num_frames)
    places = problem.scenario.places[jnp.array(problem.frames)]
    last = jnp.max(jnp.where(jnp.any(jnp.stack(masks), axis=0), places, 0))
    last = jnp.ceil(last).astype(int)
    late = CLOCK * problem.nuisance_prior.time / problem.scenario.interval
    return jnp.minimum(last + BETWEEN + math.ceil(late), problem.scenario.num_frames)


def beginning(problem: Problem, share: float) -> Problem:
    """The problem with the observations of the first share of the observed frames, at least one.

    Its arrays have the same shapes, so that the programs compiled for the problem serve this one.
    """

    def first(seen: Bool[Array, " frame"]) -> Bool[Array, " frame"]:
        number = jnp.cumsum(seen).astype(float)
        return number <= jnp.maximum(jnp.round(share * number[-1]), 1)

    return seen_where(problem, first)


def seen_where(
    problem: Problem, chosen: Callable[[Bool[Array, " frame"]], Bool[Array, " frame"]]
) -> Problem:
    """The problem with the observations of some frames alone, in arrays of the same shapes.

    `chosen`: the mask of these, from that of the observed frames of a kind.
    """
    kept = {}
    for name, mask in MASKS.items():
        if (part := getattr(problem, name)) is not None:
            seen = getattr(part, mask)
            frames = chosen(jnp.any(seen.reshape(len(seen), -1), axis=1))
            frames = frames.reshape(-1, *(1,) * (seen.ndim - 1))
            kept[name] = dataclasses.replace(part, **{mask: seen & frames})
    return dataclasses.replace(problem, **kept)


def _expected(
    recording: Recording, scenario: Scenario, frames: slice, seed: int
) -> ImageObservation | None:
    """The `ImageObservation` of a recording whose cameras are known."""
    views, mesh = recording.info.views, scenario.scene.mesh
    if views is None:
        return None
    size = np.max(np.asarray(mesh.rest), axis=0)
    axes = [np.arange(views.border + SPACING / 2, side - views.border, SPACING) for side in size]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    if not len(places):
        raise ValueError(
            f"{recording.info.name}: a sheet of {size} m has no place off a border of "
            f"{views.border:g} m: narrow the border of its views"
        )
    face, weights, _ = _on_sheet(places, mesh)
    dense = subsample(recording, TARGETS, None, seed)
    grippers = jnp.asarray(gripper_positions(recording)[frames], float)
    targets, mask = dense.points[frames], dense.mask[frames]
    clouds = [cloud[kept] for cloud, kept in zip(*map(np.asarray, (targets, mask)), strict=True)]
    apart = jnp.asarray([_apart(cloud) for cloud in clouds], float)
    cameras = np.arange(len(views.cameras))
    by = (taken_by(views, frame) for frame in range(frames.start, frames.stop))
    taken = jnp.asarray([np.isin(cameras, each) for each in by])
    views = dataclasses.replace(views, taken=())
    return ImageObservation(views, taken, mesh.faces[face], weights, grippers, targets, mask, apart)


def _apart(cloud: Float[np.ndarray, "point 3"]) -> float:
    """Twice the mean distance [m] of neighbours: hardly any place on a sheet is farther from the
    nearest point of its cloud."""
    if len(cloud) < 2:
        return 0.0
    return 2 * float(np.mean(KDTree(cloud).query(cloud, 2)[0][:, 1]))


def _markers(recording: Recording, mesh: Mesh, frames: slice) -> Markers | None:
    """The markers at their places on the sheet, or else where the first frame shows them on it."""
    if recording.markers is None or recording.markers_seen is None:
        return None
    sheet, seen = recording.info.sheet, recording.markers_seen
    if recording.marker_places is not None:
        face, weights, _ = _on_sheet(np.asarray(recording.marker_places), mesh)
        return Markers(recording.markers[frames], seen[frames], mesh.faces[face], weights)
    if hidden := np.flatnonzero(~np.asarray(seen[0])).tolist():
        raise ValueError(f"{recording.info.name}, frame 0: markers {hidden} are not seen at rest")
    offset = np.asarray(recording.markers[0]) - np.asarray(sheet.origin)
    face, weights, away = _on_sheet(offset @ np.array([sheet.warp, sheet.weft]).T, mesh)
    if away.max() > ON_SHEET:
        worst = int(away.argmax())
        raise ValueError(
            f"{recording.info.name}, frame 0: marker {worst} lies {1e3 * away[worst]:.0f} mm off "
            "the sheet: check the sheet's size and place [m] and the markers' plane, or leave the "
            "marker out if it is on another cloth"
        )
    return Markers(recording.markers[frames], seen[frames], mesh.faces[face], weights)


def _on_sheet(
    places: Float[np.ndarray, "place 2"], mesh: Mesh
) -> tuple[Int[Array, " place"], Float[Array, "place 3"], Float[np.ndarray, " place"]]:
    """The faces of places on a sheet [m], their weights, and their distances from the sheet [m]."""
    flat, rest = (jnp.pad(jnp.asarray(at, float), ((0, 0), (0, 1))) for at in (places, mesh.rest))
    face, weights = nearest(flat, rest, mesh.faces)
    foot = np.einsum("pk,pki->pi", weights, np.asarray(mesh.rest)[np.asarray(mesh.faces)[face]])
    return face, weights, np.linalg.norm(foot - places, axis=1)


def force_at(recording: Recording, frames: slice | list[int]) -> Force | None:
    """The force at some frames, None where none was measured; a log of numbers is along the warp,
    along which the clamp pulls.

    Raises `ValueError` for a log that does not cover the frames, and for a force along the pull
    that is negative in a stretching.
    """
    if recording.force is None or recording.force_times is None:
        return None
    info, log = recording.info, np.asarray(recording.force, float)
    times, clock = np.asarray(recording.times)[frames], np.asarray(recording.force_times)
    try:
        check_covered(clock, times)
    except ValueError as error:
        raise ValueError(f"{info.name}: {error}") from error
    columns = np.atleast_2d(log.T)
    values = np.stack([np.interp(times, clock, column) for column in columns], axis=1)
    scalar = log.ndim == 1
    if scalar and info.scenario == "stretching" and -values.min() > values.max():
        raise ValueError(
            f"{info.name}: the force on the pulled clamp falls to {values.min():.3g} N: it must be "
            "positive along the pull"
        )
    directions = np.array([info.sheet.warp]) if scalar else np.eye(3)
    seen = jnp.ones(len(values), bool)
    return Force(jnp.asarray(values, float), seen, jnp.asarray(directions, float))
