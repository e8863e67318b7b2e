"""Model versions, immutable and numbered, and aliases with their history.

models/<name>/versions/1.json, 2.json, ...     manifests of published versions
models/<name>/versions/drives-SHA256.bin       training drives of a version, as salted hashes
models/<name>/history/1.json, 2.json, ...      moves of aliases, with their times
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from textwrap import shorten
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, overload

from pydantic import Field

from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.signals import IDENTIFIER_PATTERN, Identifier
from fleet_slip.config import Config, parse_document
from fleet_slip.errors import QuestionError, RefusedError, StorageError
from fleet_slip.models.manifest import Manifest, TrainedDrives, checksum_of_drives
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.storage.documents import MAX_DIGITS, DocumentFolder
from fleet_slip.storage.folder import Folder

if TYPE_CHECKING:
    import polars as pl
    import pyarrow as pa
    from numpy import float64
    from numpy.typing import ArrayLike, NDArray

    from fleet_slip.models.predict import Predictor
    from fleet_slip.warehouse.warehouse import Warehouse


# Aliases of a model, and the history of their moves.
#
# Moves are numbered without gaps. If two processes decide at the same time, one decides again.

FOLDER = "models"

CHAMPION = "champion"
"""The alias of the version in use."""

CANDIDATE = "candidate"
"""The alias of the version that waits for `promote`."""

Command = Literal["publish", "promote", "rollback", "pin", "unpin"]

HOLDING: frozenset[Command] = frozenset({"rollback", "pin"})
"""After these commands no publication moves the alias, until `promote` or `unpin`."""

T = TypeVar("T")


class AliasMove(Config):
    """Entry of the history: since `at` an alias points at a version."""

    alias: Identifier
    version: Annotated[int, Field(ge=1, lt=10**MAX_DIGITS)]
    command: Command
    at: datetime
    best: int | None = None
    """Written by development versions; ignored."""


@dataclass(frozen=True)
class AliasHistory:
    """All moves of one model's aliases."""

    documents: DocumentFolder

    def moves(self) -> list[AliasMove]:
        """Return all moves, oldest first."""
        return list(self.latest_moves())[::-1]

    def latest_moves(self) -> Iterator[AliasMove]:
        """Yield the moves, newest first. Reads each move when it is needed."""
        for number in reversed(self.documents.numbers()):
            document = self.documents.read(number)
            file = self.documents.file(number)
            yield parse_document(document.content, AliasMove, file, "this move of an alias")

    def pointed_at(self, alias: str) -> int | None:
        """Return the version that an alias points at, or None."""
        return next((move.version for move in self.latest_moves() if move.alias == alias), None)

    def previous_version(self, alias: str) -> int | None:
        """Return the version that an alias pointed at before, or None.

        Rolled back versions do not count: two rollbacks go back two versions.
        """
        trail: list[int] = []
        for move in self.moves():
            if move.alias != alias or move.command in ("pin", "unpin"):
                continue
            if move.command == "rollback":
                trail = trail[:-1]
            elif trail[-1:] != [move.version]:
                trail.append(move.version)
        return trail[-2] if len(trail) > 1 else None

    def published_at(self, version: int) -> datetime | None:
        """Return when a version was published last; None if unknown."""
        moves = self.latest_moves()
        published = (m.at for m in moves if m.version == version and m.command == "publish")
        return next(published, None)

    def held_by(self, alias: str) -> AliasMove | None:
        """Return the move that prevents publications from moving an alias; None without one."""
        moves = (move for move in self.latest_moves() if move.alias == alias)
        last = next((move for move in moves if move.command != "publish"), None)
        return last if last is not None and last.command in HOLDING else None

    def aliases(self) -> dict[str, int]:
        """Return each alias and the version that it points at."""
        return {move.alias: move.version for move in self.moves()}

    def decide(self, decision: Callable[[int], T | None]) -> T:
        """Return the result of a decision; repeat it while the result is None.

        The decision receives the number of the newest move and passes it to `move`. It must not
        read the history earlier. Raises `ConflictError` after many attempts.
        """
        return self.documents.after_newest(decision)

    def move(self, alias: str, version: int, command: Command, *, after: int) -> bool:
        """Point an alias at a version; return False if there are moves after the number `after`."""
        now = datetime.now(UTC)
        move = AliasMove(alias=alias, version=version, command=command, at=now)
        content = move.model_dump(mode="json", exclude_none=True)
        return self.documents.create(after + 1, content) is not None


