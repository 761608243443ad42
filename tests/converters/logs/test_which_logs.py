"""Which files of a folder are whose logs: not our own, not what a crash or a download left; pieces of one log."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from duagc.converters import registry
from duagc.converters.logs.describe import describe
from duagc.converters.logs.sources import sources_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.recording import info
from duagc.pipeline.runs.digest import digest
from tests.fixtures.ros_bags import START_NS, Ros, scene, still
from tests.fixtures.ros_clocks import moved_headers


def later(r: Ros, rows: list[Any], by_ns: int) -> list[Any]:
    return [(topic, at + by_ns, message) for topic, at, message in moved_headers(r, rows, by_ns)]


def test_logs_that_were_renamed_make_the_same_recording(tmp_path: Path) -> None:
    r = Ros(1)
    bag = r.write(tmp_path / "bag", still(r), "plain")
    digests = []
    for folder, names in (("first", ("a", "b")), ("second", ("morning", "noon"))):
        (tmp_path / folder).mkdir()
        for name in names:
            shutil.copy(bag, tmp_path / folder / f"{name}.bag")
        registry.convert("ros", tmp_path / folder, tmp_path / "made" / folder)
        digests.append(digest(tmp_path / "made" / folder))
        parts = json.loads((tmp_path / "made" / folder / "recording.json").read_text())["source"]["parts"]
        assert parts == [f"{name}.bag" for name in names]
    assert digests[0] == digests[1]


def test_our_own_recordings_and_runs_are_no_robots(tmp_path: Path) -> None:
    r = Ros(1)
    logs = tmp_path / "logs"
    logs.mkdir()
    r.write(logs / "x", still(r), "plain")
    for _ in range(2):
        registry.convert("ros", logs, logs / "rec", force=True)
        assert sorted(info(logs / "rec")["robots"]) == ["alpha"]
    shutil.copy(logs / "rec" / "alpha.mcap", logs / "ours.mcap")
    (logs / "run").mkdir()
    (logs / "run" / "manifest.json").write_text("{}")
    shutil.copy(logs / "x.bag", logs / "run" / "y.bag")
    assert [[p.name for p in s.paths] for s in sources_of(logs, {})] == [["x.bag"]]
    with pytest.raises(DuagError, match=r"found no log but DUAG-C's own alpha\.mcap, expected"):
        registry.convert("ros", logs / "rec", tmp_path / "rec2")


def test_a_recording_does_not_replace_its_source(tmp_path: Path) -> None:
    r = Ros(2)
    bag = r.write(tmp_path / "bag", still(r), "sqlite3")
    (bag / "recording.json").write_text("{}")
    with pytest.raises(DuagError, match=r"found .*bag in it, expected --out apart from what is read"):
        registry.convert("ros", bag, bag, force=True)
    with pytest.raises(DuagError, match=r"found .*bag in it, expected --out apart from what is read"):
        registry.convert("ros", tmp_path, bag, force=True)
    assert (bag / "bag.db3").is_file()


def test_a_folder_in_a_bag_of_ros_2_is_not_part_of_it(tmp_path: Path) -> None:
    r = Ros(2)
    bag = r.write(tmp_path / "bag", still(r), "sqlite3")
    (bag / "bag").mkdir()
    registry.convert("ros", bag, bag / "rec")
    registry.convert("ros", bag, bag / "rec2")


@pytest.mark.parametrize(
    ("names", "gap_ns", "is_one"),
    [
        (("split_0", "split_1"), 50_000_000, True),
        (("split_0", "split_1"), 60_000_000_000, False),
        (("split_1", "split_3"), 50_000_000, False),
        (("a_2026-01-01-10-00-00_0", "a_2026-01-01-10-00-09_1"), 50_000_000, True),
        (("2026-01-01-10-00-00_0", "2026-01-01-10-00-09_1"), 50_000_000, True),
    ],
)
def test_pieces_of_a_log(tmp_path: Path, names: tuple[str, str], gap_ns: int, is_one: bool) -> None:
    """As a crash of `ros2 bag` leaves them, or `rosbag record --split`. Sessions a minute apart may be robots."""
    r, logs = Ros(1), tmp_path / "split"
    logs.mkdir()
    for k, name in enumerate(names):
        r.write(logs / name, later(r, still(r), k * (3 * 50_000_000 + gap_ns)), "plain")
    if not is_one:
        registry.convert("ros", logs, tmp_path / "rec")
        return
    words = rf"{names[1]}.bag begins 0.050 s after the end of {names[0]}.bag, .*--set pieces=true"
    with pytest.raises(DuagError, match=words):
        registry.convert("ros", logs, tmp_path / "rec")
    assert any(f"{names[1]}.bag begins" in text for text in describe(logs)["warnings"])
    registry.convert("ros", logs, tmp_path / "rec", options=["pieces=true"])
    assert info(tmp_path / "rec")["robots"]["alpha"]["frames"] == 8


def test_logs_of_robots_that_are_called_alike_are_not_one_log(tmp_path: Path) -> None:
    r, logs = Ros(1), tmp_path / "logs"
    logs.mkdir()
    for k in range(2):
        r.write(logs / f"robot_{k}", later(r, still(r), k * 15_000_000), "plain")
    with pytest.raises(DuagError, match=r"is in robot_0.bag and in robot_1.bag, expected pieces=true"):
        registry.convert("ros", logs, tmp_path / "rec", options=["namespaces=/camera"])
    assert not (tmp_path / "rec").exists()


def test_logs_of_robots_in_a_folder_below_are_not_one_log(tmp_path: Path) -> None:
    """As when the folder above that of the logs is named: their images would take turns in one recording."""
    r, logs = Ros(1), tmp_path / "campaign" / "day"
    logs.mkdir(parents=True)
    for k in range(2):
        r.write(logs / f"robot_{k}", later(r, still(r), k * 15_000_000), "plain")
    words = r"is in robot_0.bag and in robot_1.bag at the same time, expected pieces of one log; .*day itself"
    with pytest.raises(DuagError, match=words):
        registry.convert("ros", logs.parent, tmp_path / "rec")
    assert any("at the same time" in text for text in describe(logs.parent)["warnings"])
    registry.convert("ros", logs, tmp_path / "rec")
    assert sorted(info(tmp_path / "rec")["robots"]) == ["alpha", "bravo"]


def test_what_only_the_first_piece_says_is_missed_in_the_next(tmp_path: Path) -> None:
    r, logs = Ros(1), tmp_path / "split"
    logs.mkdir()
    whole = scene(r)
    later_rows = [row for row in later(r, whole, 4 * 50_000_000) if row[0] != "/tf_static"]
    for k, rows in enumerate((whole, later_rows)):
        r.write(logs / f"split_{k}", rows, "plain")
    with pytest.raises(
        DuagError, match=r"split_1.bag: .* does not tie them.*, or --set pieces=true if these are"
    ):
        registry.convert("ros", logs, tmp_path / "rec")
    registry.convert("ros", logs, tmp_path / "rec", options=["pieces=true"])


@pytest.mark.parametrize(
    ("name", "words"),
    [("x_1.bag.active", "rosbag reindex"), ("x_1.db3.zstd", "zstd -d"), ("x_1.mcap.part", "to its end")],
)
def test_logs_that_are_not_read_are_named(tmp_path: Path, name: str, words: str) -> None:
    r, logs = Ros(1), tmp_path / "logs"
    logs.mkdir()
    (logs / name).write_bytes(b"some")
    with pytest.raises(DuagError, match=f"found no log, .*; {name} .*{words}"):
        registry.convert("ros", logs, tmp_path / "rec")
    with pytest.raises(DuagError, match=words):
        registry.convert("ros", logs / name, tmp_path / "rec")
    r.write(logs / "x_0", still(r), "plain")
    registry.convert("ros", logs, tmp_path / "rec")
    [warning] = json.loads((tmp_path / "rec" / "recording.json").read_text())["warnings"]
    assert name in warning
    assert words in warning


@pytest.mark.parametrize("definition", ["", "uint8 X=1\nfoo_pkg/Missing y\n"])
def test_a_type_that_nobody_asked_for_may_be_broken(tmp_path: Path, definition: str) -> None:
    """As messages of a package that was not built where the bag was recorded."""
    from rosbags.rosbag1 import Writer as Writer1

    r = Ros(1)
    with Writer1(tmp_path / "odd.bag") as bag:
        r._fill(bag, still(r), r.store.serialize_ros1)
        odd = bag.add_connection("/odd", "foo_msgs/msg/Odd", msgdef=definition, md5sum="0" * 32)
        bag.write(odd, START_NS, bytes(8))
    registry.convert("ros", tmp_path / "odd.bag", tmp_path / "rec")
    assert info(tmp_path / "rec")["robots"]["alpha"]["frames"] == 4


def test_an_mcap_whose_summary_repeats_no_channels(tmp_path: Path) -> None:
    r = Ros(2)
    with (tmp_path / "x.mcap").open("wb") as stream:
        writer = Writer(stream, repeat_channels=False, repeat_schemas=False)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        for topic, at, message in still(r):
            kind = message.__msgtype__
            if topic not in channels:
                text = r.store.generate_msgdef(kind, ros_version=2)[0]
                schema = writer.register_schema(kind, "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], at, bytes(r.store.serialize_cdr(message, kind)), at, 0)
        writer.finish()
    registry.convert("ros", tmp_path / "x.mcap", tmp_path / "rec")
    assert info(tmp_path / "rec")["robots"]["alpha"]["frames"] == 4


def test_robots_that_differ_by_capitals_are_named_by_a_file(tmp_path: Path) -> None:
    r, spaces = Ros(2), ("/Alpha", "/alpha")
    rows = [row for space in spaces for row in still(r, (f"{space}/image", space), (f"{space}/depth", space))]
    r.write(tmp_path / "team", rows, "sqlite3")
    with pytest.raises(DuagError, match=r"name a robot twice, expected .* with \[robots\.NAME\] and its"):
        sources_of(tmp_path / "team", {"namespaces": ",".join(spaces)})
    names = {"one": "/Alpha", "two": "/alpha"}
    listed = [f'[robots.{name}]\nlogs = ["team"]\nnamespace = "{space}"\n' for name, space in names.items()]
    (tmp_path / "team.toml").write_text("".join(listed))
    assert {s.robot: s.namespace for s in sources_of(tmp_path / "team.toml", {})} == names
