"""Side-slip angle estimation from fleet logs.

Many cars log cheap signals, a few also log their side-slip angle. Logs become exact Gram matrices;
from these every model, cohort and fold follows without reading a row again; the winner becomes a
numbered model version, which a car computes in whole numbers.

    import fleet_slip

    fleet = fleet_slip.open("data")
    fleet.simulate("smoke")
    fleet.gram()
    selection = fleet.cohort("adhesion > 0.8").select(models="table1")
    fleet.publish("dry", selection)
    log = fleet.sql("SELECT * FROM log WHERE day = '2024-05-01'").pl()
    model = fleet.model("dry@1")
    beta_rad = model.predict(log)

`open` returns a `Fleet`, whose methods are the commands of `fleet-slip`; `connect` returns a DuckDB
connection with the views alone. Physical values are in SI units, and names carry them: `ax_mps2`,
`yaw_rate_rad_s`, `sideslip_rad`. Axes and signs are those of ISO 8855. Every error that can be
expected is a `FleetSlipError`, and says what to do next.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fleet_slip.api.cohort import FleetCohort
    from fleet_slip.api.fleet import Fleet
    from fleet_slip.errors import FleetSlipError
    from fleet_slip.models.registry import ModelVersion
    from fleet_slip.storage.folder import Folder
    from fleet_slip.views import connect

__all__ = ["Fleet", "FleetCohort", "FleetSlipError", "ModelVersion", "connect", "open"]

_HOMES = {
    "Fleet": "fleet_slip.api.fleet",
    "FleetCohort": "fleet_slip.api.cohort",
    "FleetSlipError": "fleet_slip.errors",
    "ModelVersion": "fleet_slip.models.registry",
    "connect": "fleet_slip.views",
}
"""Where the names are that are imported when they are first used: importing the package is fast."""


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
        A folder of configs that is laid over the shipped ones. None means `$FLEET_SLIP_CONFIG`,
        else the shipped ones alone.

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
    """Import a name of the package when it is first used."""
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *_HOMES]
