"""Commands that simulate, estimate, evaluate, export and check: what they write and print."""

import dataclasses
import json
import re
import tomllib
import xml.etree.ElementTree as xml
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from folders import ROOT

pytest.importorskip("tyro")

from recorded_lift import recorded  # noqa: E402

from r2s.cli.checks import EXCLUDED, implausible  # noqa: E402
from r2s.cli.common import choose_shape, make_experiment, print_result  # noqa: E402
from r2s.cli.estimate import EstimateCard  # noqa: E402
from r2s.cli.estimate_report import Outcome, approach, assumed  # noqa: E402
from r2s.cli.main import main  # noqa: E402
from r2s.estimation import cards
from r2s.estimation.cards import Card, Provenance  # noqa: E402
from r2s.estimation.estimate import point_estimate  # noqa: E402
from r2s.estimation.method import default_space  # noqa: E402
from r2s.estimation.methods import (  # noqa: E402
    MASS,
    METHODS,  # noqa: E402
    STRETCH,
)
from r2s.materials import presets  # noqa: E402
from r2s.materials.arcsim import read_material  # noqa: E402
from r2s.materials.parameters import InformedSpace  # noqa: E402
from r2s.recordings.open import load_trajectory  # noqa: E402
from r2s.recordings.recording import load, save  # noqa: E402

SHORT = ["--motion", "num_frames=4", "moving=0.15", "--shape", "3", "3"]


