"""What `r2s estimate` writes of its result: the card, and lines for people."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from r2s.cli.common import mesh_warning
from r2s.estimation import held_out
from r2s.estimation.cards import Card, Provenance, fingerprint
from r2s.estimation.consistency import FORCE
from r2s.estimation.estimate import Agreement, Estimate, Misfit
from r2s.estimation.method import COARSEST, Method, Progress, tell
from r2s.estimation.summary import describe
from r2s.laboratory.estimate import APPROACH, POOR_FIT, consistency, fits
from r2s.laboratory.files import LaboratoryTests
from r2s.laboratory.pull import Pull
from r2s.materials.parameters import ParameterSpace
from r2s.recordings.recording import Recording, clouds_are_markers
from r2s.scenarios.resolution import matching_shape

POOR = 0.5  # share of outliers, above which a recording is hardly explained at all
NOTHING = 0.9  # share of outliers, above which nothing is explained
CONTRADICTION = 0.01  # p-value below which motions contradict laboratory tests
PARTS = {  # of a fabric: names of the parameters that estimate them
    "membrane": {"warp", "E h"},
    "bending": {"bending"},
    "damping": {"damping"},
    "friction": {"friction"},
    "thickness": {"thickness"},
    "mass_damping": {"mass damping"},
}
CAUSES = {  # of a nuisance far from its nominal value
    "density": "the density",
    "air": "the wind, or the density, which the wind weighs it against,",
    "size": "the size of the sheet, or the scale of the clouds,",
    "shift x": "the cameras' or the grippers' place",
    "shift y": "the cameras' or the grippers' place",
    "shift z": "the cameras' or the grippers' place, or the table's height,",
    "turn": "the cameras' direction",
    "time": "the cameras' clock",
}


@dataclass(frozen=True)
class Outcome:
    """What was estimated, and from what.

    - `density`: as given, [kg/m^2]. `prior`: "flat" or "fabrics". `space`: the parameters, with
      what was known before the recordings.
    - `estimate`; `by_tests`: by the laboratory tests alone, None without tests.
    - `judged`: what the recording that was held out says of the estimate; or, of several
      recordings, `why_not_judged`.
    """

    method: Method
    density: float
    prior: str
    space: ParameterSpace
    recordings: Sequence[Recording]
    laboratory: Sequence[LaboratoryTests]
    estimate: Estimate
    by_tests: Estimate | None
    judged: str = ""
    why_not_judged: str = ""

    def judged_by(self, recording: Recording, progress: Progress | None) -> "Outcome":
        """With what a recording that was held out says of the estimate."""
        tell(progress, f"judging by {recording.info.name}")
        estimate = self.estimate
        shape = matching_shape(estimate.shape or COARSEST, recording.info.sheet.size)
        air = held_out.air_found(estimate, self.recordings)
        line = held_out.judge(recording, estimate.fabric, shape, air=air).describe()
        by_cloth = "" if self.method.chosen_solver == "cloth" else " (by the cloth)"
        return replace(self, judged=line + by_cloth)


def make_card(outcome: Outcome, name: str = "", date: str = "") -> Card:
    """The card of the estimated fabric; `name`: by default that of the first recording."""
    recordings, laboratory = outcome.recordings, outcome.laboratory
    sources = [each.info.source for each in recordings] + [each.source for each in laboratory]
    method = f"estimated by r2s: {approach(outcome)}"
    provenance = Provenance(
        method=f"{method}; {outcome.judged}" if outcome.judged else method,
        source="; ".join(dict.fromkeys(source for source in sources if source)),
        recordings=(
            *((each.info.name, fingerprint(each)) for each in recordings),
            *((each.name, each.fingerprint) for each in laboratory),
        ),
        date=date,
        assumed=assumed({each.name for each in outcome.estimate.ranges}),
    )
    name = name or (recordings[0].info.fabric if recordings else laboratory[0].name)
    return Card.make(name, outcome.estimate, provenance)


def approach(outcome: Outcome) -> str:
    """The method in words, with laboratory tests and prior."""
    words = outcome.estimate.approach
    if outcome.laboratory and words != APPROACH:
        words += f", after {APPROACH}"
    known = ", with the prior of measured fabrics of its weight"
    return words if outcome.prior == "flat" else words + known


def assumed(estimated: set[str]) -> tuple[str, ...]:
    """The parts of a fabric that are neither weighed nor among the parameters `estimated`."""
    return tuple(part for part, names in PARTS.items() if not names & estimated)


def report(outcome: Outcome) -> list[str]:
    """All lines on an outcome."""
    estimate, recordings = outcome.estimate, outcome.recordings
    coarse = _coarse(estimate, recordings)
    lines = [
        *describe(estimate),
        *unread(outcome.method, recordings),
        *_weighed(outcome),
        *agreement(estimate, recordings, bool(coarse)),
        *misfits(estimate, recordings),
        *coarse,
    ]
    if estimate.refused:
        lines.append(f"warning: estimated on a coarser mesh than {estimate.refused}")
    lines += _laboratory(outcome)
    if outcome.judged:
        lines.append(outcome.judged)
    if outcome.why_not_judged:
        lines.append(f"not judged by another recording: {outcome.why_not_judged}")
    return lines


def explains_nothing(outcome: Outcome) -> str:
    """Why an estimate is a failure: nearly all of every recording is outliers; else ""."""
    shares = [fit.outliers for fit in outcome.estimate.fits]
    if not shares or min(shares) < NOTHING:
        return ""
    return (
        f"the estimate explains nothing: at least {100 * min(shares):.0f} % of the points of every "
        "recording are outliers. Are the clouds in metres, with z up, and do scale, rotation, "
        "translation and path of the manifest place them on the sheet? See r2s check and r2s show"
    )


def unread(method: Method, recordings: Sequence[Recording]) -> Iterator[str]:
    """What of each recording the method does not read."""
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
            left.append(
                f"points beyond {reads.points} a frame, drawn at random (up to {most} are there)"
            )
        first, last = each.info.frames_used
        if len(reads.frames) < last - first + 1:
            left.append(f"{last - first + 1 - len(reads.frames)} of {last - first + 1} frames")
        if left:
            yield f"not used of {each.info.name}: {', '.join(left)}"


def agreement(
    estimate: Estimate, recordings: Sequence[Recording], is_coarse: bool
) -> Iterator[str]:
    """The weights of several recordings, and whether they agree (`is_coarse`: on a coarse mesh)."""
    names = [each.info.name for each in recordings]
    if len(names) < 2:
        return
    if estimate.shares:
        pairs = zip(names, estimate.shares, strict=False)
        yield f"shares in the loss: {', '.join(f'{name} {share:.2g}' for name, share in pairs)}"
    agreed = estimate.agreement
    if agreed is None:
        return
    if agreed.density is not None and agreed.doubts_density:
        yield (
            f"warning: the recordings would agree on about {agreed.density[0]:.1g} times the "
            "density that was given: weigh the sheet again, in kg/m^2"
        )
    if agreed.contradiction is not None:
        yield _contradiction(estimate, agreed, names, is_coarse)
    elif not agreed.doubts_density:
        yield _agree(agreed, names)


def _agree(agreed: Agreement, names: Sequence[str]) -> str:
    pairs = zip(names, agreed.determined, strict=True)
    alone = [name for name, directions in pairs if not directions]
    left = f"; too little information to compare: {', '.join(alone)}" if alone else ""
    if not agreed.is_excused:
        return f"the recordings agree (p = {agreed.p:.2g}){left}"
    return (
        f"the recordings agree only within the errors of their meshes (p = {agreed.p:.2g}, without "
        f"them {agreed.exact:.1g}): a stiffness that differs by a few times would not show{left}"
    )


def _contradiction(
    estimate: Estimate, agreed: Agreement, names: Sequence[str], is_coarse: bool
) -> str:
    odd = agreed.contradiction
    assert odd is not None
    unit = next(each.unit for each in estimate.ranges if each.name == odd.parameter)
    own, others = (f"{value:.4g} {unit}".removesuffix(" -") for value in odd.values)
    against = "the others" if len(names) > 2 else names[1 - odd.recording]
    return (
        f"warning: {names[odd.recording]} contradicts {against} (p = {agreed.p:.1g}; "
        f"{odd.parameter} {own} by it, {others} by {against}, {odd.errors:.1f} standard errors "
        "apart): another fabric; wrong density, scale, path or markers (the force of a pull tells "
        "stiffness, other motions stiffness over density); or a law that cannot follow all of them "
        f"(see --law){', or the mesh, see below' if is_coarse else ''}"
    )


def misfits(estimate: Estimate, recordings: Sequence[Recording]) -> Iterator[str]:
    """What of the recordings does not fit the fabric."""
    names = [each.info.name for each in recordings]
    for each in estimate.misfits:
        yield f"warning: {names[each.recording]}: {_misfit(each)}"
    for fit in estimate.fits:
        if fit.outliers > POOR:
            yield (
                f"warning: {100 * fit.outliers:.0f} % of {fit.recording} are outliers: its "
                "density, wind, path or scale may be wrong, or the mesh is too coarse"
            )


def _misfit(misfit: Misfit) -> str:
    if misfit.unit == "m":
        return (
            f"{misfit.what} is {1e3 * misfit.off:.0f} mm from its place on the sheet, far more "
            "than the others: on another cloth, or its place is wrong"
        )
    if misfit.what == FORCE:
        return (
            f"the force of this sheet is off by {100 * misfit.off:.0f} % of what was recorded: its "
            "density [kg/m^2], or the unit of the force [N], may be off"
        )
    return (
        f"{misfit.what} is {misfit.off:.1f} {misfit.unit} from what was written down: "
        f"{CAUSES[misfit.what]} may be off"
    )


def _coarse(estimate: Estimate, recordings: Sequence[Recording]) -> list[str]:
    """Where the mesh is too coarse for the estimated fabric."""
    if estimate.shape is None:
        return []
    fabric, lines = estimate.fabric, []
    for size, scenario in dict.fromkeys((r.info.sheet.size, r.info.scenario) for r in recordings):
        lines += mesh_warning(matching_shape(estimate.shape, size), fabric, size, scenario)
    return lines


def _weighed(outcome: Outcome) -> Iterator[str]:
    """That stiffness is in proportion to the given density, where no force was measured."""
    recordings, method = outcome.recordings, outcome.method
    forces = [method.reads(each).force or any(each.info.wind or ()) for each in recordings]
    pulls = [isinstance(test, Pull) for each in outcome.laboratory for test in each.tests]
    if recordings and not any(forces) and not any(pulls):
        yield (
            f"stiffness is in proportion to the density given, {outcome.density:g} kg/m^2: without "
            "the force of a pull, or wind, no recording can check it"
        )


def _laboratory(outcome: Outcome) -> Iterator[str]:
    """How the estimate fits laboratory tests, and whether motions contradict them."""
    if outcome.by_tests is None:
        return
    tests = [test for each in outcome.laboratory for test in each.tests]
    for name, errors, words in fits(tests, outcome.estimate.fabric):
        yield f"{name}: {words}"
        if errors > POOR_FIT:
            yield (
                f"warning: {name}: {errors:.1f} standard deviations off: another fabric, other "
                "units, or a law that cannot follow it (try --law stiffening)"
            )
    p = consistency(outcome.by_tests, outcome.estimate)
    if p < CONTRADICTION:
        yield (
            f"warning: the recordings contradict the laboratory tests (p = {p:.1g}): another "
            "fabric, or its density, scale or path are not as written down"
        )
