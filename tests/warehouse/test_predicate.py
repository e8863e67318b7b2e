"""A predicate is one expression on a drive's columns, and means the same for ever."""

import duckdb
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.errors import QuestionError
from fleet_slip.grams.cohort import Folding, load_cohort, sum_days
from fleet_slip.grams.update import update_grams
from fleet_slip.models.registry import ModelVersion
from fleet_slip.models.score import cohort_of_rows, score
from fleet_slip.operations.monitor import monitor
from fleet_slip.operations.sensor_screen import examine_drives
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.database import guarded_query, open_database, parse_predicate
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import SIGNALS
from tests.support.logs import land, log_rows, random_counts
from tests.support.manifests import manifest

DATABASE = duckdb.connect()

LASTING = [
    "true",
    "source <> 'scenario'",
    "adhesion < 0.8 AND mass_kg BETWEEN 1000 AND 2000",
    "campaign IN ('a', 'test') AND NOT day IS NULL",
    "CASE WHEN adhesion > 0.7 THEN drive_id = 'd1' ELSE true END",
    "drive_id LIKE 'd%' ESCAPE '$' OR drive_id SIMILAR TO 'd[0-9]'",
    "regexp_matches(drive_id, '[13]$')",
    "day >= DATE '2024-05-01' - INTERVAL 1 DAY",
    "track IN ['waterford_hills'] -- of the paper",
    "coalesce(saturated, 0) / 2 <= 1 AND mass_kg % 2 = 0",
    "TRY_CAST(substring(drive_id FROM 2) AS INT) > 1",
    "1/0",
    "\"DAY\" = '2024-05-01' OR vehicle_model = 'it''s'",
]

NOT_ALONE = [
    "",
    "true) OR (true",
    "false) UNION ALL SELECT 1 FROM range(1, 9) r(i) WHERE (true",
    "true LIMIT 1",
    "true QUALIFY true",
    "true WINDOW w AS ()",
    "true; SELECT 1",
    "true;",
    "true) FROM grams; COPY (SELECT 1) TO 'stolen.csv'; SELECT (true",
    "true /*",
    "{predicate}",
    "\ud800",
    "drive_id = '\0'",
    "(" * 3000 + "true" + ")" * 3000,
    "true" + " AND true" * 20_000,
]

FLEETING = [
    "random() < 0.5",
    "day < now()",
    "drive_id < uuid()::VARCHAR",
    "getenv('HOME') = 'x'",
    "getvariable('gram_files') IS NULL",
    "hash(drive_id) % 2 = 0",
    "day::TIMESTAMPTZ < '2024-05-01'",
    "day AT TIME ZONE 'UTC' < '2024-05-01'",
    "error('x')",
]

MORE_THAN_COLUMNS = [
    "drive_id IN (SELECT drive_id FROM log)",
    "mass_kg > ALL (SELECT 1)",
    "EXISTS (FROM read_text('/etc/passwd'))",
    "EXISTS (WITH x AS (COPY (SELECT 1) TO 'stolen.csv') FROM x)",
    "*",
    "COLUMNS('mass.*') > 1",
    "drive_id = $1",
    "n > 1",
    "grams.n > 1",
    "sum(mass_kg) OVER () > 1",
    "list_filter([1], lambda x: x > 1) = [1]",
    "repeat(drive_id, 1000000000) = 'x'",
    "system.main.lower(drive_id) = 'x'",
    "lower(drive_id ORDER BY 1) = 'x'",
]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Warehouse:
    """A warehouse of four drives with different metadata."""
    warehouse = Warehouse(LocalFolder(tmp_path_factory.mktemp("predicate") / "data"))
    rng = np.random.default_rng(1)
    drives = [
        log_rows(f"d{i}", random_counts(rng, 30), adhesion=0.6 + 0.1 * i, mass_kg=1200.0 + 100 * i)
        for i in range(4)
    ]
    land(warehouse, "one", *drives)
    update_grams(warehouse)
    return warehouse


@pytest.fixture(scope="module")
def drives(fleet: Warehouse) -> pa.Table:
    return load_cohort(fleet, "true").drives


@pytest.mark.parametrize("text", LASTING)
def test_a_predicate_in_a_statement_has_its_meaning(drives: pa.Table, text: str) -> None:
    predicate = parse_predicate(SIGNALS, text)
    with DATABASE.cursor() as database:
        database.register("drives", drives)
        written, meant = (
            database.execute(f"SELECT drive_id FROM drives WHERE ({where}\n)").fetchall()
            for where in (text, predicate.sql)
        )
    assert written == meant
    assert parse_predicate(SIGNALS, predicate.sql)
    assert str(predicate) == text


