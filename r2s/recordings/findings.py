"""What a check of a recording found: a figure, and what would be expected."""

from typing import NamedTuple

import numpy as np

INF = np.inf
CALIBRATION = "check the cameras' calibration and depth scale, and the sheet's size"
CLOCK = "check the frame rate and time_offset: does a clap or a jerk come at one time in both?"
UPRIGHT = "the world's z must point up: check the cameras' pose against a {}"
CROP = "widen the workspace or the crop, or move the camera"


class Check(NamedTuple):
    """What is looked at: the `unit`, between which figures it is expected, in words, and what to
    look at where it is not."""

    unit: str
    low: float
    high: float
    words: str
    advice: str


CHECKS = {
    "frames": Check(
        *("-", -INF, 0.05, "largest deviation from an even interval"),
        "frames were dropped, or their times are not their own: resample them",
    ),
    "rate": Check("Hz", 1.0, 240.0, "frames a second", "are times in seconds?"),
    "grippers": Check(
        *("m/s", -INF, 5.0, "greatest speed of a gripper"),
        "are the path in metres and its times in seconds?",
    ),
    # clean synthetic recordings show up to 0.08 s
    "clock": Check("s", -0.1, 0.1, "delay of the top of the cloud after the grippers", CLOCK),
    "clock rate": Check("-", 0.95, 1.05, "how fast the cameras' clock runs", CLOCK),
    "points": Check(
        *("-", 150, INF, "points of a frame, thinned to 5 mm,"),
        "move the cameras nearer, or widen masks and workspace",
    ),
    "outliers": Check(
        *("-", -INF, 0.03, "share of points that are off the sheet"),
        "clean masks, or narrow the workspace",
    ),
    "grip": Check(
        *("m", -INF, 0.08, "distance from a gripper to the nearest point (median over frames)"),
        "the frames of cameras and grippers differ, or the clock does",
    ),
    "crop": Check("-", -INF, 0.3, "", CROP),
    # a side that was measured with a ruler is good to 0.5 %
    "scale": Check(
        *("-", 0.975, 1.025, "length of the side at rest, over the one written down,"),
        CALIBRATION,
    ),
    "gravity": Check(
        *("degrees", -INF, 1.5, "tilt of the sheet that lies on the table"),
        UPRIGHT.format("level"),
    ),
    "plumb": Check(
        *("degrees", -INF, 4.0, "angle from the vertical of the line from grippers to sheet"),
        UPRIGHT.format("plumb line"),
    ),
    "table": Check(
        *("m", -0.01, 0.01, "height of the sheet at rest above the table"),
        "check table_height and the cameras' pose",
    ),
    "reach": Check(
        *("-", 0.55, 1.06, "farthest point from a gripper, over how far the sheet reaches,"),
        CALIBRATION,
    ),
    "stretch": Check(
        *("-", -INF, 1.08, "the same, over what it is at rest,"),
        "the sheet stretches, or the cameras' scale changes with the place",
    ),
    "markers": Check(
        *("-", 0.5, 1.1, "distance of neighbouring markers over that on the sheet (95 %),"),
        "the sheet stretches, or markers were taken for others",
    ),
}


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

    @classmethod
    def make(cls, key: str, figure: float, words: str = "", name: str = "") -> "Finding":
        """A figure of one of `CHECKS`; `words`: others than there, such as why it is NaN."""
        unit, low, high, usual, advice = CHECKS[key]
        return cls(name or key, figure, unit, low, high, words or usual, advice)

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
        if not np.isfinite([self.low, self.high]).all():
            bound = f"at least {self.low:g}" if np.isfinite(self.low) else f"at most {self.high:g}"
            ends = bound + unit
        line = f"{self.check}: {self.words} {self.figure:.3g}{unit}, expected {ends}"
        return f"suspicious  {line}: {self.advice}" if self.is_suspicious else f"good        {line}"
