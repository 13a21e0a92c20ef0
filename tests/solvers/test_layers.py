"""Contact of a sheet with itself: layers that rest, slide and never pass through each other."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import cloth, directional_difference, everywhere, flat, roll, two_of

from r2s._util.units import GRAVITY
from r2s.environment.scene import Control, Scene
from r2s.materials.fabric import Fabric
from r2s.mesh.mesh import Mesh, rectangle
from r2s.solvers.contact import contacts as contact
from r2s.solvers.contact.broad_phase import BVH, Pairs, build_bvh
from r2s.solvers.contact.contacts import SelfContact
from r2s.solvers.implicit.cloth import ImplicitCloth
from r2s.solvers.implicit.system import Elimination
from r2s.solvers.results import Result
from r2s.solvers.simulate import simulate

FABRIC = Fabric.make(0.2, (60.0, 10.0, 60.0, 20.0), 1e-5)
THICKNESS, RATE = jnp.asarray(1e-3), jnp.asarray(100.0)
SIZE = 0.2  # [m]

# compiled as a whole, which is quicker than operation by operation
touching, colliding = eqx.filter_jit(contact.touching), eqx.filter_jit(contact.colliding)
contact_energy = eqx.filter_jit(contact.contact_energy)
contact_hessians = eqx.filter_jit(contact.contact_hessians)


@eqx.filter_jit
def push_of(contacts, x, before):
    """The derivative [N] of the energy in contacts by positions."""
    return jax.grad(lambda x: contact.contact_energy(contacts, THICKNESS, RATE, x, before))(x)


def crossings(mesh: Mesh, x) -> int:
    """How many edges pass through a triangle that they share no vertex with."""
    x, faces = np.asarray(x), np.asarray(mesh.faces)
    edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)), axis=0)
    start, along = x[edges[:, 0]][:, None], np.diff(x[edges], axis=1)
    corner = x[faces[:, 0]][None]
    one, two = (x[faces[:, k]][None] - corner for k in (1, 2))
    normal = np.cross(one, two)
    rate = np.sum(along * normal, axis=-1)
    rate = np.where(np.abs(rate) < 1e-15, np.nan, rate)
    at = np.sum((corner - start) * normal, axis=-1) / rate
    inside = start + at[..., None] * along - corner
    square = np.sum(normal**2, axis=-1)
    u = np.sum(np.cross(inside, two) * normal, axis=-1) / square
    v = np.sum(np.cross(one, inside) * normal, axis=-1) / square
    shared = (edges[:, None, :, None] == faces[None, :, None, :]).any(axis=(2, 3))
    return int(np.sum(~shared & (at > 0) & (at < 1) & (u > 0) & (v > 0) & (u + v < 1)))


def as_if_large(mesh: Mesh) -> SelfContact:
    """As they are made for a large mesh."""
    return SelfContact(build_bvh(np.asarray(mesh.faces), np.asarray(mesh.rest)), 256)


def with_self_contact(solver, make=lambda mesh: SelfContact.make(mesh, 256)):
    mesh = solver.scene.mesh
    search = make(mesh)
    couples_all = isinstance(search.search, Pairs)
    elimination = Elimination.make(mesh, couples_all)
    return dataclasses.replace(solver, elimination=elimination, self_contact=search)


def two_sheets(gap: float, size: float = 0.1, count: int = 4):
    """One mesh of two square sheets, and positions with the second above the first [m]."""
    one = rectangle((size, size), (count, count))
    lower, upper = flat(one), flat(one, gap)
    return two_of(one), jnp.concatenate([lower, upper + jnp.array([[0.003, 0.002, 0.0]])])


@pytest.mark.slow(group="cloth")
def test_a_corner_folded_over_passes_through_nothing():
    mesh = rectangle((SIZE, SIZE), (7, 7))
    free = cloth(mesh, pinned=(0,), table=0.0, air=1.2, dt=1 / 60)
    steps = jnp.arange(1, 61) / 60
    along = jnp.minimum(steps / 0.5, 1.0)  # the corner goes over in half a second, then holds
    height = 0.002 + 0.1 * jnp.sin(jnp.pi * along)
    path = jnp.stack([along * (SIZE - 0.01), along * (SIZE - 0.01), height], axis=-1)
    control = Control(path[:, None])
    through = []
    for solver in (free, with_self_contact(free)):
        start = solver.init(flat(mesh, 1e-3))
        motion = eqx.filter_jit(simulate)(solver, FABRIC, start, control, save_every=3)
        assert bool(jnp.all(motion.ok))
        through.append([crossings(mesh, x) for x in motion.x])
    assert max(through[0]) > 10  # so there is something to prevent
    assert max(through[1]) == 0


@pytest.mark.parametrize("speed", [pytest.param(1.0, marks=pytest.mark.slow(group="cloth")), 5.0])
def test_a_sheet_thrown_at_another_does_not_tunnel(speed):
    mesh, x = two_sheets(0.02)
    solver = with_self_contact(cloth(mesh, pinned=range(16), dt=1 / 60))
    v = everywhere([0.0, 0.0, 0.0], mesh).at[16:, 2].set(-speed)
    states = roll(solver, FABRIC, solver.init(x, v), 12)
    assert np.all(np.isfinite(states.x))
    assert [crossings(mesh, x) for x in states.x] == [0] * 13
    assert np.min(states.x[:, 16:, 2]) > 1e-4  # a step of 5 m/s is 83 mm


@pytest.mark.slow(group="cloth")
def test_a_layer_rests_on_another_with_its_weight():
    mesh, x = two_sheets(0.9e-3)
    solver = with_self_contact(cloth(mesh, pinned=range(16)))
    still = roll(
        solver,
        Fabric.make(0.2, (60.0, 10.0, 60.0, 20.0), 1e-5, mass_damping=20.0),
        solver.init(x),
        60,
    )
    x, area = jnp.asarray(still.x[-1]), mesh.vertex_area
    assert np.max(np.abs(still.v[-1])) < 1e-3
    search = SelfContact.make(mesh, 256)
    contacts, fits = touching(search, mesh, THICKNESS, jnp.asarray(0.5), x)
    push = push_of(contacts, x, x)
    weight = 0.2 * GRAVITY * float(jnp.sum(area[16:]))
    assert bool(fits) and contact_energy(contacts, THICKNESS, RATE, x, x) > 0
    assert -jnp.sum(push[16:, 2]) == pytest.approx(weight, rel=0.02)
    assert jnp.sum(push, axis=0) == pytest.approx(0, abs=1e-9 * weight)  # action is reaction


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("friction", [0.1, 1.0])
def test_friction_between_layers_is_that_of_coulomb(friction):
    mesh, x = two_sheets(0.96647e-3)  # where it carries the weight
    fabric = Fabric.make(0.2, (600.0, 10.0, 600.0, 200.0), 1e-4, friction=friction)
    solver = with_self_contact(cloth(mesh, pinned=range(16)))
    v = everywhere([0.0, 0.0, 0.0], mesh).at[16:, 0].set(0.2)
    states = roll(solver, fabric, solver.init(x, v), 12)
    speed = states.v[:, 16:, 0].mean(axis=1)
    if friction == 1.0:
        assert abs(speed[-1]) < 2e-3  # at rest after 20 ms
    else:
        assert 0.2 - speed[-1] == pytest.approx(0.1 * GRAVITY * 0.12, rel=0.1)


@pytest.fixture(scope="module")
def pressed():
    """Contacts of two crumpled layers, and positions near by."""
    mesh, x = two_sheets(0.8e-3)
    random = np.random.default_rng(0)
    x = x + jnp.asarray(random.normal(size=x.shape)) * 1e-4
    search = SelfContact.make(mesh, 256)
    contacts, _ = touching(search, mesh, THICKNESS, jnp.asarray(0.5), x)
    after = x.at[16:, 2].add(-2e-3)
    contacts, _, _ = colliding(search, mesh, THICKNESS, x, after, contacts)
    return contacts, x, x + jnp.asarray(random.normal(size=x.shape)) * 1e-4


def test_the_hessian_of_a_contact_is_that_of_its_energy(pressed):
    contacts, before, x = pressed

    def force(x):
        return push_of(contacts, x, before)

    direction = jax.random.normal(jax.random.key(0), x.shape)
    expected = directional_difference(force, x, direction, 1e-8)
    blocks = contact_hessians(contacts, THICKNESS, RATE, x, before)
    parts = jnp.einsum("paibj,pbj->pai", blocks, direction[contacts.stencils])
    found = jnp.zeros_like(x).at[contacts.stencils].add(parts)
    assert jnp.linalg.norm(expected) > 0
    assert jnp.linalg.norm(found - expected) < 1e-5 * jnp.linalg.norm(expected)
    assert np.linalg.eigvalsh(np.asarray(blocks).reshape(-1, 12, 12)).min() > -1e-6


@pytest.mark.slow(group="cloth")
def test_too_many_contacts_are_not_forgotten():
    mesh, x = two_sheets(0.5e-3)
    search = SelfContact.make(mesh, 8)
    assert not touching(search, mesh, THICKNESS, jnp.asarray(0.5), x)[1]
    solver = with_self_contact(cloth(mesh, pinned=range(16)), lambda mesh: search)
    after = roll(solver, FABRIC, solver.init(x), 1)
    assert np.all(np.isnan(after.x[-1])) and after.failure[-1] == Result.SELF_CONTACT


def test_a_large_mesh_searches_a_tree_and_iterates():
    scene = Scene(rectangle((1.0, 1.0), (21, 21)), [0], table=0.0)
    large = ImplicitCloth(scene, 0.02, self_contact=True)
    assert large.self_contact is not None and not large.elimination.couples_all
    assert isinstance(large.self_contact.search, BVH)
    assert large.self_contact.capacity == 24 * 441


def landing(make):
    """Value, motion and gradient of a sheet that lands on another, and where they are."""
    mesh, x = two_sheets(3e-3, count=3)
    # crumpled: where edges are parallel, the closest points jump
    x = x + jnp.asarray(np.random.default_rng(0).normal(size=x.shape)) * 3e-4
    solver = with_self_contact(cloth(mesh, pinned=range(9)), make)
    control = Control(jnp.broadcast_to(x[:9], (8, 9, 3)))
    weights = jax.random.normal(jax.random.key(1), x.shape)
    v = everywhere([0.1, 0.0, 0.0], mesh).at[:, 2].set(-0.4)

    def loss(inputs):
        fabric, x, v = inputs
        moved = simulate(solver, fabric, solver.init(x, v), control, save_every=8).x[-1]
        return jnp.sum(weights * moved), moved

    return eqx.filter_jit(jax.value_and_grad(loss, has_aux=True)), x, v


@pytest.mark.slow(group="cloth")
def test_the_gradient_through_a_collision_agrees_with_differences_and_by_iteration():
    both, x, v = landing(lambda mesh: SelfContact.make(mesh, 256))
    inputs = (FABRIC, x, v)
    (_, moved), gradient = both(inputs)
    assert jnp.max(jnp.abs(moved[9:, 2] - 1e-3)) < 2e-3  # it has landed
    (_, again), slopes = landing(as_if_large)[0](inputs)
    assert jnp.max(jnp.abs(again - moved)) < 1e-8
    for one, other in zip(*map(jax.tree.leaves, (slopes, gradient)), strict=True):
        assert jnp.linalg.norm(one - other) <= 1e-5 * jnp.linalg.norm(other)
    for name, where, size in (
        ("velocity", lambda i: i[2], 1e-6),
        ("position", lambda i: i[1], 1e-8),
        ("density", lambda i: i[0].density, 1e-6),
        ("friction", lambda i: i[0].friction, 1e-5),
        ("thickness", lambda i: i[0].thickness, 1e-8),
        ("c11", lambda i: i[0].membrane.c11, 1e-2),
    ):

        def value(part, where=where):
            return both(eqx.tree_at(where, inputs, part))[0][0]

        direction = jax.random.normal(jax.random.key(2), where(inputs).shape)
        expected = directional_difference(value, where(inputs), direction, size)
        found = jnp.sum(where(gradient) * direction)
        assert found == pytest.approx(float(expected), rel=1e-3), name


def test_a_step_too_long_for_contact_is_refused():
    solver = with_self_contact(cloth(two_sheets(0.01)[0], dt=1 / 60))
    with pytest.raises(ValueError, match="at most 0.0333 s.*got 0.05 s"):
        dataclasses.replace(solver, dt=0.05)
