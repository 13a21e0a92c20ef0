"""`r2s check-grad`: are the derivatives of one's own scene right?"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from r2s.commands.common import ScenarioName

if TYPE_CHECKING:
    from r2s.fabrics.fabric import Fabric


@dataclass(frozen=True)
class CheckGrad:
    """Compare derivatives of a motion in every parameter of its fabric with central differences.

    In double precision, of the mean squared distance [m^2] from where the sheet began, over frames
    and vertices. Differences are taken over two widths: where these disagree, the motion is rough
    there, and says nothing ("rough"). Exit code 0 when all agree, else 1. Takes a minute or two.
    For a scene, mesh or loss of your own: `r2s.gradient_check.compare`.

        r2s check-grad lifting --fabric black_denim --motion height=0.3 --shape 5 5
        r2s check-grad folding --fabric mine.json --self-contact --forward
    """

    scenario: Annotated[Positional[ScenarioName], arg(metavar="SCENARIO")]
    """Of the study."""
    fabric: Annotated[str, arg(metavar="PRESET|CARD")] = "grey_interlock"
    """A preset of `r2s.fabrics.presets`, or the file of a fabric card."""
    motion: Annotated[tuple[str, ...], arg(metavar="NAME=NUMBER")] = ()
    """Numbers of the motion, such as height=0.3 [m]; num_frames=20 and interval=0.05 [s], too."""
    solver: Literal["cloth", "points"] = "cloth"
    """The cloth, or material points."""
    shape: tuple[int, int] = (5, 5)
    """Vertices along warp and weft."""
    self_contact: bool = False
    """The sheet touches itself (cloth only)."""
    forward: bool = False
    """Check forward mode instead of reverse mode (cloth only)."""
    tolerance: float = 1e-3
    """Relative difference that still agrees."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        import jax

        from r2s.commands.common import card_of, tell
        from r2s.gradient_check import compare

        if self.solver == "points" and (self.self_contact or self.forward):
            raise ValueError("--self-contact and --forward are of the cloth")
        if not self.tolerance > 0:
            raise ValueError(f"--tolerance must be positive, got {self.tolerance}")
        card = card_of(self.fabric)
        with jax.enable_x64(True):
            fabric = card.fabric
            options = {"forward": self.forward, "tolerance": self.tolerance}
            rows = compare(self._loss(fabric), fabric, **options)
        agree = all(row.verdict == "agrees" for row in rows)
        lines = [f"{'parameter':22s}{'value':>12s}{'derivative':>14s}{'differences':>14s}  verdict"]
        for row in rows:
            numbers = f"{row.value:12.4g}{row.derivative:14.6g}{row.differences:14.6g}"
            lines.append(f"{row.parameter:22s}{numbers}  {row.verdict}")
        lines.append("all derivatives agree" if agree else "NOT all derivatives agree")
        told = {"scenario": self.scenario, "fabric": card.name, "agree": agree}
        told["rows"] = [row._asdict() for row in rows]
        tell(self.json, told, lines)
        return 0 if agree else 1

    def _loss(self, fabric: "Fabric") -> Callable:
        import jax.numpy as jnp

        from r2s.commands.common import experiment_of
        from r2s.scenarios import material_points
        from r2s.scenarios.scenario import rollout

        scenario = experiment_of(self.scenario, self.motion).scenario(self.shape, self.self_contact)
        solver = material_points(scenario, fabric) if self.solver == "points" else None

        def loss(fabric):
            x = rollout(scenario, fabric, solver=solver).x
            return jnp.mean(jnp.sum((x - scenario.start[None]) ** 2, axis=-1))

        return loss
