"""`r2s view`: a fabric with sliders, in a browser."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from r2s.cli.common import Motion, ScenarioName, Shape

if TYPE_CHECKING:
    from r2s.estimation.cards import Card
    from r2s.materials.fabric import Fabric
    from r2s.materials.parameters import ParameterSpace
    from r2s.viewer.page import Subject

Size = tuple[float, float]


@dataclass(frozen=True)
class View:
    """Show a fabric in motion in a browser, with sliders.

    With --recording the motion is the recording's, its points lie over the cloth, and their mean
    distance follows the sliders. Sliders run over the range of estimates; values are below them.
    Ends with Ctrl-C. Needs the extra viz.

        r2s view grey_interlock --scenario fling
        r2s view denim.json --recording lift.npz --save mine.json
    """

    fabric: Annotated[Positional[str], arg(metavar="PRESET|CARD")] = "grey_interlock"
    """Where the sliders begin; its areal density is kept."""
    recording: Annotated[Path | None, arg(metavar="RECORDING")] = None
    """NPZ, or folder of frames."""
    scenario: Annotated[ScenarioName, arg(metavar="SCENARIO")] = "lifting"
    """Without a recording: of the study."""
    motion: Motion = ()
    shape: Shape = (9, 9)
    save: Annotated[Path | None, arg(metavar="FILE")] = None
    """Card that a button writes, with the fabric as shown."""
    host: str = "127.0.0.1"
    """0.0.0.0 lets other machines in."""
    port: int = 8080

    def run(self) -> None:
        import time

        from r2s.cli.common import load_card, mesh_warning
        from r2s.materials.parameters import OrthotropicSpace
        from r2s.viewer.page import Page

        card = load_card(self.fabric)
        subject, motion = self._subject(OrthotropicSpace.make(float(card.fabric.density)))
        save = None if self.save is None else lambda fabric: self._save_card(card, fabric)
        start = subject.place(card.fabric)
        page = Page(subject, start, save=save, host=self.host, port=self.port)
        for line in mesh_warning(self.shape, card.fabric, *motion):
            print(line)
        print(f"{page.url} (Ctrl-C ends)", flush=True)
        try:
            while True:
                time.sleep(1)
        except KeyboardInterrupt:
            page.close()

    def _subject(self, space: "ParameterSpace") -> "tuple[Subject, tuple[Size, str]]":
        """What is shown; the sheet's size [m] and the name of the motion."""
        from r2s.cli.common import make_experiment
        from r2s.recordings.open import open_recording
        from r2s.viewer.page import Subject

        if self.recording is None:
            made = make_experiment(self.scenario, self.motion)
            return Subject.of_experiment(made, space, self.shape), (made.sheet.size, made.name)
        if self.motion:
            raise ValueError("--motion is of a scenario: a recording has its own motion")
        seen = open_recording(self.recording)
        return Subject.of_recording(seen, space, self.shape), (
            seen.info.sheet.size,
            seen.info.scenario,
        )

    def _save_card(self, card: "Card", fabric: "Fabric") -> str:
        from r2s.estimation import cards

        assert self.save is not None
        method = f"set by hand with sliders, from {card.name}"
        origin = cards.Provenance(method, assumed=("density", "thickness", "mass_damping"))
        cards.write(self.save, cards.Card.make(self.save.stem, fabric, origin))
        return f"{self.save}"
