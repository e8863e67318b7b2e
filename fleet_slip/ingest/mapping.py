"""The mapping of a measured log: which column is which signal, in which unit, with which sign."""

import os
import re
from collections import defaultdict
from collections.abc import Container, Iterable
from contextlib import suppress
from datetime import date
from pathlib import Path
from typing import Annotated, Any

import polars as pl
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PrivateAttr,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from fleet_slip.base import canonical_ascii, find_name_fault, normalize_name, quote_name
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.course import COURSE
from fleet_slip.catalog.signals import Identifier, SignalCatalog
from fleet_slip.config import (
    Config,
    Name,
    PositiveFloat,
    added,
    faults_of,
    load_config,
)
from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import (
    CHOOSE,
    WHEEL_PREFIX,
    OffsetM,
    RowCondition,
    SignalColumn,
    TimeBase,
    is_number,
    require_course_columns,
    split_components,
)
from fleet_slip.ingest.formats.file_formats import (
    CanBus,
    CsvFormat,
    FileFormats,
    PlainNumbers,
    read_can_database,
)
from fleet_slip.ingest.formats.source import describe_unknown
from fleet_slip.quality.drive_signals import OWN_SPEEDS, RADIUS_M
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.folder import Folder
from fleet_slip.vehicle.parameters import VehicleMeasures

FRONT_WHEELS = ("steer_fl", "steer_fr")
MAX_CONDITIONS = 64
"""Conditions of one mapping. Evaluating them takes more than linear time and memory."""


class LabelSensor(Config):
    """The sensor of side-slip: its place, and whether it measures velocities or the angle.

    In a turn, points before and behind the centre of gravity have other side-slip angles, so an
    optical sensor on the rear bumper measures another angle.
    """

    from_velocities: bool = False
    """Compute side-slip as arctan(vy / vx) of the sensor's velocities, `vx` and `vy`."""
    sensor_x_m: OffsetM = 0.0
    """Distance of the sensor before the centre of gravity, in m."""
    sensor_y_m: OffsetM = 0.0
    """Distance of the sensor to the left of the centre of gravity, in m."""

    @property
    def is_elsewhere(self) -> bool:
        """True if it is not at the centre of gravity."""
        return bool(self.sensor_x_m or self.sensor_y_m)

    def require_signals(self, signals: Container[str], label: str) -> None:
        """Raise `ValueError` for a mapping without the signals that the label is computed from."""
        if self.from_velocities and label in signals:
            raise ValueError(f"label: from_velocities computes {label}: remove its column")
        needed = ["vx", "vy"] if self.from_velocities else [label]
        needed += ["yaw_rate"] if self.is_elsewhere else []
        for name in needed:
            if name not in signals:
                raise ValueError(f"label: it needs the signal {name}")
        wheels = all(f"{WHEEL_PREFIX}{corner}" in signals for corner in ("fl", "fr", "rl", "rr"))
        if self.is_elsewhere and not wheels and not any(name in signals for name in OWN_SPEEDS):
            raise ValueError("label: moving it needs a speed: vx, vehicle_speed or four wheels")


# The metadata of drives, from the mapping, a column or the path.


class FromColumn(Config):
    """A drive's metadata in a column of the file. A new value begins a new drive."""

    column: Name


def _has_one_place(path: str) -> str:
    if path.count("{}") != 1:
        raise ValueError("write {} once, in place of the value: '{}/*' is the folder's name")
    return path


PathPattern = Annotated[Name, AfterValidator(_has_one_place)]


class FromPath(Config):
    """A drive's metadata in the path of its file, where the pattern has `{}`.

    `{}/*` is the name of the folder, `{}_*` the file's name up to its first underscore. Neither
    `{}` nor `*` reaches beyond a `/`.
    """

    path: PathPattern

    def find(self, file: Path) -> str:
        """Return the text of `{}` in a file's path. Raises `InputError` for another path."""
        if (match := self.match(file)) is None:
            raise InputError(
                f"{quote_name(file)}: the path does not end as in path = {self.path!r}."
            )
        return match[1]

    def match(self, file: Path) -> tuple[Path, str] | None:
        """Return the folder above the pattern, and the text at `{}`; None for another path."""
        depth, names = self.path.count("/") + 1, os.path.abspath(file).split("/")[1:]  # noqa: PTH100
        if len(names) < depth:
            return None
        wildcards = {"{}": "([^/]+?)", "*": "[^/]*"}
        texts = re.split(r"(\{\}|\*)", self.path)
        pattern = "".join(wildcards.get(text) or pl.escape_regex(text) for text in texts)
        end = re.sub("[\ud800-\udfff]", "\0", "/".join(names[-depth:]))  # bytes that are not UTF-8
        # Polars, unlike Python, matches in a time that is linear in the length of both.
        value = pl.Series([end]).str.extract(f"^{pattern}$")[0]
        return None if value is None else (Path("/", *names[:-depth]), value)


