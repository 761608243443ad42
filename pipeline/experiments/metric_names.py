"""Names of the metrics that a rule may compare, and which of them need ground truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase

from duagc.pipeline.base.component_names import submap_of
from duagc.pipeline.base.errors import DuagError, closest

_ROBOT = (
    "frames tracked keyframes gaussians gaussians_fused stated_scale robots_in_component rpe_trans_m rpe_rot_rad "
    "ate_rmse_m ate_rmse_m_before_consensus ate_rmse_m_keyframes ate_rmse_m_joint frames_with_truth "
    "depth_agreement_m feature_agreement_px depth_agreement_m_before_consensus "
    "feature_agreement_px_before_consensus depth_agreement_m_of_truth feature_agreement_px_of_truth"
)
_TEAM = (
    "robots robots_in_largest_component ate_rmse_m ate_rmse_m_mean_of_robots inter_robot_loop_closures "
    "inter_robot_loop_closures_rejected"
)
_VIEWS = (
    "views views_without_pose psnr_db psnr_interpolated_db psnr_moved_db psnr_exposure_db ssim ms_ssim depth_l1_m "
    "depth_l1_exact_m depth_l1_layer_m depth_l1_common_m depth_completeness"
)
_EXCHANGE = (
    "sessions rounds messages packets_sent packets_dropped bytes_sent bytes_delivered bytes_setup "
    "bytes_per_round_per_robot_pair bytes_raw_alternative bytes_raw_alternative_maps_only "
    "bytes_paper_accounting matched_pairs"
)
_CONSENSUS = (
    "rounds_to_tolerance gap_to_oracle_m gap_to_oracle_rad gap_to_oracle_sigma gap_to_oracle_sigma_p99 "
    "rejected_matches_share matching_precision matching_recall"
)
_CALIBRATION = (
    "ece_paper ece_rank ece_rank_if_right ece_rank_shuffled spearman ause nll coverage_95 nll_scaled "
    "coverage_95_scaled sigma_scale gaussians gaussians_without_information"
)

_PIXELS = (
    "pixels pixels_without_sigma median_error_m median_sigma_m spearman ece_rank ece_rank_if_right "
    "ece_rank_shuffled coverage_95 nll sigma_scale coverage_95_scaled nll_scaled"
)


def _known() -> Iterator[str]:
    for section, keys in (
        ("robots.*", _ROBOT),
        ("team", _TEAM),
        ("exchange", _EXCHANGE),
        ("consensus", _CONSENSUS),
        ("calibration", _CALIBRATION),
    ):
        yield from (f"{section}.{key}" for key in keys.split())
    of_maps = [
        f"{map_}.{views}"
        for map_ in ("own", "fused", "refined", "central")
        for views in ("held_out", "peers", "team")
    ]
    for views in (*of_maps, "own.training", "fused.training", "own_unrefined.held_out"):
        yield from (f"rendering.{views}.{key}" for key in _VIEWS.split())
    for views in ("held_out", "peers"):
        yield from (f"robots.alpha.rendering.own.{views}.{key}" for key in _VIEWS.split())
    for map_ in ("own", "refined"):
        for views in ("held_out", "peers"):
            yield from (f"pixel_calibration.{map_}.{views}.{key}" for key in _PIXELS.split())


KNOWN = tuple(_known())
"""Every name, as in `results.parquet`; `robots.*` is the mean over the robots, alpha the first one."""

_OF_SURFACE = ("calibration.*", "consensus.matching_*")
_OF_TRUTH = (*_OF_SURFACE, "*.ate_*", "*.rpe_*", "*_of_truth", "*.frames_with_truth", "*.depth_l1_exact_m")


def check_metric(name: str, where: str) -> None:
    """Refuse a metric that no run has.

    Args:
        name: of the metric.
        where: the file and the place in it that name the metric.

    Raises:
        DuagError: it is unknown.
    """
    if name not in KNOWN:
        raise DuagError(f"{where}: metric {name} is unknown, {closest(name, KNOWN, 'a metric')}")


def needs_truth(name: str) -> bool:
    """Whether a metric is absent for recordings without ground truth.

    Args:
        name: of the metric.
    """
    return any(fnmatchcase(name, pattern) for pattern in _OF_TRUTH)


def needs_surface(name: str) -> bool:
    """Whether a metric is absent for recordings without the true surface of the scene.

    Args:
        name: of the metric.
    """
    return any(fnmatchcase(name, pattern) for pattern in _OF_SURFACE)


def names_in(name: str, numbers: Mapping[str, object]) -> list[str]:
    """The names that a metric stands for in the numbers of a run: the largest component of a robot is the robot.

    Args:
        name: of the metric, perhaps with `robots.*`.
        numbers: of the run.
    """
    if "*" not in name:
        return [name] if name in numbers else []
    head, tail = name.split("*")
    stands_for = {
        found: found[len(head) : -len(tail)]
        for found in numbers
        if found.startswith(head) and found.endswith(tail)
    }
    return [found for found, robot in stands_for.items() if "." not in robot and submap_of(robot) is None]
