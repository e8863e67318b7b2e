"""A table of Gram rows is refused before it decodes to more than a file of them may be."""

import io
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import fleet_slip
from fleet_slip.errors import FleetSlipError, InputError
from fleet_slip.grams import on_board
from tests.support.counted_rows import START_S, gram_of, list_array, row_of, rows_of_fleet
from tests.support.counted_rows import write_counted as write

ROWS = 2_000
MEBIBYTE = 2**20


@pytest.fixture
def fleet(tmp_path: Path) -> fleet_slip.Fleet:
    return fleet_slip.open(tmp_path / "data")


def repeated(text: str, rows: int = ROWS) -> pa.DictionaryArray:
    return pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, np.int32)), pa.array([text]))


def with_column(table: pa.Table, name: str, values: pa.Array) -> pa.Table:
    return table.set_column(table.column_names.index(name), name, values)


def test_a_text_that_is_repeated_is_refused_by_its_decoded_size(
    fleet: fleet_slip.Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(on_board, "MAX_TEXT_BYTES", MEBIBYTE)
    table = rows_of_fleet(ROWS, START_S, seed=1)
    for name in ("signals", "source", "feature_set", "part"):
        path = write(tmp_path / name, with_column(table, name, repeated("x" * 20_000)))
        with pytest.raises(InputError, match="decodes to more than"):
            fleet.import_onboard_grams(path)


def test_lists_of_equal_numbers_are_refused_before_they_are_decoded(
    fleet: fleet_slip.Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(on_board, "MAX_DECODED_BYTES", MEBIBYTE)
    monkeypatch.setattr(on_board, "_decode", lambda *_: pytest.fail("it was decoded"))
    table = rows_of_fleet(10, START_S, seed=1)
    zeros = list_array(np.zeros((10, 20_000), np.int64))
    path = write(tmp_path / "rows", with_column(table, "sums", zeros))
    assert path.stat().st_size < 20_000
    with pytest.raises(InputError, match="decodes to more than"):
        fleet.import_onboard_grams(path)


def test_a_column_of_another_type_is_named(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    table = rows_of_fleet(2, START_S, seed=1)
    nested = with_column(table, "n", list_array(np.zeros((2, 1), np.int64)))
    with pytest.raises(InputError, match=r"column n has the type list<.*write it as int64"):
        fleet.import_onboard_grams(write(tmp_path / "nested", nested))
    texts = with_column(table, "sums", pa.array([["a"], ["b"]]))
    with pytest.raises(InputError, match=r"column sums has the type list<"):
        fleet.import_onboard_grams(write(tmp_path / "texts", texts))
    twice = table.append_column("n", table["n"])
    with pytest.raises(InputError, match="two columns n"):
        fleet.import_onboard_grams(write(tmp_path / "twice", twice))


@pytest.mark.parametrize("name", ["n", "sums"])
def test_texts_in_place_of_numbers_are_refused_before_they_are_decoded(
    fleet: fleet_slip.Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr(on_board, "_decode", lambda *_: pytest.fail("it was decoded"))
    texts: pa.Array = repeated("x" * 500_000)
    if name == "sums":
        texts = pa.ListArray.from_arrays(pa.array(range(ROWS + 1), pa.int32()), texts)
    table = with_column(rows_of_fleet(ROWS, START_S, seed=1), name, texts)
    with pytest.raises(InputError, match=f"column {name} has the type"):
        fleet.import_onboard_grams(write(tmp_path / "rows", table))


def test_texts_that_repeat_prefixes_are_not_decoded(
    fleet: fleet_slip.Fleet, tmp_path: Path
) -> None:
    path = tmp_path / "rows"
    pq.write_table(
        with_column(rows_of_fleet(20, START_S, seed=1), "signals", pa.array(["x" * 10**6] * 20)),
        path,
        write_page_checksum=True,
        use_dictionary=False,
        column_encoding={"signals": "DELTA_BYTE_ARRAY"},
    )
    assert path.stat().st_size < MEBIBYTE
    before = pa.total_allocated_bytes(), pa.default_memory_pool().max_memory()
    with pytest.raises(InputError, match="not a table of Gram rows"):
        fleet.import_onboard_grams(path)
    assert pa.default_memory_pool().max_memory() < max(before) + 10 * MEBIBYTE


def test_tables_of_other_programs_are_read(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    row = row_of(gram_of(1))
    wide = {"vehicle_id": pa.large_string(), "sums": pa.large_list(pa.int64()), "part": pa.null()}
    columns = [
        pa.array([row[field.name]], wide.get(field.name, field.type)) for field in on_board.COLUMNS
    ]
    table = pa.table(columns, names=on_board.COLUMNS.names)
    assert fleet.import_onboard_grams(write(tmp_path / "rows", table)).rows == 500


@pytest.mark.parametrize("version", ["1.0", "2.0"])
def test_headers_state_what_pages_hold(version: str) -> None:
    rows, stream = 100_000, io.BytesIO()
    table = pa.table(
        {"a": pa.array(range(rows)), "b": pa.array([["x", "y"]] * rows), "c": ["abc"] * rows}
    )
    pq.write_table(
        table,
        stream,
        write_page_checksum=True,
        data_page_version=version,
        use_dictionary=["b.list.element"],
        column_encoding={"a": "PLAIN", "c": "DELTA_BYTE_ARRAY"},
        data_page_size=1000,
        write_batch_size=100,
    )
    page_headers, pages = on_board.read_pages(stream.getvalue())
    assert page_headers == rows
    by_column: dict[str, list[on_board.Page]] = {"a": [], "b": [], "c": []}
    for page in pages:
        assert page.has_checksum
        by_column[page.column].append(page)
    values = {
        name: sum(page.values for page in page_headers) for name, page_headers in by_column.items()
    }
    assert values == {"a": rows, "b": 2 * rows + 2, "c": rows}  # b has a dictionary of two texts
    assert all(len(page_headers) > 1 for page_headers in by_column.values())


def test_many_pages_and_pages_behind_the_end_of_a_column_are_refused(
    fleet: fleet_slip.Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "rows", rows_of_fleet(20, START_S, seed=1))
    with monkeypatch.context() as patch:
        patch.setattr(on_board, "MAX_PAGES", 5)
        with pytest.raises(InputError, match="decodes to more than"):
            fleet.import_onboard_grams(path)
    size = int.from_bytes(path.read_bytes()[-8:-4], "little")
    footer = on_board._ThriftReader(memoryview(path.read_bytes())[-8 - size : -8]).struct()
    chunk = footer[4][0][1][0][3]
    with pytest.raises(ValueError, match="different numbers of values"):
        list(on_board._pages_of(path.read_bytes(), {**chunk, 5: chunk[5] + 1}))


def test_damaged_files_are_refused(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    sound = write(tmp_path / "rows", rows_of_fleet(2, START_S, seed=1)).read_bytes()
    path = tmp_path / "damaged"
    for _ in range(300):
        content = bytearray(sound)
        for place in random.integers(0, len(sound), random.integers(1, 4)):
            content[place] ^= 1 << int(random.integers(8))
        path.write_bytes(content)
        try:
            on_board._read(path, bytes(content))
        except FleetSlipError as error:
            assert isinstance(error, InputError)
