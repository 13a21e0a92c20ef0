"""Commands on fabrics: `r2s simulate`, `sensitivity` and `export`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from r2s.cli.common import ChosenShape, FabricName, Json, Motion, Scenario, Shape

SMALL = 0.01  # an error of an energy that has no consequence
TINY = 1e-3  # least ratio of energies whose inverse is printed


@dataclass(frozen=True)
class Simulate:
    """Simulate a fabric in one of six scenarios, as an NPZ.

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
    solver: Literal["cloth", "explicit", "mpm"] = "cloth"
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
        import equinox as eqx
        import jax
        import numpy as np

        from r2s import scenarios
        from r2s._util.files import check_folders
        from r2s._util.threads import one_at_a_time
        from r2s.cli.common import choose_shape, load_card, make_experiment, print_result
        from r2s.cli.waiting import Waiting
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
        if self.solver != "mpm":
            one_at_a_time()
        card, experiment = load_card(self.fabric), make_experiment(self.scenario, self.motion)
        fabric, size = card.fabric, experiment.sheet.size
        shape, of_shape, of_mesh = choose_shape(self.shape, fabric, size, self.scenario)
        scenario = experiment.scenario(shape, self.self_contact)
        make_solver = {
            "cloth": None,
            "explicit": scenarios.explicit_cloth,
            "mpm": scenarios.mpm_cloth,
        }[self.solver]
        solver = None if make_solver is None else make_solver(scenario, fabric)
        with Waiting("compiling the motion") as line:
            lowered = eqx.filter_jit(rollout).lower(scenario, fabric, solver=solver)
            moved = lowered.compile()
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
            **of_shape,
            "interval_s": scenario.interval,
            "diverged_in_frame": int(np.argmin(ok)) if failure else None,
            "failure": failure or None,
            "out": self.out,
            "recording": self.recording,
        }
        print_result(self.json, result, lines)
        return 1 if failure else 0


@dataclass(frozen=True)
class Sensitivity:
    """Predict what a planned motion would determine.

    Simulates the motion with a preset that is like the fabric, as seen by two depth cameras, and
    prints the standard error that each parameter would have.
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
        from r2s.cli.common import make_experiment, mesh_warning, parse_numbers, print_result
        from r2s.estimation.estimate import as_json
        from r2s.estimation.judgement import evaluate_design
        from r2s.estimation.method import COARSEST
        from r2s.estimation.summary import describe
        from r2s.scenarios.standard import SIDE

        make_experiment(self.scenario, self.motion)  # its errors are those of the other commands
        numbers = parse_numbers(self.motion)
        design = evaluate_design(self.scenario, self.fabric, numbers, self.noise, self.seed)
        coarse = mesh_warning(COARSEST, design.fabric, (SIDE, SIDE), self.scenario)
        print_result(self.json, as_json(design), [*describe(design), *coarse])


if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from r2s.export.stiffness import Loss
    from r2s.materials.fabric import Fabric


@dataclass(frozen=True)
class Export:
    """Write a fabric for another simulator.

    Says what is lost on the way.

    mujoco: a model (MJCF) of a sheet; newton: arguments of add_cloth_mesh and add_spring (JSON);
    arcsim: a material file (JSON); pybullet: arguments of loadSoftBody (JSON). MuJoCo and Newton
    get springs along the yarns, unless --isotropic. The sheet is a grid as in `r2s simulate`.

        r2s export denim.json --to mujoco --size 0.3 0.3 --shape 17 17 --out sheet.xml
        r2s export black_denim --to arcsim --out material.json
    """

    fabric: Positional[FabricName]
    to: Literal["mujoco", "newton", "newton-vbd", "arcsim", "pybullet"]
    """The simulator."""
    out: Annotated[Path, arg(metavar="FILE")]
    """What is written."""
    size: tuple[float, float] = (0.3, 0.3)
    """Sides of the sheet, warp and weft [m]; stiffness of edges depends on the mesh."""
    shape: Shape = (9, 9)
    isotropic: bool = False
    """The nearest isotropic sheet alone."""
    json: Json = False

    def run(self) -> int:
        from r2s._util.files import check_folders
        from r2s.cli.common import load_card, mesh_warning, print_result

        check_folders(self.out)
        card = load_card(self.fabric)
        loss = self._write(card.fabric, card.name)
        result = {
            "fabric": card.name,
            "to": self.to,
            "out": str(self.out),
            "relative_energy_error": {"membrane": loss.membrane, "bending": loss.bending},
            "lost": loss.lost,
        }
        lines = [f"{self.out}: {card.name} for {self.to}", *self._consequences(loss)]
        if self.to != "arcsim":
            lines += mesh_warning(self.shape, card.fabric, self.size, "lifting")
        print_result(self.json, result, [*lines, *(f"lost: {text}" for text in loss.lost)])
        return 0

    def _consequences(self, loss: "Loss") -> "Iterator[str]":
        """What errors of the energy do to a motion, and what helps; nothing of small ones."""
        if max(map(abs, loss.membrane.values()), default=0.0) > SMALL:
            farther = {name: 1 / max(1 + e, TINY) for name, e in loss.membrane.items()}
            advice = "a motion under its own weight hardly shows it"
            if self.isotropic:
                advice += "; without --isotropic it is nearer"
            yield f"the same force stretches it {_range(farther)} times as far: {advice}"
        if max(map(abs, loss.bending.values()), default=0.0) > SMALL:
            # a bending length grows as the cube root (Peirce 1930)
            wider = {name: max(1 + e, TINY) ** (1 / 3) for name, e in loss.bending.items()}
            yield (
                f"folds are {_range(wider)} times as wide: the mesh's diagonals bend too stiffly; "
                "a mesh with alternating ones is nearer (docs/guide/export.md)"
            )

    def _write(self, fabric: "Fabric", name: str) -> "Loss":
        from r2s._util.files import write_json, write_text
        from r2s.export import arcsim, mujoco, newton, pybullet
        from r2s.mesh.mesh import rectangle

        if self.to == "arcsim":
            try:
                return arcsim.write(self.out, fabric, name)
            except TypeError as error:  # a law that such a file cannot hold
                raise ValueError(str(error)) from error
        mesh, yarns = rectangle(self.size, self.shape), not self.isotropic
        if self.to == "mujoco":
            text, loss = mujoco.mjcf(fabric, mesh, yarns=yarns)
            write_text(self.out, text)
            return loss
        if self.to == "pybullet":
            arguments, loss = pybullet.soft_body(fabric, mesh)
            write_json(self.out, {"loadSoftBody": arguments})
            return loss
        kind = "vbd" if self.to == "newton-vbd" else "semi_implicit"
        cloth, loss = newton.cloth(fabric, mesh, kind, yarns=yarns)
        springs, fields = cloth.springs, cloth.fields
        model = {"add_cloth_mesh": cloth.arguments, "add_spring": springs, "fields": fields}
        write_json(self.out, model)
        return loss


def _range(ratios: "Mapping[str, float]") -> str:
    least, most = min(ratios, key=ratios.__getitem__), max(ratios, key=ratios.__getitem__)
    return f"{ratios[least]:.3g} ({least}) to {ratios[most]:.3g} ({most})"
