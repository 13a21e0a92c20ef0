"""What is exported is the fabric, or says how far it is not."""

import dataclasses
import xml.etree.ElementTree as xml

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import stored_energy
from hypothesis import given, settings
from hypothesis import strategies as st

import r2s
from r2s._util.units import GRAVITY, isotropic_membrane
from r2s.export import arcsim, mujoco, newton, pybullet, stiffness
from r2s.materials import presets
from r2s.materials.arcsim import read_material
from r2s.materials.bending import HingeBending
from r2s.materials.fabric import Fabric
from r2s.materials.plate import OrthotropicPlate, PlateBending
from r2s.materials.tables import TableMembrane
from r2s.mesh.mesh import Mesh, rectangle


def sheet_of(c11: float, c12: float, c22: float, c33: float) -> Fabric:
    return Fabric.make(0.2, (c11, c12, c22, c33), 2e-5, mass_damping=0.5)


def isotropic_sheet(modulus: float, poisson: float) -> Fabric:
    c11, c12, c22, c33 = (float(c) for c in isotropic_membrane(modulus, poisson, 1.0))
    return sheet_of(c11, c12, c22, c33)


MODULUS, POISSON = 60.0, 0.3  # [N/m], [-]
ISOTROPIC = isotropic_sheet(MODULUS, POISSON)
MESH = rectangle((0.3, 0.2), (7, 5))
TRIANGLES = rectangle((0.3, 0.2), (7, 5), "rising")
DENIM = presets.black_denim()


# Stiffness


def test_the_probes_are_what_a_pulled_strip_shows():
    own = stiffness.membrane_stiffness(DENIM)
    probes = stiffness.probes(own)
    assert probes["warp"] == pytest.approx(210 - 10**2 / 1000)
    assert probes["weft"] == pytest.approx(1000 - 10**2 / 210)
    assert probes["shear"] == pytest.approx(27) and probes["biaxial"] == pytest.approx(1230)
    # the least energy of all strains that stretch the bias by one
    c = np.array([0.5, 0.5, 0.5])
    free = np.linalg.svd(c[None])[2][1:]
    strain = np.array([1.0, 1.0, 0.0])
    strain = strain - free.T @ np.linalg.solve(free @ own @ free.T, free @ own @ strain)
    assert c @ strain == pytest.approx(1) and probes["bias"] == pytest.approx(strain @ own @ strain)


def test_bending_is_that_of_a_cylinder_in_each_direction():
    law = OrthotropicPlate(*map(jnp.asarray, (1e-5, 2e-5, 4e-5)))
    bending = stiffness.bending_stiffness(dataclasses.replace(DENIM, bending=law))
    expected = {"warp": 1e-5, "45 deg": 2e-5, "weft": 4e-5, "-45 deg": 2e-5}
    assert bending == pytest.approx(expected, rel=1e-9)
    plate = dataclasses.replace(DENIM, bending=PlateBending.make(3e-5, 0.4))
    expected = dict.fromkeys(stiffness.DIRECTIONS, 3e-5)
    assert stiffness.bending_stiffness(plate) == pytest.approx(expected, rel=1e-9)


@settings(max_examples=20)
@given(st.floats(1.0, 1e4), st.floats(-0.9, 0.9))
def test_an_isotropic_sheet_comes_back(modulus, poisson):
    sheet = stiffness.nearest_isotropic(isotropic_sheet(modulus, poisson))
    assert sheet[:2] == pytest.approx((modulus, poisson), rel=1e-9, abs=1e-12)


def test_the_nearest_isotropic_sheet_is_the_nearest():
    truth = stiffness.probes(stiffness.membrane_stiffness(DENIM))

    def squares(modulus: float, poisson: float) -> float:
        probes = stiffness.probes(stiffness.isotropic(modulus, poisson))
        return sum(np.log(probes[name] / truth[name]) ** 2 for name in truth)

    best = stiffness.nearest_isotropic(DENIM)
    for factor, shift in ((1.01, 0.0), (0.99, 0.0), (1.0, 0.01), (1.0, -0.01)):
        assert squares(best.modulus * factor, best.poisson + shift) > squares(*best[:2])


