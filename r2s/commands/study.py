"""`r2s study`: every approach from every scenario, judged on motions never seen."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import UseAppendAction, arg


@dataclass(frozen=True)
class Study:
    """Estimate fabrics by several approaches, judge them on unseen motions, and write a report.

    Results that are there already are not made again: interrupted, the same command goes on. The
    preset "one_fabric" takes about 20 minutes on two cores; "paper" and "full" are for a cluster.

        r2s study --out results --workers 2
        r2s study --data recordings --density 0.2 --out results
        r2s study --preset paper --configuration diffcloud-cloth-lifting --slurm 16 --out paper
    """

    out: Annotated[Path, arg(metavar="FOLDER")]
    """Where report, tables, pictures and cells go."""
    preset: Literal["one_fabric", "three_fabrics", "paper", "full"] = "one_fabric"
    """Which configurations and fabrics, and how many motions."""
    data: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Recordings with their manifest; synthetic ones without."""
    density: float = 0.15
    """Areal, of the fabrics in --data [kg/m^2]."""
    paper: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """The tables of Ru et al. 2025, to set beside ours."""
    materials: Annotated[str, arg(metavar="FOLDER")] = ""
    """Measured tables to make recordings with, FABRIC.json (ARCSim)."""
    configurations: Annotated[
        tuple[str, ...],
        arg(name="configuration", aliases=("--column",), metavar="CONFIGURATION"),
        UseAppendAction,
    ] = ()
    """Such as diffcloud-cloth-lifting, instead of the preset's; may be given several times."""
    fabrics: Annotated[tuple[str, ...], arg(name="fabric", metavar="PRESET"), UseAppendAction] = ()
    """Instead of the preset's; may be given several times."""
    repeats: int | None = None
    """Estimates of each fabric."""
    judged: int | None = None
    """Motions to judge by, of each scenario."""
    seed: int = 0
    """Seed of all that is drawn."""
    workers: int = 1
    """Processes on this machine (more than one: extra cluster)."""
    slurm: int = 0
    """Jobs of a Slurm cluster."""
    scheduler: str = ""
    """Address of a Dask scheduler, such as tcp://node:8786."""
    compilation_cache: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Where workers keep compiled programs; by default the user's cache folder."""

    def run(self) -> int:
        from r2s.study.main import study

        missing = study(**vars(self))
        if missing:
            raise ValueError(f"{missing} cells are missing: {self.out / 'report.html'} says why")
        return 0
