"""What makes the derivatives of material points explode: time step, contact, or chaos.

An isotropic sheet of 9 x 9 vertices, moved as published (without damping or air) and as by r2s.
Derivatives are exact ones, by forward mode, in the place [range] of E h (10 to 1000 N/m) and nu.
"""

from pathlib import Path

import jax.numpy as jnp
import measure
import numpy as np
from matplotlib.figure import Figure
from roughness_cloth import offsets, rough, smooth
from roughness_sheets import (
    MODULUS,
    OURS,
    PUBLISHED,
    Physics,
    derivative,
    family_of,
    made,
    place_of,
    positions,
    size,
)
from roughness_tools import kept, picture, table

from r2s import scenarios
from r2s.fabrics.parameters import IsotropicSpace
from r2s.mpm.sheet import Sheet, stable_step
from r2s.scenarios.on_points import MEMBRANE_DAMPING

STEEPEST = 1.25  # times the modulus, up to where lines and secants go
SECANT = 0.02  # of the range
RATIOS = (0.5, 0.9, 1.1, 1.5, 2.0)  # time step over `stable_step`
MODULI = (30.0, 1000.0)  # [N/m]
WIDTHS, COUNT = (0.1, 0.01, 0.001, 0.0001), 21
TOO_FAR = 10.0  # [m]


CASES: dict[str, tuple[str, Physics]] = {
    "lifting, as published": ("lifting", PUBLISHED),
    "lifting, ours": ("lifting", OURS),
    "lifting, air alone": ("lifting", PUBLISHED._replace(air=True)),
    "lifting, membrane damping alone": ("lifting", PUBLISHED._replace(membrane=MEMBRANE_DAMPING)),
    "lifting, bending damping alone": ("lifting", PUBLISHED._replace(bending=0.01)),
    "folding, as published": ("folding", PUBLISHED),
    "folding, ours": ("folding", OURS),
    "folding, ours, layers pass": ("folding", OURS._replace(layers=False)),
    "shaking, as published": ("shaking", PUBLISHED),
    "shaking, ours": ("shaking", OURS),
}


def main(out: Path, small: bool) -> None:
    """Three tables, two pictures."""
    names = list(CASES)[:2] if small else list(CASES)
    growths = {}
    for number, name in enumerate(names):
        path = out / f"points_{number}.npz"
        growths[name] = kept(path, lambda name=name: growth(*CASES[name], small))
    table(out / "points_growth.csv", "derivatives of the motion [m/range]", grown(growths))
    picture(drawn_growth(growths), out / "points_growth.png")
    rows = []
    for modulus in MODULI[:1] if small else MODULI:
        found = kept(out / f"points_step_{modulus:g}.npz", lambda m=modulus: over_steps(m))
        rows += stepped_rows(modulus, found)
    table(out / "points_steps.csv", "a lift of 1 s, over the time step", rows)
    lines = {}
    for number, name in enumerate(names[:2]):
        path = out / f"points_line_{number}.npz"
        lines[name] = kept(path, lambda name=name: line(*CASES[name], small))
    table(out / "points_lines.csv", "loss of positions along E h", line_rows(lines))
    picture(drawn_lines(lines), out / "points_lines.png")


def growth(name: str, physics: Physics, small: bool) -> dict:
    """Sizes of the `exact` derivative and of the `secant` one, over the frames."""
    space, experiment = family_of(physics), scenarios.SIX[name]()
    scenario, solver = made(
        experiment.scenario((5, 5) if small else (9, 9)),
        physics,
        space(place_of(space, STEEPEST * MODULUS)),
    )
    place = place_of(space)
    x, slope = derivative(scenario, solver, space, place)
    secants = []
    for axis in np.eye(len(place)):
        ends = [place + end * jnp.asarray(axis, float) for end in offsets(SECANT, 2)]
        before, after = (np.asarray(positions(scenario, solver, space, end)) for end in ends)
        secants.append((after - before) / SECANT)
    return {
        "x": np.asarray(x),
        "times": experiment.times,
        "exact": size(np.asarray(slope)),
        "secant": size(np.stack(secants, axis=-1)),
        "apart": size(np.asarray(slope) - np.stack(secants, axis=-1)),
        "dt": solver.dt,
    }


