"""Model versions: immutable, numbered, each explaining itself; and aliases with their history.

    models/<name>/versions/1.json, 2.json, ...   what was published
    models/<name>/history/1.json, 2.json, ...    every move of an alias, in order

A manifest is a function of data, configuration and program alone; the time stands in the history.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, Literal

import pyarrow as pa
from pydantic import Field, PlainSerializer, PlainValidator, ValidationError

from fleet_slip.config import Config
from fleet_slip.documents import DocumentFolder
from fleet_slip.errors import RefusedError, SelectionError, StorageError
from fleet_slip.signals import Identifier

CHAMPION = "champion"
"""The alias of the version in use."""

ExactFraction = Annotated[
    Fraction,
    PlainValidator(Fraction),
    PlainSerializer(lambda value: f"{value.numerator}/{value.denominator}"),
]


class ModelTerm(Config):
    """One signal of a model: `label = intercept + sum(coefficient * signal)`, in SI units.

    `sql` is empty for a logged signal. For a feature it computes the count from the counts of
    signals; the count is clipped to +-32767, and times `scale` it is the physical value.
    """

    signal: Identifier
    column: Identifier
    unit: str
    scale: Decimal
    sql: str = ""
    coefficient: float
    coefficient_exact: ExactFraction

    @property
    def scale_exact(self) -> Fraction:
        """Physical value of one count, exactly."""
        return Fraction(self.scale)


class ModelLabel(Config):
    """What a model estimates."""

    signal: Identifier
    column: Identifier
    unit: str
    scale: Decimal


class CrossValidated(Config):
    """Pooled cross-validated figures of a model, and how the folds were made."""

    folds_by: str
    folds: int
    correlation: float
    correlation_standard_error: float
    rmse_deg: float
    error_mean_deg: float
    error_std_deg: float
    condition_number: float


class TrainedOn(Config):
    """The data that made a model."""

    cohort: str
    feature_set: str = "signals"
    drives: int
    rows: int
    logs_version: int
    grams_version: int


class SelectedBy(Config):
    """Why this model: the list it came from, its name there, and the rule that chose it."""

    model_list: str
    model: str
    reason: str
    config_sha256: str


class Manifest(Config):
    """One model version, complete."""

    format: Literal[1] = 1
    name: Identifier
    label: ModelLabel
    intercept: float
    intercept_exact: ExactFraction
    terms: tuple[ModelTerm, ...] = Field(min_length=1)
    cross_validation: CrossValidated
    trained_on: TrainedOn
    selected_by: SelectedBy
    package_version: str

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the model's inputs."""
        return tuple(term.signal for term in self.terms)

    @property
    def features(self) -> dict[str, str]:
        """SQL of each input that is a feature."""
        return {term.signal: term.sql for term in self.terms if term.sql}

    def same_estimator(self, other: "Manifest") -> bool:
        """Whether both are the same numbers from the same rows."""
        return (
            self.intercept_exact == other.intercept_exact
            and self.terms == other.terms
            and self.trained_on.rows == other.trained_on.rows
            and self.trained_on.drives == other.trained_on.drives
        )


class AliasMove(Config):
    """One entry of the history: an alias points at a version from this moment on."""

    alias: Identifier
    version: int
    command: Literal["publish", "promote", "rollback"]
    at: datetime


@dataclass(frozen=True)
class ModelVersion:
    """A manifest with its number and verified checksum."""

    version: int
    manifest: Manifest
    sha256: str

    @property
    def reference(self) -> str:
        """The version as it is named on the command line: `NAME@VERSION`."""
        return f"{self.manifest.name}@{self.version}"


