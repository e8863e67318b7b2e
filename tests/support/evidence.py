"""Outside answers: certified, published or by other programs. See tests/evidence/README.md."""

import json
from pathlib import Path
from typing import Any

EVIDENCE = Path(__file__).parents[1] / "evidence"


def evidence(path: str) -> Any:
    """Load a JSON file of outside answers."""
    return json.loads((EVIDENCE / path).read_text(encoding="utf-8"))
