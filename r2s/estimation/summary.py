"""The description of an estimate: values, intervals, fit, search, what to record next.

The words and figures are those of its JSON object (`r2s.estimation.estimate.as_json`).
"""

import numpy as np

from r2s._util.units import millimetres
from r2s.estimation.estimate import Estimate, Fit, Nuisance

HEADER = ("parameter", "estimate", "90 % interval", "posterior/prior")
NEXT = {  # a recording, and the parameters that it determines best
    "three stretchings with their force, along warp and weft and at 45 degrees": (
        *("warp", "weft", "shear", "coupling", "stiffening", "knee"),
        *("E h", "nu"),
    ),
    "a lift of one corner, or a cantilever test": ("bending",),
    "a fling or a swing of the hanging sheet": ("damping",),
    "a fold or a drag over the table": ("friction",),
}


def describe(estimate: Estimate) -> list[str]:
    """Lines for people: each parameter, what is correlated, fit, nuisance parameters, search."""
    shape = estimate.shape
    mesh = "" if shape is None else f" on {shape[0]} x {shape[1]} vertices"
    lines = _table(estimate)
    pairs = ", ".join(f"{one} and {other} {r:.2f}" for one, other, r in estimate.correlated())
    if pairs:
        lines.append(f"largest correlations (1 or -1: not told apart): {pairs}")
    if estimate.mesh_bias is not None:
        biases = zip(estimate.ranges, estimate.mesh_bias, strict=True)
        parts = ", ".join(
            f"{r.name} {100 * b:.0f} %" if r.log else f"{r.name} {b:.2f}" for r, b in biases
        )
        lines.append(f"discretization error{mesh}, part of the intervals: {parts}")
    lines += [_fit(fit, mesh) for fit in estimate.fits]
    if estimate.nuisances:
        parts = ", ".join(map(_nuisance, estimate.nuisances))
        lines.append(f"nuisance parameters (+- standard error): {parts}")
    lines += _search(estimate, mesh)
    named = ", ".join(f"{name} ({side})" for name, side in estimate.at_bounds.items())
    if named:
        lines.append(f"warning: at a bound, beyond which the truth may lie: {named}")
    return lines + next_recording(estimate)


def next_recording(estimate: Estimate) -> list[str]:
    """What to record next: the two of `NEXT` whose parameters have the most variance left, relative
    to the prior's; none without standard errors."""
    ratios = zip((bound.name for bound in estimate.ranges), estimate.narrowing, strict=True)
    known = {name: float(ratio) for name, ratio in ratios if np.isfinite(ratio)}
    kinds = {
        kind: [name for name in known if name in names or name.split()[0] in names]
        for kind, names in NEXT.items()
    }
    kinds = {kind: names for kind, names in kinds.items() if names}
    if not kinds:
        return []
    order = sorted(kinds, key=lambda kind: -sum(known[name] ** 2 for name in kinds[kind]))
    named = (f"{kind}, for {_worst(kinds[kind], known)}" for kind in order[:2])
    return [f"record next: {'; then '.join(named)} (in brackets posterior/prior)"]


def _worst(names: list[str], known: dict[str, float]) -> str:
    """Parameters whose ratio is at least half of the largest, that first."""
    names = sorted(names, key=lambda name: -known[name])
    return ", ".join(
        f"{name} ({known[name]:.2g})" for name in names if known[name] >= known[names[0]] / 2
    )


def _table(estimate: Estimate) -> list[str]:
    rows: list[tuple[str, ...]] = [HEADER]
    columns = estimate.values, estimate.intervals, estimate.narrowing
    for bound, value, (low, high), ratio in zip(estimate.ranges, *columns, strict=True):
        unit = "" if bound.unit == "-" else f" {bound.unit}"
        side = estimate.at_bounds.get(bound.name)
        end = f"  (at its {side} bound)" if side else ""
        ends = _end(low, bound.low), _end(high, bound.high)
        interval = f"{ends[0]} to {ends[1]}{unit}" if np.isfinite(low) else "unknown"
        rows.append((bound.name, f"{value:.4g}{unit}", interval, f"{ratio:.2g}{end}"))
    last = (
        "posterior/prior: how far the recording narrowed what was known (standard deviations; "
        "1: not at all); *: the end of the range that is searched"
    )
    if not np.isfinite(estimate.standard_errors).any():
        rows, last = [row[:2] for row in rows], "this method gives no standard errors"
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [*("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows), last]


def _end(value: float, limit: float) -> str:
    """The end of an interval, marked where it is that of the range."""
    return f"{value:.3g}" + "*" * bool(np.isclose(value, limit, rtol=1e-3))


def _fit(fit: Fit, mesh: str) -> str:
    outliers = f"without the {100 * fit.outliers:.1f} % outliers"
    words = [f"fit to {fit.recording}: mean distance {millimetres(fit.distance)} {outliers}"]
    if np.isfinite(fit.noise):
        words.append(f"the noise of its points allows {millimetres(fit.noise)}")
    if np.isfinite(fit.mesh):
        words.append(f"a prediction{mesh} is expected to be {millimetres(fit.mesh)} off a fine one")
    return "; ".join(words)


def _nuisance(nuisance: Nuisance) -> str:
    unit = "" if nuisance.unit == "-" else f" {nuisance.unit}"
    error = nuisance.standard_error
    spread = f" +- {error:.2g}" if np.isfinite(error) else ""
    return f"{nuisance.name} {nuisance.value:.3g}{spread}{unit}"


def _search(estimate: Estimate, mesh: str) -> list[str]:
    if estimate.converged is None:
        return []
    words = "converged" if estimate.converged else "not converged: the budget ended it"
    if estimate.unsure:
        words = f"not sure of the minimum: {estimate.unsure}"
    elif estimate.reached is not None:
        ended, searches = estimate.reached
        words += f"; {ended} of {searches} searches from different starts fit as well"
    else:
        words += "; no other start was tried"
    return [f"search{mesh}: {words}, {estimate.seconds:.0f} s"]
