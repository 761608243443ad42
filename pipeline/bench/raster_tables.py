"""Results of `duagc bench raster` as text."""

from __future__ import annotations

from typing import Any

from duagc.pipeline.bench.raster_work import FLOPS, TITLES
from duagc.pipeline.bench.tables import markdown

WHO = ["size", "Gaussians", "threads", "isa"]


def format_tables(result: dict[str, Any]) -> str:
    """The result of `run` as Markdown.

    Args:
        result: of `raster.run`.
    """
    rows: list[dict[str, Any]] = result["rows"]
    first_of_scene = {(row["width"], row["height"], row["gaussians"]): row for row in reversed(rows)}
    counted = [TITLES[name] for name in FLOPS]
    with_torch = [row for row in rows if row["torch_forward_ms"] is not None]
    parts = [
        _machine_lines(result["machine"]),
        "Milliseconds; one thread: CPU time, median; more: wall time, lower quartile.",
        _text([*WHO, *TITLES.values()], [[*_who(row), *_cells(row, "{}_ms", 1)] for row in rows]),
        "Work of one view; pairs of pixel and Gaussian whose alpha is evaluated, and that are drawn.",
        _text(
            ["size", "Gaussians", "visible", "tile entries", "evaluated, M", "drawn, M", "scratch, MB"],
            [
                [
                    *_who(row)[:2],
                    str(row["visible"]),
                    str(row["intersections"]),
                    f"{1e-6 * row['evaluated_pairs']:.1f}",
                    f"{1e-6 * row['contributing_pairs']:.1f}",
                    f"{row['scratch_mb']:.0f}",
                ]
                for row in reversed(first_of_scene.values())
            ],
        ),
        "Drawn pairs per second, in 10^9.",
        _text([*WHO, *counted], [[*_who(row), *_cells(row, "{}_pairs_per_s", 2, 1e-9)] for row in rows]),
        "Percent of the peak rate of multiply-adds / of the bandwidth; flops and bytes are counted by hand.",
        _text(
            [*WHO, *counted],
            [
                [
                    *_who(row),
                    *(
                        f"{a} / {b}"
                        for a, b in zip(
                            _cells(row, "{}_fraction_of_peak", 0, 100),
                            _cells(row, "{}_fraction_of_bandwidth", 0, 100),
                            strict=True,
                        )
                    ),
                ]
                for row in rows
            ],
        ),
    ]
    if with_torch:
        parts += [
            "Plain torch, milliseconds, and how many times as long it takes.",
            _text(
                [*WHO, "torch forward", "torch backward", "forward, times", "backward, times"],
                [
                    [
                        *_who(row),
                        f"{row['torch_forward_ms']:.0f}",
                        f"{row['torch_backward_ms']:.0f}",
                        f"{row['torch_forward_ms'] / row['forward_ms']:.0f}",
                        f"{row['torch_backward_ms'] / row['backward_ms']:.0f}",
                    ]
                    for row in with_torch
                ],
            ),
        ]
    return "\n\n".join(parts)


def _machine_lines(machine: dict[str, Any]) -> str:
    lines = [f"{machine['cpu']}, {machine['cores']} cores, load average {machine['load_average']:.1f} before"]
    for isa, rates in machine["fma_gflops"].items():
        lines.append(
            f"{isa}: " + ", ".join(f"{rate:.0f} GFLOP/s with {n}" for n, rate in rates.items()) + " threads"
        )
    for n, read in machine["read_gb_per_s"].items():
        lines.append(
            f"memory, {n} threads: read {read:.0f} GB/s, copy {machine['copy_gb_per_s'][n]:.0f} GB/s"
        )
    return "\n".join(f"- {line}" for line in lines)


def _who(row: dict[str, Any]) -> list[str]:
    return [f"{row['width']}x{row['height']}", str(row["gaussians"]), str(row["threads"]), row["isa"]]


def _cells(row: dict[str, Any], key: str, digits: int, factor: float = 1.0) -> list[str]:
    return [f"{factor * row[key.format(name)]:.{digits}f}" for name in TITLES if key.format(name) in row]


def _text(titles: list[str], rows: list[list[str]]) -> str:
    return "\n".join(markdown(titles, rows))
