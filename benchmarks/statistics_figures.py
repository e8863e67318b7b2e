"""Figures and numbers of docs/statistics.md, from the Gram rows of a campaign that has been run.

python -m benchmarks.statistics_figures ROOT [CAMPAIGN] [--output docs/images]
"""

import argparse
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from fleet_slip.grams.cohort import load_cohort
from fleet_slip.regression.choice import PRICES, Rule, choose_nested, criterion_values, nested_fits
from fleet_slip.regression.folds import CohortFolds, Folds, by_hash
from fleet_slip.regression.gram import complete_cases
from fleet_slip.regression.inference import DriveMoments, Evidence, infer
from fleet_slip.regression.least_squares import correlation_matrix
from fleet_slip.regression.orders import RANKINGS, all_rss, best_subsets, rank, subset_sizes
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG

SIGNALS = CATALOG.signals
LABEL = SIGNALS.label
NINE = tuple(name for name in SIGNALS.inputs if name != "steering_wheel")
SCALES = {name: SIGNALS[name].exact_scale for name in SIGNALS.gram_signals}


def load(root: str, campaign: str) -> tuple[Folds, DriveMoments]:
    cohort = load_cohort(Warehouse(LocalFolder(Path(root))), f"campaign = '{campaign}'")
    table, mask = complete_cases(cohort.tables, [*NINE, LABEL])
    ids = [
        name for name, yes in zip(cohort.drives["drive_id"].to_pylist(), mask, strict=True) if yes
    ]
    assignment = by_hash(ids, 5)
    folds = CohortFolds.from_tables([table], assignment).complete_cases(NINE, LABEL)
    return folds, DriveMoments.from_table(table)


def evidence(folds: Folds, moments: DriveMoments, output: Path) -> None:
    total = folds.total
    order = rank("backward", total, NINE, LABEL)
    fits = nested_fits(total, order, LABEL)
    rows, drives = Evidence.measure(fits), Evidence.measure(fits, moments)
    print(f"rows {rows.rows:.0f}, effective {drives.rows:.0f}, effect {drives.design_effect:.0f}")
    for name, a, b in zip(order, rows.contributions, drives.contributions, strict=True):
        print(f"  {name:<10} A by rows {a:14.1f}   A by drives {b:12.1f}")
    for name in PRICES:
        sizes = [int(np.argmin(criterion_values(name, measured))) for measured in (rows, drives)]
        print(f"  {name:<15} keeps {sizes[0]} by rows, {sizes[1]} by drives")
    naive, robust = (
        infer(fits[-1], SCALES),
        infer(fits[-1], SCALES, moments),
    )
    for naive_estimate, other in zip(naive.estimates, robust.estimates, strict=True):
        errors = f"{naive_estimate.standard_error:.2g} or {other.standard_error:.2g}"
        print(f"  {naive_estimate.name:<10} {naive_estimate.value:12.6f} +- {errors}")
    figure, axes = plt.subplots(figsize=(6.4, 3.4))
    at = np.arange(len(order))
    axes.bar(at - 0.2, rows.contributions, 0.4, label="rows taken for independent")
    axes.bar(at + 0.2, drives.contributions, 0.4, label="drives taken for independent")
    axes.axhline(2, color="black", linewidth=0.8, label="price of AIC")
    axes.axhline(np.log(drives.rows), color="black", linewidth=0.8, linestyle=":", label="of BIC")
    axes.set_yscale("log")
    axes.set_ylabel("contribution A")
    axes.set_xticks(at, order, rotation=30, ha="right")
    axes.legend(fontsize=8)
    save(figure, output / "statistics_contributions.svg")


def orders(folds: Folds, moments: DriveMoments, output: Path) -> None:
    figure, axes = plt.subplots(figsize=(6.4, 3.4))
    for name, style in zip(RANKINGS, ("-", "-", ":"), strict=True):
        choice = choose_nested(folds, moments, NINE, LABEL, SCALES, Rule(name))
        print(f"  {name:<17} {' '.join(choice.order)}")
        sizes = range(1, len(choice.order) + 1)
        rmse = [model.pooled.rmse_deg for model in choice.models]
        axes.plot(sizes, rmse, style, marker="o", markersize=3, label=name)
    axes.set_xlabel("number of signals")
    axes.set_ylabel("cross-validated RMSE, deg")
    axes.set_yscale("log")
    axes.legend(fontsize=8, title="order")
    save(figure, output / "statistics_nested.svg")


def subsets(folds: Folds, output: Path) -> None:
    total = folds.total
    results = best_subsets(total, NINE, LABEL)
    for fit in results:
        print(f"  {fit.size} R2 {fit.r_squared:.5f} {' '.join(fit.model.signals)}")
    rss = all_rss(correlation_matrix(total.restrict([*NINE, LABEL])))
    size = subset_sizes(len(NINE)).astype(np.float64)
    figure, axes = plt.subplots(figsize=(6.4, 3.4))
    spread = np.random.default_rng(0).uniform(-0.25, 0.25, len(size))
    axes.plot(size + spread, rss, ".", markersize=3, color="grey", label="all 512 subsets")
    best = [float(fit.rss / results[0].rss) for fit in results]
    axes.plot(range(len(best)), best, "o-", markersize=4, label="best of each size")
    axes.set_yscale("log")
    axes.set_xlabel("number of signals")
    axes.set_ylabel("unexplained share, 1 - R²")
    axes.legend(fontsize=8)
    save(figure, output / "statistics_subsets.svg")


def save(figure: Figure, file: Path) -> None:
    figure.tight_layout()
    figure.savefig(file, metadata={"Date": None})
    plt.close(figure)


def main() -> None:
    mpl.rcParams.update({"svg.hashsalt": "fleet-slip", "axes.grid": True, "grid.alpha": 0.3})
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root")
    parser.add_argument("campaign", nargs="?", default="waterford")
    parser.add_argument("--output", type=Path, default=Path(), help="folder of the pictures")
    arguments = parser.parse_args()
    folds, moments = load(arguments.root, arguments.campaign)
    arguments.output.mkdir(parents=True, exist_ok=True)
    print(f"{folds.drives} drives, {folds.total.n} rows")
    evidence(folds, moments, arguments.output)
    orders(folds, moments, arguments.output)
    subsets(folds, arguments.output)


if __name__ == "__main__":
    main()
