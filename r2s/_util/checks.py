"""Conditions that what is given must meet."""

import numpy as np


def expect(holds: bool | np.bool_, problem: str) -> None:
    """Raise `ValueError` that says the problem, unless the condition holds."""
    if not holds:
        raise ValueError(problem)
