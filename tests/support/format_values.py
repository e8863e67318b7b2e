"""The values that the files of each format contain."""

from datetime import UTC, datetime

import numpy as np

from tests.support.measured import MeasuredLog, ticks

START = datetime(2024, 5, 31, 12, tzinfo=UTC)


TIME_S = np.arange(100) / 100


AX = np.round(2 * np.sin(5 * TIME_S), 3)


BETA_DEG = np.round(np.cos(3 * TIME_S), 2)


AX_COUNTS = np.rint(AX / 0.001).astype(int).tolist()


BETA_COUNTS = np.rint(np.radians(BETA_DEG) / 0.0001).astype(int).tolist()


def require_the_drive(log: MeasuredLog) -> None:
    assert ticks(log) == list(range(100))
    assert log.drives["ax"].to_pylist() == AX_COUNTS
    assert log.drives["sideslip"].to_pylist() == BETA_COUNTS
    assert log.drives["day"].unique().to_pylist() == [START.date()]
