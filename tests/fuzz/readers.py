"""Everything that reads a file from outside: how a sound example of its input is made, and how it is read."""

from __future__ import annotations

import bz2
import sqlite3
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

import converters
from pipeline import checks, digest, recovery
from pipeline.config import load
from pipeline.errors import DuagError
from pipeline.recording import Recording, format_info, info, open_rgbd, read_log
from tests.converters import (
    test_foreign_mcap,
    test_image_folders,
    test_kimera_multi,
    test_s3e,
    test_simulate_meshes,
)
from tests.converters.ros_bags import Ros, scene
from tests.converters.test_seven_scenes import make_sequence
from tests.fuzz.mutate import damaged
from tests.recording.logs import write_recording

SHARED = Path(__file__).parents[3] / "shared" / "data"
Special = Callable[[Path, np.random.Generator], bool]


@dataclass(frozen=True)
class Reader:
    """make: writes sound input into a folder. read: reads it, may write below another folder."""

    name: str
    make: Callable[[Path], None]
    read: Callable[[Path, Path], None]
    special: Special


# --- damage that a format suggests ------------------------------------------------------------------------------------


def any_special(path: Path, rng: np.random.Generator) -> bool:
    """What suits the extension."""
    suffix = path.suffix.lower()
    kinds: dict[str, Special] = {
        ".png": image_bomb,
        ".jpg": image_bomb,
        ".mcap": mcap_rewritten,
        ".bag": bag_bomb,
        ".db3": database,
    }
    return suffix in kinds and kinds[suffix](path, rng)


def _replace(path: Path, data: bytes) -> bool:
    path.unlink()
    path.write_bytes(data)
    return True


