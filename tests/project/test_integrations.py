"""r2s as a simulator of RGBench, and cases of PhysTwin, on files of their layouts."""

import dataclasses
import pickle
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from phystwin import read_case
from rgbench_simulator import Environment, garment, layered

from r2s.materials import presets
from r2s.materials.stiffening import StiffeningMembrane
from r2s.recordings.recording import SheetPlacement

# RGBench

START = 1752924898.0
SIZE = (0.4, 0.3)  # of a garment [m]
MASS = 0.08  # [kg], of two layers of 1/3 kg/m^2
FLING = {"action": SimpleNamespace(type="fling")}


def configuration(folder: Path, move: str = "grasp", **others) -> SimpleNamespace:
    """Of a run with a rectangle of two layers, which both arms hold at its far corners and lift."""
    u, v = np.meshgrid(np.linspace(0, 1, 61), np.linspace(0, 1, 61), indexing="ij")
    flat = np.stack([SIZE[0] * u.ravel(), SIZE[1] * v.ravel(), 0 * u.ravel()], axis=1)
    both = np.concatenate([flat, flat + [0, 0, 0.01]])
    cells = np.arange(61 * 61).reshape(61, 61)
    a, b, c = cells[:-1, :-1].ravel(), cells[1:, :-1].ravel(), cells[:-1, 1:].ravel()
    faces = np.stack([a, b, c], axis=1)
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in both]
    lines += [f"f {i + 1} {j + 1} {k + 1}" for i, j, k in np.concatenate([faces, faces + 61 * 61])]
    (folder / "shirt.obj").write_text("\n".join(lines))
    paths = {}
    for arm, side in (("left", 1), ("right", -1)):
        rows = ["time,pos_x,pos_y,pos_z"]
        for i in range(60):
            y = (SIZE[1] if side > 0 else 0.0) - 0.25 * side - 0.15
            rows.append(f"{START + 0.01 * i},{0.1 + SIZE[0]},{y:.4f},{0.01 + 0.002 * i:.4f}")
        paths[f"{arm}_arm_csv_path"] = str(folder / f"{arm}.csv")
        (folder / f"{arm}.csv").write_text("\n".join(rows))
    parts = {
        "action": SimpleNamespace(type=move, fling_prepare_time=0.1, fling_wait_time=0.05),
        "data": SimpleNamespace(robot_joints=SimpleNamespace(**paths)),
        "evaluate": SimpleNamespace(start_calculate_time=0.2),
        "cloth": SimpleNamespace(
            model_path=str(folder / "shirt.obj"), init_pose=[0.1, -0.15, 0.01, 1, 0, 0, 0]
        ),
        "cloth_params": SimpleNamespace(mass=MASS, shoulder_index=[61 * 61 - 1, 61 * 60]),
        "env": SimpleNamespace(name="r2s", card="black_denim", spacing=0.05, timestep=0.02),
    }
    return SimpleNamespace(**(parts | others))


@pytest.mark.slow(group="study")
def test_a_garment_is_grabbed_where_the_arms_are_and_follows_them(tmp_path: Path):
    run = Environment(configuration(tmp_path))
    assert run.get_master_start_time() == START
    lying = run.get_sim_vertices()
    places = np.array([[0.5, 0.15, 0], [0.5, -0.15, 0]])
    corners = np.linalg.norm(lying - places[:, None], axis=-1).argmin(axis=1)
    run.step_to_time(0.17)
    assert run.get_current_sim_time() == pytest.approx(0.18)
    np.testing.assert_allclose(run.get_sim_vertices()[corners], lying[corners], atol=2e-3)
    run.step_to_time(0.5)
    raised = run.get_sim_vertices()
    np.testing.assert_allclose(raised[corners], places + [0, 0, 0.11], atol=1e-6)
    assert raised[:, 2].min() > -1e-3 and np.isfinite(raised).all()


@pytest.mark.slow(group="study")
def test_a_fling_begins_where_the_arms_do_and_waits_there(tmp_path: Path):
    run = Environment(configuration(tmp_path, "fling"))
    lying, places = run.get_sim_vertices(), np.array([[0.5, 0.15, 0.01], [0.5, -0.15, 0.01]])
    corners = np.linalg.norm(lying - places[:, None], axis=-1).argmin(axis=1)
    for time, height, tolerance in ((0.1, 0.01, 1e-6), (0.16, 0.01, 4e-3), (0.3, 0.04, 1e-6)):
        run.step_to_time(time)
        expected = np.where([False, False, True], height, places)
        np.testing.assert_allclose(run.get_sim_vertices()[corners], expected, atol=tolerance)


def test_its_layers_weigh_and_resist_as_the_garment(tmp_path: Path):
    run = Environment(configuration(tmp_path))
    fabric, area = presets.black_denim(), SIZE[0] * SIZE[1]
    layers = MASS / area / float(fabric.density)
    assert float(run.fabric.density) == pytest.approx(MASS / area, rel=1e-3)
    ratio = float(run.fabric.membrane.c11 / fabric.membrane.c11)
    assert ratio == pytest.approx(layers, rel=1e-3)
    assert float(run.fabric.bending.stiffness / fabric.bending.stiffness) == pytest.approx(ratio)
    assert float(run.fabric.bending.poissons_ratio) == float(fabric.bending.poissons_ratio)
    stiff = dataclasses.replace(fabric, membrane=StiffeningMembrane.make(fabric.membrane, 2.0, 1.1))
    with pytest.raises(TypeError, match="constant stiffness"):
        layered(stiff, 0.6)


