"""Steps that a budget of pixels per second of log allows."""

import pytest

from duagc.pipeline.config.mapping import STEPS, MappingConfig, TrainingSteps
from duagc.pipeline.config.training import DepthKind, SparseStepsConfig
from duagc.pipeline.frontend.mapping_budget import MappingBudget
from duagc.pipeline.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(1000, 500, 400.0, 400.0, 500.0, 250.0)  # half a megapixel
SETTINGS = "iterations", "final_iterations", "final_iterations_view"
STAMPS_NS = [0, 1_000_000_000, 5_000_000_000]


def budget(**settings: object) -> MappingBudget:
    steps = dict(zip(SETTINGS, (10, 90, 22), strict=True))
    return MappingBudget(MappingConfig.model_validate(steps | settings), CAMERA, "blended")


def test_exact_depth_takes_more_steps_at_keyframes_and_fewer_at_the_end() -> None:
    exact, noisy = (MappingBudget(MappingConfig(), CAMERA, depth) for depth in ("ray_plane", "blended"))
    assert exact.keyframe_steps(STAMPS_NS) == [32] * 3
    assert noisy.keyframe_steps(STAMPS_NS) == [8] * 3
    assert [b.final_steps(10, 10, 1.0)[0] for b in (exact, noisy)] == [560, 720]
    assert [b.final_steps(10, 50, 1.0)[0] for b in (exact, noisy)] == [700, 900]


@pytest.mark.parametrize("depth", STEPS)
def test_steps_that_are_set_are_those_of_any_depth(depth: DepthKind) -> None:
    config = MappingConfig(iterations=0, final_iterations=3)
    assert config.steps(depth) == (0, 3, STEPS[depth].final_view)


@pytest.mark.parametrize(("name", "setting"), [*zip(TrainingSteps._fields, SETTINGS, strict=True)])
def test_settings_say_the_steps_that_stand_for_none(name: str, setting: str) -> None:
    exact, noisy = (getattr(STEPS[depth], name) for depth in ("ray_plane", "blended"))
    said = " ".join(MappingConfig.documentation()[setting].split())
    assert said.endswith(f"None: {noisy}, or {exact} where depth is exact.")


def test_without_a_budget_all_steps_are_taken() -> None:
    assert budget().keyframe_steps(STAMPS_NS) == [10, 10, 10]
    assert budget().final_steps(2, 10, 1.0) == (220, 220)
    assert budget(final_iterations_max=100).final_steps(2, 10, 1.0) == (100, 100)
    assert budget().keyframe_steps([]) == []


def test_steps_at_keyframes_by_the_time_since_the_last() -> None:
    assert budget(keyframe_megapixels_s=2.0).keyframe_steps(STAMPS_NS) == [10, 4, 10]
    assert budget(keyframe_megapixels_s=2.0, iterations_level=1, iterations=24).keyframe_steps(STAMPS_NS) == [
        24,
        16,
        24,
    ]
    assert budget(keyframe_megapixels_s=0.0).keyframe_steps(STAMPS_NS) == [10, 0, 0]


def test_final_steps_by_the_length_of_the_log() -> None:
    whole = SparseStepsConfig(checkerboard=False)
    assert budget(final_megapixels_s=10.0, sparse=whole).final_steps(2, 10, 5.0) == (220, 100)
    half = SparseStepsConfig()
    assert budget(final_megapixels_s=10.0, sparse=half).final_steps(2, 10, 5.0) == (220, 200)
    assert budget(final_megapixels_s=10.0, sparse=half).final_steps(2, 10, 50.0) == (220, 220)
    assert budget(final_megapixels_s=0.0).final_steps(2, 10, 5.0) == (220, 0)
