"""Files damaged in thousands of ways: each is read, or refused by one error that names it.

`R2S_FUZZED=20000 make test-slow GROUP=documents` reads as many of each kind as before a release.
"""

import faulthandler
import os
import re
import shutil
import signal
import tempfile
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random

import pytest

for needed in ("cv2", "h5py", "trimesh", "pypcd4"):
    pytest.importorskip(needed)

from conftest import most_memory  # noqa: E402
from fuzzed_files import KINDS, Kind  # noqa: E402
from mutations import mutated  # noqa: E402

COUNT = int(os.environ.get("R2S_FUZZED", "5000"))  # damaged files of each kind
LONGEST = 10.0  # [s] to read one
MOST_MEMORY = 2000.0  # [MB]
LONGEST_ERROR = 2000  # characters
IN_MEMORY = Path("/dev/shm")  # a file system that is quick, where there is one


class Hangs(BaseException):
    """Nothing that a reader catches."""


@contextmanager
def limited() -> Iterator[None]:
    """Raise `Hangs` after `LONGEST`; end the process where a library does not even return."""

    def stop(*_) -> None:
        raise Hangs

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, LONGEST)
    faulthandler.dump_traceback_later(6 * LONGEST, exit=True)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        faulthandler.cancel_dump_traceback_later()
        signal.signal(signal.SIGALRM, before)


def fault(kind: Kind, path: Path) -> str:
    """What is wrong with how a file is refused; empty if it is read, or refused as it should be."""
    before = most_memory()
    try:
        with limited():
            kind.read(path)
    except (KeyboardInterrupt, GeneratorExit):
        raise
    except BaseException as error:
        words, last = str(error), traceback.extract_tb(error.__traceback__)[-1]
        where = f"{type(error).__name__} at {last.filename.rpartition('/')[2]}:{last.lineno}"
        is_named = type(error) is ValueError or (isinstance(error, OSError) and error.filename)
        if not is_named and type(error) is not FileNotFoundError:
            return f"{where}: {words[:120]}"
        if str(path.parent) not in words and str(path.parent) not in str(
            getattr(error, "filename", "")
        ):
            return f"{where}: the file is not named: {words[:120]}"
        if len(words) > LONGEST_ERROR:
            return f"{where}: an error of more than {LONGEST_ERROR} characters: {words[:120]}"
    if most_memory() - before > MOST_MEMORY:
        return f"{most_memory() - before:.0f} MB"
    return ""


def damage(path: Path, whole: dict[Path, bytes], rng: Random) -> None:
    """Write files anew, of which one is damaged, missing, empty, a folder, or another."""
    if not path.is_dir():
        path.write_bytes(mutated(path.suffix, whole[path], rng))
        return
    for file in set(path.rglob("*")) - set(whole):
        if file.is_file():
            file.unlink()
    for file, data in whole.items():
        if file.is_dir():
            file.rmdir()
        file.write_bytes(data)
    files = sorted(whole)
    chosen, other = rng.choice(files), rng.choice(files)
    match rng.randrange(10):
        case 0:
            chosen.unlink()
        case 1:
            chosen.unlink()
            chosen.mkdir()
        case 2:
            chosen.write_bytes(whole[other])
        case 3:
            names = (f"{rng.randrange(10**12)}", "x", "1e5", "00" + chosen.stem, chosen.stem + "_2")
            chosen.rename(chosen.with_stem(rng.choice(names)))
        case _:
            chosen.write_bytes(mutated(chosen.suffix, whole[chosen], rng))


def faults(kind: Kind, folder: Path, seeds: range) -> dict[str, list[int]]:
    """What is wrong with how damaged files are refused, and the seeds of those."""
    path, found = folder / kind.name, {}
    kind.write(path)
    kind.read(path)
    whole = {
        file: file.read_bytes()
        for file in (path.rglob("*") if path.is_dir() else [path])
        if file.is_file()
    }
    for seed in seeds:
        damage(path, whole, Random(f"{kind.name} {seed}"))
        if words := fault(kind, path):
            found.setdefault(re.sub(r"\d{3,}", "N", words), []).append(seed)
    return found


@pytest.mark.slow(group="documents")
@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", KINDS, ids=[kind.name for kind in KINDS])
def test_a_damaged_file_is_read_or_refused_by_name(kind: Kind) -> None:
    if kind.name.endswith(".e57"):
        pytest.importorskip("pye57")
    folder = Path(tempfile.mkdtemp(dir=IN_MEMORY if IN_MEMORY.is_dir() else None))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = faults(kind, folder, range(COUNT))
    finally:
        shutil.rmtree(folder)
    assert not found, "\n".join(f"seeds {seeds[:3]}: {words}" for words, seeds in found.items())