Elsewhere = FromColumn | FromPath


def _valid_name(text: str) -> str:
    name = normalize_name(text)
    if fault := find_name_fault(name):
        raise ValueError(fault)
    return name


DriveText = Annotated[str, AfterValidator(_valid_name)]
"""Name of a car, a track or another fact of a drive."""


class DriveMetadata(Config):
    """Metadata of drives: values, or their column or pattern of the path. Absent means null."""

    column: Name | None = None
    """Each value of this column is a separate drive."""
    day: date | Elsewhere | None = None
    """Date of the drive; with timestamps it may be left out and is that of the first row (UTC)."""
    vehicle_id: DriveText | Elsewhere
    vehicle_model: DriveText | Elsewhere
    track: DriveText | Elsewhere | None = None
    mass_kg: PositiveFloat | Elsewhere | None = None
    tyres: DriveText | Elsewhere | None = added(None)
    receiver: DriveText | Elsewhere | None = added(None)
    adhesion: PositiveFloat | Elsewhere | None = None

    @field_validator("day", mode="before")
    @classmethod
    def _day_is_set(cls, day: Any) -> Any:
        if day == CHOOSE:
            raise ValueError("is missing, and the time has no date: set a date, a column or a path")
        return day


class FilePattern(Config):
    """One of several files of a drive: those whose paths have equal texts at {}."""

    name: Annotated[str, Field(pattern=r"^[^/]+$", max_length=100)]
    """How its columns begin: `NAME/COLUMN`."""
    path: PathPattern
    """Pattern of the path, `{}_imu.csv`: `{}` is the name of the drive."""
    time: TimeBase | None = None
    """The column of its times, unless the file has a clock."""

    @model_validator(mode="after")
    def _is_pattern(self) -> "FilePattern":
        if self.time is not None and self.time.column is None:
            raise ValueError("time needs a 'column'")
        return self

    def find(self, file: Path) -> tuple[Path, str] | None:
        """Return the folder above the pattern, and the text at {}; None for another file."""
        return FromPath(path=self.path).match(file)


