"""A search by emulated answers: it finds a target, and goes on as if it had never stopped."""

import numpy as np
import pytest

pytest.importorskip("sklearn")

from r2s.estimation.physnet import bayes, emulator  # noqa: E402

TRUTH = np.array([0.3, 0.7, 0.55])


def respond(places):
    """Twelve smooth answers, that tell all three numbers."""
    phases = np.arange(12)[None]
    waves = [np.sin(2 * places[:, [axis]] + phases * (axis + 1)) for axis in range(3)]
    return waves[0] + waves[1] + 0.5 * waves[2] + places[:, [0]] * places[:, [1]]


TARGET = respond(TRUTH[None])[0]


def test_the_target_is_found_where_losses_alone_do_not_find_it():
    found = emulator.minimise(respond, TARGET, 3, num_calls=24, seed=1)

    def by_losses(places):
        return np.sqrt(((respond(places) - TARGET) ** 2).mean(axis=1))

    alone = bayes.minimise(by_losses, 3, num_calls=24, seed=1)
    assert np.abs(found.places[-1] - TRUTH).max() < 0.02
    assert found.losses(TARGET)[-1] < alone.losses.min() / 2


def test_a_flawed_target_is_not_followed_beyond_its_flaws():
    flawed = TARGET + 0.1 * np.random.default_rng(0).standard_normal(12)
    found = emulator.minimise(respond, flawed, 3, num_calls=24, seed=1)
    assert np.abs(found.places[-1] - TRUTH).max() < 0.15


def test_goes_on_as_if_it_had_never_stopped(tmp_path):
    path = tmp_path / "trials.npz"
    whole = emulator.minimise(respond, TARGET, 3, num_calls=15, seed=2)

    class Stopped(Exception):
        pass

    def stop(trials):
        if len(trials.places) == 10:
            raise Stopped

    with pytest.raises(Stopped):
        emulator.minimise(respond, TARGET, 3, num_calls=15, seed=2, path=path, progress=stop)
    resumed = emulator.minimise(respond, TARGET, 3, num_calls=15, seed=2, path=path)
    np.testing.assert_array_equal(resumed.places, whole.places)
    with pytest.raises(ValueError, match="seed 2 there, 3 asked"):
        emulator.minimise(respond, TARGET, 3, num_calls=15, seed=3, path=path)
    path.write_bytes(b"torn")
    with pytest.raises(ValueError, match="trials.npz is no checkpoint"):
        emulator.minimise(respond, TARGET, 3, num_calls=15, seed=2, path=path)


def test_what_fails_is_left_out_and_too_few_calls_are_refused():
    def fails(places):
        return np.where(places[:, [0]] > 0.8, np.nan, respond(places))

    found = emulator.minimise(fails, TARGET, 3, num_calls=24, seed=0)
    assert np.isnan(found.answers).any()
    assert np.abs(found.places[-1] - TRUTH).max() < 0.05
    with pytest.raises(RuntimeError, match="all 9 calls failed"):
        emulator.minimise(lambda places: respond(places) * np.nan, TARGET, 3, num_calls=24)
    with pytest.raises(ValueError, match="at least 5 calls in 3 dimensions, got 4"):
        emulator.minimise(respond, TARGET, 3, num_calls=4)
