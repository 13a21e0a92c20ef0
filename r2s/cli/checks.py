"""`r2s check-grad`: are derivatives right? `r2s doctor`: is the installation?"""

import platform
import re
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from r2s.cli.common import FabricName, Json, Motion, Scenario, ScenarioName, Shape, SolverName


@dataclass(frozen=True)
class CheckGrad:
    """Check derivatives of a motion by central differences.

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
        from r2s.scenarios import mpm_cloth
        from r2s.scenarios.scenario import rollout
        from r2s.solvers.gradient_check import compare

        if self.solver == "mpm" and (self.self_contact or self.forward):
            raise ValueError("--self-contact and --forward are of the cloth")
        if not self.tolerance > 0:
            raise ValueError(f"--tolerance must be positive, got {self.tolerance}")
        card = load_card(self.fabric)
        with jax.enable_x64(True):
            fabric = card.fabric
            experiment = make_experiment(self.scenario, self.motion)
            scenario = experiment.scenario(self.shape, self.self_contact)
            solver = mpm_cloth(scenario, fabric) if self.solver == "mpm" else None

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


if TYPE_CHECKING:
    from r2s.materials.fabric import Fabric

EXCLUDED = {"0.10.2": "wrong numbers from a jitted vmap on the CPU", "0.11.1": "no flax"}
PACKAGES = ("r2s", "jax", "jaxlib", "equinox", "optax", "lineax", "numpy")
PLAUSIBLE = {  # of fabrics for clothes and the household
    "density": (0.05, 1.0, "kg/m^2", "an areal density: a T-shirt has 0.15, denim 0.4"),
    "damping": (0.0, 0.1, "s", "a time"),
    "friction": (0.05, 1.5, "-", "Coulomb's coefficient"),
    "thickness": (1e-4, 5e-3, "m", "of the sheet"),
    "mass_damping": (0.0, 20.0, "1/s", "a rate"),
}
STIFF = (1.0, 1e5, "N/m", "a force per width: a modulus in Pa times the thickness in m")
BENDS = (1e-8, 1e-2, "N m", "a moment per curvature and width: 1 mN mm is 1e-6 N m")


@dataclass(frozen=True)
class Doctor:
    """Check the installation, a card, a mesh or a scenario.

    Says versions, devices, precision and which extras there are; whether the numbers of a fabric
    are plausible in their units; whether a mesh is sound; whether the fabric can be simulated in a
    scenario, and which time step and how much memory that takes. Exit code 1 when something is
    wrong.

        r2s doctor
        r2s doctor --fabric mine.json --scenario folding --shape 17 17
    """

    fabric: FabricName = ""
    mesh: Annotated[Path | None, arg(metavar="FILE")] = None
    """A plane sheet in an OBJ, PLY, OFF, STL or glTF file; the next five options are of it."""
    unit: Literal["m", "cm", "mm", "in"] | None = None
    """Of the mesh's lengths; by default metres, if its size is that of a sheet."""
    uv: bool = False
    """The rest shape is that of its texture coordinates."""
    weld: float | None = None
    """Vertices nearer than this are one, [m]; by default 1e-5 of the extent."""
    largest: bool = False
    """Of several pieces the largest is taken."""
    strict: bool = False
    """Refuse a mesh that would be changed."""
    scenario: Annotated[ScenarioName | None, arg(metavar="SCENARIO")] = None
    """A scenario of the study, whose motion is checked, too."""
    motion: Motion = ()
    shape: Shape = (9, 9)
    json: Json = False

    def run(self) -> int:
        from r2s.cli.common import load_card, print_result

        result, lines, wrong = installation()
        if self.fabric:
            card = load_card(self.fabric)
            result["fabric"], more = _fabric(card.name, card.fabric, self.shape)
            lines += more
            wrong += [f"{card.name}: {text}" for text in result["fabric"]["implausible"]]
        if self.mesh is not None:
            result["mesh"], more = self._mesh(self.mesh)
            lines += more
        if self.scenario is not None:
            result["scenario"], more = self._scenario(self.scenario)
            lines += more
            if failure := result["scenario"]["failure"]:
                wrong.append(f"scenario {self.scenario}: the simulation {failure}")
        result["wrong"] = wrong
        print_result(self.json, result, [*lines, *(f"WRONG: {text}" for text in wrong)])
        return 1 if wrong else 0

    def _mesh(self, path: Path) -> tuple[dict[str, Any], list[str]]:
        import numpy as np

        from r2s.mesh.files import UNITS, read_mesh

        options = {key: getattr(self, key) for key in ("uv", "weld", "largest", "strict")}
        read = read_mesh(path, scale=UNITS.get(self.unit or ""), **options)
        mesh = read.mesh
        rest, faces, hinges = (np.asarray(each) for each in (mesh.rest, mesh.faces, mesh.hinges))
        edges = np.linalg.norm(rest[faces] - rest[np.roll(faces, 1, axis=1)], axis=-1)
        result = {
            "vertices": len(rest),
            "faces": len(faces),
            "inner_edges": len(hinges),
            "area_m2": float(np.sum(mesh.area)),
            "shortest_edge_m": float(edges.min()),
            "longest_edge_m": float(edges.max()),
            "changes": read.changes,
            "notes": read.notes,
        }
        size = f"{len(rest)} vertices, {len(faces)} faces, {len(hinges)} inner edges, one piece"
        edge = f"edges {1e3 * edges.min():.2f} to {1e3 * edges.max():.2f} mm"
        lines = [f"mesh {path.name}: sound; {size}, {result['area_m2']:.4g} m^2, {edge}"]
        return result, lines + [f"    {text}" for text in [*read.changes, *read.notes]]

    def _scenario(self, name: str) -> tuple[dict[str, Any], list[str]]:
        import equinox as eqx
        import jax
        import jax.numpy as jnp

        from r2s.cli.common import load_card, make_experiment
        from r2s.scenarios import mpm_cloth
        from r2s.scenarios.scenario import rollout
        from r2s.solvers.simulate import predicted_memory

        fabric = load_card(self.fabric or "grey_interlock").fabric
        scenario = make_experiment(name, self.motion).scenario(self.shape)
        points = mpm_cloth(scenario, fabric)

        def loss(fabric):
            return jnp.mean(rollout(scenario, fabric).x ** 2)

        memory = predicted_memory(loss, fabric)
        gradient_memory = predicted_memory(jax.value_and_grad(loss), fabric)
        step = scenario.interval / scenario.substeps
        frames = scenario.num_frames + scenario.lead_in
        result = {
            "frames": frames,
            "step_s": step,
            "steps": (frames - 1) * scenario.substeps,
            "points_step_s": points.dt,
            "memory_bytes": memory,
            "gradient_memory_bytes": gradient_memory,
            "failure": eqx.filter_jit(rollout)(scenario, fabric).explain() or None,
        }
        return result, [
            f"scenario {name}: {result['steps']} steps of {1e3 * step:.1f} ms, "
            f"{memory / 1e6:.1f} MB, with its gradient {gradient_memory / 1e6:.1f} MB",
            f"    on material points: steps of {1e3 * points.dt:.3f} ms",
        ]


