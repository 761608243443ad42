"""Logs in, logs out: MCAP files that are checked whole before they are used, and the recordings made of them.

Order of a log: by log time, then by position in the file. `log_time` is when a message was received, `publish_time`
when it was produced, `sequence` counts per topic from 0; all in the time of the recording, never the wall clock.
The identity of a log is its content digest: the bytes of the file depend on the version of the compressor.
"""

from duagc.pipeline.recording.exposures import read_exposures
from duagc.pipeline.recording.folder import Recording
from duagc.pipeline.recording.log_checksums import verify
from duagc.pipeline.recording.log_digest import content_digest, stated_digest
from duagc.pipeline.recording.motion import Motion, MotionPrior
from duagc.pipeline.recording.names import (
    DEPTH_SCALE_KEY,
    RANGE_SIGMA_KEY,
    RECORDING_FILE,
    RECORDING_FORMAT,
    RECORDING_SCHEMA,
)
from duagc.pipeline.recording.read import Record, log_metadata, merge, read_log
from duagc.pipeline.recording.rgbd import RgbdLog, open_rgbd
from duagc.pipeline.recording.rgbd_frame import RgbdFrame
from duagc.pipeline.recording.summary import format_info, info, write_preview_of
from duagc.pipeline.recording.write import LogWriter

__all__ = [
    "DEPTH_SCALE_KEY",
    "RANGE_SIGMA_KEY",
    "RECORDING_FILE",
    "RECORDING_FORMAT",
    "RECORDING_SCHEMA",
    "LogWriter",
    "Motion",
    "MotionPrior",
    "Record",
    "Recording",
    "RgbdFrame",
    "RgbdLog",
    "content_digest",
    "format_info",
    "info",
    "log_metadata",
    "merge",
    "open_rgbd",
    "read_exposures",
    "read_log",
    "stated_digest",
    "verify",
    "write_preview_of",
]
