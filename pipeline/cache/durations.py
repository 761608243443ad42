"""Time that the stages of a run take, before they start, and while they are at work.

Seconds of one of the two busy threads of a core of 2.6 GHz, fitted to the parts of a whole run
(docs/reference/checks.md). What a machine is slower by, and what a recording is harder by, shows while the run goes on,
or in the results of earlier ones (`checks.measured`).
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
"""`frames`, `pixels` of an image and `keyframes` of a robot; `moved`: 1 if depth is of other times than color."""
TRACKING_S, POSES_S, MODEL_S = (0.005, 0.039), (0.007, 0.025), (0.001, 0.057)
"""Of a frame: in any case, and for every million pixels."""
MOVED_S = 0.14
"""Of moving the depth of a frame, for every million pixels; every stage that reads a frame does it."""
SEEDING_S = (0.0, 0.3)
"""The same of what a keyframe seeds and prunes."""
MAPPING_S = (0.0015, 0.086)
"""The same of a step of mapping, of which every keyframe takes some."""
FINAL_S = (0.0030, 0.080)
"""The same of a step of the final optimization."""
MAPPING_OF_TILES, FINAL_OF_TILES = 1.9, 1.7
"""By how much longer a step takes in a map of many tiles, whose views see Gaussians of others (docs/lab, length)."""
USUAL_DEPTH: DepthKind = "blended"
"""Of maps, as far as is known before they are made: by their steps those of exact depth take about as long."""
START_S = 2.0
"""Of a process."""
INFORMATION_S, DEVIATION_S = 0.020, 0.10
"""Of a frame, and of one that shows how far Gaussians are from the surface, for every million pixels."""
INFORMATION_OF_TILE_S = 0.003
"""Of a keyframe, which draws the whole map, for every tile but one."""
FUSION_S = 1.0
"""Of a robot that has peers."""
FUSED_VIEW_S = (0.062, 0.73)
"""Of a view that its fused map is trained on: in any case, and for every million pixels."""
SCORED_S, COMPARED_S = (0.006, 0.200), (0.02, 0.55)
"""The same of a render that is scored, and of a view that is compared with the others."""
SURFACE_S = 2.0
"""Of an evaluation of a robot, for its logs and the true surface."""
AGREED_S = 1.7
"""Of a robot that has peers, for what all are measured by together."""
VIEWS, HELD_OUT = 40, 8
"""The most views of a set that are scored, and every so many frames one is held out."""
RENDERS, KEYFRAME_RENDERS, PEER_RENDERS = 4, 2, 3
"""Maps that are drawn at a held-out view, at a keyframe, and at a view of a peer."""
EXCHANGE_S, EXCHANGED_KEYFRAME_S = (2.0, 10.0), 0.035
"""Of a robot that has peers: in any case, and for every million pixels; and of each of its keyframes."""
REPORT_S, VIEW_S = 5.0, 2.0
"""Of the whole run."""
SERIAL = 0.15
"""Share of a stage of several threads that one thread does."""


def front_end_parts(size: Size, mapping: MappingConfig) -> dict[str, float]:
    """Time of the parts of a front end.

    Args:
        size: of the robot's log.
        mapping: how long its map is optimized.
    """
    frames, keyframes = size["frames"], size["keyframes"]
    steps = mapping.steps(USUAL_DEPTH).keyframe

    def of(cost: tuple[float, float]) -> float:
        return _of_pixels(cost, size)

    moved = _moved_s(size) * frames
    return {
        "start": START_S,
        "tracking": of(TRACKING_S) * frames + (of(TRACKING_S) * frames + moved if moved else 0.0),
        "poses": of(POSES_S) * frames + moved,
        "mapping": (of(SEEDING_S) + of(MAPPING_S) * steps)
        * keyframes
        * _longer(MAPPING_OF_TILES, size, mapping),
        "final": of(FINAL_S) * _final_steps(size, mapping) * _longer(FINAL_OF_TILES, size, mapping),
        "model": of(MODEL_S) * frames + moved,
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
    drawn_s = INFORMATION_OF_TILE_S * size["keyframes"] * (_tiles(size, MappingConfig()) - 1)
    return size["pixels"] * 1e-6 * (INFORMATION_S * size["frames"] + DEVIATION_S * shown) + drawn_s


def fusion_s(size: Size) -> float:
    """Time of the fusion of a robot that has peers.

    Args:
        size: of its log.
    """
    view_s = _of_pixels(FUSED_VIEW_S, size) + _moved_s(size)
    longer = _longer(FINAL_OF_TILES, size, MappingConfig())
    return FUSION_S + view_s * _trained_views(size, FinetuneConfig()) * longer


def evaluation_parts(size: Size, robots: int) -> dict[str, float]:
    """Time of the parts of the evaluation of a robot.

    Args:
        size: of its log.
        robots: of the team, with itself; its maps are drawn at the views of the others.
    """
    views, keyframes = min(VIEWS, size["frames"] / HELD_OUT), min(VIEWS, size["keyframes"])
    of_peers = min(VIEWS, (robots - 1) * size["frames"] / HELD_OUT)
    scored_s, compared_s, read_s = _of_pixels(SCORED_S, size), _of_pixels(COMPARED_S, size), _moved_s(size)
    return {
        "held_out": (read_s + scored_s * RENDERS) * views,
        "training": (read_s + scored_s * KEYFRAME_RENDERS) * keyframes,
        "peers": (read_s + scored_s * PEER_RENDERS) * of_peers,
        "surface": SURFACE_S,
        "agreement": (read_s + compared_s) * views,
    }


def evaluation_of_team_s(robots: int) -> float:
    """Time of what follows the evaluation of each robot.

    Args:
        robots: of the team.
    """
    return AGREED_S * robots if robots > 1 else 0.0


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
    return tiles * mapping.final_steps(keyframes, views, USUAL_DEPTH)


def _tiles(size: Size, mapping: MappingConfig) -> int:
    """Tiles of a map."""
    whole = size["keyframes"] <= mapping.whole_keyframes
    return 1 if whole else math.ceil(size["keyframes"] / mapping.tile_keyframes)


def _longer(most: float, size: Size, mapping: MappingConfig) -> float:
    """Time of a step in a map of some tiles relative to that in one of a single tile; `most` in one of many."""
    return 1 + (most - 1) * (1 - 1 / _tiles(size, mapping))


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
