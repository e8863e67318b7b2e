"""Random columns mean the same everywhere: ends of ranges and beyond, holes, halves, any divisor.

The plain interpreter, which has the exported document and nothing of the package, is the judge.
"""

from collections.abc import Sequence
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any
from zlib import crc32

import duckdb
import numpy as np
import polars as pl
from hypothesis import HealthCheck, Phase, assume, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from fleet_slip.catalog.definitions import (
    AttributeFactor,
    CalibrationParameterName,
    Combination,
    Definition,
    Equation,
    Gate,
    Over,
    ParameterFactor,
    Product,
    Slope,
)
from fleet_slip.catalog.features import Feature
from fleet_slip.columns.column_sql import with_columns
from fleet_slip.export.files import program_content
from fleet_slip.export.program import Program
from fleet_slip.export.stepping import (
    Estimator,
    Sample,
    angles_by_kernel,
    angles_of_columns,
    compile_program,
)
from fleet_slip.models.manifest import Manifest, ModelTerm
from fleet_slip.models.registry import ModelVersion
from tests.export import plain
from tests.export.cars import Car
from tests.export.compiled import build_driver, drive, needs_cc
from tests.export.engines import by_duckdb, by_sqlite, open_session, run_drives
from tests.export.models import cars, export_texts
from tests.support.catalog import CATALOG
from tests.support.manifests import manifest

SIGNALS = ("ay", "yaw_rate", "wheel_fl")
NUMBERS: dict[CalibrationParameterName, str] = {
    "yaw_rate_offset": "0.00000625",
    "speed_ratio": "0.0005",
}


