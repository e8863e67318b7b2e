"""Learners of the size of a test, on one thread."""

from collections.abc import Iterator

import pytest

from fleet_slip.comparison.rivals.learner import one_thread


@pytest.fixture(autouse=True)
def small_learners(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let learners stop early, and keep them to one thread, as an evaluation does."""
    monkeypatch.setattr("fleet_slip.comparison.rivals.learners.PASSES", 9)
    monkeypatch.setattr("fleet_slip.comparison.rivals.learners.MOST_TREES", 60)
    monkeypatch.setattr("fleet_slip.comparison.rivals.anfis.EPOCHS", 8)
    with one_thread():
        yield
