"""What is exported is the fabric, or says how far it is not."""

import dataclasses
import xml.etree.ElementTree as xml

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import stored_energy
from hypothesis import given, settings
from hypothesis import strategies as st

from r2s._util.units import isotropic_membrane
from r2s.export import Loss, arcsim, mujoco, newton, pybullet, stiffness
from r2s.materials import presets
from r2s.materials.arcsim import read_material
from r2s.materials.bending import HingeBending
from r2s.materials.fabric import Fabric
from r2s.materials.plate import OrthotropicPlate, PlateBending
from r2s.materials.tables import TableMembrane
from r2s.mesh.mesh import Mesh, rectangle

MODULUS, POISSON = 60.0, 0.3  # [N/m], [-]
ISOTROPIC = Fabric.make(
    0.2,
    tuple(float(c) for c in isotropic_membrane(MODULUS, POISSON, 1.0)),  # pyright: ignore
    2e-5,
    mass_damping=0.5,
)
MESH = rectangle((0.3, 0.2), (7, 5))
TRIANGLES = rectangle((0.3, 0.2), (7, 5), "rising")
DENIM = presets.black_denim()


def close(one: dict, other: dict, tolerance: float = 1e-9) -> bool:
    return one.keys() == other.keys() and all(
        abs(one[name] - other[name]) <= tolerance * abs(other[name]) for name in other
    )


def test_the_probes_are_what_a_pulled_strip_shows():
    own = stiffness.membrane_stiffness(DENIM)
    found = stiffness.probes(own)
    assert found["warp"] == pytest.approx(210 - 10**2 / 1000)
    assert found["weft"] == pytest.approx(1000 - 10**2 / 210)
    assert found["shear"] == pytest.approx(27) and found["biaxial"] == pytest.approx(1230)
    # the least energy of all strains that stretch the bias by one
    c = np.array([0.5, 0.5, 0.5])
    free = np.linalg.svd(np.array([[0.5, 0.5, 0.5]]))[2][1:]
    strain = np.array([1.0, 1.0, 0.0])
    strain = strain - free.T @ np.linalg.solve(free @ own @ free.T, free @ own @ strain)
    assert c @ strain == pytest.approx(1) and found["bias"] == pytest.approx(strain @ own @ strain)


def test_bending_is_that_of_a_cylinder_in_each_direction():
    numbers = (1e-5, 2e-5, 4e-5)
    law = OrthotropicPlate(*map(jnp.asarray, numbers))
    found = stiffness.bending_stiffness(dataclasses.replace(DENIM, bending=law))
    expected = dict(zip(("warp", "bias", "weft"), numbers, strict=True))
    assert close(found, {**expected, "other bias": 2e-5})
    plate = dataclasses.replace(DENIM, bending=PlateBending.make(3e-5, 0.4))
    assert close(stiffness.bending_stiffness(plate), dict.fromkeys(stiffness.DIRECTIONS, 3e-5))


@given(st.floats(1.0, 1e4), st.floats(-0.9, 0.9))
def test_an_isotropic_sheet_comes_back(modulus, poisson):
    found = stiffness.nearest_isotropic(stiffness.isotropic(modulus, poisson))
    assert found[:2] == pytest.approx((modulus, poisson), rel=1e-9, abs=1e-12)


def test_the_nearest_isotropic_sheet_is_the_nearest():
    own = stiffness.membrane_stiffness(DENIM)
    truth = stiffness.probes(own)

    def squares(modulus: float, poisson: float) -> float:
        found = stiffness.probes(stiffness.isotropic(modulus, poisson))
        return sum(np.log(found[name] / truth[name]) ** 2 for name in truth)

    best = stiffness.nearest_isotropic(own)
    for factor, shift in ((1.01, 0.0), (0.99, 0.0), (1.0, 0.01), (1.0, -0.01)):
        assert squares(best.modulus * factor, best.poisson + shift) > squares(*best[:2])


