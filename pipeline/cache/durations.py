"""Time that the stages of a run take, before they start, and while they are at work.

Seconds of one of two busy processors of 2.6 GHz, fitted to the parts of whole runs (docs/lab, predicted-times). What a
machine is slower by, and what a recording is harder by, shows while the run goes on, or in the results of earlier ones
(`checks.measured`).
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Mapping, Sequence

from duagc.pipeline.config.fusion import FinetuneConfig
from duagc.pipeline.config.information import InformationConfig
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.training import DepthKind

Size = Mapping[str, int]
"""`frames`, `pixels` of an image and `keyframes` of a robot; `moved`: 1 if depth is of other times than color;
`exact`: 1 if depth is exact, as far as is known."""
TRACKING_S, POSES_S, MODEL_S = (0.003, 0.020), (0.001, 0.020), (0.001, 0.025)
"""Of a frame: in any case, and for every million pixels. There is no model where depth is exact."""
TRACKED_KEYFRAME_S, POSED_KEYFRAME_S = (0.02, 0.23), 0.05
"""The same of a keyframe that is tracked; and of one whose pose is optimized, in any case and once more for every
`POSED_TOGETHER` keyframes of the log."""
POSED_TOGETHER = 150
MOVED_S = 0.10
"""Of moving the depth of a frame, for every million pixels; every stage that reads a frame does it."""
GAUSSIANS_OF_PIXELS = 0.09
"""Gaussians of a tile for every pixel of its keyframes, up to its cap."""
FIRST_OF_PIXELS = 0.35
"""Gaussians of the first keyframe of a map, as a share of the pixels of an image."""
SEEDING_S = 0.75
"""Of what a keyframe seeds and prunes, for every million pixels."""
MAPPING_S, FINAL_S = (0.10, 0.021), (0.19, 0.027)
"""Of a step at a keyframe, and of one of the final optimization: for every million Gaussians, and pixels."""
MANY_TILES = 13
MAPPING_OF_TILES, FINAL_OF_TILES, FUSION_OF_TILES, SCORED_OF_TILES = 1.8, 2.2, 2.9, 6.0
"""By how much longer that takes in a map of so many tiles, whose views see Gaussians of others, and by how much a step
of its training after fusion, and a render of it."""
START_S = 2.0
"""Of a process."""
INFORMATION_S, DEVIATION_S = 0.005, 0.10
"""Of a frame, and of one that shows how far Gaussians are from the surface, for every million pixels."""
INFORMATION_OF_KEYFRAME_S, INFORMATION_OF_TILE_S = (0.03, 0.19), 0.007
"""Of a keyframe: in any case, and for every million pixels; and, as it draws the whole map, for every tile but one."""
FUSION_S = 1.0
"""Of a robot that has peers."""
FUSED_STEP_S = (0.012, 0.095)
"""Of a step on an own view, with those on peers' maps: in any case, and for every million pixels."""
SCORED_S, COMPARED_S = (0.004, 0.100), (0.01, 0.38)
"""The same of a render that is scored, and of a view that is compared with the others."""
SURFACE_S = 2.0
"""Of an evaluation of a robot, for its logs and the true surface."""
AGREED_S, TOGETHER_S = 0.3, 0.2
"""Of a robot for every peer, with whose map its own is compared; and for what all are measured by together."""
VIEWS, HELD_OUT = 40, 8
"""The most views of a set that are scored, and every so many frames one is held out."""
RENDERS, KEYFRAME_RENDERS, PEER_RENDERS = 4, 2, 3
"""Maps that are drawn at a held-out view, at a keyframe, and at a view of a peer."""
EXCHANGE_S, EXCHANGED_KEYFRAME_S = (1.0, 4.0), 0.06
"""Of a robot that has peers: in any case, and for every million pixels; and of each of its keyframes."""
REPORT_S, VIEW_S = 4.0, 2.0
"""Of the whole run."""
SERIAL = 0.15
"""Share of a stage of several threads that one thread does."""