def _fabric(
    name: str, fabric: "Fabric", shape: tuple[int, int]
) -> tuple[dict[str, Any], list[str]]:
    """Whether its numbers are plausible, and the error that a mesh leaves in each motion."""
    from r2s.materials.fabric import bending_length
    from r2s.scenarios import resolution
    from r2s.scenarios.standard import SIDE

    wrong, length, sheet = list(implausible(fabric)), float(bending_length(fabric)), (SIDE, SIDE)
    errors = {m: resolution.mesh_error(fabric, sheet, shape, m) for m in resolution.TABLE}
    lines = [
        f"fabric {name}: {'see below' if wrong else 'plausible'}",
        f"    it folds at {1e3 * length:.1f} mm: longer cells cannot follow",
        f"    expected errors of a sheet of {SIDE} m with {shape[0]} x {shape[1]} vertices:",
    ]
    for motion, error in errors.items():
        words = "enough"
        if error > resolution.ENOUGH:
            words = f"too coarse, {resolution.advice(fabric, sheet, shape, motion)}"
        lines.append(f"        {motion}: {1e3 * error:.1f} mm, {words}")
    result = {
        "name": name,
        "implausible": wrong,
        "fold_length_m": length,
        "mesh_error_m": errors,
    }
    return result, lines


def installation() -> tuple[dict[str, Any], list[str], list[str]]:
    """What is installed: as data, in lines, and what is wrong with it."""
    import jax

    versions = {"python": platform.python_version()}
    versions |= {name: _version(name) or "not installed" for name in PACKAGES}
    missing: dict[str, list[str]] = {}
    for requirement in (_version("r2s") and metadata.requires("r2s")) or ():
        match = re.match(r"([\w.-]+).*extra == ['\"]([\w-]+)['\"]", requirement)
        if match and match[2] != "dev":
            lacking = missing.setdefault(match[2], [])
            lacking += [] if _version(match[1]) else [match[1]]
    devices = [f"{each.platform} {each.device_kind}" for each in jax.devices()]
    x64 = bool(jax.config.jax_enable_x64)  # pyright: ignore[reportAttributeAccessIssue]
    lines = [", ".join(f"{name} {version}" for name, version in versions.items())]
    lines.append(f"devices: {', '.join(devices)}; {'double' if x64 else 'single'} precision")
    for extra, lacking in missing.items():
        state = f"lacks {', '.join(lacking)}: pip install 'r2s[{extra}]'" if lacking else "there"
        lines.append(f"extra {extra}: {state}")
    wrong = []
    if jax.__version__ in EXCLUDED:
        wrong.append(f"jax {jax.__version__} ({EXCLUDED[jax.__version__]}): install another one")
    result = {"versions": versions, "devices": devices, "x64": x64, "missing": missing}
    return result, lines, wrong


def _version(package: str) -> str:
    """The version of an installed package; empty where it is not."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def implausible(fabric: "Fabric") -> Iterator[str]:
    """Say which numbers of a fabric are hardly in their units, one line each."""
    import numpy as np

    from r2s.export.stiffness import bending_stiffness, membrane_stiffness

    matrix = membrane_stiffness(fabric)
    numbers = [(name, float(getattr(fabric, name)), limits) for name, limits in PLAUSIBLE.items()]
    for name, value in zip(("C11", "C22", "C33"), np.diag(matrix).tolist(), strict=True):
        numbers.append((name, value, STIFF))
    bending = bending_stiffness(fabric).items()
    numbers += [(f"bending ({name})", value, BENDS) for name, value in bending if value]
    for name, value, (low, high, unit, what) in numbers:
        if not low <= value <= high:
            yield f"{name} is {value:g} {unit}, expected {low:g} to {high:g} ({what})"
    if not np.all(np.linalg.eigvalsh(matrix) > 0):
        yield "the membrane has a negative stiffness: C12^2 must be less than C11 C22"
