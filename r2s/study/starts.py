"""From what shape a prediction starts: from that of the recording that it is compared with."""

import dataclasses

import jax.numpy as jnp

from r2s.estimation import initial_shape
from r2s.fabrics import prior
from r2s.geometry.surface import nearest
from r2s.recordings.recording import Recording, subsample
from r2s.scenarios.in_explicit_steps import explicit_cloth
from r2s.scenarios.scenario import Scenario, from_recording

COARSE = (9, 9)  # vertices of the sheet that is laid onto the first cloud
POINTS = 2000  # of that cloud


def as_recorded(scenario: Scenario, recording: Recording, density: float) -> Scenario:
    """A scenario of a recording that starts in the shape which its first cloud shows.

    A sheet that hangs from corners drawn together buckles, and rests in one of several shapes
    (`r2s.estimation.initial_shape`). Which one a simulation falls into depends on its mesh and its
    fabric, so the true fabric on another mesh can begin a centimetre off. From the shape that was
    seen it comes to rest with its own fabric, where that has such a shape. A sheet that lies on the
    table starts flat, as its recording does, and the scenario is left as it is; so is one whose
    first frame does not count.

    `density`: areal, [kg/m^2]; how a sheet hangs where the cloud does not show it is that of
    the middle of the prior.
    """
    if scenario.brake is None or recording.info.frames_used[0] != 0:
        return scenario
    coarse, seen = from_recording(recording, COARSE), subsample(recording, POINTS, None, 0)
    fabric = prior.middle(density)
    solver = explicit_cloth(coarse, fabric)
    laid = initial_shape.as_seen(coarse, fabric, seen.points[0], seen.mask[0], solver)
    mesh, flat = coarse.scene.mesh, ((0, 0), (0, 1))
    places, rest = (jnp.pad(each, flat) for each in (scenario.scene.mesh.rest, mesh.rest))
    faces, weights = nearest(places, rest, mesh.faces)
    start = jnp.einsum("vk,vki->vi", weights, laid.start[mesh.faces[faces]])
    held = scenario.path[1]
    return dataclasses.replace(
        scenario,
        start=scenario.scene.place(start, held),
        path=scenario.path.at[0].set(held),
    )