@dataclass(frozen=True)
class Registry:
    """All models below a folder."""

    path: Path

    def names(self) -> list[str]:
        """Return the names of all models, sorted."""
        if not self.path.is_dir():
            return []
        return sorted(entry.name for entry in self.path.iterdir() if (entry / "versions").is_dir())

    def versions(self, name: str) -> list[int]:
        """Return the version numbers of a model, ascending."""
        return self._versions(name).numbers()

    def load(self, name: str, version: int) -> ModelVersion:
        """Return one version. Raises `StorageError` if it was changed after it was published."""
        numbers = self.versions(name)
        if version not in numbers:
            raise SelectionError(_unknown(name, str(version), self.names(), numbers))
        document = self._versions(name).read(version)
        try:
            return ModelVersion(version, Manifest.model_validate(document.content), document.sha256)
        except ValidationError as error:
            raise StorageError(
                f"{name}@{version}: its manifest is not one that this program understands: "
                f"{error.errors()[0]['msg']}. Update fleet-slip, or publish again."
            ) from None

    def resolve(self, reference: str) -> ModelVersion:
        """Return the version that `NAME`, `NAME@VERSION` or `NAME@ALIAS` names.

        `NAME` alone is its champion. Raises `SelectionError` for an unknown one.
        """
        name, _, which = reference.partition("@")
        if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or name not in self.names():
            known = ", ".join(self.names()) or "none yet; publish one with: fleet-slip publish"
            raise SelectionError(f"no model is called {name!r}. Models: {known}.")
        which = which or CHAMPION
        if which.isascii() and which.isdigit():
            return self.load(name, int(which))
        aliases = self.aliases(name)
        if which not in aliases:
            raise SelectionError(_unknown(name, which, self.names(), self.versions(name), aliases))
        return self.load(name, aliases[which])

    def champion(self, name: str) -> ModelVersion | None:
        """Return the version in use, or None before the first."""
        version = self.aliases(name).get(CHAMPION)
        return None if version is None else self.load(name, version)

    def publish(self, manifest: Manifest) -> ModelVersion:
        """Make a manifest the next version of its model, and its champion.

        If an interrupted run left the same manifest as the latest version, that one is used.
        """
        folder = self._versions(manifest.name)
        content = manifest.model_dump(mode="json")
        number = self._same_as_latest(manifest)
        document = folder.read(number) if number else folder.append(content)
        self._move(manifest.name, CHAMPION, document.number, "publish")
        return ModelVersion(document.number, manifest, document.sha256)

    def promote(self, name: str, version: int, alias: str) -> None:
        """Point an alias at a version. Raises `SelectionError` for an unknown version.

        Where it points there already nothing is added, so that a repeated command can be undone by
        one `rollback`.
        """
        self.load(name, version)
        if self.aliases(name).get(alias) != version:
            self._move(name, alias, version, "promote")

    def rollback(self, name: str, alias: str) -> int:
        """Point an alias back at the version it had before; return that version.

        Raises `RefusedError` if it never had another.
        """
        trail: list[int] = []
        for move in self.history(name):
            if move.alias == alias:
                trail = trail[:-1] if move.command == "rollback" else [*trail, move.version]
        if len(trail) < 2:
            raise RefusedError(
                f"{name}@{alias} never pointed at another version, so there is nothing to go back "
                f"to. See: fleet-slip models {name}"
            )
        self._move(name, alias, trail[-2], "rollback")
        return trail[-2]

    def history(self, name: str) -> list[AliasMove]:
        """Return all moves of a model's aliases, oldest first."""
        folder = self._history(name)
        return [AliasMove.model_validate(folder.read(n).content) for n in folder.numbers()]

    def aliases(self, name: str) -> dict[str, int]:
        """Return each alias of a model and the version that it points at."""
        return {move.alias: move.version for move in self.history(name)}

    def as_table(self) -> pa.Table:
        """Return all versions of all models as rows."""
        rows = [row for name in self.names() for row in self._rows(name)]
        return pa.Table.from_pylist(rows, schema=_TABLE_SCHEMA)

    def _rows(self, name: str) -> list[Mapping[str, Any]]:
        history = self.history(name)
        aliases = self.aliases(name)
        rows: list[Mapping[str, Any]] = []
        for number in self.versions(name):
            version = self.load(name, number)
            manifest = version.manifest
            published = [move.at for move in history if move.version == number]
            rows.append(
                {
                    "name": name,
                    "version": number,
                    "aliases": ",".join(sorted(a for a, v in aliases.items() if v == number)),
                    "signals": ",".join(manifest.signals),
                    "correlation": manifest.cross_validation.correlation,
                    "rmse_deg": manifest.cross_validation.rmse_deg,
                    "error_mean_deg": manifest.cross_validation.error_mean_deg,
                    "error_std_deg": manifest.cross_validation.error_std_deg,
                    "cohort": manifest.trained_on.cohort,
                    "drives": manifest.trained_on.drives,
                    "rows": manifest.trained_on.rows,
                    "published_at": published[0] if published else None,
                    "sha256": version.sha256,
                }
            )
        return rows

    def _same_as_latest(self, manifest: Manifest) -> int | None:
        latest = max(self.versions(manifest.name), default=None)
        if latest is not None and self.load(manifest.name, latest).manifest == manifest:
            return latest
        return None

    def _move(
        self,
        name: str,
        alias: str,
        version: int,
        command: Literal["publish", "promote", "rollback"],
    ) -> None:
        move = AliasMove(alias=alias, version=version, command=command, at=datetime.now(UTC))
        self._history(name).append(move.model_dump(mode="json"))

    def _versions(self, name: str) -> DocumentFolder:
        return DocumentFolder(self.path / name / "versions")

    def _history(self, name: str) -> DocumentFolder:
        return DocumentFolder(self.path / name / "history")


_TABLE_SCHEMA = pa.schema(
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


def _unknown(
    name: str,
    which: str,
    names: list[str],
    versions: list[int],
    aliases: Mapping[str, int] | None = None,
) -> str:
    if name not in names:
        return f"no model is called {name!r}. Models: {', '.join(names) or 'none yet'}."
    known = [str(number) for number in versions] + sorted(aliases or {})
    return f"{name} has no version or alias {which!r}. It has: {', '.join(known)}."
