"""From a folder of RGB-D images to clouds and a recording: here, of a simulated lift.

    python examples/rgbd_folder.py

Needs OpenCV: pip install 'r2s[camera]'. Your own folder has the same layout (README).
"""

import tempfile
from pathlib import Path

import equinox as eqx
import numpy as np

import r2s
from r2s import scenarios
from r2s.materials import presets
from r2s.recordings.cameras import DepthCamera, look_at
from r2s.recordings.clouds import Cleaning
from r2s.recordings.recording import RecordingInfo, cloud, save
from r2s.recordings.rgbd import Rig, read_rig, rgbd_recording
from r2s.recordings.synthetic_rgbd import write_rgbd


def camera(place: tuple[float, float, float]) -> DepthCamera:
    """160 x 120 pixels from a place [m], depths in millimetres."""
    return DepthCamera(
        (160, 120), (144.0, 144.0), (79.5, 59.5), look_at(place, (0.2, 0.2, 0.1)), 1e-3
    )


if __name__ == "__main__":
    folder = Path(tempfile.mkdtemp()) / "lift_denim"
    experiment = scenarios.lifting(num_frames=16, interval=1 / 10, moving=1.5)
    scenario = experiment.scenario((7, 7))
    moved = eqx.filter_jit(r2s.rollout)(scenario, presets.black_denim())
    box = ((-0.1, -0.1, 0.0), (0.6, 0.6, 0.6))  # [m]
    rig = Rig(
        {"left": camera((-0.5, -0.2, 0.7)), "right": camera((0.5, -0.4, 0.8))},
        Cleaning(workspace=box, voxel=0.01),
    )
    faces = np.asarray(scenario.scene.mesh.faces)
    write_rgbd(folder, rig, np.asarray(moved.x), faces, experiment.times)
    print(f"images in {folder}: {len(list(folder.rglob('*.png')))} files")

    info = RecordingInfo(
        *("lift_denim", "lifting", "denim", "1", "simulated", experiment.frames_used),
        *(experiment.sheet, experiment.table_height, None),
    )
    grippers = experiment.route.path, experiment.route.times
    recording = rgbd_recording(folder, info, *grippers, rig=read_rig(folder))
    save(recording, folder / "lift_denim.npz")
    last = cloud(recording, 15)
    print(f"{len(recording.times)} frames, {len(last)} points in the last")
    print(f"highest {last[:, 2].max():.3f} m, the gripper {grippers[0][-1, 0, 2]:.3f} m")
