"""Golden runs: make them again, and store or compare what they computed.

    python -m tests.golden.command check [NAME ...]     exit code 3 and a line per difference
    python -m tests.golden.command renew [NAME ...]     store what this version computes

A change of a golden run is made on purpose, in a commit that says why.
"""

import argparse
import json
import operator
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from duagc.pipeline.base.determinism import configure_determinism

FOLDER = Path(__file__).parent
EXIT_DIFFERENT = 3
RELATIVE_TOLERANCE = 1e-9  # of metrics: evaluation sums in one order, but its libraries may round otherwise


def store(name: str, run: Path) -> None:
    """Write `<name>.json`, for people, and `<name>.npz`, 16 bits a message."""
    import numpy as np

    from tests.golden.runs import metrics_of
    from tests.golden.summary import summarize

    found = summarize(run)
    content = {
        "digest": found.digest,
        "files": found.files,
        "topics": {
            file: {
                topic: {"schema": t.schema, "messages": len(t.messages), "fields": t.fields}
                for (of_file, topic), t in found.topics.items()
                if of_file == file
            }
            for file in dict.fromkeys(file for file, _ in found.topics)
        },
        "metadata": found.metadata,
        "metrics": metrics_of(run),
    }
    (FOLDER / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n")
    arrays = {f"{file} {topic}": t.messages for (file, topic), t in found.topics.items()}
    np.savez_compressed(FOLDER / f"{name}.npz", **arrays)


def differences(name: str, run: Path) -> list[str]:
    """One line for every topic, metadata, file and metric that differs from what is stored; earlier stages first."""
    import numpy as np

    from tests.golden.runs import metrics_of
    from tests.golden.summary import RunSummary, TopicSummary, stage_of, summarize

    content = json.loads((FOLDER / f"{name}.json").read_text())
    with np.load(FOLDER / f"{name}.npz") as arrays:
        topics = {
            (file, topic): TopicSummary(stored["schema"], stored["fields"], arrays[f"{file} {topic}"])
            for file, of_file in content["topics"].items()
            for topic, stored in of_file.items()
        }
    stored = RunSummary(content["digest"], content["files"], topics, content.get("metadata", {}))
    found = summarize(run)
    order = ["frontend", "information", "exchange", "fusion"]
    files = sorted({*stored.files, *found.files}, key=lambda file: (order.index(stage_of(file)), file))
    lines = []
    for file in files:
        if stored.files.get(file) == found.files.get(file):
            continue
        where = f"{stage_of(file)}: {file}"
        named = sorted({topic for f, topic in {**stored.topics, **found.topics} if f == file})
        of_topics = [
            f"{where}: {line}"
            for topic in named
            if (
                line := _topic_difference(
                    topic, stored.topics.get((file, topic)), found.topics.get((file, topic))
                )
            )
        ]
        of_metadata = [
            f"{where}: metadata {line}"
            for line in _table_differences(stored.metadata.get(file, {}), found.metadata.get(file, {}))
        ]
        lines += (of_topics + of_metadata) or [
            f"{where}: digest {found.files.get(file, 'absent')}, stored {stored.files.get(file, 'absent')}"
        ]
    return lines + _metric_differences(content["metrics"], metrics_of(run))


def _topic_difference(topic: str, stored: Any, found: Any) -> str | None:
    """One line about one topic (`TopicSummary` or None), or None if it is the same."""
    if stored is None or found is None:
        return f"{topic}: {'not stored' if stored is None else 'not found'}"
    both = min(len(stored.messages), len(found.messages))
    unequal = (stored.messages[:both] != found.messages[:both]).nonzero()[0]
    names = {**stored.fields, **found.fields}
    fields = [f for f in names if stored.fields.get(f) != found.fields.get(f)]
    if len(stored.messages) == len(found.messages) and not fields and stored.schema == found.schema:
        return None
    parts = [topic]
    if stored.schema != found.schema:
        parts.append(f"schema {found.schema}, stored {stored.schema}")
    if len(stored.messages) != len(found.messages):
        parts.append(f"{len(found.messages)} messages, stored {len(stored.messages)}")
    first = int(unequal[0]) if len(unequal) else both
    if first < len(found.messages):
        parts.append(f"first message that differs: {first} at {found.times_ns[first]} ns")
    if fields:
        parts.append(f"fields {', '.join(fields)}")
    return "; ".join(parts)


def _metric_differences(stored: dict[str, object], found: dict[str, object]) -> list[str]:
    def close(old: object, new: object) -> bool:
        if isinstance(old, float) and isinstance(new, float):
            return old == new or abs(new - old) <= RELATIVE_TOLERANCE * abs(old)
        return old == new

    return [f"evaluation: {line}" for line in _table_differences(stored, found, close)]


def _table_differences(
    stored: Mapping[str, object],
    found: Mapping[str, object],
    same: Callable[[object, object], bool] = operator.eq,
) -> list[str]:
    """One line for every name whose value differs."""

    def text(table: Mapping[str, object], name: str) -> str:
        value = table.get(name, "absent")
        return f"{value:.9g}" if isinstance(value, float) else repr(value)

    return [
        f"{name}: {text(found, name)}, stored {text(stored, name)}"
        for name in sorted({*stored, *found})
        if not same(stored.get(name, "absent"), found.get(name, "absent"))
    ]


def main() -> None:
    """Make the named runs (default: all) in a temporary folder, then store or compare them."""
    from tests.golden.runs import RUNS, make_run

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("action", choices=["check", "renew"])
    parser.add_argument("names", nargs="*", choices=[*RUNS, []], metavar="NAME", help=", ".join(RUNS))
    arguments = parser.parse_args()
    different = False
    for name in arguments.names or RUNS:
        with tempfile.TemporaryDirectory() as folder:
            run = make_run(name, Path(folder))
            if arguments.action == "renew":
                store(name, run)
                continue
            lines = differences(name, run)
        print(f"{name}: " + (f"{len(lines)} differences" if lines else "equal"), flush=True)
        for line in lines:
            print(f"  {line}")
        different = different or bool(lines)
    if different:
        sys.exit(EXIT_DIFFERENT)


if __name__ == "__main__":
    configure_determinism()
    main()
