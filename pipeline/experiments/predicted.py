"""How long experiments take, before they run: every different run once, and every different front end once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from duagc.converters.simulate.trajectories.legs import FIRST_FRAMES, LEG_FRAMES
from duagc.pipeline.cache import durations
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.frontend import TrackingConfig
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.experiments.rule import Experiment, SimulatedData, config_of, data_of

FRAMES_PER_KEYFRAME = 14
"""About as many as simulated robots have."""
PIXEL_STEPS_PER_S = 1e7
"""Pixels that tracking by rendering looks at in a second."""
OPEN3D_FRAMES_PER_S = 10
"""Of Open3D's dense SLAM, with voxels of 2 cm."""
FOUND_SHARE = 0.05
"""Of the predicted time, up to which an experiment was found, not computed."""


RUN, FRONT_END, STEERING = "run", "front end", "steering"
Part = tuple[str, ...]
"""What is computed once: which of these, of which recording, with which settings."""


@dataclass(frozen=True)
class PredictedTime:
    """What some experiments take.

    Attributes:
        runs: that their rules ask for.
        different: of them; the others are found in the store.
        cpu_s: processor time of these, without simulating the recordings, which are few; with what steers a robot.
    """

    runs: int
    different: int
    cpu_s: float


def predicted_time(experiments: Sequence[Experiment], profile: str) -> PredictedTime:
    """What experiments take that share a store, on the machine that `cache.durations` was fitted on.

    Args:
        experiments: the experiments.
        profile: name of how much is computed.
    """
    parts = [_parts(experiment, profile) for experiment in experiments]
    different = {key: cpu_s for part in parts for key, cpu_s in part}
    runs = sum(key[0] == RUN for part in parts for key, _ in part)
    return PredictedTime(runs, sum(key[0] == RUN for key in different), sum(different.values()))


def time_left_s(predicted_s: Sequence[float], took_s: Sequence[float], workers: int) -> float:
    """Wall time of the experiments that are left, at the pace of those that were computed.

    Args:
        predicted_s: processor time of each, without what those before it compute.
        took_s: wall time of each that is done; those found in the store took next to none, and say nothing.
        workers: runs at the same time.
    """
    computed = [k for k, took in enumerate(took_s) if took > FOUND_SHARE * predicted_s[k]]
    before_s, wall_s = sum(predicted_s[k] for k in computed), sum(took_s[k] for k in computed)
    pace = wall_s / before_s if before_s else 1 / workers
    return pace * sum(predicted_s[len(took_s) :])


def predicted_each_s(experiments: Sequence[Experiment], profile: str) -> list[float]:
    """Processor time of experiments one after the other, each without what those before it have computed.

    Args:
        experiments: in their order.
        profile: name of how much is computed.
    """
    found: dict[Part, float] = {}
    each_s = []
    for experiment in experiments:
        new = {key: cpu_s for key, cpu_s in _parts(experiment, profile) if key not in found}
        found |= new
        each_s.append(sum(new.values()))
    return each_s


def _parts(experiment: Experiment, profile: str) -> list[tuple[Part, float]]:
    """All front ends and runs of an experiment, by what they compute, with their processor time."""
    chosen = experiment.profile(profile)
    parts: list[tuple[Part, float]] = []
    for name in experiment.file.configurations:
        data = data_of(experiment.file, chosen, name)
        config = load_config(RunConfig, None, config_of(experiment.file, chosen, name))
        whole, images = config.model_dump_json(), config.frontend.model_dump_json()
        front_s, rest_s = _times(data, config)
        for seed in chosen.seeds:
            recording = (data.model_dump_json(), str(seed))
            parts.append(((RUN, *recording, whole), rest_s))
            parts.append(((FRONT_END, *recording, images), front_s))
            if data.steering not in ("", "random"):
                parts.append(((STEERING, *recording), _steering_s(data, config)))
    return parts


def _steering_s(data: SimulatedData, config: RunConfig) -> float:
    """Of the maps by which a robot was steered."""
    lengths = range(FIRST_FRAMES, data.frames, LEG_FRAMES)
    alone = [data.model_copy(update={"robots": 1, "frames": frames}) for frames in lengths]
    return sum(_times(one, config)[0] for one in alone)


def _times(data: SimulatedData, config: RunConfig) -> tuple[float, float]:
    """Of the front ends of a run, and of all that comes after them."""
    keyframes = 1 + data.frames // FRAMES_PER_KEYFRAME
    depth = config.frontend.mapping.depth_kind(0.0 if data.noise == "none" else None)
    size = {"frames": data.frames, "pixels": data.width * data.height, "keyframes": keyframes}
    size["exact"] = int(depth == "ray_plane")
    front_s = durations.front_end_s(size, config.frontend.mapping) + durations.information_s(size)
    front_s += _other_tracker_s(size, config.frontend.tracking)
    rest_s = durations.exchange_s([size] * data.robots)
    rest_s += data.robots * (_fusion_s(size, config) + durations.evaluation_s(size, data.robots))
    return data.robots * front_s, rest_s


def _other_tracker_s(size: durations.Size, config: TrackingConfig) -> float:
    """What a tracker to compare with takes besides."""
    if config.method == "rendering":
        pixels = size["pixels"]
        while pixels > config.rendering.max_pixels:
            pixels //= 4
        return size["frames"] * (config.rendering.steps + 1) * pixels / PIXEL_STEPS_PER_S
    return size["frames"] / OPEN3D_FRAMES_PER_S if config.method == "open3d" else 0.0


def _fusion_s(size: durations.Size, config: RunConfig) -> float:
    """Of a robot; `durations` knows the views and steps of the defaults alone."""
    mine, usual = config.fusion.finetune, RunConfig().fusion.finetune
    others = size["frames"] - size["keyframes"]
    views = size["keyframes"] + min(mine.support_views, others)
    share = views / (size["keyframes"] + min(MappingConfig().support_views, others))
    trained_s = durations.fusion_s(size) - durations.FUSION_S
    steps, usual_steps = (config.steps(durations.depth_of(size)).per_view for config in (mine, usual))
    return durations.FUSION_S + trained_s * share * steps / usual_steps
