"""The error for a cohort without drives."""

from fleet_slip.catalogue.features import features
from fleet_slip.errors import DataError
from fleet_slip.grams.cohorts.reader import GramReader, OpenedGrams, open_grams
from fleet_slip.warehouse.condition import Condition
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import number_of


def empty_cohort(
    source: Warehouse | GramReader, condition: Condition, feature_set: str
) -> DataError:
    """Return the error that tells why a condition leaves no drive, from all Gram rows."""
    with open_grams(source, feature_set, condition) as opened:  # all of them: it says what there is
        return empty_cohort_error(opened, condition)


def empty_cohort_error(opened: OpenedGrams, condition: Condition) -> DataError:
    """Return the error that tells why a condition leaves no drive."""
    if revoked := opened.revoked(condition):
        drives = number_of(sum(revoked.values()), "drive")
        return DataError(
            f"all {drives} of the cohort {condition.text!r} are left out: they are of "
            f"{number_of(len(revoked), 'car')} a key of which was revoked. Choose another cohort."
        )
    if left_out := opened.count_left_out(condition):
        return DataError(
            f"all {number_of(left_out, 'drive')} of the cohort {condition.text!r} are of cars that "
            "sent Gram rows of the logged signals and no log. Select with features = signals."
        )
    change_s = features().feature_set(features().name_of(opened.identity)).change_s
    if change_s:
        return DataError(
            f"no drive of the cohort {condition.text!r} has fixes of a satellite receiver that are "
            f"{change_s} s apart: nothing tells the course. Choose another cohort, or map the "
            "course and ingest again: docs/course.md."
        )
    examples = opened.database.execute(
        "SELECT string_agg(DISTINCT source, ', ' ORDER BY source), "
        "string_agg(DISTINCT campaign, ', ' ORDER BY campaign) FROM grams"
    ).fetchone()
    sources, campaigns = examples or ("", "")
    return DataError(
        f"no drive satisfies the cohort condition {condition.text!r}. The warehouse has sources "
        f"{sources} and campaigns {campaigns}. See the columns with: "
        'fleet-slip sql "DESCRIBE drives"'
    )
