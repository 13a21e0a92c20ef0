"""What error a mesh leaves in a fabric's motion, and which mesh is fine enough."""

import csv

import equinox as eqx
import numpy as np
import pytest
from folders import ROOT
from scipy.stats import gmean

from r2s.materials import presets
from r2s.materials.fabric import bending_length
from r2s.scenarios import resolution
from r2s.scenarios.resolution import (
    ENOUGH,
    LADDER,
    TABLE,
    ladder,
    matching_shape,
    mesh_error,
    shape_for,
)
from r2s.scenarios.standard import SIDE

SIZE = (SIDE, SIDE)


def with_bending(fabric, factor: float):
    return eqx.tree_at(lambda f: f.bending.stiffness, fabric, factor * fabric.bending.stiffness)


@pytest.mark.parametrize("motion", TABLE)
def test_errors_are_those_of_the_table_where_it_has_an_entry(motion):
    knit = presets.grey_interlock()
    for ratio, error in TABLE[motion]:
        # cells of a ninth of the sheet that are so many fold lengths long
        bending = (SIDE / 8 / ratio / float(bending_length(knit))) ** 3
        assert mesh_error(with_bending(knit, bending), SIZE, (9, 9), motion) == pytest.approx(
            error, rel=1e-4
        )


@pytest.mark.parametrize("name", presets.FIVE)
def test_the_chosen_mesh_is_the_coarsest_that_is_fine_enough(name):
    fabric = presets.FIVE[name]()
    for motion in TABLE:
        shape = shape_for(fabric, SIZE, motion)
        place = LADDER.index(shape[0])
        errors = [mesh_error(fabric, SIZE, (n, n), motion) for n in LADDER]
        assert all(error > ENOUGH for error in errors[:place])
        assert errors[place] <= ENOUGH or shape[0] == LADDER[-1]


def test_a_warning_has_the_figures_and_says_what_to_take():
    knit = presets.grey_interlock()
    text = resolution.warning(knit, SIZE, (5, 5), "folding")
    finer = shape_for(knit, SIZE, "folding")
    for part in ("5 x 5", "folds at 14 mm", "112 mm long", f"try {finer[0]} x {finer[1]}"):
        assert part in text
    assert not resolution.warning(with_bending(knit, 1e6), SIZE, (9, 9), "folding")


def test_the_table_is_that_of_the_experiment():
    """Geometric means over fabrics, and the error that is left at 17 and 33 vertices a side."""
    path = ROOT / "docs/results/mesh_error_by_fabric.csv"
    text = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(text))
    lengths = {name: float(bending_length(make())) for name, make in presets.FIVE.items()}
    assert {row["motion"] for row in rows} == set(TABLE)
    for motion, table in TABLE.items():
        mine = [row for row in rows if row["motion"] == motion]
        assert {row["fabric"] for row in mine} == set(presets.FIVE)
        mean = {n: 1e-3 * gmean([float(row[n]) for row in mine]) for n in ("9", "17")}
        left = mean["17"] / (2**resolution.ORDER - 1)
        expected = left, mean["17"] + left, mean["9"] + left
        np.testing.assert_allclose([error for _, error in table], expected, rtol=0.05)
        cells = SIDE / (np.array([33, 17, 9]) - 1) / gmean(list(lengths.values()))
        np.testing.assert_allclose([ratio for ratio, _ in table], cells, rtol=0.01)


def test_a_taut_sheet_needs_no_finer_mesh_and_has_no_figure():
    knit = presets.grey_interlock()
    assert np.isnan(mesh_error(knit, SIZE, (9, 9), "stretching"))
    assert shape_for(knit, SIZE, "stretching") == (LADDER[0], LADDER[0])
    assert not resolution.warning(knit, SIZE, (5, 5), "stretching")
    # a motion that was not measured has the largest error
    largest = max(mesh_error(knit, SIZE, (9, 9), motion) for motion in TABLE)
    assert mesh_error(knit, SIZE, (9, 9), "wringing") == largest


def test_another_sheet_has_the_mesh_of_the_same_step():
    strip, square = (0.4, 0.1), (0.45, 0.45)
    assert ladder(strip) == [(9, 3), (17, 5), (33, 9)]  # square cells
    assert matching_shape((17, 5), square) == (17, 17) and matching_shape((17, 17), strip) == (
        17,
        5,
    )
    assert matching_shape((12, 12), square) == (12, 12)  # a mesh of no step