def depth_of(size: Size) -> DepthKind:
    """How the depth of a robot's Gaussians is drawn, as far as is known.

    Args:
        size: of its log.
    """
    return "ray_plane" if size.get("exact") else "blended"


def front_end_parts(size: Size, mapping: MappingConfig) -> dict[str, float]:
    """Time of the parts of a front end.

    Args:
        size: of the robot's log.
        mapping: how long its map is optimized.
    """
    frames, keyframes, depth = size["frames"], size["keyframes"], depth_of(size)

    def of(cost: tuple[float, float]) -> float:
        return _of_pixels(cost, size)

    moved = _moved_s(size) * frames
    tracked = of(TRACKING_S) * frames + of(TRACKED_KEYFRAME_S) * keyframes
    posed = POSED_KEYFRAME_S * keyframes * (1 + keyframes / POSED_TOGETHER)
    step = _step_s(MAPPING_S, size, mapping) * _longer(MAPPING_OF_TILES, size, mapping)
    last = _step_s(FINAL_S, size, mapping) * _longer(FINAL_OF_TILES, size, mapping)
    return {
        "start": START_S,
        "tracking": tracked + (tracked + moved if moved else 0.0),
        "poses": of(POSES_S) * frames + posed + moved,
        "mapping": (of((0.0, SEEDING_S)) + step * mapping.steps(depth).keyframe) * keyframes,
        "final": last * _final_steps(size, mapping),
        "model": of(MODEL_S) * frames + moved if depth == "blended" else 0.0,
    }


def front_end_s(size: Size, mapping: MappingConfig | None = None) -> float:
    """Time of the front end of a robot.

    Args:
        size: of its log.
        mapping: how long its map is optimized; None: as it is by default.
    """
    return sum(front_end_parts(size, mapping or MappingConfig()).values())


def information_s(size: Size) -> float:
    """Time of the Fisher information of a robot.

    Args:
        size: of its log.
    """
    shown = min(size["frames"], InformationConfig().deviation_frames)
    drawn_s = INFORMATION_OF_TILE_S * (_tiles(size, MappingConfig()) - 1)
    keyframes_s = (_of_pixels(INFORMATION_OF_KEYFRAME_S, size) + drawn_s) * size["keyframes"]
    return size["pixels"] * 1e-6 * (INFORMATION_S * size["frames"] + DEVIATION_S * shown) + keyframes_s


def fusion_s(size: Size) -> float:
    """Time of the fusion of a robot that has peers.

    Args:
        size: of its log.
    """
    config = FinetuneConfig()
    step_s = _of_pixels(FUSED_STEP_S, size) * _longer(FUSION_OF_TILES, size, MappingConfig())
    view_s = step_s * config.steps(depth_of(size)).per_view + _moved_s(size)
    return FUSION_S + view_s * _trained_views(size, config)


def evaluation_parts(size: Size, robots: int) -> dict[str, float]:
    """Time of the parts of the evaluation of a robot.

    Args:
        size: of its log.
        robots: of the team, with itself; its maps are drawn at the views of the others.
    """
    views, keyframes = min(VIEWS, size["frames"] / HELD_OUT), min(VIEWS, size["keyframes"])
    of_peers = min(VIEWS, (robots - 1) * size["frames"] / HELD_OUT)
    scored_s = _of_pixels(SCORED_S, size) * _longer(SCORED_OF_TILES, size, MappingConfig())
    compared_s, read_s = _of_pixels(COMPARED_S, size), _moved_s(size)
    return {
        "held_out": (read_s + scored_s * RENDERS) * views,
        "training": (read_s + scored_s * KEYFRAME_RENDERS) * keyframes,
        "peers": (read_s + scored_s * PEER_RENDERS) * of_peers,
        "surface": SURFACE_S,
        "agreement": (read_s + compared_s) * views + AGREED_S * (robots - 1),
    }


def evaluation_of_team_s(robots: int) -> float:
    """Time of what follows the evaluation of each robot.

    Args:
        robots: of the team.
    """
    return TOGETHER_S * robots if robots > 1 else 0.0


