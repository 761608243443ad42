"""Logs that other programs wrote, read alike: bags of ROS 1 and ROS 2, and MCAP of ROS or Foxglove."""

from duagc.converters.logs.entries import Entry, LogTopic
from duagc.converters.logs.files import Log, open_log

__all__ = ["Entry", "Log", "LogTopic", "open_log"]
