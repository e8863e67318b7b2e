"""What a verification of a data root looked at, and what it found."""

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class Damage:
    """One thing that is not as it must be, or that is worth knowing.

    Attributes:
        kind: where it is. "damage" of a `file`, a `drive`, a `gram` row, a `document`, a `model`,
            the `log` of a table, or a `name` that was forgotten; or only a remark: "unreferenced",
            "backlog", or "unchecked".
        path: the file below the root, or the drive or model version.
        problem: what is wrong.
    """

    kind: Literal[
        "file",
        "drive",
        "gram",
        "document",
        "model",
        "log",
        "name",
        "unreferenced",
        "backlog",
        "unchecked",
    ]
    path: str
    problem: str

    @property
    def damage(self) -> bool:
        """Whether something is lost, or would be computed wrongly."""
        return self.kind not in {"unreferenced", "backlog", "unchecked"}


@dataclass
class Verification:
    """What was looked at, and what was found."""

    files: int = 0
    size_bytes: int = 0
    rows: int = 0
    log_files_recomputed: int = 0
    documents: int = 0
    signatures: int = 0
    """Messages of cars whose signature was kept."""
    signatures_checked: int = 0
    findings: list[Damage] = field(default_factory=list)

    @property
    def damage(self) -> list[Damage]:
        """The findings that are damage."""
        return [finding for finding in self.findings if finding.damage]
