"""The report of a run: gathers figures, pictures and numbers, and fills the page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from duagc.pipeline.base.component_names import robot_of, submap_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import new_file
from duagc.pipeline.base.templates import filled
from duagc.pipeline.evaluation.cameras import CHANNELS
from duagc.pipeline.evaluation.network import Session
from duagc.pipeline.evaluation.paths import Path3, paths, top_view_axes
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.recording import Recording, open_rgbd
from duagc.pipeline.report import figures, labels, pictures
from duagc.pipeline.report.advice import advice
from duagc.pipeline.report.cards import cards
from duagc.pipeline.report.coverage import coverage_content
from duagc.pipeline.report.renders import rendered_views
from duagc.pipeline.runs.folder import RunFolder

TEMPLATE = "page.html.j2"
EXPOSURE_NOTE = (
    "A view is drawn in the exposure that the robot found of the mapped frames before and after it, if it found any. "
    "Nothing is fitted to a view, but where a column says so: there each half of a view is compared in the exposure "
    "(gain and offset of each channel) that was fitted on its other half."
)

SECTIONS = (
    ("paths", "Paths"),
    ("coverage", "Coverage"),
    ("views", "Rendered views"),
    ("agreement", "Agreement"),
    ("exchange", "Exchange"),
    ("uncertainty", "Uncertainty"),
    ("time", "Time"),
    ("absent", "Absent values"),
    ("protocol", "Protocol and configuration"),
)


def write_report(run_dir: Path, recording: Path, *, workers: int = 1) -> Path:
    """Write report/index.html of an evaluated run: one file that needs no network.

    Args:
        run_dir: folder of the run, with metrics.json.
        recording: folder of its recording.
        workers: robots drawn at the same time, in processes of their own if more than one; changes no bit.
    Returns:
        The path of the page.
    Raises:
        DuagError: the run was not evaluated, or run and recording do not fit together.
    """
    run, source = RunFolder(run_dir), Recording(recording)
    if not run.metrics:
        raise DuagError(
            f"{run_dir / 'metrics.json'}: not found, expected an evaluated run; `duagc evaluate` writes it"
        )
    html = filled("duagc.pipeline.report", TEMPLATE, **content(run, source, workers))
    path = run_dir / "report" / "index.html"
    path.parent.mkdir(exist_ok=True)
    with new_file(path) as part:
        part.write_text(html, encoding="utf-8")
    return path


def content(run: RunFolder, source: Recording, workers: int) -> dict[str, Any]:
    """Everything that the template shows, by name.

    Args:
        run: evaluated, with metrics.json.
        source: its recording.
        workers: robots drawn at the same time; changes no bit.
    """
    metrics = run.metrics
    reasons = metrics["reasons"]
    session = Session(run)
    shown_views, deviation_views = rendered_views(run, source, workers)
    return {
        "title": f"{source.name}: {_count(len({robot_of(name) for name in run.robots}), 'robot')}",
        "subtitle": _subtitle(metrics),
        "sections": SECTIONS,
        "cards": cards(metrics, reasons),
        **_paths_content(run, source, session),
        **coverage_content(run, metrics),
        "comparison_sets": [labels.VIEW_SETS[s] for s in labels.compared_sets(metrics)],
        "comparison_columns": list(labels.comparison_columns(metrics).values()),
        "comparison": labels.comparison_rows(metrics),
        **_rendering_content(metrics),
        "own_longer": labels.is_scored(metrics, "own_longer"),
        "exposure_note": " ".join(
            [EXPOSURE_NOTE, *_cameras(metrics), *_masks(source), *_calibration(run, source)]
        ),
        "views": shown_views,
        **_agreement_content(session, metrics, reasons),
        "exchange_charts": _exchange_charts(session),
        "exchange": labels.rows(metrics["exchange"], labels.EXCHANGE, reasons, "exchange"),
        "deviation_views": deviation_views,
        "reliability_chart": _reliability_chart(run),
        "calibration": labels.rows(metrics["calibration"], labels.CALIBRATION, reasons, "calibration"),
        "pixel_calibration": labels.pixel_rows(metrics),
        **_timing_content(run),
        "absent": _absent(reasons),
        "protocol": list(metrics["protocol"].items()),
        "config": run.config_text or "The run has no config.toml.",
        "recording": json.dumps(source.description, indent=2),
    }


def _cameras(metrics: dict[str, Any]) -> list[str]:
    """How the robots' cameras differ, a sentence for each that was compared with the first of its component."""
    said = []
    for name, robot in metrics["robots"].items():
        camera = robot.get("camera", {})  # runs of earlier versions have none
        if camera.get("gain_red") is not None:
            gains = ", ".join(
                f"{camera[f'gain_{channel}']:.3f} ± {camera[f'sigma_gain_{channel}']:.3f}"
                for channel in CHANNELS
            )
            said.append(
                f"By the robots' own estimate {name}'s camera has {gains} times the red, green and blue of the first "
                "robot's; peers' views are compared in the colors of the camera that took them."
            )
    return said