def expressions(*, declared: bool) -> st.SearchStrategy[str]:
    """Arithmetic on counts: as features.toml declares it, or with any divisor, as manifests may."""
    leaf = st.sampled_from([*SIGNALS, "3", "1000"])

    def larger(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
        pair = st.tuples(inner, st.sampled_from("+-*"), inner).map(lambda x: f"({' '.join(x)})")
        unary = st.tuples(st.sampled_from(["abs", "sign", "-"]), inner).map(
            lambda x: f"{x[0]}({x[1]})"
        )
        divisor = st.sampled_from(["2", "7", "40000"]) if declared else inner
        return pair | unary | st.tuples(inner, divisor).map(lambda x: f"({x[0]} // ({x[1]}))")

    strategy = st.recursive(leaf, larger, max_leaves=6)
    return strategy.map(
        lambda text: text.replace("(2)", "2").replace("(7)", "7").replace("(40000)", "40000")
    )


@st.composite
def features(draw: st.DrawFn) -> str:
    """The SQL of a feature, perhaps guarded."""
    text = draw(expressions(declared=False))
    least = draw(st.sampled_from([None, None, 0, 1, 5000]))
    return (
        text
        if least is None
        else f"CASE WHEN {draw(st.sampled_from(SIGNALS))} >= {least} THEN {text} END"
    )


RATIO = st.sampled_from([Fraction(1), Fraction(16), Fraction(1, 7), Fraction(3, 2)])
BITS = st.sampled_from([16, 18, 20])


@st.composite
def definitions(draw: st.DrawFn) -> Definition:
    """A column of any kind: window, factor, gate, number."""
    definition = draw(st.one_of(windows(), windows(), made_of_columns()))
    kind = draw(st.sampled_from(["window", "window", "fact", "gate", "number"]))
    update: dict[str, Any] = {}
    if kind == "fact":
        update["fact"] = draw(st.sampled_from([
            AttributeFactor(name="mass_kg", less=1320, ratio=Fraction(1, 100)),
            AttributeFactor(name="vehicle_model", equals="suv"),
        ]))  # fmt: skip
    if kind == "gate":
        low, rises, falls = draw(st.tuples(st.integers(-9000, 9000), *[st.integers(1, 3000)] * 2))
        high = draw(st.sampled_from([None, low + rises + falls]))
        by = draw(st.one_of(windows(), made_of_columns()))
        update["gate"] = Gate(by=by, low=low, peak=low + rises, high=high)
    if kind == "number":
        name = draw(st.sampled_from([*NUMBERS]))
        running = Definition(of="yaw_rate", over="running_mean", ratio=Fraction(16))
        running_or_none = draw(st.sampled_from([None, running]))
        less = 0 if running_or_none else draw(st.sampled_from([0, 2000]))
        alone = draw(st.booleans())
        grain = Decimal(NUMBERS[name])
        update["number"] = ParameterFactor(
            name=name, grain=grain, less=less, alone=alone, running=running_or_none
        )
    return definition.model_copy(update=update)


@st.composite
def made_of_columns(draw: st.DrawFn) -> Definition:
    """A window over a sum, product or slope of windows, or it now."""
    kind = draw(st.sampled_from(["sum", "product", "slope"]))
    definition: Combination | Product | Slope
    if kind == "sum":
        times = st.integers(-3000, 3000)
        terms = draw(st.lists(st.tuples(times, windows()), max_size=3))
        intercept = draw(st.integers(-(2**40), 2**40))
        definition = Combination(intercept=intercept, terms=tuple(terms), divisor=draw(DIVISOR))
    elif kind == "product":
        factors = draw(st.lists(windows(), max_size=2))
        definition = Product(
            of=tuple(factors), ratio=Fraction(draw(st.integers(1, 9)), draw(DIVISOR))
        )
    else:
        unknowns = draw(st.integers(1, 4))
        column = windows(st.just(16))
        x = st.tuples(column, *[st.one_of(column, st.integers(-(2**15), 2**15))] * (unknowns - 1))
        weight = st.sampled_from([Fraction(1), Fraction(2, 5)])
        equation = st.builds(Equation, y=column, x=x, weight=weight)
        ridge = st.tuples(*[st.sampled_from([1, 1000, 2**40])] * unknowns)
        ratio = st.sampled_from([Fraction(1), Fraction(10**6), Fraction(1, 7)])
        equations = draw(st.lists(equation, min_size=1, max_size=2))
        definition = Slope(equations=tuple(equations), ridge=draw(ridge), ratio=draw(ratio))
    row = {"of": f"m_{crc32(repr(definition).encode())}", "made": definition, "of_bits": draw(BITS)}
    return draw(windows(BITS, row))


DIVISOR = st.sampled_from([1, 7, 1000, 2**20])


@st.composite
def windows(
    draw: st.DrawFn, bits: st.SearchStrategy[int] = BITS, row: dict[str, Any] | None = None
) -> Definition:
    """Draw windows over a signal, a feature or a computed column, or its present value."""
    over: Over | None = draw(
        st.sampled_from([None, "mean", "sum", "lag", "change", "running_mean"])
    )
    ticks = draw(st.integers(1, 4)) if over in {"mean", "sum", "lag", "change"} else 0
    sql = "" if row else draw(st.one_of(st.just(""), features()))
    row = row or {"of": draw(st.sampled_from(SIGNALS))}
    if sql:
        row = {"of": f"f_{crc32(sql.encode())}", "sql": sql, "of_bits": draw(BITS)}
    try:
        return Definition(**row, over=over, ticks=ticks, ratio=draw(RATIO), bits=draw(bits))
    except ValidationError:  # it could need more than 64 bits
        assume(False)
        raise


@st.composite
def models(draw: st.DrawFn) -> Manifest:
    """A model of one to three columns."""
    columns = draw(st.lists(definitions(), min_size=1, max_size=3))
    terms = tuple(
        ModelTerm(
            signal=f"c{place}", column=f"c{place}", unit="1", scale=Decimal("0.001"),
            definition=column, coefficient=float(value), coefficient_exact=value,
        )
        for place, column in enumerate(columns)
        for value in [Fraction(draw(st.integers(-99, 99)), 10**6)]
    )  # fmt: skip
    return manifest(name="any").model_copy(update={"terms": terms})


def compiled(manifest: Manifest) -> Program:
    """The program; what divides by a constant that is not positive is no example."""
    try:
        return compile_program(CATALOG, manifest)
    except Exception as error:
        assume("divides by a number" not in str(error) and "uses no signal" not in str(error))
        assume("two ways" not in str(error))
        raise


COUNT = st.one_of(
    st.sampled_from([0, 0, 1, -1, 3, -30001, -30000, 30000, 30001, -32000, 32000, 32767]),
    st.integers(-2000, 2000),
    st.none(),
)


def drives(program: Program) -> st.SearchStrategy[list[list[float]]]:
    """Ticks in SI units, NaN where missing: counts, and what lies half way between two."""
    between = st.sampled_from([0.0, 0.0, 0.5, -0.5, 0.25])
    value = st.tuples(COUNT, between).map(lambda x: np.nan if x[0] is None else x[0] + x[1])
    row = st.one_of(
        st.tuples(*[value] * len(program.signals)), st.just((np.nan,) * len(program.signals))
    )
    scales = [float(signal.scale) for signal in program.signals]
    ticks = st.lists(row, min_size=1, max_size=9)
    return ticks.map(lambda rows: [[x * s for x, s in zip(r, scales, strict=True)] for r in rows])


def counts_of(program: Program, values: Sequence[Sequence[float]]) -> list[Sample]:
    """The counts that sensors make of them: to the nearest, halves to even; 16 bits hold them."""
    scales = [float(signal.scale) for signal in program.signals]
    rows = [[x / scale for x, scale in zip(row, scales, strict=True)] for row in values]
    return [tuple(round(x) if abs(x) <= 32767 else None for x in row) for row in rows]


def judged(program: Program, car: Car, samples: Sequence[Sample]) -> list[int | None]:
    """The angles by the plain interpreter."""
    constants = list(car.fact_counts(program)), list(car.number_counts(program))
    return plain.angles(program_content(program), *constants, samples)


def by_warehouse(manifest: Manifest, program: Program, car: Car, samples: Sequence[Sample]) -> Any:
    """The angles by the SQL of the warehouse, on counts within their ranges."""
    ends = [(signal.min_count, signal.max_count) for signal in program.signals]
    rows = [
        [
            n if n is not None and low <= n <= high else None
            for n, (low, high) in zip(s, ends, strict=True)
        ]
        for s in samples
    ]
    names = [signal.name for signal in program.signals]
    log = pl.DataFrame(rows, dict.fromkeys(names, pl.Int16), orient="row").with_columns(
        pl.lit("d").alias("drive_id"), pl.int_range(pl.len()).alias("tick"),
        pl.lit(car.facts.get("mass_kg"), pl.Float64).alias("mass_kg"),
        pl.lit(car.facts.get("vehicle_model"), pl.String).alias("vehicle_model"),
    )  # fmt: skip
    with duckdb.connect() as database:
        database.register("log_counts", log.to_arrow())
        rows_sql = with_columns("log_counts", {}, manifest.definitions)
        table = database.sql(f"SELECT * FROM {rows_sql} ORDER BY tick").to_arrow_table()
    columns = np.array(
        [
            [np.nan if n is None else n for n in table[name].to_pylist()]
            for name in manifest.definitions
        ],
        dtype=np.float64,
    )
    return angles_of_columns(program, columns)


def in_counts(program: Program, angles: Sequence[float | None]) -> list[int | None]:
    """Angles in rad as the program's counts."""
    scale = float(program.angle.scale)
    return [None if x is None or np.isnan(x) else int(np.floor(x / scale + 0.5)) for x in angles]


def close(angles: Sequence[int | None], expected: Sequence[int | None]) -> bool:
    """Return True if angles are equal, except where binary64 rounds a half."""
    return all(
        (a is None) == (b is None) and (a is None or b is None or abs(a - b) <= 1)
        for a, b in zip(angles, expected, strict=True)
    )


def constants_of(program: Program, car: Car) -> dict[str, Any]:
    """Return the constants of a car, in SI units."""
    facts = {fact.name: car.facts[fact.name] for fact in program.facts}
    numbers = {
        n.name: Decimal(car.numbers[n.name]) * n.grain
        for n in program.numbers
        if n.name in car.numbers
    }
    return {**facts, **numbers}


@settings(
    max_examples=25,
    phases=[Phase.generate],
    suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow],
)
@given(models(), cars(), st.data())
def test_kernel_warehouse_and_estimator_are_what_the_interpreter_says(
    model: Manifest, car: Car, data: st.DataObject
) -> None:
    program = compiled(model)
    values = data.draw(drives(program))
    samples = counts_of(program, values)
    expected = judged(program, car, samples)
    assert (
        angles_by_kernel(CATALOG.signals, model, program, car.facts, car.numbers, samples)
        == expected
    )
    if not program.numbers:
        assert by_warehouse(model, program, car, samples) == expected
    estimator = Estimator(CATALOG, model, constants_of(program, car))
    rows = [dict(zip(estimator.columns, row, strict=True)) for row in values]
    stepped = [estimator.step(row) for row in rows]
    assert close(in_counts(program, stepped), expected)
    numbers = {name: [value] * len(rows) for name, value in constants_of(program, car).items()}
    missing = {n.name: [np.nan] * len(rows) for n in program.numbers}
    frame = {c: [row[c] for row in rows] for c in estimator.columns} | missing | numbers
    predicted = ModelVersion(1, model, "0" * 64, CATALOG).predict(frame).tolist()
    assert [None if np.isnan(x) else x for x in predicted] == stepped