@pytest.mark.slow(group="documents")
def test_a_motion_is_simulated(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "x.npz"
    command = ["simulate", "lifting", "--fabric", "black_denim", "--out", str(out), *SHORT]
    assert main([*command, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["frames"] == 4 and told["diverged_in_frame"] is None
    moved = load_trajectory(out)
    assert moved.x.shape == (4, 9, 3) and np.isfinite(moved.x).all()


@pytest.mark.slow(group="documents")
def test_a_recording_is_simulated_and_judged(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out, recording = str(tmp_path / "x.npz"), tmp_path / "lift.npz"
    command = ["simulate", "lifting", "--fabric", "black_denim", "--out", out, *SHORT]
    assert main([*command, "--recording", str(recording)]) == 0
    assert load(recording).info.fabric == "black_denim"
    capsys.readouterr()
    assert main(["evaluate", "black_denim", str(recording), "--shape", "3", "3", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    (metrics,) = told["recordings"].values()
    assert 0 < metrics["chamfer_real_to_sim"] < 0.01 and told["units"]["hausdorff"] == "m"
    (mesh,) = told["meshes"].values()
    assert mesh["shape"] == [3, 3] and mesh["mesh_error_m"] > 0.005


@pytest.mark.slow(group="study")
def test_export_warns_of_a_mesh_that_is_too_coarse(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    command = ["export", "grey_interlock", "--to", "mujoco", "--out", str(tmp_path / "x.xml")]
    assert main([*command, "--size", "0.45", "0.45", "--shape", "5", "5"]) == 0
    assert "warning: a mesh of 5 x 5 is coarse" in capsys.readouterr().out
    assert main([*command, "--size", "0.2", "0.2", "--shape", "17", "17"]) == 0
    assert "warning" not in capsys.readouterr().out


def test_the_doctor_says_which_mesh_a_fabric_needs(capsys: pytest.CaptureFixture) -> None:
    assert main(["doctor", "--fabric", "grey_interlock"]) == 0
    told = capsys.readouterr().out
    assert re.search(r"folding: \d+\.\d mm, too coarse, try 33 x 33", told)
    assert main(["doctor", "--fabric", "grey_interlock", "--shape", "65", "65"]) == 0
    assert re.search(r"folding: \d\.\d mm, enough", capsys.readouterr().out)


@pytest.mark.slow(group="study")
def test_exports_are_files_and_say_what_is_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    def export(to: str, *more: str) -> tuple[Path, dict]:
        out = tmp_path / f"{to}.out"
        assert main(["export", "black_denim", "--to", to, "--out", str(out), "--json", *more]) == 0
        return out, json.loads(capsys.readouterr().out)

    path, told = export("mujoco", "--size", "0.2", "0.2", "--shape", "3", "3")
    tree = xml.fromstring(path.read_text())
    assert len(list(tree.iter("inertial"))) == 9 and len(list(tree.iter("spatial"))) == 12
    assert abs(told["relative_energy_error"]["membrane"]["weft"]) < 1e-6
    path, told = export("mujoco", "--isotropic")
    assert told["relative_energy_error"]["membrane"]["weft"] < -0.5
    path, told = export("newton")
    model = json.loads(path.read_text())
    assert model["add_cloth_mesh"]["density"] == pytest.approx(0.32) and model["add_spring"]
    path, _ = export("newton-vbd", "--isotropic")
    assert json.loads(path.read_text())["add_spring"] == []
    path, told = export("pybullet")
    assert json.loads(path.read_text())["loadSoftBody"]["useMassSpring"] == 1
    assert any("bending" in text for text in told["lost"])
    path, _ = export("arcsim")
    assert float(read_material(path).density) == pytest.approx(0.32)


def test_the_doctor_knows_the_installation(capsys: pytest.CaptureFixture) -> None:
    assert main(["doctor", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["x64"] and told["versions"]["jax"] not in EXCLUDED and told["wrong"] == []
    assert not told["missing"]["cli"] and "bench" in told["missing"]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (jax,) = (text for text in project["dependencies"] if text.startswith("jax>"))
    assert all(f"!={version}" in jax for version in EXCLUDED)


@pytest.mark.slow(group="study")
def test_the_doctor_finds_wrong_units(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for make in presets.MEASURED.values():
        assert not list(implausible(make()))
    wrong = dataclasses.replace(presets.black_denim(), density=jnp.asarray(3.2))
    cards.write(tmp_path / "ounces.json", Card.make("ounces", wrong, Provenance("weighed")))
    assert main(["doctor", "--fabric", str(tmp_path / "ounces.json")]) == 1
    text = capsys.readouterr().out
    assert "WRONG: ounces: density is 3.2 kg/m^2, expected 0.05 to 1 (an areal density" in text


def test_the_doctor_looks_at_a_mesh(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    pytest.importorskip("trimesh")
    path = tmp_path / "sheet.obj"
    corners = "v 0 0 0\nv 0.2 0 0\nv 0 0.2 0\nv 0.2 0.2 0\n"
    path.write_text(corners + "f 1 2 3\nf 2 4 3\n")
    assert main(["doctor", "--mesh", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["mesh"]
    assert told["faces"] == 2 and told["area_m2"] == pytest.approx(0.04)
    path.write_text(corners + "f 1 2 3\nf 2 3 4\n")  # one is clockwise
    assert main(["doctor", "--mesh", str(path)]) == 0
    assert "    1 of 2 faces, clockwise, are turned over" in capsys.readouterr().out
    assert main(["doctor", "--mesh", str(path), "--strict"]) == 1
    assert (
        "sheet.obj: a strict reading changes nothing, but 1 of 2 faces" in capsys.readouterr().err
    )
    path.write_text(corners.replace("0.2", "20") + "f 1 2 3\nf 2 4 3\n")
    assert main(["doctor", "--mesh", str(path)]) == 1
    assert "20 by 20, hardly in metres: in centimetres," in capsys.readouterr().err
    assert main(["doctor", "--mesh", str(path), "--unit", "cm"]) == 0
    assert "one piece, 0.04 m^2, edges 200.00 to" in capsys.readouterr().out


@pytest.mark.parametrize("density", ["150", "0.0003"])
def test_a_density_in_other_units_is_refused(tmp_path: Path, capsys, density: str) -> None:
    save(recorded(), tmp_path / "lift.npz")
    command = ["estimate", str(tmp_path / "lift.npz"), "--out", str(tmp_path / "a.json")]
    assert main([*command, "--density", density]) == 1
    assert "--density is in kg/m^2" in capsys.readouterr().err


@pytest.mark.parametrize("frames", ["inf", "nan", "3.5"])
def test_a_number_of_frames_is_whole(frames: str) -> None:
    with pytest.raises(ValueError, match="num_frames must be a whole number"):
        make_experiment("lifting", [f"num_frames={frames}"])


def test_a_mesh_that_does_not_fit_memory_is_refused(monkeypatch) -> None:
    monkeypatch.setattr("r2s._util.threads.available", lambda: 10**9)
    fabric = presets.grey_interlock()
    with pytest.raises(MemoryError, match="3000 x 3000 needs .* take a coarser one"):
        choose_shape((3000, 3000), fabric, (0.3, 0.3), "lifting")


def test_numbers_of_a_motion_and_what_is_printed(capsys: pytest.CaptureFixture) -> None:
    made = make_experiment("folding", ["reach=0.8", "num_frames=50"])
    assert len(made.times) == 50 and made.name == "folding"
    with pytest.raises(ValueError, match="reach must be above 0 and at most 1"):
        make_experiment("folding", ["reach=2"])
    print_result(True, {"a": float("nan"), "b": [np.inf, 1.0], "c": Path("x")}, [])
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": [None, 1.0], "c": "x"}


@pytest.mark.slow(group="documents")
def test_a_card_comes_from_a_recording_and_goes_on_where_it_was(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    recording, card = tmp_path / "lift.npz", tmp_path / "card.json"
    command = ["simulate", "lifting", "--out", str(tmp_path / "x.npz"), "--shape", "5", "5"]
    assert main([*command, "--recording", str(recording)]) == 0
    command = ["estimate", str(recording), "--density", "0.19", "--out", str(card), "--json"]
    command += ["--shape", "5", "5", "--num-samples", "4", "--num-starts", "1"]
    command += ["--max-iterations", "6"]
    capsys.readouterr()
    assert main([*command, "--date", "2026-01-31"]) == 0
    told = json.loads(capsys.readouterr().out)
    found = cards.read(card)
    assert told["provenance"]["date"] == "2026-01-31" and told["estimate"]["parameters"]
    assert found.provenance.recordings == (
        ("lifting_grey_interlock", cards.fingerprint(load(recording))),
    )
    assert found.estimate is not None and found.estimate.approach.startswith("diffcloud")
    assert not list(tmp_path.glob("*.progress.npz"))


@pytest.mark.slow(group="documents")
@pytest.mark.parametrize("more", [[], ["--forward"]])
def test_derivatives_of_a_scene_agree(capsys: pytest.CaptureFixture, more: list[str]) -> None:
    assert main(["check-grad", "lifting", *SHORT, "--json", *more]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["agree"] and len(told["rows"]) == 11


@pytest.mark.slow(group="documents")
def test_the_doctor_predicts_step_and_memory(capsys: pytest.CaptureFixture) -> None:
    assert main(["doctor", "--scenario", "lifting", *SHORT, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["scenario"]
    assert told["points_step_s"] < told["step_s"] <= 0.025
    assert 0 < told["memory_bytes"] < told["gradient_memory_bytes"]


FAILED = r"failed (at [\d.]+ s|[\d.]+ s before the first frame): [A-Z]"
STORM = ["--motion", "speed=1e200", "num_frames=2", "--shape", "3", "3"]  # its drag overflows


@pytest.mark.parametrize(
    "command",
    [
        ["simulate", "--out"],
        pytest.param(["doctor"], marks=pytest.mark.slow(group="documents")),
        pytest.param(["check-grad"], marks=pytest.mark.slow(group="documents")),
    ],
    ids=["simulate", "doctor", "check-grad"],
)
def test_a_run_that_diverges_says_why(
    tmp_path: Path, capsys: pytest.CaptureFixture, command: list[str]
) -> None:
    name, *options = command
    scenario = ["--scenario", "wind"] if name == "doctor" else ["wind"]
    options += [str(tmp_path / "x.npz")] if options else []
    assert main([name, *scenario, *options, *STORM]) == 1
    assert re.search(f"the simulation {FAILED}", capsys.readouterr().out)


@pytest.mark.slow(group="documents")
def test_a_recording_that_cannot_be_simulated_says_why(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    calm = recorded(2)
    storm = dataclasses.replace(calm.info, name="storm", wind=(0.0, 1e200, 0.0))
    save(dataclasses.replace(calm, info=storm), tmp_path / "storm.npz")
    assert main(["evaluate", "black_denim", str(tmp_path / "storm.npz"), "--json"]) == 1
    result = json.loads(capsys.readouterr().out)
    assert re.match(FAILED, result["failures"]["storm"])
    assert result["recordings"]["storm"]["chamfer_real_to_sim"] is None
    budget = ["--shape", "3", "3", "--num-samples", "1", "--num-starts", "1"]
    command = ["estimate", str(tmp_path / "storm.npz"), "--density", "0.32", *budget]
    assert main([*command, "--out", str(tmp_path / "card.json")]) != 0
    assert re.search(f"all 1 simulations .* the first {FAILED}", capsys.readouterr().err)


@pytest.mark.parametrize(
    ("options", "is_alone", "knows"),
    [
        ({}, True, True),
        ({"prior": "flat"}, True, False),
        ({}, False, False),  # laboratory tests are the prior
        ({"prior": "fabrics"}, False, True),
        ({"law": "stiffening"}, True, True),
        ({"method": "diffcp"}, True, False),  # on material points
        ({"method": "physnet"}, True, False),
    ],
)
def test_fabrics_of_this_weight_are_known_to_whom_they_help(options, is_alone, knows):
    """What they are like beforehand, unless something better is known, or nothing is asked for."""
    card = EstimateCard((Path("lift.npz"),), 0.2, Path("card.json"), **options)
    method = METHODS[card.method]()
    prior = card._prior(method, not is_alone)
    space = card._space(method, prior, [])
    assert isinstance(space, InformedSpace) == knows
    place = jnp.full(space.dim, 0.5)
    found = point_estimate("diffcloud", space, place, 0.0, np.zeros(1), np.zeros((1, 1, 1)), 0.0)
    words = approach(Outcome(method, 0.2, prior, space, (), (), found, None))
    assert ("prior of measured fabrics" in words) == knows


def test_a_card_says_what_was_neither_weighed_nor_estimated():
    on_cloth, on_mpm = (
        {each.name for each in default_space(solver, 0.2).ranges} for solver in ("cloth", "mpm")
    )
    assert assumed(on_cloth) == ("thickness", "mass_damping")
    assert assumed(on_mpm) == ("bending", "damping", "friction", "thickness", "mass_damping")
    whole = ("membrane", "bending", "damping", "friction", "thickness", "mass_damping")
    assert assumed({each.name for each in (STRETCH, MASS)}) == whole


def test_multipliers_have_no_law_that_stiffens():
    card = EstimateCard((Path("lift.npz"),), 0.2, Path("card.json"), law="stiffening")
    with pytest.raises(ValueError, match="multipliers of diffcloud-published"):
        card._space(METHODS["diffcloud-published"](), "flat", [])
