"""What the structure of the information of single Gaussians is, and whether it is what the method assumes.

A random sample of the Gaussians of every robot's own map, of a finished run. The claims stand in
`information_rules.toml`, which was written before the first result; its digest goes into every result.
"""

from __future__ import annotations

import hashlib
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.component_names import robot_of
from duagc.pipeline.base.errors import DuagError, closest
from duagc.pipeline.base.files import digest_of_values, new_file, read_bytes
from duagc.pipeline.cache.code_identity import CodeReader
from duagc.pipeline.config.base import Config
from duagc.pipeline.experiments.information_blocks import BlockSums, sum_blocks
from duagc.pipeline.experiments.information_measures import measures
from duagc.pipeline.information.noise import estimate_noise, with_correlation
from duagc.pipeline.information.stage import own_views, read_frontend
from duagc.pipeline.messages import GaussianInformation
from duagc.pipeline.recording import Recording, open_rgbd
from duagc.pipeline.runs.folder import RobotRun, RunFolder
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import unpack_geometry

SCHEMA = 1
RULES_FILE = Path(__file__).with_name("information_rules.toml")
STRATA = ("opacity", "footprint_px", "views", "depth_m", "residual")


class ShareRule(Config):
    """A claim: for a share of the Gaussians a measure lies within bounds."""

    name: str
    claim: str
    measure: str
    least: float = Field(-math.inf, allow_inf_nan=True)
    most: float = Field(math.inf, allow_inf_nan=True)
    share: float = Field(gt=0.0, lt=1.0)
    control: bool = False
    """Known to be false: if it holds, the other verdicts are worthless."""
    reason: str


class InformationRules(Config):
    """What stands in the file of the rules."""

    question: str
    claim: str
    limits: str
    rules: tuple[ShareRule, ...]


@dataclass(frozen=True)
class StructurePlan:
    """What is computed.

    Attributes:
        sample: Gaussians of each robot, at most; those that no keyframe saw drop out.
        windows: numbers of keyframes K.
        robots: names; empty: all.
        seed: of the sample.
    """

    sample: int = 400
    windows: tuple[int, ...] = (1, 2, 4, 8, 10)
    robots: tuple[str, ...] = ()
    seed: int = 0


@dataclass(frozen=True)
class Structure:
    """What was found.

    Attributes:
        summary: ready for JSON.
        columns: a value for each Gaussian that was measured, by name: robot, id, strata, measures.
    """

    summary: dict[str, Any]
    columns: dict[str, NDArray[Any]]


def run(folder: RunFolder, source: Recording, plan: StructurePlan) -> Structure:
    """Measure the information of a finished run's Gaussians.

    Args:
        folder: of the run.
        source: its recording; ground truth is not opened.
        plan: what.

    Raises:
        DuagError: no such robot, or the run has information of another window than all keyframes.
    """
    if folder.config.information.window != "all":
        raise DuagError(
            f"{folder.config_file}: information.window is {folder.config.information.window}, expected all"
        )
    for name in plan.robots:
        if name not in folder.robots:
            raise DuagError(
                f"{folder.path}: has no robot {name}, {closest(name, list(folder.robots), 'a robot')}"
            )
    found = {name: _of_robot(folder, source, name, plan) for name in plan.robots or folder.robots}
    columns = {
        name: np.concatenate([columns[name] for _, columns in found.values()])
        for name in next(iter(found.values()))[1]
    }
    data = read_bytes(RULES_FILE, "the rules of the information")
    rules = InformationRules.model_validate(tomllib.loads(data.decode()))
    summary = {
        "schema": SCHEMA,
        "question": rules.question,
        "claim": rules.claim,
        "limits": rules.limits,
        "run": folder.path.name,
        "recording": source.name,
        "rules_sha256": hashlib.sha256(data).hexdigest(),
        "sample": plan.sample,
        "seed": plan.seed,
        "windows": list(plan.windows),
        "robots": {name: facts for name, (facts, _) in found.items()},
        "verdicts": [_verdict(rule, columns) for rule in rules.rules],
    }
    return Structure(summary, columns)


