"""The commands of docs/guide/record.md, from folders of images to a card."""

import json
import re
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from folders import ROOT
from test_document_commands import commands

pytest.importorskip("cv2")
pytest.importorskip("trimesh")
import whole_scene as scenes  # noqa: E402

import r2s  # noqa: E402
from r2s._util.files import write_json  # noqa: E402
from r2s.estimation import cards  # noqa: E402
from r2s.recordings.clouds import Cleaning  # noqa: E402
from r2s.recordings.rgbd import Rig  # noqa: E402
from r2s.scenarios.scenario import rollout  # noqa: E402

GUIDE = ROOT / "docs" / "guide" / "record.md"
TEMPLATE = ROOT / "data_manifests" / "templates" / "study.json"
SIZE, SHAPE = (0.4, 0.4), (9, 9)
BOX = ((-0.1, -0.1, -0.02), (0.5, 0.5, 0.6))  # [m]
FAST = "--shape 5 5 --num-samples 2 --num-starts 1 --max-iterations 2".split()
FABRIC = r2s.presets.grey_interlock()
MOTIONS = {
    "lift_shirt": r2s.lifting(SIZE, num_frames=45),
    "lift_shirt2": r2s.lifting(SIZE, num_frames=45),
    "fold_shirt": r2s.folding(SIZE, num_frames=45),
}


@pytest.fixture(scope="module")
def motions() -> dict[str, np.ndarray]:
    """Places [m] of the vertices of a blue sheet in each frame of each recording."""
    scenarios = {name: motion.scenario(SHAPE) for name, motion in MOTIONS.items()}
    moved = {name: rollout(scenario, FABRIC).x for name, scenario in scenarios.items()}
    return {name: np.asarray(x) + [0, 0, 0.001] for name, x in moved.items()}


def given(folder: Path, motions: dict[str, np.ndarray], masks: bool) -> None:
    """What the guide asks for: images, cameras.json, paths of the gripper, and a manifest."""
    folder.mkdir()
    faces = np.asarray(r2s.rectangle(SIZE, SHAPE).faces)
    rig = Rig(scenes.cameras(2, across=200, masks=masks), Cleaning(BOX))
    for name, x in motions.items():
        bodies = [
            [scenes.Body(at, faces, scenes.BLUE), scenes.table(scenes.BEIGE), *scenes.arm(at[0])]
            for at in x
        ]
        scenes.write_scene(folder / name, rig, bodies, MOTIONS[name].times.tolist())
        np.save(folder / name / "gripper.npy", x[:, 0])
    cameras: dict[str, Any] = asdict(rig)
    if not masks:  # as the guide shows it
        (shown,) = re.findall(r'"segmentation": (\{.*?\]\})', GUIDE.read_text("utf-8"), re.DOTALL)
        cameras["segmentation"] = json.loads(shown)
    write_json(folder / "cameras.json", cameras)
    manifest = json.loads(TEMPLATE.read_text("utf-8"))
    for scenario in ("lift", "fold"):
        manifest["scenarios"][scenario]["sheet"]["size"] = SIZE
        manifest["scenarios"][scenario]["gripper"]["file"] = "{name}/gripper.npy"
    write_json(folder / "manifest.json", manifest)


@pytest.mark.slow(group="documents")
@pytest.mark.parametrize("masks", [True, False], ids=["masks", "no masks"])
def test_the_commands_of_the_guide_make_a_card(tmp_path: Path, motions, masks: bool) -> None:
    """As a reader types them, but that the estimate is a coarse and short one."""
    given(tmp_path / "mine", motions, masks)
    typed = commands(GUIDE.read_text("utf-8"))
    assert [each[0] for each in typed] == ["data", "check", "show", "estimate"]
    for arguments in typed:
        more = FAST if arguments[0] == "estimate" else []
        line = [sys.executable, "-m", "r2s", *arguments, *more]
        done = subprocess.run(line, capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0, f"r2s {' '.join(arguments)}: {done.stderr[-2000:]}"
    card = cards.read(tmp_path / "shirt.json")
    assert float(card.fabric.density) == pytest.approx(0.24, rel=0.2)
    assert {name for name, _ in card.provenance.recordings} >= {"lift_shirt", "lift_shirt2"}
    assert list((tmp_path / "pictures").iterdir())
