"""Side-slip angle estimation from fleet logs.

`connect(root)` returns a DuckDB connection with the warehouse's views; see `fleet_slip.views`.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fleet_slip.views import connect

__all__ = ["connect"]


def __getattr__(name: str) -> Any:
    """Import `connect` when it is first used: DuckDB is not needed to import a module."""
    if name == "connect":
        from fleet_slip.views import connect  # noqa: PLC0415

        return connect
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
