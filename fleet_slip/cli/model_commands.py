"""Commands for published models: models, show, promote, rollback, pin, unpin, diff, export."""

from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Context, Option

from fleet_slip.cli import options as opt
from fleet_slip.cli.options import fleet_of, recorded
from fleet_slip.cli.output import print_answer, print_json, print_parts, say
from fleet_slip.errors import UsageError
from fleet_slip.rendering import TextTable


def models(
    context: Context,
    name: Annotated[
        str | None,
        Argument(
            help="Name of a model: list its versions and the history of its aliases.",
            autocompletion=opt.complete_name,
        ),
    ] = None,
    json: opt.Json = False,
) -> None:
    """List the published model versions.

    Example: fleet-slip models
    """
    fleet = fleet_of(context)
    rows = fleet.models.versions(name).to_pylist()
    if json:
        print_json(rows)
        return
    if not rows:
        say("no model has been published yet. Run: fleet-slip publish NAME")
        return
    records = (
        {**row, "aliases": row["aliases"].split(","), "inputs": row["signals"].count(",") + 1}
        for row in rows
    )
    header = "model|aliases|signals|published|correlation|RMSE deg|drives"
    form = "{name}@{version}|{aliases}|{inputs}|{published_at:%Y-%m-%d %H:%M}|"
    form += "{correlation:.4f}|{rmse_deg:.4f}|{drives:,}"
    print_parts([TextTable("", header, records, form, text_columns=4)])
    for row in rows:
        reference = f"{row['name']}@{row['version']}"
        if row["trained_on_forgotten"]:
            say(f"{reference} was trained on drives that were forgotten since")
        if remark := fleet.models.get(reference).manifest.line_remark:
            say(f"{reference}: {remark}")
    if name:
        moves = fleet.models.registry.history(name).moves()
        header = "at|command|alias|version"
        form = "{at:%Y-%m-%d %H:%M:%S}|{command}|{alias}|{version}"
        print_parts([TextTable("\nhistory of aliases", header, moves, form, text_columns=3)])


def show(
    context: Context, model: opt.Model = None, everything: opt.All = False, json: opt.Json = False
) -> None:
    """Show one model version: figures, training data and coefficients.

    With --all, coefficients to the last digit, and the SQL of features.

    Example: fleet-slip show waterford
    """
    from fleet_slip.export.c import costs_content, describe_costs

    version = fleet_of(context).models.get(model)
    if json:
        print_json({**version.as_dict(), "on_board": costs_content(version)})
    else:
        print_answer(version, json, everything=everything, on_board=describe_costs(version))


@recorded
def promote(
    context: Context,
    reference: Annotated[
        str, Argument(help="NAME@VERSION.", autocompletion=opt.complete_reference)
    ],
    alias: opt.Alias = "champion",
) -> None:
    """Point an alias, by default champion, at a version.

    Example: fleet-slip promote waterford@2
    """
    version = fleet_of(context).models.promote(reference, alias)
    say(f"{version.manifest.name}@{alias} is now version {version.version}")


@recorded
def rollback(context: Context, model: opt.ModelName, alias: opt.Alias = "champion") -> None:
    """Point an alias back at its previous version, and pin it there.

    Example: fleet-slip rollback waterford
    """
    version = fleet_of(context).models.rollback(model, alias)
    say(
        f"{model}@{alias} is version {version.version} again, and pinned until: fleet-slip promote "
        f"NAME@VERSION, or fleet-slip unpin {model}"
    )


@recorded
def pin(context: Context, model: opt.ModelName, alias: opt.Alias = "champion") -> None:
    """Keep an alias at its version: publications become candidates, until promote or unpin.

    Example: fleet-slip pin waterford
    """
    version = fleet_of(context).models.pin(model, alias)
    say(f"{model}@{alias} is pinned to version {version.version}")


@recorded
def unpin(context: Context, model: opt.ModelName, alias: opt.Alias = "champion") -> None:
    """Let publications move an alias again.

    Example: fleet-slip unpin waterford
    """
    version = fleet_of(context).models.unpin(model, alias)
    say(f"{model}@{alias} is version {version.version}; publications may move it")


def diff(context: Context, first: opt.Version, second: opt.Version, json: opt.Json = False) -> None:
    """Compare two versions of a model: data, prior, signals, coefficients, figures.

    Example: fleet-slip diff waterford@1 waterford@2
    """
    print_answer(fleet_of(context).models.diff(first, second), json)


def export(
    context: Context,
    to: Annotated[
        Literal["json", "c", "sql", "dbc", "onnx", "fmu", "mlflow"],
        Option(help="Target of the export; mlflow registers the version in the server of --uri."),
    ],
    model: opt.Model = None,
    output: Annotated[
        Path, Option(help="Folder to write into; files of the same names are replaced.")
    ] = Path(),
    with_gram: Annotated[
        bool, Option("--with-gram", help="With C: also the code for Gram rows on board.")
    ] = False,
    uri: Annotated[str | None, Option(help="With mlflow: URI of the server.")] = None,
    json: opt.Json = False,
) -> None:
    """Export a version as C, SQL, ONNX, FMU, DBC or JSON, with test vectors, or to MLflow.

    Example: fleet-slip export waterford --to c --output export
    """
    models = fleet_of(context).models
    if to == "mlflow" and uri is not None:
        version = models.get(model)
        number = models.log_to_mlflow(version, uri)
        if json:
            print_json({"model": version.manifest.name, "mlflow_version": number})
        else:
            say(f"in MLflow: {version.manifest.name}, version {number}")
        return
    if to == "mlflow" or uri is not None:
        raise UsageError("--to mlflow and --uri need each other: --to mlflow --uri URI.")
    files = models.export(model, to, output, with_gram=with_gram)
    if json:
        print_json({"files": [str(path) for path in files]})
        return
    for path in files:
        say(f"{path}: {path.stat().st_size:,} bytes")
