"""Golden runs: make them again, and store or compare what they computed.

    python -m tests.golden.command check [NAME ...]     exit code 3 and a line per difference
    python -m tests.golden.command renew [NAME ...]     store what this version computes

A change of a golden run is made on purpose, in a commit that says why.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from duagc.pipeline.base.determinism import configure_determinism

FOLDER = Path(__file__).parent
EXIT_DIFFERENT = 3


def golden_of(name: str) -> Path:
    """The file of a golden run."""
    return FOLDER / f"{name}.json"


def main() -> None:
    """Make the named runs (default: all) in a temporary folder, then store or compare them."""
    from duagc.pipeline.comparison.golden import differences, store
    from tests.golden.runs import RUNS, make_run

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("action", choices=["check", "renew"])
    parser.add_argument("names", nargs="*", choices=[*RUNS, []], metavar="NAME", help=", ".join(RUNS))
    arguments = parser.parse_args()
    different = False
    for name in arguments.names or RUNS:
        needs = RUNS[name].needs
        if needs is not None and not needs.is_dir():
            line = f"{name}: {needs} not found, which is not distributed with the project"
            if arguments.names:
                sys.exit(line)
            print(f"{line}; left out", flush=True)
            continue
        with tempfile.TemporaryDirectory() as folder:
            run = make_run(name, Path(folder))
            if arguments.action == "renew":
                store(golden_of(name), run)
                continue
            lines = differences(golden_of(name), run)
        print(f"{name}: " + (f"{len(lines)} differences" if lines else "equal"), flush=True)
        for line in lines:
            print(f"  {line}")
        different = different or bool(lines)
    if different:
        sys.exit(EXIT_DIFFERENT)


if __name__ == "__main__":
    configure_determinism()
    main()
