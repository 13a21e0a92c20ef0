"""Pulls, cantilevers and drapes, against mechanics, and back from their numbers."""

import dataclasses
import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r2s
from r2s._util.units import GRAVITY
from r2s.environment.scene import Control, Scene
from r2s.estimation.default_spaces import on_cloth
from r2s.laboratory.bending import Cantilever, Drape, coefficient, drape, overhang, ring
from r2s.laboratory.estimate import consistency, estimate, fits, informed
from r2s.laboratory.files import read_knit, read_tests
from r2s.laboratory.pull import SPECIMEN, Pull, uniaxial
from r2s.materials import presets
from r2s.materials.fabric import Fabric
from r2s.materials.fabric_json import fabric_as_json, fabric_from_json
from r2s.materials.membrane import OrthotropicMembrane
from r2s.materials.parameters import StiffeningSpace
from r2s.materials.stiffening import SofteningPlate, StiffeningMembrane
from r2s.materials.tables import TableMembrane
from r2s.mesh.mesh import rectangle
from r2s.solvers.implicit.cloth import ImplicitCloth
from r2s.solvers.implicit.potential import residual

LAW = OrthotropicMembrane(*(jnp.asarray(c, float) for c in (300.0, -60.0, 200.0, 40.0)))
ANGLES = {"warp": 0.0, "bias": np.pi / 4, "weft": np.pi / 2}
SIZE = (0.2, 0.05)  # of strips [m]
SMALL_RING = ring(shape=(36, 4))


def pulled(fabric: Fabric, name: str, most: float = 0.2, noise: float = 0.0) -> Pull:
    """The pull of a fabric up to a strain, its force off by a share as a whole."""
    extension = np.linspace(0, most * SIZE[0], 60)
    at = jax.vmap(lambda s: uniaxial(fabric.membrane, s, ANGLES[name]))
    tension, across = at(jnp.asarray(1 + extension / SIZE[0]))
    width = None if name == "bias" else SIZE[1] * np.asarray(across)
    force = SIZE[1] * np.asarray(tension) * (1 + noise)
    return Pull.make(extension, force, SIZE, ANGLES[name], width, name=name)


# Pulls


@pytest.mark.slow(group="study")
@pytest.mark.parametrize(
    "direction, c11, c12, c22", [(0.0, 300, -60, 200), (np.pi / 2, 200, -60, 300)]
)
def test_a_strip_pulls_by_its_modulus_and_gets_wider_or_narrower(direction, c11, c12, c22):
    for stretch in (1.001, 1.1, 1.4):
        tension, across = uniaxial(LAW, jnp.asarray(stretch), direction)
        strain = (stretch**2 - 1) / 2
        assert float(tension) == pytest.approx(stretch * (c11 - c12**2 / c22) * strain, rel=1e-9)
        assert float(across) == pytest.approx(np.sqrt(1 - 2 * c12 / c22 * strain), rel=1e-9)


@pytest.mark.slow(group="study")
def test_a_strip_pulled_askew_has_the_modulus_of_a_turned_orthotropic_sheet():
    angle, small = 0.5, 1e-6
    compliance = np.linalg.inv(np.array([[300.0, -60.0, 0], [-60.0, 200.0, 0], [0, 0, 40.0]]))
    c, s = np.cos(angle), np.sin(angle)
    along = np.array([c**2, s**2, c * s])  # stress of a unit tension
    tension, _ = uniaxial(LAW, jnp.asarray(1 + small), angle)
    assert float(tension) / small == pytest.approx(1 / (along @ compliance @ along), rel=1e-5)


@pytest.mark.slow(group="study")
def test_yarns_stiffen_by_their_ratio_each_at_its_own_knee():
    law = StiffeningMembrane.make(LAW, 10.0, 1.02, 1.2)
    for direction, soon in ((0.0, True), (np.pi / 2, False)):
        start, there, far = (
            float(uniaxial(law, jnp.asarray(s), direction)[0]) for s in (1.001, 1.05, 3.0)
        )
        assert (there / 0.05 > 2.5 * start / 0.001) == soon
        limit = 3.0 * (3.0**2 - 1) / 2 * (300.0 if soon else 200.0)
        assert 6 < far / limit < 10


