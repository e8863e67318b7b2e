"""Removes what a gyroscope's bias and scale do to the Gram rows of changes, drive by drive.

The label has the bias times the time, and the scale error times the angle turned, both of a drive:
they are fitted away by z = (1, turned), P_ab − P_az P_zz⁻¹ P_zb, in whole numbers, each a sum of
two quotients of exact numbers in binary64, rounded: the same bits everywhere. Sums are then zero,
and products add up over drives.
"""

import numpy as np

from fleet_slip.catalogue.course_change import BESIDE, TURNED
from fleet_slip.regression.exact.gram import packed_position, packed_positions
from fleet_slip.regression.exact.gram_table import GramTable


def about_mean(table: GramTable) -> GramTable:
    """Return the table of what the columns differ by from their mean in each row."""
    left, right = np.tril_indices(len(table.signals))
    sums = table.sums.astype(np.float64)
    taken = sums[:, left] * sums[:, right] / table.n[:, None]
    products = table.products - np.rint(taken).astype(np.int64)
    return GramTable(table.signals, table.n, np.zeros_like(table.sums), products)


def swept(table: GramTable) -> GramTable:
    """Return the table without `BESIDE`, the turned `TURNED`, and what is constant in a drive."""
    signals = tuple(name for name in table.signals if name not in BESIDE)
    kept = [table.signals.index(name) for name in signals]
    z, n, sums = table.signals.index(TURNED), table.n.astype(object), table.sums.astype(object)
    with_z = table.products[:, [packed_position(max(i, z), min(i, z)) for i in [*kept, z]]]
    about = n[:, None] * with_z.astype(object) - sums[:, [*kept, z]] * sums[:, [z]]
    turns = np.where(about[:, -1] == 0, 1, about[:, -1])  # straight on: the others are 0 as well
    below = (n * turns).astype(np.float64)[:, None]
    means, slopes = table.sums[:, kept].astype(np.float64), about[:, :-1].astype(np.float64)
    left, right = np.tril_indices(len(kept))
    taken = means[:, left] * means[:, right] / table.n[:, None]
    taken += slopes[:, left] * slopes[:, right] / below
    products = table.products[:, list(packed_positions(tuple(kept)))]
    return GramTable(
        signals,
        table.n,
        np.zeros((len(table), len(kept)), dtype=np.int64),
        products - np.rint(taken).astype(np.int64),
    )
