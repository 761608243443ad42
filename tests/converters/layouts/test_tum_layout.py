"""Which depth image belongs to which color image, by lists of times."""

from pathlib import Path

import numpy as np
import pytest

from duagc.converters.layouts.tum_layout import AssociationOptions, Listed, associate


def listed(times: list[int]) -> list[Listed]:
    return [Listed(time, Path()) for time in times]


@pytest.mark.parametrize("association", ["all", "nearest"])
@pytest.mark.parametrize("seed", range(4))
def test_every_image_has_the_nearest_depth(association: str, seed: int) -> None:
    """Of two as near the earlier one, as sorting all pairs by their distance gives."""
    rng = np.random.default_rng(seed)
    color, depth = (sorted(set(rng.integers(0, 400, 60).tolist())) for _ in range(2))
    options = AssociationOptions(association=association, max_difference_s=4e-9)
    found = [(c.stamp_ns, d.stamp_ns) for c, d in associate(listed(color), listed(depth), options)]
    wanted = [(c, min(depth, key=lambda d: (abs(d - c), d))) for c in color]
    assert found == [(c, d) for c, d in wanted if abs(c - d) <= 4]


def test_where_there_is_no_depth_there_is_no_pair() -> None:
    assert associate(listed([1, 2]), [], AssociationOptions()) == []
