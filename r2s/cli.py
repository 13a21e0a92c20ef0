"""The command line `r2s`: data, pictures, plans, simulations, estimates. `r2s --help` begins.

Exit codes: 0; 1 for an error, in one line on stderr; 2 for wrong usage. A command is a dataclass,
whose fields are its arguments, with a method `run`; its docstring is its help. What it needs is
imported there, so that help comes at once. Those of simulation and estimate are in `r2s.commands`.
"""

import os
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

try:
    import tyro
    from tyro.conf import (
        FlagCreatePairsOff,
        OmitArgPrefixes,
        OmitSubcommandPrefixes,
        Positional,
        arg,
        subcommand,
    )
except ImportError:
    sys.exit("r2s: error: the command line needs tyro: pip install 'r2s[cli]'")

from r2s.commands.check_grad import CheckGrad
from r2s.commands.common import ScenarioName, numbers_of, tell
from r2s.commands.doctor import Doctor
from r2s.commands.estimate import EstimateCard
from r2s.commands.evaluate import Evaluate
from r2s.commands.export import Export
from r2s.commands.simulate import Simulate
from r2s.commands.study import Study
from r2s.commands.view import View
from r2s.study.environment import one_core, one_thread


@dataclass(frozen=True)
class Fetch:
    """Bring a public data set into a folder, and verify it.

    Files that are there and are what was published are left alone; a download that broke off goes
    on where it ended. A corrupt file is named and never replaced unasked. What cannot be downloaded
    automatically is said, with its licence, how to get it, and where to put it. Run it again then:
    it checks what is there.

        r2s data fetch diffcloud --to recordings
    """

    name: Annotated[Positional[str], arg(metavar="NAME")]
    """Of the data set; `r2s data list` shows them."""
    to: Annotated[Path, arg(metavar="FOLDER")]
    """Where it is, or shall be."""
    manifests: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Descriptions of other data sets, one JSON each, instead of the project's."""

    def run(self) -> None:
        from r2s.recordings.datasets import fetch

        for line in fetch(self.name, self.to, self.manifests):
            print(line)


@dataclass(frozen=True)
class List:
    """List the public data sets that r2s knows: name, title, licence, and how each is got."""

    manifests: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Descriptions of other data sets, one JSON each, instead of the project's."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        from r2s.recordings.datasets import Dataset, known_datasets

        told, lines = {}, []
        for name, data in known_datasets(self.manifests).items():
            automatic = isinstance(data, Dataset) and bool(data.downloads) and not data.layout
            about = {"title": data.title, "licence": data.licence, "automatic": automatic}
            told[name] = about
            lines += [f"{name}: {data.title}", f"    licence: {data.licence}"]
            lines.append(f"    {'downloaded automatically' if automatic else 'fetched by hand'}")
        tell(self.json, told, lines)


@dataclass(frozen=True)
class Convert:
    """Read recordings, of RGB-D images or of point clouds, and write each as one NPZ of r2s.

    FOLDER has a manifest.json and a folder for each recording, or is the folder of one. Where there
    is a cameras.json, in a recording's folder or above, that holds images, else numbered clouds.
    What was converted already is skipped, unless the files that it was made from have changed.
    Recordings that cannot be read are named, with file and frame, after the others were converted.

        r2s data convert recordings --to canonical
        r2s data convert recordings --only '^lift_' --to canonical
    """

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """Of recordings, or of one."""
    to: Annotated[Path, arg(metavar="OUT")]
    """Where NAME.npz goes, and NAME.sha256 of what it was made from; made when it is not there."""
    only: Annotated[str, arg(metavar="REGEX")] = ""
    """Convert those whose name matches this regular expression."""
    force: bool = False
    """Convert again what is up to date, as after an update of r2s."""

    def run(self) -> None:
        from r2s.recordings.convert import convert

        for line in convert(self.folder, self.to, self.only, self.force):
            print(line)


@dataclass(frozen=True)
class Data:
    """Recordings: which are public and how to get them, and how yours become those of r2s."""

    command: Annotated[
        Annotated[Fetch, subcommand("fetch")]
        | Annotated[List, subcommand("list")]
        | Annotated[Convert, subcommand("convert")],
        arg(name=""),
    ]

    def run(self) -> None:
        self.command.run()


