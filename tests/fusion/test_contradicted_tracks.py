"""Tracks of Gaussians that own images contradict: what else is in them counts without these, whatever the names."""

import numpy as np
import pytest

from tests.fixtures.gaussian_worlds import N, World, assert_same_map

AGAINST = np.arange(N) < N // 2


def imported(result, name):
    """Ids of a robot's Gaussians in the map."""
    return set(result.source_ids[result.source == result.robots.index(name)].tolist())


@pytest.mark.parametrize(("liar", "other"), [("bravo", "charlie"), ("charlie", "bravo")])
def test_what_a_contradicted_gaussian_was_matched_with_is_imported_alone(liar, other):
    world = World(3)
    pairs = {("bravo", "charlie"): world.pairs["bravo", "charlie"]}
    result = world.fuse("alpha", pairs=pairs, contradicted={liar: AGAINST})
    without = {name: e for name, e in world.evidence.items() if name != liar}
    alone = world.fuse("alpha", evidence=without, pairs={})
    found = imported(result, other) & set(world.maps[other].ids[AGAINST].tolist())
    assert found == imported(alone, other) & set(world.maps[other].ids[AGAINST].tolist())
    assert found
    assert not imported(result, liar) & set(world.maps[liar].ids[AGAINST].tolist())
    for row in np.flatnonzero(np.isin(result.source_ids, sorted(found))):
        same = np.flatnonzero(alone.source_ids == result.source_ids[row])
        assert result.members[row] == 1
        np.testing.assert_array_equal(result.theta[row, :3], alone.theta[same[0], :3])


def test_tracks_of_the_receiver_are_as_they_were():
    world = World(4)
    result = world.fuse("alpha", contradicted={"bravo": AGAINST, "charlie": ~AGAINST})
    assert_same_map(result, world.fuse("alpha"))
    assert (result.members == 3).all()
