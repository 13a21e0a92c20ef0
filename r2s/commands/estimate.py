"""`r2s estimate`: recordings to a fabric card."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from r2s.estimation.estimate import Estimate
    from r2s.estimation.method import Budget, Method, Progress
    from r2s.fabrics.parameters import ParameterSpace
    from r2s.laboratory.estimate import Test
    from r2s.laboratory.files import LaboratoryTests
    from r2s.recordings.recording import Recording

POOR = 0.5  # of a recording that is left out, above which it is hardly explained at all
LIGHTEST, HEAVIEST = 0.005, 5.0  # [kg/m^2]: finer than any gauze, heavier than any carpet
CONTRADICTION = 0.01  # likelihood by chance, below which it is told

# what is wrong where a nuisance is far from what was written down
BENT_BY = {
    "density": "the density",
    "air": "the wind, or the density, which the wind weighs it against,",
    "size": "the size of the sheet, or the scale of the clouds,",
    "shift x": "the cameras' or the grippers' place",
    "shift y": "the cameras' or the grippers' place",
    "shift z": "the cameras' or the grippers' place, or the table's height,",
    "turn": "the cameras' direction",
    "time": "the cameras' clock",
}

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
    """Estimate a fabric from recordings of it, and write its card.

    RECORDING is an NPZ of r2s, a folder of them, a folder of frames with its manifest, or a JSON
    file of laboratory tests (pulls, cantilevers, drapes: docs/laboratory.md); several are taken for
    the same fabric. Of three or more, two of them no stretchings, the last motion with clouds (a
    fold only where there is no other) is held out: the estimate is judged on it, beside fabrics of
    which only the weight is known. Says whether the method converged, and which numbers ended at a
    bound of their range. A killed run of diffcloud, diffcp, physnet or pinn goes on where it was,
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
    solver: Literal["cloth", "points"] | None = None
    """What simulates: the cloth (orthotropic fabrics) or material points (isotropic ones); by
    default what the method supports."""
    law: Literal["linear", "stiffening", "softening", "stiffening+softening"] | None = None
    """Constant stiffness; stiffening: yarns whose stiffness grows with their stretch (three numbers
    more); softening: bending whose stiffness falls with the curvature (two more). By default both
    for diffcloud where the force of a pull was recorded and another motion, and no laboratory test
    is given; else constant."""
    prior: Literal["flat", "fabrics"] | None = None
    """What is assumed beforehand: any place of the ranges alike, or what measured fabrics of this
    weight are like. By default fabrics for diffcloud, unless laboratory tests say what is known;
    flat for what takes no prior."""
    name: str = ""
    """Name of the fabric; by default that of the recording."""
    coarse: int | None = None
    """Places of the range that are tried first (diffcloud none, diffcp 12)."""
    starts: int | None = None
    """Descents from the best of them, or from the prior mean (diffcloud 1, diffcp 2)."""
    iterations: int | None = None
    """Gauss-Newton steps of each stage (25); of pinn and the recipes the epochs."""
    evaluations: int | None = None
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
    json: bool = False
    """Print the card as one JSON object."""

    def run(self) -> int:
        import jax

        from r2s.commands.common import print_result
        from r2s.commands.waiting import Waiting
        from r2s.estimation import cards, held_out
        from r2s.estimation.checkpoint import forget
        from r2s.estimation.estimate import describe
        from r2s.estimation.method import COARSEST, tell
        from r2s.files import check_folders
        from r2s.laboratory.estimate import estimate, informed
        from r2s.laboratory.files import read_tests
        from r2s.laboratory.pull import Pull
        from r2s.recordings.open import open_recordings
        from r2s.scenarios.resolution import alike

        check_folders(self.out)
        files = [path for path in self.recordings if path.suffix == ".json"]
        opened = open_recordings([path for path in self.recordings if path not in files])
        seen = self._turned(list(opened))
        known = [read_tests(path) for path in files]
        if not seen and not known:
            raise ValueError("no recording: name an NPZ, a folder that holds some, or a JSON file")
        with Waiting("reading the recordings") as progress:
            method = self._method(progress)
            prior = self._prior(method, not known)
            unseen = self._hold_out(seen) if seen else []
            space = self._space(method, prior, [] if known else seen)
            tests = [test for each in known for test in each.tests]
            if seen:
                method.check(seen)
                if tests:
                    method.check_prior()
            else:
                self._check_alone(method)
            told = estimate(tests, space, progress) if tests else None
            if seen:
                space = informed(space, told) if told else space
                found = method.estimate(
                    seen, space, self._budget(method), key=jax.random.key(self.seed)
                )
            else:
                assert told is not None
                found = told
            judged = []
            for each in unseen:
                tell(progress, f"judging by {each.info.name}")
                shape = alike(found.shape or COARSEST, each.info.sheet.size)
                air = held_out.air_found(found, seen)
                told_by = held_out.judge(each, found.fabric, shape, air=air)
                line = told_by.describe()
                judged.append(line if method.chosen_solver == "cloth" else f"{line} (by the cloth)")
        sources = [each.info.source for each in seen] + [each.source for each in known]
        provenance = cards.Provenance(
            method="; ".join(
                [f"estimated by r2s: {_approach(found.approach, known, prior)}", *judged]
            ),
            source="; ".join(dict.fromkeys(source for source in sources if source)),
            recordings=(
                *((each.info.name, cards.fingerprint(each)) for each in seen),
                *((each.name, each.fingerprint) for each in known),
            ),
            date=self.date,
            assumed=_assumed([each.name for each in found.ranges]),
        )
        name = self.name or (seen[0].info.fabric if seen else known[0].name)
        card = cards.Card.make(name, found, provenance)
        cards.write(self.out, card)
        forget(self._progress_file)
        weighing = _by_weight(method, self.density, seen)
        lines = [
            *describe(found),
            *_unread(method, seen),
            *([] if any(isinstance(test, Pull) for test in tests) else weighing),
            *_warnings(found, seen),
            *_laboratory_lines(tests, told, found),
            *(judged or self._unjudged(seen)),
            f"{self.out}: {card.name}",
        ]
        print_result(self.json, cards.as_json(card), lines)
        return 0

    def _check_alone(self, method: "Method") -> None:
        """Raise `ValueError` for what laboratory tests alone have no use for."""
        numbers = (self.coarse, self.starts, self.iterations, self.evaluations)
        others = (self.solver, self.shape, self.hold_out, self.finest or None, *numbers)
        if method.name != "diffcloud" or self.seed or any(each is not None for each in others):
            raise ValueError(
                "laboratory tests alone are fitted by least squares: --method, --solver, --shape, "
                "--finest, --hold-out, --seed and the numbers of a search go with recordings of "
                "motions"
            )

    def _prior(self, method: "Method", is_alone: bool) -> str:
        """What is assumed beforehand; `is_alone`: whether there are no laboratory tests."""
        usual = is_alone and method.takes_prior and method.chosen_solver == "cloth"
        return self.prior or ("fabrics" if usual else "flat")

    def _space(self, method: "Method", told: str, seen: "Sequence[Recording]") -> "ParameterSpace":
        """The fabrics to choose from, of which `told` is assumed beforehand, with the law that was
        asked for or that the recordings tell; `ValueError` for one that the solver's space
        lacks."""
        from r2s.estimation.default_spaces import law_told_by, with_law
        from r2s.estimation.method import default_space
        from r2s.fabrics import prior

        if self.density > 0 and not LIGHTEST <= self.density <= HEAVIEST:
            raise ValueError(
                f"--density is in kg/m^2, got {self.density:g}: fabrics have {LIGHTEST} to "
                f"{HEAVIEST:g} (100 g/m^2 are 0.1 kg/m^2)"
            )
        space = default_space(method.chosen_solver, self.density)
        law = self.law or (law_told_by(seen) if method.name == "diffcloud" else "linear")
        asked = law != "linear" or told != "flat"
        if asked and method.chosen_solver != "cloth":
            raise ValueError("--law and --prior are of the cloth: material points have their own")
        if law != "linear" and method.name == "diffcloud-published":
            raise ValueError(
                "--law: the two multipliers of diffcloud-published are of constant ones"
            )
        space = with_law(space, law)
        return space if told == "flat" else prior.informed(space, self.density)

    def _hold_out(self, seen: "list[Recording]") -> "list[Recording]":
        """Take what is to be held out from the recordings, and return it: one, or none."""
        from r2s.estimation import held_out

        index = held_out.choose(seen, self.hold_out)
        return [] if index is None else [seen.pop(index)]

    def _unjudged(self, seen: "list[Recording]") -> list[str]:
        """Why none of several recordings tells whether the estimate is better than knowing
        nothing."""
        from r2s.estimation import held_out

        if len(seen) < 2:
            return []
        return [f"not judged by another recording: {held_out.why_none(seen, self.hold_out)}"]

    def _turned(self, seen: "list[Recording]") -> "list[Recording]":
        """The recordings, of which the stretchings are at the angles that were asked for."""
        from dataclasses import replace

        pulls = [i for i, each in enumerate(seen) if each.info.scenario == "stretching"]
        if not self.angles:
            return seen
        if len(self.angles) != len(pulls):
            raise ValueError(
                f"--angles: got {len(self.angles)} for {len(pulls)} stretchings: give one for each"
            )
        for i, angle in zip(pulls, self.angles, strict=True):
            seen[i] = replace(seen[i], info=replace(seen[i].info, angle=angle))
        return seen

    @property
    def _progress_file(self) -> Path:
        return self.out.with_name(f"{self.out.name}.progress.npz")

    def _method(self, progress: "Progress | None") -> "Method":
        """The method with the fields that were asked for; `ValueError` for one that it lacks."""
        from r2s.estimation.registry import METHODS

        kind = METHODS[self.method]
        known = kind.options()
        own: dict[str, Any] = {"network": self.network, "finest": self.finest}
        for name, value in own.items():
            if value and name not in known:
                raise ValueError(f"--{name} is not of {self.method}")
        if self.shape is not None and not kind.takes_shape:
            raise ValueError(f"--shape is not of {self.method}: its sheet is its own")
        if self.network is None:
            own["network"] = self.out.with_name(f"{self.out.name}.network")
        return kind(
            solver=self.solver,
            shape=self.shape,
            checkpoint=self._progress_file,
            progress=progress,
            **{name: value for name, value in own.items() if name in known},
        )

    def _budget(self, method: "Method") -> "Budget":
        """The usual budget with the numbers that were asked for."""
        names = ("coarse", "starts", "iterations", "evaluations")
        asked = {name: getattr(self, name) for name in names}
        asked = {name: value for name, value in asked.items() if value is not None}
        for name in asked:
            if name not in method.heeds:
                takes = ", ".join(f"--{each}" for each in method.heeds)
                raise ValueError(f"--{name} is not of {method.name}: it takes {takes}")
        return method.budget._replace(**asked)


