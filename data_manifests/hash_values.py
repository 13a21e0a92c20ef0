"""Print the sha256 of the values of every array and cloud in a folder, as JSON.

    python data_manifests/hash_values.py FOLDER

The output is the `files` of a manifest: path in the folder -> sha256 of the values as
little-endian float32 in C order (`r2s.recordings.manifest.hash_values`).
"""

import argparse
import json
from pathlib import Path

from r2s.recordings.clouds import READERS, read_values
from r2s.recordings.manifest import hash_values


def hash_folder(folder: Path) -> dict[str, str]:
    """Path relative to `folder` -> hash, sorted, of the files that r2s can read."""
    files = sorted(p for p in folder.rglob("*") if p.suffix.lower() in READERS and p.is_file())
    return {file.relative_to(folder).as_posix(): hash_values(read_values(file)) for file in files}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path, help="holds the folders of the recordings")
    print(json.dumps(hash_folder(parser.parse_args().folder), indent=2))


if __name__ == "__main__":
    main()
