"""Conditions that what is given must meet."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np


def expect(holds: bool | np.bool_, problem: str) -> None:
    """Raise `ValueError` that says the problem, unless the condition holds."""
    if not holds:
        raise ValueError(problem)


@contextmanager
def naming(where: Any) -> Iterator[None]:
    """Put where it is, such as a file, before the words of a `ValueError` that is raised within."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def check_kinds(call: str, **expected: tuple[Any, type]) -> None:
    """Raise a `TypeError` that names an argument of a `call` that is of another type."""
    for name, (argument, kind) in expected.items():
        if not isinstance(argument, kind):
            given = type(argument).__name__
            raise TypeError(f"{call}: {name} must be a {kind.__name__}, got {given}")
