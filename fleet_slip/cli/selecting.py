"""Selecting: the command select, its options, and how a selection is printed."""

from collections.abc import Iterator
from typing import Annotated, Any

import typer

from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.cli.output import Json, print_json, print_table, say, stdout
from fleet_slip.grams.folding import ROW_FOLDS, FoldKey
from fleet_slip.regression.criteria import CRITERIA
from fleet_slip.regression.crossval import CrossValidation
from fleet_slip.regression.nested_choice import CROSS_VALIDATION, NestedChoice
from fleet_slip.regression.ranking import RANKINGS
from fleet_slip.regression.stepwise import METHODS
from fleet_slip.selection.compare import Selection
from fleet_slip.selection.model_list import DEFAULT_MOST
from fleet_slip.selection.request import (
    DEFAULT_MODELS,
    WORTH,
    SelectionRequest,
    answer_request,
    parse_worth,
)
from fleet_slip.selection.search import SearchChoice
from fleet_slip.selection.uncertainty import Uncertainty

Cohort = Annotated[
    str,
    typer.Option(help="SQL condition on the view drives, such as \"track = 'waterford_hills'\"."),
]
Models = Annotated[
    str | None,
    typer.Option(
        help=f"A model list of configs/models, or a TOML file. Default: {DEFAULT_MODELS}, unless "
        "--nested or an option that searches is given.",
        show_default=False,
    ),
]
Nested = Annotated[
    str | None,
    typer.Option(
        help="Add the nested models of an order of signals, separated by commas; 'catalogue' is "
        "all inputs in the order of configs/signals.toml."
    ),
]
Features = Annotated[
    str | None,
    typer.Option(
        help="Feature set of configs/features.toml, computed before with: fleet-slip gram "
        "--features NAME. Default: what the list says, else the logged signals."
    ),
]
FoldBy = Annotated[
    FoldKey | None,
    typer.Option(
        help="What a fold is made of. Default: what the list says. By row is WEKA's way and leaks."
    ),
]
FoldCount = Annotated[
    str | None,
    typer.Option(
        "--folds",
        metavar="NUMBER|each",
        help="Number of folds, or each: every drive, or whatever folds are made of, is a fold of "
        "its own. Default: what the list says.",
    ),
]
Rank = Annotated[
    str | None,
    typer.Option(
        help=f"Rank the inputs of --nested first: {', '.join(RANKINGS)}. Default: declared.",
        show_default=False,
    ),
]
Criterion = Annotated[
    str | None,
    typer.Option(
        help="What decides how many of the ranked inputs are kept: cv (the smallest model that "
        f"falls negligibly short of the best; see --worth), {', '.join(CRITERIA)}. Default: cv.",
        show_default=False,
    ),
]
WorthOption = Annotated[
    str,
    typer.Option(
        "--worth",
        help="The smallest gain in RMSE that is worth a signal, such as 0.005deg or 2%. Of the "
        "models that fall less short of the best, or by no more than one standard error of the "
        "difference, that with the fewest signals wins.",
    ),
]
AllSubsets = Annotated[
    bool,
    typer.Option(
        "--all-subsets", help="Search all subsets of the inputs of --nested instead of an order."
    ),
]
SearchMethod = Annotated[
    str | None,
    typer.Option(
        "--search",
        help=f"Search among the inputs of --nested, or all: {', '.join(METHODS)}; the search is "
        "made again in every fold. Adds its models of 1, 2, ... columns.",
        show_default=False,
    ),
]
Most = Annotated[
    int | None,
    typer.Option(min=1, max=200, help=f"Most columns of --search. Default: {DEFAULT_MOST}."),
]
Naive = Annotated[
    bool,
    typer.Option(
        "--naive",
        help="Take rows for independent evidence, not drives. At 100 Hz they are not: then every "
        "criterion keeps nearly everything.",
    ),
]
Repeat = Annotated[
    int | None,
    typer.Option(min=2, help="Cross-validate the winner again with so many other deals of folds."),
]
Bootstrap = Annotated[
    int | None,
    typer.Option(
        min=100,
        help="Confidence interval of the winner's correlation by drawing the drives so many times.",
    ),
]


FIGURES = ("drives", "correlation", "RMSE deg", "mean deg", "std deg", "condition")


def register(app: typer.Typer) -> None:
    """Add the command of this module."""
    app.command()(select)


def select(
    context: typer.Context,
    cohort: Cohort = TRAINING_DRIVES,
    models: Models = None,
    nested: Nested = None,
    features: Features = None,
    by: FoldBy = None,
    folds: FoldCount = None,
    rank: Rank = None,
    criterion: Criterion = None,
    worth: WorthOption = WORTH,
    all_subsets: AllSubsets = False,
    naive: Naive = False,
    search: SearchMethod = None,
    most: Most = None,
    repeat: Repeat = None,
    bootstrap: Bootstrap = None,
    json: Json = False,
) -> None:
    """Compare models on a cohort by cross-validation and choose one. Reads Gram rows only.

    Compare a list of models: **fleet-slip select --models table1**

    Find an order and a place to stop: **fleet-slip select --rank backward --criterion bic**

    Choose among many columns: **fleet-slip select --features windows --search exchange --most 12**

    Search all subsets: **fleet-slip select --all-subsets --criterion cv --bootstrap 1000**
    """
    request = SelectionRequest(
        cohort=cohort,
        models=models,
        nested=nested,
        features=features,
        by=by,
        folds=folds,
        rank=rank,
        criterion=criterion,
        worth=parse_worth(worth),
        all_subsets=all_subsets,
        naive=naive,
        search=search,
        most=most,
        repeat=repeat,
        bootstrap=bootstrap,
    )
    selection = answer_request(context.obj, request).selection
    if json:
        print_json(selection.as_dict())
    else:
        print_selection(selection)