@pytest.mark.slow(group="motions")
@settings(max_examples=15)
@given(st.lists(st.floats(1.0, 1e3), min_size=3, max_size=3), st.floats(-0.9, 0.9))
def test_sheet_and_springs_together_are_the_fabric(numbers, coupling):
    c11, c22, c33 = numbers
    c12 = coupling * np.sqrt(c11 * c22)
    own = np.array([[c11, c12, 0.0], [c12, c22, 0.0], [0.0, 0.0, c33]])
    if c12 <= -0.99 * c33:
        return  # no isotropic sheet has so negative a coupling
    np.testing.assert_allclose(stiffness.with_springs(own).stiffness, own, rtol=1e-8, atol=1e-8)
    near = stiffness.with_springs(own, mujoco.POISSON, negative=False)
    assert 0 <= near.poisson <= 0.499 and min(near.warp, near.weft) >= 0


def test_springs_store_what_the_membrane_would():
    """In homogeneous strains, as energy of the edges: no more at the border than inside."""
    found = stiffness.yarn_springs(MESH, 50.0, 200.0)
    area = 0.3 * 0.2
    for stretch, expected in (((1e-4, 0.0), 50.0), ((0.0, 1e-4), 200.0), ((1e-4, 1e-4), 250.0)):
        x = np.asarray(MESH.rest) * (1 + np.array(stretch))
        longer = np.linalg.norm(x[found.ends[:, 0]] - x[found.ends[:, 1]], axis=1) - found.lengths
        assert np.sum(found.constants * longer**2) / 1e-8 == pytest.approx(expected * area)
    slanted = Mesh.make(np.array([[0.0, 0], [1, 0], [0.3, 1]]) / 10, np.array([[0, 1, 2]]))
    with pytest.raises(ValueError, match="face 0 has not one edge along the warp"):
        stiffness.yarn_springs(slanted, 1.0, 1.0)


def test_hinges_are_right_along_the_grid_and_stiff_across_it():
    found = stiffness.hinge_bending(rectangle((0.3, 0.3), (9, 9)), 2e-5)
    assert found["warp"] == pytest.approx(2e-5, rel=1e-4) == found["weft"]
    assert 2.5 < found["other bias"] / 2e-5 < 3.1  # across the diagonals, all parallel
    mixed = rectangle((0.3, 0.3), (9, 9), "alternating")
    assert max(stiffness.hinge_bending(mixed, 2e-5).values()) < 1.7 * 2e-5
    own = stiffness.bending_stiffness(ISOTROPIC)
    shown = stiffness.hinge_bending(mixed, stiffness.hinge_stiffness(ISOTROPIC, mixed))
    logs = np.log([shown[name] / own[name] for name in own])
    assert abs(logs.mean()) < 1e-9 and np.abs(logs).max() < np.log(1.35)


EXPORTS = {
    "isotropic mjcf": lambda fabric, mesh: mujoco.mjcf(fabric, mesh, yarns=False)[1],
    "mjcf": lambda fabric, mesh: mujoco.mjcf(fabric, mesh)[1],
    "semi-implicit": lambda fabric, mesh: newton.cloth(fabric, mesh)[1],
    "vbd": lambda fabric, mesh: newton.cloth(fabric, mesh, "vbd", yarns=False)[1],
    "pybullet": lambda fabric, mesh: pybullet.soft_body(fabric, mesh)[1],
}


@pytest.mark.slow(group="motions")
@pytest.mark.parametrize("name", EXPORTS)
def test_each_says_what_is_lost(name):
    loss = EXPORTS[name](DENIM, MESH)
    assert isinstance(loss, Loss) and set(loss.membrane) >= {"warp", "bias", "weft", "shear"}
    assert all(np.isfinite(error) for error in loss.membrane.values())
    assert loss.lost or name == "isotropic mjcf"
    exact = name in ("mjcf", "semi-implicit")  # with springs along the yarns
    assert (max(map(abs, loss.membrane.values())) < 1e-9) == exact
    isotropic = EXPORTS[name](ISOTROPIC, MESH)
    if name != "pybullet":
        assert max(map(abs, isotropic.membrane.values())) < 1e-6
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), DENIM)
    with pytest.raises(ValueError, match=r"one fabric .* got a batch of shape \(2,\)"):
        EXPORTS[name](batch, MESH)


