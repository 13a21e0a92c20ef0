"""What commands share: arguments, fabrics by name or card, experiments by name, printed results."""

import inspect
import json
import math
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from r2s.estimation.cards import Card
    from r2s.materials.fabric import Fabric
    from r2s.scenarios import Experiment

A_VERTEX = 2.5e4  # [byte] of a mesh and its elimination, at least (100 x 100 vertices)
NOT_NUMBERS = {"path", "route", "size", "pinned"}  # parameters of an experiment that are no numbers
ScenarioName = Literal["lifting", "wind", "stretching", "folding", "fling", "shaking"]
Scenario = Annotated[
    Positional[ScenarioName], arg(metavar="SCENARIO", help="A scenario of the study.")
]
RecordingPath = Annotated[
    Positional[Path],
    arg(metavar="RECORDING", help="NPZ, or folder of numbered clouds or of RGB-D images."),
]
FabricName = Annotated[
    str,
    arg(
        metavar="PRESET|CARD",
        help="A preset of `r2s.materials.presets`, or the file of a fabric card.",
    ),
]
Motion = Annotated[
    tuple[str, ...],
    arg(
        metavar="NAME=NUMBER",
        help="Numbers of the motion, such as height=0.3 [m]; num_frames and interval [s], too.",
    ),
]
Shape = Annotated[tuple[int, int], arg(help="Vertices along warp and weft.")]
ChosenShape = Annotated[
    tuple[int, int] | None,
    arg(help="Vertices along warp and weft; by default as many as the fabric's folds need."),
]
SolverName = Annotated[Literal["cloth", "mpm"], arg(help="The implicit cloth, or material points.")]
Json = Annotated[bool, arg(help="Print one JSON object.")]


def check_picture(path: Path | None) -> None:
    """Raise `ImportError` or `FileNotFoundError`, before long work, where a picture can't be drawn
    or written; nothing for None."""
    from r2s._util.extras import require
    from r2s._util.files import check_folders

    if path is not None:
        require("matplotlib", "study", "--plot")
        check_folders(path)


def load_card(text: str) -> "Card":
    """Read the card of a preset, or the card in a file.

    Raises `ValueError` that names the presets when `text` is neither, or that of
    `r2s.estimation.cards.read`.
    """
    from r2s.estimation import cards
    from r2s.materials import presets

    if text in presets.MEASURED:
        return cards.preset(text)
    if not Path(text).exists():
        raise ValueError(
            f"{text}: no such card, and no preset; they are {', '.join(presets.MEASURED)}"
        )
    if Path(text).suffix.lower() == ".npz" or Path(text).is_dir():
        raise ValueError(f"{text}: this is a recording; a card (JSON) or a preset comes first")
    return cards.read(text)


def parse_numbers(motion: Iterable[str]) -> dict[str, float]:
    """Read texts NAME=NUMBER; raises `ValueError` that says what was expected."""
    numbers = {}
    for text in motion:
        name, _, value = text.partition("=")
        try:
            numbers[name] = float(value)
        except ValueError:
            message = f"--motion expects NAME=NUMBER, such as height=0.3, got {text}"
            raise ValueError(message) from None
    return numbers


def make_experiment(scenario: str, motion: Iterable[str]) -> "Experiment":
    """Make an experiment of `r2s.scenarios`; `ValueError` names the numbers that it takes."""
    from r2s import scenarios
    from r2s.scenarios.paths import LIMITS

    make = scenarios.SCENARIOS[scenario]
    known = {*LIMITS[scenario], *inspect.signature(make).parameters} - NOT_NUMBERS
    numbers: dict[str, Any] = {**parse_numbers(motion)}
    if unknown := sorted(set(numbers) - known):
        raise ValueError(
            f"{scenario} has no {', '.join(unknown)}; it takes {', '.join(sorted(known))}"
        )
    if "num_frames" in numbers:
        frames = numbers["num_frames"]
        if not float(frames).is_integer():
            raise ValueError(f"num_frames must be a whole number, got {frames:g}")
        numbers["num_frames"] = int(frames)
    try:
        return make(**numbers)
    except TypeError as error:
        raise ValueError(f"{scenario}: {error}") from None


def choose_shape(
    asked: tuple[int, int] | None, fabric: "Fabric", size: tuple[float, float], motion: str
) -> tuple[tuple[int, int], dict[str, Any], list[str]]:
    """The shape that was asked for, or else that of `r2s.scenarios.resolution`.

    Also what a result tells of it, and lines for people: the error it is expected to leave, or a
    warning where that is too large.
    """
    from r2s._util.threads import check
    from r2s.scenarios import resolution

    shape = asked or resolution.shape_for(fabric, size, motion)
    check(A_VERTEX * math.prod(shape), f"a mesh of {shape[0]} x {shape[1]}", "take a coarser one")
    error = resolution.mesh_error(fabric, size, shape, motion)
    figure = f"{1e3 * error:.1f} mm" if math.isfinite(error) else "not measured"
    words = f"mesh of {shape[0]} x {shape[1]}: expected error {figure}"
    content = {"shape": list(shape), "mesh_error_m": error}
    return shape, content, mesh_warning(shape, fabric, size, motion) or [words]


def mesh_warning(
    shape: tuple[int, int], fabric: "Fabric", size: tuple[float, float], motion: str
) -> list[str]:
    """A line where a mesh is too coarse for a fabric; none where it is not."""
    from r2s.scenarios import resolution

    text = resolution.warning(fabric, size, shape, motion)
    return [f"warning: {text}"] if text else []


def print_result(as_json: bool, content: Mapping[str, Any], lines: Iterable[str]) -> None:
    """Print one JSON object, with null for numbers that are not finite, or lines for people.

    Beside the object warnings go to the error stream.
    """
    if as_json:
        print(json.dumps(_finite(content), allow_nan=False))
        for line in lines:
            if line.startswith("warning: "):
                print(line, file=sys.stderr)
        return
    for line in lines:
        print(line)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