@pytest.mark.parametrize("text", [*NOT_ALONE, *FLEETING, *MORE_THAN_COLUMNS])
def test_anything_else_is_refused(text: str) -> None:
    with pytest.raises(QuestionError) as refused:
        parse_predicate(SIGNALS, text)
    assert str(refused.value).isprintable()
    assert len(str(refused.value)) < 1500


@pytest.mark.parametrize("text", ["true) OR (true", "random() < 0.5", "EXISTS (SELECT 1)"])
def test_every_way_in_passes_the_same_gate(fleet: Warehouse, text: str) -> None:
    published = manifest()
    stored = published.model_copy(
        update={"trained_on": published.trained_on.model_copy(update={"cohort": text})}
    )
    ways = (
        lambda: load_cohort(fleet, text),
        lambda: load_cohort(fleet, text, folding=Folding()),
        lambda: sum_days(fleet, ["ay"], text),
        lambda: examine_drives(fleet, text),
        lambda: score(fleet, published, text),
        lambda: monitor(fleet, ModelVersion(1, published, "", fleet.catalog), text),
        lambda: monitor(fleet, ModelVersion(1, stored, "", fleet.catalog)),
    )
    for way in ways:
        with pytest.raises(QuestionError, match="the predicate"):
            way()


def test_a_score_may_ask_about_rows() -> None:
    assert "abs(ay_mps2) > 3" in cohort_of_rows(SIGNALS, "abs(ay_mps2) > 3").sql
    with pytest.raises(QuestionError, match="ay_mps2"):
        parse_predicate(SIGNALS, "abs(ay_mps2) > 3")


def test_conditions_are_joined_as_they_are_meant() -> None:
    both = parse_predicate(SIGNALS, "adhesion < 1 OR true") & parse_predicate(SIGNALS, "false")
    answer = DATABASE.execute(f"SELECT {both.sql} FROM (SELECT 2 AS adhesion)").fetchall()
    assert answer == [(False,)]
    assert parse_predicate(SIGNALS, both.text)


@settings(max_examples=300)
@given(
    st.lists(
        st.sampled_from(
            [
                *"()*,;+-",
                "--", "/*", "*/", "'", '"', "'x'", "1", "\n",
                "true", "false", "NULL", "AND", "OR", "NOT", "=", "<", "IN", "IS",
                "LIKE", "BETWEEN", "drive_id", "adhesion", "day", "UNION",
                "SELECT", "FROM drives", "WHERE", "LIMIT",
                "lower", "abs", "CASE", "WHEN", "THEN", "ELSE", "END", "::", "DATE", "EXISTS",
            ]
        ),
        max_size=12,
    ).map(" ".join)
)  # fmt: skip
def test_accepted_predicates_stay_in_their_parentheses(text: str) -> None:
    try:
        predicate = parse_predicate(SIGNALS, text)
    except QuestionError:
        return
    names = {**SIGNALS.drive_schema.empty_table().to_pydict(), "day": []}
    columns = ", ".join(
        f"{'0' if SIGNALS.drive[n].type != 'string' else repr('x')} AS {n}"
        if n in SIGNALS.drive
        else f"DATE '2024-05-01' AS {n}"
        for n in names
    )
    statement = f"SELECT count(*) FROM (SELECT {columns}) WHERE false AND {predicate.sql}"
    try:
        assert DATABASE.execute(statement).fetchall() == [(0,)]
    except duckdb.Error as error:
        assert "syntax" not in str(error).lower()


@pytest.mark.parametrize(
    "predicate", ["regexp_matches(drive_id, '(')", "drive_id SIMILAR TO '['", "drive_id ~ '*'"]
)
def test_a_wrong_regular_expression_is_a_wrong_question(fleet: Warehouse, predicate: str) -> None:
    for folding in (None, Folding()):
        with pytest.raises(QuestionError, match="cannot be evaluated"):
            load_cohort(fleet, predicate, folding=folding)


def test_a_query_that_fails_late_is_wrong_input() -> None:
    """pyarrow makes an OSError of what DuckDB says of a batch that is not the first."""
    query = "SELECT CAST(if(i < 9000, '1', 'spa') AS INTEGER) FROM range(10000) t(i)"
    with open_database() as database:
        batches = database.sql(query).to_arrow_reader(1000)
        predicate = parse_predicate(SIGNALS, "campaign = 1")
        with pytest.raises(QuestionError, match="string 'spa'"), guarded_query(database, predicate):
            assert not list(batches)