class Mapping(Config):
    """How one kind of measured file becomes drives.

    A mapping is validated with the signals of a catalog as context, and keeps them.
    """

    _signal_catalog: SignalCatalog = PrivateAttr()
    name: Identifier
    missing: tuple[str, ...] = ()
    """Texts that mean "no value", in addition to the empty one; `nan` includes NaN."""
    csv: CsvFormat = CsvFormat()
    file: tuple[FilePattern, ...] = added(())
    """Patterns of the files of a drive, if it has several."""
    can: CanBus | None = added(None)
    time: TimeBase
    drive: DriveMetadata
    signals: Annotated[
        dict[str, SignalColumn], BeforeValidator(split_components), Field(min_length=1)
    ]
    label: LabelSensor | None = added(None)
    """Position of the label's sensor, which may measure two velocities instead of an angle."""
    vehicle: VehicleMeasures | None = added(None)
    """Measured data of the car, for a filter beside the model: `fleet-slip learn`."""
    where: tuple[RowCondition, ...] = added((), max_length=MAX_CONDITIONS)
    """Conditions on rows, as tables. A row that misses one is skipped and counted."""

    @field_validator("where", mode="before")
    @classmethod
    def _is_no_text(cls, where: Any) -> Any:
        if isinstance(where, str | dict):
            example = '[{ column = "fix", one_of = ["4", "5"] }]'
            raise ValueError(f"write it as tables: {example}")  # noqa: TRY004 - as of pydantic
        return where

    @model_validator(mode="before")
    @classmethod
    def _asks_for_the_day(cls, content: Any) -> Any:
        """Mark a missing day, so that it is refused together with other missing keys."""
        with suppress(AttributeError, KeyError, TypeError, ValidationError):
            drive, time = content["drive"], TimeBase.model_validate(content.get("time", {}))
            if drive.get("day") is None and not time.is_dated:
                return {**content, "drive": {**drive, "day": CHOOSE}}
        return content

    @model_validator(mode="after")
    def _consistent(self, info: ValidationInfo) -> "Mapping":
        if not isinstance(info.context, SignalCatalog):
            raise TypeError("a mapping is validated with a SignalCatalog as context")
        self._signal_catalog, signals = info.context, info.context.signals
        for name in ("tyres", "receiver"):
            if getattr(self.drive, name) is not None and name not in info.context.drive:
                raise ValueError(
                    f"drive.{name}: the catalog has no such drive column. Copy it from the shipped "
                    "one: configs/signals.toml"
                )
        for name, column in self.signals.items():
            if name not in signals:
                raise ValueError(describe_unknown(name, signals))
            try:
                column.require_unit_of(name, signals[name].unit)
            except ValueError as error:
                raise ValueError(f"signals.{name}: {column.column} {error}") from None
        require_course_columns(self.signals)
        if self.label is not None:
            self.label.require_signals(self.signals, self._signal_catalog.label)
        if self.file and not self.time.own_clock:
            raise ValueError("file: set own_clock = true under [time]; each file has its own times")
        for name, signal in self.signals.items():
            if signal.time is not None and self.time.column is None:
                raise ValueError(f"signals.{name}: 'time' needs [time] with a 'column'")
        return self

    def __hash__(self) -> int:
        """Return the hash of the mapping's identity."""
        return hash(self.canonical_json())

    @property
    def signal_catalog(self) -> SignalCatalog:
        """The signals and drive columns that it was validated against."""
        return self._signal_catalog

    def for_file(self, file: Path) -> "Mapping":
        """Return the mapping with the metadata of a file's path. Raises `InputError`."""
        stated = {name: getattr(self.drive, name) for name in DriveMetadata.model_fields}
        from_path = {
            name: item.find(file) for name, item in stated.items() if isinstance(item, FromPath)
        }
        if not from_path:
            return self
        try:
            drive = DriveMetadata.model_validate(
                {**stated, **from_path}, context=self._signal_catalog
            )
        except ValidationError as error:
            raise InputError(f"{quote_name(file)}: drive: {faults_of(error)}") from None
        return self.model_copy(update={"drive": drive})

    def time_bases(self) -> dict[str | None, list[str]]:
        """Return the columns that the mapping uses, each once, by the column of their times."""
        with_own_time = {
            s.column for s in self.signals.values() if s.time not in {None, self.time.column}
        }
        common = [name for name in self.common_columns() if name not in with_own_time]
        bases = {self.time.column: [self.time.column, *common]}
        for signal in self.signals.values():
            time = self.time.column if signal.time is None else signal.time
            bases.setdefault(time, [time]).append(signal.column)
        return {
            time: list(dict.fromkeys(name for name in names if name is not None))
            for time, names in bases.items()
        }

    @property
    def columns(self) -> set[str]:
        """All columns that the mapping uses."""
        return {name for names in self.time_bases().values() for name in names}

    def common_columns(self) -> list[str]:
        """Return the columns that apply to all signals: metadata of drives, and conditions."""
        metadata = (getattr(self.drive, name) for name in DriveMetadata.model_fields)
        names = [self.drive.column]
        names += [source.column for source in metadata if isinstance(source, FromColumn)]
        names += [self.time.date.column] if self.time.date else []
        names += [condition.column for condition in self.where]
        names += [signal.sign.column for signal in self.signals.values() if signal.sign]
        return list(dict.fromkeys(name for name in names if name is not None))

    @property
    def signal_names(self) -> tuple[str, ...]:
        """All signals of drives, including those that are computed from other signals."""
        derived = self.label is not None and self.label.from_velocities
        label = [self._signal_catalog.label] if derived else []
        return (*self.signals, *label, *self.front_wheels)

    @property
    def front_wheels(self) -> tuple[str, ...]:
        """The signals that are copies of one angle of both front wheels."""
        alone = "steer" in self.signals and not set(FRONT_WHEELS) & set(self.signals)
        return tuple(
            name for name in FRONT_WHEELS if alone and name in self._signal_catalog.signals
        )

    @property
    def member_times(self) -> dict[str, TimeBase]:
        """The times of each of several files of a drive, by name."""
        return {file.name: file.time for file in self.file if file.time is not None}

    @property
    def formats(self) -> FileFormats:
        """The parameters to open a file."""
        zone = self.time.zone if self.time.own_clock else None
        numbers = self._compared_numbers
        return FileFormats(self.csv, self.can, self.name, self._plain_numbers, zone, numbers)

    @property
    def _compared_numbers(self) -> dict[str, frozenset[str]]:
        """Numbers of `one_of` as text, by column that conditions compare only with numbers."""
        texts = defaultdict[str, set[str]](set)
        for condition in self.where:
            texts[condition.column].update(condition.one_of)
        return {column: frozenset(t) for column, t in texts.items() if all(map(is_number, t))}

    @property
    def _plain_numbers(self) -> PlainNumbers:
        """Columns that are used only as numbers, so that they need not be read as text."""
        if len(self.time_bases()) > 1:
            return PlainNumbers()
        numbers = {signal.column for signal in self.signals.values()}
        if self.time.column is not None and self.time.unit is not None:
            numbers.add(self.time.column)
        columns = frozenset(numbers - set(self.common_columns()))
        return PlainNumbers(columns, tuple(float(text) for text in self.missing if is_number(text)))

    def canonical_json(self) -> str:
        """Return JSON of the mapping that does not depend on the layout of its TOML file."""
        return canonical_ascii(self.model_dump(mode="json", exclude={"vehicle"}))


