"""`r2s sensitivity`: what a planned motion would reveal of a fabric."""

from dataclasses import dataclass

from r2s.cli.common import Json, Motion, Scenario


@dataclass(frozen=True)
class Sensitivity:
    """Say what a planned motion would reveal of a fabric, before anybody makes it.

    Simulates the motion with a preset that is like the fabric, as seen by two depth cameras, and
    prints how well each parameter would be known, and which combinations where one is not.
    Numbers of the motion are those of `r2s.scenarios.standard`, in SI units.

        r2s sensitivity lifting --fabric black_denim --motion height=0.3 moving=2
        r2s sensitivity wind --fabric grey_interlock --motion speed=3 --noise 0.002
    """

    scenario: Scenario
    fabric: str = "grey_interlock"
    """A preset of `r2s.materials.presets`."""
    motion: Motion = ()
    noise: float = 1e-3
    """Standard deviation of each coordinate of a point [m]."""
    seed: int = 0
    """Seed of the noise."""
    json: Json = False

    def run(self) -> None:
        from r2s.cli.common import mesh_warning, parse_numbers, print_result
        from r2s.estimation.estimate import as_json, describe
        from r2s.estimation.judgement import evaluate_design
        from r2s.estimation.method import COARSEST
        from r2s.scenarios.standard import SIDE

        numbers = parse_numbers(self.motion)
        found = evaluate_design(self.scenario, self.fabric, numbers, self.noise, self.seed)
        coarse = mesh_warning(COARSEST, found.fabric, (SIDE, SIDE), self.scenario)
        print_result(self.json, as_json(found), [*describe(found), *coarse])
