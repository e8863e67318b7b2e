"""The command that shows which config files are in force."""

from fleet_slip.canonical import sha256_of
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.cli.output import Json, print_json, print_table
from fleet_slip.config import read_named_file
from fleet_slip.resources import config_files, folder, own_configs


def config(json: Json = False) -> None:
    """List the config files that are in force, and where each comes from.

    A folder given with --config or $FLEET_SLIP_CONFIG is laid over the shipped one: its files take
    the place of shipped ones of the same name, and add to them.

    Example: **fleet-slip --config my_configs config**
    """
    catalogue()
    features()  # what is not valid is said here, before anything is listed
    own = own_configs()
    found = [
        {
            "file": name,
            "from": "own" if own and str(file).startswith(str(own)) else "shipped",
            "path": str(file),
            "sha256": sha256_of(read_named_file(file).decode("utf-8", "replace")),
        }
        for name, file in config_files().items()
    ]
    if json:
        print_json({"own": str(own) if own else None, "files": found})
        return
    print_table(
        f"own configs: {own or 'none'}\nshipped ones: {folder('configs')}",
        ["file", "from"],
        [[one["file"], one["from"]] for one in found],
        left=2,
    )
