"""Model versions: immutable, numbered, each explaining itself; and aliases with their history.

    models/<name>/versions/1.json, 2.json, ...   what was published
    models/<name>/history/1.json, 2.json, ...    every move of an alias, in order

A manifest is a function of data, configuration and program alone; the time stands in the history.
"""

import contextlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import pyarrow as pa
from pydantic import Field, ValidationError

from fleet_slip.config import Config, faults_of
from fleet_slip.documents import MAX_DIGITS, DocumentFolder
from fleet_slip.errors import RefusedError, SelectionError, StorageError
from fleet_slip.folder import Folder
from fleet_slip.manifest import Manifest
from fleet_slip.signals import IDENTIFIER_PATTERN, Identifier
from fleet_slip.signing import require_signature, require_signing_key, sign

_IDENTIFIER = re.compile(IDENTIFIER_PATTERN)

CHAMPION = "champion"
"""The alias of the version in use."""


class AliasMove(Config):
    """One entry of the history: an alias points at a version from this moment on."""

    alias: Identifier
    version: Annotated[int, Field(ge=1, lt=10**MAX_DIGITS)]
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
    """All models below a folder. New versions are signed with a private key, if there is one."""

    folder: Folder
    signing_key: Path | None = None

    def names(self) -> list[str]:
        """Return the names of all models, sorted."""
        return [
            name
            for name in self.folder.names()
            if _IDENTIFIER.fullmatch(name) and (self.folder / name / "versions").exists()
        ]

    def versions(self, name: str) -> list[int]:
        """Return the version numbers of a model, ascending."""
        return self._versions(name).numbers()

    def load(self, name: str, version: int) -> ModelVersion:
        """Return one version.

        Raises `StorageError` if it was changed after it was published, and `RefusedError` if it
        lacks the signature that is asked for (`fleet_slip.signing`).
        """
        loaded = self._read(name, version)
        require_signature(self._versions(name).folder, version, name, loaded.sha256)
        return loaded

    def sign(self, name: str, version: int) -> None:
        """Sign a version, if there is a key to sign with."""
        if self.signing_key is not None:
            loaded = self._read(name, version)
            folder = self._versions(name).folder
            sign(folder, version, name, loaded.sha256, self.signing_key)

    def _read(self, name: str, version: int) -> ModelVersion:
        if not _IDENTIFIER.fullmatch(name):
            raise SelectionError(_unknown(name, str(version), self.names(), []))
        try:
            document = self._versions(name).read(version)
        except StorageError:
            # Looked up only now: a model may have very many versions.
            numbers = self.versions(name) if name in self.names() else []
            if version in numbers:
                raise
            raise SelectionError(_unknown(name, str(version), self.names(), numbers)) from None
        with _foreign_document(f"{name}@{version}: its manifest"):
            manifest = Manifest.model_validate(document.content)
        if manifest.name != name:
            raise StorageError(
                f"{name}@{version}: its manifest is of the model {manifest.name}. Restore the file "
                "from a backup, or publish again."
            )
        return ModelVersion(version, manifest, document.sha256)

    def resolve(self, reference: str) -> ModelVersion:
        """Return the version that `NAME`, `NAME@VERSION` or `NAME@ALIAS` names.

        `NAME` alone is its champion. Raises `SelectionError` for an unknown one.
        """
        name, _, which = reference.partition("@")
        if name not in self.names():
            known = ", ".join(self.names()) or "none yet; publish one with: fleet-slip publish"
            raise SelectionError(f"no model is called {name!r}. Models: {known}.")
        which = which or CHAMPION
        if which.isascii() and which.isdigit() and len(which) <= MAX_DIGITS:
            return self.load(name, int(which))
        version = self.pointed_at(name, which)
        if version is None:
            known_aliases = self.aliases(name)
            raise SelectionError(
                _unknown(name, which, self.names(), self.versions(name), known_aliases)
            )
        return self.load(name, version)

    def champion(self, name: str) -> ModelVersion | None:
        """Return the version in use, or None before the first."""
        version = self.pointed_at(name, CHAMPION)
        return None if version is None else self.load(name, version)

    def publish(self, manifest: Manifest) -> ModelVersion:
        """Make a manifest the next version of its model, and its champion.

        If an interrupted run left the same manifest as the latest version, that one is used.
        """
        if self.signing_key is not None:
            require_signing_key(self.signing_key)  # before anything is written
        folder = self._versions(manifest.name)
        content = manifest.model_dump(mode="json")
        number = self._same_as_latest(manifest)
        document = folder.read(number) if number else folder.append(content)
        self.sign(manifest.name, document.number)
        self._move(manifest.name, CHAMPION, document.number, "publish")
        return ModelVersion(document.number, manifest, document.sha256)

    def promote(self, name: str, version: int, alias: str) -> None:
        """Point an alias at a version. Raises `SelectionError` for an unknown version.

        Where it points there already nothing is added, so that a repeated command can be undone by
        one `rollback`.
        """
        self.load(name, version)
        if self.pointed_at(name, alias) != version:
            self._move(name, alias, version, "promote")

    def rollback(self, name: str, alias: str) -> int:
        """Point an alias back at the version it had before; return that version.

        Raises `RefusedError` if it never had another, and what `load` raises if that is not sound.
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
        self.load(name, trail[-2])
        self._move(name, alias, trail[-2], "rollback")
        return trail[-2]

    def history(self, name: str) -> list[AliasMove]:
        """Return all moves of a model's aliases, oldest first."""
        return list(self.latest_moves(name))[::-1]

    def latest_moves(self, name: str) -> Iterator[AliasMove]:
        """Yield the moves of a model's aliases, newest first, each read when it is asked for."""
        folder = self._history(name)
        for number in reversed(folder.numbers()):
            document = folder.read(number)
            with _foreign_document(f"{folder.folder}: a move of an alias"):
                move = AliasMove.model_validate(document.content)
            yield move

    def pointed_at(self, name: str, alias: str) -> int | None:
        """Return the version that an alias points at, or None."""
        moves = self.latest_moves(name)
        return next((move.version for move in moves if move.alias == alias), None)

    def published_at(self, name: str, version: int) -> datetime | None:
        """Return when a version was published last; None if no move tells."""
        moves = self.latest_moves(name)
        published = (m.at for m in moves if m.version == version and m.command == "publish")
        return next(published, None)

    def aliases(self, name: str) -> dict[str, int]:
        """Return each alias of a model and the version that it points at."""
        return {move.alias: move.version for move in self.history(name)}

    def as_table(self) -> pa.Table:
        """Return all versions of all models as rows."""
        rows = [row for name in self.names() for row in self._rows(name)]
        return pa.Table.from_pylist(rows, schema=_TABLE_SCHEMA)

    def _rows(self, name: str) -> list[Mapping[str, Any]]:
        aliases: dict[int, list[str]] = {}
        for alias, number in sorted(self.aliases(name).items()):
            aliases.setdefault(number, []).append(alias)
        published = {move.version: move.at for move in self.latest_moves(name)}
        rows: list[Mapping[str, Any]] = []
        for number in self.versions(name):
            version = self._read(name, number)
            manifest = version.manifest
            rows.append(
                {
                    "name": name,
                    "version": number,
                    "aliases": ",".join(aliases.get(number, [])),
                    "signals": ",".join(manifest.signals),
                    "correlation": manifest.cross_validation.correlation,
                    "rmse_deg": manifest.cross_validation.rmse_deg,
                    "error_mean_deg": manifest.cross_validation.error_mean_deg,
                    "error_std_deg": manifest.cross_validation.error_std_deg,
                    "cohort": manifest.trained_on.cohort,
                    "drives": manifest.trained_on.drives,
                    "rows": manifest.trained_on.rows,
                    "published_at": published.get(number),
                    "sha256": version.sha256,
                }
            )
        return rows

    def _same_as_latest(self, manifest: Manifest) -> int | None:
        latest = max(self.versions(manifest.name), default=None)
        if latest is not None and self._read(manifest.name, latest).manifest == manifest:
            return latest
        return None

    def _move(
        self,
        name: str,
        alias: str,
        version: int,
        command: Literal["publish", "promote", "rollback"],
    ) -> None:
        if not _IDENTIFIER.fullmatch(alias):
            raise SelectionError(
                f"{alias!r} cannot be an alias: use small letters, digits and _, beginning with a "
                "letter, at most 41."
            )
        move = AliasMove(alias=alias, version=version, command=command, at=datetime.now(UTC))
        self._history(name).append(move.model_dump(mode="json"))

    def _versions(self, name: str) -> DocumentFolder:
        return DocumentFolder(self.folder / name / "versions")

    def _history(self, name: str) -> DocumentFolder:
        return DocumentFolder(self.folder / name / "history")


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


@contextlib.contextmanager
def _foreign_document(what: str) -> Iterator[None]:
    """Explain a document that is whole and yet not one of ours."""
    try:
        yield
    except ValidationError as error:
        raise StorageError(
            f"{what} is not one that this program understands: {faults_of(error)}. Update "
            "fleet-slip, or publish again."
        ) from None


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
