"""Recordings of a folder."""

from pathlib import Path

from r2s.recordings import manifest
from r2s.recordings.recording import Recording, load


def recordings_in(folder: Path, *scenarios: str) -> list[Recording]:
    """Read the recordings of some scenarios (all, when none is named) that lie in a folder.

    The folder holds NPZ files of r2s, or folders of clouds with a `manifest.json`. Raises
    `ValueError` when it holds none of these scenarios.
    """
    files = sorted(folder.glob("*.npz"))
    if files and not (folder / "manifest.json").exists():
        found = [r for r in map(load, files) if not scenarios or r.info.scenario in scenarios]
    else:
        rules = manifest.manifest_for(folder)
        names = manifest.read_recordings(folder, rules, scenarios or tuple(rules.scenarios))
        found = [manifest.read_recording(folder, rules, name) for name in names]
    if not found:
        raise ValueError(f"{folder}: no recording of {', '.join(scenarios) or 'any scenario'}")
    return found


def frames_of(recording: Recording) -> range:
    """The numbers of the frames that count."""
    return range(recording.info.frames_used[0], recording.info.frames_used[1] + 1)
