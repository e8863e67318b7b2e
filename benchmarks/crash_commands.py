"""The commands that `benchmarks/crash.py` kills, what must be there before, and small inputs."""

import csv
import json
import math
import os
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from benchmarks.flips_root import write_short_lists
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.storage.commits import CHECKSUM_KEY, NOTE, checksum_of_actions
from fleet_slip.storage.folder import TEMPORARY_PREFIX
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse

SIMULATE = ("simulate", "{campaign}", "--threads", "1")
INGEST = ("ingest", "{measured}", "--mapping", "{mapping}")
REPLACE = ("ingest", "{measured}", "--mapping", "{corrected}", "--replace")
PUBLISH = ("publish", "sideslip")
LISTS = Path(__file__).parent / "lists"
WORSE = ("publish", "sideslip", "--force", "--models", str(LISTS / "ax.toml"))

MAPPING = """
name = "logger"
[time]
column = "t"
unit = "s"
split_gap_s = 1.0
longest_gap_s = 0.1
[drive]
day = 2024-05-01
vehicle_id = { column = "car" }
vehicle_model = "van"
[signals]
ax = { column = "ax", unit = "m/s^2" }
ay = { column = "ay", unit = "m/s^2" }
yaw_rate = { column = "r", unit = "rad/s" }
sideslip = { column = "beta", unit = "rad" }
"""


@dataclass(frozen=True)
class Command:
    """A command to kill.

    `arrange` changes the root after the commands before; `damaged` says that it leaves damage.
    """

    name: str
    before: tuple[tuple[str, ...], ...]
    arguments: tuple[str, ...]
    arrange: Callable[[Path], None] | None = None
    damaged: bool = False


def prepare_inputs(folder: Path) -> dict[str, str]:
    """Write a campaign of eight very short drives, a log with rows to refuse, and short lists."""
    write_short_lists(folder / "configs")
    text = SHIPPED_CONFIGS.find("campaigns", "smoke").read_text(encoding="utf-8")
    text = text.replace("laps = 0.5", "laps = 0.04").replace("15_000", "1_500")
    names = ("smoke.toml", "m.toml", "corrected.toml", "log.csv")
    campaign, mapping, corrected, measured = (folder / name for name in names)
    campaign.write_text(text, encoding="utf-8")
    mapping.write_text(MAPPING, encoding="utf-8")
    corrected.write_text(MAPPING.replace('unit = "rad" }', 'unit = "rad", negate = true }'))
    rng = random.Random(1)  # noqa: S311
    with measured.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "car", "ax", "ay", "r", "beta"])
        for car in ("car-1", "car-2"):
            for tick in range(400):
                ay = 3 * math.sin(tick / 50) + rng.gauss(0, 0.1)
                row = [rng.gauss(0, 1), "broken" if tick % 97 == 5 else ay, ay / 20, -ay / 200]
                writer.writerow([tick / 100, car, *row])
    paths = {"campaign": campaign, "mapping": mapping, "corrected": corrected, "measured": measured}
    return {name: str(path) for name, path in paths.items()}


def let_time_pass(root: Path) -> None:
    """Make all files old, and leave what killed jobs leave."""
    day = next((root / "logs").glob("day=*"))
    (day / f"{TEMPORARY_PREFIX}0.parquet").write_bytes(b"half a file")
    (day / "smoke-9999-uncommitted.parquet").write_bytes(b"written, never committed")
    for file in root.rglob("*"):
        if file.is_file() and "_delta_log" not in file.parts:
            os.utime(file, (0, 0))
    for log in root.glob("*/_delta_log/*.json"):
        log.write_text(_removed_long_ago(log.read_text(encoding="utf-8")), encoding="utf-8")


def _removed_long_ago(log: str) -> str:
    """Return a commit whose files were removed long ago, with the checksum that it then states."""
    actions = [json.loads(line) for line in log.splitlines()]
    for action in actions:
        if "remove" in action:
            action["remove"]["deletionTimestamp"] = 1
    for info in (
        action["commitInfo"] for action in actions if NOTE in action.get("commitInfo", ())
    ):
        note = json.loads(info[NOTE])
        stated = [action for action in actions if action.keys() & {"add", "remove", "txn"}]
        info[NOTE] = json.dumps({**note, CHECKSUM_KEY: checksum_of_actions(note, stated)})
    return "\n".join(map(json.dumps, actions))


def damage_files(root: Path) -> None:
    """Flip a bit in a Gram file."""
    file = Path(Warehouse(LocalFolder(root)).grams.snapshot().paths[-1])
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


LOGS = (SIMULATE, INGEST)
MODEL = (*LOGS, ("gram",), PUBLISH)
COMMANDS = (
    Command("simulate", (), SIMULATE),
    Command("ingest", (SIMULATE,), INGEST),
    Command("replace", (*LOGS, ("gram",)), REPLACE),
    Command("gram", LOGS, ("gram",)),
    Command("gram of features", (*LOGS, ("gram",)), ("gram", "--features", "all")),
    Command("select", (*LOGS, ("gram",)), ("select", "--json")),
    Command("publish", (*LOGS, ("gram",)), PUBLISH),
    Command("promote", (*MODEL, WORSE), ("promote", "sideslip@1")),
    Command("forget a vehicle", MODEL, ("forget", "--vehicle", "car-1", "--now")),
    Command("forget a drive", MODEL, ("forget", "--drive", "smoke-2024-05-01-0001")),
    Command("compact", MODEL, ("compact",)),
    Command("vacuum", (*MODEL, ("compact",)), ("compact",), let_time_pass),
    Command("repair", MODEL, ("verify", "--full", "--repair"), damage_files, damaged=True),
    Command("run", (), ("run", "--campaign", "{campaign}", "--threads", "1")),
)
