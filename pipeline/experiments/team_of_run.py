"""The evidence of a finished run as a team to measure the modes of the Gaussian consensus with."""

from __future__ import annotations

import numpy as np

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.config.network import LinkConfig
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.tracks import tracks
from duagc.pipeline.consensus.weighting import shared_evidence
from duagc.pipeline.consensus.weights import Weights
from duagc.pipeline.evaluation.network import Session
from duagc.pipeline.experiments.consensus_modes import Team
from duagc.pipeline.experiments.gaussian_consensus import COORDINATES
from duagc.pipeline.fusion.association import association_covariance
from duagc.pipeline.geometry.spd import add_covariance, without_negative
from duagc.pipeline.network.link_model import neighbors
from duagc.pipeline.runs.folder import RunFolder
from duagc.pipeline.splat.information import LOG_COVARIANCE, pack_information


def team_of_run(run: RunFolder, topology: str) -> Team:
    """What the robots of the largest component know of their tracks, in the world.

    With the variance of sampling as fusion expects it, every member's alike.

    Args:
        run: a finished run.
        topology: of the links between the robots.

    Raises:
        DuagError: nothing was matched.
    """
    names = sorted(run.largest_component)
    evidence, T_world = {}, {}
    for name in names:
        robot = run.robots[name]
        T_map = np.array([k.T_map_camera for k in robot.keyframes])
        T_world[name] = robot.corrected.T_world_keyframe
        own = shared_evidence(name, robot.own_map.gaussians, robot.information, T_map, kind="block")
        evidence[name] = _with_sampling(own.in_world(T_world[name]), run.config.fusion)
    pairs = {key: ids for key, ids in Session(run).pairs.items() if key[0] in names and key[1] in names}
    found = tracks(evidence, pairs, run.config.matching)
    if not len(found.track):
        raise DuagError(f"{run.path}: no Gaussians were matched, expected a run in which robots met")
    count = int(found.track[-1]) + 1
    theta, weights = {}, {}
    for k, name in enumerate(found.robots):
        mine = found.robot == k
        picked = evidence[name].select(found.row[mine])
        theta[name] = np.zeros((count, COORDINATES))
        theta[name][found.track[mine]] = picked.theta
        whole, part = Weights.of_diagonal(np.zeros((count, COORDINATES))), Weights.of(picked)
        for block in ("position", "shape", "color", "opacity"):
            getattr(whole, block)[found.track[mine]] = getattr(part, block)
        weights[name] = whole
    return Team(names, neighbors(LinkConfig.model_validate({"topology": topology}), names), theta, weights)


def _with_sampling(e: Evidence, config: FusionConfig) -> Evidence:
    """(W^-1 + Sigma_assoc)^-1 with half of what two robots' splats are expected to differ by.

    Without the negative eigenvalues that rounding leaves, as robots send it.
    """
    spread = association_covariance(e.theta[:, LOG_COVARIANCE], config.spacing_per_sigma)
    packed = pack_information(
        add_covariance(e.position_information(), spread + 0.5 * config.scatter_position_m**2 * np.eye(3)),
        without_negative(
            add_covariance(e.shape_information(), 0.5 * config.scatter_log_covariance**2 * np.eye(6))
        ),
        e.color_information() / (1 + 0.5 * config.scatter_color**2 * e.color_information()),
        e.opacity_information() / (1 + 0.5 * config.scatter_opacity**2 * e.opacity_information()),
    )
    return Evidence(e.owner, e.ids, e.anchors, e.theta, packed)