def grown(growths: dict[str, dict[str, np.ndarray]]) -> list[measure.Row]:
    """Sizes after 1, 2, and 3.9 s."""
    rows = []
    for name, found in growths.items():
        row: measure.Row = {"motion": name, "dt_ms": 1e3 * float(found["dt"])}
        row["finite"] = bool(np.isfinite(found["x"]).all() and np.isfinite(found["exact"]).all())
        for frame in (15, 30, 59):
            seconds = found["times"][frame]
            row[f"exact, {seconds:.1f} s"] = found["exact"][frame]
            row[f"secant, {seconds:.1f} s"] = found["secant"][frame]
        row["exact - secant, 3.9 s"] = found["apart"][-1]
        rows.append(row)
    return rows


def over_steps(modulus: float) -> dict:
    """(physics, ratio): time step over its limit, where the sheet is [m], its derivative's size.

    The step stays, and the sheet becomes stiffer, so that it compiles once.
    """
    rows = []
    scenario = scenarios.lifting(num_frames=16, moving=0.8, height=0.2).scenario((9, 9))
    for physics in (PUBLISHED, OURS):
        space = family_of(physics)
        about, solver = made(scenario, physics, space(place_of(space, modulus)))
        for ratio in RATIOS:
            stiffness = stiffness_of(solver, space, physics, ratio, modulus)
            place = place_of(space, stiffness)
            x, slope = map(np.asarray, derivative(about, solver, space, place))
            furthest = np.abs(x).max() if np.isfinite(x).all() else np.inf
            rows.append((stiffness, furthest, size(slope)[-1]))
    shape = 2, len(RATIOS), 3
    return {"found": np.array(rows).reshape(shape), "dt": solver.dt}


def stiffness_of(
    solver: Sheet, space: IsotropicSpace, physics: Physics, ratio: float, modulus: float
) -> float:
    """E h [N/m] whose longest step is the solver's over the ratio, by bisection."""
    mesh, spacing = solver.scene.mesh, solver.background.grid.spacing
    low, high = np.log(modulus / 100), np.log(modulus * 100)
    for _ in range(20):
        middle = (low + high) / 2
        fabric = space(place_of(space, float(np.exp(middle))))
        limit = float(stable_step(mesh, spacing, fabric, jnp.asarray(physics.membrane, float)))
        low, high = (middle, high) if limit > solver.dt / ratio else (low, middle)
    return float(np.exp(low))


def stepped_rows(modulus: float, found: dict[str, np.ndarray]) -> list[measure.Row]:
    """One row a physics and ratio."""
    rows = []
    for word, members in zip(("as published", "ours"), found["found"], strict=True):
        for ratio, (stiffness, furthest, slope) in zip(RATIOS, members, strict=True):
            rows.append(
                {
                    "physics": word,
                    "dt_ms": 1e3 * float(found["dt"]),
                    "E h [N/m]": stiffness,
                    "dt / limit": ratio,
                    "stays": bool(furthest < TOO_FAR),
                    "farthest [m]": furthest,
                    "derivative [m/range]": slope,
                }
            )
    return rows


