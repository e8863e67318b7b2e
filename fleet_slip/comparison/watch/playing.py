"""A drive as a page that plays: one file without a server."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.watch.drive_frames import WHEELS, DriveFrames
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.pages.page_parts import fill_in


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
