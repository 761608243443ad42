"""Numbers in words: how a value is written with its unit, and what every metric means in one phrase."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from duagc.pipeline.base.byte_counts import bytes_text
from duagc.pipeline.evaluation.rendering import CENTRAL, COMPARED, COMPARED_SETS
from duagc.pipeline.evaluation.results import reason_of, unit_of

NONE = "–"


def meters_text(value_m: float) -> str:
    """Meters, or millimeters below a tenth of a meter.

    Args:
        value_m: meters.
    """
    if abs(value_m) < 0.1:
        millimeters = 1e3 * abs(value_m)
        if 0.0 < millimeters < 1e-3:
            return "< 0.001 mm"
        return f"{1e3 * value_m:.1f} mm" if millimeters >= 1.0 else f"{1e3 * value_m:.3g} mm"
    return f"{value_m:.3f} m"


def text(name: str, value: Any) -> str:
    """A metric's value with its unit, as the report prints it; a dash for a value that is absent.

    Args:
        name: of the metric, as in metrics.json; says its unit.
        value: number, text, truth value or None.
    """
    if value is None:
        return NONE
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value
    unit = unit_of(name)
    if unit == "m":
        return meters_text(value)
    if unit == "rad":
        return f"{np.degrees(value):.3g}°"
    if unit == "B":
        return bytes_text(value)
    if name in ("depth_completeness", "rejected_matches_share") or name.startswith("coverage_95"):
        return f"{100 * value:.1f} %"
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f")
    if unit == "dB":
        return f"{value:.2f} dB"
    number = f"{value:.3f}" if 1e-3 <= abs(value) < 1e3 else f"{value:.3g}"
    return number if unit == "1" else f"{number} {unit.replace('sigma', 'σ')}"


# path in metrics.json -> (label, what it means in one phrase)
TEAM = {
    "ate_rmse_m": ("Team ATE", "position error of all robots of the largest component under one common alignment"),
    "ate_rmse_m_mean_of_robots": ("Mean robot ATE", "each robot aligned by itself: blind to errors between robots"),
    "robots": ("Robots", "robots in this run"),
    "robots_in_largest_component": ("Largest component", "robots that agree on one common world"),
    "inter_robot_loop_closures": ("Inter-robot loop closures", "places that two robots recognized; inliers in the end"),
    "inter_robot_loop_closures_rejected": ("Loop closures rejected", "measured, then refused by geometry or outliers"),
}  # fmt: skip

ROBOT = {
    "frames": ("Frames", "images in the robot's log"),
    "tracked": ("Tracked", "frames whose pose the front end trusts"),
    "keyframes": ("Keyframes", "frames that carry the map"),
    "gaussians": ("Own Gaussians", "Gaussians in the robot's own map"),
    "gaussians_fused": ("Fused Gaussians", "Gaussians in the robot's map after fusion"),
    "stated_scale": ("Factor on σ", "on stated deviations of positions, by peers' Gaussians and own depth images"),
    "ate_rmse_m_before_consensus": ("ATE before", "position error of the front end alone, own alignment, all frames"),
    "ate_rmse_m": ("ATE after", "position error after consensus, own alignment, all frames"),
    "ate_rmse_m_joint": ("ATE, joint", "position error after consensus under the alignment that the whole team shares"),
    "feature_agreement_px": ("Features", "matched features of held-out views apart, median; no ground truth enters"),
    "feature_agreement_px_of_truth": ("Features, truth", "the same under the poses of the ground truth"),
    "rpe_trans_m": ("RPE, position", "error of the motion from one frame to the next"),
    "rpe_rot_rad": ("RPE, rotation", "error of the turn from one frame to the next"),
}  # fmt: skip

MAPS = {
    "own": "own",
    "own_unrefined": "own, before its final refinement",
    "own_longer": "own, trained longer",
    "fused": "fused",
    "refined": "refined (final)",
    "central": "of all robots' images",
}  # fmt: skip

VIEW_SETS = {
    "held_out": "own held-out views",
    "peers": "peers' held-out views",
    "team": "the team's held-out views",
    "training": "own keyframes",
}  # fmt: skip

COMPARISON = {
    "psnr_db": ("PSNR", "likeness of colors; what a map does not cover is black and counts"),
    "depth_l1_common_m": ("Depth L1", "mean depth error over pixels that own, fused and refined map cover"),
    "depth_l1_layer_m": ("one layer", "the same over what the map itself covers, drawn as one surface"),
    "depth_completeness": ("Covered", "share of recorded depth pixels that the map covers"),
}  # fmt: skip

RENDERING = {
    "views": ("Views", "rendered and compared with the image taken there"),
    "psnr_db": ("PSNR", "likeness of colors; higher is better"),
    "psnr_interpolated_db": ("PSNR, interpolated", "the same in the exposure interpolated from mapped frames"),
    "psnr_moved_db": ("PSNR, as moved", "the same, drawn as the camera moved while its shutter was open"),
    "psnr_exposure_db": ("PSNR, exposure", "the same, each half of a view in the exposure fitted on the other half"),
    "psnr_exposure_left_db": ("left half", "of that, the left halves, in the exposure fitted on the right ones"),
    "psnr_exposure_right_db": ("right half", "of that, the right halves, in the exposure fitted on the left ones"),
    "ssim": ("SSIM", "likeness of structure at one scale; 1 is equal"),
    "ms_ssim": ("MS-SSIM", "likeness of structure over five scales; 1 is equal, always kinder than SSIM"),
    "lpips": ("LPIPS", "perceptual distance by a trained network"),
    "depth_l1_m": ("Depth L1", "mean error against the recorded depth, where both exist"),
    "depth_l1_exact_m": ("Depth L1, exact", "the same against the exact depth"),
    "depth_l1_layer_m": ("Depth L1, one layer", "the same, drawn as the surface that stops a pixel's light"),
    "depth_l1_common_m": ("Depth L1, common", "over pixels that all maps but the unrefined cover"),
    "depth_completeness": ("Completeness", "share of recorded depth pixels that the map covers"),
}  # fmt: skip

EXCHANGE = {
    "sessions": ("Sessions", "meetings of the team"),
    "rounds": ("Rounds", "rounds until the session ended"),
    "messages": ("Messages", "what the robots had to say, before cutting into packets"),
    "packets_sent": ("Packets sent", "of at most 1200 bytes, all attempts"),
    "packets_dropped": ("Packets lost", "by the simulated radio"),
    "bytes_sent": ("Bytes sent", "all attempts, headers included"),
    "bytes_delivered": ("Bytes delivered", "what arrived, headers included"),
    "bytes_setup": ("Set-up bytes", "all but states of rounds, evidence and acknowledgements"),
    "bytes_per_round_per_robot_pair": ("Bytes per round and pair", "both directions, mean over the session"),
    "bytes_raw_alternative": ("Raw alternative", "maps with information and pose graphs to every other robot, once"),
    "bytes_raw_alternative_maps_only": ("Raw maps", "the same without the information: to look at, not to fuse"),
    "bytes_paper_accounting": ("Paper's accounting", "28 float32 per matched pair, both ways, in every round"),
    "matched_pairs": ("Matched Gaussians", "pairs of Gaussians of two robots that show the same piece of surface"),
}  # fmt: skip

CONSENSUS = {
    "solver": ("Solver", "how the robots reach agreement"),
    "converged": ("Converged", "every robot agreed with its component before the last allowed round"),
    "rounds_to_tolerance": ("Rounds to tolerance", "until no pose moved by more than the tolerance"),
    "gap_to_oracle_sigma": ("Gap to oracle, Gaussians", "largest difference from the centralized answer"),
    "gap_to_oracle_sigma_p99": ("Gap to oracle, 99 %", "of the matched Gaussians differ by less"),
    "gap_to_oracle_m": ("Gap to oracle, position", "largest difference of a keyframe from the centralized answer"),
    "gap_to_oracle_rad": ("Gap to oracle, rotation", "largest turn of a keyframe from the centralized answer"),
    "rejected_matches_share": ("Matches not used", "share of the matches that a robot's own map or images contradict"),
}  # fmt: skip

CALIBRATION = {
    "spearman": ("Spearman", "rank correlation of predicted and observed error; 1 is perfect, 0 knows nothing"),
    "ause": ("AUSE", "cost of trusting the predicted order of errors; 0 is perfect"),
    "ece_rank": ("ECE, ranks", "gap between predicted and observed rank per decile; 0 is perfect, 0.25 knows nothing"),
    "ece_rank_if_right": ("ECE, ranks, if right", "the same of errors drawn from the predictions"),
    "ece_rank_shuffled": ("ECE, ranks, shuffled", "the same with the predictions dealt out at random"),
    "ece_paper": ("ECE, companion code", "the paper's formula, for comparison only: near 0 without any knowledge, too"),
    "coverage_95": ("Coverage of 95 %", "share of errors within 1.96 predicted σ, as predicted"),
    "coverage_95_scaled": ("Coverage, one scale fitted", "the same after one factor, fitted on the other half"),
    "sigma_scale": ("Fitted scale", "the factor on σ; 1 if well scaled, above 1 if over-confident"),
    "nll": ("NLL", "negative log-likelihood of the errors; lower is better"),
    "nll_scaled": ("NLL, one scale fitted", "the same after the factor"),
    "gaussians": ("Gaussians judged", "fused Gaussians with full position information, all robots"),
    "gaussians_without_information": ("Left out", "Gaussians with a direction that nothing determines"),
}  # fmt: skip

PIXEL_CALIBRATION = {
    "pixels": ("Pixels", "judged, all robots"),
    "pixels_without_sigma": ("Left out", "pixels of whose Gaussians too little is stated"),
    "median_error_m": ("Error", "median absolute difference of rendered and true depth"),
    "median_sigma_m": ("σ", "median predicted standard deviation of it"),
    "coverage_95": ("Coverage of 95 %", "share of errors within 1.96 predicted σ"),
    "sigma_scale": ("Fitted scale", "the likeliest factor on σ; above 1 if over-confident"),
    "spearman": ("Spearman", "rank correlation of predicted and observed error"),
    "ece_rank": ("ECE, ranks", "gap between predicted and observed rank per decile; 0 is perfect"),
    "ece_rank_if_right": ("if right", "the same of errors drawn from the predictions"),
    "ece_rank_shuffled": ("shuffled", "the same with the predictions dealt out at random"),
}

LOOP_CLOSURE = {
    "robot": ("Robot", "the robot that decided"),
    "peer": ("Peer", "whose keyframe it was"),
    "keyframes": ("Keyframes", "of the robot and of the peer"),
    "score": ("Descriptors", "compact descriptors that match: how alike the two places look"),
    "matches": ("Matches", "between all features of the two keyframes"),
    "inliers": ("Inliers", "matches that agree on one motion between the two cameras"),
    "weight": ("Weight", "robust weight at the end: 1 inlier, 0 outlier; a dash if it took no part"),
    "verdict": ("Verdict", "what became of the candidate"),
    "detail": ("Detail", "the numbers behind the verdict"),
}  # fmt: skip


def loop_closures(decisions: Sequence[Any]) -> list[dict[str, Any]]:
    """Candidates for loop closures as rows with the names of LOOP_CLOSURE, in the order given.

    Args:
        decisions: duagc.v1.LoopClosureDecision messages.
    """
    return [
        {
            "robot": d.robot,
            "peer": d.peer,
            "keyframes": f"{d.own_keyframe} and {d.peer_keyframe}",
            "score": d.score,
            "matches": d.matches,
            "inliers": d.inliers,
            "weight": None if d.weight < 0 else d.weight,
            "verdict": d.verdict,
            "detail": d.detail,
        }
        for d in decisions
    ]


def verdict_counts(rows: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """How many candidates have each verdict, the most frequent first.

    Args:
        rows: candidates, each with "verdict".
    """
    return dict(Counter(row["verdict"] for row in rows).most_common())


def rows(
    section: Mapping[str, Any],
    words: Mapping[str, tuple[str, str]],
    reasons: Mapping[str, Sequence[str]],
    path: str,
) -> list[dict[str, str]]:
    """Label, value with unit, meaning and, if the value is absent, the reason: one row per metric that is known.

    Args:
        section: of metrics.json.
        words: label and meaning by name.
        reasons: `reasons` of metrics.json.
        path: of the section, for example "exchange".
    """
    return [
        {
            "label": label,
            "value": text(name, section[name]),
            "meaning": meaning,
            "reason": reason_of(reasons, f"{path}.{name}") if section[name] is None else "",
        }
        for name, (label, meaning) in words.items()
        if name in section
    ]


def pixel_rows(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Calibration of rendered depth: a row of "name" and "cells" for each map and set of views that has numbers.

    Args:
        metrics: content of metrics.json.
    """
    return [
        {
            "name": f"{MAPS[kind]}, {VIEW_SETS[view_set]}",
            "cells": [
                {"label": label, "meaning": meaning, "value": text(key, found[key])}
                for key, (label, meaning) in PIXEL_CALIBRATION.items()
            ],
        }
        for kind, sets in metrics.get("pixel_calibration", {}).items()  # runs of earlier versions have none
        for view_set, found in sets.items()
        if found["pixels"] is not None
    ]


