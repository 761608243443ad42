"""The digest of a log: as its writer stated it, and computed from what the log says."""

from __future__ import annotations

from pathlib import Path

from duagc.pipeline.recording.identity import ContentDigest
from duagc.pipeline.recording.names import DIGEST_RECORD
from duagc.pipeline.recording.read import LogFile


def stated_digest(path: Path) -> str | None:
    """The content digest that the writer of a log wrote into it; None if it states none.

    Args:
        path: of the log.
    """
    with LogFile(path) as log:
        return dict(log.metadata()).get(DIGEST_RECORD, {}).get("sha256")


def content_digest(path: Path) -> str:
    """64 hex characters that name what a log says, however its file is chunked and compressed.

    Args:
        path: of the log.

    Raises:
        DuagError: the log is damaged.
    """
    with LogFile(path) as log:
        content = ContentDigest()
        for record in log.records(None):
            identity = log.identities[record.topic]
            content.add(
                identity,
                record.log_time_ns,
                record.publish_time_ns,
                sequence=record.sequence,
                data=record.data,
            )
        channels = [(log.identities[topic], channel.metadata) for topic, channel in log.channels.items()]
        metadata = [(name, text) for name, text in log.metadata() if name != DIGEST_RECORD]
        return content.finish(channels, metadata, log.attachments())
