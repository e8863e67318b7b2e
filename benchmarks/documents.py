"""Puts tables into the documentation, each between two comments that bear its name."""

import re
from pathlib import Path


def insert(document: Path, name: str, text: str) -> None:
    """Replace what stands between `<!-- NAME -->` and `<!-- end of NAME -->` in a document."""
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    old = document.read_text("utf-8")
    new, found = re.subn(
        f"({re.escape(begin)}\n).*?({re.escape(end)})",
        lambda match: f"{match[1]}{text}\n{match[2]}",
        old,
        flags=re.DOTALL,
    )
    if found != 1:
        raise ValueError(f"{document} has {found} places called {name}")
    document.write_text(new, encoding="utf-8")
