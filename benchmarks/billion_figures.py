"""The table and the log-log plot of `benchmarks.billion`."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

from fleet_slip.pages.drawing import PALETTE, STYLE

Size = dict[str, Any]

FROM_NOTHING = ("simulate", "gram", "select", "publish")
NEW_DAY = ("new day: simulate", "new day: gram", "new day: select")
DRAWN = {
    "from nothing to a published model": (FROM_NOTHING, "ink"),
    "simulate and store": (("simulate",), "model_4"),
    "Gram rows": (("gram",), "model_3"),
    "a new day of 1 %": (NEW_DAY, "model_1"),
    "select": (("select",), "model_2"),
    "forget a car": (("forget a car",), "unstable"),
}


def seconds(size: Size, steps: Sequence[str]) -> float:
    """Return the time of some steps together."""
    return math.fsum(size["steps"][name]["seconds"] for name in steps)


def processor_s(size: Size, steps: Sequence[str]) -> float:
    """Return the time that some steps together took on processors."""
    return math.fsum(size["steps"][name]["cpu_s"] for name in steps)


def slope(rows: Sequence[float], values: Sequence[float]) -> float:
    """Return the slope of log value over log rows, by least squares."""
    return float(np.polyfit(np.log(rows), np.log(values), 1)[0])


def markdown(sizes: Sequence[Size]) -> str:
    """Return the figures of all sizes as a Markdown table, with slopes if there are several."""
    rows = [size["rows"] for size in sizes]
    slopes = len(sizes) > 1
    head = ["", *(f"{n:,}" for n in rows), *(["slope", "last slope"] if slopes else [])]
    lines = [_line(head), _line(["---", *["---:"] * (len(head) - 1)])]
    for name, figure, shown in _figures(sizes):
        values = [figure(size) for size in sizes]
        cells = [shown(value) for value in values]
        if slopes:
            cells += [f"{slope(rows, values):.2f}", f"{slope(rows[-2:], values[-2:]):.2f}"]
        lines.append(_line([name, *cells]))
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _figures(
    sizes: Sequence[Size],
) -> list[tuple[str, Callable[[Size], float], Callable[[float], str]]]:
    time = "{:,.1f}".format
    commands = [name for name in sizes[0]["steps"] if name != "cohort: in process"]
    inside = {
        "cohort in process: read Gram rows and fit, ms": "read_and_fit_ms",
        "cohort in process: the same, of tables that are open, ms": "read_again_and_fit_ms",
        "cohort in process: fit, ms": "fit_ms",
        "cohort in process: five models × five folds, ms": "select_ms",
    }
    return [
        ("files", lambda s: s["files"], "{:,}".format),
        ("drives", lambda s: s["drives"], "{:,}".format),
        ("bytes a row", lambda s: s["size_bytes"] / s["rows"], "{:.2f}".format),
        ("**from nothing to a published model, s**", lambda s: seconds(s, FROM_NOTHING), time),
        ("the same, processor seconds", lambda s: processor_s(s, FROM_NOTHING), time),
        ("**a new day of 1 %, s**", lambda s: seconds(s, NEW_DAY), time),
        ("the same, processor seconds", lambda s: processor_s(s, NEW_DAY), time),
        *((f"{name}, s", lambda s, name=name: seconds(s, [name]), time) for name in commands),
        *(
            (name, lambda s, key=key: s["steps"]["cohort: in process"]["told"][key], time)
            for name, key in inside.items()
            if all(key in size["steps"]["cohort: in process"]["told"] for size in sizes)
        ),
        *(
            (f"peak of {name}, MiB", lambda s, name=name: _peak_mib(s, name), "{:,.0f}".format)
            for name in commands
        ),
    ]


def _peak_mib(size: Size, step: str) -> float:
    return float(size["steps"][step]["peak_bytes"]) / 2**20


def plot(sizes: Sequence[Size], file: Path) -> None:
    """Draw time and peak memory over rows, both logarithmic, with the slopes."""
    rows = [float(size["rows"]) for size in sizes]
    with mpl.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(8.6, 3.9), width_ratios=(3, 2))
        for name, (steps, colour) in DRAWN.items():
            values = [seconds(size, steps) for size in sizes]
            last = slope(rows[-2:], values[-2:]) if len(sizes) > 1 else math.nan
            left.loglog(
                rows,
                values,
                marker="o",
                markersize=3,
                color=PALETTE[colour].light,
                label=f"{name} ({last:.2f})",
            )
        left.loglog(
            rows,
            [1200 * n / 1e9 for n in rows],
            ":",
            color=PALETTE["muted"].light,
            label="20 min for 10⁹ rows",
        )
        left.set_xlabel("rows")
        left.set_title("time, s (slope between the two largest)")
        left.legend(frameon=False, fontsize=7, loc="upper left")
        names = {"simulate": "model_4", "gram": "model_3", "select": "model_2"}
        for step, colour in {**names, "forget a car": "unstable"}.items():
            values = [_peak_mib(size, step) for size in sizes]
            right.semilogx(
                rows, values, marker="o", markersize=3, color=PALETTE[colour].light, label=step
            )
        right.axhline(1024, linestyle=":", color=PALETTE["muted"].light, label="1 GiB")
        right.set_ylim(0, None)
        right.set_xlabel("rows")
        right.set_title("peak memory of the process, MiB")
        right.legend(frameon=False, fontsize=7, loc="center right")
        file.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(file, bbox_inches="tight", metadata=_dateless(file))
        plt.close(figure)


def _dateless(file: Path) -> dict[str, None]:
    """Return metadata without the date, so that the same figures give the same file."""
    return {"Date": None} if file.suffix == ".svg" else {}