def _warnings(estimate: "Estimate", recordings: "Sequence[Recording]") -> list[str]:
    """How recordings count and whether they agree; what does not fit; where the mesh of the
    estimate is too coarse for the fabric that came out."""
    from r2s.commands.common import mesh_warning
    from r2s.scenarios.resolution import alike

    motions = dict.fromkeys((each.info.sheet.size, each.info.scenario) for each in recordings)
    fabric, shape, coarse = estimate.fabric, estimate.shape, []
    for size, scenario in motions:
        coarse += mesh_warning(alike(shape, size), fabric, size, scenario) if shape else []
    agreed = _agreement(estimate, recordings, bool(coarse))
    if estimate.refused:
        coarse.append(f"warning: estimated on a coarser mesh than {estimate.refused}")
    return [*agreed, *_misfits(estimate, recordings), *coarse]


def _assumed(estimated: "Sequence[str]") -> tuple[str, ...]:
    """The numbers and laws of a fabric that were neither weighed nor estimated, by the names of
    those that were."""
    parts = {
        "membrane": {"warp", "E h"},
        "bending": {"bending"},
        "damping": {"damping"},
        "friction": {"friction"},
        "thickness": {"thickness"},
        "mass_damping": {"mass damping"},
    }
    return tuple(name for name, told in parts.items() if not told & {*estimated})


