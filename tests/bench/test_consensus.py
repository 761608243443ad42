"""The bench of Gaussian consensus measures what its modes do."""

import json
import subprocess
import sys

import pytest

from duagc.pipeline.experiments.consensus_modes import MODES, ConsensusPlan, format_table, run


@pytest.fixture(scope="module")
def rows() -> dict[tuple[str, float], dict]:
    plan = ConsensusPlan((3,), ("chain",), (0.0, 0.5), (47.0,), (0.1,), MODES, tracks=20, max_rounds=1500)
    result = run(plan)
    lines = [line for line in format_table(result).splitlines() if line.startswith("|")]
    assert len(lines) == 2 + len(result["rows"])
    assert len({len(line) for line in lines}) == 1
    return {(row["mode"], row["loss"]): row for row in result["rows"]}


def test_admm_arrives_and_the_printed_average_does_not(rows: dict) -> None:
    for loss in (0.0, 0.5):
        assert rows["admm", loss]["rounds_to_1e-6_sigma"] is not None
        assert rows["paper", loss]["rounds_to_0.05_sigma"] is None
        assert rows["paper", loss]["gap_sigma"] > 0.1
    assert rows["admm", 0.5]["rounds"] > rows["admm", 0.0]["rounds"]


def test_evidence_is_there_after_as_many_hops_as_the_team_is_wide(rows: dict) -> None:
    lossless = rows["evidence", 0.0]
    assert lossless["rounds"] == 3  # contact, then one round for each of two hops
    assert lossless["gap_sigma"] < 0.05
    assert rows["evidence_float32", 0.0]["gap_sigma"] < 1e-4
    for loss in (0.0, 0.5):
        assert rows["evidence_float64", loss]["gap_sigma"] < 1e-6
    # three robots' evidence over two links each, whole and once: 6 transfers of 20 records
    assert 6 * 20 * 100 < lossless["bytes"] < 6 * 20 * 100 + 2000
    assert rows["evidence", 0.5]["bytes"] > 1.3 * lossless["bytes"]
    assert lossless["bytes"] < rows["admm", 0.0]["bytes"] / 10


def test_the_command_prints_one_document_and_refuses_unknown_words() -> None:
    command = [
        sys.executable,
        "-c",
        "from duagc.pipeline.cli import main; main()",
        "bench",
        "consensus",
        "--robots",
        "2",
        "--topology",
        "full",
    ]
    command += ["--loss", "0", "--contrast", "47", "--unknown", "0", "--tracks", "5", "--json"]
    out = subprocess.run(command, capture_output=True, text=True, check=True)
    assert {row["mode"] for row in json.loads(out.stdout)["rows"]} == set(MODES) - {"evidence_float32"}
    bad = subprocess.run([*command, "--mode", "magic"], capture_output=True, text=True, check=False)
    assert bad.returncode == 2
    assert "'magic' is not one of evidence" in bad.stderr