@cache
def png_bomb(width: int, height: int, depth: int, kind: int) -> bytes:
    """A small file that is a large image."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    pack = zlib.compressobj(9)
    row = bytes(width * (3 if kind == 2 else 1) * depth // 8 + 1)
    body = b"".join(pack.compress(row) for _ in range(height)) + pack.flush()
    header = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def image_bomb(path: Path, rng: np.random.Generator) -> bool:
    """A large image, or one of another kind."""
    kind = int(rng.integers(6))
    if kind < 2:
        return _replace(path, png_bomb(20_000, 20_000, *((8, 2), (16, 0))[kind]))
    shape = ((1, 1, 3), (3, 5), (48, 64, 4), (2, 3000, 3))[kind - 2]
    image = rng.integers(0, 255, shape).astype(np.uint8 if rng.random() < 0.5 else np.uint16)
    return _replace(path, cv2.imencode(".png", image)[1].tobytes())


@cache
def zstd_bomb(size: int) -> bytes:
    """A frame of zeros: blocks of one repeated byte, 128 KiB each."""
    count = size >> 17
    blocks = b"".join(
        struct.pack("<I", (1 << 17) << 3 | 2 | (i == count - 1))[:3] + b"\0" for i in range(count)
    )
    return struct.pack("<IBQ", 0xFD2FB528, 0b11100000, size) + blocks


@cache
def lz4_bomb(count: int) -> bytes:
    """A frame of `count` blocks of 4 MB of zeros."""
    import lz4.frame

    kind = {"block_size": lz4.frame.BLOCKSIZE_MAX4MB, "block_linked": False, "store_size": False}
    one = lz4.frame.compress(bytes(4 << 20), **kind)
    return bytes(one[:7]) + bytes(one[7:-4]) * count + bytes(4)


def mcap_rewritten(path: Path, rng: np.random.Generator) -> bool:
    """The same log with right checksums and one thing wrong inside, or a chunk that unpacks to 4 GB."""
    try:
        with path.open("rb") as stream:
            reader = make_reader(stream)
            messages = list(reader.iter_messages(log_time_order=False))
            metadata = [(m.name, m.metadata) for m in reader.iter_metadata()]
            header = reader.get_header()
    except Exception:  # damaged already
        return False
    kind, victim = int(rng.integers(7)), int(rng.integers(len(messages)))
    packing = (CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE)[int(rng.integers(3))]
    path.unlink()
    with path.open("wb") as stream:
        writer = Writer(stream, compression=packing, chunk_size=1 << 16)
        writer.start(profile=header.profile, library=header.library)
        for name, text in metadata:
            writer.add_metadata(name, text)
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for number, (schema, channel, message) in enumerate(messages):
            hit, data, times = number == victim, message.data, (message.log_time, message.publish_time)
            if schema and schema.id not in schemas:
                name, text = schema.name, schema.data
                if hit and kind == 1:
                    text = damaged(text, rng)
                schemas[schema.id] = writer.register_schema(name, schema.encoding, text)
            if channel.id not in channels:
                topic, told = channel.topic, dict(channel.metadata)
                if kind == 2 and rng.random() < 0.3:
                    topic = damaged(topic.encode(), rng).decode(errors="replace")
                if kind == 3 and rng.random() < 0.5:
                    told = {key: damaged(v.encode(), rng).decode(errors="replace") for key, v in told.items()}
                new = schemas.get(channel.schema_id, 0)
                channels[channel.id] = writer.register_channel(topic, channel.message_encoding, new, told)
            if hit and kind in (0, 5, 6):
                data = damaged(data, rng)
            if hit and kind == 4:
                times = (0, 2**63) if rng.random() < 0.5 else (2**64 - 1, 0)
            writer.add_message(channels[channel.id], times[0], data, times[1], message.sequence)
        writer.finish()
    if kind == 6:
        _plant_bomb(path, rng)
    return True


def _plant_bomb(path: Path, rng: np.random.Generator) -> None:
    """Replace the first chunk of a log by one that unpacks to 4 GB. The checksums of the file are left out."""
    data = path.read_bytes()
    at = 8
    while at < len(data) and data[at] != 6:
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    end = at + 9 + struct.unpack_from("<Q", data, at + 1)[0]
    zstd = rng.random() < 0.5
    size = (4 << 30) if rng.random() < 0.5 else 1 << 20
    packed = zstd_bomb(4 << 30) if zstd else lz4_bomb(600)
    name = b"zstd" if zstd else b"lz4"
    body = (
        struct.pack("<QQQII", 0, 2**40, size, 0, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    )
    path.write_bytes(data[:at] + struct.pack("<BQ", 6, len(body)) + body + data[end:])


@cache
def bz2_bomb() -> bytes:
    return bz2.compress(bytes(45_000_000)) * 70


def bag_bomb(path: Path, rng: np.random.Generator) -> bool:
    """The first chunk of a ROS 1 bag unpacks to 3 GB of zeros."""
    data = path.read_bytes()
    at = 13
    while at + 8 < len(data):
        (header,) = struct.unpack_from("<I", data, at)
        (size,) = struct.unpack_from("<I", data, at + 4 + header)
        if b"op=\x05" in data[at : at + 4 + header]:
            break
        at += 8 + header + size
    else:
        return False
    packed, name = (bz2_bomb(), b"bz2") if rng.random() < 0.7 else (lz4_bomb(600), b"lz4")
    fields = [b"op=\x05", b"compression=" + name, b"size=" + struct.pack("<I", 3_000_000_000)]
    head = b"".join(struct.pack("<I", len(f)) + f for f in fields)
    record = struct.pack("<I", len(head)) + head + struct.pack("<I", len(packed)) + packed
    end = at + 8 + header + size
    out = bytearray(data[:at] + record + data[end:])
    place = out.find(b"index_pos=") + 10
    (index,) = struct.unpack_from("<Q", out, place)
    struct.pack_into("<Q", out, place, index + len(record) - (end - at))
    return _replace(path, bytes(out))


STATEMENTS = (
    "update messages set timestamp = -1",
    "update messages set timestamp = 9223372036854775807 where id = 2",
    "update messages set timestamp = 'text' where id = 3",
    "update messages set data = null where id = 2",
    "update messages set data = 'text' where id = 2",
    "update messages set data = zeroblob(50000000) where id = 2",
    "update messages set topic_id = 99",
    "update topics set type = 'sensor_msgs/msg/Nothing'",
    "update topics set type = '../../evil'",
    "update topics set name = '/../../evil'",
    "update topics set serialization_format = 'json'",
    "update topics set offered_qos_profiles = '!!python/object:os.system'",
    "delete from topics where id = 1",
    "drop table messages",
    "alter table messages rename column data to dada",
)


def database(path: Path, rng: np.random.Generator) -> bool:
    """Rows of a ROS 2 bag that no recorder writes."""
    data = path.read_bytes()
    _replace(path, data)
    try:
        with sqlite3.connect(path) as base:
            base.execute(STATEMENTS[int(rng.integers(len(STATEMENTS)))])
        base.close()
    except sqlite3.Error:
        return False
    return True


# --- readers ----------------------------------------------------------------------------------------------------------


def read_back(recording: Path) -> None:
    """Whatever a converter has written must be sound."""
    try:
        opened = Recording(recording)
        for robot in opened.robots:
            with open_rgbd(opened.log(robot)) as log:
                for frame in log.frames():
                    assert np.isfinite(frame.depth).all()
            truth = opened.groundtruth(robot)
            for record in read_log(truth) if truth else ():
                record.message()
    except DuagError as error:
        raise AssertionError(f"written, and not readable: {error}") from error


def converter(name: str, make: Callable[[Path], Path], dataset: str, options: list[str]) -> Reader:
    """A converter by its fixture. make: writes below a folder and returns what to convert."""

    def write(seed: Path) -> None:
        made = make(seed / "data")
        (seed / "which").write_text(made.relative_to(seed).as_posix())

    def read(src: Path, out: Path) -> None:
        # the name itself is ours and stays as it was made
        made = src / _source_of(name)
        converters.convert(dataset, made, out / "rec", options=options)
        read_back(out / "rec")

    def write_and_keep(seed: Path) -> None:
        write(seed)
        _sources[name] = (seed / "which").read_text()
        (seed / "which").unlink()

    return Reader(name, write_and_keep, read, any_special)


_sources: dict[str, str] = {}


def _source_of(name: str) -> str:
    return _sources[name]


def ros_bag(version: int, container: str) -> Callable[[Path], Path]:
    def make(root: Path) -> Path:
        root.mkdir(parents=True)
        r = Ros(version)
        return r.write(root / "bag", scene(r), container)

    return make


def foreign(kind: str) -> Callable[[Path], Path]:
    def make(root: Path) -> Path:
        r = Ros(1 if kind == "ros1" else 2)
        return test_foreign_mcap.write(root / "log.mcap", scene(r), kind, r)

    return make


def kimera(root: Path) -> Path:
    folder = root / "campus_outdoor_1014_compressed"
    folder.mkdir(parents=True)
    r = Ros(1)
    for k, robot in enumerate(("acl_jackal", "sparkal2")):
        rows = test_kimera_multi.bag_rows(r, robot, 0.3 * k, robot)
        r.write(folder / f"10_14_{robot}", rows, "lz4" if k else "plain")
        test_kimera_multi.write_truth(root / "ground_truth" / "1014" / f"{robot}_gt_odom.csv", 0.3 * k)
    return folder


def s3e(root: Path) -> Path:
    sequence = root / "S3E_Playground_2"
    test_s3e.write_bag(sequence, test_s3e.NAMES)
    for name in test_s3e.NAMES:
        test_s3e.write_calibration(root / "Calibration" / f"{name.lower()}.yaml", name.lower())
        test_s3e.write_truth(sequence / f"{name.lower()}_gt.txt", name)
    return sequence


def small_sequence(root: Path) -> Path:
    """Two frames are enough, and each takes a while to register."""
    folder = make_sequence(root / "seq-01")
    for path in folder.iterdir():
        if int(path.name[6:12]) > 1:
            path.unlink()
    return folder


def make_recording(seed: Path) -> None:
    write_recording(seed / "rec", robots=2, frames=4)


def read_recording(src: Path, out: Path) -> None:
    """Everything that opens a recording; each part must end well or with one line."""
    errors = []
    for step in (
        lambda: format_info(info(src / "rec")),
        lambda: checks.check(src / "rec"),
        lambda: [
            list(open_rgbd(Recording(src / "rec").log(r)).frames()) for r in Recording(src / "rec").robots
        ],
        lambda: read_back_of(recovery.recover, src / "rec", out / "saved"),
        lambda: [digest.digest(path) for path in sorted((src / "rec").glob("*.mcap"))],
    ):
        try:
            step()
        except DuagError as error:
            errors.append(error)
    if errors:
        raise errors[0]


def read_back_of(recover: Callable[[Path, Path], object], source: Path, out: Path) -> None:
    """What is recovered must open."""
    recover(source, out)
    saved = Recording(out)
    for robot in saved.robots:
        open_rgbd(saved.log(robot)).close()


def make_scene(kind: str) -> Callable[[Path], None]:
    def make(seed: Path) -> None:
        test_simulate_meshes.folder_of(seed / "scene", kind)

    return make


def read_scene(src: Path, out: Path) -> None:
    from converters.simulate import meshes

    files = meshes.mesh_files(src / "scene")
    (out / "cache").mkdir()
    meshes.read(src / "scene", meshes.up_axis(files, "auto"), out / "cache")
    scene = meshes.load(out / "cache")
    areas = scene.areas()
    assert np.isfinite(areas).all()
    if areas.sum() > 0:
        meshes.surface_points(scene, areas, 1000, np.random.default_rng(0))


CSV_COLUMNS = "robot_src,pose_src,robot_dst,pose_dst,qx,qy,qz,qw,tx,ty,tz,kappa,tau"


def make_g2o(seed: Path) -> None:
    from tests.posegraph.graphs import helix_edges, write_g2o

    write_g2o(seed / "graph.g2o", helix_edges(24))


def make_csv(seed: Path) -> None:
    rows = [f"{r},{i},{r},{i + 1},0,0,0,1,0.{i},0.1,0,100,10000" for r in (0, 1) for i in range(9)]
    rows.append("0,2,1,3,0,0,0,1,0,1,0,100,10000")
    for robot in (0, 1):
        own = [row for row in rows if row.startswith(f"{robot},")]
        (seed / f"robot{robot}").mkdir()
        (seed / f"robot{robot}" / "measurements.csv").write_text("\n".join([CSV_COLUMNS, *own, ""]))


def graph_reader(name: str, make: Callable[[Path], None], file: str, robots: int | None) -> Reader:
    def read(src: Path, out: Path) -> None:
        from pipeline.consensus.graphs import read_team

        read_team(src / file, robots)

    return Reader(name, make, read, _no_special)


def make_config(seed: Path) -> None:
    from pipeline.config import dump
    from pipeline.runner import RunConfig

    (seed / "config.toml").write_text(dump(RunConfig()))


def read_config(src: Path, out: Path) -> None:
    from pipeline.runner import RunConfig

    load(RunConfig, src / "config.toml")


def make_gaussians(seed: Path) -> None:
    from pipeline.splat.ply import write_ply
    from tests.evaluation.fake_run import wall

    write_ply(seed / "map.ply", wall())


def read_gaussians(src: Path, out: Path) -> None:
    from pipeline.splat.ply import read_ply

    read_ply(src / "map.ply")


def make_run(seed: Path) -> None:
    from tests.evaluation import fake_run

    fake_run.make(seed)


def read_run(src: Path, out: Path) -> None:
    """Everything that opens a run but the evaluation, which takes long."""
    from pipeline.inspection import Inspector
    from pipeline.run_folder import RunFolder

    errors = []
    for step in (
        lambda: info(src / "run"),
        lambda: digest.digest(src / "run"),
        lambda: Inspector(RunFolder(src / "run")).round(1),
        lambda: Inspector(RunFolder(src / "run")).packet(2),
        lambda: Inspector(RunFolder(src / "run")).gaussian("alpha", 5),
    ):
        try:
            step()
        except DuagError as error:
            errors.append(error)
    if len(errors) == 5:
        raise errors[0]


def _no_special(path: Path, rng: np.random.Generator) -> bool:
    return False


READERS: dict[str, Reader] = {
    reader.name: reader
    for reader in (
        *(
            converter(name, make, name, options)
            for name, (make, options, *_) in test_image_folders.CASES.items()
        ),
        converter("7scenes", small_sequence, "7scenes", []),
        converter("ros1", ros_bag(1, "plain"), "ros", ["truth=/odom"]),
        converter("ros1-bz2", ros_bag(1, "bz2"), "ros", ["truth=/odom"]),
        converter("ros1-lz4", ros_bag(1, "lz4"), "ros", ["truth=/odom"]),
        converter("ros2-db3", ros_bag(2, "sqlite3"), "ros", ["truth=/odom"]),
        converter("ros2-mcap", ros_bag(2, "mcap"), "ros", ["truth=/odom"]),
        converter("mcap-json", foreign("json"), "ros", []),
        converter("mcap-protobuf", foreign("protobuf"), "ros", []),
        converter("kimera-multi", kimera, "kimera-multi", []),
        converter("s3e", s3e, "s3e", []),
        Reader("recording", make_recording, read_recording, any_special),
        Reader("run", make_run, read_run, any_special),
        Reader("config", make_config, read_config, _no_special),
        graph_reader("g2o", make_g2o, "graph.g2o", 3),
        graph_reader("csv", make_csv, ".", None),
        Reader("map-ply", make_gaussians, read_gaussians, _no_special),
        *(
            Reader(f"scene-{kind}", make_scene(kind), read_scene, any_special)
            for kind in ("glb", "obj", "ply")
        ),
    )
}