def _approach(approach: str, known: "Sequence[LaboratoryTests]", prior: str) -> str:
    """What it was estimated with, in words."""
    from r2s.laboratory.estimate import APPROACH

    if known and approach != APPROACH:
        approach = f"{approach}, after {APPROACH}"
    if prior == "flat":
        return approach
    return f"{approach}, with the prior of measured fabrics of its weight"


def _laboratory_lines(
    tests: "Sequence[Test]", told: "Estimate | None", found: "Estimate"
) -> list[str]:
    """How the estimate fits laboratory tests, and whether motions contradict them."""
    from r2s.laboratory.estimate import POOR_FIT, apart, fits

    if told is None:
        return []
    lines = []
    for name, errors, words in fits(tests, found.fabric):
        lines.append(f"{name}: {words}")
        if errors > POOR_FIT:
            lines.append(
                f"warning: {name}: {errors:.1f} standard deviations off: another fabric, other "
                "units, or a law that cannot follow it (try --law stiffening)"
            )
    p = apart(told, found)
    if p < CONTRADICTION:
        lines.append(
            f"warning: the recordings contradict the laboratory tests (by chance {p:.1g}): another "
            "fabric, or its density, scale or path are not as written down"
        )
    return lines


def _misfits(estimate: "Estimate", recordings: "Sequence[Recording]") -> list[str]:
    """What of the recordings does not fit the fabric, and how much of them is left out."""
    from r2s.estimation.misfits import FORCE

    names = [each.info.name for each in recordings]
    lines = []
    if not estimate.left_out:
        lines.append("not judged: what of the recordings does not fit")
    for misfit in estimate.misfits:
        name = names[misfit.recording]
        if misfit.unit == "m":
            lines.append(
                f"warning: {name}: {misfit.what} is {1e3 * misfit.off:.0f} mm from its place on "
                "the sheet, far more than the others: on another cloth, or its place is wrong"
            )
        elif misfit.what == FORCE:
            lines.append(
                f"warning: {name}: the force of this sheet is off by {100 * misfit.off:.0f} % of "
                "what was recorded: its density [kg/m^2], or the unit of the force [N], may be off"
            )
        else:
            lines.append(
                f"warning: {name}: {misfit.what} is {misfit.off:.1f} {misfit.unit} from what was "
                f"written down: {BENT_BY[misfit.what]} may be off"
            )
    for name, share in zip(names, estimate.left_out, strict=False):
        told = f"left out of {name}: {100 * share:.1f} % as outliers"
        poor = (
            f"warning: {told}: its density, wind, path or scale may not be as written down, or the "
            "mesh is too coarse"
        )
        lines.append(poor if share > POOR else told)
    return lines


