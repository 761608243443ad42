"""Color as video: every packet is read as the image that it shows, or says why it has none."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.writer import Writer
from numpy.typing import NDArray

from duagc.converters import registry
from duagc.converters.layouts.ros_images import is_unusable
from duagc.converters.logs import open_log
from duagc.converters.logs.definitions import OF_DRIVERS
from duagc.converters.logs.entries import Entry, InvalidMessage, stamp_ns
from duagc.converters.logs.video import images
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.recording import open_rgbd
from tests.fixtures import foreign_mcap, h265_packets
from tests.fixtures.foreign_mcap import Row, encoded, write
from tests.fixtures.ros_bags import STEP_NS, Ros, scene
from tests.fixtures.video_packets import Planes, packets, planes_of, shown

COLOR = "/camera/color/image_raw"
NEAR = 4  # of 255: the decoder computes colors with fewer digits


def colors_of(rows: list[Row]) -> list[NDArray[np.uint8]]:
    """Images [h, w, 3] (RGB) of the color of a log."""
    return [
        np.asarray(m.data).reshape(m.height, m.step)[:, : 3 * m.width].reshape(m.height, m.width, 3)
        for topic, _, m in rows
        if topic == COLOR
    ]


def as_video(rows: list[Row], film: list[bytes], r: Ros, kind: str, name: str = "h264") -> list[Row]:
    """The same log with packets in place of images."""
    if kind == "FFMPEGPacket":
        from rosbags.typesys import get_types_from_msg

        name_of_type = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
        r.store.register(get_types_from_msg(OF_DRIVERS[name_of_type], name_of_type))
    left, found = list(film), list[Row]()
    for topic, log_ns, m in rows:
        if topic != COLOR:
            found.append((topic, log_ns, m))
        elif left:
            data = np.frombuffer(left.pop(0), np.uint8)
            message = SimpleNamespace(
                __msgtype__="foxglove_msgs/msg/CompressedVideo", header=m.header, format=name, data=data
            )
            if kind == "FFMPEGPacket":
                message = r.make(
                    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
                    header=m.header,
                    width=m.width,
                    height=m.height,
                    encoding=name,
                    pts=0,
                    flags=0,
                    is_bigendian=False,
                    data=data,
                )
            found.append(("/camera/color/video", log_ns, message))
    return found


@pytest.mark.parametrize(
    ("kind", "name", "every"),
    [("protobuf", "h264", 3), ("json", "h264", 1), ("FFMPEGPacket", "libx264;yuv420p;bgr8", 99)],
)
def test_a_log_with_video_is_the_log_with_its_images(
    tmp_path: Path, kind: str, name: str, every: int
) -> None:
    r = Ros(2)
    rows = scene(r)
    planes = [planes_of(color) for color in colors_of(rows)]
    video = as_video(rows, packets(planes, every), r, kind, name)
    log = write(tmp_path / "log.mcap", video, "cdr" if kind == "FFMPEGPacket" else kind, r)
    registry.convert("ros", log, tmp_path / "rec", options=["truth=/odom"])
    left = list(planes)
    raw = [
        (
            topic,
            t,
            r.image(stamp_ns(m), m.header.frame_id, shown(left.pop(0)), "rgb8") if topic == COLOR else m,
        )
        for topic, t, m in rows
    ]
    plain_log = write(tmp_path / "plain.mcap", raw, "cdr", r)
    registry.convert("ros", plain_log, tmp_path / "plain", options=["truth=/odom"])
    with (
        open_rgbd(tmp_path / "rec" / "alpha.mcap") as found,
        open_rgbd(tmp_path / "plain" / "alpha.mcap") as plain,
    ):
        assert len(found) == len(plain) == len(planes)
        for index in range(len(planes)):
            frame, same = found.frame(index), plain.frame(index)
            assert frame.stamp_ns == same.stamp_ns
            np.testing.assert_array_equal(frame.depth, same.depth)
            assert np.abs(frame.color.astype(int) - same.color).max() <= NEAR


def entries_of(film: list[bytes], name: str = "h264", order: list[int] | None = None) -> list[Entry]:
    """Packets; order: of the times in their headers."""

    def entry(index: int, data: bytes) -> Entry:
        stamp = (order or list(range(len(film))))[index]
        header = SimpleNamespace(stamp=SimpleNamespace(sec=stamp, nanosec=0))
        packet = SimpleNamespace(header=header, format=name, data=data)
        return Entry("/video", index, None, data, lambda: packet, lambda: stamp * 10**9)

    return [entry(index, data) for index, data in enumerate(film)]


@pytest.fixture(scope="module")
def film() -> list[NDArray[np.uint8]]:
    """Seven images [48, 36, 3] (RGB), of which no side is a whole number of macroblocks."""
    random = np.random.default_rng(3)
    start = cv2.resize(random.integers(0, 255, (6, 5, 3)).astype(np.uint8), (36, 48))
    images = []
    for index in range(7):
        image = np.asarray(start).copy()
        image[4:20, 4 * index : 4 * index + 10] = (30, 220, 140)
        images.append(image)
    return images


def picture(message: Any) -> NDArray[np.int64]:
    """Colors [h, w, 3] (RGB) of a raw image."""
    return np.asarray(message.data).reshape(message.height, message.width, 3)[..., ::-1].astype(np.int64)


@pytest.mark.parametrize(("name", "encoded"), [("h264", packets), ("hevc_vaapi", h265_packets.packets)])
def test_images_may_be_read_in_any_order(
    film: list[NDArray[np.uint8]], name: str, encoded: Callable[[list[Planes], int], list[bytes]]
) -> None:
    planes = [planes_of(image) for image in film]
    found = list(images(iter(entries_of(encoded(planes, 4), name))))
    for index in (0, 1, 5, 6, 2, 2, 6, 0, 3):
        difference = np.abs(picture(found[index].read()) - shown(planes[index]))
        assert difference.max() <= NEAR, index


def test_what_comes_before_the_first_whole_picture_is_unusable(film: list[NDArray[np.uint8]]) -> None:
    planes = [planes_of(image) for image in film]
    found = list(images(iter(entries_of(packets(planes, 4)[1:]))))
    assert [is_unusable(entry.read()) for entry in found] == [True] * 3 + [False] * 3
    assert found[0].read().format == "h264 before a picture that needs no other"


def test_a_part_that_lost_a_picture_is_unusable_and_the_next_is_not(film: list[NDArray[np.uint8]]) -> None:
    whole = packets([planes_of(image) for image in film], 4)
    whole[2] = b"\x00\x00\x00\x01\x09\xf0"  # begins a picture of which nothing follows
    found = list(images(iter(entries_of(whole))))
    assert [is_unusable(entry.read()) for entry in found] == [True] * 4 + [False] * 3
    assert found[0].read().format == "h264 with 3 pictures in 4 packets"


@pytest.mark.parametrize("place", [0, 2, 4, 6])
def test_a_message_that_is_no_packet_costs_what_needs_it(film: list[NDArray[np.uint8]], place: int) -> None:
    planes = [planes_of(image) for image in film]
    entries = entries_of(packets(planes, 4))

    def refuse() -> None:
        raise InvalidMessage("log: /video", "holds 3 bytes that are no packet")

    entries[place] = replace(entries[place], read=refuse, header_ns=refuse)
    found = list(images(iter(entries)))
    assert [entry.log_ns for entry in found] == list(range(7))
    needing = [k for k in range(7) if k // 4 == place // 4 and k > place]
    for index, entry in enumerate(found):
        if index == place:
            with pytest.raises(InvalidMessage, match="no packet"):
                entry.read()
        elif index in needing:
            assert entry.read().format == "h264 before a picture that needs no other"
        else:
            assert np.abs(picture(entry.read()) - shown(planes[index])).max() <= NEAR, index


@pytest.mark.parametrize("kind", ["protobuf", "json", "cdr"])
def test_a_log_with_a_packet_that_is_none_is_converted(tmp_path: Path, kind: str) -> None:
    r = Ros(2)
    rows = scene(r)
    film = packets([planes_of(color) for color in colors_of(rows)], 2)
    name = "FFMPEGPacket" if kind == "cdr" else kind
    video = as_video(rows, film, r, name)

    def cut(message: Any, *how: Any) -> Any:
        parts = encoded(message, *how)
        is_third = "video" in parts[0].lower() or "FFMPEG" in parts[0]
        cut.seen += is_third  # type: ignore[attr-defined]
        return (*parts[:3], parts[3][:7]) if is_third and cut.seen == 3 else parts  # type: ignore[attr-defined]

    cut.seen = 0  # type: ignore[attr-defined]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(foreign_mcap, "encoded", cut)
        log = write(tmp_path / "log.mcap", video, kind, r)
    registry.convert("ros", log, tmp_path / "rec")
    found = json.loads((tmp_path / "rec" / "recording.json").read_text())
    at = next(t for topic, t, _ in video[::-1] if topic.endswith("video")) - STEP_NS
    start = f"alpha: /camera/color/video: 1 of 4 messages left out; the first, recorded at {at / 1e9:.3f} s, holds 7 "
    assert [warning for warning in found["warnings"] if warning.startswith(start)], found["warnings"]
    assert found["robots"]["alpha"]["frames"] == 2  # the fourth needs the third


def test_h265_that_begins_between_pictures_that_need_none(film: list[NDArray[np.uint8]]) -> None:
    """What needs pictures before the beginning is not shown; what follows the first one that needs none is."""
    planes = [planes_of(image) for image in (*film, *film[::-1])]
    coded = h265_packets.open_packets(planes, 4)
    data, order = [data for _, data in coded], [place for place, _ in coded]
    found = list(images(iter(entries_of(data[2:], "hevc", order[2:]))))
    needed = [packet.read() for packet in found]
    assert [is_unusable(message) for message in needed] == [True, True, False, True, *[False] * 8]
    for index in (2, 4, 6, 7, 11):
        shows = order[2 + index]
        assert np.abs(picture(needed[index]) - shown(planes[shows])).max() <= NEAR, index


def test_pictures_are_shown_in_order_of_time(film: list[NDArray[np.uint8]]) -> None:
    """The times in the headers are those of the images, packets come as the decoder needs them."""
    planes = [planes_of(image) for image in film[:3]]
    found = list(images(iter(entries_of(packets(planes, 3), order=[0, 2, 1]))))
    for index, shows in enumerate((0, 2, 1)):
        assert np.abs(picture(found[index].read()) - shown(planes[shows])).max() <= NEAR


def test_vp9(tmp_path: Path, film: list[NDArray[np.uint8]]) -> None:
    path = tmp_path / "film.ivf"
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"VP90"), 30.0, (36, 48))
    assert writer.isOpened()
    for image in film:
        writer.write(np.ascontiguousarray(image[..., ::-1]))
    writer.release()
    content, at, film_packets = path.read_bytes(), 32, []
    while at < len(content):
        (size,) = struct.unpack_from("<I", content, at)
        film_packets.append(content[at + 12 : at + 12 + size])
        at += 12 + size
    assert len(film_packets) == len(film)
    found = list(images(iter(entries_of(film_packets, "vp9"))))
    errors = [np.abs(picture(e.read()) - image).mean() for e, image in zip(found, film, strict=True)]
    assert max(errors) < 12  # lossy
    wrong = [np.abs(picture(found[0].read()) - image).mean() for image in film[2:]]
    assert min(wrong) > 1.5 * errors[0]


def test_parameters_of_the_stream_may_come_once(film: list[NDArray[np.uint8]]) -> None:
    planes = [planes_of(image) for image in film]
    whole = packets(planes, 2)
    start = b"\x00\x00\x00\x01"
    units = [[start + unit for unit in data.split(start)[1:]] for data in whole]
    assert all([unit[4] & 31 for unit in found[:-1]] == [7, 8] for found in units[::2])
    once = [whole[0], *(found[-1] for found in units[1:])]
    for first in (0, 3):  # whatever begins a topic is not read for want of them, what follows is
        found = list(images(iter(entries_of(once[first:]))))
        assert [is_unusable(entry.read()) for entry in found] == [first > 0] * len(found)
    found = list(images(iter(entries_of(once))))
    for index in (6, 0, 3, 5):
        assert np.abs(picture(found[index].read()) - shown(planes[index])).max() <= NEAR, index


def test_h265_pictures_may_need_some_before_the_one_that_needs_none(film: list[NDArray[np.uint8]]) -> None:
    planes = [planes_of(image) for image in (*film, *film[::-1])]
    coded = h265_packets.open_packets(planes, 4)
    assert [place for place, _ in coded] == [0, 1, 2, 3, 5, 4, 6, 7, 9, 8, 10, 11, 13, 12]
    data, order = [data for _, data in coded], [place for place, _ in coded]
    found = list(images(iter(entries_of(data, "hevc", order))))
    for index in (0, 5, 4, 13, 9, 8, 1):
        assert np.abs(picture(found[index].read()) - shown(planes[order[index]])).max() <= NEAR, index
    late = list(images(iter(entries_of(data[4:], "hevc", order[4:]))))  # 4 needs what is not there
    assert [is_unusable(entry.read()) for entry in late] == [False, True, *[False] * 8]
    assert late[1].read().format == "hevc that needs pictures before the first one that needs none"
    for index in (0, 2, 4, 5):
        shows = order[4 + index]
        assert np.abs(picture(late[index].read()) - shown(planes[shows])).max() <= NEAR, index


def test_h265_may_begin_with_a_picture_that_others_may_follow_into() -> None:
    """Which units begin a part; not all of them stand here as a decoder wants them."""
    units = {"parameters": 32, "clean": 21, "part": 1}
    film = [
        b"".join(b"\x00\x00\x01" + bytes([units[name] << 1, 1, 7]) for name in names.split())
        for names in ("part", "parameters clean", "part", "clean", "part")
    ]
    found = [entry.read().format for entry in images(iter(entries_of(film, "hevc_nvenc")))]
    assert found == [
        "hevc_nvenc before a picture that needs no other",
        *["hevc_nvenc with 0 pictures in 2 packets"] * 4,
    ]


def test_video_that_is_not_read_is_refused_by_its_format(tmp_path: Path) -> None:
    r = Ros(2)
    rows = scene(r)
    log = write(tmp_path / "log.mcap", as_video(rows, [b"x"] * 3, r, "protobuf", "av1"), "protobuf", r)
    with pytest.raises(DuagError, match=r"/camera/color/video: 1 bytes of format 'av1 that is not read'"):
        registry.convert("ros", log, tmp_path / "rec")


def test_images_count_before_video_of_them(tmp_path: Path) -> None:
    r = Ros(2)
    rows = scene(r)
    video = [row for row in as_video(rows, [b"x"] * 3, r, "protobuf", "av1") if row[0].endswith("video")]
    log = write(tmp_path / "log.mcap", rows + video, "protobuf", r)
    registry.convert("ros", log, tmp_path / "rec")
    with open_log([log]) as opened:
        assert opened.topics["/camera/color/video"].count == 3


@pytest.mark.parametrize("left", ["nothing", "depth", "all"])
def test_video_whose_messages_cannot_be_read_is_named_where_images_lack(tmp_path: Path, left: str) -> None:
    """What nobody can read does not stand in the way of images that can be."""
    r = Ros(2)
    path = tmp_path / "log.mcap"
    rows = [] if left == "nothing" else [row for row in scene(r) if left == "all" or row[0] != COLOR]
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedVideo", "protobuf", b"")
        writer.add_message(writer.register_channel("/cam/video", "protobuf", schema), 1, b"x", 1)
        for topic, log_ns, message in rows:
            name, encoding, text, data = encoded(message, "cdr", r)
            number = writer.register_channel(topic, "cdr", writer.register_schema(name, encoding, text))
            writer.add_message(number, log_ns, data, log_ns)
        writer.finish()
    if left == "all":
        registry.convert("ros", path, tmp_path / "rec")
        return
    with pytest.raises(DuagError, match=r"/cam/video holds 1 bytes that are no foxglove.CompressedVideo"):
        registry.convert("ros", path, tmp_path / "rec")