def line(name: str, physics: Physics, small: bool) -> dict:
    """`losses` (width, place) [m^2] of positions in the second half, and the exact `slope`.

    At the truth the slope of this loss is zero, so both are `SECANT` away from it.
    """
    space = family_of(physics)
    shape, count = ((5, 5), 5) if small else ((9, 9), COUNT)
    scenario = scenarios.SIX[name]().scenario(shape)
    stiffest = space(place_of(space, STEEPEST * MODULUS))
    scenario, solver = made(scenario, physics, stiffest)
    truth = np.asarray(place_of(space))
    at = lambda place: np.asarray(
        positions(scenario, solver, space, jnp.asarray(place, float)), float
    )[30:]
    target, axis = at(truth), np.eye(len(truth))[0]
    centre = truth + SECANT * axis
    loss = lambda x: np.mean(np.sum((x - target) ** 2, axis=-1))
    losses = [[loss(at(centre + o * axis)) for o in offsets(w, count)] for w in WIDTHS]
    x, slope = derivative(scenario, solver, space, jnp.asarray(centre, float))
    x, slope = np.asarray(x, float)[30:], np.asarray(slope, float)[30:, :, :, 0]
    return {"losses": np.array(losses), "slope": 2 * np.mean(np.sum((x - target) * slope, axis=-1))}


def line_rows(lines: dict[str, dict[str, np.ndarray]]) -> list[measure.Row]:
    """As `roughness_cloth.roughness`."""
    rows = []
    for name, found in lines.items():
        for width, losses in zip(WIDTHS, found["losses"], strict=True):
            offset = offsets(width, len(losses))
            fit = smooth(offset, losses)
            here = np.gradient(fit, offset)[len(fit) // 2]
            rows.append(
                {
                    "motion": name,
                    "width": width,
                    "rise_mm2": 1e6 * np.ptp(losses),
                    "rough/rise": rough(losses) / float(np.ptp(losses)),
                    "exact slope / fit": float(found["slope"]) / here,
                }
            )
    return rows


def drawn_growth(growths: dict[str, dict[str, np.ndarray]]) -> Figure:
    """A panel a scenario: sizes over time, exact and by secants."""
    scenes = list(dict.fromkeys(CASES[name][0] for name in growths))
    figure = Figure(figsize=(4.2 * len(scenes), 3.9), layout="constrained")
    for at, scene in zip(figure.subplots(1, len(scenes), squeeze=False)[0], scenes, strict=True):
        members = [name for name in growths if CASES[name][0] == scene]
        for number, name in enumerate(members):
            found, label = growths[name], name.removeprefix(f"{scene}, ")
            colour = f"C{number}"
            at.semilogy(found["times"], found["exact"], color=colour, label=label)
            at.semilogy(found["times"], found["secant"], "--", lw=0.9, color=colour)
        at.plot(
            [], [], "--", color="0.4", lw=0.9, label=f"dashed: secants, {SECANT:g} of the range"
        )
        at.set_title(scene, fontsize=9)
        at.set_xlabel("time [s]", fontsize=8)
        at.set_ylabel("derivative of the positions, rms [m/range]", fontsize=8)
        at.tick_params(labelsize=7, which="both")
        at.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.18))
    return figure


def drawn_lines(lines: dict[str, dict[str, np.ndarray]]) -> Figure:
    """Rows of motions, columns of widths; the tangent dashed."""
    figure = Figure(figsize=(3.1 * len(WIDTHS), 2.2 * len(lines) + 0.5), layout="constrained")
    axes = figure.subplots(len(lines), len(WIDTHS), squeeze=False)
    for row, (name, found) in zip(axes, lines.items(), strict=True):
        for at, width, losses in zip(row, WIDTHS, found["losses"], strict=True):
            offset, middle = offsets(width, len(losses)), losses[len(losses) // 2]
            at.plot(offset, 1e6 * losses, ".-", ms=3, lw=0.7)
            low, high = at.get_ylim()
            at.plot(offset, 1e6 * (middle + found["slope"] * offset), "--", color="C3", lw=1)
            at.set_ylim(low, high)
            at.tick_params(labelsize=7)
            at.locator_params(axis="x", nbins=4)
        row[0].set_ylabel(f"{name}\nloss [mm$^2$]", fontsize=8)
    for at, width in zip(axes[0], WIDTHS, strict=True):
        at.set_title(f"width {width:g} of the range", fontsize=9)
    for at in axes[-1]:
        at.set_xlabel("place of E h along the line [range]", fontsize=8)
    return figure
