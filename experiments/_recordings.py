"""Recordings of a folder."""

from pathlib import Path

from r2s.recordings import manifest
from r2s.recordings.recording import Recording, load


def recordings_in(folder: Path, scenario: str) -> list[Recording]:
    """Read the recordings of a scenario that lie in a folder.

    The folder holds NPZ files of r2s, or folders of clouds with a `manifest.json`. Raises
    `ValueError` when it holds none of this scenario.
    """
    files = sorted(folder.glob("*.npz"))
    if files and not (folder / "manifest.json").exists():
        found = [recording for recording in map(load, files) if recording.info.scenario == scenario]
    else:
        rules = manifest.manifest_for(folder)
        names = manifest.read_recordings(folder, rules, [scenario])
        found = [manifest.read_recording(folder, rules, name) for name in names]
    if not found:
        raise ValueError(f"{folder}: no recording of {scenario}")
    return found
