"""Video in logs: packets of H.264, H.265 or VP9, read as the images that they show.

A picture needs those before it, back to one that needs none. Packets from one such to the next are decoded together,
by the FFmpeg within OpenCV, with the parameters of the stream that came last. H.265 may begin with a picture that needs
none (CRA) while some after it need pictures before it: then these are decoded too. The video of Foxglove and of
`ffmpeg_image_transport` is read.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from types import SimpleNamespace as Fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.converters.logs.entries import Entry, InvalidMessage, raw_image

_CODECS = {"264": "h264", "265": "h265", "hevc": "h265", "vp9": "vp9"}
"""By what the name of a format or of an encoder holds ("h264", "libx264", "hevc_nvenc")."""
_START = b"\x00\x00\x01"
_KEY_UNITS = {"h264": range(5, 6), "h265": range(16, 22)}
"""Types of the units (NAL) of pictures that need no other."""
_PARAMETER_UNITS = {"h264": range(7, 9), "h265": range(32, 35)}
"""Of what a decoder must know of the stream; some encoders send it once."""
_SKIPPED_UNITS = {"h264": range(0), "h265": range(8, 10)}
"""Of pictures that need some before the last one that needs none (RASL)."""


def is_video(kind: str) -> bool:
    """Whether messages of a type are packets of video.

    Args:
        kind: ROS's name of the type.
    """
    return kind.endswith(("/CompressedVideo", "/FFMPEGPacket"))


def images(packets: Iterator[Entry]) -> Iterator[Entry]:
    """The same messages, read as raw images of ROS.

    What cannot be decoded is read as a compressed image of a format that no decoder knows, which says why. A message
    that is no packet stays what it is; packets after it cannot be decoded, up to a picture that needs no other.

    Args:
        packets: messages that `is_video`, of one topic, in order of recording.
    """
    part: list[Entry] = []
    before: list[Entry] = []
    parameters = b""
    for packet in packets:
        is_packet = _is_packet(packet)
        if not is_packet or _begins(packet):
            yield from _Part(part, before, parameters).entries()
            parameters = b"".join(_parameters(p) for p in part) or parameters
            part, before = [], part if part and is_packet and _begins(part[0]) else []
        if is_packet:
            part.append(packet)
        else:
            yield packet
    yield from _Part(part, before, parameters).entries()


class _Part:
    """Packets from a picture that needs no other to the next such; decoded in turn, and again for an earlier one."""

    def __init__(
        self, packets: Sequence[Entry], before: Sequence[Entry] = (), parameters: bytes = b""
    ) -> None:
        """Nothing is decoded.

        Args:
            packets: of the part.
            before: those of the part before it.
            parameters: of the stream, as they came last before the part.
        """
        self._packets, self._parameters = packets, parameters
        skipped = [_is_skipped(packet) for packet in packets]
        lead = [packet for packet in before if not _is_skipped(packet)] if any(skipped) else []
        left = [k for k, late in enumerate(skipped) if lead or not late]
        self._decoded = [*lead, *(packets[k] for k in left)]
        self._number = {k: len(lead) + n for n, k in enumerate(left)}  # among those that are decoded
        self._film: Any = None
        self._next = 0
        self._picture: NDArray[np.uint8] | None = None

    def entries(self) -> Iterator[Entry]:
        """The packets, read as images."""
        for index, packet in enumerate(self._packets):
            yield replace(packet, read=partial(self._read, index))

    def _read(self, index: int) -> Fields:
        """The image of a packet."""
        packet = self._packets[index].read()
        number = self._number.get(index)
        picture = None if self._fault or number is None else self._shown(self._places[number])
        if picture is None:
            missing = "that needs pictures before the first one that needs none"
            why = self._fault or (missing if number is None else "of which a picture cannot be decoded")
            return Fields(header=packet.header, format=f"{_name(packet)} {why}", data=bytes(packet.data))
        return raw_image(packet.header, picture, "bgr8")

    @cached_property
    def _fault(self) -> str:
        """Why the packets have no images; empty if they have."""
        if _codec(self._packets[0].read()) is None:
            return "that is not read"
        if not self._decoded or not _begins(self._decoded[0]):
            return "before a picture that needs no other"
        film, count = self._opened(), 0
        while film.isOpened() and film.grab():
            count += 1
        found, wanted = f"{count} pictures", f"{len(self._decoded)} packets"
        return "" if count == len(self._decoded) else f"with {found} in {wanted}"

    @cached_property
    def _places(self) -> dict[int, int]:
        """Which picture each decoded packet shows: they are shown in order of time, whatever needs which."""
        in_time = sorted(range(len(self._decoded)), key=lambda k: self._decoded[k].header_ns())
        return {number: place for place, number in enumerate(in_time)}

    def _shown(self, place: int) -> NDArray[np.uint8] | None:
        """Colors [h, w, 3] (BGR) of a picture; None if it cannot be decoded."""
        if self._film is None or place < self._next - 1:
            self._film, self._next = self._opened(), 0
        while self._next <= place:
            self._picture = self._film.read()[1]
            self._next += 1
        return self._picture

    def _opened(self) -> Any:
        """A decoder before the first picture."""
        import cv2

        stream: Any = io.BytesIO(self._content)
        return cv2.VideoCapture(stream, cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])

    @cached_property
    def _content(self) -> bytes:
        """The packets as a file: H.264 and H.265 one after another, VP9 in an IVF."""
        packets = [packet.read() for packet in self._decoded]
        found = [bytes(packet.data) for packet in packets]
        if _codec(packets[0]) != "vp9":
            return b"".join(found if _parameters(self._decoded[0]) else [self._parameters, *found])
        numbers = struct.pack("<HHIII", 0, 0, 30, 1, len(found))  # size and rate, which nobody reads
        head = b"DKIF" + struct.pack("<HH", 0, 32) + b"VP90" + numbers + bytes(4)
        return head + b"".join(struct.pack("<IQ", len(data), k) + data for k, data in enumerate(found))


def _is_packet(entry: Entry) -> bool:
    """Whether a message is what its topic says."""
    try:
        entry.read()
        entry.header_ns()
    except InvalidMessage:
        return False
    return True


def _begins(entry: Entry) -> bool:
    """Whether a packet holds a picture that needs no other."""
    packet = entry.read()
    codec, data = _codec(packet), bytes(packet.data)
    if codec is None:
        return False
    if codec == "vp9":  # bits: 10, profile, shows an old picture, needs others
        return bool(data) and data[0] >> 6 == 2 and not data[0] & 0b1100
    return any(kind in _KEY_UNITS[codec] for kind, _ in _units(codec, data))


def _is_skipped(entry: Entry) -> bool:
    """Whether a packet holds a picture that cannot be shown if decoding begins with its part."""
    packet = entry.read()
    codec = _codec(packet)
    return codec in _SKIPPED_UNITS and any(
        kind in _SKIPPED_UNITS[codec] for kind, _ in _units(codec, bytes(packet.data))
    )


def _parameters(entry: Entry) -> bytes:
    """What a packet says of the stream; empty: nothing, or in every picture that needs no other."""
    packet = entry.read()
    codec = _codec(packet)
    if codec not in _PARAMETER_UNITS:
        return b""
    units = _units(codec, bytes(packet.data))
    return b"".join(unit for kind, unit in units if kind in _PARAMETER_UNITS[codec])


def _units(codec: str, data: bytes) -> Iterator[tuple[int, bytes]]:
    """Types of the units (NAL) of a packet of H.264 or H.265, and their bytes with the code that begins them."""
    shift, mask = (0, 31) if codec == "h264" else (1, 63)
    at = data.find(_START)
    while 0 <= at < len(data) - len(_START):
        after = data.find(_START, at + len(_START))
        yield data[at + len(_START)] >> shift & mask, data[at : after if after >= 0 else len(data)]
        at = after


def _name(packet: Any) -> str:
    """What a packet says of its format."""
    return str(packet.format if hasattr(packet, "format") else packet.encoding)


def _codec(packet: Any) -> str | None:
    """The codec of a packet; None if it is not read."""
    return next((codec for word, codec in _CODECS.items() if word in _name(packet).lower()), None)
