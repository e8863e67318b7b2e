"""Takes from the Gram row of changes what a gyroscope's bias and scale do to it, drive by drive.

The label of changes has the gyroscope's bias times the time in it, and its scale error times the
angle turned. Both are of a drive and not of the model, so that they are fitted away within each
drive: of the matrix of products, with z = (1, turned),

    P_ab − P_az P_zz⁻¹ P_zb,

computed in whole numbers and rounded once to the nearest. What is left has sums of zero, and adds
up over drives as the products of any Gram row do.
"""

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import IntArray
from fleet_slip.catalogue.course_change import TURNED
from fleet_slip.regression.exact.gram import packed_position, packed_positions
from fleet_slip.regression.exact.gram_table import GramTable


def swept(table: GramTable) -> GramTable:
    """Return the table without `TURNED`, nor what goes with it or is constant in a drive."""
    signals = tuple(name for name in table.signals if name != TURNED)
    z, k = table.signals.index(TURNED), len(table.signals)
    n, sums = table.n.astype(object)[:, None], table.sums.astype(object)
    left, right = np.tril_indices(k)
    about = n * table.products.astype(object) - sums[:, left] * sums[:, right]
    with_z = about[:, [packed_position(max(i, z), min(i, z)) for i in range(k)]]
    turns = with_z[:, [z]]
    straight = turns == 0
    turns = np.where(straight, 1, turns)
    with_z = np.where(straight, 0, with_z)
    kept = [i for i in range(k) if i != z]
    at = np.array(list(packed_positions(tuple(kept))))
    above = about[:, at] * turns - with_z[:, left[at]] * with_z[:, right[at]]
    return GramTable(
        signals,
        table.n,
        np.zeros((len(table), len(kept)), dtype=np.int64),
        _rounded(above, n * turns).astype(np.int64),
    )


def _rounded(above: NDArray[np.object_], below: NDArray[np.object_]) -> IntArray:
    """Return quotients by positive numbers, to the nearest, halves upwards."""
    quotients: IntArray = (2 * above + below) // (2 * below)
    return quotients
