"""Twelve scenes with table, arm and clutter: cuts leave the cloth, and hardly anything else."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import whole_scene as scenes
from whole_scene import BEIGE, BLUE, GREEN, GREY, ORANGE, RED, SIDE, WHITE

from r2s.recordings.clouds import Cleaning
from r2s.recordings.recording import CORNERS, SheetPlacement
from r2s.recordings.rgbd import Rig, read_clouds
from r2s.recordings.segmentation import Arm, Segmentation, Segmenter

BOX = ((-0.35, -0.35, -0.05), (0.75, 0.75, 0.9))
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
DARK = (60, 50, 45)
AS_BLUE = ((200.0, 0.3, 0.15), (255.0, 1.0, 1.0))
AS_RED = ((340.0, 0.55, 0.2), (12.0, 1.0, 1.0))
AS_WHITE = ((0.0, 0.0, 0.55), (360.0, 0.12, 1.0))
LIES = SheetPlacement((SIDE, SIDE), (0.0, 0.0, 0.0), X, Y, ("origin",))
HANGS = SheetPlacement((SIDE, SIDE), (0.0, SIDE / 2, 0.1), X, Z, ("weft", "opposite"))
STEEP, BACK = (-0.4, -0.5, 0.75), (0.0, 0.6, 0.8)
CLUTTER = [
    scenes.box((0.08, 0.12, 0.1), (-0.15, 0.3, 0.05), GREEN, 20),
    scenes.rod((0.55, 0.1, 0), (0.55, 0.1, 0.11), 0.04, ORANGE),
    scenes.box((0.12, 0.05, 0.2), (0.3, 0.6, 0.1), GREY, 70),
]
TWIN = [*CLUTTER, scenes.rod((-0.2, -0.05, 0), (-0.2, -0.05, 0.1), 0.04, BLUE)]  # of the cloth's
CLOSE = [*CLUTTER, scenes.box((0.06, 0.1, 0.25), (0.2, 0.32, 0.125), ORANGE, 10)]  # colour

# name: sheet at rest, its positions in each frame, colours of sheet and table, the arms' direction,
# clutter, tilt of the table [degrees], and the cuts
SCENES = {
    "flat": (LIES, [scenes.lying()] * 2, BLUE, BEIGE, [Z], CLUTTER, 0.0, {"colour": AS_BLUE}),
    "flat beside its colour": (
        *(LIES, [scenes.lying(0.01)] * 2, BLUE, BEIGE, [STEEP], TWIN, 1.0),
        {"colour": AS_BLUE, "table_margin": 0.01},
    ),
    "lifted": (
        *(LIES, [scenes.lying(0.01, h) for h in (0.1, 0.2)], RED, GREY, [Z], CLUTTER, 0.0),
        {"colour": AS_RED},
    ),
    "lifted white": (
        *(LIES, [scenes.lying(0.02, h) for h in (0.0, 0.2)], WHITE, DARK, [STEEP], CLUTTER, 0.5),
        {"colour": AS_WHITE},
    ),
    "fold begun": (
        *(LIES, [scenes.folded(a) for a in (30, 60)], BLUE, BEIGE, [Z], CLUTTER, 0.0),
        {"colour": AS_BLUE},
    ),
    "half folded": (
        *(LIES, [scenes.folded(a) for a in (90, 120)], RED, BEIGE, [STEEP], TWIN, 0.0),
        {"colour": AS_RED, "table_margin": 0.01},
    ),
    "folded": (
        *(LIES, [scenes.folded(a) for a in (150, 175)], BLUE, BEIGE, [Z], TWIN, 1.5),
        {"colour": AS_BLUE},
    ),
    "folded white": (
        *(LIES, [scenes.folded(a) for a in (100, 170)], WHITE, DARK, [Z], CLUTTER, 0.0),
        {"colour": AS_WHITE},
    ),
    "hanging": (
        *(HANGS, [scenes.hanging(0.1, s) for s in (0.0, 0.05)], BLUE, BEIGE, [Z], CLUTTER, 0.0),
        {"table_margin": 0.015},
    ),
    "hanging from outstretched arms": (
        *(
            HANGS,
            [scenes.hanging(0.15)] * 2,
            WHITE,
            WHITE,
            [(-1.0, 0.0, 0.2), (1.0, 0.0, 0.2)],
            CLUTTER,
        ),
        *(1.5, {"table_margin": 0.02}),
    ),
    "hanging low": (
        *(HANGS, [scenes.hanging(0.05, s) for s in (0.03, -0.03)], RED, RED, [BACK], CLUTTER, -1.0),
        {"table_margin": 0.015},
    ),
    "hanging in clutter": (
        *(HANGS, [scenes.hanging(0.1)] * 2, BLUE, BEIGE, [Z], CLOSE, 0.0),
        {"table_margin": 0.015, "colour": AS_BLUE},
    ),
}


def measured(folder: Path, name: str) -> list[tuple[float, float]]:
    """For each frame the share of the cloth's points that are kept, and of others among them."""
    place, moved, colour, ground, outwards, clutter, tilt, cuts = SCENES[name]
    ends = np.array([CORNERS[name] for name in place.pinned]) * SIDE
    held = [int(np.linalg.norm(scenes.REST - end, axis=1).argmin()) for end in ends]
    path = np.stack([x[held] for x in moved])
    frames = []
    for x, grippers in zip(moved, path, strict=True):
        pairs = zip(grippers, outwards * (len(grippers) // len(outwards)), strict=True)
        arms = [part for gripper, axis in pairs for part in scenes.arm(gripper, axis)]
        table = scenes.table(ground, tilt)
        frames.append([scenes.sheet(x, colour), table, *arms, *clutter])
    how = Segmentation(
        arms=tuple(
            Arm(axis, 0.06, 0.8, grippers=(i,) if len(outwards) > 1 else ())
            for i, axis in enumerate(outwards)
        ),
        gripper_radius=0.02,
        **cuts,
    )
    rig = Rig(scenes.cameras(), Cleaning(BOX, voxel=0.0, neighbours=0))
    times = np.arange(len(frames)) / 15
    scenes.write_scene(folder, rig, frames, list(times))
    segmenter = Segmenter(how, place, 0.0, path, times, name)
    kept = read_clouds(folder, rig, segmenter=segmenter)[1]
    masked = {n: replace(view, masks=True) for n, view in rig.cameras.items()}
    true = read_clouds(folder, replace(rig, cameras=masked))[1]
    return [scenes.shares(*pair) for pair in zip(kept, true, strict=True)]


@pytest.mark.slow(group="documents")
@pytest.mark.parametrize("name", SCENES)
def test_the_cloth_is_kept_and_others_are_cut(tmp_path: Path, name: str) -> None:
    for kept, others in measured(tmp_path, name):
        print(f"{name}: {kept:.2%} kept, {others:.2%} others")
        assert kept >= 0.98
        assert others <= 0.01
