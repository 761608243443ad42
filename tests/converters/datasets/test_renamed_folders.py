"""Names of folders are no content: what was renamed makes logs of the same digest."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from duagc.converters import registry
from duagc.pipeline.runs.digest import digest
from tests.fixtures.image_folders import make_aria, make_replica_multiagent
from tests.fixtures.seven_scenes import make_sequence


def make_scene(root: Path) -> Path:
    for number in (1, 2):
        make_sequence(root / "scene" / f"seq-{number:02d}", frames=2)
    return root / "scene"


@pytest.mark.parametrize(
    ("dataset", "make", "options", "renamed"),
    [
        ("replica-multiagent", make_replica_multiagent, ["size=150x85"], "mine_part{}"),
        ("aria-multiagent", make_aria, ["size=128x128"], "agent_1{}"),
        ("7scenes", make_scene, [], "seq-1{}"),
    ],
)
def test_renamed_folders_make_the_same_logs(
    tmp_path: Path, dataset: str, make: Callable[[Path], Path], options: list[str], renamed: str
) -> None:
    src, digests, labels = make(tmp_path), [], []
    for name in ("first", "second"):
        robots = len(list(src.iterdir()))
        registry.convert(dataset, src, tmp_path / name, options=options, robots=robots)
        digests.append(digest(tmp_path / name))
        source = json.loads((tmp_path / name / "recording.json").read_text())["source"]
        labels.append(source.get("parts") or source["sequences"])
        for folder in list(src.iterdir()):
            number = re.findall(r"\d", folder.name)[-1]
            folder.rename(src / renamed.format(number))
        src = src.rename(src.with_name("renamed"))
    assert digests[0] == digests[1]
    assert labels[1] == [renamed.format(re.findall(r"\d", label)[-1]) for label in labels[0]]


def test_a_sequence_is_the_same_in_its_scene_and_alone(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    registry.convert("7scenes", scene / "seq-02", tmp_path / "alone", robots=1)
    registry.convert("7scenes", scene, tmp_path / "chosen", options=["sequences=2"], robots=1)
    assert digest(tmp_path / "alone") == digest(tmp_path / "chosen")
