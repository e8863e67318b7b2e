"""Where the aliases of a model point, and every move that brought them there.

A move follows the moves before it directly: of two processes that decide at once, one decides
again.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated, Literal, TypeVar

from pydantic import Field

from fleet_slip.catalogue.signals import IDENTIFIER_PATTERN, Identifier
from fleet_slip.config import Config, parse_document
from fleet_slip.errors import QuestionError
from fleet_slip.files.documents import MAX_DIGITS, DocumentFolder

CHAMPION = "champion"
"""The alias of the version in use."""

CANDIDATE = "candidate"
"""The alias of the version that waits for somebody to look at it."""

Command = Literal["publish", "promote", "rollback", "pin", "unpin"]

HOLDING: frozenset[Command] = frozenset({"rollback", "pin"})
"""After these no publication moves the alias, until a person lets it go."""

RELEASING: frozenset[Command] = frozenset({"promote", "unpin"})

T = TypeVar("T")


class AliasMove(Config):
    """One entry of the history: an alias points at a version from this moment on."""

    alias: Identifier
    version: Annotated[int, Field(ge=1, lt=10**MAX_DIGITS)]
    command: Command
    at: datetime
    best: Annotated[int, Field(ge=1, lt=10**MAX_DIGITS)] | None = None
    """Of a publication: the best of the champions so far, if that is another version."""


@dataclass(frozen=True)
class AliasHistory:
    """All moves of one model's aliases."""

    documents: DocumentFolder

    def moves(self) -> list[AliasMove]:
        """Return all moves, oldest first."""
        return list(self.latest_moves())[::-1]

    def latest_moves(self) -> Iterator[AliasMove]:
        """Yield the moves, newest first, each read when it is asked for."""
        for number in reversed(self.documents.numbers()):
            document = self.documents.read(number)
            file = self.documents.file(number)
            yield parse_document(document.content, AliasMove, file, "this move of an alias")

    def pointed_at(self, alias: str) -> int | None:
        """Return the version that an alias points at, or None."""
        return next((move.version for move in self.latest_moves() if move.alias == alias), None)

    def before(self, alias: str) -> int | None:
        """Return the version that an alias pointed at before the one of now, or None.

        What was rolled back does not count: going back twice goes back two versions.
        """
        trail: list[int] = []
        for move in self.moves():
            if move.alias == alias:
                trail = _after(trail, move)
        return trail[-2] if len(trail) > 1 else None

    def best_of(self, alias: str) -> int | None:
        """Return the best of the versions that an alias was led through since a person moved it.

        That is what publications said; None if the alias points at no version.
        """
        last = next((move for move in self.latest_moves() if move.alias == alias), None)
        return None if last is None else last.best or last.version

    def published_at(self, version: int) -> datetime | None:
        """Return when a version was published last; None if no move tells."""
        moves = self.latest_moves()
        published = (m.at for m in moves if m.version == version and m.command == "publish")
        return next(published, None)

    def held_by(self, alias: str) -> AliasMove | None:
        """Return the move since which no publication may move an alias; None if one may."""
        moves = (move for move in self.latest_moves() if move.alias == alias)
        last = next((move for move in moves if move.command in HOLDING | RELEASING), None)
        return last if last is not None and last.command in HOLDING else None

    def aliases(self) -> dict[str, int]:
        """Return each alias and the version that it points at."""
        return {move.alias: move.version for move in self.moves()}

    def decide(self, decision: Callable[[int], T | None]) -> T:
        """Return what a decision comes to, which is taken again while it comes to None.

        The decision gets the number of the newest move, which it passes to `move`; it must read
        nothing of the history before it is called. Raises `ConflictError` after many attempts.
        """
        return self.documents.after_newest(decision)

    def move(
        self, alias: str, version: int, command: Command, *, after: int, best: int | None = None
    ) -> bool:
        """Point an alias at a version; return False if there were moves after the one given."""
        if not re.fullmatch(IDENTIFIER_PATTERN, alias):
            raise QuestionError(
                f"{alias!r} cannot be an alias: use small letters, digits and _, beginning with a "
                "letter, at most 41."
            )
        move = AliasMove(
            alias=alias,
            version=version,
            command=command,
            at=datetime.now(UTC),
            best=None if best == version else best,
        )
        content = move.model_dump(mode="json", exclude_none=True)
        return self.documents.create(after + 1, content) is not None


def _after(trail: list[int], move: AliasMove) -> list[int]:
    """Return the versions that an alias was led through, after one more move."""
    match move.command:
        case "rollback":
            return trail[:-1]
        case "pin" | "unpin":
            return trail
        case _ if trail and trail[-1] == move.version:
            return trail
        case _:
            return [*trail, move.version]
