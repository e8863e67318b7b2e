"""Writers, a job that rearranges, and readers at once."""

import pytest

from benchmarks.reliability import concurrency


@pytest.mark.slow
def test_writers_lose_nothing_and_readers_see_whole_commits_in_order(
    capsys: pytest.CaptureFixture[str],
) -> None:
    concurrency(writers=3, commits=5)
    assert "nothing lost or doubled" in capsys.readouterr().out