@pytest.mark.slow(group="motions")
@settings(max_examples=15)
@given(st.lists(st.floats(1.0, 1e3), min_size=3, max_size=3), st.floats(-0.9, 0.9))
def test_sheet_and_springs_together_are_the_fabric(numbers, coupling):
    c11, c22, c33 = numbers
    c12 = coupling * np.sqrt(c11 * c22)
    if c12 <= -0.99 * c33:
        return  # no isotropic sheet has so negative a coupling
    fabric = sheet_of(c11, c12, c22, c33)
    own = stiffness.membrane_stiffness(fabric)
    np.testing.assert_allclose(stiffness.with_springs(fabric).stiffness, own, rtol=1e-8, atol=1e-8)
    near = stiffness.with_springs(fabric, mujoco.POISSON, negative=False)
    assert 0 <= near.poisson <= 0.499 and min(near.warp, near.weft) >= 0


def test_springs_store_what_the_membrane_would():
    """In homogeneous strains, as energy of the edges: no more at the border than inside."""
    springs = stiffness.yarn_springs(MESH, 50.0, 200.0)
    for stretch, expected in (((1e-4, 0.0), 50.0), ((0.0, 1e-4), 200.0), ((1e-4, 1e-4), 250.0)):
        x = np.asarray(MESH.rest) * (1 + np.array(stretch))
        first, second = springs.ends.T
        longer = np.linalg.norm(x[first] - x[second], axis=1) - springs.lengths
        assert np.sum(springs.constants * longer**2) / 1e-8 == pytest.approx(expected * 0.3 * 0.2)
    slanted = Mesh.make(np.array([[0.0, 0], [1, 0], [0.3, 1]]) / 10, np.array([[0, 1, 2]]))
    with pytest.raises(ValueError, match="face 0 has not one edge along the warp"):
        stiffness.yarn_springs(slanted, 1.0, 1.0)


def test_hinges_are_right_along_the_grid_and_stiff_across_it():
    bending = stiffness.hinge_bending(rectangle((0.3, 0.3), (9, 9)), 2e-5)
    assert bending["warp"] == pytest.approx(2e-5, rel=1e-4) == bending["weft"]
    assert 2.5 < bending["-45 deg"] / 2e-5 < 3.1  # across the diagonals, all parallel
    mixed = rectangle((0.3, 0.3), (9, 9), "alternating")
    assert max(stiffness.hinge_bending(mixed, 2e-5).values()) < 1.7 * 2e-5
    own = stiffness.bending_stiffness(ISOTROPIC)
    exported = stiffness.hinge_bending(mixed, stiffness.hinge_stiffness(ISOTROPIC, mixed))
    logs = np.log([exported[name] / own[name] for name in own])
    assert abs(logs.mean()) < 1e-9 and np.abs(logs).max() < np.log(1.35)


# What is lost


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
    assert set(loss.membrane) >= {"warp", "bias", "weft", "shear"}
    assert all(np.isfinite(error) for error in loss.membrane.values())
    assert loss.lost or name == "isotropic mjcf"
    exact = name in ("mjcf", "semi-implicit")  # with springs along the yarns
    assert (max(map(abs, loss.membrane.values())) < 1e-9) == exact
    isotropic = EXPORTS[name](ISOTROPIC, MESH)
    assert name == "pybullet" or max(map(abs, isotropic.membrane.values())) < 1e-6
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), DENIM)
    with pytest.raises(ValueError, match=r"one fabric .* got a batch of shape \(2,\)"):
        EXPORTS[name](batch, MESH)


def test_laws_that_follow_the_strain_say_so():
    table = TableMembrane(jnp.tile(jnp.array([200.0, 20.0, 100.0, 60.0]), (6, 1)))
    _, loss = mujoco.mjcf(dataclasses.replace(DENIM, membrane=table), MESH)
    assert any("stiffness follows the strain" in text for text in loss.lost)


def test_arcsim_keeps_the_directions(tmp_path):
    loss = arcsim.write(tmp_path / "denim.json", DENIM, "denim")
    assert max(map(abs, (loss.membrane | loss.bending).values())) < 1e-12
    again, own = (
        stiffness.membrane_stiffness(fabric)
        for fabric in (read_material(tmp_path / "denim.json"), DENIM)
    )
    np.testing.assert_allclose(again, own, rtol=1e-9)


# MuJoCo


