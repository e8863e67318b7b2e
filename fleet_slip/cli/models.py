"""Commands that make and serve models: publish, models, show, promote, rollback, score."""

from pathlib import Path
from typing import Annotated, Any

import typer

from fleet_slip.aliases import CHAMPION
from fleet_slip.audit import Audit
from fleet_slip.cli.output import Json, print_json, print_table, say
from fleet_slip.cli.recorded import recorded
from fleet_slip.cli.selecting import (
    AllSubsets,
    Cohort,
    Criterion,
    Features,
    FoldBy,
    FoldCount,
    Models,
    Naive,
    Nested,
    Rank,
    print_selection,
)
from fleet_slip.cli.signing import SignKey, signing_key
from fleet_slip.cohort import ALL_DRIVES, TRAINING_DRIVES
from fleet_slip.model_list import check_model_name
from fleet_slip.operations.run_log import step
from fleet_slip.publishing import Publication, manifest_of
from fleet_slip.publishing import publish as publish_selection
from fleet_slip.registry import ModelVersion, Registry
from fleet_slip.selection_plan import SelectionPlan, run_plan
from fleet_slip.warehouse import Warehouse

Reference = Annotated[
    str, typer.Argument(help="NAME, NAME@VERSION or NAME@ALIAS. NAME alone is its champion.")
]
Alias = Annotated[str, typer.Option(help="The alias to move.")]


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    for command in (publish, models, show, promote, rollback, score):
        app.command()(command)


def registry_of(warehouse: Warehouse, sign_key: Path | None = None) -> Registry:
    """Return the registry of a data root; it signs new versions if a key is configured."""
    return Registry(warehouse.root / "models", signing_key(sign_key))


@recorded
def publish(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the model, such as sideslip.")],
    cohort: Cohort = TRAINING_DRIVES,
    models: Models = None,
    nested: Nested = None,
    features: Features = None,
    by: FoldBy = None,
    folds: FoldCount = None,
    rank: Rank = None,
    criterion: Criterion = None,
    all_subsets: AllSubsets = False,
    naive: Naive = False,
    force: Annotated[
        bool, typer.Option("--force", help="Publish even what is worse than the champion.")
    ] = False,
    sign_key: SignKey = None,
    json: Json = False,
) -> None:
    """Select on a cohort and make the winner the next version of a model, and its champion.

    The options are those of select.
    """
    check_model_name(name)
    plan = SelectionPlan(
        cohort=cohort,
        models=models,
        nested=nested,
        features=features,
        by=by,
        folds=folds,
        rank=rank,
        criterion=criterion,
        all_subsets=all_subsets,
        naive=naive,
    )
    with step("select"):
        planned = run_plan(context.obj, plan)
    selection = planned.selection
    manifest = manifest_of(selection, name, planned.label, planned.config_sha256)
    registry = registry_of(context.obj, sign_key)
    publication = publish_selection(registry, manifest, selection, force=force)
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
    marked = Audit(context.obj.root).marked_models()
    rows = [
        {**row, "trained_on_forgotten": f"{row['name']}@{row['version']}" in marked}
        for row in registry.as_table().to_pylist()
        if name in (None, row["name"])
    ]
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
    for row in rows:
        if row["trained_on_forgotten"]:
            say(f"{row['name']}@{row['version']} was trained on drives that were forgotten since")
    if name:
        print_table(
            "\nhistory of aliases",
            ["at", "command", "alias", "version"],
            [
                [f"{move.at:%Y-%m-%d %H:%M:%S}", move.command, move.alias, str(move.version)]
                for move in registry.history(name).moves()
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
    if manifest.features:
        print_table(
            "\nfeatures: SQL over the counts of log_counts, clipped to +-32767, times the scale",
            ["feature", "scale", "SQL"],
            [[t.signal, f"{t.scale} {t.unit}", t.sql] for t in manifest.terms if t.sql],
            left=3,
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


@recorded
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


@recorded
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
