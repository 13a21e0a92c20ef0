"""Files of laboratories: what testers export, units, tests that are none; cards from these."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from r2s.laboratory.files import read_knit, read_tests
from r2s.laboratory.pull import Pull
from r2s.materials.stiffening import StiffeningMembrane

PULL = {"file": "warp.csv", "direction": "warp", "length": 0.2, "width": 0.05}


def written(folder: Path, **kinds) -> Path:
    path = folder / "tests.json"
    path.write_text(json.dumps({"format": "r2s-laboratory/1"} | kinds))
    return path


def write_curve(folder: Path, header: str, unit: float = 1.0, force: float = 1.0) -> None:
    """Up to a strain of 0.1, of 300 N/m."""
    rows = [f"{unit * e:.6g},{force * 300 * 0.05 * e / 0.2:.6g}" for e in np.linspace(0, 0.02, 20)]
    (folder / "warp.csv").write_text("\n".join([header, *rows]))


@pytest.mark.parametrize(
    "header, unit, force",
    [
        ("extension_m,force_N", 1, 1),
        ("Extension [mm],Force [mN]", 1e3, 1e3),
        ("strain_%,force_gf", 500, 1 / 9.80665e-3),
    ],
)
def test_the_units_of_a_curve_are_those_of_its_header(tmp_path: Path, header, unit, force):
    write_curve(tmp_path, header, unit, force)
    (pull,) = read_tests(written(tmp_path, pulls=[PULL])).tests
    assert isinstance(pull, Pull)
    np.testing.assert_allclose(pull.tension, 300 * (pull.stretch - 1), rtol=1e-4)
    assert float(pull.stretch[-1]) == pytest.approx(1.1, abs=0.005)


EXPORTS = {
    "preamble and units below": (
        "cp1252",
        '"Prüfung";"Kette"\nVorkraft;0,5;N\n\nStandardweg;Standardkraft;\nmm;N;\n{mm};{N};',
    ),
    "utf-16": ("utf-16", "Prüfzeit;Dehnung;Prüfkraft\ns;%;N\n0,1;{%};{N}"),
    "utf-16 without a mark": ("utf-16-le", "Weg in mm\tKraft in mN\n{mm}\t{mN}"),
    "quoted": (
        "utf-8-sig",
        '"Sample","1"\n"Time","Extension","Load"\n"(s)","(mm)","(N)"\n"0.1","{mm}","{N}"',
    ),
    "two strains": ("utf-8", "Tensile strain (Strain 1) (mm/mm),Tensile load [N]\n{-},{N}"),
    "quoted decimal commas": ("utf-8", 'displacement (cm),load (N)\n"{cm}","{N}"'),
    "both": ("utf-8", "strain_%,Displacement / mm,force_N\n{%},{mm},{N}"),
    "a strain called elongation": ("utf-8", "sep=;\nElongation [%];Load [N]\n{%};{N}"),
    "an extension called elongation": ("utf-8", "Elongation [mm];Force, N\n{mm};{N}"),
}


@pytest.mark.parametrize("name", EXPORTS)
def test_what_a_tester_exports_is_read(tmp_path: Path, name: str):
    """300 N/m up to a strain of 0.1, with decimal commas where these part no columns."""
    encoding, text = EXPORTS[name]
    *head, row = text.split("\n")
    strain, is_comma = np.linspace(0, 0.1, 21), ";" in row or "\t" in row or "cm" in row
    columns = {"-": 1, "%": 100, "mm": 200, "cm": 20, "N": 15, "mN": 15e3}
    for value in strain:
        line = row
        for unit, scale in columns.items():
            number = f"{scale * value:.5f}"
            line = line.replace(f"{{{unit}}}", number.replace(".", ",") if is_comma else number)
        head.append(line)
    (tmp_path / "warp.csv").write_bytes("\n".join(head).encode(encoding))
    (pull,) = read_tests(written(tmp_path, pulls=[PULL])).tests
    assert isinstance(pull, Pull)
    np.testing.assert_allclose(pull.tension, 300 * (pull.stretch - 1), rtol=1e-3)
    assert float(pull.stretch[-1]) == pytest.approx(1.1, abs=0.005)


@pytest.mark.parametrize(
    "data, words",
    [
        ("extension_mm;force_N\n0,5;0.1\n1,5;2", "line 2: .*commas and points are mixed"),
        ("extension_mm,force_N\n0,5,0,1\n1,5,2,5", "part the columns by semicolons"),
        (b"PK\x03\x04 a workbook", "save its sheet as CSV"),
        ("extension_mm,force_N\n0,0\n1,1\nMaximum,1", "line 4: expected a finite number"),
    ],
)
def test_an_export_that_cannot_be_read_is_named(tmp_path: Path, data: str | bytes, words: str):
    (tmp_path / "warp.csv").write_bytes(data if isinstance(data, bytes) else data.encode())
    with pytest.raises(ValueError, match=f"warp.csv: .*{words}"):
        read_tests(written(tmp_path, pulls=[PULL]))


@pytest.mark.parametrize(
    "header, unit, force, word",
    [
        ("extension_m,force_g", 1, 1, "mass"),
        ("extension_m,force_N", 500, 1, "per cent"),
        ("extension_m,force_N", 1, 1e5, "millinewtons"),
        ("extension_m,force_N", 1, -1, "does not rise"),
        ("extension_m,force_N", 1e-3, 1, "in metres"),
        ("extension,force_N", 1, 1, "unit of 'extension'"),
        ("Displacement,force_N", 1, 1, r"m, mm, cm, in as 'extension \[m\]' or -, %.* as 'strain"),
        ("way_mm,force_N", 1, 1, r"column 'extension' \(m, mm, .*\) or 'strain' \(-, %"),
        ("Strain [%],Stress [MPa]", 1, 1, r"column 'force' \(N, mN"),
        ("stroke_mm,position_mm,force_N", 1, 1, "found 2"),
    ],
)
def test_a_curve_in_other_units_is_named(tmp_path: Path, header, unit, force, word):
    write_curve(tmp_path, header, unit, force)
    with pytest.raises(ValueError, match=word):
        read_tests(written(tmp_path, pulls=[PULL]))


@pytest.mark.parametrize(
    "kinds, words",
    [
        ({}, "no test"),
        ({"pull": []}, "unknown: pull"),
        ({"pulls": [PULL]}, "pull 1: no such file"),
        ({"cantilevers": [{"direction": "warp", "overhangs": [6.1]}]}, "in centimetres"),
        ({"cantilevers": [{"direction": "warp", "overhangs": [0.03, 0.07]}]}, "of one direction"),
        ({"cantilevers": [{"direction": 45, "overhangs": [0.05]}]}, "0 to pi rad"),
        ({"cantilevers": [{"direction": "up", "overhangs": [0.05]}]}, "direction: expected"),
        ({"cantilevers": [{"overhangs": [0.05]}]}, "missing: direction"),
        ({"cantilevers": [{"direction": "warp", "overhangs": [10**400]}]}, "a finite number"),
        ({"drapes": [{"coefficient": 42}]}, "drape 1: .*per cent"),
        ({"drapes": [{"coefficient": 0.4, "support_radius": 0.18}]}, "diameters"),
    ],
)
def test_tests_that_are_none_are_named(tmp_path: Path, kinds: dict, words: str):
    with pytest.raises((ValueError, FileNotFoundError), match=f"tests.json: .*{words}"):
        read_tests(written(tmp_path, **kinds))


def test_pulls_of_knits_are_read_in_metres(tmp_path: Path):
    h5py = pytest.importorskip("h5py")
    file = tmp_path / "outputData_Wool Rib Y.h5"
    stretch = np.linspace(1, 1.5, 40)
    with h5py.File(file, "w") as h5:
        h5["clampSize"], h5["fabricSize"] = [142.0], [400.0]  # 4 pixels a millimetre
        for name in ("video1", "video2", "video3", "video4", "video5"):
            pins = np.zeros((6, 2, 40))
            pins[0, 0], pins[1, 0] = 200 - 20 * (stretch - 1), -200 + 20 * (stretch - 1)
            pins[-2, 1], pins[-1, 1] = 240 * stretch, 0
            h5[f"{name}/traj"], h5[f"{name}/forces"] = pins, 20 * (stretch - 1)
    path = written(tmp_path, pulls=[{"file": file.name, "direction": "warp"}])
    pulls: Any = read_tests(path).tests
    assert len(pulls) == 4  # the first one was never stretched before
    np.testing.assert_allclose(pulls[0].tension, 20 * (pulls[0].stretch - 1) / 0.1, rtol=1e-6)
    assert float(pulls[0].stretch.max()) == pytest.approx(1.5, abs=0.02)
    assert float(pulls[0].across.min()) == pytest.approx(1 - 0.1 * 0.5, abs=0.01)
    with h5py.File(file, "a") as h5:
        del h5["video3/forces"]
    with pytest.raises(ValueError, match="no pulls of stitch-by-stitch"):
        read_knit(file, 0.0)


@pytest.mark.parametrize("name", ["none.json", "no folder/tests.json"])
def test_a_missing_file_is_named_without_the_number_of_the_error(tmp_path: Path, capsys, name):
    pytest.importorskip("tyro")
    from r2s.cli.main import main

    missing = str(tmp_path / name)
    assert main(["estimate", missing, "--density", "0.2", "--out", str(tmp_path / "a.json")]) == 1
    assert capsys.readouterr().err == f"r2s: error: {missing}: No such file or directory\n"


@pytest.mark.slow(group="study")
def test_tests_alone_make_a_card(tmp_path: Path, capsys: pytest.CaptureFixture):
    pytest.importorskip("tyro")
    from r2s.cli.main import main
    from r2s.estimation import cards

    write_curve(tmp_path, "extension_m,force_N")
    pulls = [PULL | {"direction": direction} for direction in ("warp", "weft")]
    path = written(tmp_path, pulls=pulls, cantilevers=[{"direction": "warp", "overhangs": [0.05]}])
    command = ["estimate", str(path), "--density", "0.2", "--out", str(tmp_path / "card.json")]
    assert main(command) == 0
    card = cards.read(tmp_path / "card.json")
    assert float(card.fabric.membrane.c11) == pytest.approx(260, rel=0.1)  # at 10 % of strain
    assert card.provenance.method == "estimated by r2s: laboratory tests"
    assert card.provenance.recordings[0][0] == "tests"
    assert "cantilever 1: overhang 50.0 mm measured" in capsys.readouterr().out
    assert main([*command, "--num-starts", "1"]) == 1
    assert main([*command, "--method", "physnet"]) == 1
    assert "--method, --solver" in capsys.readouterr().err
    assert main([*command, "--law", "stiffening"]) == 0
    law = cards.read(tmp_path / "card.json").fabric.membrane
    assert isinstance(law, StiffeningMembrane)
