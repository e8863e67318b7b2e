"""Model versions: immutable, numbered, each explaining itself; and aliases with their history.

models/<name>/versions/1.json, 2.json, ...     what was published
models/<name>/history/1.json, 2.json, ...      every move of an alias, with its time
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import pyarrow as pa

from fleet_slip.catalogue.signals import IDENTIFIER_PATTERN
from fleet_slip.config import parse_document
from fleet_slip.errors import QuestionError, RefusedError, StorageError
from fleet_slip.files.documents import MAX_DIGITS, DocumentFolder
from fleet_slip.files.folder import Folder
from fleet_slip.models.aliases import CHAMPION, AliasHistory
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.models.trained_drives import TrainedDrives, keep_drives, read_listed

if TYPE_CHECKING:
    from fleet_slip.delta import Table
    from fleet_slip.warehouse.tables import Warehouse

_IDENTIFIER = re.compile(IDENTIFIER_PATTERN)
_NONE = "none yet; publish one with: fleet-slip publish NAME"


@dataclass(frozen=True)
class Registry:
    """All models below a folder, which are made of some Gram rows."""

    folder: Folder
    grams: "Table | None" = None

    @classmethod
    def of(cls, warehouse: "Warehouse") -> "Registry":
        """Return the models of a data root."""
        return cls(warehouse.root / "models", warehouse.grams)

    def names(self) -> list[str]:
        """Return the names of all models, sorted."""
        return [
            name
            for name in self.folder.names()
            if _IDENTIFIER.fullmatch(name) and (self.folder / name / "versions").exists()
        ]

    def require(self, name: str) -> None:
        """Raise `QuestionError` if no model is called so."""
        if name not in self.names():
            known = ", ".join(self.names()) or _NONE
            raise QuestionError(f"no model is called {name!r}. Models: {known}.")

    def versions(self, name: str) -> list[int]:
        """Return the version numbers of a model, ascending."""
        return self._versions(name).numbers()

    def load(self, name: str, version: int) -> ModelVersion:
        """Return a version. Raises `StorageError` if it was changed."""
        if not _IDENTIFIER.fullmatch(name):
            self.require(name)
        try:
            document = self._versions(name).read(version)
        except StorageError:
            # Looked up only now: a model may have very many versions.
            self.require(name)
            numbers = self.versions(name)
            if version in numbers:
                raise
            raise _unknown(name, str(version), numbers) from None
        manifest = parse_document(document.content, Manifest, f"{name}@{version}", "its manifest")
        if manifest.name != name:
            raise StorageError(
                f"{name}@{version}: its manifest is of the model {manifest.name}. Restore the file "
                "from a backup, or publish again."
            )
        return ModelVersion(version, manifest, document.sha256)

    def only(self, or_else: str = "") -> str:
        """Return the name of the only model. Raises `QuestionError` if there is not one."""
        names = self.names()
        if len(names) != 1:
            known = ", ".join(names) or _NONE
            raise QuestionError(f"name a published model{or_else}. Models: {known}.")
        return names[0]

    def resolve(self, reference: str | None) -> ModelVersion:
        """Return the version of a reference, or the only model. Raises `QuestionError`."""
        name, _, which = (reference or self.only()).partition("@")
        self.require(name)
        which = which or CHAMPION
        if which.isascii() and which.isdigit() and len(which) <= MAX_DIGITS:
            return self.load(name, int(which))
        history = self.history(name)
        version = history.pointed_at(which)
        if version is None:
            raise _unknown(name, which, [*self.versions(name), *sorted(history.aliases())])
        return self.load(name, version)

    def folder_of(self, name: str) -> Folder:
        """Return the folder of a model's versions."""
        return self._versions(name).folder

    def champion(self, name: str) -> ModelVersion | None:
        """Return the version in use, or None before the first."""
        version = self.history(name).pointed_at(CHAMPION)
        return None if version is None else self.load(name, version)

    def history(self, name: str) -> AliasHistory:
        """Return the moves of a model's aliases."""
        return AliasHistory(DocumentFolder(self.folder / name / "history"))

    def trained_drives(self, manifest: Manifest) -> TrainedDrives | None:
        """Return what drives made a version; None if it does not tell. Raises `StorageError`."""
        listed = read_listed(self.folder_of(manifest.name), manifest)
        return None if listed is None else TrainedDrives(manifest.name, listed)

    def require_drives(self, manifest: Manifest) -> None:
        """Raise `StorageError` if what tells a version's drives is damaged or gone."""
        self.trained_drives(manifest)

    def add(self, manifest: Manifest, drives: bytes | None = None) -> ModelVersion:
        """Make a manifest the next version of its model, after what tells its `drives`.

        If the latest is the same estimator from the same rows, it is used: another process added
        it.
        """
        name, versions = manifest.name, self._versions(manifest.name)
        if drives is not None:
            keep_drives(self.folder_of(name), drives)

        def next_version(latest: int) -> int | None:
            if latest and self.load(name, latest).manifest.same_estimator(manifest):
                return latest
            document = versions.create(latest + 1, manifest.model_dump(mode="json"))
            return document.number if document else None

        version = versions.after_newest(next_version)
        return self.load(name, version)

    def make_champion(self, version: ModelVersion, *, after: int, best: int | None = None) -> bool:
        """Point the champion at a version, and at the `best`; False if an alias moved since."""
        history = self.history(version.manifest.name)
        there = history.pointed_at(CHAMPION) == version.version
        return there or history.move(CHAMPION, version.version, "publish", after=after, best=best)

    def promote(self, name: str, version: int, alias: str) -> None:
        """Point an alias at a version. Raises `QuestionError` for an unknown version.

        Where it points there already nothing is added, unless a hold or a better champion of before
        ends: one `rollback` undoes a repeated command.
        """
        self.load(name, version)
        history = self.history(name)

        def move(newest: int) -> int | None:
            chosen = history.pointed_at(alias) == history.best_of(alias) == version
            there = chosen and not history.held_by(alias)
            moved = there or history.move(alias, version, "promote", after=newest)
            return version if moved else None

        history.decide(move)

    def hold(self, name: str, alias: str, command: Literal["pin", "unpin"]) -> int:
        """Pin or unpin an alias; return its version. Raises `QuestionError` if there is none."""
        version = self.resolve(f"{name}@{alias}").version
        history = self.history(name)

        def move(newest: int) -> int | None:
            there = bool(history.held_by(alias)) == (command == "pin")
            return version if there or history.move(alias, version, command, after=newest) else None

        return history.decide(move)

    def rollback(self, name: str, alias: str) -> int:
        """Point an alias back; return its version. Raises `RefusedError`, and as `load`."""
        history = self.history(name)

        def move(newest: int) -> int | None:
            version = history.before(alias)
            if version is None:
                raise RefusedError(
                    f"{name}@{alias} never pointed at another version, so there is nothing to go "
                    f"back to. See: fleet-slip models {name}"
                )
            self.load(name, version)
            return version if history.move(alias, version, "rollback", after=newest) else None

        return history.decide(move)

    def as_table(self, name: str | None = None) -> pa.Table:
        """Return all versions of all models, or of one, as rows."""
        names = self.names() if name is None else [name]
        rows = [row for one in names for row in self._rows(one)]
        return pa.Table.from_pylist(rows, schema=_TABLE_SCHEMA)

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
            figures, trained = manifest.cross_validation, manifest.trained_on
            own = {
                "version": number,
                "aliases": ",".join(aliases.get(number, [])),
                "signals": ",".join(manifest.signals),
                "published_at": published.get(number),
                "sha256": version.sha256,
            }
            rows.append({**vars(trained), **vars(figures), "name": name, **own})
        return rows

    def _versions(self, name: str) -> DocumentFolder:
        return DocumentFolder(self.folder / name / "versions")


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


def _unknown(name: str, which: str, known: Sequence[int | str]) -> QuestionError:
    there = ", ".join(map(str, known))
    return QuestionError(f"{name} has no version or alias {which!r}. It has: {there}.")
