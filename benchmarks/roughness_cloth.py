"""The default loss of the cloth along lines through the truth, and which slopes of it matter."""

from pathlib import Path
from typing import NamedTuple

import jax
import measure
import numpy as np
from matplotlib.figure import Figure
from roughness_tools import kept, losses_at, normal_at, picture, table, truth, unknown_of

from r2s.estimation.problem import Problem

WIDTHS = (0.5, 0.05, 0.005, 0.0005)  # of the range
COUNT = 41
SECANTS = (0.1, 0.02, 0.005)  # widths, of the range
AXES = {"warp": 0, "bending": 4, "damping": 5}
DEGREE = 4  # of the polynomial that stands for the loss without its roughness
NEAR = 0.05  # of the range: where a descent ends


class Case(NamedTuple):
    """A preset in a scenario, with some of its damping, along some directions.

    `bare`: without air and in short steps, so that nothing else damps either.
    """

    fabric: str
    scenario: str
    factor: float = 1.0
    directions: tuple[str, ...] = ("warp", "random")
    bare: bool = False

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.fabric}_{self.scenario}_{self.factor:g}" + "_bare" * self.bare

    @property
    def words(self) -> str:
        """How it is damped."""
        if self.bare:
            return "nothing: no air, steps of 5.6 ms"
        return {1.0: "itself, air, steps of 22 ms", 0.0: "air, steps of 22 ms"}[self.factor]


ALL = ("warp", "bending", "damping", "random")
CASES = (
    Case("grey_interlock", "lifting", 1.0, ALL),
    Case("grey_interlock", "lifting", 0.0),
    Case("grey_interlock", "lifting", 0.0, ("warp",), bare=True),
    Case("camel_ponte_roma", "lifting"),
    Case("camel_ponte_roma", "wind", 1.0, ("random",)),
)
SMALL = (Case("grey_interlock", "lifting", 1.0, ("warp",)),)


def main(out: Path, small: bool) -> None:
    """Lines, slopes, tables and pictures."""
    rows, slopes = [], []
    pictured: dict[str, list[tuple[Case, dict[str, np.ndarray]]]] = {}
    for case in SMALL if small else CASES:
        found = kept(out / f"line_{case.name}.npz", lambda case=case: lines(case, small))
        rows += roughness(case, found)
        pictured.setdefault(f"{case.fabric}_{case.scenario}", []).append((case, found))
        number = 1 if case.bare else 3
        found = kept(
            out / f"slope_{case.name}.npz", lambda case=case, number=number: slopes_of(case, number)
        )
        slopes += agreement(case, found)
    table(out / "cloth_lines.csv", "the loss along lines through the truth", rows)
    table(out / "cloth_slopes.csv", "exact slopes beside those of secants", slopes)
    for name, members in pictured.items():
        picture(drawn(members), out / f"cloth_{name}.png")


def direction(name: str, dim: int) -> np.ndarray:
    """A unit vector of the space's cube: along an axis, or a random one, always the same."""
    if name in AXES:
        return np.eye(dim)[AXES[name]]
    drawn = np.array(jax.random.normal(jax.random.key(3), (dim,), float))
    return drawn / np.linalg.norm(drawn)


def offsets(width: float, count: int = COUNT) -> np.ndarray:
    """Places along a line, of the range, with the truth in the middle."""
    return width * np.linspace(-0.5, 0.5, count)


def lines(case: Case, small: bool) -> dict:
    """`losses` (direction, width, place) [m^2], and the exact `slopes` at the truth."""
    problem, place = truth(case.fabric, case.scenario, case.factor, bare=case.bare)
    gradient = exact(problem, place)
    losses, slopes = [], []
    for name in case.directions:
        along = direction(name, len(place))
        slopes.append(gradient @ along)
        for width in WIDTHS:
            count = 9 if small else COUNT
            measure.progress(f"{case.name}, {name}, {width:g}")
            losses.append(losses_at(problem, place + offsets(width, count)[:, None] * along))
    shape = len(case.directions), len(WIDTHS), -1
    return {"losses": np.array(losses).reshape(shape), "slopes": np.array(slopes)}


def exact(problem: Problem, place: np.ndarray) -> np.ndarray:
    """The exact gradient [m^2] of the loss in the space's place."""
    normal = normal_at((problem,), unknown_of(problem, place))
    return np.asarray(normal.gradient)[: len(place)]


def smooth(offset: np.ndarray, losses: np.ndarray) -> np.ndarray:
    """The polynomial through a line of losses."""
    scaled = 2 * offset / np.ptp(offset)
    return np.polyval(np.polyfit(scaled, losses, DEGREE), scaled)


def rough(losses: np.ndarray) -> float:
    """The deviation of independent errors of the losses on a line that their roughness looks like.

    From third differences, which a smooth loss hardly has.
    """
    return float(np.sqrt(np.mean(np.diff(losses, 3) ** 2) / 20))


