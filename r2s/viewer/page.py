"""A page with sliders: the cloth follows them, with the recording and its distance beside it.

subject = Subject.of_recording(recording, space)
Page(subject, subject.place(fabric), port=8080)     # http://127.0.0.1:8080, until `close`
"""

import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s._util.extras import require
from r2s.estimation.problem import Clouds
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace
from r2s.metrics.losses import masked_mean, surface_residuals
from r2s.recordings.recording import Recording, frame_durations, subsample
from r2s.scenarios import Experiment
from r2s.scenarios.scenario import Scenario, from_recording, rollout
from r2s.solvers.simulate import Solution

MAX_POINTS = 1500  # of a cloud: more change neither the picture nor the distance
CLOTH, EDGES, CLOUD, GRIPPER = (0, 114, 178), (0, 60, 100), (213, 94, 0), (30, 30, 30)
POINT = 0.003  # [m], of a cloud
PAUSE = 0.02  # [s], between looks at what has changed


class Subject(eqx.Module):
    """A motion that any fabric of a space can make.

    - `scenario`: the motion.
    - `space`: the fabrics that the sliders reach.
    - `clouds`: points of a recording, in all its frames; None: there is none.
    - `frames_used`: the first and the last frame that count.
    """

    scenario: Scenario
    space: ParameterSpace
    clouds: Clouds | None = None
    frames_used: tuple[int, int] = eqx.field(static=True, default=(0, 0))

    @classmethod
    def of_recording(
        cls, recording: Recording, space: ParameterSpace, shape: tuple[int, int] = (9, 9)
    ) -> "Subject":
        """The motion of a recording, on a mesh of `shape` vertices; raises as `from_recording`."""
        sampled = subsample(recording, MAX_POINTS, None, 0)
        clouds = Clouds(sampled.points, sampled.mask)
        return cls(from_recording(recording, shape), space, clouds, recording.info.frames_used)

    @classmethod
    def of_experiment(
        cls, experiment: Experiment, space: ParameterSpace, shape: tuple[int, int] = (9, 9)
    ) -> "Subject":
        """A motion that nobody recorded."""
        return cls(experiment.scenario(shape), space, None, experiment.frames_used)

    def place(self, fabric: Fabric) -> Float[Array, " dim"]:
        """The point of a fabric in the unit cube of the space, at its bounds when beyond them."""
        return jnp.clip(self.space.to_unit(fabric), 0, 1)


class Moved(NamedTuple):
    """A motion of a subject, and its distance from the recording.

    - `error`: mean distance [m] from the recorded points to the sheet in each frame; NaN where
      there are none, or the simulation diverged.
    - `mean_error`: over the frames that count [m]; NaN when one of them has none.
    """

    motion: Solution
    error: Float[Array, " frame"]
    mean_error: Float[Array, ""]


@eqx.filter_jit
def move(subject: Subject, u: Float[Array, " dim"]) -> Moved:
    """The motion of the fabric at `u`, and how far the recording is from its surface."""
    motion = rollout(subject.scenario, subject.space(u))
    if subject.clouds is None:
        nowhere = jnp.full(motion.ok.shape, jnp.nan)
        return Moved(motion, nowhere, nowhere[0])
    faces = subject.scenario.scene.mesh.faces

    def distance(frame):
        points, mask, x = frame
        return masked_mean(surface_residuals(points, mask, x, faces)[0], mask)

    error = jax.lax.map(distance, (subject.clouds.points, subject.clouds.mask, motion.x))
    error = jnp.where(motion.ok, error, jnp.nan)
    first, last = subject.frames_used
    return Moved(motion, error, jnp.mean(error[first : last + 1]))


