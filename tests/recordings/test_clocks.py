"""When frames were taken: numbers, stamps in names, files of times."""

from pathlib import Path

import numpy as np
import pytest

from r2s.recordings.clocks import find_frames, places_of, read_times, times_of
from r2s.recordings.clouds import READERS


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).touch()
    return folder


def test_frames_are_sorted_by_number(tmp_path):
    touch(tmp_path, "t1_frame_10.ply", "t1_frame_8.ply", "t1_frame_9.ply", "notes.txt", "mesh.obj")
    touch(tmp_path, "._t1_frame_11.ply")
    frames = find_frames(tmp_path, READERS)
    assert frames.keys == [8, 9, 10] and frames.files[0] == tmp_path / "t1_frame_8.ply"
    assert frames.numbers == [0, 1, 2] and frames.stamps is None
    assert find_frames(tmp_path, READERS, first=6).numbers == [2, 3, 4]
    with pytest.raises(ValueError, match="frame 8 comes before the first frame, 9"):
        find_frames(tmp_path, READERS, first=9)


def test_bad_folders_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere: no such folder"):
        find_frames(tmp_path / "nowhere", READERS)
    with pytest.raises(FileNotFoundError, match="no numbered frames"):
        find_frames(tmp_path, READERS)
    touch(tmp_path, "000.npy", "001.ply")
    with pytest.raises(ValueError, match=r"mixed formats: \.npy, \.ply"):
        find_frames(tmp_path, READERS)
    (tmp_path / "001.ply").unlink()
    touch(tmp_path, "00.npy")
    with pytest.raises(ValueError, match="frame 0 is there twice: 00.npy and 000.npy: keep one"):
        find_frames(tmp_path, READERS)


@pytest.mark.parametrize(
    "names",
    [
        ["1700000100.001234567", "1700000100.101234567", "1700000100.201234567"],
        ["cloud_1700000100_001234567", "cloud_1700000100_101234567", "cloud_1700000100_201234567"],
        ["1700000100001234567", "1700000100101234567", "1700000100201234567"],
        ["lift-1700000100001", "lift-1700000100101", "lift-1700000100201"],
        ["1700000100001234", "1700000100101234", "1700000100201234"],
        ["2026-11-30_21-33-59.900", "2026-11-30_21-34-00.000", "2026-11-30_21-34-00.100"],
        ["left_20261130T213359.900", "left_20261130T213400.000", "left_20261130T213400.100"],
        ["t1700000100.95_cloud", "t1700000101.05_cloud", "t1700000101.15_cloud"],
        ["0.0", "0.1", "0.2"],
        ["t_9.9", "t_10.0", "t_10.1"],  # later than their names
    ],
)
def test_names_that_are_times_keep_them_in_their_order(tmp_path, names):
    frames = find_frames(touch(tmp_path, *(f"{name}.npy" for name in names)), READERS)
    assert [path.stem for path in frames.files] == names
    np.testing.assert_allclose(np.diff(times_of(tmp_path, frames, 30.0)), 0.1, atol=1e-6)


def test_versions_before_numbers_are_no_times(tmp_path):
    frames = find_frames(touch(tmp_path, "take_2.0004.npy", "take_2.0005.npy"), READERS)
    assert frames.stamps is None and frames.keys == [4, 5]


def test_times_without_leading_zeros_are_asked_for(tmp_path):
    touch(tmp_path, "1700000100.1234567.npy", "1700000100.101234567.npy")
    with pytest.raises(ValueError, match=r"decimals, or nanoseconds .* Write times\.csv"):
        find_frames(tmp_path, READERS)


def test_dropped_frames_leave_the_others_at_their_times_and_are_named(tmp_path):
    frames = find_frames(touch(tmp_path, "3.npy", "4.npy", "7.npy"), READERS, first=2)
    with pytest.warns(UserWarning, match=r"3 of 6 frames are missing \(from 0, 3, counted"):
        times = times_of(tmp_path, frames, 10.0)
    np.testing.assert_allclose(times, [0.1, 0.2, 0.5])


def test_numbers_that_count_something_else_are_refused(tmp_path):
    frames = find_frames(touch(tmp_path, "0.npy", "1.npy", "123456789012345.npy"), READERS)
    with pytest.raises(ValueError, match="3 frames are numbered up to .* write them to times.csv"):
        times_of(tmp_path, frames, 10.0)


def test_a_file_of_times_comes_first_and_has_a_line_for_each_frame(tmp_path):
    frames = find_frames(touch(tmp_path, "3.npy", "4.npy", "7.npy"), READERS)
    (tmp_path / "times.csv").write_text("file,time\n3.npy,5.01\n4.npy,5.09\n7.npy,5.4\n")
    np.testing.assert_allclose(times_of(tmp_path, frames, 10.0), [5.01, 5.09, 5.4])
    (tmp_path / "times.csv").write_text("5.01\n5.09\n")
    with pytest.raises(ValueError, match=r"times\.csv: 2 times, but 3 frames"):
        times_of(tmp_path, frames, 10.0)
    (tmp_path / "times.csv").write_text("1000\n1100\n1200\n")
    with pytest.raises(ValueError, match="100 s apart: give times in seconds"):
        read_times(tmp_path / "times.csv")


def test_without_any_clock_the_ways_to_give_one_are_named(tmp_path):
    frames = find_frames(touch(tmp_path, "0.npy", "1.npy"), READERS)
    with pytest.raises(FileNotFoundError, match="no times in the names .* no frame_rate"):
        times_of(tmp_path, frames, 0.0)


@pytest.mark.parametrize(
    "text",
    ["frame,time\n0,0.1\n1,0.2\n", "0.1\n0.2\n", "\ufeffTime [s]\r\n0.1\r\n\r\n0.2\r\n"],
)
def test_times_may_have_titles_and_frame_numbers(tmp_path, text):
    (tmp_path / "times.csv").write_text(text, encoding="utf-8")
    np.testing.assert_allclose(read_times(tmp_path / "times.csv"), [0.1, 0.2])


def test_frames_that_count_may_end_at_dropped_ones(tmp_path):
    numbers = [0, 1, 3, 4, 6, 7]
    assert places_of(tmp_path, (), numbers) == (0, 5)
    assert places_of(tmp_path, (2, 5), numbers) == (2, 3)  # both dropped
    with pytest.warns(UserWarning, match=r"frames_used is 1\.\.8, but .* numbered 0 to 7"):
        assert places_of(tmp_path, (1, 8), numbers) == (1, 5)
    for used in ((0, 40), (8, 9)):  # others than these are meant
        with pytest.raises(ValueError, match="numbered 0 to 7, counted from the first"):
            places_of(tmp_path, used, numbers)