@pytest.mark.slow(group="study")
def test_the_force_of_a_pull_has_the_derivatives_of_differences():
    law = StiffeningMembrane.make(LAW, 8.0, 1.05, 1.1)

    def tension(numbers):
        c = OrthotropicMembrane(*numbers[:4])
        return uniaxial(StiffeningMembrane(c, *numbers[4:]), jnp.asarray(1.15), 0.4)[0]

    at = jnp.stack(jax.tree.leaves(law))
    slope = np.asarray(jax.grad(tension)(at))
    for i, number in enumerate(at):
        step = 1e-5 * abs(number)
        ends = [float(tension(at.at[i].add(side * step))) for side in (1, -1)]
        assert slope[i] == pytest.approx((ends[0] - ends[1]) / (2 * float(step)), rel=1e-5), i


def test_a_law_that_follows_the_strain_has_no_curve():
    law = TableMembrane(jnp.full((6, 4), 100.0))
    with pytest.raises(TypeError, match="TableMembrane has no energy"):
        uniaxial(law, jnp.asarray(1.1), 0.0)


@pytest.mark.slow(group="study")
@pytest.mark.parametrize("cells, off", [((16, 4), 0.03), ((4, 4), 0.15)], ids=["4:1", "1:1"])
def test_clamps_pull_a_long_strip_as_free_sides_do(cells, off):
    """A sheet between two clamps, simulated; a square one is stiffer, by less than `off`."""
    length, wide = 0.05 * cells[0] / cells[1], 0.05
    mesh = rectangle((length, wide), (cells[0] + 1, cells[1] + 1), "quadrilaterals")
    warp = np.asarray(mesh.rest[:, 0])
    ends = np.flatnonzero((warp < 1e-9) | (warp > length - 1e-9))
    fabric = Fabric.make(0.01, (300.0, 90.0, 300.0, 105.0), 1e-7)
    scene = Scene(mesh, ends, air=None)
    solver = ImplicitCloth(scene, 5.0)
    flat = jnp.pad(mesh.rest, ((0, 0), (0, 1)))
    start = flat.at[:, 0].multiply(1.05)
    control = Control(start[ends], jnp.zeros(3))
    state = solver.init(start)
    for _ in range(5):
        state = eqx.filter_jit(solver.step)(fabric, state, control)
    pull = np.asarray(residual(solver.potential(fabric, state, control), state.x))[:, 0]
    tension = pull[warp > length - 1e-9].sum() / wide
    free = float(uniaxial(fabric.membrane, jnp.asarray(1.05), 0.0)[0])
    assert 0 < tension / free - 1 < off


# Cantilevers


def test_the_overhang_at_the_standard_slope_is_twice_the_bending_length():
    """ASTM D1388 takes half of it; the elastica says 2.0003."""
    fabric = Fabric.make(0.2, (300.0, 0.0, 300.0, 100.0), 2e-5)
    length = (2e-5 / (0.2 * GRAVITY)) ** (1 / 3)
    assert float(overhang(fabric)) / length == pytest.approx(2.0003, abs=1e-4)


def test_a_strip_that_hardly_sags_is_a_beam():
    slope = 0.01  # the tip sags by w L^4 / (8 B)
    fabric = Fabric.make(0.2, (300.0, 0.0, 300.0, 100.0), 2e-5)
    beam = (8 * slope * 2e-5 / (0.2 * GRAVITY)) ** (1 / 3)
    assert float(overhang(fabric, 0.0, slope)) == pytest.approx(beam, rel=1e-3)


# Drapes


@pytest.mark.slow(group="study")
def test_a_rigid_disc_does_not_drape_and_a_limp_one_hangs_down():
    run = eqx.filter_jit(
        lambda fabric: coefficient(SMALL_RING, drape(SMALL_RING, fabric, jax.random.key(0)))
    )
    found = [float(run(with_bending(presets.black_denim(), b))) for b in (3e-2, 1e-4, 2e-5)]
    assert found[0] == pytest.approx(1, abs=0.01)
    assert found[0] > found[1] + 0.1 > found[2] + 0.2
    assert found[2] > 0


@pytest.mark.slow(group="study")
def test_a_drape_has_the_derivative_of_differences():
    fabric, key = presets.pink_solid(), jax.random.key(0)

    @eqx.filter_jit
    def at(change):
        softer = with_bending(fabric, fabric.bending.stiffness * jnp.exp(change))
        value = coefficient(SMALL_RING, drape(SMALL_RING, softer, key))
        return value, value

    slope = float(jax.jacfwd(at, has_aux=True)(jnp.zeros(()))[0])
    ends = [float(at(jnp.asarray(side * 1e-3))[0]) for side in (1, -1)]
    assert slope == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=3e-3)
    assert slope > 0.05