def attributes(text: str, tag: str) -> dict[str, str]:
    element = xml.fromstring(text).find(f".//{tag}")
    assert element is not None
    return element.attrib


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
    masses = [float(element.attrib["mass"]) for element in tree.iter("inertial")]
    np.testing.assert_allclose(masses, 0.32 * np.asarray(MESH.vertex_area))
    assert len(list(tree.iter("joint"))) == 3 * 35
    grip = attributes(text, "connect")
    assert (grip["body1"], grip["body2"]) == ("v3", "h3")
    constants = {round(float(spring.attrib["stiffness"]), 6) for spring in tree.iter("spatial")}
    assert sorted(constants) == pytest.approx([73.0, 146.0, 468.0, 936.0])  # of square cells
    limp = dataclasses.replace(DENIM, bending=PlateBending.make(0.0))
    text, loss = mujoco.mjcf(limp, MESH)
    assert attributes(text, "elasticity")["elastic2d"] == "stretch" and not loss.bending


@pytest.mark.slow(group="motions")
@pytest.mark.parametrize("elastic", ["membrane", "both"])
def test_mujocos_forces_are_ours(elastic):
    """On triangles, which are what MuJoCo knows."""
    engine = pytest.importorskip("mujoco", reason="MuJoCo is not installed: r2s[bench]")
    engine.set_mju_user_warning(lambda message: None)  # or it writes a log file where it is run
    bends = elastic == "both"
    fabric = dataclasses.replace(DENIM, damping=jnp.asarray(0.0))
    if not bends:
        fabric = dataclasses.replace(fabric, bending=PlateBending.make(0.0))
    text, _ = mujoco.mjcf(fabric, TRIANGLES, table=None)
    model = engine.MjModel.from_xml_string(text)
    data = engine.MjData(model)
    moved = 1e-7 * np.random.default_rng(0).normal(size=(35, 3)) * [1, 1, bends]
    data.qpos[:] = moved.ravel()
    engine.mj_forward(model, data)
    if bends:
        law = HingeBending(jnp.asarray(stiffness.hinge_stiffness(fabric, TRIANGLES)))
        fabric = dataclasses.replace(fabric, bending=law)
    x = jnp.pad(TRIANGLES.rest, ((0, 0), (0, 1))) + moved
    ours = -jax.grad(lambda x: stored_energy(TRIANGLES, fabric, x))(x)
    error = data.qfrc_passive.reshape(-1, 3) - np.asarray(ours)
    for part in (slice(0, 2), slice(2, 3))[: 1 + bends]:
        assert np.abs(error[:, part]).max() < 1e-3 * np.abs(ours[:, part]).max()


# Newton and Bullet


@pytest.mark.parametrize("kind", ["semi_implicit", "vbd"])
def test_newtons_energy_has_the_stiffness_at_small_strains(kind):
    cloth, _ = newton.cloth(ISOTROPIC, MESH, kind, yarns=False)
    shear = cloth.arguments["tri_ke"]
    area = cloth.arguments["tri_ka"] + (shear if kind == "vbd" else 0.0)

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
    cloth, _ = newton.cloth(fabric, MESH, "vbd", yarns=False)
    share = stiffness.hinge_stiffness(fabric, MESH) / 2e-5
    assert cloth.arguments["edge_ke"] == pytest.approx(share * ke.mean())
    explicit, _ = newton.edge_factors(length, area, "semi_implicit", 2e-5, 0.01)
    np.testing.assert_allclose(explicit * area, ke)


def test_newtons_springs_have_arguments():
    cloth, _ = newton.cloth(DENIM, MESH)
    assert cloth.fields == {"soft_contact_mu": 0.5} and len(cloth.springs) == 7 * 4 + 6 * 5
    first = cloth.springs[0]
    assert first.keys() == {"i", "j", "ke", "kd", "control"}
    assert first["kd"] == pytest.approx(0.01 * first["ke"])


