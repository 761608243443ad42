"""Depth that a camera gives where it measures nothing stands apart; far surfaces and coarse steps do not."""

import numpy as np

from duagc.pipeline.recording.greatest_depth import greatest_apart, unmeasured


def test_the_greatest_distance_of_a_camera_stands_apart() -> None:
    measured = np.linspace(0.8, 3.1, 500, dtype=np.float32)
    assert greatest_apart(np.concatenate([measured, np.full(90, 8.0, np.float32)])) == 8.0
    assert greatest_apart(np.concatenate([measured, np.full(90, 3.15, np.float32)])) == 0.0
    assert greatest_apart(np.append(measured, np.float32(8.0))) == 0.0  # a single one is noise


def test_surfaces_do_not_stand_apart() -> None:
    """A far wall behind a room has more than one depth; a sensor of disparity has few, and far apart at the end."""
    room, wall = np.linspace(0.8, 3.1, 500), np.linspace(5.9, 6.0, 50)
    assert greatest_apart(np.concatenate([room, wall])) == 0.0
    steps = np.float32(20.0) / np.arange(2, 30)
    assert greatest_apart(np.repeat(steps, 40)) == 0.0
    assert greatest_apart(np.full(100, 2.0)) == 0.0
    assert greatest_apart(np.zeros(0)) == 0.0


def test_every_image_must_have_it() -> None:
    measured = np.linspace(800, 3100, 500).astype(np.uint16)
    images = [
        np.concatenate([measured + k, np.full(100, 8000, np.uint16), np.zeros(50, np.uint16)])
        for k in range(4)
    ]
    assert unmeasured(images) == (8000.0, 1 / 6)
    assert unmeasured([*images, measured]) == (0.0, 0.0)
    assert unmeasured([]) == (0.0, 0.0)


def clipped(shift: float) -> np.ndarray:
    """Depth of a room, in millimeters, that ends at 2,500: a floor leads up to it."""
    depth = np.linspace(900, 6100, 4000) + shift
    return np.minimum(depth + 3 * np.sin(np.arange(4000)), 2500).round().astype(np.uint16)


def test_a_range_that_was_cut_off_is_filled_with_its_end() -> None:
    greatest, share = unmeasured([clipped(shift) for shift in (0, 40, -60, 90)])
    assert greatest == 2500.0
    assert 0.6 < share < 0.8
    not_cut = [np.minimum(clipped(0), 2400 + k % 7).astype(np.uint16) for k in range(8)]
    assert unmeasured(not_cut) == (0.0, 0.0)


def test_a_wall_that_a_standing_camera_faces_is_a_surface() -> None:
    assert unmeasured([clipped(0)] * 8) == (0.0, 0.0)


def test_the_farthest_surfaces_of_a_room_are_no_pile() -> None:
    """A wall that is seen at an angle, and noise of a sensor on one that is faced."""
    rng = np.random.default_rng(0)
    floor = np.linspace(900, 2400, 2000)
    slanted = [np.concatenate([floor + k, np.linspace(2400, 2500, 2000) + k]).round() for k in range(8)]
    faced = [np.concatenate([floor + k, 2500 + 8 * rng.standard_normal(2000)]).round() for k in range(8)]
    assert unmeasured(slanted) == (0.0, 0.0)
    assert unmeasured(faced) == (0.0, 0.0)
