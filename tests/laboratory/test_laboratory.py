"""Pulls, cantilevers and drapes against mechanics, and fabrics estimated from them."""

import dataclasses
import json

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
OFF = {"warp": 0.05, "weft": -0.04, "bias": 0.03}  # relative errors of forces
SIZE = (0.2, 0.05)  # of strips [m]
SMALL_RING = ring(shape=(36, 4))
DENIM = presets.black_denim()
SPACE = on_cloth(0.32)  # of denim


def pulled(fabric: Fabric, name: str, most: float = 0.2, noise: float = 0.0) -> Pull:
    """The pull of a fabric up to a strain, its force off by a share as a whole."""
    extension = np.linspace(0, most * SIZE[0], 60)
    at = jax.vmap(lambda s: uniaxial(fabric.membrane, s, ANGLES[name]))
    tension, across = at(jnp.asarray(1 + extension / SIZE[0]))
    width = None if name == "bias" else SIZE[1] * np.asarray(across)
    force = SIZE[1] * np.asarray(tension) * (1 + noise)
    return Pull.make(extension, force, SIZE, ANGLES[name], width, name=name)


def pulls_of(fabric: Fabric, noise: dict[str, float] | None = None) -> list[Pull]:
    return [pulled(fabric, name, noise=(noise or {}).get(name, 0.0)) for name in ANGLES]


# Pulls


@pytest.mark.slow(group="study")
@pytest.mark.parametrize("direction, c11, c22", [(0.0, 300, 200), (np.pi / 2, 200, 300)])
def test_a_strip_pulls_by_its_modulus_and_gets_wider_or_narrower(direction, c11, c22):
    for stretch in (1.001, 1.1, 1.4):
        tension, across = uniaxial(LAW, jnp.asarray(stretch), direction)
        strain = (stretch**2 - 1) / 2
        assert float(tension) == pytest.approx(stretch * (c11 - 60**2 / c22) * strain, rel=1e-9)
        assert float(across) == pytest.approx(np.sqrt(1 + 2 * 60 / c22 * strain), rel=1e-9)


@pytest.mark.slow(group="study")
def test_a_strip_pulled_askew_has_the_modulus_of_a_turned_orthotropic_sheet():
    angle, small = 0.5, 1e-6
    compliance = np.linalg.inv(np.array([[300.0, -60.0, 0], [-60.0, 200.0, 0], [0, 0, 40.0]]))
    c, s = np.cos(angle), np.sin(angle)
    along = np.array([c**2, s**2, c * s])  # stress of a unit tension
    tension, _ = uniaxial(LAW, jnp.asarray(1 + small), angle)
    assert float(tension) / small == pytest.approx(1 / (along @ compliance @ along), rel=1e-5)


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
    with pytest.raises(TypeError, match="TableMembrane has no energy"):
        uniaxial(TableMembrane(jnp.full((6, 4), 100.0)), jnp.asarray(1.1), 0.0)


@pytest.mark.slow(group="study")
@pytest.mark.parametrize("cells, off", [((16, 4), 0.03), ((4, 4), 0.15)], ids=["4:1", "1:1"])
def test_clamps_pull_a_long_strip_as_free_sides_do(cells, off):
    """A sheet between two clamps, simulated; a square one is stiffer, by less than `off`."""
    length, wide = 0.05 * cells[0] / cells[1], 0.05
    mesh = rectangle((length, wide), (cells[0] + 1, cells[1] + 1), "quadrilaterals")
    warp = np.asarray(mesh.rest[:, 0])
    ends = np.flatnonzero((warp < 1e-9) | (warp > length - 1e-9))
    fabric = Fabric.make(0.01, (300.0, 90.0, 300.0, 105.0), 1e-7)
    solver = ImplicitCloth(Scene(mesh, ends, air=None), 5.0)
    start = jnp.pad(mesh.rest, ((0, 0), (0, 1))).at[:, 0].multiply(1.05)
    control = Control(start[ends], jnp.zeros(3))
    state = solver.init(start)
    for _ in range(5):
        state = eqx.filter_jit(solver.step)(fabric, state, control)
    pull = np.asarray(residual(solver.potential(fabric, state, control), state.x))[:, 0]
    tension = pull[warp > length - 1e-9].sum() / wide
    free = float(uniaxial(fabric.membrane, jnp.asarray(1.05), 0.0)[0])
    assert 0 < tension / free - 1 < off


