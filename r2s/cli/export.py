"""`r2s export`: a fabric for another simulator."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from r2s.cli.common import FabricName, Json, Shape

if TYPE_CHECKING:
    from r2s.export import Loss
    from r2s.materials.fabric import Fabric


@dataclass(frozen=True)
class Export:
    """Write a fabric for another simulator, and say what is lost on the way.

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
        from r2s.cli.common import load_card, mesh_warning, print_result

        card = load_card(self.fabric)
        loss = self._write(card.fabric, card.name)
        result = {
            "fabric": card.name,
            "to": self.to,
            "out": str(self.out),
            "relative_energy_error": {"membrane": loss.membrane, "bending": loss.bending},
            "lost": loss.lost,
        }
        lines = [f"{self.out}: {card.name} for {self.to}"]
        for part in ("membrane", "bending"):
            errors = getattr(loss, part).items()
            if errors:
                lines.append(f"{part}: " + ", ".join(f"{name} {e:+.1%}" for name, e in errors))
        if self.to != "arcsim":
            lines += mesh_warning(self.shape, card.fabric, self.size, "lifting")
        print_result(self.json, result, [*lines, *(f"lost: {text}" for text in loss.lost)])
        return 0

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
        made, loss = newton.cloth(fabric, mesh, kind, yarns=yarns)
        damping = float(fabric.damping)
        rows = newton.spring_arguments(made.springs, damping) if made.springs else []
        model = {"add_cloth_mesh": made.arguments, "add_spring": rows, "fields": made.fields}
        write_json(self.out, model)
        return loss
