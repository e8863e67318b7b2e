"""Draws the longest drive of a preview, one panel a signal; what looks wrong is red."""

from pathlib import Path

import numpy as np

from fleet_slip.catalogue.signals import SAMPLE_TIME_S, catalogue
from fleet_slip.errors import ConfigError
from fleet_slip.extras import needed
from fleet_slip.files.storage_errors import storage_errors
from fleet_slip.ingest.drafting.preview import Preview


def draw_preview(preview: Preview, file: Path) -> None:
    """Draw the signals over time. The suffix of the file says the format.

    Raises `ConfigError` for an unknown suffix, and `StorageError` if it cannot be written.
    """
    with needed("report", "a picture of a measured log"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - takes a while
        from matplotlib.figure import Figure  # noqa: PLC0415

    names = list(preview.longest)
    figure = Figure(figsize=(10, 1.3 * len(names) + 0.8), layout="constrained")
    FigureCanvasAgg(figure)
    panels = np.atleast_1d(figure.subplots(len(names), sharex=True))
    for name, axes in zip(names, panels, strict=True):
        values = preview.longest[name]
        wrong = [s.kind for s in preview.suspicions if name in s.signals]
        time_s = np.arange(values.size) * float(SAMPLE_TIME_S)
        axes.plot(time_s, values, color="tab:red" if wrong else "tab:blue", linewidth=0.8)
        axes.axhline(0, color="0.8", linewidth=0.5, zorder=0)
        axes.set_title(f"{name}, {catalogue()[name].unit}", loc="left", fontsize="small")
        axes.set_title("; ".join(f"{kind}?" for kind in wrong), loc="right", fontsize="small")
        axes.spines[["top", "right"]].set_visible(False)
    panels[-1].set_xlabel("time, s")
    figure.suptitle(f"{Path(preview.file).name}: its longest drive", x=0.01, ha="left")
    with storage_errors(file):
        try:
            figure.savefig(file, metadata={"Date": None} if file.suffix == ".svg" else None)
        except ValueError as error:
            raise ConfigError(f"{file}: {error}") from None
