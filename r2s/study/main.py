"""A study from its settings to its report: what `experiments/study.py` and `r2s study` call."""

from collections.abc import Sequence
from pathlib import Path

from r2s.study import engine, matrix, results, verdicts
from r2s.study.mujoco_recording import FABRIC
from r2s.study.mujoco_sheet import mujoco_module
from r2s.study.subprocesses import OneProcess


def study(
    preset: str = "one_fabric",
    data: Path | None = None,
    out: Path = Path("results"),
    *,
    paper: Path | None = None,
    density: float = 0.15,
    materials: str = "",
    configurations: Sequence[str] | None = None,
    fabrics: Sequence[str] | None = None,
    repeats: int | None = None,
    judged: int | None = None,
    seed: int = 0,
    workers: int = 1,
    scheduler: str = "",
    slurm: int = 0,
    compilation_cache: Path | None = None,
) -> int:
    """Make all cells that are not there, write results and report, and return how many are missing.

    - `preset`: in `matrix.PRESETS`. `configurations` (such as "diffcloud-cloth-lifting"),
      `fabrics`, `repeats`, `judged` and `seed` change it, see `matrix.Plan`.
    - `data`: a folder of recordings, of an areal `density` [kg/m^2]; None: synthetic ones.
    - `paper`: a folder with the tables of Ru et al. 2025.
    - `materials`: a folder of measured tables, see `sources.TruthSettings`.
    - `workers`: processes of this machine (one: cell after cell); or `slurm` jobs; or those of a
      Dask `scheduler`. `compilation_cache`: where workers keep compiled programs.

    Raises `ValueError` for settings that make no sense, `OSError`, and `ImportError` that names the
    extra for workers.
    """
    if preset not in matrix.PRESETS:
        raise ValueError(f"no preset {preset!r}; there are {', '.join(matrix.PRESETS)}")
    plan = matrix.with_changes(
        matrix.PRESETS[preset], configurations, fabrics, repeats, judged, materials, seed
    )
    if data is None and FABRIC in plan.fabrics:
        _has_mujoco()
    cells = matrix.synthetic(plan) if data is None else matrix.recorded(data, density, plan)
    runner = _runner(workers, scheduler, slurm, compilation_cache)
    try:
        failed = engine.run([*verdicts.ensembles(cells), *cells], out, runner)
    finally:
        runner.close()
    results.publish(cells, failed, out, plan, str(data or "synthetic"), paper)
    return len(failed)


def _has_mujoco() -> None:
    """Raise before anything is made when MuJoCo is not there."""
    try:
        mujoco_module()
    except ImportError as error:
        raise ImportError(f"{error}, or leave {FABRIC} out of --fabrics") from error


def _runner(workers: int, scheduler: str, slurm: int, cache: Path | None) -> engine.Runner:
    if not (workers > 1 or scheduler or slurm):
        return OneProcess()
    from r2s.study import cluster

    if scheduler:
        return cluster.at(scheduler)
    return cluster.slurm(slurm) if slurm else cluster.local(workers, cache)
