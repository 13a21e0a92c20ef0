"""Files that are written whole or not at all."""

import contextlib
import json
import os
import shutil
from pathlib import Path
from typing import Any


def write_bytes(path: Path | str, data: bytes) -> None:
    """Write `data` to `path`: a reader finds the old file or the new one, never a part.

    Raises OSError (of the kind that the system gave) that names `path`, the size of the data and
    the free space; no temporary file is left behind.
    """
    path = Path(path)
    # In the same folder, since os.replace cannot cross file systems.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(data)
        os.replace(temporary, path)
    except OSError as error:
        reason = error.strerror or str(error)
        message = f"cannot write {path} ({len(data)} bytes; {_free(path.parent)}): {reason}"
        raise OSError(error.errno, message) from error
    finally:
        with contextlib.suppress(OSError):  # it is gone already when all went well
            temporary.unlink()


def write_text(path: Path | str, text: str) -> None:
    """Write `text` as UTF-8 to `path`, whole or not at all; raises as `write_bytes`."""
    write_bytes(path, text.encode())


def write_json(path: Path | str, value: Any) -> None:
    """Write `value` as JSON to `path`, whole or not at all.

    Raises ValueError for NaN and infinities (which JSON lacks), TypeError for what JSON cannot
    hold, and OSError as `write_bytes`.
    """
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def _free(folder: Path) -> str:
    try:
        return f"{shutil.disk_usage(folder).free} bytes free in {folder}"
    except OSError:
        return f"folder {folder} is missing or cannot be read"
