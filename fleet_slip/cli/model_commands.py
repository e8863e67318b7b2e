"""Commands that choose, publish, show and export models."""

from dataclasses import fields
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Context, Option

from fleet_slip.catalog.signals import TRAINING_DRIVES
from fleet_slip.cli import options as opt
from fleet_slip.cli.options import fleet_of
from fleet_slip.cli.output import print_answer, print_json, print_parts, say, write_text
from fleet_slip.errors import UsageError
from fleet_slip.rendering import TextTable
from fleet_slip.storage.runs import step


def select(
    context: Context,
    cohort: opt.Cohort = TRAINING_DRIVES,
    include_faulty: opt.IncludeFaulty = False,
    models: opt.ModelList = None,
    model: opt.OneModel = None,
    order: opt.Order = None,
    features: opt.Features = None,
    label: opt.Label = None,
    group_by: opt.GroupBy = None,
    folds: opt.Folds = None,
    ranking: opt.Ranking = None,
    criterion: opt.Criterion = None,
    tolerance: opt.Tolerance = None,
    robust: opt.Robust = False,
    intercept: opt.Intercept = True,
    search: opt.Search = None,
    max_features: opt.MaxFeatures = None,
    half_life: opt.HalfLife = None,
    prior: opt.Prior = None,
    save: Annotated[
        Path | None,
        Option(
            metavar="LIST.toml", help="Write the compared models as a list, for publish --models."
        ),
    ] = None,
    everything: opt.All = False,
    json: opt.Json = False,
) -> None:
    """Compare models on a cohort by cross-validation and choose one. Reads Gram rows only.

    Compare a list of models: fleet-slip select --models table1

    Find an order and a place to stop: fleet-slip select --ranking backward --criterion bic

    Choose among many columns: fleet-slip select --features windows --search exchange

    Keep the choice: fleet-slip select --order ay,yaw_rate --save own.toml
    """
    options = locals()
    from fleet_slip.models.request import SelectionRequest

    names = [field.name for field in fields(SelectionRequest)]
    request = SelectionRequest(**{name: options[name] for name in names})
    drives = fleet_of(context).cohort(cohort, include_faulty=include_faulty)
    selection = drives.select(request)
    print_answer(selection, json, everything=everything, hint="--all")
    if save is not None:
        remark = f". Publish it: fleet-slip publish NAME --models {save}"
        write_text(save, selection.candidate_list.as_toml(), "" if json else remark)


def publish(
    context: Context,
    name: opt.ModelName,
    cohort: Annotated[
        str | None,
        Option(help="SQL predicate on the view drives. Default: the champion's, or all drives."),
    ] = None,
    include_faulty: opt.IncludeFaulty = False,
    models: opt.ModelList = None,
    label: opt.Label = None,
    robust: opt.Robust = False,
    half_life: opt.HalfLife = None,
    prior: opt.Prior = None,
    with_filter: Annotated[
        str | None,
        Option(
            help="Combine the model with a Kalman filter in this car, or none. Default: the "
            "champion's."
        ),
    ] = None,
    force: Annotated[
        bool, Option("--force", help="Publish even a model that is worse than the champion.")
    ] = False,
    candidate: opt.Candidate = False,
    dry_run: Annotated[
        bool, Option("--dry-run", help="Print what would be published; publish nothing.")
    ] = False,
    json: opt.Json = False,
) -> None:
    """Select from a model list and publish the winner as a model's next version, its champion.

    A model that exists is trained again with the cohort and options of its champion; options that
    are given replace them. A new model is trained on all drives. Explore with select; its --save
    writes a list for --models.

    --with-filter identifies a Kalman filter in a car from the drives: a vehicle of
    configs/vehicles, or a TOML file with mass_kg, front_axle_m and rear_axle_m.

    Try it first: fleet-slip publish waterford --dry-run

    Example: fleet-slip publish wet --cohort "adhesion < 0.8"
    """
    from fleet_slip.models.manifest import require_model_name
    from fleet_slip.models.publish import DryRun, Publication, recipe_for
    from fleet_slip.models.request import SelectionRequest

    fleet = fleet_of(context)
    request = SelectionRequest(
        models=models, label=label, robust=robust, half_life=half_life, prior=prior
    )
    recipe = recipe_for(fleet.models.registry, require_model_name(name), request, cohort)
    if recipe.explanation:
        say(f"{name}: {recipe.explanation}")
    drives = fleet.cohort(recipe.cohort, include_faulty=include_faulty)
    with step("select"):
        selection = drives.select(recipe.request, nested=True)
    publish_or_preview = fleet.models.preview if dry_run else fleet.models.publish
    answer: DryRun | Publication = publish_or_preview(
        name, selection, force=force, candidate=candidate, with_filter=with_filter
    )
    if json:
        if selection.examined:
            say(selection.examined)
        print_json(answer)
    else:
        print_parts(selection.parts())
        print_parts(answer.parts())
    if answer.problem:
        raise answer.problem


def diagnose(
    context: Context,
    model: opt.Model = None,
    cohort: opt.Cohort = TRAINING_DRIVES,
    signals: Annotated[
        str | None,
        Option(
            help="Signals to fit instead of a published model, separated by commas; catalogue is "
            "all inputs."
        ),
    ] = None,
    features: Annotated[
        str | None, Option(help="Feature set of --signals. Default: the logged signals.")
    ] = None,
    json: opt.Json = False,
) -> None:
    """Fit a model's signals to a cohort and examine the fit, from Gram rows.

    Believe the standard errors by drives, or by cars where there are several: at 100 Hz the rows of
    a drive are not independent, and the drives of a car share its biases.

    Example: fleet-slip diagnose waterford
    """
    drives = fleet_of(context).cohort(cohort)
    diagnosis = drives.diagnose(model, signals=signals, features=features)
    if json:
        print_json({"cohort": cohort, **diagnosis.as_dict()})
    else:
        print_answer(diagnosis, json)


def models(
    context: Context,
    name: Annotated[
        str | None, Argument(help="Name of a model: list its versions and its aliases' history.")
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
        if row["trained_on_forgotten"]:
            say(f"{row['name']}@{row['version']} was trained on drives that were forgotten since")
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


def promote(
    context: Context,
    reference: Annotated[str, Argument(help="NAME@VERSION.", autocompletion=opt.complete_model)],
    alias: opt.Alias = "champion",
) -> None:
    """Point an alias, by default champion, at a version.

    Example: fleet-slip promote waterford@2
    """
    version = fleet_of(context).models.promote(reference, alias)
    say(f"{version.manifest.name}@{alias} is now version {version.version}")


def rollback(context: Context, model: opt.ModelName, alias: opt.Alias = "champion") -> None:
    """Point an alias back at its previous version, and pin it there.

    Example: fleet-slip rollback waterford
    """
    version = fleet_of(context).models.rollback(model, alias)
    say(
        f"{model}@{alias} is version {version.version} again, and pinned until: fleet-slip promote "
        f"NAME@VERSION, or fleet-slip unpin {model}"
    )


def pin(context: Context, model: opt.ModelName, alias: opt.Alias = "champion") -> None:
    """Keep an alias at its version: publications become candidates, until promote or unpin.

    Example: fleet-slip pin waterford
    """
    version = fleet_of(context).models.pin(model, alias)
    say(f"{model}@{alias} is pinned to version {version.version}")


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
        Option(help="Target of the export; mlflow registers the version at --uri."),
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
