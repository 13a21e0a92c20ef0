"""Force logs: units, what is refused and where, the mean over frames, the clock from the motion."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2s.recordings.force_log import (
    ForceLog,
    at_frames,
    estimate_offset,
    read_force_log,
)
from r2s.recordings.markers import on_table
from r2s.recordings.recording import RecordingInfo, SheetPlacement, make_recording

TIMES = np.arange(60) / 30.0  # [s], of the frames


def written(tmp_path: Path, text: str) -> Path:
    file = tmp_path / "pull.csv"
    file.write_text(text)
    return file


@pytest.mark.parametrize(
    "header, row, expected",
    [
        ("time_s,force_N", "1.5,2.5", (1.5, 2.5)),
        ("Time [s], Force [N]", "1.5, 2.5", (1.5, 2.5)),
        ("time (ms);force (mN)", "1500;2500", (1.5, 2.5)),
        ("time_us\tforce_kN", "1500000\t0.0025", (1.5, 2.5)),
        ("n,force_gf,extra,time_s", "9,1000,x,1.5", (1.5, 9.80665)),
    ],
)
def test_units_come_from_the_header(tmp_path: Path, header, row, expected) -> None:
    zero = row.replace("1500000", "0").replace("1500", "0").replace("1.5", "0")
    log = read_force_log(written(tmp_path, f"# a lab\n\n{header}\n{zero}\n{row}\n"))
    np.testing.assert_allclose((log.times[1], log.force[1]), expected)


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "the log is empty"),
        ("time_s,force_N\n0,1\n", "expected two samples or more, found 1"),
        ("time_s,load_N\n0,1\n1,1\n", "expected one column 'force'.*found 0.*rename it"),
        ("time_s,force_N,force_mN\n0,1,1\n", "expected one column 'force'.*found 2"),
        ("time_s,force\n0,1\n1,1\n", "unit of 'force' is not known: write one of N, mN"),
        ("time_min,force_N\n0,1\n1,1\n", "unit of 'time_min' is not known: write one of s, ms"),
        (
            "time_s,force_N\n0,1\n# x\n0.2,1\n0.1,1\n",
            "line 5: times must increase.*0.2 s, then 0.1",
        ),
        ("time_s,force_N\n0,1\n0,1\n", "line 3: times must increase.*there twice"),
        ("time_s,force_N\n0,1\n1,nan\n", "line 3: expected a finite number, found 'nan'"),
        ("time_s,force_N\n0,1\n1,high\n", "line 3: expected a finite number, found 'high'"),
        ("time_s,force_N\n0,1\n1\n", "line 3 has 1 columns, the header 2: it is cut short"),
        ("time_s,force_N\n0,1\n0,1,2,5\n", "line 3 has 4 columns.*decimal commas"),
    ],
)
def test_a_broken_log_names_the_line(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ValueError, match=f"pull.csv: .*{words}|pull.csv.*{words}"):
        read_force_log(written(tmp_path, text))


def test_a_stretch_becomes_a_recording() -> None:
    """Markers of a video and a log with a clock of its own, in the canonical form."""
    samples = np.arange(-3, 5, 2e-3)
    log = ForceLog(samples, stiffening(pulled(samples - 0.8), 1.5), "pull.csv")
    places = np.zeros((60, 4, 2))
    places[:, 2:, 0] = 0.4 + pulled(TIMES)[:, None]
    places[7, 1] = np.nan  # covered
    offset = estimate_offset(log, TIMES, np.nanmean(places[:, 2:, 0], axis=1) - 0.4)
    sides = ("warp", "opposite")
    sheet = SheetPlacement((0.4, 0.4), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), sides)
    info = RecordingInfo("pull", "stretch", "made", "1", "here", (0, 59), sheet, 0.0, None)
    markers = on_table(places, 0.0)
    held = markers[:, 2:]
    recording = make_recording(
        None, TIMES, held, TIMES, info,
        force=log.force, force_times=log.times - offset, markers=markers,
    )  # fmt: skip
    assert recording.markers_seen is not None and recording.force is not None
    assert int(recording.markers_seen.sum()) == 60 * 4 - 1
    at_frame = np.interp(TIMES, np.asarray(recording.force_times), np.asarray(recording.force))
    np.testing.assert_allclose(at_frame, at_frames(log, TIMES, offset), atol=0.2)


def test_no_log_and_no_text(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="pull.csv"):
        read_force_log(tmp_path / "pull.csv")
    (tmp_path / "pull.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="pull.csv: no text in UTF-8"):
        read_force_log(tmp_path / "pull.csv")


def test_the_mean_over_a_frame_is_exact_for_a_ramp() -> None:
    samples = np.linspace(-1, 4, 501)
    log = ForceLog(samples, 3 * samples + 1, "ramp")
    np.testing.assert_allclose(at_frames(log, TIMES, 0.5), 3 * (TIMES + 0.5) + 1, atol=1e-12)


@given(st.floats(-0.5, 0.5), st.integers(0, 5))
def test_noise_is_averaged(offset: float, seed: int) -> None:
    samples = np.arange(-1, 4, 1e-3)
    noise = np.random.default_rng(seed).normal(0, 1, len(samples))
    force = at_frames(ForceLog(samples, noise, "noise"), TIMES, offset)
    assert np.std(force) < 2 / np.sqrt(33)


def test_a_log_slower_than_the_frames_is_interpolated() -> None:
    log = ForceLog(np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 1.0]), "slow")
    force = at_frames(log, TIMES)
    assert force[15] == pytest.approx(0.5) and force[45] == pytest.approx(1.0)
    assert at_frames(log, np.array([0.25])) == pytest.approx([0.25])


def test_frames_outside_the_log_and_in_its_gaps() -> None:
    samples = np.arange(0, 2, 0.01)
    log = ForceLog(samples, samples, "pull.csv")
    with pytest.raises(ValueError, match="pull.csv: frame 46, at 2.0.. s .* outside .*offset .0.5"):
        at_frames(log, TIMES, 0.5)
    holed = samples[(samples < 0.5) | (samples > 0.9)]
    with pytest.raises(ValueError, match="frame 15, at 0.500 s, is in a gap of the log"):
        at_frames(ForceLog(holed, holed, "pull.csv"), TIMES)
    with pytest.raises(ValueError, match="times of the frames must be finite and increase"):
        at_frames(log, TIMES[::-1].copy())


def pulled(times: np.ndarray) -> np.ndarray:
    """The displacement [m] of a pull from 0.4 s to 1.3 s that is then held."""
    progress = np.clip((times - 0.4) / 0.9, 0, 1)
    return 0.05 * progress**2 * (3 - 2 * progress)


def stiffening(displacement: np.ndarray, power: float) -> np.ndarray:
    return 20 * (displacement / 0.05) ** power


@pytest.mark.parametrize("power", [1.0, 1.7, 3.0])
@pytest.mark.parametrize("offset", [-0.7312, 0.0, 1.204])
def test_the_offset_is_found_from_the_motion(power: float, offset: float) -> None:
    generator = np.random.default_rng(0)
    samples = np.arange(-3, 5, 2e-3)
    force = stiffening(pulled(samples - offset), power) + generator.normal(0, 0.2, len(samples))
    log = ForceLog(samples, force, "pull.csv")
    seen = pulled(TIMES) + generator.normal(0, 5e-5, len(TIMES))
    assert estimate_offset(log, TIMES, seen) == pytest.approx(
        offset, abs=0.01
    )  # [s], a third of a frame


def test_an_offset_that_nothing_tells() -> None:
    samples = np.arange(0, 4, 0.01)
    log = ForceLog(samples, np.sin(40 * samples), "pull.csv")
    with pytest.raises(ValueError, match="explains .* of the force's variance.*log of this video"):
        estimate_offset(log, TIMES, pulled(TIMES))
    with pytest.raises(ValueError, match="nothing moves"):
        estimate_offset(log, TIMES, np.zeros(60))
    with pytest.raises(ValueError, match="one finite displacement"):
        estimate_offset(log, TIMES, np.full(60, np.nan))
    short = ForceLog(samples[:60], stiffening(pulled(samples[:60] + 0.9), 1.0), "pull.csv")
    with pytest.raises(ValueError, match="pull.csv: .*(records allow|explains)"):
        estimate_offset(short, TIMES, pulled(TIMES))