def test_bullets_springs_are_the_membrane_that_it_says():
    """The energy of springs of 1 N/m on all edges in a small homogeneous strain."""
    unit = pybullet.spring_stiffness(MESH)
    edges = np.unique(stiffness.face_edges(MESH).reshape(-1, 2), axis=0)
    strain = 1e-5 * np.array([1.0, -0.5, 0.7])
    gradient = np.array([[strain[0], strain[2] / 2], [strain[2] / 2, strain[1]]])
    before = np.diff(np.asarray(MESH.rest)[edges], axis=1)[:, 0]
    after = before @ (np.eye(2) + gradient)
    longer = np.linalg.norm(after, axis=1) - np.linalg.norm(before, axis=1)
    assert np.sum(longer**2) == pytest.approx(0.06 * strain @ unit @ strain, rel=1e-3)
    arguments, loss = pybullet.soft_body(DENIM, MESH)
    assert arguments["mass"] == pytest.approx(0.32 * 0.06) and not loss.bending
    spring, damping = (arguments[f"spring{kind}Stiffness"] for kind in ("Elastic", "Damping"))
    assert damping == pytest.approx(0.01 * spring)


# A motion


FALLING = Fabric.make(0.2, (100.0, 30.0, 100.0, 35.0), 1e-5, damping=2e-4, mass_damping=3.0)
SIDE, SIZE, HEIGHT = 0.3, 9, 0.5  # [m], vertices a side, of the sheet that starts flat [m]
FRAMES, INTERVAL, STEPS = 45, 1 / 30, 68  # -, [s], steps of MuJoCo in a frame
CORNERS = (0, SIZE - 1, SIZE**2 - SIZE, SIZE**2 - 1)


def falling_sheet() -> r2s.Scenario:
    """The four corners come together within a second, in vacuum, while the sheet falls."""
    mesh = rectangle((SIDE, SIDE), (SIZE, SIZE))
    start = np.pad(np.asarray(mesh.rest), ((0, 0), (0, 1)), constant_values=HEIGHT)
    corners = start[np.array(CORNERS)]
    times = INTERVAL * np.arange(FRAMES + 1)
    eased = np.clip(times, 0, 1) ** 2 * (3 - 2 * np.clip(times, 0, 1))
    way = (corners.mean(axis=0) - corners) / 20
    scene = r2s.Scene(mesh, jnp.array(CORNERS), air=None)
    return r2s.Scenario(
        scene=scene,
        start=jnp.asarray(start, float),
        path=jnp.asarray(corners + eased[:, None, None] * way, float),
        path_times=jnp.asarray(times, float),
        first_time=jnp.asarray(INTERVAL, float),
        interval=INTERVAL,
        num_frames=FRAMES,
        lead_in=1,
        substeps=4,
        acceleration=jnp.where(scene.is_free[:, None], jnp.array([0.0, 0.0, -GRAVITY]), 0.0),
    )


def in_mujoco(scenario: r2s.Scenario) -> np.ndarray:
    """Positions [m] (vertex, 3) of the exported fabric at the end, without contact."""
    engine = pytest.importorskip("mujoco", reason="needs r2s[mujoco]")
    step, options = INTERVAL / STEPS, {"pinned": CORNERS, "height": HEIGHT, "table": None}
    text, _ = mujoco.mjcf(FALLING, scenario.scene.mesh, timestep=step, **options)
    model = engine.MjModel.from_xml_string(text)
    model.opt.disableflags |= engine.mjtDisableBit.mjDSBL_CONTACT
    mujoco.brake(model, FALLING)
    data = engine.MjData(model)
    for pinned in np.asarray(scenario.controls(STEPS).pinned):
        data.mocap_pos[:] = pinned
        engine.mj_step(model, data)
    engine.mj_kinematics(model, data)  # positions lag by a step otherwise
    engine.mj_flex(model, data)
    return data.flexvert_xpos.copy()


@pytest.mark.slow(group="motions")
def test_an_exported_fabric_hangs_in_mujoco_as_ours_does() -> None:
    """As users run it: in single precision, promotion as usual."""
    with (
        jax.enable_x64(False),
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
    ):
        scenario = falling_sheet()
        theirs = in_mujoco(scenario)
        ours = np.asarray(eqx.filter_jit(r2s.rollout)(scenario, FALLING).x)
    distance = np.sqrt(np.mean(np.sum((ours[-1] - theirs) ** 2, axis=-1))) / SIDE
    moved = np.sqrt(np.mean(np.sum((ours[-1] - ours[0]) ** 2, axis=-1))) / SIDE
    assert distance < 0.05 < moved
