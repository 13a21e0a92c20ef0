"""Pictures of a recording: a contact sheet and a video of clouds, grippers, and simulated cloth.

    show(open_recording("recording.npz"), "out", load_trajectory("trajectory.npz"))

Needs matplotlib: pip install 'r2s[study]'; the video is an MP4 where OpenCV is installed
('r2s[camera]'), else a GIF.
"""

import importlib.util
import io
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from r2s._util.extras import require
from r2s._util.files import write_bytes
from r2s.recordings.open import SimulatedCloth
from r2s.recordings.recording import Recording, SheetPlacement, cloud, corner, frame_durations
from r2s.viewer.cuts import write_figure

# The object API alone: pyplot would keep every figure, and choose a backend for the caller.
require("matplotlib", "study", "pictures")
from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from matplotlib.lines import Line2D  # noqa: E402
from matplotlib.ticker import MaxNLocator  # noqa: E402
from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # noqa: E402

# Okabe and Ito's colours, which the colour-blind can tell apart.
CLOTH, CLOUD, GRIPPER, MARKER, GREY = "#0072B2", "#D55E00", "#000000", "#009E73", "#8c8c8c"
MAX_DOTS = 1500  # a panel; more would hide the cloth
MAX_PANELS = 12  # of the contact sheet
ELEVATION, FLAT_ELEVATION, AZIMUTH = 18, 50, -60  # [degrees], of the eye; the second: flat scenes
FLAT = 0.3  # least height of the box over its longest side, so that a flat scene can be seen in
EVEN, TICKS = 0.05, 4  # of an interval, to which frames are even; pictures of an MP4 else
STRIP = 1.7  # [inch], height of the force's curve
Video = Literal["auto", "gif", "mp4", "none"]
Pictures = Iterable[UInt8[np.ndarray, "height width 3"]]


def show(
    recording: Recording,
    folder: Path | str,
    cloth: SimulatedCloth | None = None,
    video: Video = "auto",
) -> list[Path]:
    """Write `NAME.png`, a contact sheet, and `NAME.gif` or `NAME.mp4`, in real time; their paths.

    They show clouds, grippers with their path so far, markers and the force where there are any,
    the sheet's outline at rest, and the table; all axes of all frames have one scale, in metres.
    Raises ValueError when the cloth has another number of frames, ImportError that names the
    extra, OSError.
    """
    if cloth is not None and len(cloth.x) != len(recording.times):
        raise ValueError(
            f"the trajectory has {len(cloth.x)} frames, the recording {recording.info.name} "
            f"{len(recording.times)}: simulate it at the recording's times"
        )
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    stem = recording.info.name.replace("/", "_")
    written = [contact_sheet(folder / f"{stem}.png", recording, cloth)]
    if video == "auto":
        video = "gif" if importlib.util.find_spec("cv2") is None else "mp4"
    if video != "none":
        path, times = folder / f"{stem}.{video}", np.asarray(recording.times, np.float64)
        write = write_mp4 if video == "mp4" else write_gif
        write(path, pictures(recording, cloth), frame_durations(times))
        written.append(path)
    return written


def contact_sheet(path: Path, recording: Recording, cloth: SimulatedCloth | None = None) -> Path:
    """Write up to twelve frames, spread over the recording, as one PNG."""
    count = len(recording.times)
    frames = np.unique(np.linspace(0, count - 1, min(MAX_PANELS, count)).round().astype(int))
    figure = _drawn(Content.make(recording, cloth), frames.tolist(), (3.6, 3.3))
    return write_figure(path, figure)


def pictures(recording: Recording, cloth: SimulatedCloth | None = None) -> Iterator[np.ndarray]:
    """Each frame as a picture, (height, width, 3) in 0..255, of even sides."""
    content = Content.make(recording, cloth)
    for frame in range(len(recording.times)):
        canvas = FigureCanvasAgg(_drawn(content, [frame], (6.4, 4.7)))
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


