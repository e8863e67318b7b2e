"""Programs side by side: the coefficients of one model from the same log files.

    pip install --group peers -c constraints.txt
    python -m benchmarks.peers [--root DATA] [--campaign waterford] [--only spark lstsq]
        [--plot docs/images/peers.svg]

The model is the last one of Table I, on a campaign, which is simulated into the data root
first if it is not there (a temporary one by default). Each program runs in a process of its
own: twice on two threads, of which the faster counts, and once more on one thread with the files in
reverse order. Digits are of the worst coefficient, against the exact rational solution. A program
that is not installed is skipped.
"""

import argparse
import importlib.util
import json
import math
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pyarrow.parquet as pq
from matplotlib.figure import Figure

from benchmarks.harness import add_options, simulated
from benchmarks.peer_ways import COLUMNS, INPUTS, LABEL, WAYS, thread_variables
from fleet_slip.pages.page import PALETTE, STYLE
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import LinearModel, fit
from tests.support.catalog import CATALOG

MOST_DIGITS = 16.0
"""A coefficient that is the exact one, rounded once."""


@dataclass(frozen=True)
class Result:
    """The result of a program: coefficients, time and memory."""

    name: str
    rows_per_s: float
    rows_per_processor_s: float | None
    peak_bytes: int
    digits: float
    same_bits: bool


def exact_model(paths: Sequence[str]) -> LinearModel:
    """Return the exact solution in counts, from sums that no SQL has made."""
    total = Gram.zero(COLUMNS)
    for path in paths:
        rows = pq.read_table(path, columns=COLUMNS, partitioning=None)
        counts = np.column_stack([rows[name].to_numpy().astype(np.int64) for name in COLUMNS])
        total += Gram.from_counts(COLUMNS, counts)
    return fit(total, INPUTS, LABEL).model


def digits(coefficients: Sequence[float], model: LinearModel) -> float:
    """Return the correct decimal digits of the worst of the coefficients and the intercept."""
    exact = [*model.coefficients, model.intercept]
    worst = max(
        Fraction(0) if value == float(truth) else abs(Fraction(value) / truth - 1)
        for value, truth in zip(coefficients, exact, strict=True)
    )
    return min(MOST_DIGITS, -math.log10(worst)) if worst else MOST_DIGITS


def in_process(way: str, threads: int, runs: int, paths: Sequence[str]) -> dict[str, Any]:
    """Run a way in a process of its own. Raises `CalledProcessError`."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.peer_ways", way, str(threads), str(runs), *paths],
        env=os.environ | thread_variables(threads),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        check=True,
    )
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def measure(way: str, paths: Sequence[str], rows: int, exact: LinearModel) -> Result:
    """Run a way three times and compare."""
    result = in_process(way, 2, 2, paths)
    other = in_process(way, 1, 1, paths[::-1])
    results = [*result["coefficients"], *other["coefficients"]]
    truth = exact.physical(CATALOG.input_scales) if WAYS[way].physical else exact
    return Result(
        WAYS[way].name,
        rows / result["s"],
        # The memory of a Java machine is not that of this process.
        None if way == "spark" else rows / min(result["processor_s"], other["processor_s"]),
        result["peak_bytes"],
        min(digits(coefficients, truth) for coefficients in results),
        all(coefficients == results[0] for coefficients in results),
    )


def row_of(result: Result) -> str:
    """Return a row of the table."""
    processor = result.rows_per_processor_s
    rate = "" if processor is None else f"{processor / 1e6:.2f}"
    return (
        f"| {result.name} | {result.rows_per_s / 1e6:.2f} | {rate} | "
        f"{result.peak_bytes / 2**20:,.0f} | "
        f"{result.digits:.1f} | {'yes' if result.same_bits else 'no'} |"
    )


def draw(results: Sequence[Result], path: Path) -> None:
    """Draw rates and memory as bars; those that give the same bits each time are filled."""
    ordered = sorted(results, key=lambda result: result.rows_per_s)
    panels = (
        ("million rows/s", [result.rows_per_s / 1e6 for result in ordered], "{:.2g}"),
        ("peak memory, MiB", [result.peak_bytes / 2**20 for result in ordered], "{:,.0f}"),
        ("correct digits", [result.digits for result in ordered], "{:.1f}"),
    )
    with mpl.rc_context({**STYLE, "svg.hashsalt": "peers"}):
        figure = Figure(figsize=(9.0, 0.34 * len(ordered) + 0.9), layout="constrained")
        axes = figure.subplots(1, len(panels), sharey=True)
        colours = [PALETTE["model_4" if entry.same_bits else "above_1"].light for entry in ordered]
        for axis, (title, values, form) in zip(axes, panels, strict=True):
            bars = axis.barh([result.name for result in ordered], values, color=colours)
            axis.bar_label(bars, [form.format(value) for value in values], padding=3)
            axis.set_title(title)
            axis.set_xlim(0, max(values) * 1.25)
            axis.xaxis.set_visible(False)
            axis.spines[["top", "right", "bottom"]].set_visible(False)
        figure.supxlabel(
            "blue: the same bits from two threads and one, files in either order; orange: not",
            fontsize=8,
        )
        figure.savefig(path, metadata={"Date": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add_options(parser)
    parser.add_argument("--only", nargs="+", choices=list(WAYS), default=list(WAYS))
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args()
    with simulated(options) as warehouse:
        logs = warehouse.logs.snapshot()
        exact = exact_model(logs.paths)
        print("| program | million rows/s | of a processor | peak MiB | digits | same bits |")
        print("| --- | ---: | ---: | ---: | ---: | --- |", flush=True)
        results = []
        for way in options.only:
            package = WAYS[way].package
            if package and importlib.util.find_spec(package) is None:
                print(f"| {WAYS[way].name} | not installed: pip install --group peers | | | | |")
                continue
            results.append(measure(way, logs.paths, logs.rows, exact))
            print(row_of(results[-1]), flush=True)
        if options.plot:
            draw(results, options.plot)


if __name__ == "__main__":
    main()