def _unread(method: "Method", recordings: "Sequence[Recording]") -> list[str]:
    """What of the recordings the method has not read."""
    from r2s.recordings.recording import clouds_are_markers

    lines = []
    for each in recordings:
        reads = method.reads(each)
        has_clouds = each.mask.any() and not clouds_are_markers(each)
        kinds = {
            "clouds": has_clouds and reads.points == 0,
            "markers": each.markers is not None and not reads.markers,
            "force": each.force is not None and not reads.force,
        }
        left = [kind for kind, is_left in kinds.items() if is_left]
        most = int(each.mask.sum(axis=1).max())
        if has_clouds and reads.points and reads.points < most:
            left.append(f"all but {reads.points} points a frame, drawn at random, of up to {most}")
        first, last = each.info.frames_used
        if len(reads.frames) < last - first + 1:
            left.append(f"{last - first + 1 - len(reads.frames)} of {last - first + 1} frames")
        if left:
            lines.append(f"not read of {each.info.name}: {', '.join(left)}")
    return lines


def _by_weight(method: "Method", density: float, recordings: "Sequence[Recording]") -> list[str]:
    """What no recording weighs: without a force that is read, the wind's or a pull's, stiffness
    scales with the density that was given."""
    weighed = [method.reads(each).force or any(each.info.wind or ()) for each in recordings]
    if any(weighed) or not recordings:
        return []
    return [
        f"stiffness is that of a sheet of {density:g} kg/m^2, in proportion: no force of a pull "
        "and no wind tells whether that is right"
    ]


def _agreement(
    estimate: "Estimate", recordings: "Sequence[Recording]", is_coarse: bool = False
) -> list[str]:
    """How much each of several recordings counts, and which contradicts the others, if one does;
    `is_coarse`: on a mesh that is too coarse for the fabric."""
    names = [each.info.name for each in recordings]
    if len(names) < 2:
        return []
    shares = [f"{n} {share:.2g}" for n, share in zip(names, estimate.shares, strict=False)]
    lines = [f"shares in the loss: {', '.join(shares)}"] if shares else []
    found = estimate.agreement
    if found is None:
        return [*lines, "not judged: whether the recordings agree"]
    if found.density is not None and found.doubts_density:
        lines.append(
            f"warning: the recordings would agree on about {found.density[0]:.1g} times the "
            "density that was given: weigh the sheet again, in kg/m^2"
        )
    odd = found.contradiction
    if odd is None and found.doubts_density:
        return lines
    if odd is None:
        alone = [name for name, told in zip(names, found.told, strict=True) if not told]
        little = "; too little beyond the prior and the mesh's error is told to compare"
        left = f"{little} {', '.join(alone)}" if alone else ""
        words = f"the recordings agree (by chance {found.p:.2g}){left}"
        if found.is_excused:
            words = (
                "the recordings agree only as far as their meshes may err (by chance "
                f"{found.p:.2g}, without that {found.exact:.1g}), so a fabric a few times as stiff "
                f"in one of them would not be told{left}"
            )
        return [*lines, words]
    unit = next(each.unit for each in estimate.ranges if each.name == odd.parameter)
    own, others = (f"{value:.4g} {unit}".removesuffix(" -") for value in odd.values)
    against = "the others" if len(names) > 2 else names[1 - odd.recording]
    return [
        *lines,
        f"warning: {names[odd.recording]} contradicts {against} (by chance {found.p:.1g}; "
        f"{odd.parameter} {own} by it, {others} by {against}, {odd.errors:.1f} standard "
        "errors apart): another fabric, or the density, scale, path or markers are not as written "
        "down (a pull's force tells stiffness, other motions stiffness over density), or a law "
        f"that cannot follow all of them (see --law){', or the mesh, see below' * is_coarse}",
    ]
