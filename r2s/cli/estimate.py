"""`r2s estimate`: recordings to a fabric card."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from r2s.cli.estimate_report import Outcome
    from r2s.estimation.method import Budget, Method, Progress
    from r2s.materials.parameters import ParameterSpace
    from r2s.recordings.recording import Recording

LIGHTEST, HEAVIEST = 0.005, 5.0  # [kg/m^2]: finer than any gauze, heavier than any carpet
SEARCH = ("num_samples", "num_starts", "max_iterations", "max_evaluations")  # numbers of a search

MethodName = Literal[
    "diffcloud",
    "diffcp",
    "physnet",
    "pinn",
    "cma-es",
    "diffcloud-published",
    "diffcp-published",
    "physnet-published",
    "pinn-published",
]


@dataclass(frozen=True)
class EstimateCard:
    """Estimate a fabric from recordings; writes its card.

    RECORDING is an NPZ of r2s, a folder of them, a folder of frames with its manifest, or a JSON
    file of laboratory tests (docs/guide/laboratory.md); several are taken for the same fabric.
    Of three or more, two of them no stretchings, the last motion with clouds (a fold only where
    there is no other) is held out: the estimate is judged on it, beside fabrics of which only
    the weight is known. Says whether the method converged, and which numbers ended at a bound
    of their range. A killed run of diffcloud, diffcp, physnet or pinn goes on where it was,
    from FILE.progress.npz.

    diffcloud differentiates through the cloth, diffcp through material points, cma-es tries fabrics
    on either. pinn fits a network to the markers and force of stretchings, and takes no other
    motion. physnet compares depth images on the map of a network that was trained for the motion:
    that in the file --network, or one that is trained now (an hour) and written there. Names with
    -published follow the recipes of the papers.

        r2s estimate lift.npz --density 0.32 --out denim.json
        r2s estimate lift.npz wind.npz fling.npz --density 0.32 --out denim.json
        r2s estimate tests.json lift.npz --density 0.32 --out denim.json
        r2s estimate warp.npz bias.npz lift.npz --angles 0 45 --density 0.2 --out mine.json
    """

    recordings: Annotated[Positional[tuple[Path, ...]], arg(metavar="RECORDING")]
    """NPZ, folders, or JSON of laboratory tests."""
    density: Annotated[float, arg(metavar="KG/M^2")]
    """Areal density of the sheet: weigh it."""
    out: Annotated[Path, arg(metavar="FILE")]
    """The card, JSON."""
    method: MethodName = "diffcloud"
    """How to estimate."""
    solver: Literal["cloth", "mpm"] | None = None
    """What simulates: the cloth (orthotropic fabrics) or material points (isotropic ones); by
    default what the method supports."""
    law: Annotated[str | None, arg(metavar="LAW")] = None
    """linear: constant; stiffening: yarns whose stiffness grows with their stretch (three numbers
    more); softening: bending whose stiffness falls with the curvature (two more). By default both
    for diffcloud where the force of a pull was recorded and another motion, and no laboratory test
    is given; else constant."""
    prior: Literal["flat", "fabrics"] | None = None
    """What is assumed beforehand: any place of the ranges alike, or what measured fabrics of this
    weight are like. By default fabrics for diffcloud, unless laboratory tests say what is known;
    flat for what takes no prior."""
    name: str = ""
    """Name of the fabric; by default that of the recording."""
    num_samples: int | None = None
    """Samples of the parameter range that are tried first (diffcloud none, diffcp 12)."""
    num_starts: int | None = None
    """Descents from the best of them, or from the prior mean (diffcloud 1, diffcp 2)."""
    max_iterations: int | None = None
    """Gauss-Newton steps of each stage (25); of pinn and the recipes the epochs."""
    max_evaluations: int | None = None
    """Simulations of a search (cma-es 600, physnet 80)."""
    angles: Annotated[tuple[float, ...], arg(metavar="DEGREES")] = ()
    """From the pull of each stretching to the warp; by default what the recordings say."""
    network: Annotated[Path | None, arg(metavar="FILE")] = None
    """physnet: its trained network; by default that of --out with .network."""
    shape: tuple[int, int] | None = None
    """Vertices of the simulated sheet; by default diffcloud takes 17 along the longer side, or 33
    where the fabric needs them, others take 9 9."""
    finest: bool = False
    """diffcloud: go on to 33 vertices along the longer side, whichever fabric is found: minutes."""
    hold_out: Annotated[str | None, arg(metavar="NAME|none")] = None
    """Recording to judge the estimate by, which is not made from it; none: of all of them."""
    seed: int = 0
    """Seed of the coarse search, or of the network and its search."""
    date: str = ""
    """To write on the card; r2s looks at no clock."""
    force: bool = False
    """Write the card even where the estimate explains none of the recordings."""
    json: bool = False
    """Print the card as one JSON object."""
    plot: Annotated[Path | None, arg(metavar="FILE")] = None
    """A PNG: prior and posterior of each parameter, and the estimated sheet in three frames."""

    def run(self) -> int:
        from r2s._util.files import check_folders
        from r2s._util.threads import one_at_a_time
        from r2s.cli.common import check_picture, print_result
        from r2s.cli.estimate_report import explains_nothing, make_card, report
        from r2s.cli.waiting import Waiting
        from r2s.estimation import cards
        from r2s.estimation.checkpoint import forget

        check_folders(self.out)
        check_picture(self.plot)
        if len(self.recordings) == 1 and self.method == "diffcloud":
            one_at_a_time()
        with Waiting("reading the recordings") as progress:
            outcome = self._estimate(progress)
        if (reason := explains_nothing(outcome)) and not self.force:
            raise RuntimeError(f"{reason}; no card is written without --force")
        card = make_card(outcome, self.name, self.date)
        cards.write(self.out, card)
        forget(self._progress_file)
        if self.plot is not None:
            _draw(self.plot, outcome)
        lines = [*report(outcome), f"wrote {self.out}, the card of {card.name}"]
        print_result(self.json, cards.as_json(card), lines)
        return 0

    def _estimate(self, progress: "Progress") -> "Outcome":
        """Read, estimate, and judge by the recording that is held out."""
        import jax

        from r2s.cli.estimate_report import Outcome
        from r2s.estimation import held_out
        from r2s.laboratory.estimate import estimate, informed
        from r2s.laboratory.files import read_tests
        from r2s.recordings.open import open_recordings

        files = [path for path in self.recordings if path.suffix == ".json"]
        others = [path for path in self.recordings if path not in files]
        recordings = self._set_angles(list(open_recordings(others)))
        laboratory = [read_tests(path) for path in files]
        if not recordings and not laboratory:
            raise ValueError("no recording: name an NPZ, a folder that holds some, or a JSON file")
        method = self._method(progress)
        prior = self._prior(method, bool(laboratory))
        index = held_out.choose(recordings, self.hold_out) if recordings else None
        unseen = None if index is None else recordings.pop(index)
        space = self._space(method, prior, [] if laboratory else recordings)
        tests = [test for each in laboratory for test in each.tests]
        if recordings:
            method.check(recordings)
            if tests:
                method.check_prior()
        else:
            self._check_alone(method)
        by_tests = estimate(tests, space, progress) if tests else None
        if recordings:
            space = informed(space, by_tests) if by_tests else space
            key = jax.random.key(self.seed)
            result = method.estimate(recordings, space, self._budget(method), key=key)
        else:
            assert by_tests is not None
            result = by_tests
        outcome = Outcome(
            method, self.density, prior, space, recordings, laboratory, result, by_tests
        )
        if unseen is not None:
            return outcome.judged_by(unseen, progress)
        if len(recordings) < 2:
            return outcome
        return replace(outcome, why_not_judged=held_out.why_none(recordings, self.hold_out))

    def _check_alone(self, method: "Method") -> None:
        """Raise `ValueError` for options that laboratory tests alone have no use for."""
        numbers = [getattr(self, name) for name in SEARCH]
        others = (self.solver, self.shape, self.hold_out, self.finest or None, *numbers)
        if method.name != "diffcloud" or self.seed or any(each is not None for each in others):
            raise ValueError(
                "laboratory tests alone are fitted by least squares: --method, --solver, --shape, "
                "--finest, --hold-out, --seed and the numbers of a search go with recordings of "
                "motions"
            )

    def _prior(self, method: "Method", has_tests: bool) -> str:
        """The prior: as asked for, or that of measured fabrics where nothing better is known."""
        usual = not has_tests and method.takes_prior and method.chosen_solver == "cloth"
        return self.prior or ("fabrics" if usual else "flat")

    def _space(
        self, method: "Method", prior: str, recordings: "Sequence[Recording]"
    ) -> "ParameterSpace":
        """The parameters with their prior and the law asked for, or that the recordings identify.

        Raises `ValueError` for a density in other units, and what the solver's space lacks.
        """
        from r2s.estimation.default_spaces import identified_law, with_law
        from r2s.estimation.method import default_space
        from r2s.materials.prior import informed

        if not LIGHTEST <= self.density <= HEAVIEST:
            raise ValueError(
                f"--density is in kg/m^2, got {self.density:g}: fabrics have {LIGHTEST} to "
                f"{HEAVIEST:g} (100 g/m^2 are 0.1 kg/m^2)"
            )
        law = self.law or (identified_law(recordings) if method.name == "diffcloud" else "linear")
        if method.chosen_solver != "cloth" and (law != "linear" or prior != "flat"):
            raise ValueError("--law and --prior are of the cloth: material points have their own")
        if law != "linear" and method.name == "diffcloud-published":
            raise ValueError(
                "--law: the two multipliers of diffcloud-published are of constant ones"
            )
        space = with_law(default_space(method.chosen_solver, self.density), law)
        return space if prior == "flat" else informed(space, self.density)

    def _set_angles(self, recordings: "list[Recording]") -> "list[Recording]":
        """The recordings, the stretchings among them at the angles asked for."""
        pulls = [i for i, each in enumerate(recordings) if each.info.scenario == "stretching"]
        if not self.angles:
            return recordings
        if len(self.angles) != len(pulls):
            raise ValueError(
                f"--angles: got {len(self.angles)} for {len(pulls)} stretchings: give one for each"
            )
        for i, angle in zip(pulls, self.angles, strict=True):
            info = replace(recordings[i].info, angle=angle)
            recordings[i] = replace(recordings[i], info=info)
        return recordings

    @property
    def _progress_file(self) -> Path:
        return self.out.with_name(f"{self.out.name}.progress.npz")

    def _method(self, progress: "Progress | None") -> "Method":
        """The method with the options asked for; `ValueError` for one that it lacks."""
        from r2s.estimation.methods import METHODS

        kind = METHODS[self.method]
        known = kind.options()
        own: dict[str, Any] = {"network": self.network, "finest": self.finest}
        for name, value in own.items():
            if value and name not in known:
                raise ValueError(f"--{name} is not of {self.method}")
        if self.shape is not None and not kind.takes_shape:
            raise ValueError(f"--shape is not of {self.method}: its sheet is its own")
        own["network"] = self.network or self.out.with_name(f"{self.out.name}.network")
        return kind(
            solver=self.solver,
            shape=self.shape,
            checkpoint=self._progress_file,
            progress=progress,
            **{name: value for name, value in own.items() if name in known},
        )

    def _budget(self, method: "Method") -> "Budget":
        """The method's budget with the numbers asked for; `ValueError` for one that it lacks."""
        asked = {name: getattr(self, name) for name in SEARCH if getattr(self, name) is not None}
        for name, number in asked.items():
            option, least = f"--{name}".replace("_", "-"), 0 if name == "num_samples" else 1
            if name not in method.budget_fields:
                takes = ", ".join(f"--{each}" for each in method.budget_fields).replace("_", "-")
                raise ValueError(f"{option} is not of {method.name}: it takes {takes}")
            if number < least:
                raise ValueError(f"{option} must be at least {least}, got {number}")
        return method.budget._replace(**asked)


def _draw(path: Path, outcome: "Outcome") -> None:
    """Draw an outcome, with the motion of its first recording that is no stretching."""
    import numpy as np

    from r2s.estimation import held_out
    from r2s.estimation.method import COARSEST
    from r2s.metrics.prediction_error import predict_motion
    from r2s.recordings.open import SimulatedCloth
    from r2s.scenarios.resolution import matching_shape
    from r2s.viewer.comparison import draw_estimate

    estimate, recordings = outcome.estimate, outcome.recordings
    if not recordings:
        draw_estimate(path, estimate, outcome.space)
        return
    first = min(recordings, key=lambda each: each.info.scenario == "stretching")
    shape = matching_shape(estimate.shape or COARSEST, first.info.sheet.size)
    air = held_out.air_found(estimate, recordings)
    scenario = held_out.in_steps(first, shape, air)
    x = predict_motion(scenario, estimate.fabric).x
    sheet = SimulatedCloth(x, np.asarray(scenario.scene.mesh.faces))
    draw_estimate(path, estimate, outcome.space, first, sheet)