def test_a_sheet_has_the_outline_and_no_loose_pieces():
    u = np.random.default_rng(0).random((20000, 2))
    shirt = u[(np.abs(u[:, 0] - 0.5) < 0.3) | (u[:, 1] > 0.6)]
    mesh = garment(np.concatenate([shirt, [[1.3, 0.1]]]), 0.05)
    assert float(mesh.area.sum()) == pytest.approx(0.6 * 0.6 + 0.4, rel=0.15)
    assert float(mesh.rest[:, 0].max()) < 1.1
    with pytest.raises(ValueError, match="in pieces"):
        garment(np.concatenate([u, u + [2.0, 0]]), 0.05)


@pytest.mark.parametrize(
    "others, words",
    [
        ({"cloth": SimpleNamespace(model_path="no.obj")}, "no.obj"),
        ({"env": SimpleNamespace(name="r2s")}, "lacks env.card"),
        ({"action": SimpleNamespace(type="iron")}, "grasp, fold, fling, got 'iron'"),
        (FLING | {"cloth_params": SimpleNamespace(mass=MASS)}, "lacks cloth_params.shoulder_index"),
        (
            FLING | {"cloth_params": SimpleNamespace(mass=MASS, shoulder_index=[5, 5])},
            "both arms hold one vertex",
        ),
    ],
)
def test_a_configuration_that_lacks_something_is_named(tmp_path: Path, others, words):
    with pytest.raises((ValueError, FileNotFoundError), match=words):
        Environment(configuration(tmp_path, **others))


# PhysTwin


TURN = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
CORNERS = np.pad(np.array([[0.4, 0.3], [0.4, 0.0]]) @ TURN.T, ((0, 0), (0, 1)))  # [m]


def case(folder: Path, hands: int = 1, **changes) -> Path:
    """A sheet of 0.4 x 0.3 m that lies turned by 30 degrees and is lifted at one corner, or two."""
    u, v = np.meshgrid(np.linspace(0, 0.4, 21), np.linspace(0, 0.3, 16), indexing="ij")
    flat = np.stack([u.ravel(), v.ravel()], axis=1) @ TURN.T
    frames = np.repeat(np.pad(flat, ((0, 0), (0, 1)))[None], 12, axis=0)
    held = CORNERS[:hands, None] + 0.01 * np.random.default_rng(0).normal(size=(hands, 15, 3))
    held = np.repeat(held.reshape(1, -1, 3), 12, axis=0)
    held[..., 2] += np.linspace(0, 0.2, 12)[:, None]
    seen = np.ones(frames.shape[:2], bool)
    seen[:, ::7] = False
    arrays = {
        "object_points": frames * [1, -1, -1],
        "object_colors": np.zeros_like(frames),
        "object_visibilities": seen,
        "object_motions_valid": np.concatenate([np.ones_like(seen)[:-1], seen[:1] & False]),
        "controller_points": held * [1, -1, -1],
        "surface_points": np.zeros((0, 3)),
    }
    folder = folder / ("double_lift_cloth_1" if hands == 2 else "single_lift_cloth")
    folder.mkdir()
    (folder / "final_data.pkl").write_bytes(pickle.dumps(arrays | changes))
    return folder


@pytest.mark.parametrize("hands", [1, 2])
def test_a_case_is_a_sheet_that_hands_lift(tmp_path: Path, hands: int):
    recording = read_case(case(tmp_path, hands))
    info = recording.info
    assert sorted(info.sheet.size) == pytest.approx([0.3, 0.4], abs=1e-6)
    path = np.asarray(recording.gripper_path)
    assert len(info.sheet.pinned) == path.shape[1] == hands
    np.testing.assert_allclose(path[-1, :, 2] - path[0, :, 2], 0.2, atol=1e-6)
    away = np.linalg.norm(path[0, :, None] - CORNERS[:hands], axis=-1)
    assert away.min(axis=0).max() < 1e-6
    np.testing.assert_allclose(recording.times, np.arange(12) / 30, atol=1e-6)
    assert np.all(np.asarray(recording.mask).sum(axis=1) == 336 - 48)  # the last frame's, too
    assert info.table_height == pytest.approx(0, abs=1e-9)


def test_a_case_that_is_none_is_named(tmp_path: Path):
    folder = case(tmp_path)
    sheet = SheetPlacement(
        (0.4, 0.3), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), ("warp", "opposite")
    )
    with pytest.raises(ValueError, match="1 hands hold the sheet, found 2 corners"):
        read_case(folder, sheet)
    with pytest.raises(FileNotFoundError, match="no such case of PhysTwin"):
        read_case(tmp_path)
    file = folder / "final_data.pkl"
    stored = pickle.loads(file.read_bytes())
    for change, words in (
        (
            {"controller_points": stored["controller_points"][:5]},
            "controller_points must have the shape",
        ),
        ({"object_visibilities": stored["object_visibilities"] & False}, "no point was seen in"),
    ):
        file.write_bytes(pickle.dumps(stored | change))
        with pytest.raises(ValueError, match=words):
            read_case(folder)
    file.write_bytes(pickle.dumps({"object_points": Path("code that runs")}))
    with pytest.raises(ValueError, match="which is no array"):
        read_case(folder)
    file.write_bytes(b"nothing")
    with pytest.raises(ValueError, match="no arrays of PhysTwin"):
        read_case(folder)
