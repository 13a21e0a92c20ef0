"""Plates: the curvature of faces is exact, and its energy that of Kirchhoff's plate."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2s.materials.fabric import Fabric
from r2s.materials.plate import OrthotropicPlate, PlateBending
from r2s.mesh.mesh import ELEMENTS, Mesh, borders, rectangle
from r2s.scenarios.scenario import rollout
from r2s.scenarios.standard import lifting

SLIGHT = 1e-4  # so that angles are slopes
numbers = st.floats(-1.0, 1.0)


def irregular() -> Mesh:
    """Triangles of a grid whose inner vertices were moved."""
    grid, shifts = rectangle((0.2, 0.3), (5, 6), "rising"), np.zeros((5, 6, 2))
    shifts[1:-1, 1:-1] = np.random.default_rng(0).uniform(-0.015, 0.015, (3, 4, 2))
    return Mesh.make(np.asarray(grid.rest) + shifts.reshape(-1, 2), np.asarray(grid.faces))


MESHES = {name: rectangle((0.2, 0.3), (5, 6), name) for name in ELEMENTS}
MESHES["irregular"] = irregular()


def bent(mesh: Mesh, k11, k22, k12):
    """A sheet with a constant curvature [1/m], if slight."""
    x, y = mesh.rest.T
    return jnp.stack([x, y, (k11 * x**2 + k22 * y**2) / 2 + k12 * x * y], axis=1)


def curvatures(mesh: Mesh, x):
    return np.asarray(mesh.plate.curvatures(mesh.plate.bends.curvatures_at(x)))


def inner_elements(mesh: Mesh):
    """The faces with a hinge on each edge, the vertices with a cell of their own area."""
    if len(mesh.plate.areas) == len(mesh.rest):
        areas, twists = np.asarray(mesh.plate.areas), np.asarray(mesh.plate.to_curvature[:, 2, 2])
        return (areas > 0.9 * areas.max()) & (twists > 0)
    return ~np.any(borders(mesh), axis=1)


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("name", MESHES)
@given(k11=numbers, k22=numbers, k12=numbers)
def test_a_constant_curvature_is_seen_exactly(name, k11, k22, k12):
    mesh, inner = MESHES[name], inner_elements(MESHES[name])
    x = bent(mesh, *(SLIGHT * jnp.asarray(k, float) for k in (k11, k22, k12)))
    expected = -SLIGHT * np.array([k11, k22, 2 * k12])  # downwards is positive
    assert inner.sum() > 10
    assert np.abs(curvatures(mesh, x)[inner] - expected).max() < 1e-9


def test_a_face_at_the_border_takes_the_least_curvature_that_its_hinges_allow():
    mesh = MESHES["falling"]
    exact = np.linalg.norm(SLIGHT * np.array([0.4, -0.7, 0.2, 0.2]))
    k11, k22, twice = curvatures(mesh, bent(mesh, *(SLIGHT * jnp.array([0.4, -0.7, 0.2])))).T
    norm, border = np.sqrt(k11**2 + k22**2 + twice**2 / 2), ~inner_elements(mesh)
    assert border.sum() > 10 and np.all(norm[border] <= exact * (1 + 1e-6))


@pytest.mark.parametrize("name", ["quadrilaterals", "falling", "rising", "irregular"])
@pytest.mark.parametrize("angle", [0.0, 22.5, 45.0, 90.0, 135.0])
def test_a_plate_bends_alike_in_all_directions(name, angle):
    mesh, (c, s) = MESHES[name], (np.cos(np.radians(angle)), np.sin(np.radians(angle)))
    curvature = curvatures(mesh, bent(mesh, *(SLIGHT * jnp.array([c * c, s * s, c * s]))))
    law = PlateBending.make(2e-5, 0.3)
    densities = jax.vmap(law.energy_density)(jnp.asarray(curvature))[inner_elements(mesh)]
    assert densities == pytest.approx(2e-5 * SLIGHT**2 / 2, rel=1e-4)


@pytest.mark.parametrize(
    ("angle", "stiffness"), [(0, 3e-5), (45, 2.5e-5), (90, 1e-5), (135, 2.5e-5)]
)
def test_an_orthotropic_plate_has_the_stiffness_of_the_direction(angle, stiffness):
    law = OrthotropicPlate(*(jnp.asarray(b, float) for b in (3e-5, 2.5e-5, 1e-5)))
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    density = law.energy_density(jnp.asarray([c * c, s * s, 2 * c * s]))
    assert density == pytest.approx(stiffness / 2, rel=1e-12)


def test_an_isotropic_plate_twists_as_it_bends():
    """Curvatures of 1 and -1 along two axes are a twist along those at 45 degrees."""
    law = PlateBending.make(2.0, 0.3)
    bending, twist = jnp.array([1.0, -1.0, 0.0]), jnp.array([0.0, 0.0, 2.0])
    assert law.energy_density(twist) == pytest.approx(float(law.energy_density(bending)))


def test_a_solid_plate_has_the_textbook_stiffness():
    law = PlateBending.isotropic(2e9, 0.3, 1e-3)
    assert law.stiffness == pytest.approx(2e9 * 1e-9 / (12 * (1 - 0.09)))
    # free to curve across, it is a beam of E h^3 / 12
    beam = law.energy_density(jnp.asarray([1.0, -0.3, 0.0]))
    assert beam == pytest.approx(2e9 * 1e-9 / 24)


@pytest.mark.slow(group="cloth")
def test_quadrilaterals_favour_neither_warp_nor_weft_nor_a_diagonal():
    fabric = Fabric.make(0.2, (60.0, 20.0, 60.0, 20.0), 2e-5)
    lift = lifting(num_frames=40).scenario((9, 9))
    x = np.asarray(eqx.filter_jit(rollout)(lift, fabric).x).reshape(-1, 9, 9, 3)
    mirrored = x.transpose(0, 2, 1, 3)[..., [1, 0, 2]]  # about the diagonal through the grip
    assert np.ptp(x[-1, ..., 2]) > 0.2
    np.testing.assert_allclose(x, mirrored, atol=1e-9)
