"""An agent reads no file and no other robot's data."""

from __future__ import annotations

from pathlib import Path

from tests.test_layers import imports_of

FORBIDDEN = ("truth", "evaluation", "converters", "fusion", "viewer", "report")


def test_an_agent_can_reach_nothing_but_its_own() -> None:
    """Only the session and the replay name other robots' data or read files; the agent's own modules do not."""
    folder = Path(__file__).parents[2] / "pipeline" / "exchange"
    readers = {"session.py", "replay.py", "record.py"}
    for path in sorted(folder.rglob("*.py")):
        names = imports_of(path)
        assert not any(word in name for name in names for word in FORBIDDEN), path.name
        if path.name not in readers:
            assert not any(n.split(".")[0] in ("pathlib", "os", "io", "mcap") for n in names), path.name
            assert not any(
                n.startswith(("duagc.pipeline.recording", "duagc.pipeline.exchange.session")) for n in names
            ), path.name