# Cantilevers


def test_a_strip_overhangs_twice_its_bending_length_and_sags_like_a_beam():
    """ASTM D1388 takes half of the overhang; the elastica says 2.0003."""
    fabric = Fabric.make(0.2, (300.0, 0.0, 300.0, 100.0), 2e-5)
    length = (2e-5 / (0.2 * GRAVITY)) ** (1 / 3)
    assert float(overhang(fabric)) / length == pytest.approx(2.0003, abs=1e-4)
    slope = 0.01  # the tip of a beam sags by w L^4 / (8 B)
    beam = (8 * slope) ** (1 / 3) * length
    assert float(overhang(fabric, 0.0, slope)) == pytest.approx(beam, rel=1e-3)


# Drapes


def with_bending(fabric: Fabric, stiffness) -> Fabric:
    return eqx.tree_at(lambda f: f.bending.stiffness, fabric, jnp.asarray(stiffness, float))


@eqx.filter_jit
def draped(fabric: Fabric):
    return coefficient(SMALL_RING, drape(SMALL_RING, fabric, jax.random.key(0)))


@pytest.mark.slow(group="study")
def test_a_rigid_disc_does_not_drape_and_a_limp_one_hangs_down():
    rigid, soft, limp = (float(draped(with_bending(DENIM, b))) for b in (3e-2, 1e-4, 2e-5))
    assert rigid == pytest.approx(1, abs=0.01)
    assert rigid > soft + 0.1 > limp + 0.2 > 0.2


@pytest.mark.slow(group="study")
def test_a_drape_has_the_derivative_of_differences():
    fabric = presets.pink_solid()

    @eqx.filter_jit
    def at(change):
        return draped(with_bending(fabric, fabric.bending.stiffness * jnp.exp(change)))

    slope = float(jax.jacfwd(at)(jnp.zeros(())))
    ends = [float(at(jnp.asarray(side * 1e-3))) for side in (1, -1)]
    assert slope == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=3e-3)
    assert slope > 0.05


# Estimates


def errors(estimated, fabric: Fabric, space) -> dict[str, float]:
    """Of each parameter, in standard errors."""
    truth = np.asarray(space.values(space.to_unit(fabric)))
    triples = zip(space.ranges, estimated.values, truth, strict=True)
    off = np.array([np.log(v / t) if r.log else v - t for r, v, t in triples])
    return by_name(off / estimated.standard_errors, space)


def by_name(values, space) -> dict[str, float]:
    return dict(zip((bound.name for bound in space.ranges), values, strict=True))


@pytest.mark.slow(group="study")
@pytest.mark.parametrize("name", ["black_denim", "camel_ponte_roma"])
def test_pulls_and_a_cantilever_determine_the_stiffnesses(name):
    fabric = presets.MEASURED[name]()
    space = on_cloth(float(fabric.density))
    cantilever = Cantilever.make([1.02 * float(overhang(fabric))])
    estimated = estimate([*pulls_of(fabric, OFF), cantilever], space)
    off = errors(estimated, fabric, space)
    assert all(abs(off[n]) < 2 for n in ("warp", "weft", "shear", "coupling", "bending"))
    known = by_name(estimated.standard_errors, space)
    assert known["warp"] == pytest.approx(SPECIMEN, rel=0.3)
    assert known["bending"] == pytest.approx(0.09, rel=0.4)  # three times that of the overhang
    assert known["damping"] > 1 and known["friction"] > 0.5  # no test depends on these
    assert estimated.converged


