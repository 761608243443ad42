"""Logs that other programs wrote, read alike: bags of ROS 1 and ROS 2, and MCAP of ROS or Foxglove."""

from converters.logs.entries import Entry, Topic
from converters.logs.files import Log, open_log

__all__ = ["Entry", "Log", "Topic", "open_log"]
