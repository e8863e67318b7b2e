"""Commands that make and serve models: select, publish, models, show, promote, rollback, score."""

from typing import Annotated, Any

import typer

from fleet_slip.cli.output import Json, print_json, print_table, print_text, say
from fleet_slip.cohort import ALL_DRIVES, TRAINING_DRIVES, load_cohort
from fleet_slip.errors import ConfigError
from fleet_slip.model_list import (
    CandidateModel,
    FoldKey,
    FoldPlan,
    ModelList,
    check_model_name,
    load_model_list,
    nested_models,
)
from fleet_slip.publishing import Publication, manifest_of
from fleet_slip.publishing import publish as publish_selection
from fleet_slip.registry import CHAMPION, ModelVersion, Registry
from fleet_slip.selection import Selection
from fleet_slip.selection import select as select_model
from fleet_slip.signals import catalogue
from fleet_slip.warehouse import Warehouse

DEFAULT_MODELS = "table1"

Cohort = Annotated[
    str,
    typer.Option(help="SQL condition on the view drives, such as \"track = 'waterford_hills'\"."),
]
Models = Annotated[
    str | None,
    typer.Option(
        help=f"A model list of configs/models, or a TOML file. Default: {DEFAULT_MODELS}, unless "
        "--nested is given.",
        show_default=False,
    ),
]
Nested = Annotated[
    str | None,
    typer.Option(
        help="Add the nested models of an order of signals, separated by commas; 'catalogue' is "
        "the order of configs/signals.toml."
    ),
]
FoldBy = Annotated[
    FoldKey | None, typer.Option(help="What a fold is made of. Default: what the list says.")
]
FoldCount = Annotated[
    int | None, typer.Option("--folds", min=2, help="Number of folds. Default: what the list says.")
]
Reference = Annotated[
    str, typer.Argument(help="NAME, NAME@VERSION or NAME@ALIAS. NAME alone is its champion.")
]
Alias = Annotated[str, typer.Option(help="The alias to move.")]


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    for command in (select, publish, models, show, promote, rollback, score):
        app.command()(command)


def registry_of(warehouse: Warehouse) -> Registry:
    """Return the registry of a data root."""
    return Registry(warehouse.root / "models")


def candidates_of(model_list: ModelList | None, nested: str | None) -> tuple[CandidateModel, ...]:
    """Return the candidates of a list, then those of a nested order."""
    listed = model_list.model if model_list else ()
    if nested is None:
        return listed
    known = catalogue().inputs
    order = known if nested == "catalogue" else tuple(name.strip() for name in nested.split(","))
    unknown = [name for name in order if name not in known]
    if unknown or len(set(order)) < len(order):
        raise ConfigError(
            f"--nested {nested}: {', '.join(unknown) or 'a signal'} "
            f"{'is not an input' if unknown else 'stands twice'}. Inputs: {', '.join(known)}."
        )
    return (*listed, *nested_models(order))


def run_selection(
    warehouse: Warehouse,
    cohort: str,
    list_name: str | None = None,
    nested: str | None = None,
    by: FoldKey | None = None,
    folds: int | None = None,
) -> tuple[Selection, str, str]:
    """Select on a cohort. Returns the selection, the name of the list, and its checksum."""
    name = list_name or (None if nested else DEFAULT_MODELS)
    model_list = load_model_list(name) if name else None
    plan = model_list.folds if model_list else FoldPlan()
    plan = FoldPlan(by=by or plan.by, count=folds or plan.count)
    candidates = candidates_of(model_list, nested)
    described = ModelList(
        description=model_list.description if model_list else "Nested models of an order",
        folds=plan,
        model=candidates,
    )
    selection = select_model(load_cohort(warehouse, cohort), candidates, plan)
    label = "+".join(filter(None, [name, f"nested:{nested}" if nested else None]))
    return selection, label, described.sha256


