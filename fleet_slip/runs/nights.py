"""The record of nights: where each began, and how it ended.

    nights/1.json, 2.json, ...    two of a night: its beginning and its end

A killed night that is given again starts from its beginning, and tells the whole. Faulty drives are
hashes: the record outlives what is forgotten.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from datetime import date
from hashlib import sha256
from typing import Any

from fleet_slip.files.documents import DocumentFolder
from fleet_slip.files.folder import Folder

FOLDER = "nights"
HASH_CHARACTERS = 16


@dataclass(frozen=True)
class Beginning:
    """What a root had when a night began: its champion, and hashes of drives `known` as faulty."""

    champion: str | None
    drives: int
    rows: int
    quarantined: int
    known: frozenset[str] = frozenset()


@dataclass(frozen=True)
class PastNight:
    """How a night ended; `steps` are the state of each by name."""

    night: date
    exit_code: int
    drives: int
    rows: int
    champion: str | None
    steps: Mapping[str, str]
    faulty: frozenset[str] = frozenset()


def hash_drive(model: str, drive_id: str) -> str:
    """Return `left(sha256('MODEL ' || drive_id), 16)`, which stands for a drive in the record."""
    return sha256(f"{model} {drive_id}".encode()).hexdigest()[:HASH_CHARACTERS]


@dataclass(frozen=True)
class Nights:
    """The nights of one model in a data root."""

    root: Folder
    model: str

    def begin(self, night: date, now: Beginning) -> Beginning:
        """Record the beginning of a night; return the one that is there, if the night has one."""
        for content in self._newest_first():
            if content["night"] < night.isoformat():
                break
            if content["night"] == night.isoformat() and content["event"] == "begun":
                kept = {name: content[name] for name in vars(now)}
                return Beginning(**{**kept, "known": frozenset(content["known"])})
        before = next(self.ended(before=night), None)
        known = before.faulty if before else frozenset()
        begun = replace(now, known=known)
        self._append("begun", night, {**vars(begun), "known": sorted(begun.known)})
        return begun

    def end(self, past: PastNight) -> None:
        """Record how a night ended."""
        content = {**vars(past), "steps": dict(past.steps), "faulty": sorted(past.faulty)}
        self._append("ended", content.pop("night"), content)

    def ended(self, before: date | None = None) -> Iterator[PastNight]:
        """Yield the nights that ended, the newest first and each once, as it ended at last."""
        seen = {before.isoformat()} if before else set()
        for content in self._newest_first():
            late = before is not None and content["night"] > before.isoformat()
            if content["event"] == "ended" and content["night"] not in seen and not late:
                seen.add(content["night"])
                kept = {field.name: content[field.name] for field in fields(PastNight)}
                kept |= {"night": date.fromisoformat(content["night"])}
                yield PastNight(**{**kept, "faulty": frozenset(content["faulty"])})

    def _newest_first(self) -> Iterator[Mapping[str, Any]]:
        documents = DocumentFolder(self.root / FOLDER)
        for number in reversed(documents.numbers()):
            content = documents.read(number).content
            if content["model"] == self.model:
                yield content

    def _append(self, event: str, night: date, content: Mapping[str, Any]) -> None:
        known = {"event": event, "model": self.model, "night": night.isoformat()}
        DocumentFolder(self.root / FOLDER).append({**known, **content})


def without_drives(cohort: str, model: str, hashes: Iterable[str]) -> str:
    """Return a condition that also leaves out the drives of these hashes."""
    listed = ", ".join(f"'{one}'" for one in sorted(hashes))
    if not listed:
        return cohort
    return (
        f"({cohort}) AND left(sha256('{model} ' || drive_id), {HASH_CHARACTERS}) NOT IN ({listed})"
    )


_LEFT_OUT = re.compile(
    r"\((.*)\) AND left\(sha256\('[^']*' \|\| drive_id\), \d+\) NOT IN \([^()]*\)", re.DOTALL
)


def with_all_drives(cohort: str) -> str:
    """Return a condition as it was before `without_drives` left out some."""
    while found := _LEFT_OUT.fullmatch(cohort):
        cohort = found[1]
    return cohort