def test_laws_that_follow_the_strain_say_so():
    table = TableMembrane(jnp.tile(jnp.array([200.0, 20.0, 100.0, 60.0]), (6, 1)))
    _, loss = mujoco.mjcf(dataclasses.replace(DENIM, membrane=table), MESH)
    assert any("stiffness follows the strain" in text for text in loss.lost)


def attributes(text: str, tag: str) -> dict[str, str]:
    found = xml.fromstring(text).find(f".//{tag}")
    assert found is not None
    return found.attrib


def test_mujoco_has_the_sheet_in_its_numbers():
    text, _ = mujoco.mjcf(ISOTROPIC, MESH, yarns=False)
    solid = attributes(text, "elasticity")
    young, poisson, thickness = (float(solid[n]) for n in ("young", "poisson", "thickness"))
    assert young * thickness == pytest.approx(MODULUS) and poisson == pytest.approx(POISSON)
    bending = young * thickness**3 / (12 * (1 - poisson**2))
    expected = stiffness.hinge_stiffness(ISOTROPIC, MESH)
    assert bending == pytest.approx(expected) and 1e-5 < expected < 2e-5
    assert solid["elastic2d"] == "both"


def test_mujoco_has_masses_grips_and_yarns_in_a_whole_model():
    text, _ = mujoco.mjcf(DENIM, MESH, pinned=(3,))
    tree = xml.fromstring(text)
    masses = [float(each.attrib["mass"]) for each in tree.iter("inertial")]
    np.testing.assert_allclose(masses, 0.32 * np.asarray(MESH.vertex_area))
    assert len(list(tree.iter("joint"))) == 3 * 35
    grip = attributes(text, "connect")
    assert (grip["body1"], grip["body2"]) == ("v3", "h3")
    constants = sorted({round(float(each.attrib["stiffness"]), 6) for each in tree.iter("spatial")})
    assert constants == pytest.approx([73.0, 146.0, 468.0, 936.0])  # of square cells
    sheet_without_bending = dataclasses.replace(DENIM, bending=PlateBending.make(0.0))
    text, loss = mujoco.mjcf(sheet_without_bending, MESH)
    assert attributes(text, "elasticity")["elastic2d"] == "stretch" and not loss.bending


@pytest.mark.parametrize("kind", ["semi_implicit", "vbd"])
def test_newtons_energy_has_the_fabric_s_stiffness_at_small_strains(kind):
    made, _ = newton.cloth(ISOTROPIC, MESH, kind, yarns=False)
    shear = made.arguments["tri_ke"]
    area = made.arguments["tri_ka"] + (shear if kind == "vbd" else 0.0)

    def density(strain):
        """Of its membrane, from (E11, E22, 2 E12): C = 2 E + 1."""
        a, b, c = 1 + 2 * strain[0], 1 + 2 * strain[1], strain[2]
        change = jnp.sqrt(a * b - c**2) - 1 - shear / area
        return shear / 2 * (a + b - 2) + area / 2 * change**2

    zero = jnp.zeros(3)
    np.testing.assert_allclose(jax.grad(density)(zero), 0, atol=1e-12)
    own = stiffness.membrane_stiffness(ISOTROPIC)
    np.testing.assert_allclose(jax.hessian(density)(zero), own, rtol=1e-9, atol=1e-9)


def test_newtons_edges_bend_like_hinges():
    """Its energies k l theta^2 / 2 (VBD), summed, are those of r2s's hinges."""
    fabric = dataclasses.replace(ISOTROPIC, bending=HingeBending(jnp.asarray(2e-5)))
    length, area = np.asarray(MESH.hinge_length), np.asarray(MESH.hinge_area)
    ke, kd = newton.edge_factors(length, area, "vbd", 2e-5, 0.01)
    # r2s: area stiffness (theta l / area)^2 / 2
    np.testing.assert_allclose(ke * length, area * 2e-5 * (length / area) ** 2)
    np.testing.assert_allclose(kd, 0.01 * ke)
    made, _ = newton.cloth(fabric, MESH, "vbd", yarns=False)
    share = stiffness.hinge_stiffness(fabric, MESH) / 2e-5
    assert made.arguments["edge_ke"] == pytest.approx(share * ke.mean())
    explicit, _ = newton.edge_factors(length, area, "semi_implicit", 2e-5, 0.01)
    np.testing.assert_allclose(explicit * area, ke)


