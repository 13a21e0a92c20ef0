"""What a check of a recording found: a figure, and what would be expected."""

from typing import NamedTuple

import numpy as np


class Finding(NamedTuple):
    """- `check`: what was looked at. `figure`, `unit`: what was measured; NaN: nothing shows it.
    - `low`, `high`: between which it is expected.
    - `words`: what the figure is; `advice`: what to look at where it is not as expected.
    """

    check: str
    figure: float
    unit: str
    low: float
    high: float
    words: str
    advice: str

    @property
    def is_suspicious(self) -> bool:
        """Whether the figure was measured and is not as expected."""
        return bool(np.isfinite(self.figure)) and not self.low <= self.figure <= self.high

    def describe(self) -> str:
        """One line for people."""
        if not np.isfinite(self.figure):
            return f"not shown   {self.check}: {self.words}"
        unit = "" if self.unit == "-" else f" {self.unit}"
        ends = f"{self.low:g} to {self.high:g}{unit}"
        if not np.isfinite(self.high):
            ends = f"at least {self.low:g}{unit}"
        if not np.isfinite(self.low):
            ends = f"at most {self.high:g}{unit}"
        line = f"{self.check}: {self.words} {self.figure:.3g}{unit}, expected {ends}"
        return f"suspicious  {line}: {self.advice}" if self.is_suspicious else f"good        {line}"
