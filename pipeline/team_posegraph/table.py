"""The result of `duagc posegraph` for people."""

from __future__ import annotations

from typing import Any


def format_result(result: dict[str, Any]) -> str:
    """Some lines of text.

    Args:
        result: of `solve`.
    """
    r = result
    robust = "robust weights" if r["robust"] == "gnc" else "every factor counts"
    lines = [
        f"{r['path']}: {r['robots']} robots, {r['keyframes']} keyframes, {r['factors']} factors, "
        f"{r['closures']} of them between robots",
        f"{r['solver']}, {robust}, {100 * r['loss']:g} % of the packets lost",
        "",
    ]
    several = len(r["components"]) > 1
    for component in r["components"]:
        if several:
            lines.append(f"component of {', '.join(component['robots'])}")
        lines += _component(component)
    state = (
        "all agents have converged" if r["converged"] else "NOT converged: some agents still moved at the end"
    )
    lines += [
        f"{'sent in all':<28}{_bytes(r['bytes'])}  ({r['packets']} packets, {r['packets_lost']} lost)",
        f"{'set-up':<28}{_bytes(r['bytes_setup'])}  in {r['rounds_setup']} rounds",
        f"{'raw graphs to all others':<28}{_bytes(r['bytes_raw_alternative'])}  for comparison",
        f"{'time':<28}{r['seconds']:.1f} s, {r['robot_ms_per_round']:.2f} ms per robot and round",
        f"{state}",
    ]
    if r["ignored_files"]:
        lines.append(f"not read: {', '.join(r['ignored_files'])} (plain keys, no robot named)")
    return "\n".join(lines)


def _component(c: dict[str, Any]) -> list[str]:
    lines = [
        f"{'cost':<28}{c['cost']:.8g}",
        f"{'centralized optimum':<28}{c['optimum']:.8g}  "
        f"({_state(c)}gap {_gap(c['gap'])}, {c['distance_rms_m']:.2g} m rms)",
        f"{'rounds':<28}{c['rounds']}"
        + (f"  in {c['exchanges']} exchanges" if c["exchanges"] is not None else ""),
    ]
    for gap, rounds in c["rounds_to"].items():
        reached = (
            "not reached" if rounds is None else f"{rounds} rounds, {_bytes(c['bytes_to'][gap])} with set-up"
        )
        lines.append(f"{'to a gap of ' + gap:<28}{reached}")
    if c["inlier_cost"] != c["cost"]:
        lines.append(f"{'cost of what was kept':<28}{c['inlier_cost']:.8g}  ({c['kept']} loops and closures)")
    if c["reference"] is not None:
        ref = c["reference"]
        lines.append(
            f"{'against the reference':<28}{_share(ref)}; between robots {_share(ref['between_robots'])}"
        )
        if "cost_of_reference" in ref:
            lines.append(f"{'cost of the reference':<28}{ref['cost_of_reference']:.8g}")
            certified = "certified" if ref["certified"] else "not certified"
            lines.append(
                f"{'optimum of its inliers':<28}{ref['optimum']:.8g}  "
                f"({_state(ref)}{certified}; gap {_gap(ref['gap'])})"
            )
    return [*lines, ""]


def _state(result: dict[str, Any]) -> str:
    return "" if result["optimum_converged"] else "not converged; "


def _share(ref: dict[str, Any]) -> str:
    if ref["precision"] is None or ref["recall"] is None:
        return "nothing to compare"
    return f"precision {ref['precision']:.3f}, recall {ref['recall']:.3f} ({ref['kept']} kept, {ref['true']} true)"


def _gap(gap: float | None) -> str:
    return "undefined" if gap is None else f"{gap:.1e}"


def _bytes(count: int) -> str:
    return f"{count / 1e3:,.1f} kB" if count < 1e6 else f"{count / 1e6:,.2f} MB"
