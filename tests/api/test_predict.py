"""A model's angles on data frames of every kind, against arithmetic by hand and against SQL."""

import math
import re
from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_slip.api.fleet import Fleet
from fleet_slip.errors import InputError
from fleet_slip.models.manifest import ModelTerm
from fleet_slip.models.registry import ModelVersion
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.manifests import manifest

Column = list[float | None]
WHEELS = ("wheel_fl", "wheel_fr", "wheel_rl", "wheel_rr")


def model(intercept: float, **coefficients: float) -> ModelVersion:
    """A model that nobody published, of signals and features."""
    terms = tuple(
        ModelTerm(
            signal=name,
            column=CATALOG.input(name).column,
            unit=CATALOG.input(name).unit,
            scale=CATALOG.input(name).scale,
            sql=CATALOG.features[name].sql if name in CATALOG.features else "",
            coefficient=coefficient,
            coefficient_exact=Fraction(coefficient),
        )
        for name, coefficient in coefficients.items()
    )
    document = {"intercept": intercept, "intercept_exact": Fraction(intercept), "terms": terms}
    return ModelVersion(1, manifest().model_copy(update=document), "", CATALOG)


LINEAR = model(0.25, ay=-0.0085, yaw_rate=0.0123, steering_wheel=0.1)
BENT = model(-0.5, ay=0.01, speed_squared=1e-4, curvature=2.0)

value = st.one_of(st.none(), st.floats(-40, 40))


@st.composite
def columns_of(draw: st.DrawFn, names: tuple[str, ...]) -> dict[str, Column]:
    rows = draw(st.integers(0, 8))
    return {name: draw(st.lists(value, min_size=rows, max_size=rows)) for name in names}


def as_polars(columns: dict[str, Column]) -> pl.DataFrame:
    return pl.DataFrame(columns, schema=dict.fromkeys(columns, pl.Float64))


def as_pandas(columns: dict[str, Column]) -> Any:
    frame = pd.DataFrame({name: pd.Series(x, dtype="float64") for name, x in columns.items()})
    return frame.set_index(pd.Index([f"row {i}" for i in range(len(frame))]))


def as_nullable_pandas(columns: dict[str, Column]) -> Any:
    return pd.DataFrame({name: pd.array(x, dtype="Float64") for name, x in columns.items()})


def as_table(columns: dict[str, Column]) -> Any:
    return pa.table({name: pa.array(x, pa.float64()) for name, x in columns.items()})


def as_batch(columns: dict[str, Column]) -> Any:
    return pa.record_batch({name: pa.array(x, pa.float64()) for name, x in columns.items()})


def as_reader(columns: dict[str, Column]) -> Any:
    return as_table(columns).to_reader(max_chunksize=3)


def as_lists(columns: dict[str, Column]) -> dict[str, Column]:
    return columns


def as_arrays(columns: dict[str, Column]) -> dict[str, Any]:
    return {name: np.array(x, dtype=np.float64) for name, x in columns.items()}


KINDS: dict[Callable[[dict[str, Column]], Any], type[Any]] = {
    as_polars: pl.Series,
    as_pandas: pd.Series,
    as_nullable_pandas: pd.Series,
    as_table: pa.ChunkedArray,
    as_batch: pa.Array,
    as_reader: pa.ChunkedArray,
    as_lists: np.ndarray,
    as_arrays: np.ndarray,
}


def listed(angles: Any) -> Column:
    """Angles of any kind as numbers, None where there is none."""
    values = angles.to_pylist() if isinstance(angles, pa.Array | pa.ChunkedArray) else list(angles)
    if not isinstance(angles, np.ndarray | pd.Series):  # the kinds that know null use no NaN
        assert not any(isinstance(x, float) and math.isnan(x) for x in values)
    return [None if x is None or math.isnan(x) else x for x in values]


def on_every_kind(version: ModelVersion, columns: dict[str, Column]) -> Column:
    answers = []
    for make, kind in KINDS.items():
        angles = version.predict(make(columns))
        assert isinstance(angles, kind), make
        answers.append(listed(angles))
    assert all(answer == answers[0] for answer in answers)
    return answers[0]


