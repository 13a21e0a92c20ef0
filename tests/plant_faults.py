"""Plant faults in r2s, one at a time, and see whether the fast tests catch them.

    python tests/plant_faults.py                # all; about half an hour on two cores
    python tests/plant_faults.py gravity wind   # those whose names have one of these words

Works in a copy of the project in a temporary folder. Each fault is a sign, a factor, a unit, an
index or a missing term. It is caught if one of its test files fails. Exit code 1 when one is not.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
QUICK = "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0"


class Fault(NamedTuple):
    """A text that stands once in `r2s/`, what is written in its place, and tests that fail then."""

    name: str
    right: str
    wrong: str
    tests: str


FAULTS = (
    Fault(
        "membrane: half of the shear stiffness",
        "(stretch + self.c33 * shear**2) / 2",
        "(stretch + self.c33 * shear**2 / 2) / 2",
        "materials/test_membrane.py",
    ),
    Fault(
        "membrane: half of the coupling",
        "2 * self.c12 * e11 * e22",
        "self.c12 * e11 * e22",
        "materials/test_membrane.py",
    ),
    Fault(
        "springs: one bias is missing",
        "extension(mean + half) ** 2 + extension(mean - half) ** 2",
        "extension(mean + half) ** 2",
        "materials/test_membrane.py",
    ),
    Fault(
        "plate: twice the twisting stiffness",
        "(1 - nu) / 2 * twist**2",
        "(1 - nu) * twist**2",
        "materials/test_plate.py",
    ),
    Fault(
        "orthotropic plate: another stiffness along the bias",
        "of_twist = self.bias - (self.warp + self.weft) / 4",
        "of_twist = self.bias - (self.warp + self.weft) / 2",
        "materials/test_plate.py solvers/test_elastica.py",
    ),
    Fault(
        "hinge: the sign of one derivative",
        "of_left, of_right = -length * left",
        "of_left, of_right = length * left",
        "materials/test_bending.py materials/test_plate.py",
    ),
    Fault(
        "strain: half of the shear",
        "(weft @ weft - 1) / 2, warp @ weft])",
        "(weft @ weft - 1) / 2, warp @ weft / 2])",
        "materials/test_membrane.py",
    ),
    Fault(
        "strain: half of the shear",
        "(weft @ weft - 1) / 2, warp @ weft]",
        "(weft @ weft - 1) / 2, warp @ weft / 2]",
        "materials/test_membrane.py",
    ),
    Fault(
        "grid: area of a sample",
        "areas = np.full((len(corners), 4), np.prod(spacing) / 4)",
        "areas = np.full((len(corners), 4), np.prod(spacing) / 2)",
        "materials/test_membrane.py mesh/test_mesh.py",
    ),
    Fault(
        "wind: force linear in the speed",
        "self.drag_coefficient * jnp.abs(normal_flow) ** 3",
        "self.drag_coefficient * jnp.abs(normal_flow) ** 2",
        "environment/test_contact_air.py",
    ),
    Fault(
        "wind: twice the density",
        "return self.density / 2 * area * (drag + friction) / 3",
        "return self.density * area * (drag + friction) / 3",
        "environment/test_contact_air.py",
    ),
    Fault(
        "fan: the wrong side",
        "4 * (self.radius - distance) / self.edge",
        "4 * (distance - self.radius) / self.edge",
        "environment/test_contact_air.py",
    ),
    Fault(
        "table: factor of the energy",
        "return PRESSURE_STIFFNESS * depth**3 / 3",
        "return PRESSURE_STIFFNESS * depth**3 / 2",
        "environment/test_contact_air.py",
    ),
    Fault(
        "friction in explicit steps: half",
        "kept = _kept_slip(speed, friction * pushed)",
        "kept = _kept_slip(speed, friction * pushed / 2)",
        "solvers/test_explicit.py",
    ),
    Fault(
        "gravity in explicit steps: upwards",
        "up = up - braking * dt * gravity",
        "up = up + braking * dt * gravity",
        "solvers/test_explicit.py",
    ),
    Fault(
        "gravity in implicit steps: along y",
        "+ mass * step.gravity * x[2]",
        "+ mass * step.gravity * x[1]",
        "solvers/test_cloth.py",
    ),
    Fault(
        "friction in implicit steps: a rate is missing",
        "area * contact.normal_potential(depth) + friction / step.rate",
        "area * contact.normal_potential(depth) + friction",
        "environment/test_contact_air.py",
    ),
    Fault(
        "damping of mass: twice",
        "drag = mass * step.fabric.mass_damping / 2",
        "drag = mass * step.fabric.mass_damping",
        "environment/test_contact_air.py solvers/test_cloth.py",
    ),
    Fault(
        "damping of the membrane: twice",
        "return step.fabric.damping * step.rate / 2 * jnp.sum(change * stress_change)",
        "return step.fabric.damping * step.rate * jnp.sum(change * stress_change)",
        "solvers/test_cloth.py solvers/test_statics.py",
    ),
    Fault(
        "BDF2: the rate of the first order",
        "jnp.asarray(1.5 / self.dt, float)",
        "jnp.asarray(1.0 / self.dt, float)",
        "solvers/test_cloth.py",
    ),
    Fault(
        "viscosity in explicit steps: its sign",
        "return stress + self.share * ahead",
        "return stress - self.share * ahead",
        "solvers/test_explicit.py",
    ),
    Fault(
        "grid: mass at the border",
        "(np.r_[0.5, np.ones(n - 2), 0.5] for n in shape)",
        "(np.r_[1.0, np.ones(n - 2), 1.0] for n in shape)",
        "mesh/test_mesh.py",
    ),
    Fault(
        "material points: factor of the affine velocity",
        "return 4 / grid.spacing**2",
        "return 3 / grid.spacing**2",
        "solvers/test_mpm_transfer.py solvers/test_mpm_block.py",
    ),
    Fault(
        "material points: no stress between layers",
        "mass[:, None, None] * state.C - factor * stress",
        "mass[:, None, None] * state.C",
        "solvers/test_mpm_sheet.py",
    ),
    Fault(
        "self-contact: a sign of the weights",
        "_EDGES_SIGN = np.array([1, 1, -1, -1])",
        "_EDGES_SIGN = np.array([1, -1, -1, 1])",
        "solvers/test_proximity.py",
    ),
    Fault(
        "parameters: a logarithmic range upside down",
        "jnp.exp(jnp.log(self.low) * (1 - u) + jnp.log(self.high) * u)",
        "jnp.exp(jnp.log(self.high) * (1 - u) + jnp.log(self.low) * u)",
        "materials/test_family.py",
    ),
    Fault(
        "camera: focal length in the wrong place",
        "self.focal_length * plane / depth[:, None]",
        "self.focal_length * plane / (depth[:, None] + 1)",
        "recordings/test_views.py recordings/test_depth.py",
    ),
    Fault(
        "Chamfer distance: one direction alone",
        '"chamfer": (one + other) / 2',
        '"chamfer": one',
        "metrics/test_metrics.py",
    ),
    Fault(
        "paper's distance: factor 2 is missing",
        "return 2 * (cloud - centre) / radius",
        "return (cloud - centre) / radius",
        "metrics/test_metrics.py",
    ),
    Fault(
        "energy: work of the air is missing",
        "return self.grippers + self.air - (held - held[0])",
        "return self.grippers - (held - held[0])",
        "scenarios/test_scenarios.py materials/test_wrinkling.py solvers/test_cloth.py",
    ),
    Fault(
        "pull: tension over the length",
        "(force - rest.force) / wide",
        "(force - rest.force) / length",
        "laboratory/test_laboratory.py",
    ),
    Fault(
        "pull: the zero of a pretension after the first reading",
        "rest = (shown - at_none) / slope",
        "rest = (at_none - shown) / slope",
        "laboratory/test_laboratory.py",
    ),
    Fault(
        "cantilever: length by the square root",
        "(stiffness / (fabric.density * GRAVITY)) ** (1 / 3)",
        "(stiffness / (fabric.density * GRAVITY)) ** (1 / 2)",
        "laboratory/test_laboratory.py",
    ),
    Fault(
        "bounded step: the sign of the gradient",
        "right = -axes.T @ np.asarray(gradient, np.float64) / roots",
        "right = axes.T @ np.asarray(gradient, np.float64) / roots",
        "estimation/test_mesh_bias.py",
    ),
)


def plant(package: Path, fault: Fault) -> Path:
    """Write a fault into the one file that has its text; that file."""
    found = [path for path in package.rglob("*.py") if fault.right in path.read_text("utf-8")]
    if len(found) != 1 or found[0].read_text("utf-8").count(fault.right) != 1:
        raise ValueError(f"{fault.name}: its text must stand once in r2s, found {found}")
    found[0].write_text(found[0].read_text("utf-8").replace(fault.right, fault.wrong), "utf-8")
    return found[0]


def is_caught(copy: Path, fault: Fault) -> bool:
    """Whether one of the fault's tests fails."""
    tests = [str(copy / "tests" / name) for name in fault.tests.split()]
    quiet = {"OMP_NUM_THREADS": "1", "NPROC": "1", "TF_CPP_MIN_LOG_LEVEL": "3", "XLA_FLAGS": QUICK}
    command = [sys.executable, "-m", "pytest", "-q", "-x", *tests]
    done = subprocess.run(command, cwd=copy, env=os.environ | quiet, capture_output=True, text=True)
    if done.returncode not in (0, 1):  # no tests, or an error of pytest itself
        raise RuntimeError(f"{fault.name}: {done.stdout[-1000:]}{done.stderr[-1000:]}")
    return done.returncode == 1


def main(words: list[str]) -> int:
    """Plant the faults whose names have one of the words; how many were not caught."""
    chosen = [x for x in FAULTS if not words or any(word in x.name for word in words)]
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "r2s"
        leave = shutil.ignore_patterns(".venv", ".git", "results", "__pycache__")
        shutil.copytree(ROOT, copy, ignore=leave)
        for fault in chosen:
            began = time.monotonic()
            file = plant(copy / "r2s", fault)
            caught = is_caught(copy, fault)
            shutil.copy(ROOT / file.relative_to(copy), file)
            missed += not caught
            seconds = time.monotonic() - began
            print(f"{'caught' if caught else 'MISSED'} {fault.name} ({seconds:.0f} s)", flush=True)
    print(f"{len(chosen) - missed} of {len(chosen)} caught")
    return missed


if __name__ == "__main__":
    sys.exit(1 if main(sys.argv[1:]) else 0)
