"""Results of `duagc bench frontend` as text."""

from __future__ import annotations

from typing import Any

from duagc.pipeline.bench.frontend import WITHOUT_MAP
from duagc.pipeline.bench.tables import markdown
from duagc.pipeline.evaluation import map_agreement


def format_tables(result: dict[str, Any]) -> str:
    """The rows as Markdown tables: tracking, mapping by cap, parts.

    Args:
        result: of `frontend.run`.
    """
    machine, rows = result["machine"], result["rows"]
    about = [
        result["recording"],
        machine["cpu"],
        f"{machine['cores']} cores",
        f"{machine['threads']} threads",
    ]
    about += [f"load {machine['load_average']:.1f}", "processor time"]
    head = ["robot", "", "frames", "lost", "keyframes", "ATE mm", "RPE mm", "RPE mrad"]
    head += ["ms/frame", "p95", "first, last quarter", "steps", "model ms", "poses s", "peak MB"]
    lines = [", ".join(about), "", "Tracking"]
    lines += markdown(head, [_tracking_cells(row) for row in rows])
    head = ["robot", "", "depth mm", "of ground truth", "features px", "of ground truth"]
    judged = [_agreement_cells(row) for row in rows if "depth_agreement_m" in row]
    lines += ["", "Agreement of held-out views", *markdown(head, judged)]
    mapped = [row for row in rows if row["name"] == "map"]
    if mapped:
        head = [
            "robot",
            "cap",
            "Gaussians",
            "PSNR dB",
            "before refinement",
            "depth L1 mm",
            "exact mm",
            "layer mm",
        ]
        head += ["ms/keyframe", "p95", "first, last quarter", "k drawn", "refinement s", "all s", "peak MB"]
        lines += [
            "",
            "Mapping; scores of held-out views",
            *markdown(head, [_map_cells(row) for row in mapped]),
        ]
    parts = [
        [row["robot"], row.get("max_gaussians", row["name"]), whole, _parts_text(row["times"][whole])]
        for row in rows
        for whole in ("frame", "keyframe")
        if whole in row["times"] and row["name"] in ("map", WITHOUT_MAP)
    ]
    lines += ["", "Parts, ms", *markdown(["robot", "cap", "of a", "parts"], parts)]
    return "\n".join(lines)


def _tracking_cells(row: dict[str, Any]) -> list[Any]:
    frame = row["times"]["frame"]
    return [
        *(
            row["robot"],
            f"all, map of {row['max_gaussians']}" if row["name"] == "map" else row["name"],
            row["frames"],
            row.get("lost", row.get("failed")),
            row.get("keyframes", "-"),
        ),
        *(
            _number(row["ate_rmse_m"], 1e3, 3),
            _number(row["rpe_trans_m"], 1e3, 3),
            _number(row["rpe_rot_rad"], 1e3, 3),
        ),
        *(f"{frame['cpu_ms']:.1f}", f"{frame['cpu_ms_p95']:.1f}", _quarters(frame)),
        *(_work(frame, "steps", 1.0), _model(row["times"].get("model"))),
        *(_number(row["times"].get("pose_optimization_cpu_s"), 1, 1), f"{row['peak_memory_mb']:.0f}"),
    ]


def _agreement_cells(row: dict[str, Any]) -> list[Any]:
    return [
        *(row["robot"], row["name"]),
        *(_number(row[f"depth_agreement_m{of}"], 1e3, 2) for of in ("", map_agreement.OF_TRUTH)),
        *(_number(row[f"feature_agreement_px{of}"], 1, 2) for of in ("", map_agreement.OF_TRUTH)),
    ]


def _map_cells(row: dict[str, Any]) -> list[Any]:
    keyframe, refined, unrefined = row["times"]["keyframe"], row["refined"], row["unrefined"] or {}
    return [
        *(row["robot"], row["max_gaussians"], row["gaussians"], _number(refined["psnr_db"], 1, 2)),
        _number(unrefined.get("psnr_db"), 1, 2),
        *(_number(refined["depth_l1_m"], 1e3, 2), _number(refined["depth_l1_exact_m"], 1e3, 2)),
        _number(refined["depth_l1_layer_m"], 1e3, 2),
        *(f"{keyframe['cpu_ms']:.0f}", f"{keyframe['cpu_ms_p95']:.0f}", _quarters(keyframe)),
        _work(keyframe, "gaussians_drawn", 1e-3),
        *(
            f"{row['times']['final_refinement_cpu_s']:.1f}",
            f"{row['cpu_s']:.1f}",
            f"{row['peak_memory_mb']:.0f}",
        ),
    ]


def _quarters(times: dict[str, float]) -> str:
    return f"{times['cpu_ms_first_quarter']:.1f}, {times['cpu_ms_last_quarter']:.1f}"


def _work(times: dict[str, float], name: str, scale: float) -> str:
    if name not in times:
        return "-"
    return f"{scale * times[f'{name}_first_quarter']:.1f}, {scale * times[f'{name}_last_quarter']:.1f}"


def _model(times: dict[str, float] | None) -> str:
    return "-" if times is None else f"{times['calls']} x {times['cpu_ms']:.1f}"


def _parts_text(times: dict[str, Any]) -> str:
    return ", ".join(f"{label} {value:.1f}" for label, value in times["parts_cpu_ms"].items())


def _number(value: float | None, scale: float, digits: int) -> str:
    return "-" if value is None else f"{scale * value:.{digits}f}"