def with_bending(fabric: Fabric, stiffness) -> Fabric:
    return eqx.tree_at(lambda f: f.bending.stiffness, fabric, jnp.asarray(stiffness, float))


# Estimates


def truth(fabric: Fabric, space) -> np.ndarray:
    return np.asarray(space.values(space.to_unit(fabric)))


def errors(found, fabric: Fabric, space) -> dict[str, float]:
    """Of each parameter, in standard errors."""
    true = truth(fabric, space)
    off = [
        np.log(v / t) if r.log else v - t
        for r, v, t in zip(space.ranges, found.values, true, strict=True)
    ]
    return dict(
        zip((r.name for r in space.ranges), np.array(off) / found.standard_errors, strict=True)
    )


@pytest.mark.slow(group="study")
@pytest.mark.parametrize("name", ["black_denim", "camel_ponte_roma"])
def test_pulls_and_a_cantilever_tell_the_stiffnesses(name):
    fabric = presets.MEASURED[name]()
    space = on_cloth(float(fabric.density))
    tests = [
        pulled(fabric, d, noise=n) for d, n in (("warp", 0.05), ("weft", -0.04), ("bias", 0.03))
    ]
    found = estimate([*tests, Cantilever.make([1.02 * float(overhang(fabric))])], space)
    off = errors(found, fabric, space)
    assert all(abs(off[each]) < 2 for each in ("warp", "weft", "shear", "coupling", "bending"))
    known = dict(zip((r.name for r in space.ranges), found.standard_errors, strict=True))
    assert known["warp"] == pytest.approx(SPECIMEN, rel=0.3)
    assert known["bending"] == pytest.approx(0.09, rel=0.4)  # three times that of the overhang
    assert known["damping"] > 1 and known["friction"] > 0.5  # nothing tells these
    assert found.converged


@pytest.mark.slow(group="study")
def test_a_sheet_that_stiffens_is_told_by_its_pulls():
    fabric = presets.grey_interlock()
    small = fabric.membrane
    fabric = dataclasses.replace(fabric, membrane=StiffeningMembrane.make(small, 6.0, 1.08, 1.05))
    space = StiffeningSpace.make(on_cloth(float(fabric.density)))
    tests = [pulled(fabric, each, 0.25) for each in ANGLES]
    found = estimate(tests, space)
    off = errors(found, fabric, space)
    assert all(abs(off[name]) < 1.5 for name in off if name not in ("damping", "friction"))
    assert all(each.errors < 0.5 for each in fits(tests, found.fabric)[:3])
    straight = estimate(tests, on_cloth(float(fabric.density)))
    assert max(each.errors for each in fits(tests, straight.fabric)) > 2


@pytest.mark.slow(group="cloth")
def test_a_drape_tells_bending_where_nothing_else_does():
    fabric = presets.pink_solid()
    space = on_cloth(float(fabric.density))
    value = float(coefficient(ring(), drape(ring(), fabric, jax.random.key(3))))
    found = estimate([*(pulled(fabric, each) for each in ANGLES), Drape.make(value)], space)
    off = errors(found, fabric, space)
    assert abs(off["bending"]) < 2
    known = dict(zip((r.name for r in space.ranges), found.standard_errors, strict=True))
    assert known["bending"] < 0.3


@pytest.mark.slow(group="study")
def test_what_tests_tell_is_the_prior_of_an_estimate_from_motions():
    fabric = presets.black_denim()
    space = on_cloth(float(fabric.density))
    found = estimate([pulled(fabric, each) for each in ANGLES], space)
    known = informed(space, found)
    mean, precision = known.prior()
    np.testing.assert_allclose(known.values(mean), found.values, rtol=1e-6)
    widths = np.array([r.width for r in space.ranges])
    np.testing.assert_allclose(
        np.sqrt(np.diag(np.linalg.inv(precision))) * widths, found.standard_errors, rtol=1e-4
    )
    again = estimate([Cantilever.make([float(overhang(fabric))])], known)  # one after the other
    together = estimate(
        [*(pulled(fabric, e) for e in ANGLES), Cantilever.make([float(overhang(fabric))])], space
    )
    np.testing.assert_allclose(again.values, together.values, rtol=0.01)
    np.testing.assert_allclose(again.standard_errors, together.standard_errors, rtol=0.02)