@pytest.mark.slow(group="study")
def test_pulls_determine_how_a_sheet_stiffens():
    fabric = presets.grey_interlock()
    stiffening = StiffeningMembrane.make(fabric.membrane, 6.0, 1.08, 1.05)
    fabric = dataclasses.replace(fabric, membrane=stiffening)
    linear = on_cloth(float(fabric.density))
    space = StiffeningSpace.make(linear)
    tests = [pulled(fabric, name, 0.25) for name in ANGLES]
    estimated = estimate(tests, space)
    off = errors(estimated, fabric, space)
    assert all(abs(off[name]) < 1.5 for name in off if name not in ("damping", "friction"))
    assert all(fit.errors < 0.5 for fit in fits(tests, estimated.fabric))
    assert max(fit.errors for fit in fits(tests, estimate(tests, linear).fabric)) > 2


@pytest.mark.slow(group="cloth")
def test_a_drape_determines_bending_where_nothing_else_does():
    fabric = presets.pink_solid()
    space = on_cloth(float(fabric.density))
    value = float(coefficient(ring(), drape(ring(), fabric, jax.random.key(3))))
    estimated = estimate([*pulls_of(fabric), Drape.make(value)], space)
    assert abs(errors(estimated, fabric, space)["bending"]) < 2
    assert by_name(estimated.standard_errors, space)["bending"] < 0.3


@pytest.mark.slow(group="study")
def test_tests_one_after_the_other_give_what_they_give_together():
    cantilever = Cantilever.make([float(overhang(DENIM))])
    first = estimate(pulls_of(DENIM), SPACE)
    known = informed(SPACE, first)
    mean, precision = known.prior()
    np.testing.assert_allclose(known.values(mean), first.values, rtol=1e-6)
    widths = np.array([r.width for r in SPACE.ranges])
    deviations = np.sqrt(np.diag(np.linalg.inv(precision)))
    np.testing.assert_allclose(deviations * widths, first.standard_errors, rtol=1e-4)
    again = estimate([cantilever], known)
    together = estimate([*pulls_of(DENIM), cantilever], SPACE)
    np.testing.assert_allclose(again.values, together.values, rtol=0.01)
    np.testing.assert_allclose(again.standard_errors, together.standard_errors, rtol=0.02)


@pytest.mark.slow(group="estimates")
def test_a_motion_after_tests_determines_more_than_either():
    """A lift on 9 x 9 vertices, after pulls and a cantilever that are off by up to 5 %."""
    cantilever = Cantilever.make([1.02 * float(overhang(DENIM))])
    by_tests = estimate([*pulls_of(DENIM, OFF), cantilever], SPACE)
    lift = r2s.record(r2s.lifting(), DENIM, "denim", key=jax.random.key(1))
    method = r2s.METHODS["diffcloud"](shape=(9, 9))
    both = method.estimate([lift], informed(SPACE, by_tests), key=jax.random.key(0))
    alone = method.estimate([lift], SPACE, key=jax.random.key(0))
    assert all(abs(off) < 2.5 for off in errors(both, DENIM, SPACE).values())
    assert (both.standard_errors < alone.standard_errors).all()
    assert (both.standard_errors < by_tests.standard_errors).all()
    assert consistency(by_tests, both) > 0.01
    with pytest.raises(ValueError, match="cma-es takes no account"):
        r2s.METHODS["cma-es"]().estimate([lift], informed(SPACE, by_tests), key=jax.random.key(0))


