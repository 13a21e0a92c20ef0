"""`r2s check-grad`: are the derivatives of one's own scene right?"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from r2s.commands.common import ScenarioName

if TYPE_CHECKING:
    from r2s.fabric import Fabric

WIDTHS = (1e-3, 2.5e-4)  # relative, to either side
TOLERANCE = 1e-3


@dataclass(frozen=True)
class CheckGrad:
    """Compare derivatives of a motion in every parameter of its fabric with central differences.

    In double precision, of the mean squared distance [m^2] from where the sheet began, over frames
    and vertices. Differences are taken over two widths: where these disagree, the motion is rough
    there, and says nothing ("rough"). Exit code 0 when all agree, else 1. Takes a minute or two.

        r2s check-grad lifting --fabric black_denim --motion height=0.3 --shape 5 5
        r2s check-grad folding --fabric mine.json --layers --forward
    """

    scenario: Annotated[Positional[ScenarioName], arg(metavar="SCENARIO")]
    """Of the study."""
    fabric: Annotated[str, arg(metavar="PRESET|CARD")] = "grey_interlock"
    """A preset of `r2s.presets`, or the file of a fabric card."""
    motion: Annotated[tuple[str, ...], arg(metavar="NAME=NUMBER")] = ()
    """Numbers of the motion, such as height=0.3 [m]; num_frames=20 and interval=0.05 [s], too."""
    solver: Literal["cloth", "points"] = "cloth"
    """The cloth, or material points."""
    shape: tuple[int, int] = (5, 5)
    """Vertices along warp and weft."""
    layers: bool = False
    """The sheet touches itself (cloth only)."""
    forward: bool = False
    """Check forward mode instead of reverse mode (cloth only)."""
    tolerance: float = TOLERANCE
    """Relative difference that still agrees."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        import jax

        from r2s.commands.common import card_of, tell

        if self.solver == "points" and (self.layers or self.forward):
            raise ValueError("--layers and --forward are of the cloth")
        if not self.tolerance > 0:
            raise ValueError(f"--tolerance must be positive, got {self.tolerance}")
        card = card_of(self.fabric)
        with jax.enable_x64(True):
            rows = self._rows(card.fabric)
        agree = all(row["verdict"] == "agrees" for row in rows)
        lines = [f"{'parameter':22s}{'value':>12s}{'derivative':>14s}{'differences':>14s}  verdict"]
        for row in rows:
            numbers = f"{row['value']:12.4g}{row['derivative']:14.6g}{row['differences']:14.6g}"
            lines.append(f"{row['parameter']:22s}{numbers}  {row['verdict']}")
        lines.append("all derivatives agree" if agree else "NOT all derivatives agree")
        told = {"scenario": self.scenario, "fabric": card.name, "agree": agree, "rows": rows}
        tell(self.json, told, lines)
        return 0 if agree else 1

    def _rows(self, fabric: "Fabric") -> list[dict[str, Any]]:
        import jax
        import jax.numpy as jnp

        leaves, tree = jax.tree.flatten(fabric)
        start = jnp.concatenate([jnp.ravel(leaf) for leaf in leaves])
        sizes = [leaf.size for leaf in leaves]
        ends = [sum(sizes[: i + 1]) for i in range(len(sizes) - 1)]
        shapes = [leaf.shape for leaf in leaves]
        back = lambda vector: jax.tree.unflatten(
            tree,
            [p.reshape(s) for p, s in zip(jnp.split(vector, ends), shapes, strict=True)],
        )
        loss = self._loss(fabric, back)
        slope = jax.jit((jax.jacfwd if self.forward else jax.grad)(loss))(start)
        value = jax.jit(loss)
        names = _names(fabric)
        return [
            _row(name, value, start, i, float(slope[i]), self.tolerance)
            for i, name in enumerate(names)
        ]

    def _loss(self, fabric: "Fabric", back: Callable) -> Callable:
        import jax.numpy as jnp

        from r2s.commands.common import experiment_of
        from r2s.scenario import motion
        from r2s.scenarios import material_points

        scenario = experiment_of(self.scenario, self.motion).scenario(self.shape, self.layers)
        solver = material_points(scenario, fabric) if self.solver == "points" else None

        def loss(vector):
            x = motion(scenario, back(vector), solver=solver).x
            return jnp.mean(jnp.sum((x - scenario.start[None]) ** 2, axis=-1))

        return loss


def _names(fabric: "Fabric") -> list[str]:
    """Of every number of a fabric."""
    import jax

    found = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(fabric)[0]:
        name = jax.tree_util.keystr(path).lstrip(".")
        found += [name] if leaf.ndim == 0 else [f"{name}[{i}]" for i in range(leaf.size)]
    return found


def _row(
    name: str, loss: Callable, start: Any, i: int, slope: float, tolerance: float
) -> dict[str, Any]:
    """The derivative in one number beside differences, and what to make of it."""
    import math

    value = float(start[i])
    scale = abs(value) or 1.0

    def difference(width: float) -> float:
        above, below = (loss(start.at[i].add(side * width * scale)) for side in (1, -1))
        return float(above - below) / (2 * width * scale)

    wide, narrow = (difference(width) for width in WIDTHS)
    # central differences err with the square of their width
    ratio = (WIDTHS[0] / WIDTHS[1]) ** 2
    best = narrow + (narrow - wide) / (ratio - 1)
    least = 1e-9 * float(loss(start)) / scale  # rounding of the loss over the narrow width
    size = max(abs(best), abs(slope), least)
    if not all(map(math.isfinite, (wide, narrow, slope))):
        verdict = "not finite"
    elif abs(slope - best) <= tolerance * size or size == least:
        verdict = "agrees"
    elif abs(narrow - wide) > tolerance * size:
        verdict = "rough"
    else:
        verdict = "differs"
    numbers = {"derivative": slope, "differences": best, "wide": wide, "narrow": narrow}
    return {"parameter": name, "value": value, **numbers, "verdict": verdict}