def print_selection(selection: Selection[Any]) -> None:
    """Print the table of a selection, the winner and why, and how sure that is."""
    where = selection.cohort.condition
    # The signals of an order or of subsets stand in the table above it.
    listed = selection.choice is None
    if selection.choice is not None:
        _print_choice(selection.choice)
    print_table(
        f"{selection.cohort.drive_count:,} drives, {selection.cohort.rows:,} rows"
        + ("" if where == TRAINING_DRIVES else f" where {where}")
        + f"; {len(selection.models[0].folds)} folds by {selection.folds.by}",
        ["model", *(["signals"] if listed else []), *FIGURES],
        [
            [model.name, *([_columns_of(model, selection)] if listed else []), *_figures(model)]
            for model in selection.models
        ],
        left=1 + listed,
    )
    if selection.folds.by == ROW_FOLDS:
        say(
            "folds of rows leak: each test row's neighbours at 100 Hz are training rows, so that "
            "these figures are those of the fit, not of prediction. Compare with --by drive."
        )
    for name, reason in selection.skipped.items():
        say(f"model {name} was left out: {reason}")
    stdout().print(
        f"winner: {selection.winner.model.name}. {selection.winner.reason}", markup=False
    )
    if selection.choice is not None and selection.choice.honest is not None:
        _print_honest(selection.choice.honest)
    if selection.uncertainty is not None:
        _print_uncertainty(selection.uncertainty)


def _columns_of(model: CrossValidation, selection: Selection[Any]) -> str:
    """Return a model's signals; of one that a search found, what its size changed."""
    found = selection.searched.models if selection.searched else ()
    if model not in found or model is selection.winner.model:
        return " ".join(model.signals)
    before = found[len(model.signals) - 2].signals if len(model.signals) > 1 else ()
    added = [f"+{name}" for name in model.signals if name not in before]
    removed = [f"-{name}" for name in before if name not in model.signals]
    return " ".join([*added, *removed])


def _figures(model: CrossValidation) -> list[str]:
    return [
        f"{model.drives:,}",
        f"{model.correlation:.4f}",
        f"{model.pooled.rmse_deg:.4f}",
        f"{model.pooled.error_mean_deg:+.4f}",
        f"{model.pooled.error_std_deg:.4f}",
        f"{model.condition_number:.3g}",
    ]


def _print_choice(choice: SearchChoice) -> None:
    worth = (
        f"taking {choice.evidence.kind} for independent, the cohort is worth "
        f"{choice.evidence.rows:,.0f} rows"
    )
    if choice.nested is not None:
        nested = choice.nested
        print_table(
            f"order by {choice.rule.ranking}; {worth}",
            ["", "added", "contribution A", "D to full", "expected D", _criterion_name(choice)],
            _order_rows(nested),
            left=2,
        )
    if choice.subsets is not None and choice.picks is not None:
        print_table(
            f"best subset of every size; {worth}",
            ["size", "signals", "picked by", "R squared", "gap to second"],
            [
                [
                    str(result.best.size),
                    " ".join(result.best.model.signals),
                    " ".join(c for c, size in choice.picks.items() if size == result.best.size),
                    f"{result.best.r_squared:.6f}",
                    "" if result.gap is None else f"{result.gap:.2g}",
                ]
                for result in choice.subsets
            ],
            left=3,
        )


def _criterion_name(choice: SearchChoice) -> str:
    if choice.rule.criterion == CROSS_VALIDATION:
        return "minus correlation"
    return choice.rule.criterion


def _order_rows(nested: NestedChoice) -> Iterator[list[str]]:
    """Return a line for each of the k+1 models, the empty one first.

    The distance D is that of the paper's equation (2), in units of the noise: from the full model,
    and as it is to be expected from the true one.
    """
    evidence = nested.evidence
    columns = zip(nested.values, evidence.excess(), evidence.distances(), strict=True)
    for j, (value, to_full, expected) in enumerate(columns):
        added = nested.order[j - 1] if j else "(none)"
        contribution = f"{evidence.contributions[j - 1]:,.1f}" if j else ""
        mark = " <" if j == nested.size else "  "
        figures = [contribution, f"{to_full:,.1f}", f"{expected:,.1f}"]
        yield [str(j), added, *figures, f"{value:,.4f}{mark}"]


def _print_honest(honest: CrossValidation) -> None:
    stdout().print(
        "made again inside every training fold, the whole choice has a correlation of "
        f"{honest.correlation:.4f} and an RMSE of {honest.pooled.rmse_deg:.4f} deg.",
        markup=False,
    )


def _print_uncertainty(found: Uncertainty) -> None:
    if found.interval is not None:
        stdout().print(
            f"{found.interval.level:.0%} interval of the winner's correlation, drawing its drives "
            f"{found.interval.replicates:,} times: {found.interval.low:.4f} to "
            f"{found.interval.high:.4f}.",
            markup=False,
        )
    if found.repeated_mean is not None and found.repeated_spread is not None:
        stdout().print(
            f"{found.repeats} other deals of the drives into folds: correlation "
            f"{found.repeated_mean:.5f} +- {found.repeated_spread:.5f}.",
            markup=False,
        )