def _of_robot(
    folder: RunFolder, source: Recording, name: str, plan: StructurePlan
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Facts of one robot, and its columns."""
    robot, config = folder.robots[name], folder.config
    frontend = robot.folder / "frontend.mcap"
    floor_m = config.frontend.mapping.seeding.thickness_m
    with open_rgbd(source.log(robot_of(name))) as log:
        views, _ = own_views(log, read_frontend(frontend), frontend, config.frontend.moving)
        rows = _sampled(robot, plan)
        noise, _ = with_correlation(estimate_noise(views, config.information), views, config.information)
        sums = sum_blocks(
            views, noise, rows, plan.windows, thickness_floor_m=floor_m, what=f"information of {name}"
        )
        keyframes = len(views.images)
    gaussians, information = views.gaussians.select(rows), selected(robot.information, rows)
    seen = sums.views > 0
    facts = {
        "gaussians": len(views.gaussians),
        "keyframes": keyframes,
        "sampled": len(rows),
        "seen": int(seen.sum()),
        "color_sigma": noise.color_sigma,
        "depth_sigma": noise.depth_formula(),
        "color_pixels_per_sample": noise.color_pixels,
        "depth_pixels_per_sample": noise.depth_pixels,
        "difference_from_stage": agreement(sums, information),
        "views_that_differ": int((sums.views != information.observations).sum()),
    }
    columns: dict[str, NDArray[Any]] = {
        "robot": np.full(len(rows), name),
        "id": gaussians.ids,
        **strata(sums, gaussians),
        **measures(sums, gaussians, information, seed=plan.seed),
    }
    for K in plan.windows:
        if keyframes <= K:  # all of them: nothing to compare
            columns |= {
                f"{kind}_{K}": np.full(len(rows), np.nan) for kind in ("rolling", "latest", "r_latest")
            }
    return facts, {key: column[seen] for key, column in columns.items()}


def _sampled(robot: RobotRun, plan: StructurePlan) -> NDArray[np.int64]:
    count = len(robot.own_map.gaussians)
    draws = random_streams.generator(plan.seed, "sample of the information", robot=robot.robot)
    return np.sort(draws.permutation(count)[: plan.sample]).astype(np.int64)


def selected(information: GaussianInformation, rows: NDArray[np.int64]) -> GaussianInformation:
    """The information of some Gaussians.

    Args:
        information: of all.
        rows: [r], of those that are wanted.
    """
    names = ("ids", "geometry", "color", "opacity", "observations", "deviation_m")
    return replace(information, **{name: getattr(information, name)[rows] for name in names})


def strata(sums: BlockSums, gaussians: Gaussians) -> dict[str, Array]:
    """What the Gaussians are sorted by, [r] each, by name.

    Args:
        sums: of r Gaussians.
        gaussians: these.
    """
    views = np.maximum(sums.views, 1)
    return {
        "opacity": gaussians.opacities(),
        "footprint_px": sums.pixels / views,
        "views": sums.views.astype(np.float64),
        "depth_m": sums.depth_m / views,
        "residual": sums.residual / np.maximum(sums.weight, 1e-12),
    }


def agreement(sums: BlockSums, information: GaussianInformation) -> dict[str, float]:
    """Largest relative difference between these sums and those that the stage wrote, by block.

    Args:
        sums: of r Gaussians, over all keyframes.
        information: of them, as the stage wrote it.
    """
    geometry = unpack_geometry(information.geometry)
    diagonal = np.diagonal(sums.chart, axis1=1, axis2=2)
    pairs = {
        "geometry": (sums.chart[:, :9, :9], geometry),
        "color": (diagonal[:, 9:12], information.color.astype(np.float64)),
        "opacity": (diagonal[:, 12:], information.opacity.astype(np.float64)[:, None]),
    }
    out = {}
    for name, (mine, theirs) in pairs.items():
        axes = tuple(range(1, mine.ndim))
        size = np.sqrt((theirs**2).sum(axis=axes))
        off = np.sqrt(((mine - theirs) ** 2).sum(axis=axes))
        out[name] = float((off / np.where(size > 0, size, 1.0)).max(initial=0.0))
    return out


def _verdict(rule: ShareRule, columns: Mapping[str, Array]) -> dict[str, Any]:
    """Whether a rule holds for the sample, and why."""
    if rule.measure not in columns:
        return _said(rule, "not testable", f"{rule.measure} was not computed", None)
    values = columns[rule.measure]
    values = values[~np.isnan(values)]
    if not len(values):
        return _said(rule, "not testable", "there is nothing to compare", None)
    met = int(np.count_nonzero((values >= rule.least) & (values <= rule.most)))
    share, (low, high) = met / len(values), wilson(met, len(values))
    word = "holds" if low >= rule.share else "fails" if high < rule.share else "open"
    why = f"{100 * share:.1f} % ({100 * low:.1f} to {100 * high:.1f}) of {len(values)}"
    return _said(rule, word, f"{why}, expected {100 * rule.share:g} %", share)


def _said(rule: ShareRule, word: str, why: str, share: float | None) -> dict[str, Any]:
    named = {"name": rule.name, "claim": rule.claim, "control": rule.control}
    return {**named, "verdict": word, "why": why, "share": share}


def wilson(met: int, count: int) -> tuple[float, float]:
    """95 % interval of a share that was found in a random sample (Wilson 1927).

    Args:
        met: of the sample, how many.
        count: of the sample.
    """
    from scipy.stats import binomtest

    interval = binomtest(met, count).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def code_digest() -> str:
    """SHA-256 of the code that everything here is computed by."""
    modules = CodeReader().version_of(f"{__name__}:run").modules
    return digest_of_values(modules)


def write_gaussians(columns: Mapping[str, NDArray[Any]], path: Path) -> None:
    """Write one row for each Gaussian as Parquet.

    Args:
        columns: of `Structure`.
        path: of the file.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with new_file(path) as part:
        pq.write_table(pa.table({name: pa.array(c) for name, c in columns.items()}), part, compression="zstd")


def quantile(values: Array, share: float) -> float:
    """The least value that so many are not above; of values that are not NaN, NaN of none.

    Args:
        values: may be infinite.
        share: 0 to 1.
    """
    known = values[~np.isnan(values)]
    return float(np.quantile(known, share, method="inverted_cdf")) if len(known) else math.nan


def thirds(values: Array) -> Sequence[tuple[float, float, NDArray[np.bool_]]]:
    """Lower, middle and upper third: least and largest value, and which; thirds without any are left out.

    Args:
        values: [n]; equal ones stay together.
    """
    edges = [quantile(values, share) for share in (1 / 3, 2 / 3)]
    number = np.searchsorted(edges, values, side="left")
    parts = [number == k for k in range(3)]
    return [(float(values[p].min()), float(values[p].max()), p) for p in parts if p.any()]
