"""Every converter's fixture becomes a recording that passes the check."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from duagc.converters import registry
from duagc.pipeline.checks import check
from tests.fixtures.image_folders import CASES
from tests.fixtures.ros_bags import Ros, scene
from tests.fixtures.seven_scenes import make_sequence
from tests.fuzz.seeds import kimera, s3e


def ros_bag(version: int, container: str) -> Callable[[Path], Path]:
    def make(root: Path) -> Path:
        root.mkdir()
        r = Ros(version)
        return r.write(root / "bag", scene(r), container)

    return make


# name: dataset, how its fixture is made, options
FIXTURES: dict[str, tuple[str, Callable[[Path], Path], list[str]]] = {
    **{name: (name, make, options) for name, (make, options, _, _) in CASES.items()},
    "s3e": ("s3e", s3e, []),
    "kimera-multi": ("kimera-multi", kimera, []),
    "7scenes": ("7scenes", lambda root: make_sequence(root / "seq-01"), []),
    "ros1": ("ros", ros_bag(1, "plain"), ["truth=/odom"]),
    "ros2": ("ros", ros_bag(2, "sqlite3"), ["truth=/odom"]),
}


SLOW = ("tum", "bonn", "icl-nuim", "7scenes", "kimera-multi")  # seconds of rendering and registering each


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in FIXTURES]
)
def test_fixtures_pass(tmp_path: Path, name: str) -> None:
    dataset, make, options = FIXTURES[name]
    registry.convert(dataset, make(tmp_path / "data"), tmp_path / "recording", options=options)
    report = check.check(tmp_path / "recording")
    alarms = report.of(check.Severity.ERROR) + report.of(check.Severity.WARNING)
    # some fixtures fly round their room, in few large steps; of some the last depth image is late
    known = ("m/s", "could be registered", "5 depth images for 6 color images")
    assert all(any(words in f.found for words in known) for f in alarms), check.format_report(report)
    assert report.sound
