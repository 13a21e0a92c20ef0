"""`r2s show`: pictures of a recording."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from r2s.cli.common import RecordingPath


@dataclass(frozen=True)
class Show:
    """Draw a recording: a contact sheet (PNG) and a video of clouds, grippers and simulated cloth.

    All panels have one scale, in metres. RECORDING is an NPZ of r2s, or a folder of frames with
    its manifest.json beside it; without one, the manifest of DIFFCLOUD is taken.

        r2s show recordings/lift_tan --out pictures
        r2s show lift.npz --trajectory simulated.npz --out pictures --video gif
    """

    recording: RecordingPath
    out: Annotated[Path, arg(metavar="FOLDER")]
    """Where the pictures go; it is made when it is not there."""
    trajectory: Annotated[Path | None, arg(metavar="FILE")] = None
    """NPZ with x (frame, vertex, 3) [m], at the recording's frames, and faces (face, 3)."""
    video: Literal["auto", "gif", "mp4", "none"] = "auto"
    """auto: an MP4 where OpenCV is installed, else a GIF."""

    def run(self) -> None:
        from r2s.recordings.open import load_trajectory, open_recording
        from r2s.viewer.pictures import show

        cloth = None if self.trajectory is None else load_trajectory(self.trajectory)
        for path in show(open_recording(self.recording), self.out, cloth, self.video):
            print(path)
