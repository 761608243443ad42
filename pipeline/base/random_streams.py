"""Named random streams: one seed, one independent counter-based generator per consumer.

A new consumer changes no other consumer's draws, and a draw does not depend on what was drawn elsewhere.
"""

import hashlib
import itertools
from collections.abc import Iterator

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


def in_turn(
    seed: int, name: str, count: int, *, first: int = 0, **key: str | int
) -> Iterator[tuple[int, int]]:
    """Numbers below a count without end, in random order, each once before any comes again.

    Args:
        seed: the seed of the run.
        name: the consumer.
        count: how many there are.
        first: step to begin with; those before it are as if they had been taken.
        key: as of `generator`.
    Returns:
        For each step its number, and one that grows by one from one turn of that number to its next.
    """
    if count < 1:
        raise ValueError(f"count is {count}, expected at least 1")
    for turn in itertools.count(first // count):
        order = generator(seed, name, start=turn * count, **key).permutation(count)
        for number in order[max(0, first - turn * count) :]:
            yield int(number), turn + int(number)