def test_a_motion_contradicts_tests_where_it_is_sure_and_far_away():
    """One that knows no better than the tests, or whose mesh errs, does not."""
    by_tests = estimate(pulls_of(DENIM), SPACE)
    widths = np.array([bound.width for bound in SPACE.ranges])

    def shifted(by: float, known: float):
        """By so many of the tests' standard errors in the membrane; known so much worse."""
        shift = np.where(np.arange(SPACE.dim) < 3, by, 0) * by_tests.standard_errors / widths
        place = np.asarray(SPACE.to_unit(by_tests.fabric)) + shift
        values = np.asarray(SPACE.values(jnp.asarray(place, float)))
        deviations = known * by_tests.standard_errors
        return dataclasses.replace(by_tests, values=values, standard_errors=deviations)

    assert consistency(by_tests, by_tests) == 1
    assert min(consistency(by_tests, shifted(0.5, worse)) for worse in (1.0, 1.2)) > 0.3
    better = shifted(2.0, 0.7)
    blamed = dataclasses.replace(better, mesh_bias=2 * by_tests.standard_errors)
    assert consistency(by_tests, better) < 0.05 and consistency(by_tests, blamed) > 0.3
    assert consistency(by_tests, shifted(8.0, 0.7)) < 1e-6


def test_a_drape_that_does_not_come_to_rest_is_an_error(monkeypatch: pytest.MonkeyPatch):
    failed = lambda self, fabric: jnp.full(1, jnp.nan) * fabric.density  # noqa: E731
    monkeypatch.setattr(Drape, "residuals", failed)
    with pytest.raises(RuntimeError, match="no specimen of the drape test comes to rest"):
        estimate([Drape.make(0.4)], on_cloth(0.2))


@pytest.mark.parametrize("part", ["membrane", "bending"])
def test_laws_that_hold_another_one_go_into_a_file_and_back(part):
    laws = {
        "membrane": StiffeningMembrane.make(LAW, 5.0, 1.1, 1.2),
        "bending": SofteningPlate(DENIM.bending, jnp.asarray(0.4), jnp.asarray(20.0)),
    }
    fabric = dataclasses.replace(DENIM, **{part: laws[part]})
    stored = fabric_as_json(fabric)
    back = fabric_from_json(json.loads(json.dumps(stored)))
    assert jax.tree.all(jax.tree.map(np.array_equal, back, fabric))
    small = stored[part]["small"]
    small.pop(next(name for name in small if name != "law"))
    with pytest.raises(ValueError, match="small: missing"):
        fabric_from_json(stored)


@pytest.mark.parametrize(
    "strain, force, words",
    [
        ([0, 0.05, 0.1, 0.05, 0], [0, 1, 2, 0.6, 0], "goes back by 100%"),
        ([0, 0.02, 0.05, 0.08, 0.1], [0, 1, 2, 3, 0.2], "falls before the end"),
        ([0, 0.05, 0.08, 0.1], [1, 1.5, 1.8, 2], "at rest the force is 50%"),
        ([0, 0.05, 0.1], [0, -1, 2], "fewer than three samples"),
    ],
)
def test_a_curve_that_is_no_pull_is_named(strain, force, words):
    with pytest.raises(ValueError, match=words):
        Pull.make(0.2 * np.array(strain), np.array(force, float), SIZE)


# The zero of a pull

STIFF = 8000.0  # [N/m]
D = np.linspace(0, 0.0225, 91)  # [m]


def straight(extension: np.ndarray) -> np.ndarray:
    """The force [N] of a strip of `SIZE` that is taut from 0 on, with some noise."""
    noise = np.random.default_rng(0).normal(0, 0.05, len(extension))
    return STIFF * SIZE[1] / SIZE[0] * np.maximum(extension, 0) + noise


@pytest.mark.parametrize("level", [2.0, 5.0, 10.0])  # [N], those of ISO 13934-1
@pytest.mark.parametrize("is_counted", [True, False], ids=["counted", "tared"])
def test_a_pretension_puts_the_rest_before_the_first_reading(level, is_counted):
    before = level * SIZE[0] / SIZE[1] / STIFF
    force = straight(D + before) - (0 if is_counted else level)
    pull = Pull.make(D, force, SIZE, pretension=None if is_counted else level)
    assert float(pull.zero) == pytest.approx(-before, abs=1e-4)
    assert float(pull.zero_deviation) == pytest.approx(before, rel=0.1)
    assert float(pull.length) == pytest.approx(SIZE[0] - before, abs=1e-4)
    slope = np.asarray(pull.tension) / (np.asarray(pull.stretch) - 1)
    np.testing.assert_allclose(slope[1:], STIFF, rtol=0.06)


