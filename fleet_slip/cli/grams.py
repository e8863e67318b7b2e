"""Reducing logs to Gram rows, and what can be reduced: the commands gram and features."""

from concurrent.futures import Executor
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fleet_slip.api.calls import open_workers
from fleet_slip.api.fleet import Fleet
from fleet_slip.base import pluralize
from fleet_slip.catalog.catalog import Catalog, FeatureSet
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.signals import SAMPLE_TIME_S
from fleet_slip.cli.options import command
from fleet_slip.cli.output import All, Json, print_json, print_parts, say
from fleet_slip.cli.progress import progress
from fleet_slip.columns.column_sql import column_query
from fleet_slip.config import read_named_file
from fleet_slip.grams.compute import gram_statement, has_statement
from fleet_slip.rendering import TextTable
from fleet_slip.resources import Configs, folder

if TYPE_CHECKING:
    from fleet_slip.grams.update import GramReport

ALL_SETS = "all"
"""Instead of the name of a feature set: every one."""


@command(Fleet.gram)
def gram(
    fleet: Fleet,
    features: str,
    cohort: str | None,
    threads: int | None,
    cluster: str | None,
    sql: Annotated[bool, typer.Option("--sql", help="Print the statement and do nothing.")] = False,
    json: Json = False,
) -> None:
    """Reduce new log files to Gram rows, and drop the rows of files that are gone.

    A feature set that is asked for the first time costs one pass over the logs; from then on only
    new files are read.

    Every set: fleet-slip gram --features all

    Example: fleet-slip gram --features windows
    """
    names = fleet.warehouse.feature_sets() if features == ALL_SETS else (features,)
    if sql:
        catalog = fleet.warehouse.catalog
        for name in names:
            if features != ALL_SETS or has_statement(catalog, name):
                typer.echo(gram_statement(catalog, name))
        return
    with open_workers(fleet.root, cluster or threads) as executor:
        if cohort:  # which files have its drives is known from the logged signals' Gram rows
            _run_gram(fleet, executor, PLAIN, None)
        reports = [_run_gram(fleet, executor, name, cohort) for name in names]
    if json:
        print_json(reports if features == ALL_SETS else reports[0])
        return
    for report in reports:
        print_parts(report.parts())
    if not (any(one.gram_rows for one in reports) or fleet.warehouse.logs.snapshot().files):
        say(
            f"{fleet.root}: no logs yet. Load some with fleet-slip ingest, or simulate with "
            "fleet-slip run"
        )


def _run_gram(
    fleet: Fleet, executor: Executor, feature_set: str, cohort: str | None
) -> "GramReport":
    with progress(f"gram {feature_set}") as show:
        return fleet.gram(feature_set, cohort=cohort, workers=executor, progress=show)


# The command that lists features, feature sets and the config files that define them: features.


def features(
    context: typer.Context,
    sets: Annotated[
        bool, typer.Option("--sets", help="List the feature sets instead of the features.")
    ] = False,
    sql: Annotated[
        str | None,
        typer.Option(
            "--sql",
            help="Print the query over log_counts that computes this feature, window or factor.",
            show_default=False,
        ),
    ] = None,
    files: Annotated[
        bool, typer.Option("--files", help="List the config files in force, and whose they are.")
    ] = False,
    everything: All = False,
    json: Json = False,
) -> None:
    """List the features and feature sets of configs/features.toml.

    Features are integer functions of the logged counts, such as yaw rate over speed. Compute the
    Gram rows of a set with: fleet-slip gram --features NAME, then use it with: fleet-slip
    select --features NAME

    Example: fleet-slip features --sql ay_mean_16
    """
    catalog: Catalog = context.obj().warehouse.catalog
    if files:
        _print_files(catalog.configs, json)
        return
    named = {name: catalog.feature_set(name) for name in (PLAIN, *catalog.sets)}
    if sql is not None:
        typer.echo(column_query(catalog, sql))
    elif json:
        print_json(
            {
                "windows": {
                    name: one.model_dump(mode="json") for name, one in catalog.time_columns.items()
                },
                "features": {
                    name: {**one.model_dump(mode="json"), "sql": one.sql}
                    for name, one in catalog.features.items()
                },
                "sets": {
                    name: {"identity": catalog.identity(name), **_content_of(one)}
                    for name, one in named.items()
                },
            }
        )
    elif sets:
        row = "{0}|{1.inputs}|{1.description}"
        print_parts([TextTable("", "set|columns|description", named.items(), row, left=3)])
    else:
        shown: dict[str, Any] = dict(catalog.features)
        if everything:
            shown |= catalog.time_columns
        header, row = "column|unit|scale|description", "{0}|{1.unit}|{1.scale}|{1.description}"
        print_parts([TextTable("", header, shown.items(), row, left=4)])
        if not everything:
            print_parts([_families(catalog)])


def _content_of(feature_set: FeatureSet) -> dict[str, Any]:
    """Return what JSON says of a feature set: times in s, as the file states them."""
    content = asdict(feature_set)
    ticks = content.pop("block_ticks")
    return {**content, "block_s": None if ticks is None else float(ticks * SAMPLE_TIME_S)}


def _families(catalog: Catalog) -> TextTable:
    """Return columns over time by family: one by one they are hundreds."""
    file = catalog.file
    families = [
        [name, " ".join(map(str, one.ticks or (0,))), one.description]
        for name, one in file.windows.items()
    ]
    single = (*file.products, *file.estimates, *file.slopes, *file.factors, *file.calibrated)
    families += [[name, "", file.time_columns[name].description] for name in single]
    families += [[f"COLUMN_{name}_…", "", gate.description] for name, gate in file.gates.items()]
    many = pluralize(len(file.time_columns), "column")
    title = f"\n{many} over time; one by one: --all"
    return TextTable(title, "column|over ticks|description", families, left=3)


def _print_files(configs: Configs, json: bool) -> None:
    own = configs.folder
    found = {
        name: {
            "from": "own" if own and str(file).startswith(str(own)) else "shipped",
            "path": str(file),
        }
        for name, file in configs.files().items()
        if read_named_file(file)
    }
    if json:
        print_json(found)
    else:
        heading = f"own configs: {own or 'none'}\nshipped ones: {folder('configs')}"
        print_parts([TextTable(heading, "file|from", found.items(), "{0}|{1[from]}", left=2)])
