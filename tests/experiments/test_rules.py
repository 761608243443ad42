"""Experiments are read whole before anything runs; what they name exists."""

import json
import re
import tomllib
from pathlib import Path

import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.batch.suite import SuiteFile
from duagc.pipeline.evaluation.pixel_errors import MAPS, NAMES, SETS
from duagc.pipeline.experiments.carry_out import check_recordings, prepare
from duagc.pipeline.experiments.metric_names import KNOWN, names_in, needs_truth
from duagc.pipeline.experiments.predicted import predicted_each_s, predicted_time, time_left_s
from duagc.pipeline.experiments.rule import RULES, data_of, experiment_names, read_experiment
from tests.fixtures import fake_run
from tests.fixtures.commands import assert_one_line, duagc_here
from tests.layers import ROOT

FILE = """
title = "a"
question = "b"
claim = "c"
limits = "d"
[profiles.small]
seeds = [0, 1, 2, 3, 4]
data = { robots = 2, frames = 2, width = 32, height = 32 }
[configurations.plain]
[configurations.lossy]
set = ["exchange.link.loss_probability=0.3"]
[metrics."team.ate_rmse_m"]
title = "ATE"
better = "less"
[metrics."exchange.rounds"]
title = "rounds"
better = "less"
[[rules]]
name = "poses"
claim = "equal"
kind = "equivalent"
first = { configuration = "lossy", metric = "team.ate_rmse_m" }
second = { configuration = "plain", metric = "team.ate_rmse_m" }
margin = 0.001
reason = "small"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "mine.toml").write_text(FILE)
    return tmp_path


@pytest.mark.parametrize("name", experiment_names())
def test_every_experiment_of_the_package_can_be_read_and_has_a_control(name: str) -> None:
    found = read_experiment(name)
    assert any(rule.control for rule in found.file.rules)
    assert all(len(profile.seeds) >= 5 for profile in found.file.profiles.values())
    assert set(found.file.profiles) == {"small", "full"}


def test_the_digest_is_that_of_the_bytes(folder: Path) -> None:
    before = read_experiment("mine", folder)
    (folder / "mine.toml").write_text(FILE + "\n# a word\n")
    assert read_experiment("mine", folder).sha256 != before.sha256
    assert read_experiment("mine", folder).file == before.file


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        (
            '"team.ate_rmse_m"]',
            '"team.ate_rms_m"]',
            "metric team.ate_rms_m is unknown, expected perhaps team.ate_rmse_m",
        ),
        (
            "loss_probability",
            "loss_probabilty",
            "configuration lossy: .* expected perhaps exchange.link.loss_probab",
        ),
        (
            'configuration = "lossy"',
            'configuration = "losy"',
            "rule poses: configuration losy .* perhaps lossy",
        ),
        (
            'metric = "team.ate_rmse_m" }\nsecond',
            'metric = "exchange.bytes_sent" }\nsecond',
            "is not in the file",
        ),
        ('configuration = "lossy"', 'configuration = "plain"', "team.ate_rmse_m of plain with itself"),
        ('{ configuration = "lossy", metric', "{ value = 1.0, metric", "a side has a value and a metric"),
        ("margin = 0.001", "", "margin is 0, expected above 0 for equivalent"),
        ('kind = "equivalent"', 'kind = "differs"', "margin is 0.001, expected none for differs"),
        ('kind = "equivalent"', 'kind = "equal"', "rules.0.kind"),
        ("[0, 1, 2, 3, 4]", "[0, 0]", "seeds: 0 occurs twice"),
        ("[0, 1, 2, 3, 4]", "[]", "profile small: found no seed"),
        ("frames = 2", "frames = 1", "frames is 1, expected 2"),
        ("frames = 2", "frame = 2", "data.frame"),
        ("[[rules]]", "[[rules]", "not valid TOML"),
    ],
)
def test_what_does_not_exist_is_one_line(folder: Path, old: str, new: str, complaint: str) -> None:
    assert old in FILE
    (folder / "mine.toml").write_text(FILE.replace(old, new))
    with pytest.raises(DuagError, match=complaint):
        read_experiment("mine", folder)


def test_metrics_of_two_kinds_are_not_compared(folder: Path) -> None:
    text = FILE.replace('title = "ATE"', 'title = "ATE"\nunit = "m"')
    text = text.replace('plain", metric = "team.ate_rmse_m"', 'plain", metric = "exchange.rounds"')
    (folder / "mine.toml").write_text(text)
    with pytest.raises(DuagError, match="expected metrics of one kind"):
        read_experiment("mine", folder)


def test_the_known_metrics_are_those_of_a_run() -> None:
    """Of the golden demo, which has all of them but those of truth that no simulation lacks."""
    golden = json.loads((ROOT / "tests" / "golden" / "demo.json").read_text(encoding="utf-8"))["metrics"]
    numbers = {name: value for name, value in golden.items() if isinstance(value, int | float)}
    pixels = {f"pixel_calibration.{m}.{s}.{key}" for m in MAPS for s in SETS for key in NAMES}
    assert pixels == {name for name in KNOWN if name.startswith("pixel_calibration.")}
    absent = {name for name in KNOWN if not names_in(name, golden)} - pixels
    on_request = {name for name in KNOWN if name.startswith(("rendering.central.", "consensus.matching_"))}
    assert absent == on_request != set()
    for section in ("team.", "exchange.", "calibration."):
        assert {name for name in numbers if name.startswith(section)} <= set(KNOWN)
    numbers["robots.alpha-2.ate_rmse_m"] = 1.0  # a part of a robot's path is no robot
    assert names_in("robots.*.ate_rmse_m", numbers) == ["robots.alpha.ate_rmse_m", "robots.bravo.ate_rmse_m"]


def test_the_metrics_of_truth_are_known() -> None:
    assert needs_truth("team.ate_rmse_m")
    assert needs_truth("robots.*.rpe_rot_rad")
    assert needs_truth("calibration.spearman")
    assert not needs_truth("rendering.own.held_out.psnr_db")
    assert not needs_truth("consensus.rounds_to_tolerance")


def test_the_commands_name_what_there_is(tmp_path: Path) -> None:
    said = duagc_here("experiment", "list").stdout
    assert [line.split()[0] for line in said.splitlines()] == experiment_names()
    shown = duagc_here("experiment", "show", "h1_team").stdout
    assert shown.endswith((RULES / "h1_team.toml").read_text())
    assert re.search(
        r"^# small: \d+ seeds, .*, about [1-9][\d.]* (s|min) of processor time$", shown, re.MULTILINE
    )
    assert read_experiment("h1_team").sha256 in shown
    assert_one_line(duagc_here("experiment", "show", "h1_tean"), "expected perhaps h1_team")
    assert duagc_here("experiment", "run", "--out", tmp_path).returncode == 2
    twice = duagc_here("experiment", "run", "h1_team", "compaction", "h1_team", "--out", tmp_path)
    assert (twice.returncode, "h1_team more than once" in twice.stderr) == (2, True), twice.stderr
    assert_one_line(
        duagc_here("experiment", "run", "h1_team", "--profile", "medium", "--out", tmp_path), "small"
    )
    assert_one_line(duagc_here("experiment", "report", tmp_path), "found no result.json")


def test_what_experiments_take_counts_equal_runs_once(folder: Path) -> None:
    mine = read_experiment("mine", folder)
    (folder / "twin.toml").write_text(FILE.replace('"a"', '"twin"'))
    (folder / "larger.toml").write_text(FILE.replace("width = 32", "width = 320"))
    alone = predicted_time([mine], "small")
    assert (alone.runs, alone.different) == (10, 10)
    both = predicted_time([mine, read_experiment("twin", folder)], "small")
    assert (both.runs, both.different, both.cpu_s) == (20, 10, alone.cpu_s)
    assert predicted_time([read_experiment("larger", folder)], "small").cpu_s > alone.cpu_s
    assert predicted_each_s([mine, read_experiment("twin", folder)], "small") == [alone.cpu_s, 0.0]


def test_steering_takes_the_time_of_its_maps(folder: Path) -> None:
    def seconds(policy: str) -> float:
        data = f'frames = 60, width = 32, height = 32, steering = "{policy}" }}'
        (folder / "steered.toml").write_text(FILE.replace("frames = 2, width = 32, height = 32 }", data))
        return predicted_time([read_experiment("steered", folder)], "small").cpu_s

    assert seconds("") == seconds("random") < seconds("information") == seconds("unseen")
    with pytest.raises(DuagError, match="steering"):
        seconds("informed")


def test_the_time_left_is_that_of_the_pace_so_far() -> None:
    predicted_s = [100.0, 200.0, 300.0]
    assert time_left_s(predicted_s, [], workers=2) == 300
    assert time_left_s(predicted_s, [80.0], workers=2) == pytest.approx(400)
    assert time_left_s(predicted_s, [0.5, 100.0], workers=2) == pytest.approx(150)  # the first was found
    assert time_left_s(predicted_s, [0.5], workers=2) == 250
    assert time_left_s(predicted_s, [80.0, 90.0, 100.0], workers=2) == 0


def test_a_front_end_counts_once_for_all_that_comes_after_it(folder: Path) -> None:
    alone = predicted_time([read_experiment("mine", folder)], "small").cpu_s
    (folder / "own.toml").write_text(
        FILE.replace("exchange.link.loss_probability=0.3", "frontend.mapping.iterations=9")
    )
    assert predicted_time([read_experiment("own", folder)], "small").cpu_s > 1.1 * alone


def test_trackers_to_compare_with_take_longer(folder: Path) -> None:
    text, found = FILE.replace("frames = 2", "frames = 100"), {}
    for method in ("registration", "open3d", "rendering"):
        setting = f"frontend.tracking.method={method}"
        (folder / f"{method}.toml").write_text(text.replace("exchange.link.loss_probability=0.3", setting))
        found[method] = predicted_time([read_experiment(method, folder)], "small").cpu_s
    ten_robots = 10  # two of each of five recordings
    assert found["open3d"] > found["registration"] + ten_robots * 5
    assert found["rendering"] > found["registration"] + ten_robots * 5


def test_a_recording_without_truth_is_refused_before_anything_runs(tmp_path: Path) -> None:
    fake = fake_run.make(tmp_path / "fake")
    for path in fake.recording.rglob("*groundtruth*"):
        path.unlink()
    described = json.loads((fake.recording / "recording.json").read_text())
    for robot in described["robots"].values():
        robot.pop("groundtruth", None)
    (fake.recording / "recording.json").write_text(json.dumps(described))
    out = tmp_path / "out"
    given = f"wall={fake.recording}"
    result = duagc_here("experiment", "run", "h1_team", "--recording", given, "--out", out)
    assert_one_line(result, "has no ground truth of", "expected it for metric robots.*.ate_rmse_m")
    assert not out.exists()
    for text, said in (
        ("wall", "NAME=FOLDER"),
        (f"a/b={fake.recording}", "expected letters"),
        (f"seed_1={fake.recording}", "no seed_ in front"),
        (f"there={tmp_path / 'nowhere'}", "nowhere/recording.json"),
    ):
        assert_one_line(duagc_here("experiment", "run", "h1_team", "--recording", text, "--out", out), said)
    twice = ("--recording", given, "--recording", f"wall={tmp_path}")
    said = f"--recording wall={tmp_path}: found {fake.recording} as wall, expected every name once"
    assert_one_line(duagc_here("experiment", "run", "h1_team", *twice, "--out", out), said)
    assert not out.exists()


def test_a_recording_without_the_true_surface_is_refused_for_h3(tmp_path: Path) -> None:
    fake = fake_run.make(tmp_path / "fake")
    described = json.loads((fake.recording / "recording.json").read_text())
    described.pop("geometry", None)
    (fake.recording / "recording.json").write_text(json.dumps(described))
    given, out = {"wall": fake.recording}, tmp_path / "out"
    check_recordings([read_experiment("h1_team")], given)
    result = duagc_here(
        "experiment", "run", "h3_stereo", "--recording", f"wall={fake.recording}", "--out", out
    )
    assert_one_line(result, "has no true surface", "expected it for metric calibration.ece_rank of h3_stereo")
    assert not out.exists()


def test_sensors_and_movers_are_data_of_an_experiment(folder: Path) -> None:
    text = FILE.replace("height = 32 }", 'height = 32, sensor = "stereo", movers = 2, masks = false }')
    (folder / "mine.toml").write_text(text)
    settings = read_experiment("mine", folder).profile("small").data.settings(3)
    assert (settings.rig.sensor, settings.movers, settings.masks, settings.seed) == ("stereo", 2, False, 3)
    for wrong, said in (
        ("masks = false, movers = 0", "masks are withheld without movers"),
        ('sensor = "sonar"', "sensor is 'sonar'"),
    ):
        (folder / "mine.toml").write_text(FILE.replace("height = 32 }", f"height = 32, {wrong} }}"))
        with pytest.raises(DuagError, match=said):
            read_experiment("mine", folder)


def test_a_configuration_may_have_data_of_its_own(folder: Path) -> None:
    text = FILE.replace(
        "[configurations.lossy]", "[configurations.lossy]\ndata = { overlap = 0.2, robots = 3 }"
    )
    (folder / "mine.toml").write_text(text)
    found = read_experiment("mine", folder)
    profile = found.profile("small")
    data = {name: data_of(found.file, profile, name) for name in found.file.configurations}
    assert (data["plain"].robots, data["plain"].overlap) == (2, profile.data.overlap)
    assert (data["lossy"].robots, data["lossy"].overlap, data["lossy"].frames) == (3, 0.2, 2)
    for wrong, said in (("robots = 99", "robots is 99"), ("robts = 3", "data: robts")):
        (folder / "mine.toml").write_text(text.replace("robots = 3", wrong))
        with pytest.raises(DuagError, match=said):
            read_experiment("mine", folder)


def test_every_configuration_runs_on_its_own_data_alone(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulated = []

    def simulate(path: Path, **settings: object) -> None:
        simulated.append((settings["seed"], settings["overlap"]))
        path.mkdir(parents=True)

    monkeypatch.setattr("duagc.pipeline.experiments.carry_out.simulate", simulate)
    monkeypatch.setattr("duagc.pipeline.experiments.carry_out.read_suite", lambda path: path)
    monkeypatch.setattr(
        "duagc.pipeline.experiments.carry_out.SIMULATOR", "duagc.pipeline.base.errors:closest"
    )
    text = FILE.replace("[configurations.lossy]", "[configurations.lossy]\ndata = { overlap = 0.2 }")
    (folder / "mine.toml").write_text(text.replace("[0, 1, 2, 3, 4]", "[3, 4]"))
    found = read_experiment("mine", folder)
    store = folder / "store"
    path = prepare(
        found, found.profile("small"), folder / "out", recordings={}, store=store, log=lambda _: None
    )
    assert simulated == [(3, 0.6), (4, 0.6), (3, 0.2), (4, 0.2)]
    suite = SuiteFile.model_validate(tomllib.loads(Path(str(path)).read_text()))
    left = {
        (recording, configuration, seed)
        for recording in suite.recordings
        for configuration in suite.configurations
        for seed in suite.seeds
        if not any(
            row.recording == recording and (row.configuration == configuration or row.seed == seed)
            for row in suite.exclude
        )
    }
    plain = [("seed_3", "plain", 3), ("seed_4", "plain", 4)]
    assert sorted(cell for cell in left if cell[1] == "plain") == plain
    lossy = sorted(cell for cell in left if cell[1] == "lossy")
    assert [(name.split(".")[0], seed) for name, _, seed in lossy] == [("seed_3", 3), ("seed_4", 4)]
    assert not {name for name, _, _ in lossy} & {name for name, _, _ in plain}
