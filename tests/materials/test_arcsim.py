"""Material files: round trips, what a constant law becomes, and errors that say what is wrong."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r2s.materials.arcsim import read_material, write_material
from r2s.materials.bending import HingeBending
from r2s.materials.fabric import Fabric
from r2s.materials.membrane import SpringMembrane
from r2s.materials.plate import OrthotropicPlate
from r2s.materials.tables import TableMembrane

CONTENT = {
    "density": 0.2,
    "stretching": [[100.0 + row, -20.1, 80.0 + row / 3, 30.0 - 9 * row] for row in range(6)],
    "bending": [[1e-5 * (1 + row + column / 7) for column in range(5)] for row in range(3)],
}
CONSTANT = Fabric.make(0.2, (300.0, 60.0, 200.0, 80.0), 2e-5)


TABLES = {"stretching": "membrane", "bending": "bending"}
SPRINGS = SpringMembrane(*jnp.ones(3))


@pytest.fixture
def file(tmp_path):
    """A function that writes content, with changes, as a material file."""

    def write(**changes):
        path = tmp_path / "cloth.json"
        content = {**CONTENT, **changes}
        path.write_text(json.dumps({k: v for k, v in content.items() if v is not ...}))
        return path

    return write


@pytest.mark.parametrize("is_double", [False, True])
def test_a_file_is_read_as_it_is_and_written_without_changing_a_bit(file, tmp_path, is_double):
    path = tmp_path / "again.json"
    with jax.enable_x64(is_double):
        fabric = read_material(file(), damping=0.02)
        write_material(path, fabric, "a name")
        again = read_material(path, damping=0.02)
    for key, law in TABLES.items():
        np.testing.assert_allclose(getattr(fabric, law).stiffness, CONTENT[key], rtol=1e-6)
    assert (float(fabric.friction), float(fabric.mass_damping)) == (0.5, 0.0)
    assert json.loads(path.read_text())["name"] == "a name"
    assert all(jax.tree.leaves(jax.tree.map(lambda a, b: bool(jnp.all(a == b)), fabric, again)))


@pytest.mark.parametrize("diffsim", [False, True])
def test_a_constant_law_is_a_table_of_equal_rows_as_published(tmp_path, diffsim):
    path = tmp_path / "constant.json"
    write_material(path, CONSTANT, diffsim=diffsim)
    content = json.loads(path.read_text())
    # C33 acts on E12 there, and the bending stiffness is four times that of the hinge
    expected = np.array([300.0, 60.0, 200.0, 160.0]) / (2 if diffsim else 1)
    assert content["stretching"] == [expected.tolist()] * 6
    assert content["bending"] == [[8e-5] * 5] * 3
    hinge = read_material(path).bending.at(jnp.array(0.4), jnp.array(-13.0))
    assert hinge.stiffness == CONSTANT.bending.stiffness


def test_an_orthotropic_plate_keeps_its_directions(tmp_path):
    path, stiffness = tmp_path / "orthotropic.json", jnp.array([1e-5, 2e-5, 5e-5])
    write_material(path, dataclasses.replace(CONSTANT, bending=OrthotropicPlate(*stiffness)))
    bending = read_material(path).bending
    for direction, expected in zip((0.0, np.pi / 4, np.pi / 2), stiffness, strict=True):
        along = bending.at(jnp.array(direction), jnp.array(8.0)).stiffness
        assert along == pytest.approx(float(expected), rel=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"density": ...}, r"density is unknown.*kg/m\^2"),
        ({"density": 0}, r"density must be above 0 kg/m\^2, got 0"),
        ({"stretching": CONTENT["stretching"][:5]}, r"stretching: expected 6 entries"),
        (
            {"stretching": [[1.0, 0.0, 1.0, 1.0]] * 5 + [[1.0, 0.0, -2.0, 1.0]]},
            r"stretching\[5\]: C11 and C22 must be above 0 N/m, got 1.0 and -2.0",
        ),
        (
            {"bending": [[1e-5] * 5, [1e-5] * 5, [-1e-5] * 5]},
            r"bending\[2\]: stiffness must not be below 0 N m, got -1e-05",
        ),
        ({"youngs": 1.0}, r"unknown: youngs; known: density, stretching, bending"),
    ],
)
def test_an_error_names_the_file_the_key_and_what_was_expected(file, changes, message):
    path = file(**changes)
    with pytest.raises(ValueError, match=message) as error:
        read_material(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("comment", ["// warp first", "/* two\nlines // */", "// [\n// {", ""])
def test_comments_and_marks_of_other_programs_are_skipped(file, comment):
    path = file(name="https://a.b/*c*/")
    text = path.read_text().replace('"stretching"', f'{comment}\n"stretching"')
    path.write_text(f"\ufeff{comment}\n{text} {comment}\n", encoding="utf-8")
    assert float(read_material(path).density) == pytest.approx(0.2)
    path.write_text(f"{comment}\n{text},", encoding="utf-8")
    with pytest.raises(ValueError, match=f"line {2 + 2 * comment.count(chr(10)) + 1} column"):
        read_material(path)


@pytest.mark.parametrize("given", [{"damping": -1.0}, {"thickness": 0.0}, {"friction": -0.1}])
def test_numbers_beside_the_file_are_checked(file, given):
    (name,) = given
    with pytest.raises(ValueError, match=f"{name} must be"):
        read_material(file(), **given)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"membrane": SPRINGS}, TypeError, "SpringMembrane"),
        ({"membrane": TableMembrane(jnp.ones((2, 6, 4)))}, ValueError, "stretching: expected 6"),
        ({"density": jnp.ones(3)}, ValueError, r"one fabric, got a batch of shape \(3,\)"),
        ({"density": jnp.zeros(())}, ValueError, "cannot write .*density"),
        ({"bending": HingeBending(jnp.asarray(jnp.nan))}, ValueError, "cannot write .*bending"),
    ],
)
def test_what_a_file_cannot_hold_is_refused(tmp_path, unchecked, changes, error, message):
    path = tmp_path / "refused.json"
    with pytest.raises(error, match=message):
        write_material(path, dataclasses.replace(CONSTANT, **changes))
    assert not path.exists()


def test_diffsim_has_no_negative_coupling(tmp_path):
    fabric = Fabric.make(0.2, (300.0, -60.0, 200.0, 80.0), 2e-5)
    with pytest.raises(ValueError, match="DiffSim takes a negative C12 for 0, got -60.0 N/m"):
        write_material(tmp_path / "negative.json", fabric, diffsim=True)
