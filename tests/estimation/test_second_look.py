"""A search that others from elsewhere confirm, or do not."""

import dataclasses

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s.estimation import second_look
from r2s.estimation.descent import DEFAULT, Search
from r2s.estimation.estimate import as_json, describe, from_json
from r2s.estimation.gauss_newton import Descent, Normal
from r2s.estimation.mesh_refinement import ALIKE, LIKELY, look_again
from r2s.materials.parameters import IsotropicSpace

SPACE = IsotropicSpace.make(0.2)


class Problem:
    """What a look asks of a problem."""

    space = SPACE


def ended(place: float, scale: float = 6e-3) -> Search:
    """A search that ended with both numbers at a place."""
    none, size = jnp.zeros(()), SPACE.dim
    theta, square = jnp.full(size, place), jnp.eye(size)
    normal = Normal(none, none, none, theta, square, square)
    row = [Descent(theta, normal, none, none, jnp.asarray(scale), jnp.zeros((), int))]
    return Search((Problem(),), [row], 1.0, lambda _, theta, __: [(theta, None)])  # pyright: ignore


def looked(monkeypatch, first: Search, *others: Search | None, losses):
    """The look at a first end, where other searches end at others (None: they diverge)."""
    left, starts, scales = iter(others), [], []

    def search(problems, budget, *, start, **_):
        assert budget.starts == 1 and not budget.coarse and budget.near != budget.leads_on
        starts.append(np.asarray(start))
        found = next(left)
        if found is None:
            raise RuntimeError("all starts of the descents diverged")
        return found

    def loss(_, predicted, scale):
        scales.append(float(scale))
        return losses(float(predicted[0][0]))

    monkeypatch.setattr(second_look, "search", search)
    monkeypatch.setattr(second_look, "loss_from", loss)
    return look_again(first, DEFAULT, key=jr.key(0)), starts, scales


def test_two_searches_that_end_alike_are_enough(monkeypatch):
    near = 0.6 * (1 + 0.9 * (ALIKE - 1))
    found, starts, _ = looked(monkeypatch, ended(0.6), ended(near), losses=lambda at: at)
    assert found.reached == (2, 2) and found.seconds == 2.0
    assert float(found.theta[0]) == pytest.approx(0.6)
    assert [float(each[0]) for each in found.others] == pytest.approx([near])  # in its errors
    assert np.max(np.abs(starts[0] - SPACE.prior()[0])) > 0.01  # a draw of the prior


def test_where_two_differ_the_best_of_three_is_taken_and_counted(monkeypatch):
    ends = ended(0.6), ended(0.3), ended(0.3), ended(0.301)  # the last goes on to the end
    found, starts, _ = looked(monkeypatch, *ends, losses=lambda at: at)
    assert found.reached == (2, 3) and not found.unsure
    assert float(found.theta[0]) == pytest.approx(0.301)
    assert np.max(np.abs(starts[1] - starts[0])) > 0.01  # not from the same place again


def test_a_search_that_no_other_confirms_is_not_sure(monkeypatch):
    ends = ended(0.3), ended(0.6), None
    found, _, _ = looked(monkeypatch, *ends, losses=lambda at: at)
    assert found.reached == (1, 3) and float(found.theta[0]) == pytest.approx(0.3)
    assert found.unsure == "none of 2 searches from other starts fits as well"
    assert found.others == ()


def test_an_end_that_fits_nearly_as_well_is_in_the_errors_though_it_confirms_nothing(monkeypatch):
    ends = ended(0.3), ended(0.3 * 0.99 * LIKELY), ended(0.3 * 1.01 * LIKELY)
    found, *_ = looked(monkeypatch, *ends, losses=lambda at: at)
    assert found.reached == (1, 3)
    assert [float(each[0]) for each in found.others] == pytest.approx([0.297 * LIKELY])


def test_ends_are_compared_by_the_scale_of_the_best_fit(monkeypatch):
    ends = ended(0.6, 9e-3), ended(0.6, 7e-3)
    _, _, scales = looked(monkeypatch, *ends, losses=lambda at: at)
    np.testing.assert_allclose(scales, 7e-3)


@pytest.mark.parametrize(
    ("unsure", "words"),
    [("", "yes, 2 of 2 searches from different starts fit as well"), ("why", "no, not sure: why")],
)
def test_an_estimate_says_how_many_searches_ended_there(unsure, words, estimate_of_nothing):
    found = dataclasses.replace(
        estimate_of_nothing, reached=(2, 2), converged=not unsure, unsure=unsure
    )
    assert f"converged: {words}" in describe(found)
    again = from_json(as_json(found))
    assert again.reached == (2, 2) and again.unsure == unsure


@pytest.fixture
def estimate_of_nothing():
    from test_mesh_ladder import estimate_of_nothing

    return estimate_of_nothing()
