"""What a run takes is predicted from what was measured."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.cache.durations import evaluation_s, front_end_parts, front_end_s, fusion_s
from duagc.pipeline.cache.stage_key import StageKey
from duagc.pipeline.cache.store import Store, StoredResults
from duagc.pipeline.checks import measured
from duagc.pipeline.checks.estimate import estimate
from duagc.pipeline.checks.measured import MachineSpeed, speed_of
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.runs.declared_settings import DeclaredSettings
from duagc.pipeline.runs.stages import EVALUATION, FRONTEND, FUSION, Stage

VGA, NOISY, MOVED, EXACT = 640 * 480, {}, {"moved": 1}, {"exact": 1}
# frames, pixels and keyframes of every robot, what their depth is like, and seconds of a run on two idle processors
# (docs/lab, predicted-times)
MEASURED = {
    "redkitchen": ([(333, VGA, 13), (333, VGA, 13)], NOISY, 86),
    "fr1_desk": ([(150, VGA, 10), (150, VGA, 17)], MOVED, 107),
    "demo": ([(160, 480 * 360, 11), (160, 480 * 360, 13)], EXACT, 56),
    "house": ([(300, VGA, 45), (300, VGA, 42)], EXACT, 159),
    "all rooms": ([(3000, 320 * 240, 487), (3000, 320 * 240, 440)], EXACT, 1896),
}


def robots(rows: list[tuple[int, int, int]], **depth: int) -> dict[str, dict[str, int]]:
    return {str(k): {"frames": f, "pixels": p, "keyframes": n, **depth} for k, (f, p, n) in enumerate(rows)}


@pytest.mark.parametrize("name", MEASURED)
def test_measured_runs_lie_within_the_range(name: str) -> None:
    rows, depth, seconds = MEASURED[name]
    found = estimate(robots(rows, **depth))
    assert 1.2 * found["seconds_from"] < seconds < found["seconds_to"] / 1.2
    assert found["seconds_to"] < 3 * found["seconds_from"]


def test_exact_depth_is_predicted_by_its_own_steps() -> None:
    size, config = {"frames": 300, "pixels": VGA, "keyframes": 45}, MappingConfig()
    noisy, exact = (front_end_parts(size | depth, config) for depth in (NOISY, EXACT))
    steps, of_exact = (config.steps(kind) for kind in ("blended", "ray_plane"))
    assert exact["final"] / noisy["final"] == pytest.approx(of_exact.final / steps.final)
    assert 1.5 < exact["mapping"] / noisy["mapping"] < of_exact.keyframe / steps.keyframe
    assert exact["model"] == 0 < noisy["model"]
    assert fusion_s(size | EXACT) > 1.4 * fusion_s(size)


def test_small_images_take_more_than_their_share_of_pixels() -> None:
    large, small = (estimate(robots([(100, pixels, 8)] * 2)) for pixels in (640 * 480, 160 * 120))
    assert small["seconds_to"] > large["seconds_to"] / 16 * 2
    assert small["seconds_to"] < large["seconds_to"]
    alone = estimate(robots([(100, 640 * 480, 8)]))
    assert alone["seconds_to"] < large["seconds_to"]
    assert estimate({})["bytes"] == 0


@pytest.mark.parametrize(
    ("rows", "megabytes"),  # of the folder of the run, two robots each
    [
        ([(333, VGA, 13), (333, VGA, 13)], 173.1),  # RedKitchen
        ([(150, VGA, 10), (150, VGA, 17)], 178.2),  # fr1_desk
        ([(100, 320 * 240, 10), (100, 320 * 240, 10)], 173.3),  # the tutorial
        ([(30, 160 * 120, 2), (30, 160 * 120, 3)], 29.1),
        ([(16, 160 * 120, 1), (16, 160 * 120, 2)], 13.5),
    ],
)
def test_the_room_on_the_disk_is_that_of_measured_runs(
    rows: list[tuple[int, int, int]], megabytes: float
) -> None:
    """A store holds as much again."""
    assert 1e-6 * estimate(robots(rows))["bytes"] == pytest.approx(2 * megabytes, rel=0.8)
    assert 1e-6 * estimate(robots(rows))["bytes"] > 0.9 * 2 * megabytes


def test_results_of_earlier_versions_are_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They say less of themselves, or of what they took; of some logs no map could be begun."""
    size, time = {"frames": 30, "pixels": VGA, "keyframes": 3}, {"cpu_s": 10.0}

    def entry(result: Any, timing: dict[str, float], log: str) -> StoredResults:
        return StoredResults(StageKey("x", "alpha", {}, {}, {}, {"log": log}), {}, result, timing)

    of_stages = {
        "frontend": [
            entry(size, time, "a"),
            entry({"frames": 30, "pixels": VGA}, time, "b"),
            entry(size, {}, "c"),
            entry(size | {"keyframes": 0}, time, "d"),
        ],
        "fusion": [
            entry({"robots": 2}, time, "a"),
            entry({"left_out": {}}, time, "a"),
            entry(None, time, "a"),
        ],
        "evaluation": [entry(None, {}, "a")],
    }
    monkeypatch.setattr(measured, "_is_default", lambda entry, stage: True)
    monkeypatch.setattr(Store, "recent", lambda self, stage, most: iter(of_stages[stage]))
    assert measured.speed_of(tmp_path).stages == 2


