"""The catalog of the shipped configs, which most tests use."""

from pathlib import Path

from fleet_slip.catalog.catalog import load_catalog
from fleet_slip.resources import Configs

CATALOG = load_catalog()
SIGNALS = CATALOG.signals


def configs_with(folder: Path, **texts: str) -> Configs:
    """Write files such as `signals.toml` to a folder; return it, laid over the shipped configs."""
    folder.mkdir(exist_ok=True)
    for name, text in texts.items():
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    return Configs(folder)
