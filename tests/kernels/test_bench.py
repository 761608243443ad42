import numpy as np
import pytest

from pipeline.geometry.camera import PinholeCamera
from pipeline.kernels import Rasterizer, available_isas, bench


def test_the_torch_rasterizer_draws_the_same_room():
    room, camera = bench.make_room(2000), PinholeCamera(50, 40, 25.0, 25.0, 24.5, 19.5)
    render = Rasterizer().forward(room, camera, bench.view_of_room())
    image = bench.torch_tiles(bench._torch_parameters(room), camera, bench.view_of_room()).detach().numpy()
    assert render.alpha.mean() > 0.9  # the room fills the view
    # float32 on both sides: a pair at a threshold may be drawn by one of them only
    assert np.abs(image[..., :3] - render.color).mean() < 1e-5
    assert np.abs(image[..., 3] - render.depth).mean() < 1e-4


def test_table_has_a_row_per_build_and_size():
    result = bench.run(sizes=((40, 30),), threads=(1,), gaussians=500, rounds=1)
    implementations = [row["implementation"] for row in result["rows"]]
    assert implementations == [*available_isas(), "plain torch"]
    assert all(row["forward"] >= 0 and row["backward"] >= 0 for row in result["rows"])
    table = bench.format_table(result)
    for name in implementations:
        assert name in table


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_room_is_flat_along_its_walls(axis):
    room = bench.make_room(3000)
    on_wall = room.log_scales.argmin(axis=1) == axis
    assert on_wall.mean() > 0.1
