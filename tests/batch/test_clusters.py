"""Cells on clusters of this machine: jobs of submitit's local executor, tasks of Ray, one of which is killed."""

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from duagc.converters.simulate.team import simulate
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.batch import clusters
from duagc.pipeline.batch.batch import run_batch
from duagc.pipeline.batch.cell import read_state, run_folder
from duagc.pipeline.batch.clusters import RayEngine, SlurmEngine
from duagc.pipeline.batch.engines import Engine, LocalEngine
from duagc.pipeline.batch.suite import Suite, read_suite
from duagc.pipeline.runs.digest import digest
from tests.fixtures.commands import ROOT, assert_one_line, duagc_here

SMALL = [
    "frontend.mapping.max_gaussians=2000",
    "frontend.mapping.iterations=4",
    "frontend.mapping.final_iterations=4",
    "frontend.mapping.final_iterations_view=0",
    "fusion.finetune.steps_per_view=2",
]


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    folder = tmp_path_factory.mktemp("suite")
    simulate(folder / "room", robots=2, frames=12, size=(160, 120), seed=1, overlap=0.9, workers=1)
    lossy = [*SMALL, "exchange.link.loss_probability=0.3"]
    (folder / "suite.toml").write_text(
        '[recordings]\nroom = "room"\n'
        f"[configurations.plain]\nset = {json.dumps(SMALL)}\n"
        f"[configurations.lossy]\nset = {json.dumps(lossy)}\n"
    )
    return read_suite(folder / "suite.toml")


@pytest.fixture(scope="module")
def expected(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    out = tmp_path_factory.mktemp("local")
    with LocalEngine(1) as engine:
        return digests(suite, out, engine)


def digests(suite: Suite, out: Path, engine: Engine) -> dict[str, str]:
    states = run_batch(suite, out, out / "store", engine, log=print)
    assert {state.state for state in states.values()} == {"done"}, states
    return {name: digest(run_folder(out, name)) for name in suite.cells}


@pytest.fixture
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells are processes of their own, which find the package where this one does."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))


@pytest.mark.slow
def test_jobs_of_submitit_compute_what_this_machine_does(
    suite: Suite, expected: dict[str, str], tmp_path: Path, importable: None
) -> None:
    pytest.importorskip("submitit")
    with SlurmEngine(2, tmp_path / "slurm", cluster="local", timeout_min=10) as engine:
        assert digests(suite, tmp_path, engine) == expected


@pytest.mark.slow
def test_tasks_of_ray_compute_what_this_machine_does_though_one_is_killed(
    suite: Suite, expected: dict[str, str], tmp_path: Path, importable: None
) -> None:
    pytest.importorskip("ray")
    killed: list[int] = []

    def kill_one() -> None:
        """The process of the first cell that is under way."""
        while not killed:
            for name in suite.cells:
                state = read_state(tmp_path, name)
                if state.state == "running":
                    time.sleep(2.0)
                    os.kill(int(str(state.process["pid"])), signal.SIGKILL)
                    killed.append(state.process["pid"])
                    return
            time.sleep(0.05)

    killer = threading.Thread(target=kill_one, daemon=True)
    killer.start()
    with RayEngine(2) as engine:
        assert digests(suite, tmp_path, engine) == expected
    killer.join(timeout=10)
    assert len(killed) == 1
    assert sorted(read_state(tmp_path, name).attempts for name in suite.cells) == [1, 2]


@pytest.mark.parametrize(
    ("module", "make", "extra"),
    [("submitit", lambda out: SlurmEngine(1, out), "slurm"), ("ray", lambda out: RayEngine(1), "ray")],
)
def test_an_engine_that_is_not_installed_names_its_extra(
    module: str, make: Callable[[Path], Engine], extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(DuagError, match=rf"package {module} not found; pip install 'duagc\[{extra}\]'"):
        make(tmp_path)
    (tmp_path / "suite.toml").write_text('[recordings]\nroom = "room"\n[configurations.plain]\n')
    result = duagc_here("batch", tmp_path / "suite.toml", "--out", tmp_path / "out", "--engine", extra)
    assert_one_line(result)  # the recording is looked for first
    assert "recording.json" in result.stderr


def test_a_cell_is_a_command() -> None:
    words = clusters.cell_command({"suite": "s.toml", "out": "o", "cell": "c", "store": "x"})
    assert words[1:3] == ["-m", "duagc.pipeline.batch.cell"]
    assert words[3:] == ["s.toml", "--out", "o", "--store", "x", "--cell", "c"]
