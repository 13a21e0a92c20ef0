"""Files damaged as disks, scripts and people damage them, drawn from a seed.

Each function takes the bytes of a valid file and a `random.Random`, and gives other bytes.
"""

import copy
import io
import json
import re
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

import cv2
import numpy as np

Mutation = Callable[[bytes, Random], bytes]
NUMBER = re.compile(rb"[+-]?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")
ODD_TEXT = (
    *(b"nan", b"inf", b"-inf", b"", b"-1", b"0", b"-0.0", b"text", b"1,5", b"1e308", b"-1e308"),
    *(
        b"1e400",
        b"1e-320",
        b"9" * 30,
        b"4294967295",
        b"-2147483648",
        b"\x00",
        b"\xff\xfe",
        b"12:30",
    ),
    *(b"1" * 5000, b'"', b"\n", b" ", b"1e", b"0x1F", b"\xc3\xa4", b"\xb2", b"true", b"null"),
)
ODD_VALUES: tuple[Any, ...] = (
    *(None, True, False, "", "text", "a\x00b", "../..", "/", "x" * 5000, "{name}", "(", "\ud800"),
    *(0, -1, 1, 2, 1e308, -1e308, 1e-320, 1.5, 10**20, 10**400, float("nan"), float("inf")),
    *([], {}, [[]], [{}], [None], [0], [1, 2, 3], [[1, 2], [3]], {"a": 1}, {"": None}, [1e308] * 3),
)
ODD_NUMBERS = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e308, -1e308, 1e39, 1e-320, 1e19, 3.5)


def damaged(data: bytes, rng: Random) -> bytes:
    """Cut, with bytes changed, left out, put in, doubled or zeroed; or something else."""
    kind, size = rng.randrange(9), len(data)
    at = rng.randrange(size + 1)
    length = min(size - at, 1 + int(rng.expovariate(0.05)))
    if kind == 0:
        return data[:at]
    if kind == 1:
        return data[:at] + data[at + length :]
    if kind == 2:
        return data[:at] + rng.randbytes(length) + data[at:]
    if kind == 3:
        return data[:at] + bytes(length) + data[at + length :]
    if kind == 4:
        return data[:at] + data[at : at + length] * rng.choice((2, 3, 50)) + data[at + length :]
    if kind == 5:
        return rng.choice(
            (b"", b"\n", b"\x00" * 64, rng.randbytes(99), b"PK\x03\x04" + data, data * 2)
        )
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8)) if size else 0):
        place = rng.randrange(min(size, 200) if kind == 6 else size)  # headers are at the beginning
        changed[place] = rng.choice((changed[place] ^ (1 << rng.randrange(8)), 0, 255, 127, 32))
    return bytes(changed)


def text(data: bytes, rng: Random) -> bytes:
    """Numbers, words, lines and columns of a text replaced, or another encoding."""
    kind = rng.randrange(10)
    if kind < 4:
        found = list(NUMBER.finditer(data))
        chosen = rng.sample(found, min(len(found), rng.choice((1, 1, 2, 5))))
        for match in sorted(chosen, key=re.Match.start, reverse=True):
            data = data[: match.start()] + rng.choice(ODD_TEXT) + data[match.end() :]
        return data
    lines = data.split(b"\n")
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    if kind == 4:
        lines[at : at + rng.choice((1, 1, 3))] = []
    elif kind == 5:
        lines[at], lines[other] = lines[other], lines[at]
    elif kind == 6:
        lines.insert(at, rng.choice((lines[other], b"", b"#", b"text", b",,,", b";", b"1 2 3 4 5")))
    elif kind == 7:
        one, two = rng.sample((b",", b";", b"\t", b" ", b".", b"_", b"\r\n", b'"'), 2)
        return data.replace(one, two, rng.choice((1, -1)))
    elif kind == 8:
        words = re.split(rb"([\s,;]+)", data)
        place = rng.randrange(len(words))
        words[place] = rng.choice((*ODD_TEXT, rng.choice(words)))
        return b"".join(words)
    else:
        read = data.decode("utf-8", "replace")
        return rng.choice((read.encode("utf-16"), b"\xef\xbb\xbf" + data, read.encode("utf-16-be")))
    return b"\n".join(lines)