def load_mapping(name_or_path: str, catalog: Catalog) -> Mapping:
    """Load a mapping by name from `configs/mappings`, or by path. Raises `ConfigError`."""
    file = catalog.configs.find("mappings", name_or_path)
    mapping = load_config(file, Mapping, catalog.signals)
    if mapping.can is not None:
        database = read_can_database(mapping.can, Path(str(file)).parent)
        mapping = mapping.model_copy(update={"can": database})
    return mapping


# Assumed values for keys that a mapping does not state: shown with every model of its logs. A
# data root keeps it by the name of the mapping, which is the column `campaign` of its drives.

ASSUMPTIONS = "assumptions"


NO_WHEEL_SPEEDS = (
    "no wheel speeds, so that curvature is left out; a speed of the car may replace them "
    "(docs/real-data.md)"
)
ONE_SPEED = "one speed of the car replaces the wheel speeds, which thus contain no slip"


def assumptions_of(mapping: Mapping) -> tuple[str, ...]:
    """Return the assumed values of keys that a mapping does not state, by key."""
    signals, time, sensor = mapping.signals, mapping.time, mapping.label
    wheels = {
        name: signal.radius_m for name, signal in signals.items() if name.startswith(WHEEL_PREFIX)
    }
    label, course = signals.get(mapping.signal_catalog.label), signals.get(COURSE)
    labelled = mapping.signal_catalog.label in mapping.signal_names
    moved = sensor is not None and sensor.is_elsewhere
    naive = time.format is not None and "%z" not in time.format and time.is_dated
    texts = {
        f"wheel radius {RADIUS_M} m, the nominal one (radius_m)": RADIUS_M in wheels.values()
        or (moved and None in wheels.values()),
        f"{time.rate_hz} rows a second (time.rate_hz)": time.assumed,
        "times are UTC (time.zone)": naive and time.zone is None,
        "side-slip sensor at the centre of gravity (label)": labelled and not moved,
        "sideslip is not delayed (delay_s)": label is not None and not label.delay_s,
        "antenna at the centre of gravity (antenna_x_m, antenna_y_m)": course is not None
        and not (course.antenna_x_m or course.antenna_y_m),
        "both front wheels steer alike (steer_fl, steer_fr)": mapping.front_wheels,
        NO_WHEEL_SPEEDS: not wheels and any(name in signals for name in OWN_SPEEDS),
        ONE_SPEED: len(wheels) > 1 and len({signals[name].column for name in wheels}) == 1,
    }
    return tuple(text for text, is_assumed in texts.items() if is_assumed)


def store_assumptions(root: Folder, mapping: Mapping) -> None:
    """Store the assumptions of a mapping, unless the newest entry is equal."""
    folder, assumed = DocumentFolder(root, f"{ASSUMPTIONS}/{mapping.name}"), assumptions_of(mapping)
    if assumed != _newest(folder):
        folder.append({"assumed": assumed})


def stored_assumptions(root: Folder, mappings: Iterable[str]) -> tuple[str, ...]:
    """Return the assumptions of the mappings of some drives. Raises `StorageError`."""
    folders = (DocumentFolder(root, f"{ASSUMPTIONS}/{name}") for name in sorted(mappings))
    return tuple(dict.fromkeys(text for folder in folders for text in _newest(folder)))


def _newest(folder: DocumentFolder) -> tuple[str, ...]:
    numbers = folder.numbers()
    return tuple(folder.read(max(numbers)).content["assumed"]) if numbers else ()