def test_keyframes_that_are_not_known_widen_the_range() -> None:
    known = robots([(300, 640 * 480, 40)])
    unknown = {"0": known["0"] | {"keyframes_from": 20, "keyframes_to": 80}}
    exact, wide = estimate(known), estimate(unknown)
    assert wide["seconds_to"] > 1.2 * exact["seconds_to"]
    assert wide["seconds_from"] < exact["seconds_from"] / 1.1
    for number in (20, 80):  # its own range may lie beyond, its middle not
        found = estimate(robots([(300, 640 * 480, number)]))
        assert wide["seconds_from"] < 1.5 * found["seconds_from"] < wide["seconds_to"]


def test_maps_of_many_tiles_take_more_than_their_keyframes() -> None:
    """Views see Gaussians of other tiles: 1.2 with four tiles, 2.2 with thirteen (docs/lab, predicted-times)."""
    one, four, many = ({"frames": 3000, "pixels": 320 * 240, "keyframes": n} for n in (64, 142, 487))
    final = [front_end_parts(size, MappingConfig())["final"] for size in (one, four, many)]
    steps = [MappingConfig().steps("blended").final * n for n in (64, 142, 487)]
    a_step = np.array(final) / steps
    assert a_step[1] / a_step[0] == pytest.approx(1.2, rel=0.1)
    assert a_step[2] / a_step[0] == pytest.approx(2.2, rel=0.1)
    assert fusion_s(many) > 2 * 487 / 64 * fusion_s(one)


SIZE = {"frames": 200, "pixels": 640 * 480, "keyframes": 10}


def keep(store: Path, stage: Stage, inputs: dict[str, str], cpu_s: float, *overrides: str) -> None:
    """A result in a store, as a run leaves it."""
    config = load_config(RunConfig, overrides=overrides)
    settings = DeclaredSettings(config, stage.name, stage.settings).plain()
    key = StageKey(stage.name, "alpha" if stage.per_robot else None, {}, {}, settings, inputs)
    result = SIZE if stage is FRONTEND else {"robots": len(inputs["log"])}
    Store(store).keep(StoredResults(key, {}, result, {"cpu_s": cpu_s}), store)


def test_a_machine_that_was_slow_is_predicted_to_be_slow(tmp_path: Path) -> None:
    store = tmp_path / "store"
    assert speed_of(store) == MachineSpeed()
    keep(store, FRONTEND, {"log": "a"}, 2.5 * front_end_s(SIZE))
    keep(store, FRONTEND, {"log": "b"}, 3.5 * front_end_s(SIZE), "seed=7")
    keep(store, FRONTEND, {"log": "c"}, 9.0 * front_end_s(SIZE), "frontend.mapping.iterations=99")
    keep(store, FUSION, {"log": "a"}, 99.0)  # alone: it says nothing of a robot that has peers
    team = {"log": "", "recording: alpha.mcap": "a", "robots/alpha/frontend.mcap": "x"}
    keep(store, EVALUATION, team, 2.0 * evaluation_s(SIZE, 1))
    keep(
        store, EVALUATION, team | {"robots/bravo/frontend.mcap": "y"}, 9.0
    )  # of a robot whose size is unknown
    speed = speed_of(store)
    assert speed.ratios == pytest.approx({"frontend": 3.0, "evaluation": 2.0})
    assert speed.stages == 3
    slow, usual = (estimate({"alpha": SIZE}, ratios) for ratios in (speed.ratios, {}))
    expected = 6.0 + 3.0 * front_end_s(SIZE) + 2.0 * evaluation_s(SIZE, 1)
    keep(store, FRONTEND, {"log": "dd"}, 3.0 * front_end_s(SIZE))
    keep(store, FUSION, {"log": "dd"}, 4.0 * fusion_s(SIZE))
    assert speed_of(store).ratios["fusion"] == pytest.approx(4.0)
    assert slow["seconds_from"] < expected < slow["seconds_to"]
    assert slow["seconds_from"] > 2 * usual["seconds_from"]