@given(columns_of(LINEAR.columns))
def test_a_linear_model_is_one_dot_product(columns: dict[str, Column]) -> None:
    expected: Column = []
    for given_row in zip(*columns.values(), strict=True):
        row = [valid(x, name) for x, name in zip(given_row, columns, strict=True)]
        total: float | None = LINEAR.manifest.intercept
        for term, x in zip(LINEAR.manifest.terms, row, strict=True):
            rounded = 0.0 if x is None else logged(x, term.signal)
            total = None if x is None or total is None else total + term.coefficient * rounded
        expected.append(total)
    assert on_every_kind(LINEAR, columns) == expected


def count(x: float, signal: str) -> int:
    """The count of a value: to the nearest, halves to even."""
    return round(x / float(SIGNALS[signal].scale))


def logged(x: float, signal: str) -> float:
    """The value of a count."""
    return count(x, signal) * float(SIGNALS[signal].scale)


def valid(x: float | None, column: str) -> float | None:
    """A value; None where it is beyond its valid range."""
    (signal,) = (signal for signal in SIGNALS.signals.values() if signal.column == column)
    if x is None or not signal.min_count <= round(x / float(signal.scale)) <= signal.max_count:
        return None
    return x


def nearest(dividend: int, divisor: int) -> int:
    """The nearest integer to a quotient, halves away from zero, as counts of features are."""
    quotient = (2 * abs(dividend) + divisor) // (2 * divisor)
    clipped = min(quotient, 32767)
    return clipped if dividend >= 0 else -clipped


@given(columns_of(BENT.columns))
def test_features_are_functions_of_counts(columns: dict[str, Column]) -> None:
    expected: Column = []
    for given_row in zip(*columns.values(), strict=True):
        row = [valid(x, name) for x, name in zip(given_row, columns, strict=True)]
        at = dict(zip(columns, row, strict=True))
        if None in row:
            expected.append(None)
            continue
        wheels = sum(count(at[f"{wheel}_rad_s"] or 0.0, wheel) for wheel in WHEELS)
        if 31 * wheels < 120_000:  # too slow for a curvature
            expected.append(None)
            continue
        yaw_rate = count(at["yaw_rate_rad_s"] or 0.0, "yaw_rate")
        squared = nearest(961 * wheels**2, 160_000_000) * 0.1
        curvature = nearest(400_000 * yaw_rate, 31 * wheels) * 0.00001
        expected.append(
            -0.5 + 0.01 * logged(at["ay_mps2"] or 0.0, "ay") + 1e-4 * squared + 2.0 * curvature
        )
    assert BENT.predict(as_polars(columns)).to_list() == expected


def test_columns_are_those_of_the_signals_each_once() -> None:
    assert LINEAR.columns == ("ay_mps2", "yaw_rate_rad_s", "steering_wheel_rad")
    assert BENT.columns == ("ay_mps2", *(f"{w}_rad_s" for w in WHEELS), "yaw_rate_rad_s")


def test_the_bits_on_the_logs_are_those_of_a_dot_product_in_sql(fleet: Fleet) -> None:
    version = LINEAR
    terms = [f"{term.coefficient!r} * {term.column}" for term in version.manifest.terms]
    estimate = " + ".join([repr(version.manifest.intercept), *terms])
    complete = " AND ".join(f"{column} IS NOT NULL" for column in version.columns)
    rows = fleet.sql(
        f"SELECT {estimate} AS estimate_rad FROM log WHERE {complete} ORDER BY drive_id, tick"
    ).pl()
    angles = version.predict(fleet.sql("FROM log ORDER BY drive_id, tick").pl())
    assert angles.name == "sideslip_rad"
    assert len(angles) > 50_000
    assert angles.drop_nulls().to_list() == rows["estimate_rad"].to_list()


def test_a_relation_is_a_frame(fleet: Fleet) -> None:
    relation = fleet.sql("FROM log ORDER BY drive_id, tick LIMIT 100")
    version = fleet.models.get("smoke")
    assert version.predict(relation).to_pylist() == version.predict(relation.pl()).to_list()


