"""What a mapping leaves open, and which value stands for it: said beside every model of its logs.

A data root keeps it by the name of the mapping, which is the column `campaign` of its drives.
"""

from collections.abc import Iterable

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.ingest.columns import COURSE, WHEELS
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.resampling import RADIUS_M
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.folder import Folder

FOLDER = "assumptions"


def assumptions_of(mapping: Mapping) -> tuple[str, ...]:
    """Return what stands for whatever a mapping does not say, each with the key that says it."""
    signals, time, sensor = mapping.signals, mapping.time, mapping.label
    wheels = {name: one.radius_m for name, one in signals.items() if name.startswith(WHEELS)}
    label, course = signals.get(catalogue().label), signals.get(COURSE)
    labelled = catalogue().label in mapping.signal_names
    moved = sensor is not None and sensor.is_elsewhere
    unknown_radius = RADIUS_M in wheels.values() or (moved and None in wheels.values())
    naive = time.format is not None and "%z" not in time.format and time.is_dated
    return tuple(
        text
        for assumed, text in (
            (unknown_radius, f"wheel radius {RADIUS_M} m, the nominal one (radius_m)"),
            (time.assumed, f"{time.rate_hz} rows a second (time.rate_hz)"),
            (naive and time.zone is None, "times are UTC (time.zone)"),
            (labelled and not moved, "side-slip sensor at the centre of gravity (label)"),
            (label is not None and not label.delay_s, "sideslip is not delayed (delay_s)"),
            (
                course is not None and not (course.antenna_x_m or course.antenna_y_m),
                "antenna at the centre of gravity (antenna_x_m, antenna_y_m)",
            ),
            (mapping.front_wheels, "both front wheels steer alike (steer_fl, steer_fr)"),
        )
        if assumed
    )


def keep_assumptions(root: Folder, mapping: Mapping) -> None:
    """Write down what a mapping of drives leaves open, unless it was the same before."""
    kept, found = DocumentFolder(root / FOLDER / mapping.name), assumptions_of(mapping)
    if found != _newest(kept):
        kept.append({"assumed": found})


def kept_assumptions(root: Folder, mappings: Iterable[str]) -> tuple[str, ...]:
    """Return what the mappings of some drives leave open. Raises `StorageError`."""
    folders = (DocumentFolder(root / FOLDER / name) for name in sorted(mappings))
    return tuple(dict.fromkeys(text for folder in folders for text in _newest(folder)))


def _newest(folder: DocumentFolder) -> tuple[str, ...]:
    numbers = folder.numbers()
    return tuple(folder.read(max(numbers)).content["assumed"]) if numbers else ()
