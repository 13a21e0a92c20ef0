"""What pictures of a study are made of: which run, of which vertices, in which frame."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_study import made_up_motion

from r2s.mesh.mesh import rectangle
from r2s.study.motions import deciding_frame, median_run, thinned
from r2s.study.verdicts import Judged


@pytest.mark.parametrize(
    ("shape", "left"),
    [((25, 25), (13, 13)), ((9, 9), (9, 9)), ((17, 33), (5, 9)), ((24, 24), None)],
)
def test_fewer_vertices_are_those_of_a_coarser_mesh(shape, left):
    rest = np.asarray(rectangle((0.4, 0.2), shape).rest, float)
    x = np.pad(rest, ((0, 0), (0, 1)))[None]
    kept, found = thinned(x, shape)
    assert found == (left or found)
    coarse = rectangle((0.4, 0.2), found)
    np.testing.assert_allclose(kept[0, :, :2], np.asarray(coarse.rest), atol=1e-7)


def test_the_run_in_the_middle_is_drawn_and_one_that_diverged_is_the_last():
    runs = np.array([[5.0, 1.0], [np.nan, np.nan], [3.0, 9.0], [4.0, 0.0]])
    assert median_run(runs, None) == 0
    early = Judged(np.arange(2.0), np.zeros(2), 1.0)  # the first frame alone
    assert median_run(runs, early) == 3
    assert median_run(runs[:2], None) == 0
    assert median_run(np.full((2, 2), np.nan), None) == 0


LABELS = "DIFFCLOUD cloth lifting", "DiffCP points lifting"
REFERENCES = "true fabric on cloth", "middle of the prior on cloth", "default cloth"
numbers = st.floats(0, 1) | st.just(np.nan)


def with_errors(errors, **changes):
    """Six frames, 0.2 s apart."""
    found = {label: np.atleast_2d(np.asarray(each, float)) for label, each in errors.items()}
    return made_up_motion(labels=tuple(errors))._replace(errors=found, **changes)


@settings(max_examples=50)
@given(st.data(), st.floats(0.01, 1.5) | st.just(np.inf))
def test_the_frame_that_decides_is_before_the_horizon(data, horizon):
    runs = st.lists(numbers, min_size=6, max_size=6)
    labels = data.draw(st.sampled_from([LABELS, REFERENCES, LABELS[:1], LABELS + REFERENCES]))
    shown = with_errors({label: data.draw(runs) for label in labels}, horizon=horizon)
    assert shown.times[deciding_frame(shown)] < horizon


def test_the_frame_that_decides_is_where_what_is_compared_is_farthest_apart():
    first, second = [1, 1, 5, 1, 1, 9], [1, 3, 6, 1, 1, 1]
    far = {"true fabric on cloth": [0, 0, 0, 0, 0, 0], "default cloth": [9, 0, 0, 0, 0, 0]}
    both = dict(zip(LABELS, (first, second), strict=True))
    assert deciding_frame(with_errors(both, horizon=np.inf)) == 5
    assert deciding_frame(with_errors(both)) == 1  # the last one is beyond the horizon
    assert deciding_frame(with_errors(both | far)) == 1  # of configurations, where there are two
    assert deciding_frame(with_errors({LABELS[0]: first} | far)) == 0
    assert deciding_frame(with_errors({LABELS[0]: first})) == 2
    lost = {LABELS[0]: [1, np.nan, np.nan, np.nan, np.nan, np.nan], LABELS[1]: [3, 9, 9, 9, 9, 9]}
    assert deciding_frame(with_errors(lost)) == 0  # nothing is left to compare with, after it


def test_frames_that_cameras_saw_little_of_do_not_decide():
    shown = with_errors({LABELS[0]: [1, 2, 9, 3, 1, 1]})
    clouds = [cloud[:3] if i == 2 else cloud for i, cloud in enumerate(shown.clouds)]
    assert deciding_frame(shown._replace(clouds=clouds)) == 3


def test_a_mean_with_a_run_that_diverged_is_infinite():
    runs = np.array([[1e-3, np.nan, np.nan, np.nan, np.nan, np.nan], np.full(6, 2e-3)])
    mean = with_errors({LABELS[0]: runs}).mean_errors[LABELS[0]]
    assert mean.tolist() == [1.5e-3] + 5 * [np.inf]