def test_numbers_of_every_type_are_taken() -> None:
    expected = LINEAR.predict({name: [1.0, 2.0, 3.0] for name in LINEAR.columns})
    for dtype in (pl.Int8, pl.UInt64, pl.Float32, pl.Decimal(10, 2)):
        frame = pl.DataFrame({n: [1, 2, 3] for n in LINEAR.columns}).cast(dtype)
        assert LINEAR.predict(frame).to_list() == expected.tolist()
    masked = np.ma.MaskedArray([1.0, 2.0, 3.0], mask=[False, True, False])
    angles = LINEAR.predict(dict.fromkeys(LINEAR.columns, masked))
    assert np.isnan(angles).tolist() == [False, True, False]
    exact: Any = [Decimal(1), Decimal(2), Decimal(3)]
    decimals = LINEAR.predict(dict.fromkeys(LINEAR.columns, exact))
    assert decimals.tolist() == expected.tolist()
    nothing = LINEAR.predict(pl.DataFrame({n: [None, None] for n in LINEAR.columns}))
    assert nothing.to_list() == [None, None]


GOOD: dict[str, Column] = {name: [1.0, 2.0] for name in LINEAR.columns}


@pytest.mark.parametrize("make", [as_polars, as_pandas, as_table, as_batch, as_reader, as_lists])
def test_a_missing_column_is_named_and_so_are_those_there(
    make: Callable[[dict[str, Column]], Any],
) -> None:
    frame = make({name: x for name, x in GOOD.items() if name != "ay_mps2"})
    with pytest.raises(InputError) as caught:
        LINEAR.predict(frame)
    assert "the frame lacks ay_mps2. It has yaw_rate_rad_s, steering_wheel_rad." in str(
        caught.value
    )


def test_a_frame_without_columns_and_one_with_many() -> None:
    with pytest.raises(InputError, match="It has no column"):
        LINEAR.predict(pl.DataFrame())
    with pytest.raises(InputError, match="c19 and 80 more"):
        LINEAR.predict({f"c{i}": [1.0] for i in range(100)})


@pytest.mark.parametrize(
    "wrong",
    [
        ["1.0", "2.0"],
        [True, False],
        [[1.0], [2.0]],
        np.ones((2, 2)),
        np.array([1j, 2j]),
        np.array(["2024-05-01", "2024-05-02"], dtype="datetime64[s]"),
        ["1.0", 2.0],
        pytest.param([object(), 1.0], id="objects"),
        1.0,
        "12",
        [2**60 + 1, 2],
    ],
    ids=str,
)
def test_a_column_without_numbers_is_refused(wrong: Any) -> None:
    with pytest.raises(InputError, match="the column ay_mps2 is"):
        LINEAR.predict({**GOOD, "ay_mps2": wrong})


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        ({**GOOD, "ay_mps2": [1.0]}, "differ in length: ay_mps2 1, yaw_rate_rad_s 2"),
        ({**GOOD, "ay_mps2": [1.0, math.inf]}, "ay_mps2 has 1 infinite values"),
        (as_polars(GOOD).lazy(), "LazyFrame is no data frame"),
        (as_polars(GOOD)["ay_mps2"], "Series is no data frame"),
        (as_pandas(GOOD)["ay_mps2"], "Series is no data frame"),
        (np.ones((3, 3)), "ndarray is no data frame"),
        (None, "NoneType is no data frame"),
        (pd.DataFrame({**GOOD, "ay_mps2": ["a", 1.0]}), "the column ay_mps2 is"),
        (pa.table([[1.0]] * 4, names=[*GOOD, "ay_mps2"]), "several columns ay_mps2"),
        (pd.concat([as_pandas(GOOD)] * 2, axis=1), "several columns ay_mps2"),
    ],
)
def test_an_object_that_is_no_frame_is_refused(frame: Any, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        LINEAR.predict(frame)


def test_a_sum_beyond_float64_is_seen() -> None:
    big = model(0.0, ay=1e308)
    assert big.predict({"ay_mps2": [30.0, -30.0, None]}).tolist()[:2] == [math.inf, -math.inf]


@pytest.mark.parametrize(("ay", "is_present"), [(30.0, True), (30.00049, True), (30.00051, False)])
@pytest.mark.parametrize("version", [LINEAR, BENT])
def test_a_value_beyond_its_signals_range_is_missing(
    version: ModelVersion, ay: float, is_present: bool
) -> None:
    """30,000 counts of ay are valid; what is rounded to more is not."""
    row = {name: [60.0] if name.startswith("wheel") else [0.1] for name in version.columns}
    for sign in (1, -1):
        (angle,) = version.predict({**row, "ay_mps2": [sign * ay]})
        assert np.isfinite(angle) == is_present
