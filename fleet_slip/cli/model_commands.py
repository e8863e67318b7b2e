"""Commands for published models: models, show, promote, rollback, pin, unpin, diff, export."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from fleet_slip.base import pluralize
from fleet_slip.cli import options as opt
from fleet_slip.cli.options import fleet_of, recorded
from fleet_slip.cli.output import print_answer, print_json, print_parts, say
from fleet_slip.rendering import Part, TextTable

if TYPE_CHECKING:
    from fleet_slip.models.manifest import CrossValidated, LearnedFrom
    from fleet_slip.models.registry import ModelVersion


def models(
    context: typer.Context,
    name: Annotated[
        str | None,
        typer.Argument(help="Name of a model: list its versions and the history of its aliases."),
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
    context: typer.Context,
    model: opt.Model = None,
    everything: opt.All = False,
    json: opt.Json = False,
) -> None:
    """Show one model version: figures, training data and coefficients.

    With --all, coefficients to the last digit, and the SQL of features.

    Example: fleet-slip show waterford
    """
    version = fleet_of(context).models.get(model)
    if json:
        from fleet_slip.export.costs import costs_content

        head = {
            "version": version.version,
            "sha256": version.sha256,
            "on_board": costs_content(version),
        }
        print_json({**head, **version.manifest.model_dump(mode="json")})
    else:
        print_parts(_version_parts(version, everything))


def _label_text(learned: "LearnedFrom") -> str:
    """Describe the label of a model without a reference sensor, and its intercept."""
    times = learned.change_s
    intervals = ", ".join(f"{time:g}" for time in (times if isinstance(times, tuple) else (times,)))
    text = f"changes of the {learned.label} over {intervals} s: the figures are of changes"
    if not learned.cars:
        return f"{text}. No intercept: it goes through the origin"
    error = learned.intercept_uncertainty_deg
    uncertainty = "uncertainty unknown" if error is None else f"uncertain by {error:.2g} deg"
    return (
        f"{text}. Intercept where {pluralize(learned.cars, 'car')} "
        f"{'goes' if learned.cars == 1 else 'go'} straight, {uncertainty}"
    )


def _version_parts(version: "ModelVersion", everything: bool) -> Iterator[Part]:
    """Render a model version."""
    manifest = version.manifest
    label, origin = manifest.label, manifest.through_origin
    yield (
        f"{version.reference}: {label.column} = {'' if origin else 'intercept + '}"
        f"sum of coefficient * signal{', through the origin' if origin else ''}"
    )
    properties = {**_properties(version), **({"sha256": version.sha256} if everything else {})}
    yield TextTable("", "|", properties.items(), text_columns=2)
    form = repr if everything else "{:.6g}".format
    terms = [] if origin else [["intercept", label.unit, form(manifest.intercept), ""]]
    for term in manifest.terms:
        per_count = f"{float(term.coefficient_exact * term.scale_exact):.9g}"
        terms.append([term.column, term.unit, form(term.coefficient), per_count])
    header = "signal|unit|coefficient"
    if not everything:
        yield TextTable("", header, [row[:3] for row in terms], text_columns=2)
        return
    yield TextTable("", f"{header}|per count", terms, text_columns=2)
    yield "per count: coefficient times scale, for an ECU that works on raw counts"
    if manifest.features:
        yield TextTable(
            "\nfeatures: SQL over the counts of log_counts, clipped to +-32767, times the scale",
            "feature|scale|SQL",
            (term for term in manifest.terms if term.sql),
            "{signal}|{scale} {unit}|{sql}",
            text_columns=3,
        )


def _properties(version: "ModelVersion") -> dict[str, str]:
    """Return the properties of a version, with their names."""
    from fleet_slip.export.costs import describe_costs
    from fleet_slip.warehouse.predicate import describe_cohort

    manifest = version.manifest
    figures, trained, selected = (
        manifest.cross_validation,
        manifest.trained_on,
        manifest.selected_by,
    )
    drives = f"{pluralize(trained.drives, 'drive')} of {pluralize(trained.vehicles, 'car')}, "
    drives += pluralize(trained.rows, "row")
    properties = {
        "correlation": f"{figures.correlation:.4f} (s.e. {figures.correlation_standard_error:.2g})",
        "RMSE": f"{figures.rmse_deg:.4f} deg",
        "label noise": _label_noise(figures),
        "error std": f"{figures.error_std_deg:.4f} deg",
        "error mean": f"{figures.error_mean_deg:+.4f} deg",
        "on board": describe_costs(version),
        "cross-validation": f"{pluralize(figures.folds, 'fold')} by {figures.folds_by}",
        "cohort": f"{describe_cohort(trained.cohort)}: {drives}",
        "tables": f"logs version {trained.logs_version}, grams {trained.grams_version}",
        "selected": f"model {selected.model} of {selected.model_list}",
        "why": selected.reason,
    }
    if line := manifest.line:
        properties["inner line"] = f"{line}, fitted first; feature set {trained.feature_set}"
    if prior := manifest.prior:
        properties["prior"] = (
            f"{prior.campaign}: {pluralize(prior.drives, 'simulated drive')} of "
            f"{', '.join(prior.vehicles)}, each row with the weight {prior.weight}"
        )
    if learned := manifest.learned_from:
        properties["learned from"] = _label_text(learned)
    if manifest.assumed:
        properties["assumed"] = "; ".join(manifest.assumed)
    if source := manifest.imported_from:
        properties["imported"] = (
            f"from {source.reference} of another data root, sha256 {source.sha256}"
        )
    return properties


def _label_noise(figures: "CrossValidated") -> str:
    """Describe the share of label noise in the RMSE."""
    if figures.label_noise_deg is None:
        return "unknown, and part of the RMSE"
    rmse_deg = figures.beyond_label_noise_deg
    return f"{figures.label_noise_deg:.4f} deg, without which the RMSE is {rmse_deg:.4f} deg"


@recorded
def promote(
    context: typer.Context,
    reference: Annotated[str, typer.Argument(help="NAME@VERSION.")],
    alias: opt.Alias = "champion",
) -> None:
    """Point an alias, by default champion, at a version.

    Example: fleet-slip promote waterford@2
    """
    version = fleet_of(context).models.promote(reference, alias)
    say(f"{version.manifest.name}@{alias} is now version {version.version}")


@recorded
def rollback(context: typer.Context, model: opt.ModelName, alias: opt.Alias = "champion") -> None:
    """Point an alias back at its previous version, and pin it there.

    Example: fleet-slip rollback waterford
    """
    version = fleet_of(context).models.rollback(model, alias)
    say(
        f"{model}@{alias} is version {version.version} again, and pinned until: fleet-slip promote "
        f"NAME@VERSION, or fleet-slip unpin {model}"
    )


@recorded
def pin(context: typer.Context, model: opt.ModelName, alias: opt.Alias = "champion") -> None:
    """Keep an alias at its version: publications become candidates, until promote or unpin.

    Example: fleet-slip pin waterford
    """
    version = fleet_of(context).models.pin(model, alias)
    say(f"{model}@{alias} is pinned to version {version.version}")


@recorded
def unpin(context: typer.Context, model: opt.ModelName, alias: opt.Alias = "champion") -> None:
    """Let publications move an alias again.

    Example: fleet-slip unpin waterford
    """
    version = fleet_of(context).models.unpin(model, alias)
    say(f"{model}@{alias} is version {version.version}; publications may move it")


def diff(
    context: typer.Context, first: opt.Version, second: opt.Version, json: opt.Json = False
) -> None:
    """Compare two versions of a model: data, prior, signals, coefficients, figures.

    Example: fleet-slip diff waterford@1 waterford@2
    """
    print_answer(fleet_of(context).models.diff(first, second), json)


def export(
    context: typer.Context,
    to: Annotated[
        Literal["json", "c", "sql", "dbc", "onnx", "fmu"],
        typer.Option(help="Target of the export."),
    ],
    model: opt.Model = None,
    output: Annotated[
        Path, typer.Option(help="Folder to write into; files of the same names are replaced.")
    ] = Path(),
    with_gram: Annotated[
        bool, typer.Option("--with-gram", help="With C: also the code for Gram rows on board.")
    ] = False,
    json: opt.Json = False,
) -> None:
    """Export a version as C, SQL, ONNX, FMU, DBC or JSON, with test vectors.

    Example: fleet-slip export waterford --to c --output export
    """
    files = fleet_of(context).models.export(model, to, output, with_gram=with_gram)
    if json:
        print_json({"files": [str(path) for path in files]})
        return
    for path in files:
        say(f"{path}: {path.stat().st_size:,} bytes")