def select(
    context: typer.Context,
    cohort: Cohort = TRAINING_DRIVES,
    models: Models = None,
    nested: Nested = None,
    by: FoldBy = None,
    folds: FoldCount = None,
    json: Json = False,
) -> None:
    """Compare models on a cohort by cross-validation and choose one. Reads Gram rows only."""
    selection, _, _ = run_selection(context.obj, cohort, models, nested, by, folds)
    if json:
        print_json(selection.as_dict())
    else:
        print_selection(selection)


def print_selection(selection: Selection) -> None:
    """Print the table of a selection, the winner and why."""
    where = selection.cohort.condition
    print_table(
        f"{selection.cohort.drives.num_rows:,} drives, {selection.cohort.rows:,} rows"
        + ("" if where == TRAINING_DRIVES else f" where {where}")
        + f"; {selection.folds.count} folds by {selection.folds.by}",
        ["model", "signals", "correlation", "RMSE deg", "mean deg", "std deg", "condition"],
        [
            [
                model.name,
                " ".join(model.signals),
                f"{model.correlation:.4f}",
                f"{model.pooled.rmse_deg:.4f}",
                f"{model.pooled.error_mean_deg:+.4f}",
                f"{model.pooled.error_std_deg:.4f}",
                f"{model.condition_number:.3g}",
            ]
            for model in selection.models
        ],
        left=2,
    )
    for name, reason in selection.skipped.items():
        say(f"model {name} was left out: {reason}")
    print_text(f"winner: {selection.winner.model.name}. {selection.winner.reason}")


def publish(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the model, such as sideslip.")],
    cohort: Cohort = TRAINING_DRIVES,
    models: Models = None,
    nested: Nested = None,
    by: FoldBy = None,
    folds: FoldCount = None,
    force: Annotated[
        bool, typer.Option("--force", help="Publish even what is worse than the champion.")
    ] = False,
    json: Json = False,
) -> None:
    """Select on a cohort and make the winner the next version of a model, and its champion."""
    check_model_name(name)
    selection, label, sha256 = run_selection(context.obj, cohort, models, nested, by, folds)
    manifest = manifest_of(selection, name, label, sha256)
    publication = publish_selection(registry_of(context.obj), manifest, selection, force=force)
    if json:
        print_json(published(publication))
    else:
        print_selection(selection)
        print_publication(publication)


def published(publication: Publication) -> dict[str, Any]:
    """Return what `publish --json` prints."""
    version = publication.version
    return {
        "model": version.manifest.name,
        "version": version.version,
        "new": publication.new,
        "reason": publication.reason,
        "sha256": version.sha256,
    }


def print_publication(publication: Publication) -> None:
    """Say what was published."""
    done = "published" if publication.new else "nothing to publish:"
    say(f"{done} {publication.version.reference}. {publication.reason}")


def models(
    context: typer.Context,
    name: Annotated[
        str | None, typer.Argument(help="Show one model's versions and history.")
    ] = None,
    json: Json = False,
) -> None:
    """List the published model versions."""
    registry = registry_of(context.obj)
    rows = [row for row in registry.as_table().to_pylist() if name in (None, row["name"])]
    if name and not rows:
        registry.resolve(name)
    if json:
        print_json(rows)
        return
    if not rows:
        say("no model has been published yet. Run: fleet-slip publish NAME")
        return
    print_table(
        "",
        ["model", "aliases", "signals", "published", "correlation", "std deg", "drives", "rows"],
        [
            [
                f"{row['name']}@{row['version']}",
                row["aliases"],
                row["signals"].replace(",", " "),
                f"{row['published_at']:%Y-%m-%d %H:%M}" if row["published_at"] else "",
                f"{row['correlation']:.4f}",
                f"{row['error_std_deg']:.4f}",
                f"{row['drives']:,}",
                f"{row['rows']:,}",
            ]
            for row in rows
        ],
        left=4,
    )
    if name:
        print_table(
            "\nhistory of aliases",
            ["at", "command", "alias", "version"],
            [
                [f"{move.at:%Y-%m-%d %H:%M:%S}", move.command, move.alias, str(move.version)]
                for move in registry.history(name)
            ],
            left=3,
        )


