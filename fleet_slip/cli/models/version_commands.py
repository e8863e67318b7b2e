"""Commands that serve models: models, show, promote, rollback, pin, unpin."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from fleet_slip.api.fleet import Fleet
from fleet_slip.catalogue.definitions import Definition
from fleet_slip.cli.completing import complete_model
from fleet_slip.cli.model_argument import OnlyModel
from fleet_slip.cli.output import All, Json, print_json, print_table, print_text, say
from fleet_slip.cli.record_runs import record_run
from fleet_slip.errors import UsageError
from fleet_slip.export.costs import costs_content, describe_costs
from fleet_slip.models.aliases import CHAMPION
from fleet_slip.models.manifest import CrossValidated, LearnedFrom, ModelTerm
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.words import number_of

Reference = Annotated[
    str,
    typer.Argument(
        help="NAME, NAME@VERSION or NAME@ALIAS. NAME alone is its champion.",
        autocompletion=complete_model,
    ),
]
Alias = Annotated[str, typer.Option(help="The alias to move.")]


def models(
    context: typer.Context,
    name: Annotated[
        str | None,
        typer.Argument(
            help="Show one model's versions and history. Or: import, and a FILE that export --to "
            "json wrote, to bring its version in."
        ),
    ] = None,
    file: Annotated[Path | None, typer.Argument(help="The file to import.")] = None,
    everything: All = False,
    json: Json = False,
) -> None:
    """List the published model versions, or bring one in from elsewhere: models import FILE.

    Example: **fleet-slip models**
    """
    fleet: Fleet = context.obj
    if file is not None:
        _import_model(fleet, name, file, json)
        return
    if name == "import" and name not in fleet.registry().names():
        raise UsageError("which file? Run: fleet-slip models import FILE")
    rows = fleet.models(name).to_pylist()
    if json:
        print_json(rows)
        return
    if not rows:
        say("no model has been published yet. Run: fleet-slip publish NAME")
        return
    _print_models(rows, everything)
    for row in rows:
        if row["trained_on_forgotten"]:
            say(f"{row['name']}@{row['version']} was trained on drives that were forgotten since")
    if name:
        print_table(
            "\nhistory of aliases",
            ["at", "command", "alias", "version"],
            [
                [f"{move.at:%Y-%m-%d %H:%M:%S}", move.command, move.alias, str(move.version)]
                for move in fleet.registry().history(name).moves()
            ],
            left=3,
        )


def _print_models(rows: Sequence[Mapping[str, Any]], everything: bool) -> None:
    """Print a line for each version; with the names of its signals if all is asked for."""
    more = ["error std deg", "rows"] if everything else []
    print_table(
        "",
        ["model", "aliases", "signals", "published", "correlation", "RMSE deg", "drives", *more],
        [
            [
                f"{row['name']}@{row['version']}",
                row["aliases"].replace(",", ", "),
                row["signals"].replace(",", " ")
                if everything
                else str(len(row["signals"].split(","))),
                f"{row['published_at']:%Y-%m-%d %H:%M}" if row["published_at"] else "",
                f"{row['correlation']:.4f}",
                f"{row['rmse_deg']:.4f}",
                f"{row['drives']:,}",
                *([f"{row['error_std_deg']:.4f}", f"{row['rows']:,}"] if everything else []),
            ]
            for row in rows
        ],
        left=4,
    )


def _import_model(fleet: Fleet, word: str | None, file: Path, json: bool) -> None:
    if word != "import":
        raise UsageError(f"{word!r}: a file is for import. Run: fleet-slip models import {file}")
    version = fleet.import_model(file)
    origin = version.manifest.imported_from
    if json:
        told = origin.model_dump() if origin else None
        print_json({"model": version.reference, "sha256": version.sha256, "imported_from": told})
        return
    came = f"imported from {origin.reference}" if origin else "is there already, made here"
    say(f"{version.reference}: {came}. To use it: fleet-slip promote {version.reference}")


def show(
    context: typer.Context, model: OnlyModel = None, everything: All = False, json: Json = False
) -> None:
    """Show one model version: figures, the data that made it, and coefficients.

    With --all, coefficients to the last digit, and what each column is.

    Example: **fleet-slip show waterford**
    """
    version: ModelVersion = context.obj.model(model)
    if json:
        content = version.manifest.model_dump(mode="json")
        facts = {
            "version": version.version,
            "sha256": version.sha256,
            "on_board": costs_content(version.manifest),
        }
        print_json({**facts, **content})
    else:
        _print_version(version, everything)


def _definition_row(term: ModelTerm, one: Definition) -> list[str]:
    times = [one.fact.name] if one.fact else []
    if gate := one.gate:
        knots = [str(knot) for knot in (gate.low, gate.peak, gate.high) if knot is not None]
        times.append(f"{gate.by.over or ''} {gate.by.of} {gate.by.ticks or ''}: {' '.join(knots)}")
    window = [one.of, one.over or "", str(one.ticks or ""), str(one.bits)]
    return [term.signal, f"{term.scale} {term.unit}", *window, ", ".join(times).strip()]


def _teacher(learned: LearnedFrom) -> str:
    """Say what stood for a label, and where the intercept is from."""
    times = learned.change_s
    over = ", ".join(f"{one:g}" for one in (times if isinstance(times, tuple) else (times,)))
    told = f"changes of the {learned.label} over {over} s: the figures are of changes"
    if not learned.cars:
        return f"{told}. No intercept: it goes through the origin"
    unsure = learned.intercept_uncertainty_deg
    uncertain = "not known how surely" if unsure is None else f"uncertain by {unsure:.2g} deg"
    return (
        f"{told}. Intercept where {number_of(learned.cars, 'car')} "
        f"{'goes' if learned.cars == 1 else 'go'} straight, {uncertain}, between cars "
        f"{learned.intercept_spread_deg:.3f} deg"
    )


def _print_version(version: ModelVersion, everything: bool) -> None:
    manifest = version.manifest
    label, origin = manifest.label, manifest.through_origin
    print_text(
        f"{version.reference}: {label.column} = {'' if origin else 'intercept + '}"
        f"sum of coefficient * signal{', through the origin' if origin else ''}"
    )
    facts = {**_facts(version), **({"sha256": version.sha256} if everything else {})}
    print_table("", ["", ""], facts.items(), left=2)
    form = repr if everything else "{:.6g}".format
    terms = [] if origin else [["intercept", label.unit, form(manifest.intercept), ""]]
    for term in manifest.terms:
        per_count = f"{float(term.coefficient_exact * term.scale_exact):.9g}"
        terms.append([term.column, term.unit, form(term.coefficient), per_count])
    shown = 4 if everything else 3
    header = ["signal", "unit", "coefficient", "per count"]
    print_table("", header[:shown], [row[:shown] for row in terms], left=2)
    if not everything:
        return
    print_text("per count: coefficient times scale, for an ECU that works on raw counts")
    if manifest.features:
        print_table(
            "\nfeatures: SQL over the counts of log_counts, clipped to +-32767, times the scale",
            ["feature", "scale", "SQL"],
            [[t.signal, f"{t.scale} {t.unit}", t.sql] for t in manifest.terms if t.sql],
            left=3,
        )
    if manifest.definitions:
        print_table(
            "\ncolumns over time (docs/memory.md): counts, times the scale",
            ["column", "scale", "of", "over", "ticks", "bits", "times"],
            [_definition_row(term, own) for term in manifest.terms if (own := term.definition)],
            left=4,
        )


def _facts(version: ModelVersion) -> dict[str, str]:
    """Return what a version says of itself in sentences."""
    manifest = version.manifest
    figures, trained, chosen = (
        manifest.cross_validation,
        manifest.trained_on,
        manifest.selected_by,
    )
    cars = "" if trained.vehicles is None else f" of {number_of(trained.vehicles, 'car')}"
    drives = f"{number_of(trained.drives, 'drive')}{cars}, {number_of(trained.rows, 'row')}"
    facts = {
        "correlation": f"{figures.correlation:.4f} (s.e. {figures.correlation_standard_error:.2g})",
        "RMSE": f"{figures.rmse_deg:.4f} deg",
        "label noise": _label_noise(figures),
        "error std": f"{figures.error_std_deg:.4f} deg",
        "error mean": f"{figures.error_mean_deg:+.4f} deg",
        "on board": describe_costs(manifest),
        "cross-validation": f"{number_of(figures.folds, 'fold')} by {figures.folds_by}",
        "cohort": f"{trained.cohort}: {drives}",
        "tables": f"logs version {trained.logs_version}, grams {trained.grams_version}",
        "selected": f"model {chosen.model} of {chosen.model_list}",
        "why": chosen.reason,
    }
    if learned := manifest.learned_from:
        facts["learned from"] = _teacher(learned)
    if one := manifest.imported_from:
        facts["imported"] = f"from {one.reference} of another data root, sha256 {one.sha256}"
    return facts


def _label_noise(figures: CrossValidated) -> str:
    """Return how much of the RMSE is noise of the label."""
    if figures.label_noise_deg is None:
        return "not known, and part of the RMSE"
    left = figures.beyond_label_noise_deg
    return f"{figures.label_noise_deg:.4f} deg, without which the RMSE is {left:.4f} deg"


@record_run
def promote(
    context: typer.Context,
    reference: Annotated[
        str,
        typer.Argument(help="NAME@VERSION to point the alias at.", autocompletion=complete_model),
    ],
    alias: Alias = CHAMPION,
) -> None:
    """Point an alias, the champion unless told otherwise, at a version.

    Example: **fleet-slip promote waterford@2**
    """
    version = context.obj.promote(reference, alias)
    say(f"{version.manifest.name}@{alias} is now version {version.version}")


@record_run
def rollback(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the model.", autocompletion=complete_model)],
    alias: Alias = CHAMPION,
) -> None:
    """Point an alias back at the version that it had before; no publication moves it from there.

    Until promote or unpin.

    Example: **fleet-slip rollback waterford**
    """
    version = context.obj.rollback(name, alias)
    say(
        f"{name}@{alias} is version {version.version} again, and stays so until: fleet-slip "
        f"promote, or fleet-slip unpin {name}"
    )


@record_run
def pin(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the model.", autocompletion=complete_model)],
    alias: Alias = CHAMPION,
) -> None:
    """Keep an alias where it is: publications become candidates, until promote or unpin.

    Example: **fleet-slip pin waterford**
    """
    version = context.obj.pin(name, alias)
    say(f"{name}@{alias} is pinned to version {version.version}")


@record_run
def unpin(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the model.", autocompletion=complete_model)],
    alias: Alias = CHAMPION,
) -> None:
    """Let publications move an alias again, after pin or rollback.

    Example: **fleet-slip unpin waterford**
    """
    version = context.obj.unpin(name, alias)
    say(f"{name}@{alias} is version {version.version}; the next publication may move it")