@pytest.mark.slow(group="estimates")
def test_a_motion_after_tests_tells_more_than_either():
    """A lift on 9 x 9 vertices, whose mesh says nothing of a fabric for sure, after pulls and a
    cantilever that are off by up to 5 %."""
    fabric = presets.black_denim()
    space = on_cloth(float(fabric.density))
    noise = {"warp": 0.05, "weft": -0.04, "bias": 0.03}
    tests = [pulled(fabric, each, noise=noise[each]) for each in ANGLES]
    told = estimate([*tests, Cantilever.make([1.02 * float(overhang(fabric))])], space)
    lift = r2s.record(r2s.lifting(), fabric, "denim", key=jax.random.key(1))
    method = r2s.METHODS["diffcloud"](shape=(9, 9))
    both = method.estimate([lift], informed(space, told), key=jax.random.key(0))
    alone = method.estimate([lift], space, key=jax.random.key(0))
    off = errors(both, fabric, space)
    assert all(abs(value) < 2.5 for value in off.values())
    for which, name in enumerate(off):
        assert both.standard_errors[which] < alone.standard_errors[which], name
        assert both.standard_errors[which] < told.standard_errors[which], name
    assert consistency(told, both) > 0.01
    with pytest.raises(ValueError, match="cma-es takes no account"):
        r2s.METHODS["cma-es"]().estimate([lift], informed(space, told), key=jax.random.key(0))


@pytest.mark.slow(group="study")
def test_a_motion_that_leads_elsewhere_than_the_tests_contradicts_them():
    space = on_cloth(0.32)
    tests = [pulled(presets.black_denim(), each) for each in ANGLES]
    told = estimate(tests, space)
    assert consistency(told, told) == 1
    better = 0.7 * told.standard_errors  # than by the tests alone
    values = told.values * np.array([1.5, 1, 1, 1, 1, 1, 1])
    assert (
        consistency(told, dataclasses.replace(told, values=values, standard_errors=better)) < 1e-6
    )


@pytest.mark.parametrize("law", [StiffeningMembrane.make(LAW, 5.0, 1.1, 1.2), SofteningPlate])
def test_laws_that_hold_another_one_go_into_a_file_and_back(law):
    fabric = presets.black_denim()
    if isinstance(law, StiffeningMembrane):
        fabric = dataclasses.replace(fabric, membrane=law)
    else:
        plate = law(fabric.bending, jnp.asarray(0.4), jnp.asarray(20.0))
        fabric = dataclasses.replace(fabric, bending=plate)
    stored = fabric_as_json(fabric)
    back = fabric_from_json(json.loads(json.dumps(stored)))
    assert jax.tree.all(jax.tree.map(np.array_equal, back, fabric))
    part = stored["membrane" if isinstance(law, StiffeningMembrane) else "bending"]
    part["small"].pop(next(name for name in part["small"] if name != "law"))
    with pytest.raises(ValueError, match="small: missing"):
        fabric_from_json(stored)


# Files


def written(folder: Path, **kinds) -> Path:
    path = folder / "tests.json"
    path.write_text(json.dumps({"format": "r2s-laboratory/1"} | kinds))
    return path


def curve(folder: Path, header: str, unit: float = 1.0, force: float = 1.0) -> str:
    rows = [f"{unit * e:.6g},{force * 300 * 0.05 * e / 0.2:.6g}" for e in np.linspace(0, 0.02, 20)]
    (folder / "warp.csv").write_text("\n".join([header, *rows]))
    return "warp.csv"


def test_the_units_of_a_curve_are_those_of_its_header(tmp_path: Path):
    pull = {"direction": "warp", "length": 0.2, "width": 0.05}
    found = []
    for header, unit, force in (
        ("extension_m,force_N", 1, 1),
        ("Extension [mm],Force [mN]", 1e3, 1e3),
        ("strain_%,force_gf", 500, 1 / 9.80665e-3),
    ):
        path = written(tmp_path, pulls=[pull | {"file": curve(tmp_path, header, unit, force)}])
        found.append(read_tests(path).tests[0])
    for other in found[1:]:
        np.testing.assert_allclose(other.tension, found[0].tension, rtol=1e-4)
        np.testing.assert_allclose(other.stretch, found[0].stretch, rtol=1e-6)


