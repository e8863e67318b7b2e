"""Commands that serve models: models, show, promote, pin, diff, export."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

from fleet_slip.api.fleet import Fleet
from fleet_slip.base import pluralize
from fleet_slip.cli.options import command
from fleet_slip.cli.output import All, Json, print_json, print_parts, say
from fleet_slip.models.manifest import CrossValidated, LearnedFrom
from fleet_slip.models.registry import ModelVersion
from fleet_slip.rendering import Part, TextTable
from fleet_slip.warehouse.predicate import describe_cohort


@command()
def models(
    fleet: Fleet,
    name: Annotated[
        str | None,
        typer.Argument(help="Show one model's versions and history."),
    ] = None,
    json: Json = False,
) -> None:
    """List the published model versions.

    Example: fleet-slip models
    """
    rows = fleet.models(name).to_pylist()
    if json:
        print_json(rows)
        return
    if not rows:
        say("no model has been published yet. Run: fleet-slip publish NAME")
        return
    shown = (
        {**row, "aliases": row["aliases"].split(","), "inputs": row["signals"].count(",") + 1}
        for row in rows
    )
    header = "model|aliases|signals|published|correlation|RMSE deg|drives"
    form = "{name}@{version}|{aliases}|{inputs}|{published_at:%Y-%m-%d %H:%M}|"
    form += "{correlation:.4f}|{rmse_deg:.4f}|{drives:,}"
    print_parts([TextTable("", header, shown, form, left=4)])
    for row in rows:
        if row["trained_on_forgotten"]:
            say(f"{row['name']}@{row['version']} was trained on drives that were forgotten since")
    if name:
        moves = fleet.registry().history(name).moves()
        header = "at|command|alias|version"
        form = "{at:%Y-%m-%d %H:%M:%S}|{command}|{alias}|{version}"
        print_parts([TextTable("\nhistory of aliases", header, moves, form, left=3)])


@command(Fleet.model, arguments=["model"])
def show(version: ModelVersion, everything: All = False, json: Json = False) -> None:
    """Show one model version: figures, the data that made it, and coefficients.

    With --all, coefficients to the last digit, and the SQL of features.

    Example: fleet-slip show waterford
    """
    if json:
        from fleet_slip.export.costs import costs_content  # noqa: PLC0415 - compiled code

        content = version.manifest.model_dump(mode="json")
        facts = {
            "version": version.version,
            "sha256": version.sha256,
            "on_board": costs_content(version),
        }
        print_json({**facts, **content})
    else:
        print_parts(_version_parts(version, everything))


def _teacher(learned: LearnedFrom) -> str:
    """Say what stood for a label, and where the intercept is from."""
    times = learned.change_s
    over = ", ".join(f"{one:g}" for one in (times if isinstance(times, tuple) else (times,)))
    told = f"changes of the {learned.label} over {over} s: the figures are of changes"
    if not learned.cars:
        return f"{told}. No intercept: it goes through the origin"
    unsure = learned.intercept_uncertainty_deg
    uncertain = "uncertainty unknown" if unsure is None else f"uncertain by {unsure:.2g} deg"
    return (
        f"{told}. Intercept where {pluralize(learned.cars, 'car')} "
        f"{'goes' if learned.cars == 1 else 'go'} straight, {uncertain}"
    )


def _version_parts(version: ModelVersion, everything: bool) -> Iterator[Part]:
    manifest = version.manifest
    label, origin = manifest.label, manifest.through_origin
    yield (
        f"{version.reference}: {label.column} = {'' if origin else 'intercept + '}"
        f"sum of coefficient * signal{', through the origin' if origin else ''}"
    )
    facts = {**_facts(version), **({"sha256": version.sha256} if everything else {})}
    yield TextTable("", "|", facts.items(), left=2)
    form = repr if everything else "{:.6g}".format
    terms = [] if origin else [["intercept", label.unit, form(manifest.intercept), ""]]
    for term in manifest.terms:
        per_count = f"{float(term.coefficient_exact * term.scale_exact):.9g}"
        terms.append([term.column, term.unit, form(term.coefficient), per_count])
    header = "signal|unit|coefficient"
    if not everything:
        yield TextTable("", header, [row[:3] for row in terms], left=2)
        return
    yield TextTable("", f"{header}|per count", terms, left=2)
    yield "per count: coefficient times scale, for an ECU that works on raw counts"
    if manifest.features:
        yield TextTable(
            "\nfeatures: SQL over the counts of log_counts, clipped to +-32767, times the scale",
            "feature|scale|SQL",
            (term for term in manifest.terms if term.sql),
            "{signal}|{scale} {unit}|{sql}",
            left=3,
        )


def _facts(version: ModelVersion) -> dict[str, str]:
    """Return what a version says of itself in sentences."""
    from fleet_slip.export.costs import describe_costs  # noqa: PLC0415 - compiled code

    manifest = version.manifest
    figures, trained, chosen = (
        manifest.cross_validation,
        manifest.trained_on,
        manifest.selected_by,
    )
    drives = f"{pluralize(trained.drives, 'drive')} of {pluralize(trained.vehicles, 'car')}, "
    drives += pluralize(trained.rows, "row")
    facts = {
        "correlation": f"{figures.correlation:.4f} (s.e. {figures.correlation_standard_error:.2g})",
        "RMSE": f"{figures.rmse_deg:.4f} deg",
        "label noise": _label_noise(figures),
        "error std": f"{figures.error_std_deg:.4f} deg",
        "error mean": f"{figures.error_mean_deg:+.4f} deg",
        "on board": describe_costs(version),
        "cross-validation": f"{pluralize(figures.folds, 'fold')} by {figures.folds_by}",
        "cohort": f"{describe_cohort(trained.cohort)}: {drives}",
        "tables": f"logs version {trained.logs_version}, grams {trained.grams_version}",
        "selected": f"model {chosen.model} of {chosen.model_list}",
        "why": chosen.reason,
    }
    if line := manifest.line:
        facts["inner line"] = f"{line}, fitted first; feature set {trained.feature_set}"
    if prior := manifest.prior:
        facts["prior"] = (
            f"{prior.campaign}: {pluralize(prior.drives, 'simulated drive')} of "
            f"{', '.join(prior.vehicles)}, each row with the weight {prior.weight}"
        )
    if learned := manifest.learned_from:
        facts["learned from"] = _teacher(learned)
    if manifest.assumed:
        facts["assumed"] = "; ".join(manifest.assumed)
    if one := manifest.imported_from:
        facts["imported"] = f"from {one.reference} of another data root, sha256 {one.sha256}"
    return facts


def _label_noise(figures: CrossValidated) -> str:
    """Return how much of the RMSE is noise of the label."""
    if figures.label_noise_deg is None:
        return "unknown, and part of the RMSE"
    left = figures.beyond_label_noise_deg
    return f"{figures.label_noise_deg:.4f} deg, without which the RMSE is {left:.4f} deg"


@command(Fleet.promote, arguments=["reference"], without=["json"])
def promote(version: ModelVersion, alias: str, previous: bool) -> None:
    """Point an alias, by default champion, at a version.

    Example: fleet-slip promote waterford@2
    """
    name = version.manifest.name
    say(
        f"{name}@{alias} is version {version.version} again, and pinned until: fleet-slip promote "
        f"NAME@VERSION, or fleet-slip pin {name} --off"
        if previous
        else f"{name}@{alias} is now version {version.version}"
    )


@command(Fleet.pin, arguments=["name"], without=["json"])
def pin(version: ModelVersion, name: str, alias: str, off: bool) -> None:
    """Keep an alias where it is: publications become candidates, until promote or pin --off.

    Example: fleet-slip pin waterford
    """
    done = "is pinned to version {}" if not off else "is version {}; publications may move it"
    say(f"{name}@{alias} {done.format(version.version)}")


@command(Fleet.diff, arguments=["one", "other"])
def diff() -> None:
    """Compare two versions of a model: data, prior, signals, coefficients, figures.

    Example: fleet-slip diff waterford@1 waterford@2
    """


@command(Fleet.export, arguments=["model"])
def export(files: Sequence[Path], json: Json = False) -> None:
    """Export a version as C, SQL, ONNX, FMU, DBC or JSON, with test vectors.

    Example: fleet-slip export waterford --to c --output export
    """
    if json:
        print_json({"files": [str(path) for path in files]})
        return
    for path in files:
        say(f"{path}: {path.stat().st_size:,} bytes")
