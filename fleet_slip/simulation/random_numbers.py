"""Random numbers that depend on what they are for, and on nothing else."""

import hashlib

import numpy as np


def random_generator(seed: int, *identity: str) -> np.random.Generator:
    """Return a generator that depends on the seed and on what it is for, and on nothing else."""
    digest = hashlib.sha256("\n".join(identity).encode()).digest()
    words = np.frombuffer(digest, dtype="<u4").tolist()
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, *words])))