def _masks(source: Recording) -> list[str]:
    """How much of the images never shows the scene, a sentence if that is so of any robot."""
    shares = []
    for name in source.robots:
        with open_rgbd(source.log(name)) as log:
            if log.valid is not None:
                shares.append(f"{np.mean(~log.valid):.1%} of {name}'s")
    if not shares:
        return []
    return [
        "Pixels that never show the scene count nowhere and are drawn as a checkerboard: "
        f"{', '.join(shares)}."
    ]


def _calibration(run: RunFolder, source: Recording) -> list[str]:
    """What a calibration changed in the recording, or why nothing, a sentence where one was asked for."""
    said = source.calibration or run.calibration
    return [f"Calibration from the recording's own images: {'; '.join(said)}."] if said else []


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _subtitle(metrics: dict[str, Any]) -> str:
    team = metrics["team"]
    robots = {name: row for name, row in metrics["robots"].items() if submap_of(name) is None}
    frames = sum(robot["frames"] for robot in robots.values())  # every component has all frames of its log
    agree = team["robots_in_largest_component"]
    shared = (
        "no two robots share a world" if agree < 2 else f"{agree} of {team['robots']} robots share one world"
    )
    count = labels.text("frames", frames)
    return f"{count} frames of {', '.join(robots)} · {shared} · relative poses {_known(metrics)}"


def _known(metrics: dict[str, Any]) -> str:
    return f"{metrics['protocol']['initial_relative_poses']} at the start"


# --- paths -------------------------------------------------------------------------------------------------------


def _paths_content(run: RunFolder, source: Recording, session: Session) -> dict[str, Any]:
    ways = paths(run, source)
    shown = [way for way in ways if way.component == run.robots[run.largest_component[0]].component]
    others = [way.robot for way in ways if way not in shown]
    lead = "Seen from above, in the world that the robots agreed on."
    if others:
        lead += f" Not in that world, so not shown: {', '.join(others)}."
    if any(isinstance(way.true, Absent) for way in shown):
        lead += (
            " The recording has no ground truth of the paths."
            if all(isinstance(way.true, Absent) for way in shown)
            else " Ground truth is missing for some robots."
        )
    lead = " ".join([lead, *advice(run, source, session)])
    columns = labels.without_empty(labels.ROBOT, list(run.metrics["robots"].values()))
    return {
        "paths_lead": lead,
        "paths_chart": pictures.svg_uri(_top_view(shown, list(run.robots))),
        "robot_columns": list(columns.values()),
        "robots": [
            {
                "robot": name,
                "color": figures.color_of(i),
                "values": [
                    labels.text(column, run.metrics["robots"][name].get(column)) for column in columns
                ],
            }
            for i, name in enumerate(run.robots)
        ],
    }


def _top_view(ways: Sequence[Path3], names: Sequence[str]) -> str:
    axes = top_view_axes(np.concatenate([way.after.poses for way in ways]))
    return figures.top_view(
        [
            {
                "robot": way.robot,
                "index": names.index(way.robot),
                "before": way.before.positions @ axes.T,
                "after": way.after.positions @ axes.T,
                "true": None if isinstance(way.true, Absent) else way.true.positions @ axes.T,
            }
            for way in ways
        ]
    )


# --- views -------------------------------------------------------------------------------------------------------


def _rendering_content(metrics: dict[str, Any]) -> dict[str, Any]:
    """All scores of the maps that exist at the sets of views that have views, without columns of dashes."""
    found = [
        (word, labels.VIEW_SETS[view_set], metrics["rendering"][kind][view_set])
        for kind, word in labels.MAPS.items()
        for view_set in labels.VIEW_SETS
        if metrics["rendering"].get(kind, {}).get(view_set, {}).get("views")
    ]
    columns = labels.without_empty(labels.RENDERING, [scores for _, _, scores in found])
    return {
        "rendering_columns": list(columns.values()),
        "rendering": [
            {
                "map": word,
                "view_set": view_set,
                "values": [labels.text(name, scores[name]) for name in columns],
            }
            for word, view_set, scores in found
        ],
    }


