"""Conditions that what is given must meet."""

from typing import Any

import numpy as np

SHOWN = 200  # characters of a value in an error


def expect(holds: bool | np.bool_, problem: str) -> None:
    """Raise `ValueError` that says the problem, unless the condition holds."""
    if not holds:
        raise ValueError(problem)


def expect_value(holds: bool, where: str, expected: str, found: Any) -> None:
    """Raise `ValueError` that says what was expected where, unless the condition holds."""
    if not holds:
        raise ValueError(f"{where}: expected {expected}, found {shown(found)}")


def shown(value: Any) -> str:
    """A value as an error shows it: the beginning of a long one."""
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def check_kinds(call: str, **expected: tuple[Any, type]) -> None:
    """Raise a `TypeError` that names an argument of a `call` that is of another type."""
    for name, (argument, kind) in expected.items():
        if not isinstance(argument, kind):
            given = type(argument).__name__
            raise TypeError(f"{call}: {name} must be a {kind.__name__}, got {given}")
