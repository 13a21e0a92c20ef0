"""Bayesian optimisation: better than chance, whole after failures and interruptions."""

import numpy as np
import pytest

from r2s.estimation.physnet import bayes

pytest.importorskip("skopt")
CENTRE = np.array([0.3, 0.8, 0.55])


def bowl(places):
    return np.sqrt(((places - CENTRE) ** 2).sum(axis=1))


def random_search(objective, dim, *, num_calls, seed):
    """The least loss of as many random places."""
    return objective(np.random.default_rng(seed).random((num_calls, dim))).min()


def test_finds_the_bottom_of_a_bowl_closer_than_random_search():
    found = bayes.minimise(bowl, 3, num_calls=20, batch=2, num_first=8, seed=1)
    assert len(found.losses) == 20
    assert found.losses[found.best] < 0.5 * random_search(bowl, 3, num_calls=20, seed=1)


def test_goes_on_from_a_file_with_the_same_places(tmp_path):
    whole = bayes.minimise(bowl, 3, num_calls=11, batch=3, num_first=8, seed=2)
    bayes.minimise(bowl, 3, num_calls=8, batch=3, num_first=8, seed=2, path=tmp_path / "h.npz")
    rest = []

    def rest_of(places):
        rest.extend(places)
        return bowl(places)

    resumed = bayes.minimise(
        rest_of, 3, num_calls=11, batch=3, num_first=8, seed=2, path=tmp_path / "h.npz"
    )
    assert len(rest) == 3
    np.testing.assert_array_equal(resumed.places, whole.places)
    np.testing.assert_array_equal(resumed.losses, whole.losses)


def test_a_failed_call_counts_as_the_worst_so_far():
    history = bayes.tell(bayes.begin(2), [[0.1, 0.2], [0.3, 0.4]], [np.nan, np.inf])
    assert history.failed.all()
    np.testing.assert_array_equal(history.penalised, bayes.UNKNOWN_PENALTY)
    history = bayes.tell(history, [[0.5, 0.6], [0.7, 0.8]], [3.0, 2.0])
    np.testing.assert_array_equal(history.penalised, [3, 3, 3, 2])
    assert history.best == 3
    with pytest.raises(RuntimeError, match="all 1 calls of the objective failed"):
        _ = bayes.tell(bayes.begin(1), [[0.5]], [np.nan]).best


def test_avoids_where_the_objective_fails():
    def fails(places):
        return np.where(places[:, 0] > 0.5, np.nan, bowl(places))

    found = bayes.minimise(fails, 3, num_calls=12, batch=4, num_first=8, seed=0)
    assert found.failed[:8].sum() >= 3
    assert found.failed[8:].mean() < 0.4
    assert found.losses[found.best] < 0.25


def test_settles_in_seven_dimensions():
    centre = np.array([0.2, 0.7, 0.45, 0.6, 0.3, 0.8, 0.5])
    weights = np.array([1.0, 1.0, 1.0, 0.1, 1.0, 0.1, 1.0])  # two hardly matter

    def wide(places):
        return np.sqrt((weights * (places - centre) ** 2).sum(axis=1) + 1e-3)

    found = bayes.minimise(wide, 7, num_calls=48, seed=0)
    error = np.abs(found.places[found.best] - centre)[weights == 1]
    assert error.max() < 0.1
    assert found.losses[found.best] < 0.5 * random_search(wide, 7, num_calls=48, seed=0)


def test_refuses_a_history_of_another_search(tmp_path):
    bayes.minimise(bowl, 3, num_calls=4, batch=2, num_first=8, seed=0, path=tmp_path / "h.npz")
    with pytest.raises(ValueError, match=r"h\.npz is of another run .seed 0 there, 1 asked"):
        bayes.minimise(bowl, 3, num_calls=4, batch=2, num_first=8, seed=1, path=tmp_path / "h.npz")
    (tmp_path / "h.npz").write_bytes(b"no archive")
    with pytest.raises(ValueError, match=r"h\.npz is no checkpoint"):
        bayes.minimise(bowl, 3, num_calls=4, batch=2, num_first=8, seed=0, path=tmp_path / "h.npz")


def test_refuses_losses_of_another_number_and_below_zero():
    with pytest.raises(ValueError, match="one loss for each of 2 places"):
        bayes.tell(bayes.begin(1), [[0.1], [0.2]], [1.0])
    with pytest.raises(ValueError, match="a loss is -2: expected none below 0"):
        bayes.tell(bayes.begin(1), [[0.1], [0.2]], [1.0, -2.0])


def test_losses_of_zero_and_places_that_repeat_can_be_gone_on_from():
    history = bayes.tell(bayes.begin(2), [[0.1, 0.2]] * 8, np.zeros(8))
    places = bayes.ask(history, 3, num_first=8)
    assert places.shape == (3, 2) and (places >= 0).all() and (places <= 1).all()