@dataclass(frozen=True)
class Show:
    """Draw a recording: a contact sheet (PNG) and a video of clouds, grippers and simulated cloth.

    All panels have one scale, in metres. RECORDING is an NPZ of r2s, or a folder of frames with
    its manifest.json beside it; without one, the manifest of DIFFCLOUD is taken.

        r2s show recordings/lift_tan --out pictures
        r2s show lift.npz --trajectory simulated.npz --out pictures --video gif
    """

    recording: Annotated[Positional[Path], arg(metavar="RECORDING")]
    """NPZ, or folder of numbered clouds or of RGB-D images."""
    out: Annotated[Path, arg(metavar="FOLDER")]
    """Where the pictures go; it is made when it is not there."""
    trajectory: Annotated[Path | None, arg(metavar="FILE")] = None
    """NPZ with x (frame, vertex, 3) [m], at the recording's frames, and faces (face, 3)."""
    video: Literal["auto", "gif", "mp4", "none"] = "auto"
    """auto: an MP4 where OpenCV is installed, else a GIF."""

    def run(self) -> None:
        from r2s.viewer.pictures import load_trajectory, open_recording, show

        cloth = None if self.trajectory is None else load_trajectory(self.trajectory)
        for path in show(open_recording(self.recording), self.out, cloth, self.video):
            print(path)


@dataclass(frozen=True)
class Sensitivity:
    """Say what a planned motion would reveal of a fabric, before anybody makes it.

    Simulates the motion with a preset that is like the fabric, as seen by two depth cameras, and
    prints how well each parameter would be known, and which combinations where one is not.
    Numbers of the motion are those of `r2s.scenarios.paths`, in SI units.

        r2s sensitivity lifting --fabric black_denim --motion height=0.3 moving=2
        r2s sensitivity wind --fabric grey_interlock --motion speed=3 --noise 0.002
    """

    scenario: Annotated[Positional[ScenarioName], arg(metavar="SCENARIO")]
    """Of the study."""
    fabric: str = "grey_interlock"
    """A preset of `r2s.fabrics.presets`."""
    motion: Annotated[tuple[str, ...], arg(metavar="NAME=NUMBER")] = ()
    """Numbers of the motion, such as height=0.3 [m]."""
    noise: float = 1e-3
    """Of each coordinate of a point, a standard deviation [m]."""
    seed: int = 0
    """Of the noise."""
    json: bool = False
    """Print one JSON object: that of an estimate."""

    def run(self) -> None:
        from r2s.estimation.estimate import describe
        from r2s.estimation.estimate_json import as_json
        from r2s.estimation.experiment_design import evaluate_design

        numbers = numbers_of(self.motion)
        found = evaluate_design(self.scenario, self.fabric, numbers, self.noise, self.seed)
        tell(self.json, as_json(found), describe(found))


Command = (
    Annotated[Data, subcommand("data")]
    | Annotated[Show, subcommand("show")]
    | Annotated[Sensitivity, subcommand("sensitivity")]
    | Annotated[Simulate, subcommand("simulate")]
    | Annotated[EstimateCard, subcommand("estimate")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Export, subcommand("export")]
    | Annotated[CheckGrad, subcommand("check-grad")]
    | Annotated[Doctor, subcommand("doctor")]
    | Annotated[Study, subcommand("study")]
    | Annotated[View, subcommand("view")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line (None: that of the process); the exit code.

    Raises SystemExit, with 0 after --help and 2 after a wrong usage, whose message is on stderr.
    """
    try:
        command = tyro.cli(
            Command,  # pyright: ignore[reportArgumentType]
            prog="r2s",
            description="r2s: real-to-sim for fabrics. Each command tells more with --help.",
            args=arguments,
            config=(OmitArgPrefixes, OmitSubcommandPrefixes, FlagCreatePairsOff),
        )
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            return command.run() or 0
    except BrokenPipeError:  # whoever read the output had enough
        sys.stdout = None
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        print(f"r2s: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("r2s: error: interrupted", file=sys.stderr)
        return 1
    return 0


def command() -> int:
    """`main` in a process of its own."""
    os.environ["XLA_FLAGS"] = one_thread(os.environ.get("XLA_FLAGS", ""))  # JAX has not begun yet
    if sys.argv[1:2] in (["estimate"], ["view"]):  # others mostly compile, faster on all cores
        one_core()
    return main()


def _warn(message, *_, **__) -> None:
    print(f"r2s: warning: {message}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(command())