def evaluation_s(size: Size, robots: int) -> float:
    """Time of the evaluation of a robot.

    Args:
        size: of its log.
        robots: of the team, with itself.
    """
    return sum(evaluation_parts(size, robots).values())


def exchange_s(sizes: Sequence[Size]) -> float:
    """Time of the exchange of a team.

    Args:
        sizes: of the logs of its robots.
    """
    if len(sizes) < 2:
        return 0.0
    return sum(_of_pixels(EXCHANGE_S, size) + EXCHANGED_KEYFRAME_S * size["keyframes"] for size in sizes)


def side_by_side_s(begun: Iterable[float], waiting: Sequence[float], workers: int) -> float:
    """Time until all of some tasks are done.

    Args:
        begun: what is left of those that are at work.
        waiting: of those that begin in this order, as soon as a worker has none.
        workers: how many there are.
    """
    ends = sorted(begun)
    ends += [0.0] * (workers - len(ends))
    heapq.heapify(ends)
    for seconds in waiting:
        heapq.heapreplace(ends, ends[0] + seconds)
    return max(ends, default=0.0)


def threaded_s(seconds: float, processors: int) -> float:
    """Time of a stage that uses all processors.

    Args:
        seconds: that one thread takes.
        processors: of the machine; threads of a core count each.
    """
    return seconds * (SERIAL + (1 - SERIAL) / processors)


def gaussians(size: Size, mapping: MappingConfig) -> float:
    """How many Gaussians the map of a robot has.

    Args:
        size: `pixels` of an image, and `keyframes`.
        mapping: that makes it.
    """
    first, tiles = FIRST_OF_PIXELS * size["pixels"], _tiles(size, mapping)
    later = GAUSSIANS_OF_PIXELS * size["pixels"] * (size["keyframes"] / tiles - 1)
    return tiles * min(first + max(later, 0), mapping.max_gaussians)


def _of_pixels(cost: tuple[float, float], size: Size) -> float:
    return cost[0] + cost[1] * size["pixels"] * 1e-6


def _moved_s(size: Size) -> float:
    """Time of moving the depth of a frame to the time of its color."""
    return MOVED_S * size["pixels"] * 1e-6 if size.get("moved") else 0.0


def _final_steps(size: Size, mapping: MappingConfig) -> float:
    """Steps of the final optimization of all tiles of a map."""
    tiles = _tiles(size, mapping)
    keyframes = size["keyframes"] / tiles
    views = (
        min(keyframes + mapping.support_views, size["frames"] / tiles)
        + (tiles > 1) * mapping.border_keyframes
    )
    return tiles * mapping.final_steps(keyframes, views, depth_of(size))


def _step_s(cost: tuple[float, float], size: Size, mapping: MappingConfig) -> float:
    """Time of a step in a map of one tile."""
    of_tile = size["pixels"] * size["keyframes"] / _tiles(size, mapping)
    gaussians = min(GAUSSIANS_OF_PIXELS * of_tile, mapping.max_gaussians)
    return (cost[0] * gaussians + cost[1] * size["pixels"]) * 1e-6


def _tiles(size: Size, mapping: MappingConfig) -> int:
    """Tiles of a map."""
    whole = size["keyframes"] <= mapping.whole_keyframes
    return 1 if whole else math.ceil(size["keyframes"] / mapping.tile_keyframes)


def _longer(most: float, size: Size, mapping: MappingConfig) -> float:
    """Time of a step in a map of some tiles relative to that in one of a single tile; `most` in one of many."""
    return 1 + (most - 1) * min((_tiles(size, mapping) - 1) / (MANY_TILES - 1), 1)


def _trained_views(size: Size, config: FinetuneConfig) -> int:
    """Keyframes and other frames that a fused map is trained on."""
    between = size["frames"] - size["keyframes"]
    return size["keyframes"] + min(config.at_most(config.support_views, size["keyframes"]), max(between, 0))


def slowdown(workers: int, processors: int) -> float:
    """By how much slower each of some processes is than where every one has a processor.

    Args:
        workers: processes at work.
        processors: of the machine; threads of a core count each.
    """
    return max(1.0, workers / processors)
