"""A message of each car of a fleet, all different, quickly."""

import zlib

import numpy as np

from fleet_slip.arrays import IntArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.received.messages import message_size, message_type, signals_definition


def messages_of(
    cars: int, start_s: int | IntArray, seed: int, *, label_follows: bool = False
) -> bytes:
    """Return a message of each of some cars, whose drives began at one moment, or at one each.

    If the label follows, it is a sum of the inputs, the same in all cars, and noise.
    """
    signals = catalogue().gram_signals
    random = np.random.default_rng(seed)
    k = len(signals)
    n = random.integers(2_000, 360_000, cars)
    low, high = np.array([(catalogue()[s].min_count, catalogue()[s].max_count) for s in signals]).T
    half = (high - low) / 2
    mean = (low + high) / 2 + random.uniform(-0.2, 0.2, (cars, k)) * half
    spread = random.normal(0, 0.1, (cars, 4, k)) * half
    if label_follows:
        weight = 0.5 / (k - 1) * half[-1] / half[:-1]
        mean[:, -1] = (mean[:, :-1] - (low + high)[:-1] / 2) @ weight
        spread[:, :, -1] = spread[:, :, :-1] @ weight
    square = np.einsum("mik,mil->mkl", spread, spread) + mean[:, :, None] * mean[:, None, :]
    square[:, range(k), range(k)] += (0.01 * half) ** 2
    row, column = np.tril_indices(k)
    sums = np.rint(mean * n[:, None]).astype(np.int64)
    products = np.rint(square[:, row, column] * n[:, None]).astype(np.int64)
    products[:, row == column] += (products[:, row == column] ^ sums) & 1
    messages = np.zeros(cars, message_type(k))
    messages["magic"], messages["layout"], messages["length"] = b"FSGR", 1, message_size(k)
    messages["definition"], messages["parts"] = signals_definition(), 1
    messages["vehicle"] = [f"CAR{car}" for car in range(cars)]
    messages["start_s"], messages["mask"], messages["rows"] = start_s, 2**k - 1, n
    messages["numbers"] = np.hstack([sums, products])
    content = messages.view(np.uint8).reshape(cars, -1)
    messages["checksum"] = [zlib.crc32(bytes(one[:-4])) for one in content]
    return messages.tobytes()
