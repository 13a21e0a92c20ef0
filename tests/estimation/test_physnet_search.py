"""Searches of the unit cube: they find a target, survive failures, and continue from their file."""

import numpy as np
import pytest

pytest.importorskip("skopt")
pytest.importorskip("sklearn")

from r2s.estimation.physnet import search  # noqa: E402

TRUTH = np.array([0.3, 0.7, 0.55])


def respond(places):
    """Twelve smooth answers, which determine all three numbers."""
    phases = np.arange(12)[None]
    waves = [np.sin(2 * places[:, [axis]] + phases * (axis + 1)) for axis in range(3)]
    return waves[0] + waves[1] + 0.5 * waves[2] + places[:, [0]] * places[:, [1]]


TARGET = respond(TRUTH[None])[0]


@pytest.fixture(autouse=True)
def few_calls(monkeypatch):
    monkeypatch.setattr(search, "FIRST_CALLS", 8)


def searched(answer=respond, target=TARGET, *, calls=24, seed=1, **options):
    return search.search(answer, target, 3, num_calls=calls, seed=seed, **options)


@pytest.mark.slow(group="physnet")
def test_answers_find_what_losses_alone_do_not_and_losses_what_chance_does_not():
    found, by_losses = searched(), searched(published=True)
    random = respond(np.random.default_rng(1).random((24, 3))) - TARGET
    assert np.abs(found.places[-1] - TRUTH).max() < 0.02
    assert found.losses[-1] < by_losses.losses.min() / 2
    assert by_losses.losses.min() < np.sqrt((random**2).mean(axis=1)).min()


def test_a_flawed_target_is_not_followed_beyond_its_flaws():
    flawed = TARGET + 0.1 * np.random.default_rng(0).standard_normal(12)
    found = searched(target=flawed)
    assert np.abs(found.places[-1] - TRUTH).max() < 0.15


@pytest.mark.slow(group="physnet")
@pytest.mark.parametrize("published", [False, True])
def test_a_search_continues_from_its_file_as_if_uninterrupted(published, tmp_path):
    options = {"published": published, "calls": 15}
    whole, options["path"] = searched(**options), tmp_path / "trials.npz"

    class Stopped(Exception):
        pass

    def stop(calls, loss):
        if calls >= 10:
            raise Stopped

    with pytest.raises(Stopped):
        searched(progress=stop, **options)
    resumed = searched(**options)
    np.testing.assert_array_equal(resumed.places, whole.places)
    with pytest.raises(ValueError, match="seed 1 there, 3 asked"):
        searched(**options | {"seed": 3})


@pytest.mark.slow(group="physnet")
def test_calls_that_fail_are_left_out_and_avoided():
    def fails(places):
        return np.where(places[:, [0]] > 0.5, np.nan, respond(places))

    found = searched(fails, seed=0)
    assert np.isnan(found.losses[:9]).sum() >= 3
    assert np.abs(found.places[-1] - TRUTH).max() < 0.05
    optimum = searched(fails, calls=16, seed=0, published=True)
    assert np.isnan(optimum.losses[8:]).mean() < 0.4
    with pytest.raises(RuntimeError, match="all 9 calls failed"):
        searched(lambda places: respond(places) * np.nan)
    with pytest.raises(ValueError, match="at least 5 calls"):
        searched(calls=4)