class Page:
    """A server on a thread of its own, until `close`.

    `moved` is the motion that the page shows, `u` the place of its fabric in the space, and
    `failure` why it has no motion. While a slider is dragged only its last place is simulated.

    - `u`: where the sliders begin, in the unit cube of the subject's space.
    - `save`: called with the fabric that is shown when its button is pressed; returns the text
      of the notification. None: no button.
    - `host`, `port`: 127.0.0.1 lets nobody in from other machines.

    Raises `OSError` when the port is taken, `ImportError` that names the extra.
    """

    def __init__(
        self,
        subject: Subject,
        u: Float[Array, " dim"],
        *,
        save: Callable[[Fabric], str] | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
    ):
        viser = require("viser", "viz", "a page with sliders")
        self.subject, self.u = subject, np.asarray(u)
        self.moved: Moved = move(subject, jnp.asarray(u))
        self.failure = ""
        self._changed, self._stop = threading.Event(), threading.Event()
        self._drawing = threading.Lock()
        self.server = viser.ViserServer(host=host, port=port, label="r2s", verbose=False)
        if (free := self.server.get_port()) != port:
            self.server.stop()
            raise OSError(f"port {port} of {host} is taken; {free} is free")
        self._sliders: list[Any] = []
        self._add_controls(save)
        self._draw()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """What to open in a browser."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def close(self) -> None:
        """End the server and its thread."""
        self._stop.set()
        self._thread.join()
        self.server.stop()

    def _add_controls(self, save: Callable[[Fabric], str] | None) -> None:
        """The camera, the table, sliders and buttons."""
        gui, scene, subject = self.server.gui, self.server.scene, self.subject
        scene.set_up_direction("+z")
        points = np.asarray(self.moved.motion.x).reshape(-1, 3)
        middle, extent = np.nanmean(points, axis=0), np.ptp(points, axis=0).max()
        eye = middle + extent * np.array([0.7, -1.3, 0.7])

        @self.server.on_client_connect
        def _(client: Any) -> None:
            client.camera.position, client.camera.look_at = eye, middle

        height = float(subject.scenario.scene.table.height)
        grid = {"cell_size": 0.05, "section_size": 0.25, "position": (0.0, 0.0, height)}
        scene.add_grid("/table", 2.0, 2.0, **grid)
        last = len(self.moved.motion.ok) - 1
        self._frame = gui.add_slider("frame", 0, last, 1, subject.frames_used[1] or last)
        self._play = gui.add_checkbox("play", False)
        self._frame.on_update(lambda _: self._draw())
        for bound, place in zip(subject.space.ranges, self.u, strict=True):
            scale = ", on a logarithmic scale" if bound.log else ""
            hint = f"{bound.low:g} to {bound.high:g} {bound.unit}{scale}"
            slider = gui.add_slider(bound.name, 0.0, 1.0, 0.01, float(place), hint=hint)
            slider.on_update(lambda _: self._changed.set())
            self._sliders.append(slider)
        self._text = gui.add_markdown("")
        if save is not None:
            gui.add_button("save card").on_click(lambda event: self._save(save, event))

    def _save(self, save: Callable[[Fabric], str], event: Any) -> None:
        try:
            title, text = "saved", save(self.subject.space(jnp.asarray(self.u)))
        except (OSError, ValueError) as error:
            title, text = "not saved", f"{error}"
        if event.client is not None:
            event.client.add_notification(title, text)

    def _run(self) -> None:
        # how long each frame is shown: until the next, the last as long as most of them
        lasting = frame_durations(np.asarray(self.moved.motion.times, np.float64))
        due = time.monotonic()
        while not self._stop.is_set():
            if self._changed.is_set():
                self._changed.clear()
                u = np.array([slider.value for slider in self._sliders], self.u.dtype)
                try:
                    self.moved, self.failure = move(self.subject, jnp.asarray(u)), ""
                except RuntimeError as error:  # such as of memory: the page stays open
                    self.failure = f"No motion of this fabric: {error}. Shown is the last one."
                self.u = u
                self._draw()
            if self._play.value and time.monotonic() >= due:
                frame = (self._frame.value + 1) % len(lasting)
                due = max(due, time.monotonic() - PAUSE) + lasting[frame]
                self._frame.value = frame  # draws it
            time.sleep(min(PAUSE, lasting.min()))

    def _draw(self) -> None:
        """Draw the frame of the slider."""
        with self._drawing, self.server.atomic():
            frame, scene = int(self._frame.value), self.server.scene
            of_sheet, clouds = self.subject.scenario.scene, self.subject.clouds
            faces = np.asarray(of_sheet.mesh.faces)
            x = np.asarray(self.moved.motion.x[frame], np.float32)
            is_finite = bool(self.moved.motion.ok[frame])
            sides = {"color": CLOTH, "side": "double", "flat_shading": True}
            edges = {"color": EDGES, "wireframe": True}
            for name, look in (("/cloth", sides), ("/mesh", edges)):
                scene.add_mesh_simple(name, x, faces, visible=is_finite, **look)
            self._points("/grippers", x[np.asarray(of_sheet.pinned)], GRIPPER, 4 * POINT)
            if clouds is not None:
                cloud = np.asarray(clouds.points[frame])[np.asarray(clouds.mask[frame])]
                self._points("/recording", cloud, CLOUD, POINT)
            self._text.content = self._describe(frame)

    def _points(self, name: str, points: np.ndarray, color: tuple, size: float) -> None:
        look = {"point_size": size, "point_shape": "circle", "precision": "float32"}
        self.server.scene.add_point_cloud(name, points.astype(np.float32), color, **look)

    def _describe(self, frame: int) -> str:
        """The numbers of the fabric, and the distance of the recording."""
        space, moved = self.subject.space, self.moved
        values = np.asarray(space.values(jnp.asarray(self.u)))
        rows = [
            f"| {bound.name} | {value:.3g} | {bound.unit} |"
            for bound, value in zip(space.ranges, values, strict=True)
        ]
        lines = ["| | | |", "|---|---|---|", *rows, ""]
        if self.failure:
            lines.append(self.failure)
        elif failure := moved.motion.explain():
            lines.append(f"The simulation {failure}")
        elif self.subject.clouds is not None:
            first, last = self.subject.frames_used
            lines.append(
                f"Recording to sheet, mean: **{1e3 * float(moved.error[frame]):.1f} mm** in frame "
                f"{frame}, **{1e3 * float(moved.mean_error):.1f} mm** in frames {first} to {last}."
            )
        return "\n".join(lines)
