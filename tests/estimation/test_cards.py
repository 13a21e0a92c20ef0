"""Fabric cards: exact, with provenance, and with errors that name file and key."""

import copy
import dataclasses
import json
from typing import Any

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from hypothesis import given

from r2s.estimation import cards
from r2s.estimation.cards import Card, Provenance
from r2s.estimation.estimate import (
    Agreement,
    Contradiction,
    Estimate,
    Fit,
    Misfit,
    Nuisance,
    as_json,
    from_json,
    point_estimate,
)
from r2s.materials import presets
from r2s.materials.bending import HingeBending
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import OrthotropicSpace
from r2s.materials.plate import OrthotropicPlate
from r2s.materials.tables import TableBending, TableMembrane
from r2s.recordings.recording import (
    RecordingInfo,
    SheetPlacement,
    load,
    make_recording,
    save,
)

MEASURED = Provenance(method="measured", version="1.0", date="2026-01-31", assumed=("damping",))
FAMILY = OrthotropicSpace.make(0.2)


def estimate_at(place, deviations, loss=1e-6) -> Estimate:
    place = jnp.asarray(place, float)
    dim = FAMILY.dim
    correlation = np.eye(dim)
    correlation[0, 1] = correlation[1, 0] = -0.999999
    history = np.ones((3, 2)), np.ones((3, 2, dim))
    return dataclasses.replace(
        point_estimate("diffcloud", FAMILY, place, loss, *history, 1.5, converged=True),
        standard_errors=np.asarray(deviations, float),
        correlation=correlation,
        nuisances=(Nuisance("shift x", "m", 0.001, np.nan),),
    )


def same(one, other) -> bool:
    alike = jax.tree.structure(one) == jax.tree.structure(other)
    leaves = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return alike and all(np.array_equal(a, b, equal_nan=True) for a, b in leaves)


positive = st.floats(1e-12, 1e9, allow_subnormal=False)


@given(
    st.lists(positive, min_size=7, max_size=7), st.floats(-0.99, 0.99), st.sampled_from([32, 64])
)
def test_a_fabric_comes_back_bit_by_bit(tmp_path_factory, numbers, coupling, bits):
    c11, c22, c33, density, bending, damping, thickness = numbers
    c12 = coupling * float(np.sqrt(c11) * np.sqrt(c22))
    density = min(density, 20.0)  # kg/m^2: more is refused
    fabric = Fabric.make(density, (c11, c12, c22, c33), bending, damping, 0.5, thickness)
    kind = np.float32 if bits == 32 else np.float64
    fabric = jax.tree.map(lambda leaf: leaf.astype(kind), fabric)
    path = tmp_path_factory.mktemp("cards") / "card.json"
    card = Card.make("any", fabric, MEASURED)
    cards.write(path, card)
    again = cards.read(path)
    assert again == card
    back = jax.tree.map(lambda leaf: leaf.astype(kind), again.fabric)
    assert same(back, fabric) and again.precision == f"float{bits}"


def test_double_precision_survives_where_jax_has_single(tmp_path):
    fabric = Fabric.make(0.1234567890123456, (100.0, 1.0, 1 / 3 * 100, 10.0), 1e-5)
    first, second = tmp_path / "a.json", tmp_path / "b.json"
    cards.write(first, Card.make("any", fabric, MEASURED))
    with jax.enable_x64(False):
        card = cards.read(first)
        assert card.fabric.density.dtype == jnp.float32
        cards.write(second, card)
    assert first.read_text() == second.read_text()


LAWS = {
    "hinges": {"bending": HingeBending(jnp.asarray(1e-5))},
    "orthotropic plate": {"bending": OrthotropicPlate(*map(jnp.asarray, (1e-5, 2e-5, 3e-5)))},
    "tables": {
        "membrane": TableMembrane(jnp.arange(24.0).reshape(6, 4) + 1),
        "bending": TableBending(jnp.arange(15.0).reshape(3, 5) / 3),
    },
}