def is_scored(metrics: Mapping[str, Any], kind: str) -> bool:
    """Whether a map exists in this run and was rendered at some view.

    Args:
        metrics: content of metrics.json.
        kind: name of the map in the section "rendering".
    """
    return any(found["views"] for found in metrics["rendering"].get(kind, {}).values())


def compared_sets(metrics: Mapping[str, Any]) -> list[str]:
    """Sets of views at which some map was rendered: a robot alone has no peers' views.

    Args:
        metrics: content of metrics.json.
    """
    sections = [metrics["rendering"][kind] for kind in COMPARED]
    return [s for s in COMPARED_SETS if any(section[s]["views"] for section in sections)]


def without_empty(
    columns: Mapping[str, tuple[str, str]], sections: Sequence[Mapping[str, Any]]
) -> dict[str, tuple[str, str]]:
    """The columns that have a value in at least one section: a column of dashes says nothing.

    Args:
        columns: label and meaning by name of the metric.
        sections: values by name of the metric; None: absent.
    """
    return {name: words for name, words in columns.items() if any(s.get(name) is not None for s in sections)}


def _compared(metrics: Mapping[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Of all robots together and of each: name, map, its scores by set of views."""
    kinds = [kind for kind in (*COMPARED, CENTRAL) if is_scored(metrics, kind)]
    robots = metrics["robots"]
    if len(robots) > 1:
        yield from (("all robots", kind, metrics["rendering"][kind]) for kind in kinds)
    for name, robot in robots.items():
        yield from ((name, kind, robot["rendering"][kind]) for kind in kinds)


def comparison_columns(metrics: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """The columns of COMPARISON that have a value in this run.

    Args:
        metrics: content of metrics.json.
    """
    sets = compared_sets(metrics)
    return without_empty(COMPARISON, [found[s] for _, _, found in _compared(metrics) for s in sets])


def comparison_rows(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A robot's maps side by side, for all robots and for each: own views, peers' views, both.

    Args:
        metrics: content of metrics.json.

    Returns:
        Rows of "robot", "map", "first" (of its robot) and "values": `comparison_columns` for each of `compared_sets`.
    """
    sets, columns = compared_sets(metrics), comparison_columns(metrics)
    return [
        {
            "robot": name,
            "map": MAPS[kind],
            "first": kind == COMPARED[0],
            "values": [text(column, found[view_set][column]) for view_set in sets for column in columns],
        }
        for name, kind, found in _compared(metrics)
    ]


def comparison_text(metrics: Mapping[str, Any]) -> str:
    """The same as lines of text, without units: dB, mm, mm, %; for own, peers' and team's views.

    Args:
        metrics: content of metrics.json.
    """
    scale = {"psnr_db": (1.0, 2), "depth_completeness": (100.0, 1)}
    heads = {
        "psnr_db": "PSNR, dB",
        "depth_l1_common_m": "depth L1, mm",
        "depth_l1_layer_m": "one layer, mm",
        "depth_completeness": "covered, %",
    }
    short = {"held_out": "own", "peers": "peers", "team": "team"}
    sets, columns = compared_sets(metrics), comparison_columns(metrics)
    if not sets:
        return "no map was compared: no frame was held out, and no two robots met"
    width = max(8 * len(sets), 15)
    cell = width // max(len(sets), 1)
    lines = [" " * 24 + "".join(heads[column].rjust(width) for column in columns)]
    if len(sets) > 1:
        lines.append(" " * 24 + "".join(short[s].rjust(cell) for _ in columns for s in sets))
    for name, kind, found in _compared(metrics):
        line = f"{name if kind == COMPARED[0] else '':<12}{kind:<12}"
        for column in columns:
            factor, digits = scale.get(column, (1e3, 1))
            for view_set in sets:
                value = found[view_set][column]
                line += (NONE if value is None else f"{factor * value:.{digits}f}").rjust(cell)
        lines.append(line)
    return "\n".join(lines)
