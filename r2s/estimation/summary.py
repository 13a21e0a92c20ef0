"""What an estimate says, in lines for people: values, intervals, fit, search, what to record next.

The words and figures are those of its JSON object (`r2s.estimation.estimate.as_json`).
"""

import numpy as np

from r2s.estimation.estimate import Estimate, Fit

HEADER = ("parameter", "estimate", "90 % interval", "posterior/prior")
NEXT = {  # a recording, and the parameters that it determines best
    "three stretchings with their force, along warp and weft and at 45 degrees": (
        *("warp", "weft", "shear", "coupling", "stiffening", "knee warp", "knee weft"),
        *("E h", "nu"),
    ),
    "a lift of one corner, or a cantilever test": ("bending", "bending loss", "bending knee"),
    "a fling or a swing of the hanging sheet": ("damping",),
    "a fold or a drag over the table": ("friction",),
}


def describe(estimate: Estimate) -> list[str]:
    """Lines for people: each parameter, what is correlated, fit, nuisance parameters, search."""
    shape = estimate.shape
    mesh = "" if shape is None else f" on {shape[0]} x {shape[1]} vertices"
    lines = [
        *_table(estimate),
        *_correlations(estimate),
        *_mesh_share(estimate, mesh),
        *(_fit(each, mesh) for each in estimate.fits),
        *_nuisances(estimate),
        *_search(estimate, mesh),
    ]
    named = ", ".join(f"{name} ({side})" for name, side in estimate.at_bounds.items())
    if named:
        lines.append(f"warning: at a bound, beyond which the truth may lie: {named}")
    return lines + next_recording(estimate)


def next_recording(estimate: Estimate) -> list[str]:
    """What to record next: that of `NEXT` whose parameters are the least narrowed; none without
    standard errors."""
    ratios = {each.name: r for each, r in zip(estimate.ranges, estimate.narrowing, strict=True)}
    known = {name: float(ratio) for name, ratio in ratios.items() if np.isfinite(ratio)}
    kinds = {kind: [name for name in names if name in known] for kind, names in NEXT.items()}
    kinds = {kind: names for kind, names in kinds.items() if names}
    if not kinds:
        return []
    kind = max(kinds, key=lambda kind: np.mean([known[name] for name in kinds[kind]]))
    named = ", ".join(f"{name} ({known[name]:.2g})" for name in kinds[kind])
    return [f"record next: {kind}, for {named}"]


def _table(estimate: Estimate) -> list[str]:
    has_errors = bool(np.isfinite(estimate.standard_errors).any())
    rows: list[tuple[str, ...]] = [HEADER]
    columns = estimate.values, estimate.intervals, estimate.narrowing
    for bound, value, (low, high), ratio in zip(estimate.ranges, *columns, strict=True):
        unit = "" if bound.unit == "-" else f" {bound.unit}"
        side = estimate.at_bounds.get(bound.name)
        end = f"  (at its {side} bound)" if side else ""
        interval = f"{low:.3g} to {high:.3g}{unit}" if np.isfinite(low) else "unknown"
        rows.append((bound.name, f"{value:.4g}{unit}", interval, f"{ratio:.2g}{end}"))
    if not has_errors:  # of a method that gives none
        rows = [row[:2] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    if has_errors:
        lines.append(
            "posterior/prior: how far the recording narrowed what was known (standard deviations; "
            "1: not at all)"
        )
    else:
        lines.append("this method gives no standard errors")
    return lines


def _correlations(estimate: Estimate) -> list[str]:
    pairs = [f"{one} and {other} {r:.2f}" for one, other, r in estimate.correlated()]
    return [f"largest correlations (1 or -1: not told apart): {', '.join(pairs)}"] if pairs else []


def _mesh_share(estimate: Estimate, mesh: str) -> list[str]:
    if estimate.mesh_bias is None:
        return []
    pairs = zip(estimate.ranges, estimate.mesh_bias, strict=True)
    parts = [f"{r.name} {100 * b:.0f} %" if r.log else f"{r.name} {b:.2f}" for r, b in pairs]
    return [f"discretization error{mesh}, part of the intervals: {', '.join(parts)}"]


def _fit(fit: Fit, mesh: str) -> str:
    allowed = [f"{words} {_mm(value)}" for words, value in (
        ("the noise of its points allows", fit.noise),
        (f"the mesh{mesh.replace(' on ', ' of ')} is expected to add", fit.mesh),
    ) if np.isfinite(value)]  # fmt: skip
    words = f"fit to {fit.recording}: mean distance {_mm(fit.distance)}"
    outliers = f"{100 * fit.outliers:.1f} % outliers"
    return "; ".join([words, *allowed, outliers])


def _nuisances(estimate: Estimate) -> list[str]:
    parts = []
    for name, unit, value, error in estimate.nuisances:
        unit = "" if unit == "-" else f" {unit}"
        spread = f" +- {error:.2g}" if np.isfinite(error) else ""
        parts.append(f"{name} {value:.3g}{spread}{unit}")
    return [f"nuisance parameters: {', '.join(parts)}"] if parts else []


def _search(estimate: Estimate, mesh: str) -> list[str]:
    if estimate.converged is None:
        return []
    words = "converged" if estimate.converged else "not converged: the budget ended it"
    if estimate.unsure:
        words = f"not sure of the minimum: {estimate.unsure}"
    elif estimate.reached is not None:
        ended, searches = estimate.reached
        words += f"; {ended} of {searches} searches from different starts fit as well"
    return [f"search{mesh}: {words}, {estimate.seconds:.0f} s"]


def _mm(value: float) -> str:
    return f"{1e3 * value:.2g} mm"