@pytest.mark.parametrize("name", LAWS)
def test_every_law_comes_back(name):
    fabric = dataclasses.replace(presets.black_denim(), **LAWS[name])
    card = Card.make("any", fabric, MEASURED)
    stored = json.loads(json.dumps(cards.as_json(card), allow_nan=False))
    assert same(cards.from_json(stored).fabric, fabric)


def test_a_law_of_ones_own_and_a_batch_are_refused():
    class Own(eqx.Module):
        stiffness: jax.Array

    fabric = presets.black_denim()
    own = dataclasses.replace(fabric, membrane=Own(jnp.asarray(1.0)))
    with pytest.raises(TypeError, match="membrane law of r2s .OrthotropicMembrane.*got Own"):
        Card.make("own", own, MEASURED)
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), fabric)
    with pytest.raises(ValueError, match=r"one fabric, got a batch of shape \(3,\)"):
        Card.make("batch", batch, MEASURED)
    endless = dataclasses.replace(fabric, damping=jnp.asarray(jnp.inf))
    with pytest.raises(ValueError, match="fabric: damping: value: .*finite numbers, found inf"):
        Card.make("endless", endless, MEASURED)


@pytest.mark.slow(group="estimates")
@given(
    st.lists(st.floats(0, 1), min_size=7, max_size=7),
    st.lists(st.one_of(st.just(float("nan")), st.floats(1e-6, 10)), min_size=7, max_size=7),
)
def test_an_estimate_comes_back_without_its_history(place, deviations):
    found = estimate_at(place, deviations)
    card = Card.make("denim", found, MEASURED)
    again = cards.from_json(json.loads(json.dumps(cards.as_json(card), allow_nan=False)))
    assert again == card
    back = again.estimate
    assert back is not None and same(back.fabric, found.fabric) and not back.history.size
    np.testing.assert_array_equal(back.standard_errors, found.standard_errors)
    np.testing.assert_array_equal(back.correlation, found.correlation)
    np.testing.assert_array_equal(back.values, found.values)
    assert back.ranges == found.ranges


def test_an_estimate_in_single_precision_comes_back():
    """As estimates are by default: JSON knows no NumPy numbers."""
    one: Any = np.float32(0.5)
    wide = estimate_at(np.full(FAMILY.dim, 0.5), np.full(FAMILY.dim, 0.25), loss=0.5)
    single = dataclasses.replace(
        wide,
        values=wide.values.astype(np.float32),
        standard_errors=wide.standard_errors.astype(np.float32),
        correlation=wide.correlation.astype(np.float32),
        mesh_bias=np.full(FAMILY.dim, one),
        loss=one,
        losses=wide.losses.astype(np.float32),
        nuisances=(Nuisance("shift x", "m", one, one * np.nan),),
        fits=(Fit("lift", one, one, one, one * np.nan),),
        misfits=(Misfit(0, "force", one, ""),),
        shares=(one, one),
        agreement=Agreement(one, (1, 2), Contradiction(1, "warp", one, (one, one)), (one, one)),
    )
    text = json.dumps(as_json(single), allow_nan=False)
    read = from_json(json.loads(text))
    np.testing.assert_array_equal(read.values, single.values)
    assert read.agreement == single.agreement and read.misfits == single.misfits
    assert read.fits[0].distance == 0.5 and np.isnan(read.fits[0].mesh)


def test_what_is_not_determined_is_on_the_card_with_units():
    found = estimate_at([0.5] * 7, [0.2, 0.2, 0.01, 0.01, np.nan, 1.0, 0.01], loss=float("nan"))
    stored = cards.as_json(Card.make("denim", found, MEASURED))["estimate"]
    warp, bending = stored["parameters"]["warp"], stored["parameters"]["bending"]
    assert warp["unit"] == "N/m" and bending["standard_error"] is None
    assert bending["interval_90"] == [None, None] and bending["posterior_over_prior"] is None
    low, high = warp["interval_90"]
    assert high / low == pytest.approx(np.exp(2 * 1.645 * 0.2))
    assert stored["loss"] is None and "history" not in stored


