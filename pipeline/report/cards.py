"""The cards of a report: the few numbers to look at first."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from duagc.pipeline.base.component_names import robot_of
from duagc.pipeline.evaluation.results import reason_of
from duagc.pipeline.report import labels

TEAM_ONLY = ("team.ate_rmse_m", "rendering.fused.peers.psnr_db", "rendering.refined.peers.psnr_db")
"""Values that a run of one robot cannot have: it shows no card for them."""


def cards(metrics: dict[str, Any], reasons: dict[str, list[str]]) -> list[dict[str, str]]:
    """What the template shows of each card.

    Args:
        metrics: of the run.
        reasons: why values are absent, each with the names of these.
    """
    own = metrics["rendering"]["own"]
    final = "fused" if metrics["rendering"]["refined"]["held_out"]["psnr_db"] is None else "refined"

    def meaning(view_set: str, name: str, what: str) -> str:
        return f"{final} maps, {what}; own maps: {labels.text(name, own[view_set][name])}"

    held_out, peers = f"rendering.{final}.held_out", f"rendering.{final}.peers"
    chosen = (
        ("team.ate_rmse_m", *labels.TEAM["ate_rmse_m"]),
        ("team.ate_rmse_m_mean_of_robots", *labels.TEAM["ate_rmse_m_mean_of_robots"]),
        (f"{held_out}.psnr_db", "PSNR", meaning("held_out", "psnr_db", "views never mapped")),
        *_other_psnrs(held_out, metrics["rendering"][final]["held_out"], meaning),
        (f"{peers}.psnr_db", "PSNR, peers' views", meaning("peers", "psnr_db", "where the others stood")),
        (
            f"{held_out}.depth_l1_common_m",
            "Depth L1",
            meaning("held_out", "depth_l1_common_m", "views never mapped, pixels that all maps cover"),
        ),
        ("team.inter_robot_loop_closures", *labels.TEAM["inter_robot_loop_closures"]),
        ("exchange.bytes_sent", *labels.EXCHANGE["bytes_sent"]),
        ("exchange.rounds", *labels.EXCHANGE["rounds"]),
    )
    alone = len({robot_of(name) for name in metrics["robots"]}) < 2
    shown = []
    for path, label, what in chosen:
        value: Any = metrics
        for part in path.split("."):
            value = value[part]
        if value is None and alone and path in TEAM_ONLY:
            continue
        name = path.rsplit(".", 1)[1]
        shown.append(
            {
                "label": label,
                "value": labels.text(name, value),
                "meaning": what,
                "reason": reason_of(reasons, path) if value is None else "",
            }
        )
    return shown


def _other_psnrs(
    path: str, scores: Mapping[str, Any], meaning: Callable[[str, str, str], str]
) -> list[tuple[str, str, str]]:
    """Cards of PSNR in the exposure of the view and as its camera moved, where frames are not alike in that."""
    others = (
        ("psnr_interpolated_db", "psnr_db", "PSNR, in exposure", "in the exposure of the view"),
        ("psnr_moved_db", "psnr_interpolated_db", "PSNR, as moved", "drawn as the camera moved"),
    )
    return [
        (f"{path}.{name}", label, meaning("held_out", name, what))
        for name, plain, label, what in others
        if name in scores and scores[name] != scores[plain]
    ]
