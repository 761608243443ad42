"""What a robot takes home of two peers that saw the same is the same, whichever of them has the lower name."""

import numpy as np
import pytest

from duagc.pipeline.consensus.evidence import Evidence
from tests.fixtures.gaussian_worlds import N, World


def imported(world, renamed):
    """theta of what alpha takes of two peers that are matched with each other alone; they may change their names."""
    own, *peers = world.names
    names = dict(zip(world.names, (own, *(reversed(peers) if renamed else peers)), strict=True))
    evidence = {
        names[n]: Evidence(names[n], e.ids, e.anchors, e.theta, e.information)
        for n, e in world.evidence.items()
    }
    ids = world.pairs[tuple(peers)]
    result = world.fuse(
        own,
        evidence=evidence,
        pairs={tuple(peers): ids[:, ::-1] if renamed else ids},
        T_world_keyframe={names[n]: T for n, T in world.T_world.items()},
    )
    others = result.source != result.robots.index(own)
    assert (result.members[others] == 2).all()
    return result.theta[others]


@pytest.mark.parametrize("well_known", ["bravo", "charlie"])
def test_the_better_known_gaussian_counts_more_whatever_its_name(well_known):
    world = World(3)
    e = world.evidence[well_known]
    world.evidence[well_known] = Evidence(well_known, e.ids, e.anchors, e.theta, 1e4 * e.information)
    as_named, renamed = imported(world, False), imported(world, True)
    assert len(as_named) == N
    sorted_rows = [theta[np.lexsort(theta[:, :3].round(6).T)] for theta in (as_named, renamed)]
    np.testing.assert_allclose(*sorted_rows, rtol=0, atol=1e-9)