@pytest.mark.parametrize(
    "header, unit, force, words",
    [
        ("extension_m,force_g", 1, 1, "is a mass: a force is in N, or in gf"),
        ("extension_m,force_N", 500, 1, "per cent, or in millimetres"),
        ("extension_m,force_N", 1, 1e5, "is the force in grams or millinewtons"),
        ("extension_m,force_N", 1, -1, "the force does not rise"),
        ("extension_m,force_N", 1e-3, 1, "stretches by 0.0001 of its length at most"),
        ("extension,force_N", 1, 1, "unit of 'extension' is not known"),
        ("stretch_m,force_N", 1, 1, "expected one column 'strain'"),
    ],
)
def test_a_curve_in_other_units_is_named(tmp_path: Path, header, unit, force, words):
    file = curve(tmp_path, header, unit, force)
    pull = {"file": file, "direction": "warp", "length": 0.2, "width": 0.05}
    with pytest.raises(ValueError, match=words):
        read_tests(written(tmp_path, pulls=[pull]))


@pytest.mark.parametrize(
    "strain, force, words",
    [
        ([0, 0.05, 0.1, 0.05, 0], [0, 1, 2, 0.6, 0], "goes back by 100%"),
        ([0, 0.02, 0.05, 0.08, 0.1], [0, 1, 2, 3, 0.2], "the force falls before the end"),
        ([0, 0.05, 0.08, 0.1], [1, 1.5, 1.8, 2], "at rest the force is 50%"),
        ([0, 0.05, 0.1], [0, -1, 2], "fewer than three samples"),
    ],
)
def test_a_curve_that_is_no_pull_is_named(strain, force, words):
    with pytest.raises(ValueError, match=words):
        Pull.make(0.2 * np.array(strain), np.array(force, float), SIZE)


@pytest.mark.slow(group="study")
def test_widths_do_not_make_the_errors_of_tensions_smaller():
    """What scatters more than it should says so, with widths as without."""
    fabric, space = presets.black_denim(), on_cloth(0.32)
    random, found = np.random.default_rng(0), {}
    pulls = [pulled(fabric, each) for each in ANGLES]
    rough = [
        dataclasses.replace(each, tension=each.tension * (1 + 0.06 * random.normal(size=24)))
        for each in pulls
    ]
    for name, tests in (
        ("with", rough),
        ("without", [dataclasses.replace(each, across=each.across * jnp.nan) for each in rough]),
    ):
        found[name] = estimate(tests, space).standard_errors[2]  # of the shear
    assert found["with"] == pytest.approx(found["without"], rel=0.2)