@needs_cc
@settings(
    max_examples=5,
    phases=[Phase.generate],
    deadline=None,
    suppress_health_check=[
        HealthCheck.filter_too_much,
        HealthCheck.too_slow,
        HealthCheck.function_scoped_fixture,
    ],
)
@given(model=models(), car=cars(), data=st.data())
def test_exports_are_what_the_interpreter_says(
    model: Manifest, car: Car, data: st.DataObject, tmp_path: Path
) -> None:
    program, version = compiled(model), ModelVersion(1, model, "0" * 64, CATALOG)
    values = data.draw(st.lists(drives(program), min_size=3, max_size=3))
    samples = [counts_of(program, drive_values) for drive_values in values]
    expected = [judged(program, car, drive_values) for drive_values in samples]
    driver = build_driver(tmp_path, version, program)
    assert [drive(driver, program, car, drive_values) for drive_values in samples] == expected
    log = log_of(program, car, values)
    expected_angles = {
        (str(d), t): angle
        for d, drive_values in enumerate(expected)
        for t, angle in enumerate(drive_values)
    }
    statement = export_texts(version, None, "sql")["sideslip_any.sql"]
    assert by_duckdb(statement, log) == expected_angles
    assert by_sqlite(statement, log) == expected_angles
    session = open_session(version, "float64")
    for drive_values, angles in zip(values, expected, strict=True):
        angles_of_onnx = run_drives(session, program, [car], np.array([drive_values]))[0]
        assert close(in_counts(program, angles_of_onnx.tolist()), angles)


