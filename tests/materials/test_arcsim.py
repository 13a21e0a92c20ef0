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
from r2s.materials.stiffening import SofteningPlate
from r2s.materials.tables import TableMembrane

CONTENT = {
    "density": 0.2,
    "stretching": [[100.0 + row, -20.1, 80.0 + row / 3, 30.0 - 9 * row] for row in range(6)],
    "bending": [[1e-5 * (1 + row + column / 7) for column in range(5)] for row in range(3)],
}
CONSTANT = Fabric.make(0.2, (300.0, 60.0, 200.0, 80.0), 2e-5)


@pytest.fixture
def file(tmp_path):
    """A function that writes content, with changes, as a material file."""

    def write(**changes):
        path = tmp_path / "cloth.json"
        content = {**CONTENT, **changes}
        path.write_text(json.dumps({k: v for k, v in content.items() if v is not ...}))
        return path

    return write


def test_a_file_is_read_as_it_is(file):
    fabric = read_material(file(), damping=0.02, thickness=2e-3)
    assert fabric.density == 0.2
    assert np.all(np.asarray(fabric.membrane.stiffness) == np.array(CONTENT["stretching"]))
    assert np.all(np.asarray(fabric.bending.stiffness) == np.array(CONTENT["bending"]))
    given = fabric.damping, fabric.friction, fabric.thickness, fabric.mass_damping
    assert given == (0.02, 0.5, 2e-3, 0.0)


@pytest.mark.parametrize("is_double", [False, True])
def test_a_round_trip_changes_no_bit(file, tmp_path, is_double):
    with jax.enable_x64(is_double):
        fabric = read_material(file())
        path = tmp_path / "again.json"
        write_material(path, fabric, "a name")
        again = read_material(path)
    assert json.loads(path.read_text())["name"] == "a name"
    assert jax.tree.structure(fabric) == jax.tree.structure(again)
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
    again = read_material(path).bending
    for direction, expected in zip((0.0, np.pi / 4, np.pi / 2), stiffness, strict=True):
        found = again.at(jnp.array(direction), jnp.array(8.0)).stiffness
        assert found == pytest.approx(float(expected), rel=1e-12)


WRONG = {
    "density missing": ({"density": ...}, r"density is unknown.*kg/m\^2"),
    "density zero": ({"density": 0}, r"density must be above 0 kg/m\^2, got 0"),
    "density text": ({"density": "0.2"}, r"density: expected a finite number, found '0.2'"),
    "density infinite": ({"density": float("inf")}, r"density: expected a finite number"),
    "no stretching": ({"stretching": ...}, r"stretching is unknown.*6 rows.*N/m"),
    "five rows": ({"stretching": CONTENT["stretching"][:5]}, r"stretching: expected 6 entries"),
    "short row": ({"stretching": [[1.0, 0.0, 1.0]] * 6}, r"stretching\[0\]: expected 4 entries"),
    "negative": (
        {"stretching": [[1.0, 0.0, 1.0, 1.0]] * 5 + [[1.0, 0.0, -2.0, 1.0]]},
        r"stretching\[5\]: C11 and C22 must be above 0 N/m, got 1.0 and -2.0",
    ),
    "bending square": ({"bending": [[1e-5] * 3] * 3}, r"bending\[0\]: expected 5 entries"),
    "bending negative": (
        {"bending": [[1e-5] * 5, [1e-5] * 5, [-1e-5] * 5]},
        r"bending\[2\]: stiffness must not be below 0 N m, got -1e-05",
    ),
    "other key": ({"youngs": 1.0}, r"unknown: youngs; known: density, stretching, bending"),
}


@pytest.mark.parametrize("case", WRONG)
def test_an_error_names_the_file_the_key_and_what_was_expected(file, case):
    changes, message = WRONG[case]
    path = file(**changes)
    with pytest.raises(ValueError, match=message) as error:
        read_material(path)
    assert str(path) in str(error.value)


def test_a_file_that_is_no_json_or_missing_is_named(tmp_path):
    path = tmp_path / "broken.json"
    path.write_text("{")
    with pytest.raises(ValueError, match="broken.json: no JSON"):
        read_material(path)
    with pytest.raises(OSError, match="absent.json"):
        read_material(tmp_path / "absent.json")


@pytest.mark.parametrize("given", [{"damping": -1.0}, {"thickness": 0.0}, {"friction": -0.1}])
def test_what_the_file_does_not_know_is_checked(file, given):
    with pytest.raises(ValueError, match=r"damping \[s\], friction.*thickness \[m\]"):
        read_material(file(), **given)


UNWRITABLE = {
    "springs": (
        {"membrane": SpringMembrane(*jnp.ones(3))},
        TypeError,
        "SpringMembrane",
    ),
    "softening": (
        {"bending": SofteningPlate(CONSTANT.bending, jnp.asarray(0.3), jnp.asarray(9.0))},
        TypeError,
        "SofteningPlate",
    ),
    "batch of tables": (
        {"membrane": TableMembrane(jnp.ones((2, 6, 4)))},
        ValueError,
        r"expected a table of shape \(6, 4\), got \(2, 6, 4\)",
    ),
    "weightless": ({"density": jnp.zeros(())}, ValueError, r"cannot write .*density"),
    "NaN": ({"bending": HingeBending(jnp.asarray(jnp.nan))}, ValueError, r"cannot write .*bending"),
}


@pytest.mark.parametrize("case", UNWRITABLE)
def test_what_a_file_cannot_hold_is_refused(tmp_path, case):
    changes, error, message = UNWRITABLE[case]
    path = tmp_path / "refused.json"
    with pytest.raises(error, match=message):
        write_material(path, dataclasses.replace(CONSTANT, **changes))
    assert not path.exists()


def test_a_batch_of_fabrics_is_refused(tmp_path):
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), CONSTANT)
    with pytest.raises(ValueError, match=r"one fabric, got a batch of shape \(3,\)"):
        write_material(tmp_path / "batch.json", batch)


def test_diffsim_has_no_negative_coupling(tmp_path):
    fabric = Fabric.make(0.2, (300.0, -60.0, 200.0, 80.0), 2e-5)
    with pytest.raises(ValueError, match="DiffSim takes a negative C12 for 0, got -60.0 N/m"):
        write_material(tmp_path / "negative.json", fabric, diffsim=True)
    write_material(tmp_path / "plain.json", fabric)
    found = read_material(tmp_path / "plain.json").membrane.at(jnp.zeros(3))
    assert found.c12 == fabric.membrane.c12
