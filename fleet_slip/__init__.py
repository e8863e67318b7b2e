"""Side-slip angle estimation from fleet logs.

Many cars log cheap signals, and a few also log their side-slip angle. Logs are reduced to exact
Gram matrices. From these, models are selected, cross-validated and published without reading a row
again. A published version is a linear model that a car computes in integer arithmetic.

    import fleet_slip

    fleet = fleet_slip.open("data")
    fleet.simulate("smoke")
    fleet.gram()
    selection = fleet.cohort("adhesion > 0.8").select(models="table1")
    fleet.models.publish("dry", selection)
    log = fleet.sql("SELECT * FROM log WHERE day = '2024-05-01'").pl()
    model = fleet.models.get("dry@1")
    beta_rad = model.predict(log)

`open` returns a `Fleet`; `connect` returns a DuckDB connection with the views. Physical values are
in SI units, and names carry them: `ax_mps2`, `yaw_rate_rad_s`, `sideslip_rad`. Axes and signs are
those of ISO 8855. Every expected error is a `FleetSlipError`, whose message contains the remedy.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fleet_slip.api.fleet import Fleet
    from fleet_slip.api.fleet_models import FleetCohort
    from fleet_slip.errors import FleetSlipError
    from fleet_slip.models.registry import ModelVersion
    from fleet_slip.storage.folder import Folder
    from fleet_slip.views import connect

__all__ = ["Fleet", "FleetCohort", "FleetSlipError", "ModelVersion", "connect", "open"]

_HOMES = {
    "Fleet": "fleet_slip.api.fleet",
    "FleetCohort": "fleet_slip.api.fleet_models",
    "FleetSlipError": "fleet_slip.errors",
    "ModelVersion": "fleet_slip.models.registry",
    "connect": "fleet_slip.views",
}
"""Modules of the names that are imported on first use: importing the package is fast."""


def open(  # noqa: A001 - as in gzip
    root: "Folder | Path | str | None" = None, config: "Path | str | None" = None
) -> "Fleet":
    """Open the fleet of a data root. Nothing in the root is read or written yet.

    Parameters
    ----------
    root
        A folder, or a URL (`s3://BUCKET/PATH`, `gs://`, `az://`). None means `$FLEET_SLIP_ROOT`,
        else `./data`. Credentials come from the environment.
    config
        A folder of configs that override the shipped ones. None means `$FLEET_SLIP_CONFIG`, else
        the shipped ones alone.

    Returns
    -------
    Fleet
        Close it, or use it in a `with` block.

    Raises
    ------
    StorageError
        If no data root can have this path.
    ConfigError
        If `config` is no readable folder of configs.
    """
    from fleet_slip.api.fleet import Fleet  # noqa: PLC0415 - pyarrow and Delta
    from fleet_slip.warehouse.warehouse import open_warehouse  # noqa: PLC0415

    return Fleet(open_warehouse(root, config))


def __getattr__(name: str) -> Any:
    """Import a name of the package on first use."""
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *_HOMES]
