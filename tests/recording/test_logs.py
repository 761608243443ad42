"""Logs: what is written is what is read; their identity."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.workers import worker_pool
from duagc.pipeline.recording import LogWriter, content_digest, log_metadata, merge, open_rgbd, read_log
from duagc.pipeline.recording.read import LogFile
from duagc.schemas import topics
from tests.fixtures.recording_logs import update, write_camera, write_updates


@settings(max_examples=20, deadline=None)
@given(steps=st.lists(st.integers(0, 3), max_size=30))
def test_messages_come_back_in_order(tmp_path_factory: pytest.TempPathFactory, steps: list[int]) -> None:
    times = np.cumsum(steps, dtype=int).tolist()
    path = tmp_path_factory.mktemp("log") / "alpha.mcap"
    digest = write_updates(path, "alpha", times)
    records = list(read_log(path))
    assert [r.log_time_ns for r in records] == times
    assert [r.publish_time_ns for r in records] == [max(0, t - 5) for t in times]
    assert [r.sequence for r in records] == list(range(len(times)))
    assert [r.message() for r in records] == [update("alpha", i) for i in range(len(times))]
    assert content_digest(path) == digest


def test_sequences_count_per_topic(tmp_path: Path) -> None:
    path = write_camera(tmp_path / "alpha.mcap")
    for topic in (topics.COLOR.of("alpha"), topics.DEPTH.of("alpha")):
        assert [r.sequence for r in read_log(path, [topic])] == [0, 1, 2, 3]
    assert list(read_log(path, ["/alpha/odometry"])) == []


def test_one_topic_may_stand_alone(tmp_path: Path) -> None:
    path = write_camera(tmp_path / "alpha.mcap")
    color = topics.COLOR.of("alpha")
    for one in (color, topics.COLOR):
        assert [r.topic for r in read_log(path, one)] == [color] * 4
    assert [r.topic for r in merge([path], color)] == [color] * 4
    assert list(read_log(path, "/alpha/odometry")) == []


def test_a_log_that_was_closed_says_so(tmp_path: Path) -> None:
    path = write_camera(tmp_path / "alpha.mcap")
    log = open_rgbd(path)
    log.close()
    with pytest.raises(DuagError) as raised:
        log.frame(3)
    assert str(raised.value) == f"{path}: the log was closed, expected it open while it is read"


def test_many_chunks_come_back_in_order(tmp_path: Path) -> None:
    """A log of several chunks of 1 MiB, with incompressible messages."""
    path = tmp_path / "alpha.mcap"
    rng = np.random.default_rng(0)
    blobs = [rng.bytes(300_000) for _ in range(12)]
    with LogWriter(path, "alpha") as log:
        for index, blob in enumerate(blobs):
            log.write(topics.COLOR.of("alpha"), m.pack_color(index, "alpha", blob, "jpeg"), index)
    assert [r.proto().data for r in read_log(path)] == blobs
    assert path.stat().st_size > 3_600_000


def _opened(path: Path, others: dict[str, int]) -> tuple[int, int]:
    """In a worker: how many chunks and how many checksummed bytes it takes to know all publish times of a log."""
    from duagc.pipeline.recording import log_checksums, read

    unpacked, summed = [], []
    chunk, crc = read.LogFile._chunk, log_checksums._crc_of
    read.LogFile._chunk = lambda self, start: unpacked.append(start) or chunk(self, start)  # type: ignore[method-assign]
    log_checksums._crc_of = lambda stream, start, stop: (
        summed.append(stop - start) or crc(stream, start, stop)
    )
    with read.LogFile(path) as log:
        assert {topic: len(log.entries_by_time(topic)) for topic in others} == others
    return len(unpacked), sum(summed)


def test_a_worker_knows_the_logs_that_its_parent_knows(tmp_path: Path) -> None:
    path = write_camera(tmp_path / "alpha.mcap")
    counts = {topics.COLOR.of("alpha"): 4, topics.DEPTH.of("alpha"): 4}
    with worker_pool(1) as pool:  # of a log that nobody has read yet
        chunks, summed = pool.submit(_opened, path, counts).result()
    assert chunks > 0
    assert summed > 0.9 * path.stat().st_size
    with LogFile(path) as log:
        assert {topic: len(log.entries_by_time(topic)) for topic in counts} == counts
    with worker_pool(1) as pool:
        assert pool.submit(_opened, path, counts).result() == (0, 0)
    path.write_bytes(path.read_bytes())  # another time: it may say something else
    with worker_pool(1) as pool:
        assert min(pool.submit(_opened, path, counts).result()) > 0


def test_merge_orders_by_time_then_file_then_place(tmp_path: Path) -> None:
    paths = []
    for name, times in (("bravo", [0, 5, 5, 9]), ("alpha", [5, 5, 9, 20])):
        paths.append(tmp_path / f"{name}.mcap")
        write_updates(paths[-1], name, times)
    merged = [(r.log_time_ns, r.topic.split("/")[1], r.sequence) for r in merge(paths)]
    expected = [(t, 0, i, "bravo") for i, t in enumerate([0, 5, 5, 9])]
    expected += [(t, 1, i, "alpha") for i, t in enumerate([5, 5, 9, 20])]
    assert merged == [(t, name, i) for t, _, i, name in sorted(expected)]


def test_the_writer_refuses_what_is_not_in_the_table(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "x.mcap") as log:
        log.write("/alpha/map_update", update("alpha", 0), 10)
        for topic, message, time, words in (
            ("/alpha/map_updates", update("alpha", 0), 10, "topics.py"),
            ("/alpha/odometry", update("alpha", 0), 10, "expected duagc.v1.Odometry"),
            ("/alpha/map_update", m.pack_color(0, "alpha", b"", "png"), 10, "expected duagc.v1.MapUpdate"),
            ("/alpha/map_update", update("alpha", 0), 9, "comes after 10 ns"),
        ):
            with pytest.raises(ValueError, match=words):
                log.write(topic, message, time)


def test_nothing_half_written_has_a_final_name(tmp_path: Path) -> None:
    path = tmp_path / "alpha.mcap"

    def write_and_fail(error: type[BaseException]) -> None:
        with LogWriter(path, "alpha") as log:
            log.write("/alpha/map_update", update("alpha", 0), 0)
            assert [p.name for p in tmp_path.iterdir()] == ["alpha.mcap.part"]
            raise error

    for error in (RuntimeError, KeyboardInterrupt):
        with pytest.raises(error):
            write_and_fail(error)
        assert list(tmp_path.iterdir()) == []
    with pytest.raises(DuagError, match="expected to write a log"), LogWriter(tmp_path / "no" / "x.mcap"):
        pass


# --- identity ---------------------------------------------------------------------------------------------------------


def test_digest_depends_on_content_only(tmp_path: Path) -> None:
    first = write_updates(tmp_path / "a.mcap", "alpha", [0, 1, 2], {"seed": "0"})
    assert write_updates(tmp_path / "b.mcap", "alpha", [0, 1, 2], {"seed": "0"}) == first
    others = [
        write_updates(tmp_path / "c.mcap", "alpha", [0, 1, 3], {"seed": "0"}),
        write_updates(tmp_path / "d.mcap", "alpha", [0, 1], {"seed": "0"}),
        write_updates(tmp_path / "e.mcap", "bravo", [0, 1, 2], {"seed": "0"}),
        write_updates(tmp_path / "f.mcap", "alpha", [0, 1, 2], {"seed": "1"}),
    ]
    assert len({first, *others}) == 5
    assert len(first) == 64
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_digest_does_not_depend_on_the_encoder(tmp_path: Path) -> None:
    """The same messages in a file that another program chunked and left uncompressed."""
    source, other = tmp_path / "a.mcap", tmp_path / "b.mcap"
    digest = write_updates(source, "alpha", [0, 1, 2])
    with other.open("wb") as stream:
        writer = Writer(stream, chunk_size=10, compression=CompressionType.NONE)
        writer.start(library="another")
        writer.add_metadata("duagc.log", log_metadata(source))
        for number, record in enumerate(read_log(source)):
            if number == 0:
                schema = writer.register_schema(record.schema, "protobuf", record.schema_data)
                channel = writer.register_channel(record.topic, "protobuf", schema)
            writer.add_message(
                channel, record.log_time_ns, record.data, record.publish_time_ns, record.sequence
            )
        writer.finish()
    assert other.read_bytes() != source.read_bytes()
    assert content_digest(other) == digest


def test_digest_is_the_same_in_every_process(tmp_path: Path) -> None:
    write_camera(tmp_path / "alpha.mcap")
    code = (
        "import sys; from pathlib import Path; from duagc.pipeline.recording import content_digest;"
        "print(content_digest(Path(sys.argv[1])))"
    )
    out = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "alpha.mcap")],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    assert out.stdout.strip() == content_digest(tmp_path / "alpha.mcap")
