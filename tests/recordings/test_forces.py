"""Force logs: units, what is refused and where, the clock from the motion."""

import re
from pathlib import Path

import numpy as np
import pytest

from r2s.recordings.force_log import ForceLog, estimate_offset, read_force_log
from r2s.recordings.markers import on_table
from r2s.recordings.recording import RecordingInfo, SheetPlacement, make_recording

TIMES = np.arange(60) / 30.0  # [s], of the frames
X, Y = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)


@pytest.mark.parametrize(
    "header, row, expected",
    [
        ("time_s,force_N", "1.5,2.5", (1.5, 2.5)),
        ("Time [s], Force [N]", "1.5, 2.5", (1.5, 2.5)),
        ("time (ms);force (mN)", "1500;2500", (1.5, 2.5)),
        ("time_us\tforce_kN", "1500000\t0.0025", (1.5, 2.5)),
        ("n,force_gf,extra,time_s", "9,1000,x,1.5", (1.5, 9.80665)),
        ("Prüfzeit [s];Kraft [N]", "1,5;2,5", (1.5, 2.5)),
        ("time_s,force_N,note", "1.5,2.5,", (1.5, 2.5)),
        ('2" grips\ntime_s,force_N', "1.5,2.5,,", (1.5, 2.5)),
        ("Load cell: 500 N\nTime,Load\n(sec),(N)", "1.5,2.5", (1.5, 2.5)),
        ("Elapsed time (s)\tLoad (lbf)\t", "1.5\t2\t", (1.5, 8.8964432)),
    ],
)
def test_units_come_from_the_header(tmp_path: Path, header, row, expected) -> None:
    zero = re.sub("1500000|1500|1[.,]5", "0", row)
    (tmp_path / "pull.csv").write_text(f"# a lab\n\n{header}\n{zero}\n{row}\n")
    log = read_force_log(tmp_path / "pull.csv")
    np.testing.assert_allclose((log.times[1], log.force[1]), expected)


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "the log is empty"),
        ("time_s,force_N\n0,1\n", "expected two samples or more, found 1"),
        ("time_s,drag_N\n0,1\n1,1\n", "expected one column 'force'.*found 0"),
        ("time_s,force_N,force_mN\n0,1,1\n", "expected one column 'force'.*found 2"),
        ("time_s,force\n0,1\n1,1\n", "unit of 'force' is not known: write one of N, mN"),
        ("time_s,force_N\n0,1\n# x\n0.2,1\n0.1,1\n", "line 5: times must.*0.2 s, then 0.1"),
        ("time_s,force_N\n0,1\n0,1\n", "line 3: times must increase.*repeated"),
        ("time_s,force_N\n0,1\n1,nan\n", "line 3: expected a finite number, found 'nan'"),
        ("time_s,force_N\n0,1\n1,high\n", "line 3: expected a finite number, found 'high'"),
        ("time_s,force_N\n0,1\n1\n", "line 3 has 1 columns, the header 2: it is cut short"),
        ("time_s,force_N\n0,1\n0,1,2,5\n", "line 3 has 4 columns.*decimal commas"),
        (b"\xff\xfe\x00", "no text in UTF-8"),
        (b"\x81\x8d\xff", "no text in UTF-8, UTF-16 or Windows-1252"),
        ('time_s,force_N\n"0,1\n1,1\n', "line 2: a quotation mark is not closed"),
    ],
)
def test_a_broken_log_names_the_line(tmp_path: Path, text: str | bytes, words: str) -> None:
    file = tmp_path / "pull.csv"
    with pytest.raises(FileNotFoundError, match="pull.csv"):
        read_force_log(file)
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError, match=f"pull.csv: .*{words}"):
        read_force_log(file)


def test_a_stretch_becomes_a_recording() -> None:
    """Markers of a video and a log with a clock of its own, in the canonical form."""
    samples = np.arange(-3, 5, 2e-3)
    log = ForceLog(samples, stiffening(pulled(samples - 0.8), 1.5), "pull.csv")
    places = np.zeros((60, 4, 2))
    places[:, 2:, 0] = 0.4 + pulled(TIMES)[:, None]
    places[7, 1] = np.nan  # covered
    offset = estimate_offset(log, TIMES, np.nanmean(places[:, 2:, 0], axis=1) - 0.4)
    sheet = SheetPlacement((0.4, 0.4), (0.0, 0.0, 0.0), X, Y, ("warp", "opposite"))
    info = RecordingInfo("pull", "stretch", "made", "1", "here", (0, 59), sheet, 0.0, None)
    markers = on_table(places, 0.0)
    force = {"force": log.force, "force_times": log.times - offset}
    recording = make_recording(None, TIMES, markers[:, 2:], TIMES, info, markers=markers, **force)
    assert recording.markers_seen is not None and recording.force is not None
    assert int(recording.markers_seen.sum()) == 60 * 4 - 1
    at_frame = np.interp(TIMES, np.asarray(recording.force_times), np.asarray(recording.force))
    np.testing.assert_allclose(at_frame, stiffening(pulled(TIMES), 1.5), atol=0.3)


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
    third_of_a_frame = 0.01  # [s]
    assert estimate_offset(log, TIMES, seen) == pytest.approx(offset, abs=third_of_a_frame)


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
