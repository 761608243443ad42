"""From cells to the page: recordings are shared, results keep their rule, the page repeats to the last byte."""

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.batch.cell import CellState, run_folder, write_state
from duagc.pipeline.batch.suite import read_suite
from duagc.pipeline.experiments import carry_out as carrying_out
from duagc.pipeline.experiments.carry_out import (
    RECORDINGS,
    RESULT,
    SUITE,
    carry_out,
    check_place,
    code_digest,
    prepare,
    recording_folder,
    simulator_digest,
)
from duagc.pipeline.experiments.pages import MARKDOWN, PAGE, VERDICTS, judge_folder, write_report
from duagc.pipeline.experiments.rule import read_experiment
from duagc.pipeline.runs import stages
from tests.experiments.test_rules import FILE
from tests.fixtures import fake_run


class Measured:
    """An engine whose cells come to what their configuration and seed say; one fails."""

    slots = 1

    def __init__(self, fails: str = "") -> None:
        self.fails, self.last = fails, ""

    def submit(self, name: str, arguments: Mapping[str, str]) -> None:
        out, self.last = Path(arguments["out"]), name
        _, configuration, seed = name.split("-")
        if name == self.fails:
            write_state(out, name, CellState("failed", error="no <depth>"))
            return
        run_folder(out, name).mkdir(parents=True, exist_ok=True)
        ate_m = 0.01 * (1 + int(seed)) + (0.0001 if configuration == "lossy" else 0.0)
        metrics = {
            "team": {"ate_rmse_m": ate_m},
            "exchange": {"rounds": None},
            "reasons": {"silence": ["exchange.*"]},
        }
        (run_folder(out, name) / "metrics.json").write_text(json.dumps(metrics))
        write_state(out, name, CellState("done", wall_s=1.0))

    def wait(self) -> str:
        return self.last


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An experiment that was carried out, in `out`; its file in `rules`."""
    root = tmp_path_factory.mktemp("place")
    (root / "rules").mkdir()
    (root / "rules" / "mine.toml").write_text(FILE.replace("[0, 1, 2, 3, 4]", "[0, 1, 2, 3, 4, 5]"))
    profile = read_experiment("mine", root / "rules").profile("small")
    data = profile.data
    fake = fake_run.make(root / "fake")
    for seed in range(6):  # recordings that are there already
        with _small_code():
            there = recording_folder(
                root / "out", data, seed, simulator_digest(root / "store", data, profile)
            )
        shutil.copytree(fake.recording, there)
    _carry_out(root, Measured("seed_5-lossy-5"))
    return root


def _carry_out(root: Path, engine: Measured) -> list[str]:
    """Of a pipeline of one small stage, whose code is quickly read."""
    said: list[str] = []
    with _small_code():
        carry_out(
            read_experiment("mine", root / "rules"),
            "small",
            root / "out",
            recordings={},
            engine=engine,
            store=root / "store",
            log=said.append,
        )
    return said


@contextmanager
def _small_code() -> Iterator[pytest.MonkeyPatch]:
    with pytest.MonkeyPatch.context() as patch:
        _only_stage(patch, "closest")
        yield patch


def _only_stage(patch: pytest.MonkeyPatch, function: str, simulator: str = "DuagError") -> None:
    patch.setattr(carrying_out, "SIMULATOR", f"duagc.pipeline.base.errors:{simulator}")
    only = replace(stages.EVALUATION, code=f"duagc.pipeline.base.errors:{function}")
    patch.setattr(stages, "EVALUATION", only)
    patch.setattr(stages, "STAGES", (only, stages.REPORT))


def test_every_seed_has_its_own_recording_and_run(place: Path) -> None:
    suite = read_suite(place / "out" / "mine" / SUITE)
    assert [(c.recording, c.seed, c.config.seed) for c in suite.cells.values()][::2] == [
        (f"seed_{k}", k, k) for k in range(6)
    ]
    assert {cell.until for cell in suite.cells.values()} == {"evaluation"}
    assert len(list((place / "out" / RECORDINGS).iterdir())) == 6
    assert not [line for line in _carry_out(place, Measured("seed_5-lossy-5")) if line.startswith("simulate")]


@pytest.mark.slow
def test_a_recording_that_is_missing_is_simulated_from_its_seed(place: Path, tmp_path: Path) -> None:
    experiment = read_experiment("mine", place / "rules")
    profile = experiment.profile("small").model_copy(update={"seeds": (3,)})
    said: list[str] = []
    suite = prepare(experiment, profile, tmp_path, recordings={}, store=tmp_path / "store", log=said.append)
    assert said == ["simulate: 2 robots, 2 frames each, seed 3"]
    parameters = json.loads((suite.cells["seed_3-plain-3"].folder / "recording.json").read_text())
    assert parameters["parameters"]["seed"] == 3


def test_another_simulator_takes_no_recordings_of_the_one_before(place: Path, tmp_path: Path) -> None:
    profile = read_experiment("mine", place / "rules").profile("small")
    data, folders = profile.data, []
    for simulator in ("DuagError", "closest", "DuagError"):
        with pytest.MonkeyPatch.context() as patch:
            _only_stage(patch, "closest", simulator)
            digest = simulator_digest(tmp_path / "store", data, profile)
            folders.append(recording_folder(tmp_path, data, 0, digest))
    assert folders[0] == folders[2] != folders[1]


def test_code_that_changes_meanwhile_makes_no_result(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = (place / "out" / "mine" / RESULT).read_bytes()
    digests = iter(["one", "another"])
    monkeypatch.setattr(carrying_out, "code_digest", lambda *_: next(digests))
    with pytest.raises(DuagError, match="the code changed while its runs were computed"):
        _carry_out(place, Measured("seed_5-lossy-5"))
    assert (place / "out" / "mine" / RESULT).read_bytes() == before


def _code(place: Path, steering: str = "") -> str:
    """Digest of the code of the experiment of a place, as if its first robot were steered."""
    experiment = read_experiment("mine", place / "rules")
    profile = experiment.profile("small")
    data = profile.data.model_copy(update={"steering": steering})
    return code_digest(place / "store", experiment, profile.model_copy(update={"data": data}))


def test_what_steers_a_robot_is_code_of_its_experiment_alone(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _only_stage(monkeypatch, "closest")
    found = []
    for function in ("new_file", "read_text"):
        monkeypatch.setattr(carrying_out, "STEERING", f"duagc.pipeline.base.files:{function}")
        found.append((_code(place), _code(place, "random")))
    (plain, steered), (plain_after, steered_after) = found
    assert plain == plain_after
    assert steered != steered_after


def test_the_result_keeps_values_reasons_and_the_rule(place: Path) -> None:
    result = json.loads((place / "out" / "mine" / RESULT).read_text())
    assert result["rule_sha256"] == read_experiment("mine", place / "rules").sha256
    failed = next(r for r in result["rows"] if r["seed"] == 5 and r["configuration"] == "lossy")
    assert failed["values"]["team.ate_rmse_m"] is None
    assert failed["reasons"]["team.ate_rmse_m"] == "no <depth>"
    assert result["rows"][0]["reasons"] == {"exchange.rounds": "silence"}


def test_the_page_says_the_verdict_and_repeats_to_the_last_byte(place: Path) -> None:
    judged = judge_folder(place / "out", place / "rules")
    assert [(v.word, len(v.gaps)) for v in judged[0].verdicts] == [("fails", 5)]
    assert judged[0].verdicts[0].why.startswith("shown by 5 seeds, and not by all; seeds 5: ")
    files = [PAGE, MARKDOWN, VERDICTS, "mine/rules.svg"]
    write_report(place / "out", judged)
    before = [(place / "out" / file).read_bytes() for file in files]
    write_report(place / "out", judge_folder(place / "out", place / "rules"))
    assert [(place / "out" / file).read_bytes() for file in files] == before
    page = before[0].decode()
    assert "no &lt;depth&gt;" in page
    assert "duagc experiment run mine --profile small --out DIR" in page
    assert "This experiment has no control." in page
    assert json.loads(before[2])["mine"][0]["mean"] == pytest.approx(-0.0001)


def test_the_page_says_where_sections_are_of_different_code(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = json.loads((place / "out" / "mine" / RESULT).read_text())
    _only_stage(monkeypatch, "closest")
    assert result["code_sha256"] == _code(place)
    _only_stage(monkeypatch, "DuagError")
    assert result["code_sha256"] != _code(place)
    _only_stage(monkeypatch, "closest", simulator="closest")
    assert result["code_sha256"] != _code(place)
    older = {k: v for k, v in result.items() if k != "code_sha256"}
    other = {"same": result, "older": older, "null": {**older, "code_sha256": None}}
    pages = {}
    for name, twin in other.items():
        for file, document in (("mine", result), ("twin", twin)):
            (tmp_path / name / file).mkdir(parents=True)
            (tmp_path / name / file / RESULT).write_text(json.dumps(document))
            shutil.copy(place / "rules" / "mine.toml", tmp_path / f"{file}.toml")
        write_report(tmp_path / name, judge_folder(tmp_path / name, tmp_path))
        pages[name] = (tmp_path / name / MARKDOWN).read_text()
    assert pages["same"].count(f"code `{result['code_sha256'][:12]}`") == 2
    assert "Not all sections" not in pages["same"]
    assert "**Not all sections are known to be of the same code**" in pages["older"]
    assert "; code not recorded." in pages["older"]
    assert pages["null"] == pages["older"]


def test_a_result_under_another_rule_is_refused(place: Path, tmp_path: Path) -> None:
    changed = (place / "rules" / "mine.toml").read_text().replace("margin = 0.001", "margin = 0.002")
    (tmp_path / "mine.toml").write_text(changed)
    with pytest.raises(
        DuagError, match=r"result.json: was made under rule [0-9a-f]{12}, expected [0-9a-f]{12}"
    ):
        judge_folder(place / "out", tmp_path)
    with pytest.raises(DuagError, match="was made under rule"):
        check_place(read_experiment("mine", tmp_path), "small", place / "out")
    with pytest.raises(DuagError, match="is of profile small, expected full"):
        check_place(read_experiment("mine", place / "rules"), "full", place / "out")
    broken = tmp_path / "mine" / RESULT
    broken.parent.mkdir()
    broken.write_text("{}")
    with pytest.raises(DuagError, match="is no result of an experiment"):
        judge_folder(tmp_path, tmp_path)
