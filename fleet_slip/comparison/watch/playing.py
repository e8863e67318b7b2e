"""A drive as a film, MP4 or GIF, and as a page that plays: one file without a server."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.animation import FFMpegWriter, PillowWriter
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.watch.drive_frames import FRAMES_PER_S, WHEELS, DriveFrames
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.files.storage_errors import storage_errors
from fleet_slip.pages.drawing import STYLE, colour
from fleet_slip.pages.page_parts import fill_in

GIF_EVERY = 2
"""A GIF keeps time in hundredths of a second; every second frame keeps it small."""
DPI = 80
AROUND_M = 22.0
CAR_M = np.array([(2.1, 0.9), (2.1, -0.9), (-2.3, -0.9), (-2.3, 0.9)])
ARROWS = (("truth", 9.0), ("model_4", 8.0))


def write_film(frames: DriveFrames, file: Path) -> None:
    """Write the film of a drive; the suffix says how. Raises `StorageError`."""
    every = GIF_EVERY if file.suffix == ".gif" else 1
    rate = FRAMES_PER_S / every
    if file.suffix == ".gif":
        writer: Any = PillowWriter(fps=round(rate))
    else:
        from imageio_ffmpeg import get_ffmpeg_exe  # noqa: PLC0415 - an extra

        mpl.rcParams["animation.ffmpeg_path"] = str(get_ffmpeg_exe())
        writer = FFMpegWriter(fps=round(rate), codec="libx264", extra_args=["-pix_fmt", "yuv420p"])
    with mpl.rc_context(STYLE), storage_errors(file):
        figure, show = _stage(frames)
        with writer.saving(figure, str(file), DPI):
            for number in range(0, len(frames.time_s), every):
                show(number)
                writer.grab_frame()


def _stage(frames: DriveFrames) -> tuple[Figure, Callable[[int], None]]:
    """Return a figure, and what moves everything in it to a frame."""
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    above, angles = figure.subplots(2, height_ratios=[2.2, 1])
    figure.suptitle(f"{frames.title} — {frames.model}", fontsize=9)
    above.axis("off")
    if len(frames.track[0]):
        above.plot(*frames.track, color=colour("grid"), linewidth=26, solid_capstyle="round")
    above.plot(frames.x_m, frames.y_m, color=colour("muted"), linewidth=0.7)
    car = Polygon(CAR_M, closed=True, facecolor=colour("below_1"), edgecolor=colour("ink"))
    above.add_patch(car)
    arrows = {name: above.plot([], [], color=colour(name), linewidth=2)[0] for name, _ in ARROWS}
    for name, values in (("truth", frames.sideslip_deg), ("model_4", frames.estimate_deg)):
        angles.plot(frames.time_s, values, color=colour(name), linewidth=1.2)
    angles.set_title(
        "side-slip angle, deg: true (dark) and estimated (blue)", color=colour("muted")
    )
    cursor = angles.axvline(frames.time_s[0], color=colour("unstable"), linewidth=1)
    told = above.text(0.01, 0.97, "", transform=above.transAxes, va="top")

    def show(i: int) -> None:
        x, y, heading = frames.x_m[i], frames.y_m[i], frames.heading_rad[i]
        turn = np.array([(np.cos(heading), np.sin(heading)), (-np.sin(heading), np.cos(heading))])
        car.set_xy(CAR_M @ turn + (x, y))
        for (name, length), angle in zip(
            ARROWS, (frames.sideslip_deg[i], frames.estimate_deg[i]), strict=True
        ):
            course = heading + np.radians(angle)
            arrows[name].set_data(
                [x, x + length * np.cos(course)], [y, y + length * np.sin(course)]
            )
        across_m = AROUND_M * above.bbox.width / above.bbox.height  # so that a metre is a metre
        above.set_xlim(x - across_m, x + across_m)
        above.set_ylim(y - AROUND_M, y + AROUND_M)
        cursor.set_xdata([frames.time_s[i]] * 2)
        told.set_text(
            f"{frames.time_s[i]:5.1f} s   {3.6 * frames.speed_mps[i]:3.0f} km/h   "
            f"true {frames.sideslip_deg[i]:+.2f}°   estimated {frames.estimate_deg[i]:+.2f}°"
        )

    return figure, show


def write_page(frames: DriveFrames, file: Path) -> None:
    """Write the page as a whole, or not at all. Raises `StorageError`."""
    LocalFolder(file.parent).put(file.name, render_watch(frames).encode("utf-8"))


def render_watch(frames: DriveFrames) -> str:
    """Return the page."""
    text = json.dumps(_data(frames), separators=(",", ":"), allow_nan=False)
    # Within a script element only this could end it.
    data = Markup(text.replace("<", "\\u003c"))  # noqa: S704
    return fill_in("watch.html.j2", frames=frames, data=data)


def _data(frames: DriveFrames) -> dict[str, Any]:
    wheels = np.array([frames.wheel_rad_s[name] for name in WHEELS])
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = wheels.mean(axis=0)
        excess = 100 * np.where(mean > 1, wheels / mean - 1, np.nan)
    return {
        "t": _listed(frames.time_s, 2),
        "speed": _listed(frames.speed_mps, 2),
        "x": _listed(frames.x_m, 2),
        "y": _listed(frames.y_m, 2),
        "heading": _listed(frames.heading_rad, 4),
        "beta": _listed(frames.sideslip_deg, 3),
        "estimate": _listed(frames.estimate_deg, 3),
        "steer": _listed(frames.steer_rad, 4),
        "wheels": [_listed(one, 2) for one in excess],
        "gates": [_listed(one, 3) for one in frames.gates.values()],
        "track": [_listed(one, 1) for one in frames.track],
    }


def _listed(values: FloatArray, digits: int) -> list[float | None]:
    """Return numbers for JSON, None for what is not finite."""
    return [round(value, digits) if np.isfinite(value) else None for value in values.tolist()]
