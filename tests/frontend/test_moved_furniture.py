"""A table that was moved while the lens was covered: it fills the views, and the room is still the place."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from duagc.converters.simulate.render import bake
from duagc.converters.simulate.render.renderer import RenderedView, Renderer
from duagc.converters.simulate.scenes.catalog import build
from duagc.converters.simulate.scenes.scene import Ball, Scene, Side, Surface
from duagc.converters.simulate.settings import camera_of
from duagc.converters.simulate.trajectories.loops import look_at
from duagc.pipeline.experiments.shots import FRAME_NS, Shot
from duagc.pipeline.frontend.components import Component
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.submap_joining import join_submaps
from duagc.pipeline.frontend.submaps import SubmapTracker, TrackedLog
from duagc.pipeline.frontend.tracked import Status
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.registration import RgbdPyramid
from tests.fixtures.frame_images import of_shot
from tests.frontend.conftest import CONFIG

CAMERA = camera_of((320, 240))
TABLE = np.array([3.15, 2.8, 0.45])  # the middle of its books, meters
FRAMES = 50  # before the lens is covered, and after
COVERED = 60
STILL = (0.0, 0.0)


def moved(scene: Scene, way_m: tuple[float, float]) -> Scene:
    """The scene with its low table elsewhere."""
    step = np.array([*way_m, 0.0])

    def place(surface: Surface) -> Surface:
        if isinstance(surface, Ball):
            return replace(surface, center=surface.center + step)
        if isinstance(surface, Side):
            return replace(surface, base=surface.base + step)
        return replace(surface, corner=surface.corner + step)

    scene.surfaces = [place(s) if s.name.startswith("low table") else s for s in scene.surfaces]
    return scene


def around(first_deg: float, last_deg: float, height_m: float) -> np.ndarray:
    """T_world_camera [n, 4, 4] of views of the table from a circle around it."""
    a = np.radians(np.linspace(first_deg, last_deg, FRAMES))
    circle = np.stack([0.6 * np.cos(a), 0.6 * np.sin(a), height_m - TABLE[2] + 0.05 * np.sin(3 * a)], axis=1)
    return look_at(TABLE + circle, TABLE + 0.1 * np.stack([np.sin(5 * a), np.cos(4 * a), 0 * a], 1))


PATHS = (around(200, 290, height_m=1.1), around(230, 320, height_m=1.05))


@cache
def renderer(way_m: tuple[float, float]) -> Renderer:
    scene = moved(build("room", 0), way_m)
    return Renderer(scene, bake.bake(scene, 0.004), CAMERA)


@cache
def views(path: int, way_m: tuple[float, float]) -> list[RenderedView]:
    return [renderer(way_m).render(T) for T in PATHS[path]]


@cache
def recorded(way_m: tuple[float, float]) -> tuple[list[Shot], np.ndarray]:
    """Views around the table, a covered lens, views around the table where it is then; and T_world_camera."""
    rng, shape = np.random.default_rng(0), (CAMERA.height, CAMERA.width)
    images = [
        (np.clip(view.color + rng.normal(0, 2, view.color.shape), 0, 255).astype(np.uint8), view.depth)
        for view in (*views(0, STILL), *views(1, way_m))
    ]
    images[FRAMES:FRAMES] = [(np.zeros((*shape, 3), np.uint8), np.zeros(shape))] * COVERED
    shots = [Shot(k, k * FRAME_NS, color, d.astype(np.float32)) for k, (color, d) in enumerate(images)]
    return shots, np.concatenate([PATHS[0], np.full((COVERED, 4, 4), np.nan), PATHS[1]])


def pyramid(shot: Shot, levels: int) -> RgbdPyramid:
    return RgbdPyramid.build(shot.color.astype(np.float32) / 255, shot.depth, CAMERA, levels)


def tracked(shots: list[Shot]) -> tuple[TrackedLog, list[Component]]:
    tracker = SubmapTracker(CAMERA, CONFIG)
    for s in shots:
        tracker.track(of_shot(s))
    log = tracker.finish()
    components = join_submaps(
        log.submaps, lambda frame, levels: pyramid(shots[frame], levels), CONFIG, seed=0, robot="alpha"
    )
    return log, components


def apart_m(component: Component, truth: np.ndarray) -> float:
    """How far keyframes of a component are from the truth, at most, if its first one is right."""
    T = np.array([k.T_map_keyframe for k in component.keyframes])
    true = truth[[k.frame_index for k in component.keyframes]]
    found = true[0] @ np.linalg.inv(T[0]) @ T
    return float(np.linalg.norm((found - true)[:, :3, 3], axis=1).max())


@pytest.mark.parametrize(("way_m", "components"), [((0.0, 0.35), 2), (STILL, 1)])
def test_a_table_that_was_moved_does_not_carry_the_camera_along(way_m, components) -> None:
    shots, truth = recorded(way_m)
    log, found = tracked(shots)
    assert len(found) == components
    assert max(apart_m(component, truth) for component in found) < 0.01
    lost = [k for k, frame in enumerate(log.frames) if frame.status is Status.LOST]
    assert set(range(FRAMES, FRAMES + COVERED)) <= set(lost)
    assert len(lost) <= COVERED + 3  # a place counts when the next frame confirms it


def test_once_something_is_known_to_have_moved_no_single_view_tells_the_place() -> None:
    """Later views show the table alone; what was tracked meanwhile is placed by all of its views."""
    shots, _ = recorded((0.0, 0.35))
    tracker = Tracker(CAMERA, CONFIG)
    frames = [tracker.track(of_shot(s)) for s in shots[: FRAMES + COVERED + 10]]
    reasons = [frame.reason for frame in frames]
    assert set(reasons[:FRAMES]) == {Reason.NONE}
    first = reasons.index(Reason.SOMETHING_MOVED)
    assert first >= FRAMES + COVERED
    assert set(reasons[first:]) == {Reason.SOMETHING_MOVED}
