"""`r2s study`: every approach from every scenario, judged on motions never seen."""

from contextlib import AbstractContextManager, closing
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import UseAppendAction, arg


@dataclass(frozen=True)
class Study:
    """Compare several approaches on unseen motions.

    Estimates fabrics by each, evaluates the estimates, and writes a report.

    Results that are there already are not made again: interrupted, the same command goes on. The
    preset "one_fabric" takes about 45 minutes on two cores; "paper" and "full" are for a cluster.

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
        tuple[tuple[str, ...], ...],
        arg(
            name="configuration",
            aliases=("--configurations", "--column", "--columns"),
            metavar="CONFIGURATION ...",
        ),
        UseAppendAction,
    ] = ()
    """Such as diffcloud-cloth-lifting, instead of the preset's; one or several."""
    fabrics: Annotated[
        tuple[tuple[str, ...], ...],
        arg(name="fabric", aliases=("--fabrics",), metavar="PRESET ..."),
        UseAppendAction,
    ] = ()
    """Instead of the preset's; one or several."""
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
        """Make all cells that are missing, and write results and report.

        Raises `ValueError` for settings that make no sense and when cells are missing at the end,
        `OSError`, and `ImportError` that names the extra for workers.
        """
        from r2s.study import engine, report
        from r2s.study import plan as plans
        from r2s.study.ensembles import ensembles

        if self.workers < 1 or self.slurm < 0:
            raise ValueError(
                f"--workers must be at least 1 and --slurm at least 0, got {self.workers} and "
                f"{self.slurm}"
            )
        plan = plans.with_changes(
            plans.PRESETS[self.preset],
            list(chain(*self.configurations)),
            list(chain(*self.fabrics)),
            self.repeats,
            self.judged,
            self.materials,
            self.seed,
        )
        if self.data is None:
            cells = plans.synthetic(plan)
        else:
            cells = plans.recorded(self.data, self.density, plan)
        plans.check_simulators(cells)
        with self._runner() as runner:
            failed = engine.run([*ensembles(cells), *cells], self.out, runner)
        source = str(self.data or "synthetic")
        report.publish_study(cells, failed, self.out, plan, source, self.paper)
        if failed:
            raise ValueError(
                f"{len(failed)} cells are missing: {self.out / 'report.html'} says why"
            )
        return 0

    def _runner(self) -> AbstractContextManager:
        """One process, or workers of this machine, of Slurm or of a scheduler."""
        from r2s.study import engine

        if self.scheduler:
            return closing(engine.at(self.scheduler))
        if self.slurm:
            return closing(engine.slurm(self.slurm))
        if self.workers > 1:
            return closing(engine.local(self.workers, self.compilation_cache))
        return closing(engine.OneProcess())
