"""`r2s simulate`: a fabric in a scenario, to a file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from r2s.commands.common import ScenarioName


@dataclass(frozen=True)
class Simulate:
    """Simulate a fabric in one of the six scenarios, and write its motion as an NPZ.

    The NPZ has x (frame, vertex, 3) [m] and faces (face, 3), as `r2s show --trajectory` reads it.
    With --recording it is also seen by two depth cameras, with noise and outliers: a synthetic
    recording to estimate from. Numbers of the motion are those of `r2s.scenarios.paths`, in SI
    units.

        r2s simulate lifting --fabric black_denim --motion height=0.3 --out lift.npz
        r2s simulate fling --fabric mine.json --shape 17 17 --out x.npz --recording fling.npz
    """

    scenario: Annotated[Positional[ScenarioName], arg(metavar="SCENARIO")]
    """Of the study."""
    out: Annotated[Path, arg(metavar="FILE")]
    """NPZ of the motion."""
    fabric: Annotated[str, arg(metavar="PRESET|CARD")] = "grey_interlock"
    """A preset of `r2s.fabrics.presets`, or the file of a fabric card."""
    motion: Annotated[tuple[str, ...], arg(metavar="NAME=NUMBER")] = ()
    """Numbers of the motion, such as height=0.3 [m]."""
    solver: Literal["cloth", "points"] = "cloth"
    """The cloth, or material points."""
    shape: tuple[int, int] = (9, 9)
    """Vertices along warp and weft."""
    self_contact: bool = False
    """The sheet touches itself (cloth only; slower)."""
    recording: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write a synthetic recording, as NPZ."""
    seed: int = 0
    """Of the recording's noise."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        import equinox as eqx
        import jax
        import numpy as np

        from r2s import scenarios
        from r2s.commands.common import card_of, experiment_of, tell
        from r2s.recordings.recording import save
        from r2s.scenarios import synthetic
        from r2s.scenarios.scenario import rollout
        from r2s.viewer.pictures import save_trajectory

        if self.self_contact and self.solver == "points":
            raise ValueError(
                "--self-contact is of the cloth: material points touch through their grid"
            )
        card, experiment = card_of(self.fabric), experiment_of(self.scenario, self.motion)
        scenario, fabric = experiment.scenario(self.shape, self.self_contact), card.fabric
        points = scenarios.material_points if self.solver == "points" else None
        solver = None if points is None else points(scenario, fabric)
        moved = eqx.filter_jit(rollout)(scenario, fabric, solver=solver)
        ok = np.asarray(moved.ok)
        save_trajectory(self.out, moved.x, scenario.scene.mesh.faces)
        told = {
            "scenario": self.scenario,
            "fabric": card.name,
            "solver": self.solver,
            "frames": len(ok),
            "vertices": int(moved.x.shape[1]),
            "interval_s": scenario.interval,
            "diverged_in_frame": None if ok.all() else int(np.argmin(ok)),
            "out": str(self.out),
            "recording": None if self.recording is None else str(self.recording),
        }
        lines = [f"{self.out}: {len(ok)} frames of {told['vertices']} vertices"]
        if ok.all() and self.recording is not None:
            about = experiment, fabric, card.name
            size = {"shape": self.shape, "self_contact": self.self_contact, "solver": points}
            made = synthetic.record(*about, **size, key=jax.random.key(self.seed))
            save(made, self.recording)
            lines.append(f"{self.recording}: {made.points.shape[1]} points a frame at most")
        if not ok.all():
            lines.append(f"the simulation diverged in frame {told['diverged_in_frame']}")
        tell(self.json, told, lines)
        return 0 if ok.all() else 1
