"""`r2s simulate`: a fabric in a scenario, to a file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from r2s.cli.common import ChosenShape, FabricName, Json, Motion, Scenario


@dataclass(frozen=True)
class Simulate:
    """Simulate a fabric in one of the six scenarios, and write its motion as an NPZ.

    The NPZ has x (frame, vertex, 3) [m] and faces (face, 3), as `r2s show --trajectory` reads it.
    With --recording it is also seen by two depth cameras, with noise and outliers: a synthetic
    recording to estimate from. Numbers of the motion are those of `r2s.scenarios.standard`, in SI
    units.

        r2s simulate lifting --fabric black_denim --motion height=0.3 --out lift.npz
        r2s simulate fling --fabric mine.json --shape 33 33 --out x.npz --recording fling.npz
    """

    scenario: Scenario
    out: Annotated[Path, arg(metavar="FILE")]
    """NPZ of the motion."""
    fabric: FabricName = "grey_interlock"
    motion: Motion = ()
    solver: Literal["cloth", "explicit", "points"] = "cloth"
    """The implicit cloth, the cloth in explicit steps, or material points."""
    shape: ChosenShape = None
    self_contact: bool = False
    """The sheet touches itself (cloth only; slower)."""
    recording: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write a synthetic recording, as NPZ."""
    seed: int = 0
    """Seed of the recording's noise."""
    json: Json = False

    def run(self) -> int:
        import jax
        import numpy as np

        from r2s import scenarios
        from r2s._util.files import check_folders
        from r2s.cli.common import choose_shape, load_card, make_experiment, print_result
        from r2s.cli.waiting import Waiting
        from r2s.compilation import compile_once
        from r2s.recordings.open import save_trajectory
        from r2s.recordings.recording import save
        from r2s.scenarios import synthetic
        from r2s.scenarios.scenario import rollout

        check_folders(self.out, self.recording)
        if self.self_contact and self.solver != "cloth":
            raise ValueError(
                "--self-contact is of the implicit cloth: explicit steps have none, and material "
                "points touch through their grid"
            )
        card, experiment = load_card(self.fabric), make_experiment(self.scenario, self.motion)
        fabric, size = card.fabric, experiment.sheet.size
        shape, told, of_mesh = choose_shape(self.shape, fabric, size, self.scenario)
        scenario = experiment.scenario(shape, self.self_contact)
        make_solver = {
            "cloth": None,
            "explicit": scenarios.explicit_cloth,
            "points": scenarios.material_points,
        }[self.solver]
        solver = None if make_solver is None else make_solver(scenario, fabric)
        with Waiting("compiling the motion") as line:
            moved = compile_once(rollout)
            moved.prepare(scenario, fabric, solver=solver)
            line.say(f"simulating {scenario.num_frames} frames")
            motion = moved(scenario, fabric, solver=solver)
            ok, failure = np.asarray(motion.ok), motion.explain()
        save_trajectory(self.out, motion.x, scenario.scene.mesh.faces)
        lines = [f"{self.out}: {len(ok)} frames of {motion.x.shape[1]} vertices", *of_mesh]
        if failure:
            lines.append(f"the simulation {failure}")
        elif self.recording is not None:
            with Waiting("recording the motion"):
                made = synthetic.record(
                    experiment,
                    fabric,
                    card.name,
                    shape=shape,
                    self_contact=self.self_contact,
                    solver=make_solver,
                    motion=motion,
                    key=jax.random.key(self.seed),
                )
            save(made, self.recording)
            lines.append(f"{self.recording}: {made.points.shape[1]} points a frame at most")
        result = {
            "scenario": self.scenario,
            "fabric": card.name,
            "solver": self.solver,
            "frames": len(ok),
            "vertices": int(motion.x.shape[1]),
            **told,
            "interval_s": scenario.interval,
            "diverged_in_frame": int(np.argmin(ok)) if failure else None,
            "failure": failure or None,
            "out": self.out,
            "recording": self.recording,
        }
        print_result(self.json, result, lines)
        return 1 if failure else 0
