"""What a run takes is predicted from what was measured."""

from pathlib import Path

import numpy as np
import pytest

from duagc.pipeline.cache.durations import USUAL_DEPTH, evaluation_s, front_end_parts, front_end_s, fusion_s
from duagc.pipeline.cache.stage_key import StageKey
from duagc.pipeline.cache.store import Store, StoredResults
from duagc.pipeline.checks.estimate import estimate
from duagc.pipeline.checks.measured import MachineSpeed, speed_of
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.runs.declared_settings import DeclaredSettings
from duagc.pipeline.runs.stages import EVALUATION, FRONTEND, FUSION, Stage

# frames, pixels and predicted keyframes of every robot, and seconds of a run on the two threads of an idle core
# (docs/lab, checkpoints)
MEASURED = {"redkitchen": ([(333, 640 * 480, 13), (333, 640 * 480, 14)], 184)}


def robots(rows: list[tuple[int, int, int]]) -> dict[str, dict[str, int]]:
    return {str(k): {"frames": f, "pixels": p, "keyframes": n} for k, (f, p, n) in enumerate(rows)}


@pytest.mark.parametrize("name", MEASURED)
def test_measured_runs_lie_within_the_range(name: str) -> None:
    rows, seconds = MEASURED[name]
    found = estimate(robots(rows))
    assert found["seconds_from"] < seconds < found["seconds_to"]
    assert found["seconds_to"] < 3 * found["seconds_from"]


def test_small_images_take_more_than_their_share_of_pixels() -> None:
    large, small = (estimate(robots([(100, pixels, 8)] * 2)) for pixels in (640 * 480, 160 * 120))
    assert small["seconds_to"] > large["seconds_to"] / 16 * 2
    assert small["seconds_to"] < large["seconds_to"]
    alone = estimate(robots([(100, 640 * 480, 8)]))
    assert alone["seconds_to"] < large["seconds_to"]
    assert estimate({})["bytes"] == 0


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
    """Views of a tile see Gaussians of others: measured 1.3 with two tiles (docs/lab, keyframes-of-a-log)."""
    one, two, many = ({"frames": 3000, "pixels": 160 * 120, "keyframes": n} for n in (64, 77, 480))
    final = [front_end_parts(size, MappingConfig())["final"] for size in (one, two, many)]
    steps = [MappingConfig().steps(USUAL_DEPTH).final * n for n in (64, 77, 480)]
    a_step = np.array(final) / steps
    assert a_step[1] / a_step[0] == pytest.approx(1.34, rel=0.1)
    assert a_step[2] / a_step[0] == pytest.approx(1.6, rel=0.1)
    assert fusion_s(many) > 480 / 64 * fusion_s(one)


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
