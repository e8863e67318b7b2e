"""Patterns of lost GPS: the stated times, and nothing but fixes lost."""

import numpy as np

from fleet_slip.comparison.observers.outages import URBAN_FIX_S, URBAN_LOST_S, tunnel, urban


def test_urban_outages_have_the_stated_mean_times() -> None:
    lost = urban(10_000_000, np.random.default_rng(1))
    assert not lost[0]
    changes = np.diff(lost.astype(int))
    outages = (changes == 1).sum()
    assert lost.sum() / outages == np.clip(lost.sum() / outages, 970, 1030)
    expected = URBAN_LOST_S / (URBAN_LOST_S + URBAN_FIX_S)
    assert abs(lost.mean() - expected) < 0.01


def test_the_same_seed_gives_the_same_outages() -> None:
    first, again, other = (urban(50_000, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_tunnel_is_twenty_seconds_long() -> None:
    lost = tunnel(10_000, 30.0)
    assert np.flatnonzero(lost)[[0, -1]].tolist() == [3000, 4999]
    assert lost.sum() == 2000
