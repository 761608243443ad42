"""Which depth image belongs to which color image, by lists of times."""

from pathlib import Path

import numpy as np
import pytest

from duagc.converters.layouts.tum_layout import AssociationOptions, Listed, Poses, associate, read_list
from duagc.pipeline.base.errors import DuagError


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


@pytest.mark.parametrize("mark", ["", "\ufeff"], ids=["plain", "byte order mark"])
def test_lists_may_begin_with_a_byte_order_mark(mark: str, tmp_path: Path) -> None:
    path = tmp_path / "rgb.txt"
    path.write_text(f"{mark}1.5 rgb/0.png\n2.5 rgb/1.png\n", encoding="utf-8")
    assert [entry.stamp_ns for entry in read_list(path)] == [1_500_000_000, 2_500_000_000]


@pytest.mark.parametrize("between", [" ", ",", ", ", "\t"])
def test_numbers_of_poses_are_separated_by_spaces_or_commas(between: str, tmp_path: Path) -> None:
    path = tmp_path / "truth.txt"
    rows = [["1.000000001", "1", "2", "3", "0", "0", "0", "1"], ["2.5", "4", "5", "6", "0", "0", "1", "0"]]
    path.write_text("".join(between.join(row) + "\n" for row in rows))
    poses = Poses.read(path)
    assert poses.stamps_ns.tolist() == [1_000_000_001, 2_500_000_000]
    np.testing.assert_array_equal(poses.T_world_body[:, :3, 3], [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize("names", ["qw qx qy qz", "q_w, q_x, q_y, q_z"])
def test_poses_whose_comment_names_qw_first_are_refused(names: str, tmp_path: Path) -> None:
    """Exchanged components keep the angle between two poses: of a short motion, only the names say it."""
    path = tmp_path / "truth.txt"
    rows = "1.0 1 2 3 0 0 0 1\n2.5 4 5 6 0 0 1 0\n"
    path.write_text(f"# timestamp tx ty tz {names}\n{rows}")
    with pytest.raises(
        DuagError, match=r"truth\.txt:1: names qw qx qy qz, expected .* qx qy qz qw: put qw last"
    ):
        Poses.read(path)
    path.write_text(f"# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n{rows}")
    assert len(Poses.read(path).stamps_ns) == 2