def test_newtons_springs_have_arguments():
    made, _ = newton.cloth(DENIM, MESH)
    assert made.springs is not None and made.fields == {"soft_contact_mu": 0.5}
    rows = newton.spring_arguments(made.springs, 0.01)
    assert len(rows) == 7 * 4 + 6 * 5 and rows[0].keys() == {"i", "j", "ke", "kd", "control"}
    assert rows[0]["kd"] == pytest.approx(0.01 * rows[0]["ke"])


def test_bullets_springs_are_the_membrane_that_it_says():
    """The energy of springs of 1 N/m on all edges in a small homogeneous strain."""
    unit = pybullet.spring_stiffness(MESH)
    pairs = np.sort(np.asarray(MESH.faces)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, rest = np.unique(pairs, axis=0), np.asarray(MESH.rest)
    strain = 1e-5 * np.array([1.0, -0.5, 0.7])
    gradient = np.array([[strain[0], strain[2] / 2], [strain[2] / 2, strain[1]]])
    before = rest[edges[:, 1]] - rest[edges[:, 0]]
    longer = np.linalg.norm(before @ (np.eye(2) + gradient), axis=1)
    longer -= np.linalg.norm(before, axis=1)
    assert np.sum(longer**2) == pytest.approx(0.06 * strain @ unit @ strain, rel=1e-3)
    made, loss = pybullet.soft_body(DENIM, MESH)
    assert made["mass"] == pytest.approx(0.32 * 0.06) and not loss.bending
    assert made["springDampingStiffness"] == pytest.approx(0.01 * made["springElasticStiffness"])


def test_arcsim_keeps_the_directions(tmp_path):
    loss = arcsim.write(tmp_path / "denim.json", DENIM, "denim")
    assert loss.worst < 1e-12 and any("friction" in text for text in loss.lost)
    again = read_material(tmp_path / "denim.json")
    np.testing.assert_allclose(
        stiffness.membrane_stiffness(again), stiffness.membrane_stiffness(DENIM), rtol=1e-9
    )


@pytest.mark.slow(group="motions")
@pytest.mark.parametrize("elastic", ["membrane", "both"])
def test_mujocos_forces_are_ours(elastic):
    """On triangles, which are what MuJoCo knows."""
    engine = pytest.importorskip("mujoco", reason="MuJoCo is not installed: r2s[bench]")
    engine.set_mju_user_warning(lambda message: None)  # or it writes a log file where it is run
    fabric = dataclasses.replace(DENIM, damping=jnp.asarray(0.0))
    if elastic == "membrane":
        fabric = dataclasses.replace(fabric, bending=PlateBending.make(0.0))
    text, _ = mujoco.mjcf(fabric, TRIANGLES, table=None)
    model = engine.MjModel.from_xml_string(text)
    data = engine.MjData(model)
    moved = 1e-7 * np.random.default_rng(0).normal(size=(35, 3)) * [1, 1, elastic == "both"]
    data.qpos[:] = moved.ravel()
    engine.mj_forward(model, data)
    hinges = fabric
    if elastic == "both":
        law = HingeBending(jnp.asarray(stiffness.hinge_stiffness(fabric, TRIANGLES)))
        hinges = dataclasses.replace(fabric, bending=law)
    x = jnp.pad(TRIANGLES.rest, ((0, 0), (0, 1))) + moved
    ours = -jax.grad(lambda x: stored_energy(TRIANGLES, hinges, x))(x)
    error = data.qfrc_passive.reshape(-1, 3) - np.asarray(ours)
    for part in (slice(0, 2), slice(2, 3)) if elastic == "both" else (slice(0, 2),):
        assert np.abs(error[:, part]).max() < 1e-3 * np.abs(ours[:, part]).max()
