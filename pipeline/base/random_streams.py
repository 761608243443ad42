"""Named random streams: one seed, one independent counter-based generator per consumer.

A new consumer changes no other consumer's draws, and a draw does not depend on what was drawn elsewhere.
"""

import hashlib

import numpy as np


def generator(seed: int, name: str, **key: str | int) -> np.random.Generator:
    """Return the Philox generator of one consumer.

    Args:
        seed: the seed of the run.
        name: the consumer, for example "link".
        key: what distinguishes this consumer from its siblings, for example robot="alpha", sequence=17.
    Returns:
        A generator that is the same in every process and on every machine.
    """
    text = "\x1f".join([str(int(seed)), name, *(f"{k}={key[k]}" for k in sorted(key))])
    digest = hashlib.sha256(text.encode()).digest()
    return np.random.Generator(np.random.Philox(key=np.frombuffer(digest[:16], dtype=np.uint64)))