class Content(NamedTuple):
    """What the panels show.

    - `clouds`: points [m] of each frame, thinned.
    - `low`, `high`: corners [m] of the box that is drawn.
    """

    recording: Recording
    cloth: SimulatedCloth | None
    clouds: list[np.ndarray]
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def make(cls, recording: Recording, cloth: SimulatedCloth | None) -> "Content":
        generator = np.random.default_rng(0)
        frames = (cloud(recording, frame) for frame in range(len(recording.times)))
        clouds = [generator.permutation(points)[:MAX_DOTS] for points in frames]
        return cls(recording, cloth, clouds, *_limits(recording, cloth, np.concatenate(clouds)))

    def visible(self, points: np.ndarray) -> np.ndarray:
        """Which points [m] are in the box."""
        return _inside(points, self.low, self.high)


def _drawn(content: Content, frames: list[int], panel: tuple[float, float]) -> Figure:
    """A figure with a panel for each frame, of a width and height [inch]; the force below them."""
    columns = min(4, len(frames))
    rows = -(-len(frames) // columns)
    recording = content.recording
    strip = 0.0 if recording.force is None else STRIP
    height = panel[1] * rows + 0.9 + strip
    figure = Figure(figsize=(panel[0] * columns, height), dpi=100)
    top, bottom = 1 - 0.57 / height, (0.4 + strip) / height
    figure.subplots_adjust(0.0, bottom, 0.96, top, wspace=0.06, hspace=0.1)
    for i, frame in enumerate(frames):
        axes: Any = figure.add_subplot(rows, columns, i + 1, projection="3d")
        draw_surroundings(axes, content)
        draw_frame(axes, content, frame)
        first, last = recording.info.frames_used
        caption = f"frame {frame}, {float(recording.times[frame]):.2f} s"
        caption += "" if first <= frame <= last else " (not used)"
        axes.set_title(caption, fontsize=9, y=0.98)
    if strip:
        axes = figure.add_axes((0.08, 0.75 / height, 0.86, (strip - 0.45) / height))
        _draw_force(axes, recording, frames)
    draw_title_and_legend(figure, content)
    return figure


def draw_surroundings(axes: Any, content: Content) -> None:
    """Limits, one scale for all axes, labels, and what does not move: table and sheet at rest."""
    low, high, info = content.low, content.high, content.recording.info
    axes.patch.set_alpha(0)  # it would cover the labels of the panel to the left
    axes.computed_zorder = False  # the dots lie over the cloth, whatever their depth
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=0.98)
    is_flat = high[2] - low[2] < 1.01 * FLAT * (high - low).max()
    axes.view_init(elev=FLAT_ELEVATION if is_flat else ELEVATION, azim=AZIMUTH)
    for axis, name in ((axes.xaxis, "x"), (axes.yaxis, "y"), (axes.zaxis, "z")):
        axis.set_major_locator(MaxNLocator(3))
        axis.set_label_text(f"{name} [m]", fontsize=8)
        axis.labelpad = -5 if name != "z" else -3
        axis.pane.set_alpha(0.4)
    axes.tick_params(labelsize=7, pad=-3)
    axes.tick_params("z", pad=1)
    axes.plot(*_outline(info.sheet).T, color=GREY, linewidth=0.9, linestyle="--", zorder=2)
    if low[2] <= info.table_height <= high[2]:
        edge = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * (high - low)[:2] + low[:2]
        axes.plot(*edge.T, np.full(5, info.table_height), color=GREY, linewidth=0.6, zorder=1)