def show(context: typer.Context, reference: Reference, json: Json = False) -> None:
    """Show one model version: coefficients, figures, and the data that made it."""
    version = registry_of(context.obj).resolve(reference)
    if json:
        content = version.manifest.model_dump(mode="json")
        print_json({"version": version.version, "sha256": version.sha256, **content})
    else:
        _print_version(version)


def _print_version(version: ModelVersion) -> None:
    manifest = version.manifest
    figures, trained = manifest.cross_validation, manifest.trained_on
    label = manifest.label
    print_table(
        f"{version.reference}: {label.column} = intercept + sum of coefficient * signal",
        ["signal", "unit", "coefficient", "per count"],
        [
            ["intercept", label.unit, repr(manifest.intercept), ""],
            *(
                [
                    term.column,
                    term.unit,
                    repr(term.coefficient),
                    f"{float(term.coefficient_exact * term.scale_exact):.9g}",
                ]
                for term in manifest.terms
            ),
        ],
        left=2,
    )
    print_table(
        "",
        ["", ""],
        [
            [
                "correlation",
                f"{figures.correlation:.4f} (s.e. {figures.correlation_standard_error:.2g})",
            ],
            ["error std", f"{figures.error_std_deg:.4f} deg"],
            ["error mean", f"{figures.error_mean_deg:+.4f} deg"],
            ["cross-validation", f"{figures.folds} folds by {figures.folds_by}"],
            ["cohort", f"{trained.cohort}: {trained.drives:,} drives, {trained.rows:,} rows"],
            ["tables", f"logs version {trained.logs_version}, grams {trained.grams_version}"],
            [
                "selected",
                f"model {manifest.selected_by.model} of {manifest.selected_by.model_list}",
            ],
            ["why", manifest.selected_by.reason],
            ["sha256", version.sha256],
        ],
        left=2,
    )


def promote(
    context: typer.Context,
    reference: Annotated[str, typer.Argument(help="NAME@VERSION to point the alias at.")],
    alias: Alias = CHAMPION,
) -> None:
    """Point an alias, the champion unless told otherwise, at a version."""
    check_model_name(alias)
    registry = registry_of(context.obj)
    version = registry.resolve(reference)
    registry.promote(version.manifest.name, version.version, alias)
    say(f"{version.manifest.name}@{alias} is now version {version.version}")


def rollback(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the model.")],
    alias: Alias = CHAMPION,
) -> None:
    """Point an alias back at the version that it had before."""
    version = registry_of(context.obj).rollback(name, alias)
    say(f"{name}@{alias} is version {version} again")


def score(
    context: typer.Context,
    reference: Reference,
    cohort: Cohort = ALL_DRIVES,
    sql: Annotated[bool, typer.Option("--sql", help="Print the statement and do nothing.")] = False,
    json: Json = False,
) -> None:
    """Evaluate a model on the rows of a cohort: also the largest error and percentiles."""
    from fleet_slip.score import score as score_rows  # noqa: PLC0415
    from fleet_slip.score import score_statement  # noqa: PLC0415

    version = registry_of(context.obj).resolve(reference)
    if sql:
        typer.echo(score_statement(version.manifest, cohort))
        return
    result = score_rows(context.obj, version.manifest, cohort).as_dict()
    if json:
        print_json({"model": version.reference, "cohort": cohort, **result})
        return
    print_table(
        f"{version.reference} on {result['rows']:,} rows",
        ["figure", "value"],
        [
            [name.replace("_deg", ", deg").replace("_", " "), f"{value:.4f}"]
            for name, value in result.items()
            if name != "rows" and value is not None
        ],
    )
