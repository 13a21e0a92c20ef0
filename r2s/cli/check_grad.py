"""`r2s check-grad`: are the derivatives of one's own scene right?"""

from dataclasses import dataclass

from r2s.cli.common import FabricName, Json, Motion, Scenario, Shape, SolverName


@dataclass(frozen=True)
class CheckGrad:
    """Compare derivatives of a motion in every parameter of its fabric with central differences.

    In double precision, of the mean squared distance [m^2] from where the sheet began, over frames
    and vertices. Differences are taken over two widths: where these disagree, the motion is rough
    there, and says nothing ("rough"). Exit code 0 when all agree, else 1. Takes a minute or two.
    For a scene, mesh or loss of your own: `r2s.solvers.gradient_check.compare`.

        r2s check-grad lifting --fabric black_denim --motion height=0.3 --shape 5 5
        r2s check-grad folding --fabric mine.json --self-contact --forward
    """

    scenario: Scenario
    fabric: FabricName = "grey_interlock"
    motion: Motion = ()
    solver: SolverName = "cloth"
    shape: Shape = (5, 5)
    self_contact: bool = False
    """The sheet touches itself (cloth only)."""
    forward: bool = False
    """Check forward mode instead of reverse mode (cloth only)."""
    tolerance: float = 1e-3
    """Relative difference that still agrees."""
    json: Json = False

    def run(self) -> int:
        import jax
        import jax.numpy as jnp

        from r2s.cli.common import load_card, make_experiment, mesh_warning, print_result
        from r2s.scenarios import material_points
        from r2s.scenarios.scenario import rollout
        from r2s.solvers.gradient_check import compare

        if self.solver == "points" and (self.self_contact or self.forward):
            raise ValueError("--self-contact and --forward are of the cloth")
        if not self.tolerance > 0:
            raise ValueError(f"--tolerance must be positive, got {self.tolerance}")
        card = load_card(self.fabric)
        with jax.enable_x64(True):
            fabric = card.fabric
            experiment = make_experiment(self.scenario, self.motion)
            scenario = experiment.scenario(self.shape, self.self_contact)
            solver = material_points(scenario, fabric) if self.solver == "points" else None

            def loss(fabric):
                x = rollout(scenario, fabric, solver=solver).x
                return jnp.mean(jnp.sum((x - scenario.start[None]) ** 2, axis=-1))

            rows = compare(loss, fabric, forward=self.forward, tolerance=self.tolerance)
            failure = ""
            if any(row.verdict == "not finite" for row in rows):
                failure = rollout(scenario, fabric, solver=solver).explain()
            warning = mesh_warning(self.shape, fabric, experiment.sheet.size, self.scenario)
        agree = all(row.verdict == "agrees" for row in rows)
        lines = [f"{'parameter':22s}{'value':>12s}{'derivative':>14s}{'differences':>14s}  verdict"]
        for row in rows:
            numbers = f"{row.value:12.4g}{row.derivative:14.6g}{row.differences:14.6g}"
            lines.append(f"{row.parameter:22s}{numbers}  {row.verdict}")
        lines += [f"the simulation {failure}"] if failure else []
        lines += warning
        lines.append("all derivatives agree" if agree else "NOT all derivatives agree")
        result = {
            "scenario": self.scenario,
            "fabric": card.name,
            "agree": agree,
            "failure": failure or None,
            "rows": [row._asdict() for row in rows],
        }
        print_result(self.json, result, lines)
        return 0 if agree else 1