def draw_frame(axes: Any, content: Content, frame: int) -> None:
    """Draw what moves, as it is in a frame."""
    recording, cloth = content.recording, content.cloth
    if cloth is not None:
        x = cloth.x[frame]
        faces = cloth.faces[content.visible(x)[cloth.faces].all(axis=1)]
        style: dict[str, Any] = {"facecolor": (CLOTH, 0.25), "edgecolor": (CLOTH, 0.7)}
        axes.add_collection3d(Poly3DCollection(x[faces], linewidth=0.35, zorder=3, **style))
        if len(faces) < len(cloth.faces):
            text = "part of the cloth is out of the picture"
            axes.text2D(0.5, 0.02, text, fontsize=8, ha="center", transform=axes.transAxes)
    points = content.clouds[frame]
    points = points[content.visible(points)]
    dots: dict[str, Any] = {"linewidths": 0, "depthshade": False}
    axes.scatter(*points.T, s=2.2, color=CLOUD, zorder=5, **dots)
    if recording.markers is not None and recording.markers_seen is not None:
        markers = np.asarray(recording.markers)[frame][np.asarray(recording.markers_seen)[frame]]
        axes.scatter(*markers.T, s=14, color=MARKER, zorder=6, marker="x", depthshade=False)
    times, now = np.asarray(recording.gripper_times), float(recording.times[frame])
    knots = np.append(times[times < now], now)
    for gripper in np.asarray(recording.gripper_path).transpose(1, 2, 0):  # its path so far
        path = np.stack([np.interp(knots, times, axis) for axis in gripper])
        axes.plot(*path, color=GRIPPER, linewidth=0.9, zorder=7)
        axes.plot(*path[:, -1:], "o", color=GRIPPER, markersize=5, zorder=8)


