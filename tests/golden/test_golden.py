"""Golden runs compute what is stored, and a change is named by stage, topic, message and field."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.comparison.golden import differences, store
from duagc.pipeline.recording import LogWriter, log_metadata, read_log
from tests.golden.command import golden_of
from tests.golden.runs import RUNS, make_run

QUICK = "tiny3"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden run that is small enough for `make test`."""
    return make_run(QUICK, tmp_path_factory.mktemp(QUICK), workers=1)


def test_the_small_run_is_as_stored(run: Path) -> None:
    assert differences(golden_of(QUICK), run) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(RUNS) - {QUICK}))
def test_every_run_is_as_stored(name: str, tmp_path: Path) -> None:
    needs = RUNS[name].needs
    if needs is not None and not needs.is_dir():
        pytest.skip(f"needs {needs}")
    assert differences(golden_of(name), make_run(name, tmp_path)) == []


def changed_log(path: Path, topic: str, index: int, **fields: Any) -> int:
    """Write a log again with other values in one message of a topic.

    Args:
        path: of the log.
        topic: of the message.
        index: of the message among those of its topic.
        fields: its new values, by name.
    Returns:
        Time of the message.
    """
    records, metadata = list(read_log(path)), log_metadata(path)
    chosen = [record for record in records if record.topic == topic][index]
    with LogWriter(path, metadata.pop("robot"), metadata) as log:
        for record in records:
            message = record.proto()
            if record is chosen:
                for name, value in fields.items():
                    setattr(message, name, value)
            log.write(record.topic, message, record.log_time_ns, record.publish_time_ns)
    return chosen.log_time_ns


def test_a_changed_message_is_named(run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    log = tmp_path / "run" / "robots" / "alpha" / "frontend.mcap"
    time_ns = changed_log(log, "/alpha/odometry", 5, overlap=0.125)
    assert differences(golden_of(QUICK), tmp_path / "run") == [
        "frontend: robots/alpha/frontend.mcap: /alpha/odometry; "
        f"first message that differs: 5 at {time_ns} ns; fields overlap"
    ]


def test_a_changed_setting_is_named(run: Path, tmp_path: Path) -> None:
    golden = tmp_path / "golden.json"
    for name in ("golden.npz", "golden.json"):  # of somebody else
        (tmp_path / name).write_text("mine")
        with pytest.raises(DuagError, match="exists and is no golden run"):
            store(golden, run)
        assert (tmp_path / name).read_text() == "mine"
    for name in ("golden.npz", "golden.json"):
        (tmp_path / name).unlink()
    store(golden, run)
    assert differences(golden, run) == []
    shutil.copytree(run, tmp_path / "run")
    path = tmp_path / "run" / "exchange.mcap"
    records, metadata = list(read_log(path)), log_metadata(path)
    config = json.loads(metadata["config"])
    config["link"]["loss_probability"] = 0.75
    with LogWriter(path, metadata=metadata | {"config": json.dumps(config)}) as log:
        for record in records:
            log.write(record.topic, record.proto(), record.log_time_ns, record.publish_time_ns)
    (line,) = differences(golden, tmp_path / "run")
    assert line == "exchange: exchange.mcap: metadata config.link.loss_probability: 0.75, stored 0.3"


def test_other_versions_of_libraries_are_named_where_something_differs(run: Path, tmp_path: Path) -> None:
    golden, arrays = tmp_path / "golden.json", golden_of(QUICK).with_suffix(".npz")
    shutil.copy(arrays, tmp_path / "golden.npz")
    content = json.loads(golden_of(QUICK).read_text())
    content["libraries"]["numpy"] = "2.5.5"
    golden.write_text(json.dumps(content))
    assert differences(golden, run) == []
    content["files"].pop("robots/alpha/odometry.tum")
    golden.write_text(json.dumps(content))
    first, second = differences(golden, run)
    assert first == f"library numpy: '{np.__version__}', stored '2.5.5'"
    assert "robots/alpha/odometry.tum" in second


def test_a_changed_metric_is_named(run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    path = tmp_path / "run" / "metrics.json"
    metrics = json.loads(path.read_text())
    metrics["team"]["ate_rmse_m"] += 0.25
    path.write_text(json.dumps(metrics))
    (line,) = differences(golden_of(QUICK), tmp_path / "run")
    assert line.startswith("evaluation: team.ate_rmse_m: 0.2")


@pytest.mark.parametrize("damage", ["topics", "files", "metrics", "metadata", "fields"])
def test_a_golden_run_with_a_list_in_place_of_a_table_is_one_line(tmp_path: Path, damage: str) -> None:
    golden = tmp_path / "golden.json"
    shutil.copy(golden_of(QUICK).with_suffix(".npz"), tmp_path / "golden.npz")
    content = json.loads(golden_of(QUICK).read_text())
    if damage == "fields":
        next(iter(next(iter(content["topics"].values())).values()))["fields"] = []
    else:
        content[damage] = []
    golden.write_text(json.dumps(content))
    with pytest.raises(DuagError, match=r"golden\.json: .*expected a golden run"):
        differences(golden, tmp_path)
