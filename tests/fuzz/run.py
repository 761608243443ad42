"""Runs readers on damaged files, within limits of memory and time.

    python -m tests.fuzz.run --count 5000 [READER ...]        # all of them by default

A reader may end with one error line (`DuagError`), or with a result that reads back whole. Everything else is a
failure: another exception, a signal, more memory or time, waiting, a file left open, a file outside its output folder,
a changed input.
"""

from __future__ import annotations

import argparse
import re
import resource
import sys
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.fuzz.cases import Outcome


@dataclass
class Tally:
    """Of many cases of a reader: how many ended how, by which lines they were refused, one text for each failure."""

    kinds: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    failures: dict[str, str] = field(default_factory=dict)

    def add(self, reader: str, outcome: Outcome) -> None:
        """Count one."""
        self.kinds[outcome.kind] += 1
        if outcome.kind == "refused":
            self.reasons[reason(outcome.text)] += 1
        elif outcome.kind == "failed":
            place = [line for line in outcome.text.splitlines() if line.startswith('  File "')][-1:]
            key = outcome.text.splitlines()[-1][:60] + "".join(place) if outcome.text else "?"
            self.failures.setdefault(key, f"{reader} {outcome.number} ({outcome.what}): {outcome.text}")


def reason(line: str) -> str:
    """An error line without what changes from case to case: names, numbers, what stands in quotes."""
    line = re.sub(r"\S*/case-\d+\S*", "PATH", line)
    line = re.sub(r"(?<!\w)(b?['\"]).*['\"]", "'...'", line)
    return re.sub(r"[\w.+-]*\d[\w.+-]*|\b(nan|inf)\b", "#", line)[:100]


def main() -> int:
    from duagc.pipeline.base import determinism

    determinism.configure_determinism()  # before OpenCV is imported: it reads its limit of pixels then
    from tests.fuzz import seeds
    from tests.fuzz.cases import cases
    from tests.fuzz.readers import READERS

    seeds.shrink()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("readers", nargs="*", default=sorted(READERS))
    parser.add_argument("--count", type=int, default=5000)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--echo", action="store_true", help="print every case")
    parser.add_argument(
        "--reasons", type=int, default=0, help="print so many of the reasons to refuse a file"
    )
    arguments = parser.parse_args()
    failed = 0
    for name in arguments.readers:
        spent, tally = _cpu_s(), Tally()
        for outcome in cases(READERS[name], arguments.count, arguments.first):
            tally.add(name, outcome)
            if arguments.echo:
                print(outcome.number, outcome.kind, outcome.what, outcome.text[-150:])
        kinds = ", ".join(f"{tally.kinds[kind]} {kind}" for kind in ("read", "refused", "failed"))
        commonest = max(tally.reasons.values(), default=0) / max(tally.kinds["refused"], 1)
        print(
            f"{name}: {kinds}, for {len(tally.reasons)} reasons, the commonest {commonest:.0%}; "
            f"{_cpu_s() - spent:.0f} s of CPU",
            flush=True,
        )
        for line, times in tally.reasons.most_common(arguments.reasons):
            print(f"    {times:5d} {line}")
        for text in tally.failures.values():
            print(text, flush=True)
        failed += tally.kinds["failed"]
    return 1 if failed else 0


def _cpu_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


if __name__ == "__main__":
    sys.exit(main())
