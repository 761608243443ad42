"""Names and numbers that writers and readers of logs share."""

import os
from pathlib import Path

from duagc import __version__

MAGIC = b"\x89MCAP0\r\n"
LIBRARY = f"duagc/{__version__}"
DIGEST_RECORD = "duagc.digest"  # metadata record with the content digest; itself not part of it
LOG_RECORD = "duagc.log"  # metadata record with what was given to the writer
ROBOT_KEY = "robot"
DEPTH_SCALE_KEY = "depth_scale"
RECORDING_FILE = "recording.json"
RECORDING_FORMAT = "duagc.recording"
RECORDING_SCHEMA = 1
RANGE_SIGMA_KEY = "range_sigma"  # channel metadata of a LiDAR: standard deviation of its ranges, m


def is_mcap(path: Path) -> bool:
    """Whether a file begins or ends as MCAP does, whatever else is wrong with it.

    Args:
        path: of the file.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as stream:
        head = stream.read(len(MAGIC))
        stream.seek(-len(head), os.SEEK_END)
        return MAGIC in (head, stream.read())