def _places(value: Any) -> list[tuple[Any, Any]]:
    """Every container of a JSON value with each of its keys."""
    keys = list(value) if isinstance(value, dict) else range(len(value))
    found = [(value, key) for key in keys]
    for key in keys:
        if isinstance(value[key], dict | list):
            found += _places(value[key])
    return found


def odd_json(value: Any, rng: Random) -> Any:
    """A JSON value in which an entry is replaced, left out, added, renamed or nested."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        places = _places(value)
        if not places:
            break
        parent, key = rng.choice(places)
        kind = rng.randrange(8)
        if kind == 0:
            del parent[key]
        elif kind == 1 and isinstance(parent, dict):
            parent[rng.choice(("x", "", key + "s"))] = parent.pop(key)
        elif kind == 2 and isinstance(parent, list):
            parent.insert(rng.randrange(len(parent) + 1), rng.choice((parent[key], 0.5)))
        elif kind == 3:
            parent[key] = [parent[key]]
        elif kind == 4:
            parent[key] = copy.deepcopy(rng.choice(places)[0])
        elif kind == 5 and isinstance(parent[key], int | float):
            parent[key] = rng.choice((-parent[key], 1000 * parent[key], str(parent[key]), 0))
        else:
            parent[key] = copy.deepcopy(rng.choice(ODD_VALUES))
    return value


def json_file(data: bytes, rng: Random) -> bytes:
    """An odd JSON value, or the text of one damaged."""
    kind = rng.randrange(12)
    if kind == 0:
        return damaged(data, rng)
    if kind == 1:
        return text(data, rng)
    if kind == 2:
        deep = rng.choice((10, 5000, 200_000))
        return rng.choice((b"[" * deep, b'{"a":' * deep, b"[" * deep + b"]" * deep, b"null", b"3"))
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):  # it was damaged before
        return text(data, rng)
    if not isinstance(value, dict | list):
        return text(data, rng)
    return json.dumps(odd_json(value, rng)).encode()


def odd_array(values: np.ndarray, rng: Random) -> np.ndarray:
    """An array of another shape, type or with odd numbers."""
    kind = rng.randrange(8)
    if kind < 3 and values.size and values.dtype.kind == "f":
        values = values.copy()
        for _ in range(rng.choice((1, 1, 3))):
            values.flat[rng.randrange(values.size)] = np.array(rng.choice(ODD_NUMBERS)).astype(
                values.dtype
            )
        return values
    shaped: Sequence[Callable[[], np.ndarray]] = (
        lambda: values[:0],
        lambda: values[..., None],
        lambda: values[None],
        lambda: values.ravel(),
        lambda: values[:-1],
        lambda: np.concatenate([values, values]),
        lambda: values[..., :-1],
        lambda: values.T,
        lambda: values[::-1],
        lambda: np.zeros((0, *values.shape[1:]), values.dtype),
        lambda: np.asarray(values.ravel()[0]),
        lambda: values[1::2],
    )
    typed: Sequence[Callable[[], np.ndarray]] = (
        lambda: values.astype(complex),
        lambda: values.astype(bool),
        lambda: values.astype(np.int64),
        lambda: values.astype(np.uint8),
        lambda: values.astype(np.float16),
        lambda: values.astype(str),
        lambda: values.astype("S4"),
        lambda: np.array("text"),
        lambda: np.array(["a", "b"]),
        lambda: values.astype("datetime64[s]"),
        lambda: values.astype(">f8"),
        lambda: np.zeros(3, [("x", "f4"), ("y", "f4")]),
        lambda: values.astype(object),
        lambda: np.full_like(values, rng.choice((0, 1))),
    )
    try:
        return rng.choice(shaped if kind < 6 else typed)()
    except (ValueError, TypeError, IndexError, OverflowError):
        return np.zeros(())


def npy(data: bytes, rng: Random) -> bytes:
    """An odd array in an NPY, an odd header, or the file damaged."""
    kind = rng.randrange(4)
    if kind == 0:
        return damaged(data, rng)
    if kind == 1:  # the length of the header stays
        head, rest = data[:10], data[10:]
        shape = re.search(rb"\([\d, ]*\)", rest)
        sizes = (b"(999999999999, 3)", b"(-1, 3)", b"(2147483648,)", b"()", b"(3, 'a')")
        if shape is None:
            return data
        end = shape.end() + len(rest[shape.end() :].partition(b"\n")[0])
        line = rest[: shape.start()] + rng.choice(sizes) + rest[shape.end() : end].rstrip()
        return head + line.ljust(end)[:end] + rest[end:]
    buffer = io.BytesIO()
    np.save(buffer, odd_array(np.load(io.BytesIO(data)), rng))
    return buffer.getvalue()


def npz(data: bytes, rng: Random) -> bytes:
    """Arrays of an NPZ odd, left out, swapped or renamed; JSON in it odd; or the file damaged."""
    if rng.randrange(4) == 0:
        return damaged(data, rng)
    with np.load(io.BytesIO(data)) as file:
        arrays = dict(file)
    for _ in range(rng.choice((1, 1, 2))):
        names = list(arrays)
        name, other = rng.choice(names), rng.choice(names)
        kind = rng.randrange(10)
        if kind == 0:
            del arrays[name]
        elif kind == 1:
            arrays[rng.choice(("x", name + "s"))] = arrays.pop(name)
        elif kind == 2:
            arrays[name], arrays[other] = arrays[other], arrays[name]
        elif arrays[name].dtype.kind == "U" and arrays[name].ndim == 0 and rng.randrange(4):
            changed = json_file(str(arrays[name]).encode(), rng)
            arrays[name] = np.array(changed.decode("utf-8", "replace"))
        else:
            arrays[name] = odd_array(arrays[name], rng)
        if not arrays:
            break
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


def image(data: bytes, rng: Random) -> bytes:
    """A PNG of other sizes, bits, channels or pixels, another kind of image, or damaged."""
    if rng.randrange(2):
        return damaged(data, rng)
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    kinds = (
        lambda: pixels.astype(np.uint8),
        lambda: pixels.astype(np.uint16),
        lambda: np.repeat(np.atleast_3d(pixels)[..., :1], rng.choice((3, 4)), axis=2),
        lambda: np.zeros_like(pixels),
        lambda: np.full_like(pixels, 2 ** (8 * pixels.dtype.itemsize) - 1),
        lambda: pixels[: rng.choice((1, -1))],
        lambda: pixels[::2, ::2],
        lambda: np.ascontiguousarray(pixels.swapaxes(0, 1)),
        lambda: np.random.default_rng(rng.randrange(99)).permutation(pixels),
        lambda: np.where(pixels > 0, rng.choice((1, 40, 255)), 0).astype(pixels.dtype),
    )
    made = rng.choice(kinds)()
    suffix = rng.choice((".png", ".png", ".png", ".jpg", ".bmp"))
    shown = made if suffix == ".png" else made.astype(np.uint8)
    return cv2.imencode(suffix, shown)[1].tobytes()


BY_SUFFIX: dict[str, Mutation] = {
    ".json": json_file,
    ".npz": npz,
    ".npy": npy,
    ".png": image,
    ".jpg": image,
    **dict.fromkeys((".csv", ".tum", ".txt", ".obj", ".off", ".xyz", ".gltf"), text),
}


def mutated(suffix: str, data: bytes, rng: Random) -> bytes:
    """Bytes in place of those of a file of a format; one in four is damaged blindly."""
    kind = BY_SUFFIX.get(suffix, text if rng.randrange(2) else damaged)
    return (damaged if rng.randrange(4) == 0 else kind)(data, rng)