def test_a_drape_that_does_not_come_to_rest_is_an_error(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(
        Drape, "residuals", lambda self, fabric: jnp.full(1, jnp.nan) * fabric.density
    )
    with pytest.raises(RuntimeError, match="no specimen of the drape test comes to rest"):
        estimate([Drape.make(0.4)], on_cloth(0.2))


@pytest.mark.parametrize(
    "kinds, words",
    [
        ({}, "no test"),
        ({"pull": []}, "unknown: pull"),
        ({"cantilevers": [{"direction": "warp", "overhangs": [6.1, 6.2]}]}, "in centimetres"),
        ({"cantilevers": [{"direction": "warp", "overhangs": [0.03, 0.07]}]}, "of one direction"),
        ({"cantilevers": [{"direction": 45, "overhangs": [0.05]}]}, "0 to pi rad"),
        ({"cantilevers": [{"overhangs": [0.05]}]}, "cantilever 1: missing: direction"),
        ({"drapes": [{"coefficient": 42}]}, "is it in per cent"),
        ({"cantilevers": [{"direction": "warp", "overhangs": [10**400]}]}, "a number is too large"),
        ({"cantilevers": [{"direction": True, "overhangs": [0.05]}]}, "direction: expected"),
        ({"source": [1], "drapes": [{"coefficient": 0.4}]}, "source: expected text"),
        ({"drapes": [{"coefficient": 0.4, "deviation": 5}]}, "the deviation is a share"),
        ({"drapes": [{"coefficient": 0.4, "support_radius": 0.1499}]}, "drape 1: the radii"),
        (
            {"pulls": [{"file": "", "direction": "warp", "length": 0.2, "width": 0.05}]},
            "pull 1: no such file",
        ),
        (
            {"drapes": [{"coefficient": 0.4, "specimen_radius": 0.3, "support_radius": 0.18}]},
            "diameters",
        ),
        ({"drapes": [{"coefficient": 0.4, "radius": 0.3}]}, "drape 1: unknown: radius"),
        (
            {"pulls": [{"file": "no.csv", "direction": "warp", "length": 0.2, "width": 0.05}]},
            "no.csv",
        ),
    ],
)
def test_tests_that_are_none_are_named(tmp_path: Path, kinds: dict, words: str):
    with pytest.raises((ValueError, FileNotFoundError), match=words):
        read_tests(written(tmp_path, **kinds))


def test_pulls_of_knits_are_read_in_metres(tmp_path: Path):
    h5py = pytest.importorskip("h5py")
    file = tmp_path / "outputData_Wool Rib Y.h5"
    stretch = np.linspace(1, 1.5, 40)
    with h5py.File(file, "w") as h5:
        h5["clampSize"], h5["fabricSize"] = [142.0], [400.0]  # 4 pixels a millimetre
        for name in ("video1", "video2", "video3", "video4", "video5"):
            pins = np.zeros((6, 2, 40))
            pins[0, 0], pins[1, 0] = 200 - 20 * (stretch - 1), -200 + 20 * (stretch - 1)
            pins[-2, 1], pins[-1, 1] = 240 * stretch, 0
            h5[f"{name}/traj"], h5[f"{name}/forces"] = pins, 20 * (stretch - 1)
    pulls = read_knit(file, 0.0)
    assert len(pulls) == 4  # the first one was never stretched before
    np.testing.assert_allclose(pulls[0].tension, 20 * (pulls[0].stretch - 1) / 0.1, rtol=1e-6)
    assert float(pulls[0].stretch.max()) == pytest.approx(1.5, abs=0.02)
    assert float(pulls[0].across.min()) == pytest.approx(1 - 0.1 * 0.5, abs=0.01)
    with h5py.File(file, "a") as h5:
        del h5["video3/forces"]
    with pytest.raises(ValueError, match="no pulls of stitch-by-stitch"):
        read_knit(file, 0.0)


@pytest.mark.slow(group="study")
def test_tests_alone_make_a_card(tmp_path: Path, capsys: pytest.CaptureFixture):
    pytest.importorskip("tyro")
    from r2s.cli.main import main
    from r2s.estimation import cards

    pull = {"file": curve(tmp_path, "extension_m,force_N"), "length": 0.2, "width": 0.05}
    pulls = [pull | {"direction": each} for each in ("warp", "weft")]
    path = written(tmp_path, pulls=pulls, cantilevers=[{"direction": "warp", "overhangs": [0.05]}])
    command = ["estimate", str(path), "--density", "0.2", "--out", str(tmp_path / "card.json")]
    assert main(command) == 0
    card = cards.read(tmp_path / "card.json")
    assert float(card.fabric.membrane.c11) == pytest.approx(260, rel=0.1)  # at 10 % of strain
    assert card.provenance.method == "estimated by r2s: laboratory tests"
    assert card.provenance.recordings[0][0] == "tests"
    assert "cantilever 1: overhang 50.0 mm measured" in capsys.readouterr().out
    assert main([*command, "--num-starts", "1"]) == 1
    assert main([*command, "--method", "physnet"]) == 1
    assert "--method, --solver" in capsys.readouterr().err
    assert main([*command, "--law", "stiffening"]) == 0
    law = cards.read(tmp_path / "card.json").fabric.membrane
    assert isinstance(law, StiffeningMembrane)


def test_an_estimate_that_errs_by_its_mesh_does_not_contradict_tests_that_it_lies_near():
    """It knows no better than the tests do, and half a standard error is no contradiction."""
    space = on_cloth(0.32)
    told = estimate([pulled(presets.black_denim(), each) for each in ANGLES], space)
    widths = np.array([bound.width for bound in space.ranges])

    def shifted(by: float, known: float):
        """By so many of the tests' standard errors in the membrane; known so much worse."""
        shift = np.where(np.arange(space.dim) < 3, by, 0) * told.standard_errors / widths
        places = np.asarray(space.to_unit(told.fabric)) + shift
        values = np.asarray(space.values(jnp.asarray(places, float)))
        errors = known * told.standard_errors
        return dataclasses.replace(told, values=values, standard_errors=errors)

    for worse in (1.0, 1.2):
        assert consistency(told, shifted(0.5, worse)) > 0.3
    better = shifted(2.0, 0.7)
    blamed = dataclasses.replace(better, mesh_bias=2 * told.standard_errors)
    assert consistency(told, better) < 0.05 and consistency(told, blamed) > 0.3
