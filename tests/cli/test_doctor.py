"""`duagc doctor` names what lacks, and the line that mends it; `duagc config diff` names what differs."""

import json
from pathlib import Path

import pytest

from duagc.pipeline import doctor
from tests.fixtures.commands import assert_one_line, duagc_here


def test_this_machine_can_do_the_job(tmp_path: Path) -> None:
    result = duagc_here("doctor", "--out", tmp_path / "not" / "yet")
    assert result.returncode == 0, result.stdout
    lines = result.stdout.splitlines()
    assert any(line.split()[:2] == ["ok", "kernels"] for line in lines)
    assert any(line.split()[:2] == ["ok", "numpy"] for line in lines)
    assert str(tmp_path) in result.stdout
    assert not (tmp_path / "not").exists()
    rows = json.loads(duagc_here("doctor", "--json").stdout)
    assert {row["state"] for row in rows} <= {"ok", "note"}


def test_what_lacks_is_said_with_its_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    there = doctor._is_there
    monkeypatch.setattr(doctor, "_is_there", lambda module: module != "cryptography" and there(module))
    result = duagc_here("doctor", "--out", tmp_path)
    assert result.returncode == 0
    assert (
        "lacks: exchange.transport.signatures = 'ed25519'; mend: pip install 'duagc[signed]'" in result.stdout
    )
    monkeypatch.setattr(doctor, "_is_there", lambda module: module != "mcap" and there(module))
    result = duagc_here("doctor", "--out", tmp_path)
    assert result.returncode == 1
    assert any(line.split()[:2] == ["missing", "mcap"] for line in result.stdout.splitlines())


def test_little_memory_and_disk_are_notes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "memory_bytes", lambda: (4_000_000_000, 1_000_000_000))
    monkeypatch.setattr(doctor, "LEAST_DISK_BYTES", 1 << 62)
    found = {f.name: f for f in doctor.examine(tmp_path)}
    assert (found["memory"].state, found["memory"].remedy) == ("note", "duagc run --workers 1")
    assert found["disk"].state == "note"
    assert doctor.text(list(found.values())).count("mend:") >= 2


def test_settings_that_differ_are_listed(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("seed = 4\n[exchange]\nmax_rounds = 7\n")
    result = duagc_here("config", "diff", path)
    assert result.returncode == 3
    assert result.stdout.splitlines()[0] == "seed: 4 and 0"
    assert "exchange.max_rounds: 7 and " in result.stdout
    assert duagc_here("config", "diff", path, path).returncode == 0
    assert json.loads(duagc_here("config", "diff", path, "--json").stdout)["seed"] == [4, 0]
    path.write_text("[exchange]\nmax_round = 7\n")
    assert_one_line(duagc_here("config", "check", path), "expected perhaps exchange.max_rounds")


@pytest.mark.parametrize("out", ["/proc/runs", "/dev/null", "/dev/null/runs"])
def test_a_place_where_nothing_can_be_written_is_missing(out: str) -> None:
    result = duagc_here("doctor", "--out", out)
    assert result.returncode == 1
    assert any(line.split()[:2] == ["missing", "disk"] for line in result.stdout.splitlines())
