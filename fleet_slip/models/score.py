"""Evaluates a published model on the rows of a cohort, in SQL."""

from dataclasses import asdict, dataclass
from typing import Any

from fleet_slip.catalogue.feature_sql import with_features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError
from fleet_slip.models.manifest import Manifest
from fleet_slip.resources import read_sql
from fleet_slip.warehouse.condition import Condition, asking, parse_condition, row_columns
from fleet_slip.warehouse.table_views import connect_tables
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class Score:
    """Figures of the error, estimate minus truth, over the rows of a cohort with the signals."""

    rows: int
    correlation: float | None
    rmse_deg: float
    error_mean_deg: float
    error_std_deg: float
    error_mean_absolute_deg: float
    error_median_deg: float
    error_p95_deg: float
    error_p99_deg: float
    error_max_deg: float

    def as_dict(self) -> dict[str, Any]:
        """Return what `score --json` prints."""
        return asdict(self)


def score_statement(manifest: Manifest, condition: str | Condition) -> str:
    """Return `jobs/score.sql` for a model: its dot product over the logs in SI units.

    Features are computed as the manifest defines them, whatever they are called today. Raises
    `QuestionError` if the condition is not one expression on the columns of the view `log`.
    """
    terms = [f"{term.coefficient!r} * {term.column}" for term in manifest.terms]
    columns = [term.column for term in manifest.terms] + [manifest.label.column]
    return read_sql("jobs", "score.sql").format(
        estimate="\n        + ".join([repr(manifest.intercept), *terms]),
        label=manifest.label.column,
        rows=_rows(manifest),
        complete=" AND ".join(f"{column} IS NOT NULL" for column in columns),
        condition=parse_condition(condition, row_columns()).sql,
    )


def _rows(manifest: Manifest) -> str:
    """Return the view `log`, or for a model with features a subquery with their columns too."""
    if not manifest.features:
        return "log"
    columns = [
        *(f"{name} * {s.scale}::DOUBLE AS {s.column}" for name, s in catalogue().signals.items()),
        *(f"{t.signal} * {t.scale}::DOUBLE AS {t.column}" for t in manifest.terms if t.sql),
    ]
    separator = ",\n            "
    return f"""(
        SELECT
            *,
            {separator.join(columns)}
        FROM {with_features("log_counts", manifest.features)}
    )"""


def score(warehouse: Warehouse, manifest: Manifest, condition: str | Condition) -> Score:
    """Score a model on the rows of `log` that satisfy a condition.

    Raises like `score_statement`, and `DataError` if no such row has the model's signals.
    """
    condition = parse_condition(condition, row_columns())
    statement = score_statement(manifest, condition)
    with connect_tables(warehouse, statement) as database, asking(database, condition):
        result = database.execute(statement)
        names = [column[0] for column in result.description or ()]
        row = result.fetchone()
    if row is None or not row[0]:
        raise DataError(
            f"no row of the cohort {condition.text!r} has {', '.join(manifest.signals)} and "
            f"{manifest.label.signal}. Choose another cohort, or a model with fewer signals."
        )
    figures = dict(zip(names, row, strict=True))
    percentiles = figures.pop("error_percentiles_deg")
    median, p95, p99 = percentiles
    return Score(**figures, error_median_deg=median, error_p95_deg=p95, error_p99_deg=p99)
