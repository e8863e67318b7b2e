"""A benchmark that takes a fifth longer than it did is named, whatever the machine's speed."""

from pathlib import Path

from tests.support.bench_record import Record, add_record, draw, read_records, slower_than


def test_what_takes_longer_in_yardsticks_is_named(tmp_path: Path) -> None:
    file = tmp_path / "figures" / "bench.jsonl"
    assert not read_records(file)
    for speed in (1.0, 2.0, 1.0, 8.0):
        record = Record("abc", "start", 10.0 * speed, speed)
        assert slower_than(read_records(file), record) is None
        add_record(file, record)
    assert slower_than(read_records(file), Record("d", "start", 11.9, 1.0)) is None
    told = slower_than(read_records(file), Record("d", "start", 12.1, 1.0))
    assert told is not None and told.startswith("start: 12.1 s of processors, 1.21 times")
    assert slower_than(read_records(file), Record("d", "another", 99.0, 1.0)) is None


def test_records_are_drawn_over_the_commits_they_are_of(tmp_path: Path) -> None:
    records = [
        Record(commit, command, 10.0, 1.0)
        for commit in ("0abc1", "9def2+")
        for command in ("start", "encoding --copies 1")
    ]
    draw(records, tmp_path / "bench.svg")
    drawn = (tmp_path / "bench.svg").read_text("utf-8")
    for text in ("0abc1", "9def2+", "start", "encoding"):
        assert drawn.count(f"<!-- {text}") == 1
