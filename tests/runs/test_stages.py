"""A stage reads and writes what it declares and nothing else."""

import time
from pathlib import Path

import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.workers import peak_memory_bytes
from duagc.pipeline.messages import Odometry
from duagc.pipeline.recording import LogWriter, open_rgbd, read_log
from duagc.pipeline.runs import stages
from duagc.pipeline.runs.stages import Stage
from duagc.pipeline.runs.timing import Timing
from duagc.schemas import topics
from tests.fixtures import fake_run

ESTIMATOR = (stages.FRONTEND, stages.INFORMATION, stages.EXCHANGE, stages.FUSION)


@pytest.fixture(scope="module")
def fake(tmp_path_factory: pytest.TempPathFactory) -> fake_run.FakeRun:
    return fake_run.make(tmp_path_factory.mktemp("fake"))


def robot_folder(fake: fake_run.FakeRun, robot: str = "alpha") -> Path:
    return fake.run / "robots" / robot


def odometry(fake: fake_run.FakeRun) -> Odometry:
    path = robot_folder(fake) / "frontend.mcap"
    return next(record.message() for record in read_log(path, [topics.ODOMETRY]))


def test_every_topic_of_a_stage_is_written_by_its_producer_and_no_other() -> None:
    for topic in topics.TOPICS:
        writers = [stage.name for stage in stages.STAGES if topic in stage.writes]
        assert writers == ([] if topic.producer == "converters" else [topic.producer]), topic.pattern


def test_memory_is_measured_in_millions_of_bytes() -> None:
    """As it is predicted (`cache.footprint`) and shown."""
    timing = Timing()
    with timing.measured("fusion", "alpha"):
        pass
    held_mb = timing.stages["fusion.alpha"]["peak_rss_mb"]
    assert held_mb == pytest.approx(peak_memory_bytes() / 1e6, rel=0.01)


def test_a_stage_cannot_declare_a_topic_of_another_producer() -> None:
    with pytest.raises(ValueError, match="stage fusion writes /<robot>/odometry, which frontend produces"):
        Stage("fusion", reads=(), writes=(topics.ODOMETRY,))


def test_every_stage_reads_what_stands_in_the_recording_or_an_earlier_stage_wrote() -> None:
    written = {*stages.SENSORS, *stages.TRUTH}
    for stage in stages.STAGES:
        assert set(stage.reads) <= written, stage.name
        written |= set(stage.writes)


@pytest.mark.parametrize("stage", ESTIMATOR, ids=lambda stage: stage.name)
def test_no_stage_of_the_estimator_declares_ground_truth(stage: Stage) -> None:
    assert not set(stage.reads) & set(stages.TRUTH)


def test_an_undeclared_read_is_refused_by_the_name_of_the_stage(fake: fake_run.FakeRun) -> None:
    folder = robot_folder(fake)
    with (
        stages.INFORMATION.running(folder, "alpha"),
        pytest.raises(
            DuagError, match=r"frontend\.mcap: stage information of alpha reads /alpha/map_update, "
        ),
    ):
        list(read_log(folder / "frontend.mcap", [topics.MAP_UPDATE.of("alpha")]))


def test_a_whole_log_with_an_undeclared_topic_is_refused(fake: fake_run.FakeRun) -> None:
    folder = robot_folder(fake)
    with stages.INFORMATION.running(folder, "alpha"), pytest.raises(DuagError, match="stage information"):
        list(read_log(folder / "frontend.mcap"))


def test_an_undeclared_write_is_refused_and_leaves_no_file(fake: fake_run.FakeRun, tmp_path: Path) -> None:
    message = odometry(fake)
    with (
        stages.FRONTEND.running(tmp_path, "alpha"),
        pytest.raises(
            DuagError, match=r"stage frontend of alpha writes /alpha/fused_map, expected one of its"
        ),
        LogWriter(tmp_path / "frontend.mcap", "alpha") as log,
    ):
        log.channel(topics.FUSED_MAP.of("alpha"), topics.FUSED_MAP.schema)
    assert list(tmp_path.iterdir()) == []
    with stages.FRONTEND.running(tmp_path, "alpha"), LogWriter(tmp_path / "frontend.mcap", "alpha") as log:
        log.write(topics.ODOMETRY.of("alpha"), message, 0)
    assert (tmp_path / "frontend.mcap").is_file()