# One published version of a model, which estimates angles from data frames.


@dataclass(frozen=True)
class ModelVersion(Answer):
    """A manifest with its number, its verified checksum, and the catalog of its data root."""

    version: int
    manifest: Manifest
    sha256: str
    catalog: Catalog = field(repr=False, compare=False)

    def __repr__(self) -> str:
        figures = self.manifest.cross_validation
        return (
            f"<{type(self).__name__} {self.reference}: {len(self.manifest.terms)} signals, RMSE "
            f"{figures.rmse_deg:.4f} deg, correlation {figures.correlation:.4f}>"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return number, checksum and manifest."""
        content = self.manifest.model_dump(mode="json")
        return {"version": self.version, "sha256": self.sha256, **content}

    def parts(self, everything: bool = False, on_board: str = "") -> Iterator[Part]:
        """Render figures, training data and coefficients; `on_board` are the costs in a car."""
        manifest = self.manifest
        label, origin = manifest.label, manifest.through_origin
        yield (
            f"{self.reference}: {'line' if manifest.line_remark else label.column} = "
            f"{'' if origin else 'intercept + '}"
            f"sum of coefficient * signal{', through the origin' if origin else ''}"
        )
        properties = manifest.properties(on_board)
        if everything:
            properties["sha256"] = self.sha256
        yield TextTable("", "|", properties.items(), text_columns=2)
        form = repr if everything else "{:.6g}".format
        rows = [] if origin else [("intercept", label.unit, form(manifest.intercept), "")]
        for term in manifest.terms:
            per_count = f"{float(term.coefficient_exact * term.scale_exact):.9g}"
            rows.append((term.column, term.unit, form(term.coefficient), per_count))
        if not everything:
            short = [row[:3] for row in rows]
            yield TextTable("", "signal|unit|coefficient", short, text_columns=2)
            return
        yield TextTable("", "signal|unit|coefficient|per count", rows, text_columns=2)
        yield "per count: coefficient times scale, for an ECU that works on raw counts"

    @property
    def reference(self) -> str:
        """Reference on the command line: `NAME@VERSION`."""
        return f"{self.manifest.name}@{self.version}"

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns in SI units that `predict` needs, named as in the view `log`."""
        return self.manifest.estimate.columns(self.catalog.signals)

    @overload
    def predict(self, frame: "pl.DataFrame") -> "pl.Series": ...
    @overload
    def predict(
        self, frame: "Mapping[str, ArrayLike | Sequence[float | None]]"
    ) -> "NDArray[float64]": ...
    @overload
    def predict(self, frame: Any) -> Any: ...
    def predict(self, frame: Any) -> Any:
        """Estimate the side-slip angle in rad for each row of a frame.

        The frame has the columns of `columns` in SI units, as in the view `log`; other columns are
        ignored. Signals are rounded to counts, half to even, as in the sensors, and are missing
        beyond their valid range. On the rows of the logs the angles are bit for bit those of
        `score`.

        | frame | returned, one float64 for each row | no angle |
        | --- | --- | --- |
        | `polars.DataFrame` | `polars.Series` | null |
        | `pandas.DataFrame` | `pandas.Series` with its index | NaN |
        | `pyarrow.RecordBatch` | `pyarrow.Array` | null |
        | `pyarrow.Table`, a DuckDB relation, any Arrow stream | `pyarrow.ChunkedArray` | null |
        | mapping of names to arrays of shape (rows,) | `numpy.ndarray` of shape (rows,) | NaN |

        A model with windows uses earlier rows of the same drive: the columns `drive_id` and `tick`
        or `time_s` define them. Without these columns the rows are consecutive ticks of one drive.

        There is no angle where an input is null or NaN, or a feature has no value, such as a
        curvature at standstill.

        Raises `InputError` for a column that is missing, repeated, not numeric, infinite, or of
        another length than the others.
        """
        from fleet_slip.models.predict import predict  # noqa: PLC0415 - DuckDB, not for show

        return predict(self.catalog.signals, self.manifest, frame, self._predictor)

    @cached_property
    def _predictor(self) -> "Predictor":
        from fleet_slip.models.predict import Predictor  # noqa: PLC0415 - numba, not for show

        return Predictor.from_manifest(self.catalog.signals, self.manifest)


_IDENTIFIER = re.compile(IDENTIFIER_PATTERN)


@dataclass(frozen=True)
class Registry:
    """All models of a data root, and the catalog of their columns."""

    root: Folder
    catalog: Catalog

    @classmethod
    def open(cls, warehouse: "Warehouse") -> "Registry":
        """Return the registry of a data root."""
        return cls(warehouse.root, warehouse.catalog)

    @property
    def folder(self) -> Folder:
        """The folder of all models."""
        return self.root / FOLDER

    def names(self) -> list[str]:
        """Return the names of all models, sorted."""
        return [
            name
            for name in self.folder.names()
            if _IDENTIFIER.fullmatch(name) and (self.folder / name / "versions").exists()
        ]

    def require(self, name: str) -> None:
        """Raise `QuestionError` if there is no model of this name."""
        if name not in self.names():
            raise QuestionError(f"no model is called {name!r}. Models: {self._listed_names}.")

    @property
    def _listed_names(self) -> str:
        none = f"none in {self.folder} yet; publish one with: fleet-slip publish NAME"
        return ", ".join(self.names()) or none

    def versions(self, name: str) -> list[int]:
        """Return the version numbers of a model, ascending."""
        return self.versions_of(name).numbers()

    def load(self, name: str, version: int) -> ModelVersion:
        """Return a version. Raises `StorageError` if it was changed."""
        if not _IDENTIFIER.fullmatch(name):
            self.require(name)
        try:
            document = self.versions_of(name).read(version)
        except StorageError:
            # Listed only after an error: a model may have very many versions.
            self.require(name)
            numbers = self.versions(name)
            if version in numbers:
                raise
            raise _unknown(name, str(version), numbers) from None
        manifest = parse_document(
            document.content,
            Manifest,
            f"{name}@{version}",
            "its manifest",
            self.catalog.signals,
        )
        if manifest.name != name:
            raise StorageError(
                f"{name}@{version}: its manifest names the model {manifest.name}. Restore the "
                "file from a backup, or publish again."
            )
        return ModelVersion(version, manifest, document.sha256, self.catalog)

    def only_name(self, alternatives: str = "") -> str:
        """Return the name of the only model. Raises `QuestionError` if there is not one."""
        names = self.names()
        if len(names) != 1:
            raise QuestionError(
                f"name a published model{alternatives}. Models: {self._listed_names}."
            )
        return names[0]

    def resolve(self, reference: str | None) -> ModelVersion:
        """Return the version of a reference; None: of the only model. Raises `QuestionError`."""
        name, _, label = (reference or self.only_name()).partition("@")
        self.require(name)
        label = label or CHAMPION
        if label.isascii() and label.isdigit() and len(label) <= MAX_DIGITS:
            return self.load(name, int(label))
        history = self.history(name)
        version = history.pointed_at(label)
        if version is None:
            raise _unknown(name, label, [*self.versions(name), *sorted(history.aliases())])
        return self.load(name, version)

    def champion(self, name: str) -> ModelVersion | None:
        """Return the version in use, or None before the first."""
        version = self.history(name).pointed_at(CHAMPION)
        return None if version is None else self.load(name, version)

    def history(self, name: str) -> AliasHistory:
        """Return the moves of a model's aliases."""
        return AliasHistory(DocumentFolder(self.root, f"{FOLDER}/{name}/history"))

    def trained_drives(self, manifest: Manifest) -> TrainedDrives:
        """Return the training drives of a version. Raises `StorageError`."""
        expected = manifest.trained_on.drives_sha256
        folder, file = self.versions_of(manifest.name).folder, f"drives-{expected}.bin"
        content = folder.read(file)
        if checksum_of_drives(content) != expected:
            raise StorageError(
                f"{folder}/{file}: its bytes do not match the checksum in its name. Restore the "
                "file from a backup."
            )
        return TrainedDrives.from_content(manifest.name, content)

    def add(self, manifest: Manifest, drives: bytes) -> ModelVersion:
        """Store a manifest as the next version of its model, after the hashes of its `drives`.

        Returns the latest version instead if it is the same estimator from the same rows: another
        process has added it.
        """
        name, versions = manifest.name, self.versions_of(manifest.name)
        versions.folder.create(f"drives-{checksum_of_drives(drives)}.bin", drives)

        def next_version(latest: int) -> int | None:
            if latest in versions.numbers() and self.load(name, latest).manifest.same_estimator(
                manifest
            ):
                return latest
            document = versions.create(latest + 1, manifest.model_dump(mode="json"))
            return document.number if document else None

        return self.load(name, versions.after_newest(next_version))

    def promote(self, name: str, version: int, alias: str) -> None:
        """Point an alias at a version. Raises `QuestionError` for an unknown version.

        Adds no move if the alias points there already, unless this ends a hold. So one `rollback`
        also undoes a repeated command.
        """
        self.load(name, version)

        def target(history: AliasHistory) -> int | None:
            is_there = history.pointed_at(alias) == version
            return None if is_there and not history.held_by(alias) else version

        self._move(name, alias, "promote", target)

    def hold(self, name: str, alias: str, command: Literal["pin", "unpin"]) -> int:
        """Pin or unpin an alias; return its version. Raises `QuestionError` if there is none."""
        version = self.resolve(f"{name}@{alias}").version

        def target(history: AliasHistory) -> int | None:
            return None if bool(history.held_by(alias)) == (command == "pin") else version

        self._move(name, alias, command, target)
        return version

    def rollback(self, name: str, alias: str) -> int:
        """Point an alias back; return its version. Raises `RefusedError`, and as `load`."""

        def target(history: AliasHistory) -> int:
            version = history.previous_version(alias)
            if version is None:
                raise RefusedError(
                    f"{name}@{alias} never pointed at another version, so there is nothing to go "
                    f"back to. See: fleet-slip models {name}"
                )
            return self.load(name, version).version

        return self._move(name, alias, "rollback", target)

    def _move(
        self, name: str, alias: str, command: Command, target: Callable[[AliasHistory], int | None]
    ) -> int:
        """Point an alias at the target, unless that is None; return its version."""
        history = self.history(name)

        def move(newest: int) -> int | None:
            version = target(history)
            if version is None:
                return history.pointed_at(alias)
            return version if history.move(alias, version, command, after=newest) else None

        return history.decide(move)

    def as_table(self, name: str | None = None) -> "pa.Table":
        """Return all versions of all models, or of one, as rows."""
        import pyarrow as pa  # noqa: PLC0415 - not for show

        names = self.names() if name is None else [name]
        rows = [row for name in names for row in self._rows(name)]
        schema = pa.schema(
            [
                ("name", pa.string()),
                ("version", pa.int64()),
                ("aliases", pa.string()),
                ("signals", pa.string()),
                ("correlation", pa.float64()),
                ("rmse_deg", pa.float64()),
                ("error_mean_deg", pa.float64()),
                ("error_std_deg", pa.float64()),
                ("cohort", pa.string()),
                ("drives", pa.int64()),
                ("rows", pa.int64()),
                ("published_at", pa.timestamp("us", tz="UTC")),
                ("sha256", pa.string()),
            ]
        )
        return pa.Table.from_pylist(rows, schema=schema)

    def _rows(self, name: str) -> list[Mapping[str, Any]]:
        moves = self.history(name).moves()
        aliases: dict[int, list[str]] = {}
        for alias, number in sorted({move.alias: move.version for move in moves}.items()):
            aliases.setdefault(number, []).append(alias)
        published = {move.version: move.at for move in reversed(moves)}
        rows: list[Mapping[str, Any]] = []
        for number in self.versions(name):
            version = self.load(name, number)
            manifest = version.manifest
            rows.append(
                {
                    **vars(manifest.trained_on),
                    **vars(manifest.cross_validation),
                    "name": name,
                    "version": number,
                    "aliases": ",".join(aliases.get(number, [])),
                    "signals": ",".join(manifest.signals),
                    "published_at": published.get(number),
                    "sha256": version.sha256,
                }
            )
        return rows

    def versions_of(self, name: str) -> DocumentFolder:
        """Return the documents of a model's versions."""
        return DocumentFolder(self.root, f"{FOLDER}/{name}/versions")


def _unknown(name: str, label: str, labels: Sequence[int | str]) -> QuestionError:
    """Return the error for a version or alias that a model does not have."""
    available = ", ".join(map(str, labels))
    return QuestionError(f"{name} has no version or alias {label!r}. It has: {available}.")


# Differences of two versions: entries of their manifests, and their training drives.

_LONGEST_SHOWN = 40
"""Maximum number of characters of a value in the table; the document is complete."""


@dataclass(frozen=True)
class Difference(Answer):
    """Differences of two versions.

    Attributes
    ----------
    facts
        Values of both by the path of the entry; None where an entry is missing.
    drives
        Training drives of the first alone, the second alone, and both; None if the
        versions are of two models.
    """

    first: ModelVersion
    second: ModelVersion
    facts: dict[str, tuple[Any, Any]]
    drives: tuple[int, int, int] | None

    def parts(self) -> Iterator[Part]:
        """Return a table of the differences, and the numbers of drives.

        For a term of a single version it shows the coefficient alone.
        """
        one_name, other_name = self.first.reference, self.second.reference
        first, second = self.first.manifest.signals, self.second.manifest.signals
        once = tuple(f"terms.{signal}." for signal in {*first} ^ {*second})
        rows = [
            [name, _format_value(a), _format_value(b)]
            for name, (a, b) in self.facts.items()
            if not name.endswith(("_exact", "sha256"))  # for machines: --json
            and (not name.startswith(once) or name.endswith(".coefficient"))
        ]
        if not rows:
            yield Remark(f"{one_name} and {other_name} are the same estimator from the same data")
            return
        yield TextTable("", f"what differs|{one_name}|{other_name}", rows, text_columns=3)
        if self.drives:
            only_one, only_other, both = self.drives
            yield Remark(
                f"drives: {both:,} made both, {only_one:,} only {one_name}, {only_other:,} only "
                f"{other_name}"
            )

    def as_dict(self) -> dict[str, Any]:
        """Return what `diff --json` prints."""
        names = ("only_one", "only_other", "both")
        return {
            "one": self.first.reference,
            "other": self.second.reference,
            "drives": dict(zip(names, self.drives, strict=True)) if self.drives else None,
            "facts": {name: {"one": a, "other": b} for name, (a, b) in self.facts.items()},
        }


def compare_versions(registry: Registry, first: ModelVersion, second: ModelVersion) -> Difference:
    """Compare two versions. Raises `StorageError` if a file of training drives is damaged."""
    import numpy as np  # noqa: PLC0415 - not for show

    a, b = (dict(_flatten(_content(version), "")) for version in (first, second))
    names = [name for name in dict.fromkeys([*a, *b]) if a.get(name) != b.get(name)]
    facts = {name: (a.get(name), b.get(name)) for name in names}
    if first.manifest.name != second.manifest.name:  # their drives are salted differently
        return Difference(first, second, facts, None)
    c, d = (registry.trained_drives(version.manifest).salted for version in (first, second))
    both = len(np.intersect1d(c, d, assume_unique=True))
    return Difference(first, second, facts, (len(c) - both, len(d) - both, both))


def _content(version: ModelVersion) -> dict[str, Any]:
    """Return the content of a manifest, terms by their signals."""
    content = version.manifest.model_dump(mode="json")
    return {**content, "terms": {term.pop("signal"): term for term in content["terms"]}}


def _flatten(content: dict[str, Any], path: str) -> Iterator[tuple[str, Any]]:
    for name, value in content.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{path}{name}.")
        else:
            yield f"{path}{name}", value


def _format_value(value: Any) -> str:
    text = "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
    return shorten(text, _LONGEST_SHOWN, placeholder="…")
