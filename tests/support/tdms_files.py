"""TDMS files."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from nptdms import ChannelObject, TdmsWriter

from tests.support import measured

START = datetime(2024, 5, 31, 12, tzinfo=UTC)


SIGNALS = {
    "ax": {"column": "ax", "unit": "m/s^2"},
    "sideslip": {"column": "beta", "unit": "deg", "longest_gap_s": 0.3},
}


def wave(step_s: float, **more: Any) -> dict[str, Any]:
    return {"wf_start_time": START.replace(tzinfo=None), "wf_increment": step_s, **more}


def write(file: Path, *segments: list[ChannelObject]) -> Path:
    with TdmsWriter(file) as writer:
        for channels in segments:
            writer.write_segment(channels)
    return file


def own_clock(**changes: Any) -> Any:
    return measured.own_clock(**{"signals": SIGNALS, **changes})
