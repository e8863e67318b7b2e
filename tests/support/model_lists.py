"""Model lists of a test's own."""

import json
from pathlib import Path


def write_list(file: Path, *models: str, **keys: str | bool) -> str:
    """Write a list of models, inputs separated by commas; return its path."""
    lines = ['description = "own"', *(f"{key} = {json.dumps(keys[key])}" for key in keys)]
    for number, inputs in enumerate(models, start=1):
        signals = json.dumps(inputs.split(","))
        lines += ["[[model]]", f'name = "{number}"', f"signals = {signals}"]
    file.write_text("\n".join(lines) + "\n")
    return str(file)


def nested(inputs: str) -> list[str]:
    """Return the first 1, 2, ... of inputs separated by commas."""
    names = inputs.split(",")
    return [",".join(names[:size]) for size in range(1, len(names) + 1)]
