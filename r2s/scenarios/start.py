"""A sheet that hangs starts in a shape that is known.

A sheet that hangs from corners drawn together buckles, and can rest in several shapes: in which one
a simulation comes to rest depends on its mesh and its fabric. So the same fabric on another mesh
may begin, and go on, a centimetre off.
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.geometry.mesh import Mesh
from r2s.geometry.surface import nearest
from r2s.scenarios.scenario import Scenario


def starting_as(scenario: Scenario, mesh: Mesh, x: Float[Array, "vertex 3"]) -> Scenario:
    """A scenario whose sheet starts in the shape of the same sheet on another mesh.

    - `mesh`, `x`: that mesh, whose rest shape has the same size, and its vertices, [m].

    Grippers are from the beginning where their path begins; a sheet that hangs comes to rest from
    there. A sheet that lies on the table (`Scenario.brake` is None) is left as it is.
    """
    if scenario.brake is None:
        return scenario
    flat = ((0, 0), (0, 1))
    places, rest = (jnp.pad(each, flat) for each in (scenario.scene.mesh.rest, mesh.rest))
    faces, weights = nearest(places, rest, mesh.faces)
    start = jnp.einsum("vk,vki->vi", weights, jnp.asarray(x, float)[mesh.faces[faces]])
    held = scenario.path[1]
    return dataclasses.replace(
        scenario, start=scenario.scene.place(start, held), path=scenario.path.at[0].set(held)
    )