# --- agreement and exchange --------------------------------------------------------------------------------------


def _agreement_content(
    session: Session, metrics: dict[str, Any], reasons: dict[str, list[str]]
) -> dict[str, Any]:
    series = session.series_by_round()
    candidates = labels.loop_closures(session.loop_closures)
    tolerance = session.run.config.exchange.consensus.tolerance
    charts = [
        {
            "title": title,
            "uri": pictures.svg_uri(
                figures.lines(
                    series[name], "round", "m or rad", log=True, level=level, robots=list(session.run.robots)
                )
            ),
        }
        for title, name, level in (
            ("Largest change of a pose in a round", "change", tolerance),
            ("Largest disagreement between neighbors (primal residual)", "primal", None),
        )
        if series[name]
    ]
    if metrics["team"]["robots_in_largest_component"] < 2:
        lead = "No two robots share a world, so there was nothing to agree on."
    elif metrics["consensus"]["converged"]:
        lead = (
            "The robots adjusted the poses of their keyframes until no pose moved by more than the tolerance."
        )
    else:
        lead = "The session ended before all robots had agreed: the results are those of its last round."
    return {
        "agreement_lead": lead,
        "agreement_charts": charts,
        "consensus": labels.rows(metrics["consensus"], labels.CONSENSUS, reasons, "consensus"),
        "loop_closure_columns": list(labels.LOOP_CLOSURE.values()),
        "loop_closures": [
            [labels.text(name, row[name]) for name in labels.LOOP_CLOSURE] for row in candidates
        ],
        "verdicts": [(count, verdict) for verdict, count in labels.verdict_counts(candidates).items()],
    }


def _exchange_charts(session: Session) -> list[dict[str, str]]:
    """Bytes per round by purpose, and packets delivered and lost per link."""
    spent, links = session.series_by_round()["bytes"], session.links
    if not links:
        return []
    ticks = next(iter(spent.values()))[0]
    kilobytes = {purpose: values / 1e3 for purpose, (_, values) in spent.items()}
    names = [f"{link.sender} to {link.receiver}" for link in links]
    parts = {"delivered": [k.packets - k.dropped for k in links], "lost": [k.dropped for k in links]}
    return [
        {
            "title": "Bytes per round",
            "uri": pictures.svg_uri(figures.stacked(ticks, kilobytes, "round", "kB")),
        },
        {"title": "Packets per link", "uri": pictures.svg_uri(figures.bars(names, parts, "packets"))},
    ]


# --- uncertainty -------------------------------------------------------------------------------------------------


def _reliability_chart(run: RunFolder) -> str:
    """Predicted against observed error per decile and robot, from metrics.parquet; empty if there is none."""
    path = run.path / "metrics.parquet"
    if not path.is_file():
        return ""
    import pyarrow.parquet as pq

    try:
        rows = pq.read_table(path, filters=[("scope", "==", "reliability")]).to_pylist()
    except (ValueError, OSError) as error:  # pyarrow's errors are kinds of these
        raise DuagError(f"{path}: is no Parquet file that can be read, expected that of the run") from error
    bins: dict[str, dict[str, dict[str, float]]] = {}
    for row in rows:
        bins.setdefault(row["robot"], {}).setdefault(row["view_set"], {})[row["name"]] = row["value"]
    if not bins:
        return ""
    curves = {
        robot: [(decile["predicted_rms_m"], decile["observed_rms_m"]) for decile in deciles.values()]
        for robot, deciles in bins.items()
    }
    return pictures.svg_uri(figures.reliability(curves, list(run.robots)))


# --- time and the rest -------------------------------------------------------------------------------------------


def _timing_content(run: RunFolder) -> dict[str, Any]:
    stages = run.timing
    rows = [
        {
            "stage": entry.get("stage", key),
            "robot": entry.get("robot") or "all",
            "wall": f"{entry['wall_s']:.1f} s",
            "cpu": f"{entry['cpu_s']:.1f} s",
            "memory": f"{entry['peak_rss_mb']:.0f} MB",
        }
        for key, entry in stages.items()
    ]
    names = [f"{row['stage']}, {row['robot']}" if row["robot"] != "all" else row["stage"] for row in rows]
    chart = figures.bars(names, {"wall": [entry["wall_s"] for entry in stages.values()]}, "seconds")
    return {"timing": rows, "timing_chart": pictures.svg_uri(chart)}


def _absent(reasons: dict[str, list[str]]) -> list[tuple[str, str]]:
    """(reason, the values that it explains)."""
    return [(reason, ", ".join(names)) for reason, names in reasons.items()]
