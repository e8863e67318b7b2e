"""Records of benchmarks: what takes a fifth longer is named."""

from pathlib import Path

from tests.support.bench_record import Record, add_record, read_records, slower_than


def test_a_slower_command_is_named(tmp_path: Path) -> None:
    file = tmp_path / "figures" / "bench.jsonl"
    assert not read_records(file)
    for speed in (1.0, 2.0, 1.0, 8.0):
        record = Record("abc", "start", 10.0 * speed, speed)
        assert slower_than(read_records(file), record) is None
        add_record(file, record)
    assert slower_than(read_records(file), Record("d", "start", 11.9, 1.0)) is None
    message = slower_than(read_records(file), Record("d", "start", 12.1, 1.0))
    assert message is not None and message.startswith("start: 12.1 s of processors, 1.21 times")
    assert slower_than(read_records(file), Record("d", "another", 99.0, 1.0)) is None
