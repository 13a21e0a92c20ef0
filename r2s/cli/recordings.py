"""Commands on recordings: `r2s check`, `r2s show` and `r2s data`."""

from dataclasses import dataclass
from math import isnan
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg, subcommand

from r2s.cli.common import Json, RecordingPath


@dataclass(frozen=True)
class Check:
    """Check a recording for mistakes.

    Looks at the scale, gravity and table where the whole sheet is seen at rest, at how far points
    are from the grippers, whether markers or the whole sheet stretch, the frames' times, how late
    the top of the cloud follows the grippers, the number of points, outliers, and crops; at points
    at one place or behind the cameras, where nothing was measured; and whether each depth camera
    fits the sheet at rest and the others. What a recording does not show is said to be not shown.
    Exit code 1 when something is suspicious.

        r2s check recordings/lift_tan
        r2s check lift.npz --json
    """

    recording: RecordingPath
    json: Json = False

    def run(self) -> int:
        from r2s.cli.common import print_result
        from r2s.recordings.checks import check
        from r2s.recordings.open import open_recording

        findings = check(open_recording(self.recording))
        suspicious = sum(each.is_suspicious for each in findings)
        content = {"suspicious": suspicious, "findings": [each._asdict() for each in findings]}
        hidden, count = sum(isnan(each.figure) for each in findings), len(findings)
        total = f"{suspicious} of {count} suspicious" if suspicious else "nothing suspicious"
        if hidden:
            total += f"; {hidden} of {count} checks were not possible"
        print_result(self.json, content, [*(each.describe() for each in findings), total])
        return int(suspicious > 0)


@dataclass(frozen=True)
class Show:
    """Draw a recording: a contact sheet and a video.

    Both show clouds, grippers and, with --trajectory, a simulated sheet, in one scale, in metres.
    RECORDING is an NPZ of r2s, or a folder of frames with its manifest.json beside it; without one,
    the manifest of DIFFCLOUD is taken.

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


Manifests = Annotated[
    Path | None,
    arg(
        metavar="FOLDER",
        help="Descriptions of other data sets, one JSON each, instead of the project's.",
    ),
]


@dataclass(frozen=True)
class Fetch:
    """Verify a public data set in a folder, or say how to get it.

    A corrupt file is named. For a missing one it says the licence, how to get it, and where to put
    it: none of the data sets may be downloaded without a person. Then run it again.

        r2s data fetch diffcloud --to recordings
    """

    name: Annotated[Positional[str], arg(metavar="NAME")]
    """Name of the data set; `r2s data list` shows them."""
    to: Annotated[Path, arg(metavar="FOLDER")]
    """Where it is, or shall be."""
    manifests: Manifests = None

    def run(self) -> None:
        from r2s.recordings.datasets import fetch

        for line in fetch(self.name, self.to, self.manifests):
            print(line)


@dataclass(frozen=True)
class List:
    """List the public data sets that r2s knows: name, title, licence, and how each is got."""

    manifests: Manifests = None
    json: Json = False

    def run(self) -> None:
        from r2s.cli.common import print_result
        from r2s.recordings.datasets import known_datasets

        result, lines = {}, []
        for name, data in known_datasets(self.manifests).items():
            result[name] = {"title": data.title, "licence": data.licence, "automatic": False}
            lines += [f"{name}: {data.title}", f"    licence: {data.licence}"]
            lines.append("    fetched by hand")
        print_result(self.json, result, lines)


@dataclass(frozen=True)
class Convert:
    """Read recordings, of RGB-D images or of point clouds, and write each as one NPZ of r2s.

    FOLDER has a manifest.json and a folder for each recording, or is the folder of one. Where there
    is a cameras.json, in a recording's folder or above, that holds images, else numbered clouds.
    Where a segmentation is given there, the cloth is cut out of what was seen without masks, and
    the share of each cut is printed. What was converted already is skipped, unless the files that
    it was made from have changed.
    Recordings that cannot be read are named, with file and frame, after the others were converted.

        r2s data convert recordings --to canonical
        r2s data convert recordings --only '^lift_' --to canonical --plot
    """

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """A folder of recordings, or of one."""
    to: Annotated[Path, arg(metavar="OUT")]
    """Where NAME.npz goes, and NAME.sha256 of what it was made from; made when it is not there."""
    only: Annotated[str, arg(metavar="REGEX")] = ""
    """Convert those whose name matches this regular expression."""
    force: bool = False
    """Convert again what is up to date, as after an update of r2s."""
    plot: bool = False
    """Draw NAME_cuts.png beside NAME.npz: what a segmentation cut off, and what is left."""

    def run(self) -> None:
        from r2s.recordings.open import convert
        from r2s.viewer.cuts import draw_cuts

        draw = draw_cuts if self.plot else None
        for line in convert(self.folder, self.to, self.only, self.force, draw):
            print(line)


@dataclass(frozen=True)
class Data:
    """Convert your recordings, and get public ones."""

    command: Annotated[
        Annotated[Fetch, subcommand("fetch")]
        | Annotated[List, subcommand("list")]
        | Annotated[Convert, subcommand("convert")],
        arg(name=""),
    ]

    def run(self) -> None:
        self.command.run()