def test_the_presets_have_cards_with_their_source():
    for name, make in presets.MEASURED.items():
        card = cards.preset(name)
        assert same(card.fabric, make()) and card.estimate is None
        assert "2011" in card.provenance.source and "friction" in card.provenance.assumed
        assert card.provenance.version and not card.provenance.date
    with pytest.raises(ValueError, match="no preset 'felt'; there are camel_ponte_roma"):
        cards.preset("felt")


def changed(path: tuple, value) -> dict:
    stored = copy.deepcopy(cards.as_json(cards.preset("black_denim")))
    place = stored
    for key in path[:-1]:
        place = place[key]
    if value is ...:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    return stored


WRONG = {
    "another format": (
        ("format",),
        "r2s-card/9",
        r"format must be 'r2s-card/2', found 'r2s-card/9'",
    ),
    "no fabric": (("fabric",), ..., r"missing: fabric"),
    "no density": (("fabric", "density"), ..., r"fabric: missing: density"),
    "no unit": (("fabric", "density", "unit"), ..., r"fabric: density: missing: unit"),
    "grams": (("fabric", "density", "unit"), "g/m^2", r"density: unit: expected 'kg/m\^2', found"),
    "text": (("fabric", "density", "value"), "0.2", r"density: value: expected a number, or null"),
    "negative": (("fabric", "density", "value"), -1.0, r"density must be positive \[kg/m\^2\]"),
    "no stiffness": (("fabric", "membrane", "c11"), ..., r"fabric: membrane: missing: c11"),
    "no such law": (("fabric", "bending", "law"), "Felt", r"bending: law: expected one of Plate"),
    "other key": (("fabric", "colour"), "grey", r"fabric: unknown: colour; known: density"),
    "no method": (("provenance", "method"), ..., r"provenance: missing: method"),
    "assumed": (("provenance", "assumed"), ["hue"], r"assumed: expected some of bending"),
    "half an estimate": (("estimate",), {"format": "r2s-estimate/3"}, r"estimate: missing: param"),
}


@pytest.mark.parametrize("case", WRONG)
def test_an_error_names_the_file_and_the_key(tmp_path, case):
    place, value, message = WRONG[case]
    path = tmp_path / "denim.json"
    path.write_text(json.dumps(changed(place, value)))
    with pytest.raises(ValueError, match=message) as error:
        cards.read(path)
    assert str(path) in str(error.value)


def test_no_card_at_all(tmp_path):
    with pytest.raises(OSError, match="absent.json"):
        cards.read(tmp_path / "absent.json")
    (tmp_path / "list.json").write_text("[1]")
    with pytest.raises(ValueError, match="list.json: no fabric card: format must be"):
        cards.read(tmp_path / "list.json")
    (tmp_path / "broken.json").write_text("{")
    with pytest.raises(ValueError, match="broken.json"):
        cards.read(tmp_path / "broken.json")


def test_a_changed_fabric_is_no_longer_the_estimate():
    stored = cards.as_json(Card.make("denim", estimate_at([0.5] * 7, [0.1] * 7), MEASURED))
    stored = copy.deepcopy(stored)
    stored["fabric"]["density"]["value"] = 0.3
    with pytest.raises(ValueError, match="estimate: its fabric has other numbers"):
        cards.from_json(stored)
    assert cards.from_json({**stored, "estimate": None}).fabric.density == 0.3


def test_a_fingerprint_is_of_the_data_not_of_the_precision(tmp_path):
    sheet = SheetPlacement(
        (0.3, 0.3), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), ("origin",)
    )
    info = RecordingInfo("lift", "lifting", "denim", "1", "made", (0, 1), sheet, 0.0, None)
    points = np.asarray(jr.uniform(jr.key(0), (2, 5, 3), float))
    recording = make_recording(list(points), [0, 1], np.zeros((2, 3)), [0, 1], info)
    first = cards.fingerprint(recording)
    save(recording, tmp_path / "lift.npz")
    with jax.enable_x64(False):
        assert cards.fingerprint(load(tmp_path / "lift.npz")) == first
    moved = eqx.tree_at(lambda r: r.points, recording, recording.points + 1e-3)
    assert cards.fingerprint(moved) != first
    renamed = dataclasses.replace(recording, info=dataclasses.replace(info, name="fold"))
    assert cards.fingerprint(renamed) != first
