"""Commands that choose a model: select, publish, diagnose."""

from pathlib import Path
from typing import Annotated

from typer import Context, Option

from fleet_slip.catalog.signals import TRAINING_DRIVES
from fleet_slip.cli import options as opt
from fleet_slip.cli.options import fleet_of, recorded
from fleet_slip.cli.output import print_answer, print_json, print_parts, say, write_text
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
            metavar="LIST.toml",
            help="Write what was compared as a model list, for publish --models.",
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
    from fleet_slip.models.request import SelectionRequest

    request = SelectionRequest(
        models=models,
        model=model,
        order=order,
        features=features,
        label=label,
        group_by=group_by,
        folds=folds,
        ranking=ranking,
        criterion=criterion,
        tolerance=tolerance,
        robust=robust,
        intercept=intercept,
        search=search,
        max_features=max_features,
        half_life=half_life,
        prior=prior,
    )
    drives = fleet_of(context).cohort(cohort, include_faulty=include_faulty)
    selection = drives.select(request)
    print_answer(selection, json, everything=everything, hint="--all")
    if save is not None:
        remark = f". Publish it: fleet-slip publish NAME --models {save}"
        write_text(save, selection.compared.as_toml(), "" if json else remark)


@recorded
def publish(
    context: Context,
    name: opt.ModelName,
    cohort: Annotated[
        str | None,
        Option(
            help="SQL predicate on the view drives. Default: the cohort of the model's champion; "
            "all drives, for a new model."
        ),
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
            help="Combine the model with a Kalman filter in this car, identified from the drives: "
            "a vehicle of configs/vehicles, or a TOML file with mass_kg, front_axle_m and "
            "rear_axle_m; none for no filter. Default: the champion's."
        ),
    ] = None,
    force: Annotated[
        bool, Option("--force", help="Publish even a model that is worse than the champion.")
    ] = False,
    candidate: Annotated[
        bool, Option("--candidate", help="Publish as a candidate; promote makes it champion.")
    ] = False,
    dry_run: Annotated[
        bool, Option("--dry-run", help="Print what would be published; publish nothing.")
    ] = False,
    json: opt.Json = False,
) -> None:
    """Select from a model list and publish the winner as a model's next version, its champion.

    A model that exists is trained again with the options of its champion; options that are given
    replace them. Explore with select; its --save writes a list for --models.

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
            help="Signals to fit instead of a published model, separated by commas; 'catalogue' is "
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