@pytest.mark.parametrize("offset", [-1.0, 0.0, 5.0])  # [N], of the machine
@pytest.mark.parametrize("slack", [0.001, 0.003, 0.01])  # [m]
def test_slack_and_the_offset_of_a_machine_are_taken_out(slack, offset):
    pull = Pull.make(D, straight(D - slack) + offset, SIZE)
    assert float(pull.zero) == pytest.approx(slack, abs=2e-4)
    assert float(pull.zero_deviation) < 2e-3
    assert float(pull.length) == pytest.approx(SIZE[0] + slack, abs=2e-4)


@pytest.mark.parametrize("position", [-0.05, 0.02, 0.2])
def test_a_machine_may_count_the_extension_from_anywhere(position):
    pull = Pull.make(D + position, straight(D), SIZE)
    assert float(pull.zero) == pytest.approx(position, abs=2e-4)
    assert float(pull.length) == pytest.approx(SIZE[0], abs=2e-4)


def test_a_curve_that_begins_late_keeps_its_zero():
    late = D[20:]  # the first force is a fifth of the largest
    pull = Pull.make(late, straight(late), SIZE)
    assert abs(float(pull.zero)) < float(pull.zero_deviation)
    assert float(pull.length) == pytest.approx(SIZE[0], abs=2e-4)


def test_a_zero_that_is_given_stays():
    pull = Pull.make(D, straight(D + 0.002), SIZE, zero=-0.002)
    assert (float(pull.zero), float(pull.zero_deviation)) == (pytest.approx(-0.002), 0.0)
    with pytest.raises(ValueError, match="zero, 0.5 m, is beyond"):
        Pull.make(D, straight(D), SIZE, zero=0.5)
    with pytest.raises(ValueError, match="pretension is a force"):
        Pull.make(D, straight(D), SIZE, pretension=0.0)


@pytest.mark.slow(group="study")
@pytest.mark.parametrize("zero", [-0.0025, 0.0, 0.004], ids=["pretension", "none", "slack"])
def test_a_zero_is_estimated_with_the_stiffness(zero):
    """Of a fabric that pulls as its law does."""
    fabric = Fabric.make(0.25, (STIFF, 0.0, 3000.0, 500.0), 1e-5)
    at = jax.vmap(lambda stretch: uniaxial(fabric.membrane, stretch, 0.0)[0])
    stretch = (SIZE[0] + D) / (SIZE[0] + zero)
    force = SIZE[1] * np.where(stretch > 1, np.asarray(at(jnp.asarray(stretch, float))), 0)
    pull = Pull.make(D, 1.03 * force, SIZE, name="tests.json: pull 1 (warp.csv)")
    found = estimate([pull], on_cloth(0.25))
    (nuisance,) = found.nuisances
    assert nuisance.name == "zero of pull 1 (warp.csv)" and nuisance.unit == "m"
    assert abs(nuisance.value - zero) < 2 * nuisance.standard_error < 3e-4
    assert found.values[0] == pytest.approx(1.03 * STIFF, rel=0.02)
    assert found.standard_errors[0] == pytest.approx(SPECIMEN, rel=0.1)
    (fit,) = fits([pull], found.fabric)
    assert fit.errors < 0.3 and "at rest at an extension of" in fit.words


@pytest.mark.slow(group="study")
def test_a_straight_line_under_pretension_is_as_stiff_as_without():
    """The law is no straight line: it fits both alike."""
    pulls = [Pull.make(D, straight(D + before), SIZE) for before in (0.0, 0.0025)]
    free, under = (estimate([pull], on_cloth(0.25)).values[0] for pull in pulls)
    assert under == pytest.approx(free, rel=0.1) and free == pytest.approx(6281, rel=0.1)
