"""A page with sliders: the cloth follows them, with the recording and its distance beside it."""

import threading
import time
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s._util.extras import require
from r2s.materials.fabric import Fabric
from r2s.viewer.subject import Moved, Subject, error_used, move

CLOTH, CLOUD, GRIPPER = (0, 114, 178), (213, 94, 0), (30, 30, 30)  # Okabe and Ito's
POINT = 0.003  # [m], of a cloud
PAUSE = 0.02  # [s], between looks at what has changed


class Page:
    """A server on a thread of its own, until `close`.

    Only the last of the places that a slider was dragged through is simulated. `moved` is the
    motion that the page shows, `u` the place of its fabric in the space, and `failure` the reason
    when there is no motion of it; `latest` waits for the motion that the sliders ask for.

    - `subject`: the motion, the space of fabrics and the recording.
    - `u`: where the sliders begin, in the unit cube of the subject's space.
    - `save`: called with the fabric that is shown when its button is pressed; returns the text
      of the notification. None: no button.
    - `host`, `port`: 127.0.0.1 lets nobody in from other machines.

    Raises `OSError` when the port is taken.
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
        if self.server.get_port() != port:
            taken = self.server.get_port()
            self.server.stop()
            raise OSError(f"port {port} of {host} is taken; {taken} is free")
        self._sliders: list[Any] = []
        self._fill(save)
        self._draw()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """What to open in a browser."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def latest(self, timeout: float = 60.0) -> Moved:
        """What the sliders ask for now, simulated; `TimeoutError` after `timeout` [s]."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            if not self._changed.is_set() and np.array_equal(self.u, self._wanted()):
                return self.moved
            time.sleep(PAUSE)
        raise TimeoutError(f"no motion within {timeout:g} s of the sliders' last move")

    def close(self) -> None:
        """End the server and its thread."""
        self._stop.set()
        self._thread.join()
        self.server.stop()

    def _fill(self, save: Callable[[Fabric], str] | None) -> None:
        """Everything on the page, once."""
        gui, scene, subject = self.server.gui, self.server.scene, self.subject
        scene.set_up_direction("+z")
        middle = np.asarray(self.moved.x).reshape(-1, 3)
        self._look_at(np.nanmean(middle, axis=0), np.ptp(middle, axis=0).max())
        height = float(subject.scenario.scene.table.height)
        grid = {"cell_size": 0.05, "section_size": 0.25, "position": (0.0, 0.0, height)}
        scene.add_grid("/table", 2.0, 2.0, **grid)
        last = len(self.moved.ok) - 1
        self._frame = gui.add_slider("frame", 0, last, 1, subject.frames_used[1] or last)
        self._play = gui.add_checkbox("play", False)
        self._frame.on_update(lambda _: self._draw())
        for bound, place in zip(subject.space.ranges, self.u, strict=True):
            hint = f"{bound.low:g} to {bound.high:g} {bound.unit}"
            hint += ", on a logarithmic scale" if bound.log else ""
            slider = gui.add_slider(bound.name, 0.0, 1.0, 0.01, float(place), hint=hint)
            slider.on_update(lambda _: self._changed.set())
            self._sliders.append(slider)
        self._text = gui.add_markdown("")  # what they stand for
        if save is not None:
            gui.add_button("save card").on_click(lambda event: self._save(save, event))

    def _look_at(self, middle: np.ndarray, extent: float) -> None:
        eye = middle + extent * np.array([0.7, -1.3, 0.7])

        @self.server.on_client_connect
        def _(client: Any) -> None:
            client.camera.position, client.camera.look_at = eye, middle

    def _save(self, save: Callable[[Fabric], str], event: Any) -> None:
        try:
            title, text = "saved", save(self.subject.space(jnp.asarray(self.u)))
        except (OSError, ValueError) as error:
            title, text = "not saved", f"{error}"
        if event.client is not None:
            event.client.add_notification(title, text)

    def _wanted(self) -> np.ndarray:
        return np.array([slider.value for slider in self._sliders], self.u.dtype)

    def _run(self) -> None:
        interval = self.subject.scenario.interval
        due = time.monotonic()
        while not self._stop.is_set():
            if self._changed.is_set():
                self._changed.clear()
                wanted = self._wanted()
                try:
                    self.moved, self.failure = move(self.subject, jnp.asarray(wanted)), ""
                except RuntimeError as error:  # such as of memory: the page goes on
                    self.failure = f"No motion of this fabric: {error}. Shown is the last one."
                self.u = wanted
                self._draw()
            if self._play.value and time.monotonic() >= due:
                due = time.monotonic() + interval
                self._frame.value = (self._frame.value + 1) % len(self.moved.ok)  # draws it
            time.sleep(min(PAUSE, interval))

    def _draw(self) -> None:
        """The frame of the slider."""
        with self._drawing:
            frame, moved, scene = int(self._frame.value), self.moved, self.server.scene
            faces = np.asarray(self.subject.scenario.scene.mesh.faces)
            x = np.asarray(moved.x[frame], np.float32)
            is_whole = bool(moved.ok[frame])
            with self.server.atomic():
                look = {"color": CLOTH, "side": "double", "flat_shading": True}
                scene.add_mesh_simple("/cloth", x, faces, visible=is_whole, **look)
                edges = {"color": (0, 60, 100), "wireframe": True, "visible": is_whole}
                scene.add_mesh_simple("/mesh", x, faces, **edges)
                held = x[np.asarray(self.subject.scenario.scene.held)]
                self._points("/grippers", held, GRIPPER, 4 * POINT)
                if self.subject.clouds is not None:
                    mask = np.asarray(self.subject.clouds.mask[frame])
                    seen = np.asarray(self.subject.clouds.points[frame])[mask]
                    self._points("/recording", seen, CLOUD, POINT)
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
            error = 1e3 * float(moved.error[frame]), 1e3 * float(error_used(self.subject, moved))
            first, last = self.subject.frames_used
            lines.append(
                f"Recording to sheet, mean: **{error[0]:.1f} mm** in frame {frame}, "
                f"**{error[1]:.1f} mm** in frames {first} to {last}."
            )
        return "\n".join(lines)
