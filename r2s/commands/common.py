"""What commands share: fabrics by name or card, experiments by name, what is printed."""

import inspect
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from r2s.estimation.cards import Card
    from r2s.recordings.recording import Recording
    from r2s.scenarios import Experiment

NO_NUMBERS = {"path", "route", "size", "held"}
ScenarioName = Literal["lifting", "wind", "stretching", "folding", "fling", "shaking"]


def card_of(text: str) -> "Card":
    """The card of a preset, or that in a file.

    Raises `ValueError` that names the presets for what is neither; as `r2s.estimation.cards.read`.
    """
    from r2s.estimation import cards
    from r2s.fabrics import presets

    if text in presets.MEASURED:
        return cards.preset(text)
    if not Path(text).exists():
        raise ValueError(
            f"{text}: no such card, and no preset; they are {', '.join(presets.MEASURED)}"
        )
    return cards.read(text)


def numbers_of(motion: Iterable[str]) -> dict[str, float]:
    """From NAME=NUMBER each; `ValueError` says what was expected."""
    found = {}
    for text in motion:
        name, _, value = text.partition("=")
        try:
            found[name] = float(value)
        except ValueError:
            message = f"--motion expects NAME=NUMBER, such as height=0.3, got {text}"
            raise ValueError(message) from None
    return found


def experiment_of(scenario: str, motion: Iterable[str], **others: Any) -> "Experiment":
    """An experiment of `r2s.scenarios` with these numbers; `ValueError` names those it takes."""
    from r2s import scenarios
    from r2s.scenarios import paths as trajectories

    make = scenarios.SIX[scenario]
    known = {*trajectories.LIMITS[scenario], *inspect.signature(make).parameters} - {
        "path",
        "route",
        "size",
        "held",
    }
    numbers: dict[str, Any] = {**numbers_of(motion), **others}
    if unknown := sorted(set(numbers) - known):
        raise ValueError(
            f"{scenario} has no {', '.join(unknown)}; it takes {', '.join(sorted(known))}"
        )
    for name in {"num_frames"} & set(numbers):
        numbers[name] = int(numbers[name])
    try:
        return make(**numbers)
    except TypeError as error:
        raise ValueError(f"{scenario}: {error}") from None


def recordings_of(paths: Sequence[Path]) -> Iterator["Recording"]:
    """The recordings of NPZ files, of folders of them, or of folders of clouds or images."""
    from r2s.recordings.recording import load
    from r2s.viewer.pictures import open_recording

    for path in paths:
        inside = sorted(path.glob("*.npz")) if path.is_dir() else []
        if inside and not (path / "manifest.json").exists():
            yield from map(load, inside)
        else:
            yield open_recording(path)


def tell(as_json: bool, content: Mapping[str, Any], lines: Iterable[str]) -> None:
    """Print one JSON object with what is not finite as null, or lines for people."""
    if as_json:
        print(json.dumps(_finite(content), allow_nan=False))
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
