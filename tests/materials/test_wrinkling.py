"""Cells that wrinkle: their energy is the least over wrinkles that the mesh does not show."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import r2s
from r2s import rectangle
from r2s.materials import presets, wrinkling
from r2s.materials.wrinkling import LEAST, membrane_on_samples, released
from r2s.scenarios.energy import stored_energy
from r2s.solvers.explicit.sheet import bending_force, membrane_force, membrane_stress

CRITICAL = 0.5  # [N/m]
value = jax.jit(released)
slope = jax.jit(jax.grad(released, argnums=2))
curvature = jax.jit(jax.hessian(released, argnums=2))


def stiffness(name: str) -> np.ndarray:
    law = presets.FIVE[name]().membrane
    return np.array(jax.hessian(law.energy_density)(jnp.zeros(3, float)), float)


def strains(count: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, 3)) * 0.1


def by_search(matrix: np.ndarray, strain: np.ndarray) -> float:
    """What wrinkles release, by descent over the Cholesky factor of their shortening."""

    def cost(root):
        a, b, c = root
        hidden = jnp.stack([a**2, b**2 + c**2, 2 * a * b])
        changed = strain + hidden
        kept = strain @ matrix @ strain / 2
        return changed @ matrix @ changed / 2 - kept + CRITICAL * (hidden[0] + hidden[1])

    step = jax.jit(jax.value_and_grad(cost))
    starts = np.array([[0.3, 0, 0.3], [0.3, 0.2, 0.1], [0.1, 0.3, 0.1], [0.3, -0.2, 0.1]])
    ends = [minimize(lambda x: tuple(map(np.array, step(x))), s, jac=True) for s in starts]
    return -min(min(end.fun for end in ends), 0.0)


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("name", presets.FIVE)
def test_wrinkles_release_what_a_search_finds(name):
    """And what their gradual beginning adds: at most the parabola of half the critical stress."""
    matrix = stiffness(name)
    added = CRITICAL**2 / 12 / max(matrix[0, 0], matrix[1, 1])
    for strain in strains(6):
        more = float(value(matrix, jnp.full(2, CRITICAL), strain)) - by_search(matrix, strain)
        tolerance = 20 * LEAST * by_search(matrix, strain) + 1e-9
        assert -tolerance <= more <= added + tolerance


@pytest.mark.parametrize("name", presets.FIVE)
def test_derivatives_agree_with_differences_and_the_rest_is_convex(name):
    matrix, h, at = stiffness(name), 1e-6, jnp.full(2, CRITICAL)

    def differences(f, strain):
        steps = h * np.eye(3)
        ahead, behind = ([f(matrix, at, strain + s * e) for e in steps] for s in (1, -1))
        return (np.array(ahead) - np.array(behind)) / (2 * h)

    for strain in strains(20):
        np.testing.assert_allclose(slope(matrix, at, strain), differences(value, strain), atol=1e-6)
        second = np.array(curvature(matrix, at, strain))
        tolerance = 1e-6 * matrix.max()
        np.testing.assert_allclose(second, differences(slope, strain), atol=tolerance)
        assert np.linalg.eigvalsh(matrix - second).min() > 0


@pytest.mark.slow(group="cloth")
def test_forces_on_material_points_are_those_of_the_stored_energy():
    mesh, fabric = rectangle((0.2, 0.2), (5, 5), "wrinkling"), presets.grey_interlock()
    noise = np.random.default_rng(1).normal(size=(25, 3)) * 2e-3
    x = jnp.asarray(np.pad(0.95 * np.array(mesh.rest), ((0, 0), (0, 1))) + noise)

    def stored(mesh):
        return lambda x: stored_energy(mesh, fabric, x)

    def forces(x):
        membrane = membrane_force(mesh, x, membrane_stress(mesh, fabric, x))
        return membrane + bending_force(mesh, fabric, x, 0 * x)

    force = jax.jit(forces)(x)
    expected = -jax.jit(jax.grad(stored(mesh)))(x)
    np.testing.assert_allclose(force, expected, atol=1e-6 * np.abs(expected).max())
    stiffer = stored(rectangle((0.2, 0.2), (5, 5), "quadrilaterals"))
    assert jax.jit(stored(mesh))(x) < 0.5 * jax.jit(stiffer)(x)


@pytest.mark.slow(group="cloth")
def test_a_motion_of_wrinkled_cells_has_the_gradient_that_differences_have():
    sheet = rectangle((0.2, 0.2), (5, 5), "wrinkling")
    scene = r2s.Scene(sheet, [0, 4])
    solver, start = r2s.ImplicitCloth(scene, dt=0.01), jnp.pad(sheet.rest, ((0, 0), (0, 1)))
    nearer = jnp.outer(jnp.linspace(0, 0.04, 10), jnp.array([0.0, 1, 0]))
    path = start[jnp.array([0, 4])][None] + jnp.stack([nearer, -nearer], axis=1)
    control = r2s.Control(path)
    knit = presets.grey_interlock()

    def height(stiffness):
        fabric = eqx.tree_at(lambda f: f.bending.stiffness, knit, stiffness)
        return jnp.mean(r2s.simulate(solver, fabric, solver.init(start), control).x[-1, :, 2])

    height, at = jax.jit(height), jnp.asarray(5.5e-6)
    slope, h = jax.jit(jax.grad(height))(at), 1e-10
    differences = (height(at + h) - height(at - h)) / (2 * h)
    assert float(slope) == pytest.approx(float(differences), rel=1e-4)


def test_below_half_of_the_critical_stress_nothing_is_released():
    matrix = stiffness("black_denim")
    almost = np.linalg.solve(matrix, [-0.49 * CRITICAL, 0.3, 0])
    beyond = np.linalg.solve(matrix, [-1.1 * CRITICAL, 0.3, 0])
    assert value(matrix, jnp.full(2, CRITICAL), almost) == 0
    assert value(matrix, jnp.full(2, CRITICAL), beyond) > 0


def test_stiffness_changes_gradually_as_wrinkles_begin():
    matrix, at = stiffness("grey_interlock"), jnp.full(2, CRITICAL)
    stresses = np.linspace(-2, 0, 201)[:, None] * [CRITICAL, 0, 0]
    second = np.array([curvature(matrix, at, e) for e in np.linalg.solve(matrix, stresses.T).T])
    assert np.abs(second).max() > 0.9 * matrix[0, 0]
    assert np.abs(np.diff(second, axis=0)).max() < 0.1 * matrix.max()


@pytest.mark.slow(group="cloth")
def test_the_critical_stress_is_that_of_waves_as_long_as_a_cell():
    """So it grows as cells shrink, and is less along the longer side of a cell."""
    fabric = presets.grey_interlock()
    for size, count in (((0.2, 0.2), 5), ((0.2, 0.2), 9), ((0.2, 0.1), 5)):
        samples = rectangle(size, (count, count), "wrinkling").samples
        none = jnp.zeros((*samples.areas.shape, 3), float)
        laws = membrane_on_samples(samples, fabric.membrane, fabric.bending, none)
        waves = 2 * np.pi * (count - 1) / np.array(size)
        expected = float(fabric.bending.stiffness) * waves**2
        assert np.asarray(laws.critical[0, 0]) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("name", ["black_denim", "grey_interlock"])
def test_derivatives_in_the_law_agree_with_differences_up_to_the_most_that_is_hidden(name):
    """Half of the strains are compressed by more than wrinkles can hide."""
    matrix, at, h = (
        stiffness(name) + np.diag([0.5, 0.5], 1) + np.diag([0.5, 0.5], -1),
        jnp.asarray([CRITICAL, 2 * CRITICAL]),
        1e-5,
    )
    random = np.random.default_rng(4)
    in_law = jax.jit(jax.grad(released, argnums=(0, 1)))
    for strain in random.uniform([-0.6, -0.6, -0.1], [0.1, 0.1, 0.1], (20, 3)):
        root = random.normal(size=(3, 3))
        change = (root + root.T) * np.sqrt(np.outer(np.diag(matrix), np.diag(matrix))), at
        found = sum(jnp.vdot(a, b) for a, b in zip(in_law(matrix, at, strain), change, strict=True))
        ahead, behind = (
            value(matrix + s * h * change[0], at + s * h * change[1], strain) for s in (1, -1)
        )
        assert float(found) == pytest.approx(float(ahead - behind) / (2 * h), rel=1e-5, abs=1e-9)


@pytest.mark.slow(group="cloth")
def test_equal_compression_in_all_directions_releases_shear_too():
    matrix = np.array([[100.0, 30.0, 0.0], [30.0, 100.0, 0.0], [0.0, 0.0, 35.0]])
    for kind, bound in ((jnp.float32, 0.1), (jnp.float64, 1e-6)):
        at = jnp.full(2, 0.01, kind)
        second = [
            curvature(jnp.asarray(matrix, kind), at, jnp.asarray([-e, -e, 0], kind))
            for e in (0.004, 0.1)
        ]
        assert float(second[0][2, 2]) > 0.9 * 35
        assert float(second[0][2, 2]) == pytest.approx(float(second[1][2, 2]), abs=bound)


@pytest.mark.parametrize("diagonal", [(0, 20, 5), (20, 0, 5), (20, 20, 0), (0, 0, 0)])
def test_without_stiffness_along_a_yarn_all_is_finite(diagonal):
    matrix, at = jnp.diag(jnp.asarray(diagonal, float)), jnp.full(2, CRITICAL)
    for strain in ((-0.1, -0.1, 0.0), (0.1, 0.1, 0.02), (0.0, 0.0, 0.0)):
        strain = jnp.asarray(strain, float)
        for found in (value(matrix, at, strain), slope(matrix, at, strain)):
            assert jnp.all(jnp.isfinite(found))
        assert jnp.all(jnp.isfinite(curvature(matrix, at, strain)))


def test_a_search_from_other_wrinkles_ends_at_the_same_ones():
    """Wherever it starts: the energy that is left is convex, so that there is one minimum."""
    random = np.random.default_rng(1)
    count = 2000
    warp, weft = np.exp(random.uniform(np.log(3), np.log(3000), (2, count)))
    matrix = np.zeros((count, 3, 3))
    matrix[:, 0, 0], matrix[:, 1, 1] = warp, weft
    coupling = random.uniform(-0.97, 0.97, count) * np.sqrt(warp * weft)
    matrix[:, 0, 1] = matrix[:, 1, 0] = coupling
    matrix[:, 2, 2] = np.exp(random.uniform(0, np.log(1000), count))
    critical = np.repeat(np.exp(random.uniform(np.log(1e-3), np.log(5), (count, 1))), 2, axis=1)
    strain = random.normal(size=(1, count, 3)) * 0.1
    laws = wrinkling.Wrinkled(
        r2s.OrthotropicMembrane(*jnp.asarray([[warp], [coupling], [weft], [matrix[:, 2, 2]]])),
        jnp.asarray(critical[None]),
        jax.vmap(jax.vmap(wrinkling.prepare_search))(
            jnp.asarray(matrix[None]), jnp.asarray(critical[None])
        ),
    )
    found = wrinkling.search(laws, jnp.asarray(strain))
    others = wrinkling.search(laws, jnp.asarray(random.permutation(strain, axis=1)))
    again = wrinkling.search(laws, jnp.asarray(strain), others)
    assert np.mean(np.abs(np.asarray(found[0])) > 1) > 0.2  # there is something to find
    for one, other in zip(found, again, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-8)


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("name", presets.FIVE)
def test_known_wrinkles_give_the_energy_its_slope_and_the_closed_form_its_curvature(name):
    sheet, fabric = rectangle((0.3, 0.2), (3, 2)), presets.FIVE[name]()
    strain = jnp.asarray(strains(2 * 4).reshape(2, 4, 3))
    law = membrane_on_samples(sheet.samples, fabric.membrane, fabric.bending, 0 * strain)
    known = wrinkling.with_wrinkles(law, wrinkling.search(law, strain))

    def energies(law, strain):
        return jax.vmap(jax.vmap(lambda law, strain: law.energy_density(strain)))(law, strain)

    def slopes(law, strain):
        return jax.vmap(jax.vmap(lambda law, strain: jax.grad(law.energy_density)(strain)))(
            law, strain
        )

    np.testing.assert_allclose(energies(known, strain), energies(law, strain), rtol=1e-9)
    np.testing.assert_allclose(slopes(known, strain), slopes(law, strain), rtol=1e-7, atol=1e-9)
    stress = wrinkling.stress_on_samples(law, strain)
    tangent = wrinkling.tangents_on_samples(law, strain)
    np.testing.assert_allclose(stress, slopes(law, strain), rtol=1e-7, atol=1e-9)
    by_derivative = jax.vmap(jax.vmap(lambda law, e: jax.hessian(law.energy_density)(e)))(
        law, strain
    )
    largest = float(jnp.max(jnp.abs(by_derivative)))
    np.testing.assert_allclose(tangent, by_derivative, rtol=0, atol=1e-9 * largest)
