"""The command that lists features, feature sets and config files: features."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fleet_slip.base import pluralize
from fleet_slip.cli import options as opt
from fleet_slip.cli.options import fleet_of
from fleet_slip.cli.output import print_json, print_parts
from fleet_slip.rendering import TextTable

if TYPE_CHECKING:
    from fleet_slip.catalog.catalog import Catalog, FeatureSet
    from fleet_slip.resources import Configs


def features(
    context: typer.Context,
    sets: Annotated[
        bool, typer.Option("--sets", help="List the feature sets instead of the features.")
    ] = False,
    sql: Annotated[
        str | None,
        typer.Option(
            help="Print the query over log_counts that computes this feature, window or factor."
        ),
    ] = None,
    files: Annotated[
        bool, typer.Option("--files", help="List the config files in use, and their folders.")
    ] = False,
    everything: opt.All = False,
    json: opt.Json = False,
) -> None:
    """List the features and feature sets of configs/features.toml.

    Features are integer functions of the logged counts, such as yaw rate over speed. Compute the
    Gram rows of a set with: fleet-slip gram --features NAME, then use it with: fleet-slip
    select --features NAME

    Example: fleet-slip features --sql ay_mean_16
    """
    from fleet_slip.catalog.features import PLAIN

    catalog = fleet_of(context).warehouse.catalog
    if files:
        _print_files(catalog.configs, json)
        return
    feature_sets = {name: catalog.feature_set(name) for name in (PLAIN, *catalog.sets)}
    if sql is not None:
        from fleet_slip.columns.column_sql import column_query

        typer.echo(column_query(catalog, sql))
    elif json:
        print_json(
            {
                "windows": {
                    name: column.model_dump(mode="json")
                    for name, column in catalog.time_columns.items()
                },
                "features": {
                    name: {**feature.model_dump(mode="json"), "sql": feature.sql}
                    for name, feature in catalog.features.items()
                },
                "sets": {
                    name: {"identity": catalog.identity(name), **_content_of(feature_set)}
                    for name, feature_set in feature_sets.items()
                },
            }
        )
    elif sets:
        row = "{0}|{1.inputs}|{1.description}"
        print_parts(
            [TextTable("", "set|columns|description", feature_sets.items(), row, text_columns=3)]
        )
    else:
        columns: dict[str, Any] = dict(catalog.features)
        if everything:
            columns |= catalog.time_columns
        header, row = "column|unit|scale|description", "{0}|{1.unit}|{1.scale}|{1.description}"
        print_parts([TextTable("", header, columns.items(), row, text_columns=4)])
        if not everything:
            print_parts([_families(catalog)])


def _content_of(feature_set: "FeatureSet") -> dict[str, Any]:
    """Return the document of a feature set, with times in s."""
    from fleet_slip.catalog.signals import SAMPLE_TIME_S

    content = asdict(feature_set)
    ticks = content.pop("block_ticks")
    return {**content, "block_s": None if ticks is None else float(ticks * SAMPLE_TIME_S)}


def _families(catalog: "Catalog") -> TextTable:
    """Render the hundreds of columns over time by family."""
    file = catalog.file
    families = [
        [name, " ".join(map(str, window.ticks or (0,))), window.description]
        for name, window in file.windows.items()
    ]
    single = (*file.products, *file.estimates, *file.slopes, *file.factors, *file.calibrated)
    families += [[name, "", file.time_columns[name].description] for name in single]
    families += [[f"COLUMN_{name}_…", "", gate.description] for name, gate in file.gates.items()]
    count = pluralize(len(file.time_columns), "column")
    title = f"\n{count} over time; one by one: --all"
    return TextTable(title, "column|over ticks|description", families, text_columns=3)


def _print_files(configs: "Configs", json: bool) -> None:
    from fleet_slip.config import read_named_file
    from fleet_slip.resources import folder

    overlay = configs.folder
    files = {
        name: {
            "from": "own" if overlay and str(file).startswith(str(overlay)) else "shipped",
            "path": str(file),
        }
        for name, file in configs.files().items()
        if read_named_file(file)
    }
    if json:
        print_json(files)
    else:
        heading = f"own configs: {overlay or 'none'}\nshipped ones: {folder('configs')}"
        print_parts(
            [TextTable(heading, "file|from", files.items(), "{0}|{1[from]}", text_columns=2)]
        )
