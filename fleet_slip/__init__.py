"""Side-slip angle estimation from fleet logs.

`connect(root)` returns a DuckDB connection with the warehouse's views; see `fleet_slip.connection`.
"""

from fleet_slip.connection import connect

__all__ = ["connect"]
