"""Compiled and traced programs in files: found again, damaged, full, shared, refused."""

import os
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from jax._src import compilation_cache

import r2s.kept
from r2s import programs
from r2s.fabrics import presets
from r2s.fabrics.fold_length import fold_length
from r2s.kept import Kept, kept
from r2s.programs import SUFFIX, Programs

SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_enable_compilation_cache",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Programs are kept in a folder of the test's own; then where they were before."""
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    monkeypatch.setattr(compilation_cache, "get_file_cache", compilation_cache.get_file_cache)
    monkeypatch.setattr(programs, "_in_use", [])
    monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "true")
    found = programs.keep(tmp_path)
    assert found is not None and found.parent == tmp_path
    yield found
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def files(folder: Path) -> list[Path]:
    return sorted(folder.glob(f"*{SUFFIX}"))


DAMAGES = {
    "empty": lambda whole: b"",
    "truncated": lambda whole: whole[: len(whole) // 2],
    "garbage": lambda whole: bytes(len(whole)),
    "a bit": lambda whole: whole[:-1] + bytes([whole[-1] ^ 1]),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_program_is_made_anew_without_a_word(folder: Path, damage) -> None:
    ones = jnp.ones(3)

    def run() -> float:
        return float(jax.jit(lambda x: jnp.sum(x) + 41)(ones))  # a new function: nothing is known

    assert run() == 44
    (made,) = (file for file in files(folder) if "lambda" in file.name)
    whole = made.read_bytes()
    made.write_bytes(damage(whole))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert run() == 44
    assert len(made.read_bytes()) > 100 and Programs(folder).get(made.name[: -len(SUFFIX)])


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_trace_is_made_anew(folder: Path, damage) -> None:
    fabric = presets.grey_interlock()
    first = kept(fold_length)(fabric)
    (made,) = (file for file in files(folder) if file.name.startswith("traced_fold_length"))
    made.write_bytes(damage(made.read_bytes()))
    assert kept(fold_length)(fabric) == first
    assert Programs(folder).get(made.name[: -len(SUFFIX)])


def test_a_kept_function_is_not_traced_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fabric = presets.black_denim()
    first = kept(fold_length)(fabric)
    assert first == pytest.approx(float(fold_length(fabric)), rel=1e-6)
    again = kept(fold_length)
    monkeypatch.setattr(jax.export, "export", None)  # to trace would fail
    assert again(fabric) == first
    assert again(presets.grey_interlock()) != first  # other numbers, the same program


def test_other_shapes_and_static_parts_are_other_programs(folder: Path) -> None:
    times = Kept(jax.lax.mul)  # of a library whose version is in the key
    assert jnp.array_equal(times(jnp.ones(3), jnp.full(3, 2.0)), jnp.full(3, 2.0))
    total = Kept(jnp.full_like)
    assert total(jnp.ones(3), 2).sum() == 6 and total(jnp.ones(3), 3).sum() == 9
    assert total(jnp.ones((2, 2)), 3).sum() == 12
    assert total(jnp.ones(3, jnp.int32), 3).dtype == jnp.int32


def test_equal_numbers_of_other_types_are_other_programs(folder: Path) -> None:
    full = Kept(jnp.full)
    kinds = [full((2,), value).dtype.kind for value in (1, 1.0, True)]
    assert kinds == ["i", "f", "b"]


def test_numbers_of_another_precision_are_converted_as_jax_does(folder: Path) -> None:
    with jax.enable_x64(True):
        fabric = presets.black_denim()
    with jax.enable_x64(False):
        found = kept(fold_length)(fabric)
        assert found.dtype == jnp.float32
    assert float(found) == pytest.approx(float(fold_length(fabric)), rel=1e-5)


def test_a_source_that_changed_since_the_process_began_is_not_kept(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(r2s.kept, "BEGAN", 0.0)
    fabric = presets.grey_interlock()
    assert kept(fold_length)(fabric) == pytest.approx(float(fold_length(fabric)), rel=1e-6)
    assert not [file for file in files(folder) if file.name.startswith("traced")]


def test_a_folder_that_others_can_write_is_refused(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    with pytest.raises(PermissionError, match="others can write it"):
        Programs(shared)


def test_to_import_r2s_leaves_the_cache_of_jax_alone() -> None:
    told = "import jax; before = dict(jax.config.values); import r2s, r2s.cli, r2s.kept\n"
    told += f"before = [before[name] for name in {SETTINGS}]\n"
    told += f"after = [jax.config.values[name] for name in {SETTINGS}]\n"
    told += "from jax._src import compilation_cache as cache\n"
    told += "assert after == before and r2s.programs.kept() is None\n"
    told += "assert cache.get_file_cache.__module__ == cache.__name__"
    subprocess.run([sys.executable, "-c", told], check=True, timeout=120)


def last(pair: tuple) -> jax.Array:
    return pair[1]


class Foreign(eqx.Module):
    """Of no source that r2s knows."""

    factor: int = eqx.field(static=True)


def test_a_class_of_unknown_source_is_compiled_but_not_kept(folder: Path) -> None:
    run = Kept(lambda x: 2 * x)  # a function of unknown source
    assert run(jnp.ones(())) == 2
    assert jax.tree.leaves(Kept(eqx.tree_at)(last, (Foreign(2), jnp.ones(())), jnp.zeros(()))) == [
        0
    ]
    assert not [file for file in files(folder) if file.name.startswith("traced")]


def test_the_oldest_go_when_all_are_too_large(tmp_path: Path) -> None:
    store = Programs(tmp_path, most=350)
    for number, key in enumerate("abc"):
        store.put(key, bytes(80))
        os.utime(tmp_path / f"{key}{SUFFIX}", (number, number))
    assert store.get("a")  # and is the newest now
    store.put("d", bytes(80))
    assert store.get("a") and store.get("b") is None and store.get("d")
    store.put("e", bytes(400))  # larger than all may be
    assert store.get("e") is None and store.get("a")
    store.clear()
    assert not files(tmp_path)


def test_what_no_folder_takes_is_one_warning(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.warns(UserWarning, match="programs are not kept: .*file.* --no-cache") as told:
        assert programs.keep(blocked) is None
    assert len(told) == 1 and programs.kept() is None
    assert float(jax.jit(lambda x: x + 1)(jnp.ones(()))) == 2

    def full(*_) -> None:
        raise OSError("No space left on device")

    store = Programs(tmp_path / "full")
    monkeypatch.setattr(programs, "_write", full)
    with pytest.warns(UserWarning, match="not kept any more: No space left"):
        store.put("a", b"1")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        store.put("a", b"1")


WRITER = """
import sys
from pathlib import Path
from r2s.programs import Programs
store = Programs(Path(sys.argv[1]))
value = bytes([int(sys.argv[2])]) * 1_000_000
for _ in range(100):
    store.put("same", value)
    found = store.get("same")
    assert found is not None and len(found) == 1_000_000 and len(set(found)) == 1
"""


def test_two_processes_write_the_same_program_at_once(tmp_path: Path) -> None:
    run = [sys.executable, "-c", WRITER, str(tmp_path)]
    writers = [subprocess.Popen([*run, str(number)]) for number in (1, 2)]
    assert [writer.wait(timeout=120) for writer in writers] == [0, 0]
    assert [file.name for file in tmp_path.iterdir()] == [f"same{SUFFIX}"]


def test_the_folder_of_the_user(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert programs.user_folder() == tmp_path / "r2s" / "programs"
    monkeypatch.setattr(sys, "platform", "darwin")
    assert programs.user_folder() == Path.home() / "Library" / "Caches" / "r2s" / "programs"
    assert programs.machine() == programs.machine() and len(programs.machine()) == 12