def roughness(case: Case, found: dict[str, np.ndarray]) -> list[measure.Row]:
    """One row a direction and width.

    The exact slope at the truth is compared with that of a polynomial through the line, there, and
    their difference is given over the line's mean slope, rise / width, since both may be near zero.
    """
    rows = []
    for i, name in enumerate(case.directions):
        for k, width in enumerate(WIDTHS):
            losses = found["losses"][i, k]
            offset, rise = offsets(width, len(losses)), float(np.ptp(losses))
            here = np.gradient(smooth(offset, losses), offset)[len(losses) // 2]
            turns = np.sum(np.diff(np.sign(np.diff(losses))) != 0)
            rows.append(
                {
                    "fabric": case.fabric,
                    "scenario": case.scenario,
                    "damped by": case.words,
                    "direction": name,
                    "width": width,
                    "rise_mm2": 1e6 * rise,
                    "rough_mm2": 1e6 * rough(losses),
                    "rough/rise": rough(losses) / rise,
                    "turns": int(turns),
                    "(exact-fit) width/rise": (found["slopes"][i] - here) * width / rise,
                }
            )
    return rows


def slopes_of(case: Case, number: int) -> dict:
    """Gradients [m^2]: `exact` (place, dim), and `secant` (width, place, dim), of the loss.

    Half of the places lie anywhere in the range, half near the truth.
    """
    problem, place = truth(case.fabric, case.scenario, case.factor, bare=case.bare)
    dim = len(place)
    drawn = np.asarray(jax.random.uniform(jax.random.key(7), (2 * number, dim), float))
    places = np.concatenate(
        [0.1 + 0.8 * drawn[:number], place + NEAR * (2 * drawn[number:] - 1)], axis=0
    )

    def secant(where, width):
        ends = [where + offsets(width, 2)[:, None] * axis for axis in np.eye(dim)]
        return np.array([np.diff(losses_at(problem, pair))[0] / width for pair in ends])

    return {
        "exact": np.stack([exact(problem, where) for where in places]),
        "secant": np.array([[secant(where, width) for where in places] for width in SECANTS]),
    }


def agreement(case: Case, found: dict[str, np.ndarray]) -> list[measure.Row]:
    """One row a width and group of places: how far exact slopes are from the secants'."""
    rows, half = [], len(found["exact"]) // 2
    for where, part in (("anywhere", slice(0, half)), ("near the truth", slice(half, None))):
        for width, secant in zip(SECANTS, found["secant"], strict=True):
            a, b = found["exact"][part], secant[part]
            lengths = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
            cosine = np.sum(a * b, axis=1) / (lengths[0] * lengths[1])
            apart = np.linalg.norm(a - b, axis=1) / lengths[1]
            rows.append(
                {
                    "fabric": case.fabric,
                    "scenario": case.scenario,
                    "damped by": case.words,
                    "places": f"{half} {where}",
                    "width": width,
                    "cosine, median": np.median(cosine),
                    "cosine, least": cosine.min(),
                    "difference, median": np.median(apart),
                    "difference, most": apart.max(),
                }
            )
    return rows


def _colour(case: Case) -> str:
    return "C3" if case.bare else {1.0: "C0", 0.0: "C1"}[case.factor]


def drawn(members: list[tuple[Case, dict[str, np.ndarray]]]) -> Figure:
    """Rows of directions, columns of widths; the loss less that at the truth, and the tangents."""
    names = list(dict.fromkeys(name for case, _ in members for name in case.directions))
    figure = Figure(figsize=(3.1 * len(WIDTHS), 2.2 * len(names) + 0.7), layout="constrained")
    axes = figure.subplots(len(names), len(WIDTHS), squeeze=False)
    panels = [
        (axes[names.index(name), k], offsets(width, found["losses"].shape[-1]), case, found, i, k)
        for case, found in members
        for i, name in enumerate(case.directions)
        for k, width in enumerate(WIDTHS)
    ]
    for at, offset, case, found, i, k in panels:
        losses = 1e6 * found["losses"][i, k]
        above = losses - losses[len(losses) // 2]
        at.plot(offset, above, ".-", ms=3, lw=0.7, color=_colour(case))
        at.set_xlim(offset[0], offset[-1])
    for at, offset, case, found, i, _ in panels:
        low, high = at.get_ylim()
        at.plot(offset, 1e6 * found["slopes"][i] * offset, "--", lw=1, color=_colour(case))
        at.set_ylim(low, high)
    for k, width in enumerate(WIDTHS):
        axes[0, k].set_title(f"width {width:g} of the range", fontsize=9)
        axes[-1, k].set_xlabel("place along the line [range]", fontsize=8)
    for i, name in enumerate(names):
        axes[i, 0].set_ylabel(f"{name}\nloss - loss at the truth [mm$^2$]", fontsize=8)
    for at in axes.ravel():
        at.tick_params(labelsize=7)
        at.locator_params(axis="x", nbins=4)
        at.axvline(0, color="0.8", lw=0.6, zorder=0)
    lines = [
        axes[0, 0].plot([], [], ".-", color=_colour(case), label=f"damped by {case.words}")[0]
        for case, _ in members
    ]
    lines += axes[0, 0].plot([], [], "--", color="0.4", label="exact slope at the truth")
    figure.legend(handles=lines, loc="outside lower center", ncols=len(lines), fontsize=8)
    case = members[0][0]
    figure.suptitle(f"{case.fabric.replace('_', ' ')}, {case.scenario}", fontsize=10)
    return figure
