"""The data contract of the views, in the Open Data Contract Standard (ODCS) 3.1.

The standard is at https://bitol-io.github.io/open-data-contract-standard/v3.1.0.
"""

from collections.abc import Mapping
from importlib.metadata import version as package_version
from typing import TYPE_CHECKING, Any

import yaml

from fleet_slip.views import open_views

if TYPE_CHECKING:
    from fleet_slip.warehouse.warehouse import Warehouse

API_VERSION = "v3.1.0"

VIEWS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "log": ("Signals of all drives at 100 Hz, in SI units.", ("drive_id", "tick")),
    "drives": ("One row per drive, with its metadata.", ("drive_id",)),
    "grams": (
        "Gram rows: the number of rows of a drive, sums and sums of products of its counts.",
        (),
    ),
    "models": ("Published model versions and their cross-validated errors.", ("name", "version")),
}
"""The views of the contract, with description and primary key."""

_LOGICAL_TYPES = {
    "VARCHAR": "string",
    "DOUBLE": "number",
    "DATE": "date",
    "TIMESTAMPTZ": "timestamp",
    "BOOLEAN": "boolean",
}

_MINIMUM_ZERO = frozenset(
    {"tick", "time_s", "duration_s", "rows", "row_count", "clipped", "rmse_deg", "error_std_deg"}
)
"""Columns without a negative value, beside the signals, whose ranges the catalog contains."""


def data_contract(warehouse: "Warehouse") -> str:
    """Return the contract of the views `log`, `drives`, `grams` and `models` as YAML.

    Raises `StorageError` if there is no data root.
    """
    query = 'SELECT view, "column", type, unit, description FROM dictionary'
    with open_views(warehouse, None) as database:
        columns = database.execute(query).fetchall()
    signals = warehouse.catalog.signals.signals.values()
    ranges = {signal.column: (float(signal.min), float(signal.max)) for signal in signals}
    schema = [
        {
            "name": view,
            "physicalType": "view",
            "logicalType": "object",
            "description": description,
            "properties": [
                _property(*column[1:], key=key, limits=ranges.get(column[1]))
                for column in columns
                if column[0] == view
            ],
        }
        for view, (description, key) in VIEWS.items()
    ]
    document = {
        "apiVersion": API_VERSION,
        "kind": "DataContract",
        "id": "fleet-slip",
        "name": "fleet_slip",
        "version": package_version("fleet-slip"),
        "status": "active",
        "domain": "vehicle dynamics",
        "description": {
            "purpose": "Logs of vehicles, their Gram rows, and models of the side-slip angle.",
            "usage": "Query the views by fleet-slip sql, or by fleet_slip.connect in DuckDB.",
            "limitations": "Axes and signs are those of ISO 8855. A signal that a car does not "
            "log is null. Values outside the range of a signal are quarantined or missing.",
        },
        "schema": schema,
    }
    return str(yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=100))


def _property(
    name: str,
    physical_type: str,
    unit: str,
    description: str,
    *,
    key: tuple[str, ...],
    limits: tuple[float, float] | None,
) -> dict[str, Any]:
    """Return a column as a property of ODCS."""
    physical_type = physical_type.replace("TIMESTAMP WITH TIME ZONE", "TIMESTAMPTZ")
    element = physical_type.removesuffix("[]")
    logical = _LOGICAL_TYPES.get(element, "integer")
    column: dict[str, Any] = {"name": name, "physicalType": physical_type}
    if element == physical_type:
        column["logicalType"] = logical
    else:
        column["logicalType"] = "array"
        column["items"] = {"logicalType": logical, "physicalType": element}
    column["description"] = description
    if name in key:
        column |= {"required": True, "primaryKey": True, "primaryKeyPosition": key.index(name) + 1}
    if limits:
        column["logicalTypeOptions"] = {"minimum": limits[0], "maximum": limits[1]}
    elif name in _MINIMUM_ZERO:
        column["logicalTypeOptions"] = {"minimum": 0}
    if unit:
        column["customProperties"] = [{"property": "unit", "value": unit}]
    return column
