"""The file of a search, from which it continues."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from r2s.files import write_bytes


def write(
    path: Path | str, kind: str, arrays: Mapping[str, np.ndarray], settings: Mapping[str, int]
) -> None:
    """Write arrays and the settings of their search, whole or not at all."""
    buffer = io.BytesIO()
    stored: dict[str, Any] = {**arrays, **settings}
    np.savez(buffer, format=kind, **stored)
    write_bytes(path, buffer.getvalue())


def read(
    path: Path | str, kind: str, names: Sequence[str], settings: Mapping[str, int]
) -> list[np.ndarray]:
    """The arrays that `write` wrote.

    Raises `ValueError` that names the file when it is damaged, or of another kind or search.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            stored = {name: file[name] for name in file.files}
        found = {name: int(stored[name]) for name in settings}
        arrays = [stored[name] for name in names]
        is_of = stored["format"]
    except Exception as error:  # a damaged file raises anything
        raise ValueError(f"{path}: no history of a search: {error}") from error
    if is_of != kind:
        raise ValueError(f"{path}: expected format {kind}, found {is_of}")
    if found != settings:
        raise ValueError(
            f"{path}: is of a search with {found}, asked for {settings}: choose another"
        )
    return arrays