def log_of(program: Program, car: Car, values: Sequence[Sequence[Sequence[float]]]) -> pl.DataFrame:
    """Drives in SI units, null where missing, with what the car knows."""
    names = [signal.column for signal in program.signals]
    parts = [
        pl.DataFrame(drive_values, dict.fromkeys(names, pl.Float64), orient="row").with_columns(
            pl.lit(str(place)).alias("drive_id"), pl.int_range(pl.len()).alias("tick")
        )
        for place, drive_values in enumerate(values)
    ]
    numbers = {n.name: constants_of(program, car).get(n.name) for n in program.numbers}
    return (
        pl.concat(parts)
        .fill_nan(None)
        .with_columns(
            pl.lit(car.facts.get("mass_kg"), pl.Float64).alias("mass_kg"),
            pl.lit(car.facts.get("vehicle_model"), pl.String).alias("vehicle_model"),
            *(
                pl.lit(None if x is None else float(x), pl.Float64).alias(n)
                for n, x in numbers.items()
            ),
        )
    )


@settings(max_examples=100, suppress_health_check=[HealthCheck.filter_too_much])
@given(
    st.one_of(expressions(declared=True), st.text("ay*/-+() 0123", max_size=12)), st.integers(0, 9)
)
def test_a_feature_that_can_be_defined_can_be_exported(text: str, divisor: int) -> None:
    try:
        feature = Feature.model_validate(
            {"counts": text, "divided_by": str(divisor) if divisor else None, "scale": 1}
            | {"unit": "1", "column": "any_feature", "description": "any"},
            context=CATALOG.signals,
        )
    except ValidationError:
        return
    value = Fraction(1, 10**6)
    term = ModelTerm(
        signal="any_feature", column="any_feature", unit="1", scale=Decimal(1), sql=feature.sql,
        coefficient=float(value), coefficient_exact=value,
    )  # fmt: skip
    model = manifest(name="any").model_copy(update={"terms": (term,)})
    program = compile_program(CATALOG, model)
    samples: list[Sample] = [(n,) * len(program.signals) for n in (None, -3, 0, 7, 30000)]
    assert angles_by_kernel(CATALOG.signals, model, program, {}, {}, samples) == judged(
        program, Car({}, {}), samples
    )
