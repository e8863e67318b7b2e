"""How fast logs with several time bases come in, and how much memory that takes, by format.

    python -m benchmarks.ingest_clocks [--rows 1000000,4000000] [--formats mdf,mcap,…]

Four time bases, at 50, 100, 100 and 250 Hz, with eleven noisy signals in drives of half an hour,
are written on the fly: as groups of an MDF file, topics of an MCAP file (CDR), messages of a CAN
trace (candump and BLF) and of an MDF file with bus logging, structs of MATLAB 5 and 7.3 files, and
as MDF files of ten minutes in a folder that is one log. A row is a sample of one base. Each is
ingested by a process of its own; rates are by the clock and of processor time. Memory is the peak
of the whole process, the temporary copy the largest size of the files without a name that it had
open. The slope is what each further second of the processor brings, and how much memory each
further million rows takes.
"""

import argparse
import tempfile
from pathlib import Path

from benchmarks.ingest import GOAL_MIB, measure
from benchmarks.logs_with_clocks import ROWS_PER_S, WRITERS, pieces, write_mapping

_INGEST = """
import os, threading
from fleet_slip.ingest.landing.ingest_job import ingest_files
from fleet_slip.ingest.mapping.mapping import load_mapping
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.warehouse.tables import Warehouse
mapping = load_mapping({mapping!r})
warehouse = Warehouse(LocalFolder(Path({root!r})))
list(ingest_files(warehouse, [Path({small!r})], mapping))
largest, done = 0, threading.Event()
def watch():
    global largest
    while not done.wait(0.05):
        size = 0
        for number in os.listdir("/proc/self/fd"):
            try:
                found = os.stat("/proc/self/fd/" + number)
            except OSError:
                continue
            size += found.st_size if found.st_nlink == 0 else 0
        largest = max(largest, size)
watcher = threading.Thread(target=watch)
watcher.start()
start = clocks()
(report,) = ingest_files(warehouse, [Path({file!r})], mapping)
done.set()
watcher.join()
assert report.new and report.counts.rows_kept == {rows}, report.counts
Path({copy!r}).write_text(str(largest))
"""


def take(kind: str, rows: int) -> tuple[float, float]:
    """Write a log, ingest it, print what it took; return processor seconds and peak MiB."""
    name, _, write = WRITERS[kind]
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        file, small, copy = folder / name, folder / f"small-{name}", folder / "copy"
        write(file, pieces(rows))
        write(small, pieces(20 * ROWS_PER_S, piece_s=5))
        known = {
            "file": str(file), "small": str(small), "root": str(folder / "root"),
            "mapping": str(write_mapping(folder, kind)), "copy": str(copy), "rows": rows,
        }  # fmt: skip
        seconds, processor_s, peak_mib = measure(_INGEST.format(**known))
        parts = file.iterdir() if file.is_dir() else [file]
        size_mib = sum(part.stat().st_size for part in parts) / 2**20
        met = "met" if peak_mib <= GOAL_MIB else "missed"
        print(
            f"{kind:8} {rows:13,} {rows / seconds / 1e6:14.2f} "
            f"{rows / processor_s / 1e6:14.2f} {peak_mib:6.0f} {size_mib:9.0f} "
            f"{int(copy.read_text()) / 2**20:9.0f}  {GOAL_MIB} MiB {met}",
            flush=True,
        )
    return processor_s, peak_mib


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", default="1000000,4000000", help="numbers of rows, with commas")
    parser.add_argument("--formats", default=",".join(WRITERS))
    given = parser.parse_args()
    sizes = sorted(int(rows) // ROWS_PER_S * ROWS_PER_S for rows in given.rows.split(","))
    print(
        f"{'format':8} {'rows':>13} {'million rows/s':>14} {'of processor':>14} {'MiB':>6} "
        f"{'file, MiB':>9} {'copy, MiB':>9}  goal"
    )
    for kind in given.formats.split(","):
        taken = [take(kind, rows) for rows in sizes]
        if len(sizes) > 1:
            more = (sizes[-1] - sizes[0]) / 1e6
            seconds, mib = (taken[-1][i] - taken[0][i] for i in (0, 1))
            print(
                f"{kind:8} {'slope':>13} {'':14} {more / seconds:14.2f} {mib / more:6.1f} a million"
            )


if __name__ == "__main__":
    main()
