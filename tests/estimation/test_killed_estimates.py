"""An estimate of a study that was killed goes on where it was."""

import jax.numpy as jnp
import numpy as np
import pytest

from r2s.estimation.estimate import point_estimate
from r2s.estimation.method import Method, default_space
from r2s.study import estimates
from r2s.study import plan as plans

NOTHING = point_estimate(
    "none",
    default_space("cloth", 0.2),
    jnp.full(7, 0.5),
    0.0,
    np.zeros((1, 1)),
    np.zeros((1, 1, 7)),
    0.0,
)


@pytest.fixture
def cell():
    plan = plans.with_changes(plans.SMALL, ["diffcloud-cloth-lifting"], ["grey_interlock"])
    return next(each.estimate for each in plans.synthetic(plan) if each.estimate is not None)


def test_an_estimate_that_was_killed_goes_on_from_its_checkpoint(cell, tmp_path, monkeypatch):
    found = []

    def estimate(method, recordings, space, budget, *, key):
        found.append(method.checkpoint.exists())
        method.checkpoint.parent.mkdir(parents=True, exist_ok=True)
        method.checkpoint.write_bytes(b"half")
        if len(found) == 1:
            raise KeyboardInterrupt
        return NOTHING

    monkeypatch.setattr(Method, "estimate", estimate)
    with pytest.raises(KeyboardInterrupt):
        cell._estimated([], None, tmp_path)
    assert cell.begun(tmp_path).exists()
    assert cell._estimated([], None, tmp_path) is NOTHING
    assert found == [False, True] and not cell.begun(tmp_path).exists()


def test_another_source_or_processor_begins_anew(cell, tmp_path, monkeypatch):
    here = cell.begun(tmp_path)
    for name in ("source_hash", "processor"):
        with monkeypatch.context() as patched:
            patched.setattr(estimates, name, lambda: "another")
            assert cell.begun(tmp_path) != here
    assert cell.begun(tmp_path) == here
