"""From nothing to a published model over any number of rows, and what a fleet does to it then.

    python -m benchmarks.billion --root FOLDER --rows 1e6 1e7 1e8 1e9 [--figures FILE]

Each step is a command in a process of its own, as a user would type it, so that its time has the
start of Python in it and its peak memory is its own. A size that was interrupted goes on where it
stopped; a step that was interrupted says so, since its time is then not the whole. Figures are
added to those that FILE already has, so that sizes can be run one by one; without --rows the table
is made of the figures that are there.
"""

import argparse
import json
import math
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import billion_campaigns as campaigns
from benchmarks.harness import insert
from benchmarks.usage import Usage, measured

COHORT = "adhesion < 0.8"
VEHICLE = "history-0003"
MODEL = "sideslip"
BYTES_PER_ROW = 10.6
SLACK_BYTES = 2 * 2**30
REWRITTEN_SHARE = 0.1
"""More than the share of the files that forgetting one of 300 cars writes again."""

PROGRAM = (str(Path(sys.executable).with_name("fleet-slip")),)


Size = dict[str, Any]

FROM_NOTHING = ("simulate", "gram", "select", "publish")
NEW_DAY = ("new day: simulate", "new day: gram", "new day: select")


@dataclass
class Steps:
    """The steps of one size, kept in a file so that they are not done twice."""

    file: Path
    done: dict[str, dict[str, Any]] = field(default_factory=dict)
    begun: list[str] = field(default_factory=list)

    @classmethod
    def load(cls, file: Path) -> "Steps":
        """Read what was done before, if anything."""
        if not file.exists():
            return cls(file)
        return cls(file, **json.loads(file.read_text("utf-8")))

    def do(self, name: str, work: Callable[[], tuple[Usage, dict[str, Any]]]) -> dict[str, Any]:
        """Return the figures of a step, doing it if that is still to be done."""
        if name not in self.done:
            interrupted = name in self.begun
            self.begun.append(name)
            self._save()
            usage, result = work()
            figures = asdict(usage)
            del figures["output"]
            self.done[name] = {**figures, "told": result, "interrupted": interrupted}
            self._save()
            print(
                f"  {name:<28} {usage.seconds:9.2f} s  {usage.cpu_s:9.2f} CPU-s "
                f"{usage.peak_bytes / 2**20:7.0f} MiB",
                flush=True,
            )
        return self.done[name]

    def _save(self) -> None:
        text = json.dumps({"done": self.done, "begun": self.begun}, indent=1)
        self.file.write_text(text, encoding="utf-8")


def fleet_slip(root: Path, *arguments: str) -> tuple[Usage, dict[str, Any]]:
    """Run a command of fleet-slip; return what it took and its JSON."""
    usage = measured([*PROGRAM, "--root", str(root), *arguments, "--json"])
    return usage, json.loads(usage.output)


def forgotten(root: Path) -> tuple[Usage, dict[str, Any]]:
    return fleet_slip(root, "forget", "--vehicle", VEHICLE, "--now")


def refitted(root: Path) -> tuple[Usage, dict[str, Any]]:
    usage = measured([sys.executable, "-m", "benchmarks.refit", str(root), COHORT])
    return usage, json.loads(usage.output)