def test_ground_truth_is_refused_while_a_robot_estimates(fake: fake_run.FakeRun) -> None:
    path = fake.recording / "alpha.groundtruth.mcap"
    assert list(read_log(path, [topics.GROUNDTRUTH_POSE]))
    with (
        stages.FRONTEND.running(robot_folder(fake), "alpha"),
        pytest.raises(DuagError, match=r"stage frontend of alpha reads /alpha/groundtruth/pose"),
    ):
        list(read_log(path, [topics.GROUNDTRUTH_POSE]))


def test_a_stage_of_one_robot_reads_no_sensors_of_another(fake: fake_run.FakeRun) -> None:
    with (
        stages.FRONTEND.running(robot_folder(fake), "alpha"),
        pytest.raises(DuagError, match=r"stage frontend of alpha reads /bravo/camera/color"),
    ):
        open_rgbd(fake.recording / "bravo.mcap")


def test_a_log_that_is_open_already_is_held_to_the_declaration(fake: fake_run.FakeRun) -> None:
    """The check is at every message: a reader handed in from outside does not get around it."""
    with open_rgbd(fake.recording / "alpha.mcap") as log:
        log.frame(0)
        narrow = Stage("narrow", reads=(topics.DEPTH,))
        with (
            narrow.running(fake.run),
            pytest.raises(DuagError, match="stage narrow reads /alpha/camera/color"),
        ):
            log.frame(1)


def test_undeclared_files_are_refused(fake: fake_run.FakeRun, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("found by hand")
    with stages.FRONTEND.running(tmp_path, "alpha"):
        with pytest.raises(DuagError, match=r"notes\.txt: stage frontend of alpha reads this file, expected"):
            (tmp_path / "notes.txt").read_text()
        with pytest.raises(DuagError, match=r"more\.txt: stage frontend of alpha writes this file, expected"):
            (tmp_path / "more.txt").write_text("")
    assert not (tmp_path / "more.txt").exists()
    assert (tmp_path / "notes.txt").read_text() == "found by hand"


def test_an_earlier_result_cannot_be_overwritten(fake: fake_run.FakeRun) -> None:
    before = (robot_folder(fake) / "frontend.mcap").read_bytes()
    with (
        stages.FUSION.running(robot_folder(fake), "alpha"),
        pytest.raises(DuagError, match=r"frontend\.mcap\S*: stage fusion of alpha writes this file"),
        LogWriter(robot_folder(fake) / "frontend.mcap", "alpha"),
    ):
        pass
    assert (robot_folder(fake) / "frontend.mcap").read_bytes() == before


def test_nothing_is_limited_after_a_stage(fake: fake_run.FakeRun) -> None:
    with pytest.raises(RuntimeError), stages.FRONTEND.running(robot_folder(fake), "alpha"):
        raise RuntimeError
    assert list(read_log(robot_folder(fake) / "frontend.mcap"))


def test_a_stage_of_a_robot_is_run_for_a_robot(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="robot is None"), stages.FRONTEND.running(tmp_path):
        pass
    with pytest.raises(ValueError, match="robot is alpha"), stages.EXCHANGE.running(tmp_path, "alpha"):
        pass


def test_the_check_is_cheap(fake: fake_run.FakeRun) -> None:
    """A check takes microseconds, reading a message takes tens of them at least."""
    path = fake.recording / "alpha.mcap"
    with stages.FRONTEND.running(robot_folder(fake), "alpha"):
        from duagc.pipeline.recording.access import check_read

        begin = time.perf_counter()
        for _ in range(1000):
            check_read(path, "/alpha/camera/color")
        assert time.perf_counter() - begin < 0.2