def _draw_force(axes: Any, recording: Recording, frames: list[int]) -> None:
    """The force [N] (of a vector its size) while the frames were taken; dots at some of them."""
    force, logged = np.asarray(recording.force), np.asarray(recording.force_times)
    force = force if force.ndim == 1 else np.linalg.norm(force, axis=1)
    axes.plot(logged, force, color=GRIPPER, linewidth=1.1)
    times = np.asarray(recording.times)
    at_frames = np.interp(times[frames], logged, force, left=np.nan, right=np.nan)
    axes.plot(times[frames], at_frames, "o", color=CLOUD, markersize=4, zorder=3)
    margin = 0.02 * float(np.ptp(times)) or 1.0
    axes.set_xlim(times[0] - margin, times[-1] + margin)
    axes.set_xlabel("time [s]", fontsize=8, labelpad=1)
    axes.set_ylabel("force [N]", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(color=GREY, alpha=0.3, linewidth=0.5)


def _inside(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Which points are in a box; False where one is not finite."""
    return np.asarray(((points >= low) & (points <= high)).all(axis=1))


def _limits(
    recording: Recording, cloth: SimulatedCloth | None, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The corners [m] of a box around the sheet at rest, the grippers, the points and the cloth.

    What is farther from the first two than half of the sheet's side flew off, or is no cloth; but
    most of the points are always in.
    """
    path = np.asarray(recording.gripper_path).reshape(-1, 3)
    known = np.concatenate([path, _outline(recording.info.sheet)])
    low, high, reach = known.min(axis=0), known.max(axis=0), 0.5 * max(recording.info.sheet.size)
    wide = low - reach, high + reach
    near = points[_inside(points, *wide)]
    near = points if len(near) < 0.8 * len(points) else near
    corners = [low, high, *(np.percentile(near, [0.5, 99.5], axis=0) if len(near) else ())]
    if cloth is not None:
        vertices = cloth.x.reshape(-1, 3)
        corners.extend(vertices[_inside(vertices, *wide)])
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    least = FLAT * float((high - low).max())
    centre, half = (low + high) / 2, np.maximum(high - low, least) / 2
    return centre - 1.04 * half, centre + 1.04 * half


def _outline(sheet: SheetPlacement) -> np.ndarray:
    """The corners [m] of the sheet at rest, around and back to the first."""
    names = ("origin", "warp", "opposite", "weft", "origin")
    return np.stack([corner(sheet, name) for name in names])


def draw_title_and_legend(figure: Any, content: Content) -> None:
    """The recording's name at the top of a figure, and at its bottom what each colour is."""
    info = content.recording.info
    title = f"{info.name}: {info.scenario}, {info.fabric}, trial {info.trial}"
    figure.suptitle(title, fontsize=11)
    outside = 1 - float(content.visible(np.concatenate(content.clouds)).mean())
    omitted = f" ({outside:.1%} out of the picture)" if outside >= 5e-4 else ""
    dot: dict[str, Any] = {"linestyle": "", "marker": "o"}
    handles = [
        Line2D([], [], color=CLOUD, markersize=4, label=f"recorded cloud{omitted}", **dot),
        Line2D([], [], color=GRIPPER, marker="o", markersize=5, linewidth=1, label="gripper"),
        Line2D([], [], color=GREY, linestyle="--", linewidth=1, label="sheet at rest"),
    ]
    if content.recording.markers is not None:
        handles.append(Line2D([], [], color=MARKER, linestyle="", marker="x", label="marker"))
    if content.cloth is not None:
        handles.append(Line2D([], [], color=CLOTH, linewidth=5, alpha=0.5, label="simulated cloth"))
    narrow: dict[str, Any] = {"columnspacing": 0.9, "handletextpad": 0.3, "fontsize": 7.5}
    options = narrow if figure.get_figwidth() < 8 else {"fontsize": 9}
    options |= {"loc": "lower center", "ncols": len(handles), "frameon": False}
    figure.legend(handles=handles, **options)


def write_gif(path: Path, frames: Pictures, lasting: Float[np.ndarray, " frame"]) -> None:
    """Write pictures, each `lasting` so long [s], as a GIF, of up to 50 a second."""
    from PIL import Image  # comes with matplotlib

    images = [Image.fromarray(pixels) for pixels in frames]
    # One palette for all, from the fullest picture: else colours flicker, and files are larger.
    palette = images[len(images) // 2].quantize(64)
    first, *others = (i.quantize(palette=palette, dither=Image.Dither.NONE) for i in images)
    # GIFs count in hundredths of a second: round the times, not the intervals, which would add up.
    times = np.round(100 * np.cumsum([0, *lasting]))
    duration = [max(20, 10 * int(step)) for step in np.diff(times)]  # [ms]
    options = {"save_all": True, "append_images": others, "loop": 0, "optimize": False}
    buffer = io.BytesIO()
    first.save(buffer, format="GIF", duration=duration, **options)
    write_bytes(path, buffer.getvalue())


def write_mp4(path: Path, frames: Pictures, lasting: Float[np.ndarray, " frame"]) -> None:
    """Write pictures of even sides, each `lasting` so long [s], as an MP4.

    Its rate is even: that of the frames, or, where they are not, `TICKS` times that of the most
    frequent interval, at which pictures are repeated. Needs OpenCV: pip install 'r2s[camera]'.
    Raises OSError where it cannot write MP4.
    """
    cv2 = require("cv2", "camera", "videos as MP4 (a GIF needs no extra)")
    usual = float(np.median(lasting))
    is_even = np.abs(lasting - usual).max() < EVEN * usual
    tick = usual / (1 if is_even else TICKS)
    repeats = np.diff(np.round(np.cumsum([0, *lasting]) / tick)).astype(int)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        part, writer = Path(folder) / "video.mp4", cv2.VideoWriter()
        for pixels, count in zip(frames, repeats, strict=True):
            code, size = cv2.VideoWriter.fourcc(*"mp4v"), pixels.shape[1::-1]
            if not writer.isOpened() and not writer.open(str(part), code, 1 / tick, size):
                raise OSError(f"{path}: OpenCV cannot write MP4 here: ask for a GIF")
            for _ in range(count):
                writer.write(np.ascontiguousarray(pixels[..., ::-1]))
        writer.release()
        write_bytes(path, part.read_bytes())