def run_size(rows: int, folder: Path) -> dict[str, Any]:
    """Do every step at one size and return its figures."""
    folder.mkdir(parents=True, exist_ok=True)
    root = folder / "data"
    steps = Steps.load(folder / "steps.json")
    require_space(rows, folder, root)
    history, day = campaigns.history(rows), campaigns.new_day(rows)
    paths = {campaign.name: str(campaigns.write(campaign, folder)) for campaign in (history, day)}
    print(f"{rows:,} rows: {history.days} days of {history.drives_per_day} drives", flush=True)
    simulated = steps.do("simulate", lambda: fleet_slip(root, "simulate", paths["history"]))
    gram = steps.do("gram", lambda: fleet_slip(root, "gram"))
    predicate = "source <> 'scenario'"
    selected = steps.do("select", lambda: fleet_slip(root, "select", "--cohort", predicate))
    steps.do("publish", lambda: fleet_slip(root, "publish", MODEL))
    added = steps.do("new day: simulate", lambda: fleet_slip(root, "simulate", paths["new_day"]))
    steps.do("new day: gram", lambda: fleet_slip(root, "gram"))
    again = steps.do("new day: select", lambda: fleet_slip(root, "select"))
    steps.do("cohort: select", lambda: fleet_slip(root, "select", "--cohort", COHORT))
    steps.do("cohort: in process", lambda: refitted(root))
    steps.do("forget a car", lambda: forgotten(root))
    row_count = simulated["told"]["rows"]
    assert gram["told"]["rows_read"] == row_count == selected["told"]["rows"]
    assert again["told"]["rows"] == row_count + added["told"]["rows"]
    return {
        "rows": row_count,
        "new_rows": added["told"]["rows"],
        "days": history.days,
        "files": simulated["told"]["batches_written"],
        "drives": simulated["told"]["drives"],
        "size_bytes": simulated["told"]["size_bytes"],
        "steps": {name: _without_answer(name, step) for name, step in steps.done.items()},
        "machine": machine(),
    }


def _without_answer(name: str, step: dict[str, Any]) -> dict[str, Any]:
    """Return a step without what the command printed, unless that is what was measured."""
    return step if name == "cohort: in process" else {k: v for k, v in step.items() if k != "told"}


def require_space(rows: int, folder: Path, root: Path) -> None:
    """Exit if the disk cannot hold what is still to be written."""
    needed = BYTES_PER_ROW * rows * (1 + campaigns.NEW_SHARE + REWRITTEN_SHARE) + SLACK_BYTES
    present = sum(file.stat().st_size for file in root.rglob("*.parquet")) if root.is_dir() else 0
    free = shutil.disk_usage(folder).free + present
    if free < needed:
        sys.exit(
            f"{folder}: {rows:,} rows need {needed / 1e9:.1f} GB and {free / 1e9:.1f} GB are free. "
            "Choose another --root, or fewer --rows."
        )


def machine() -> dict[str, Any]:
    """Return what the figures were measured on."""
    return {
        "cores": len(os.sched_getaffinity(0)),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "python": platform.python_version(),
        "load_before": os.getloadavg()[0],
    }


def compile_kernels() -> None:
    """Run the smallest campaign once: what numba compiles then is kept for later processes."""
    with tempfile.TemporaryDirectory() as folder:
        usage, _ = fleet_slip(Path(folder), "simulate", "smoke")
    print(f"kernels ready in {usage.seconds:.1f} s", flush=True)


def read_figures(file: Path) -> dict[str, Any]:
    """Return the figures of earlier runs, by the number of rows asked for."""
    return dict(json.loads(file.read_text("utf-8"))) if file.exists() else {}


def run(sizes: Sequence[int], root: Path, file: Path, *, keep: bool) -> None:
    """Run sizes one after another, adding the figures of each to the file."""
    if sizes:
        compile_kernels()
    for rows in sizes:
        folder = root / f"rows-{rows}"
        figures = read_figures(file)
        figures[str(rows)] = run_size(rows, folder)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
        if not keep:
            shutil.rmtree(folder)


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--root", type=Path, default=Path("data-billion"), help="where to work")
    parser.add_argument("--rows", type=float, nargs="*", default=[], help="sizes to run, as 1e9")
    parser.add_argument("--figures", type=Path, help="JSON file of figures; default: below --root")
    parser.add_argument("--document", type=Path, help="a page to put the table into")
    parser.add_argument("--json", action="store_true", help="print the figures instead of a table")
    parser.add_argument("--keep", action="store_true", help="do not delete the data afterwards")
    options = parser.parse_args()
    file = options.figures or options.root / "figures.json"
    run([round(rows) for rows in options.rows], options.root, file, keep=options.keep)
    figures = read_figures(file)
    if not figures:
        sys.exit(f"{file}: no figures yet. Give sizes: --rows 1e6 1e7")
    sizes = [figures[key] for key in sorted(figures, key=int)]
    if options.document:
        insert(options.document, "billion", markdown(sizes))
    print(json.dumps(figures, indent=1) if options.json else markdown(sizes))


if __name__ == "__main__":
    main()
