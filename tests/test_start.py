"""A sheet starts in a shape that is known from another mesh."""

import jax.numpy as jnp
import numpy as np

from r2s import scenarios
from r2s.geometry.mesh import corner, rectangle
from r2s.scenarios.start import starting_as


def curved(rest):
    """A hanging sheet's places [m], bilinear in its rest shape."""
    across, down = rest[:, 0], rest[:, 1]
    return jnp.stack([0.9 * across, 0.2 * across * down, 0.7 - down], axis=1)


def test_a_hanging_sheet_starts_where_it_was_on_another_mesh():
    experiment = scenarios.shaking()
    mesh = rectangle(experiment.sheet.size, (5, 5))
    for shape in ((5, 5), (9, 9), (4, 7)):
        scenario = experiment.scenario(shape)
        found = starting_as(scenario, mesh, curved(mesh.rest))
        held = [corner(shape, name) for name in experiment.sheet.held]
        free = np.setdiff1d(np.arange(len(found.start)), held)
        flat_faces = 0.2 * (0.45 / 4) ** 2 / 4  # of a bilinear cell, at its middle
        away = found.start - curved(scenario.scene.mesh.rest)
        assert np.abs(np.asarray(away)[free]).max() < flat_faces + 1e-6
        np.testing.assert_allclose(found.start[jnp.asarray(held)], scenario.path[1], atol=1e-6)
        np.testing.assert_allclose(found.path[0], found.path[1], atol=1e-6)


def test_a_sheet_on_the_table_starts_as_ever():
    scenario = scenarios.lifting().scenario((5, 5))
    mesh = rectangle(scenarios.lifting().sheet.size, (9, 9))
    assert starting_as(scenario, mesh, jnp.ones((81, 3))) is scenario
