"""The command that writes a project of one's own: init."""

import os
import re
import shlex
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from fleet_slip.cli.output import print_text
from fleet_slip.errors import UsageError
from fleet_slip.files.storage_errors import storage_errors
from fleet_slip.resources import folder as shipped

NAME = re.compile(r"[a-z][a-z0-9_]*")
OWN = ("publish.toml", "monitor.toml", "retention.toml")
"""Configs that a project has of its own from the beginning, as they ship."""


def init(
    folder: Annotated[Path, typer.Argument(help="A new or empty folder.", show_default=False)],
    model: Annotated[
        str, typer.Option(help="Name of the model and of the mapping: a-z, 0-9, _.")
    ] = "fleet",
    log: Annotated[
        Path | None,
        typer.Option(
            help="A measured log, to draft the mapping from. Default: a mapping to fill in.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Write a project: configs to edit, a draft of a mapping, a schedule, and what to type next.

    It is written whole or not at all.

    Example: **fleet-slip init my_fleet --log drive.mf4**
    """
    if not NAME.fullmatch(model):
        raise UsageError(f"--model {model}: write it in lower-case letters, digits and _.")
    mapping = _mapping_of(log, model) if log else _template("mapping.toml", model=model)
    whole = folder.absolute()
    with storage_errors(folder):
        if whole.exists() and (not whole.is_dir() or any(whole.iterdir())):
            raise UsageError(f"{folder}: it is not empty. Name a new folder.")
        whole.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".init-", dir=whole.parent) as temporary:
            draft = Path(temporary) / "project"
            _write(draft, whole, model, mapping)
            os.rename(draft, whole)  # noqa: PTH104 - takes the place of an empty folder
    print_text((whole / "README.md").read_text(encoding="utf-8").rstrip())


def _write(draft: Path, whole: Path, model: str, mapping: str) -> None:
    for name in ("configs/mappings", "landing"):
        (draft / name).mkdir(parents=True)
    for name in OWN:
        text = (shipped("configs") / name).read_text(encoding="utf-8")
        (draft / "configs" / name).write_text(text, encoding="utf-8")
    (draft / "configs" / "mappings" / f"{model}.toml").write_text(mapping, encoding="utf-8")
    program = Path(sys.argv[0]).absolute()
    known = {"folder": shlex.quote(str(whole)), "program": shlex.quote(str(program))}
    in_cron = {key: text.replace("%", r"\%") for key, text in known.items()}  # else a line's end
    for name, names in (("README.md", known), ("crontab", in_cron)):
        (draft / name).write_text(_template(name, model=model, **names), encoding="utf-8")


def _mapping_of(log: Path, model: str) -> str:
    """Return the mapping that a measured log suggests."""
    from fleet_slip.ingest.drafting.draft import draft_mapping  # noqa: PLC0415 - takes a while
    from fleet_slip.ingest.drafting.draft_text import write_draft  # noqa: PLC0415
    from fleet_slip.ingest.drafting.profile import profile_file  # noqa: PLC0415
    from fleet_slip.ingest.formats.reading import FileFormats  # noqa: PLC0415

    formats = FileFormats(can=None, duckdb=None)
    return write_draft(draft_mapping(log, profile_file(log, formats)), model)


def _template(name: str, **known: str) -> str:
    text = (shipped("jobs") / "project" / name).read_text(encoding="utf-8")
    return text.format(**known)
