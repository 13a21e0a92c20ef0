"""`r2s estimate`: recordings to a fabric card."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from r2s.estimation.descent import Budget
    from r2s.estimation.estimate import Estimate
    from r2s.recordings.recording import Recording


@dataclass(frozen=True)
class EstimateCard:
    """Estimate a fabric from recordings of it, and write its card.

    RECORDING is an NPZ of r2s, a folder of them, or a folder of frames with its manifest; several
    are taken for the same fabric. diffcloud and diffcp take any motion; pinn takes stretchings with
    markers and force. A killed run goes on where it was, from FILE.progress.npz.

        r2s estimate lift.npz --density 0.32 --out denim.json
        r2s estimate warp.npz weft.npz --method pinn --angles 0 90 --density 0.2 --out mine.json
    """

    recordings: Annotated[Positional[tuple[Path, ...]], arg(metavar="RECORDING")]
    """NPZ, or folders."""
    density: Annotated[float, arg(metavar="KG/M^2")]
    """Areal density of the sheet: weigh it."""
    out: Annotated[Path, arg(metavar="FILE")]
    """The card, JSON."""
    method: Literal["diffcloud", "diffcp", "pinn"] = "diffcloud"
    """Through the cloth, through material points (E h and Poisson's ratio), or the network."""
    name: str = ""
    """Of the fabric; by default that of the recording."""
    coarse: int | None = None
    """Places of the range that are tried first (diffcloud 24, diffcp 12)."""
    starts: int | None = None
    """Descents from the best of them (diffcloud 3, diffcp 2)."""
    iterations: int | None = None
    """Gauss-Newton steps of each stage (25)."""
    angles: Annotated[tuple[float, ...], arg(metavar="DEGREES")] = ()
    """pinn: from each pull to the warp; by default 0."""
    shape: tuple[int, int] = (9, 9)
    """Vertices of the simulated sheet."""
    seed: int = 0
    """Of the coarse search or the network."""
    date: str = ""
    """To write on the card; r2s looks at no clock."""
    json: bool = False
    """Print the card as one JSON object."""

    def run(self) -> int:
        from r2s.commands.common import print_result
        from r2s.estimation import cards
        from r2s.estimation.experiment_design import describe
        from r2s.recordings.open import open_recordings

        seen = list(open_recordings(self.recordings))
        if not seen:
            raise ValueError("no recording: name an NPZ, or a folder that holds some")
        found = {"diffcloud": self._cloud, "diffcp": self._points, "pinn": self._network}
        estimate = found[self.method](seen)
        about = cards.Provenance(
            method=f"estimated by r2s: {estimate.approach}",
            source="; ".join(dict.fromkeys(each.info.source for each in seen)),
            recordings=tuple((each.info.name, cards.fingerprint(each)) for each in seen),
            date=self.date,
            assumed=("density", "thickness", "mass_damping"),
        )
        card = cards.Card.make(self.name or seen[0].info.fabric, estimate, about)
        cards.write(self.out, card)
        self._progress_file.unlink(missing_ok=True)
        print_result(
            self.json, cards.as_json(card), [*describe(estimate), f"{self.out}: {card.name}"]
        )
        return 0

    @property
    def _progress_file(self) -> Path:
        return self.out.with_name(f"{self.out.name}.progress.npz")

    def _cloud(self, seen: "Sequence[Recording]") -> "Estimate":
        from r2s.estimation import diffcloud
        from r2s.estimation.descent import DEFAULT
        from r2s.estimation.problem import Problem
        from r2s.fabrics.parameters import OrthotropicSpace

        space = OrthotropicSpace.make(self.density)
        problems = tuple(Problem.make(each, space, shape=self.shape) for each in seen)
        return self._descend(diffcloud.estimate, problems, DEFAULT)

    def _points(self, seen: "Sequence[Recording]") -> "Estimate":
        from r2s.estimation import diffcp
        from r2s.estimation.problem import Problem
        from r2s.fabrics.parameters import IsotropicSpace

        space = IsotropicSpace.make(self.density)
        made = (Problem.make(each, space, shape=self.shape, as_seen=False) for each in seen)
        problems = tuple(diffcp.on_points(each) for each in made)
        return self._descend(diffcp.estimate, problems, diffcp.DEFAULT)

    def _descend(self, estimate: Callable, problems, usual: "Budget") -> "Estimate":
        import jax

        asked = {name: getattr(self, name) for name in ("coarse", "starts", "iterations")}
        with _bar() as progress:
            return estimate(
                problems,
                usual._replace(**{name: n for name, n in asked.items() if n is not None}),
                checkpoint=self._progress_file,
                progress=progress,
                key=jax.random.key(self.seed),
            )

    def _network(self, seen: "Sequence[Recording]") -> "Estimate":
        import math

        import jax

        from r2s.estimation.pinn import from_pulls
        from r2s.estimation.pinn.pulls import pull_from
        from r2s.fabrics.parameters import OrthotropicSpace

        angles = self.angles or (0.0,) * len(seen)
        if len(angles) != len(seen):
            raise ValueError(f"--angles has {len(angles)} numbers, for {len(seen)} pulls")
        pairs = zip(seen, angles, strict=True)
        pulls = [pull_from(each, math.radians(angle)) for each, angle in pairs]
        space = OrthotropicSpace.make(self.density)
        return from_pulls.estimate(pulls, space, key=jax.random.key(self.seed)).estimate


class _bar:
    """A progress bar on stderr, where tqdm is installed."""

    def __enter__(self) -> Callable[[int, float], None] | None:
        try:
            from tqdm import tqdm
        except ImportError:
            self.bar = None
            return None
        self.bar = bar = tqdm(desc="iterations", disable=None)

        def report(iteration: int, loss: float) -> None:
            del iteration
            bar.set_postfix_str(f"{1e3 * loss**0.5:.2f} mm")
            bar.update()

        return report

    def __exit__(self, *_) -> None:
        if self.bar is not None:
            self.bar.close()
