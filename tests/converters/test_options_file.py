"""Options of converters from a file: all converters, what wins, what recordings say of it, and files that are wrong."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
import tomlkit
from typer.testing import CliRunner

from duagc.converters import registry
from duagc.converters.datasets import seven_scenes
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.cli import app
from tests.fixtures.box_room import path, render, save
from tests.fixtures.dataset_example import CAMERA, DOC
from tests.fixtures.seven_scenes import make_sequence


def convert(*arguments: object) -> None:
    result = CliRunner().invoke(app, ["convert", *map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == 0, result.output


def description(recording: Path) -> dict[str, object]:
    return dict(json.loads((recording / "recording.json").read_text()))


def test_a_file_is_as_good_as_set_and_set_wins(tmp_path: Path) -> None:
    sequence = make_sequence(tmp_path / "seq", frames=2)
    text = '# measured\ncolor_focal_px = 520\nbaseline_m = 0.03\ncolor_distortion = "0.01 0 0 0"\n'
    (tmp_path / "cameras.toml").write_text(text)
    filed = "7scenes", sequence, "--options", tmp_path / "cameras.toml"
    said = ["baseline_m=0.03", "color_distortion=0.01 0 0 0", "color_focal_px=520"]
    sets = [word for option in said for word in ("--set", option)]
    convert(*filed, "--out", tmp_path / "a" / "rec")
    convert("7scenes", sequence, *sets, "--out", tmp_path / "b" / "rec")
    a, b = description(tmp_path / "a" / "rec"), description(tmp_path / "b" / "rec")
    assert a.pop("options_file") == {"name": "cameras.toml", "text": text}
    assert b.pop("options_file") is None
    assert a == b, "digests of the logs too"
    convert(*filed, "--set", "baseline_m=0.02", "--out", tmp_path / "c")
    assert description(tmp_path / "c")["parameters"] == {**a["parameters"], "baseline_m": 0.02}  # type: ignore[dict-item]
    registry.convert("7scenes", sequence, tmp_path / "d")
    assert description(tmp_path / "d")["options_file"] is None, "one conversion's file is not the next one's"


def test_a_converter_of_ones_own_takes_a_file(tmp_path: Path) -> None:
    (code,) = [block.split("```")[0] for block in DOC.read_text().split("```python\n")[1:]]
    (tmp_path / "mine.py").write_text(code)
    src = tmp_path / "walk"
    poses = path(2)
    for k, T in enumerate(poses):
        color, z = render(CAMERA, T)
        save(src / "color" / f"{k:06d}.png", color)
        save(src / "depth" / f"{k:06d}.png", np.rint(z * 1000).astype(np.uint16))
    (src / "camera.txt").write_text("160 120 140 140 79.5 59.5\n")
    np.savetxt(src / "poses.txt", np.reshape(poses, (-1, 16)))
    (tmp_path / "slow.toml").write_text("rate_hz = 10\n")
    convert(tmp_path / "mine.py", src, "--options", tmp_path / "slow.toml", "--out", tmp_path / "rec")
    assert description(tmp_path / "rec")["parameters"]["rate_hz"] == 10  # type: ignore[index]


@pytest.mark.parametrize("dataset", sorted(registry.DATASETS))
def test_every_converter_has_its_options_in_a_file(dataset: str, tmp_path: Path) -> None:
    """All of them at their defaults pass, so that the complaint is about the dataset; an unknown one does not."""
    fields = registry._module(dataset).Options.model_fields
    file = tmp_path / "options.toml"
    file.write_text(tomlkit.dumps({name: field.default for name, field in fields.items()}))
    assert tomllib.loads(file.read_text())
    with pytest.raises(DuagError, match="nothing_here"):
        registry.convert(dataset, tmp_path / "nothing_here" / "seq", tmp_path / "rec", options_file=file)
    file.write_text("focus = 3\n")
    with pytest.raises(
        DuagError, match=rf"options.toml, for {dataset}: focus is no option; expected"
    ) as caught:
        registry.convert(dataset, tmp_path / "nothing_here" / "seq", tmp_path / "rec", options_file=file)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "rec").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("color_focal_px = 520", "nothing_here/seq: no such folder"),  # sound
        (
            "color_focal_px = 0",
            r"wrong.toml, for 7scenes: color_focal_px = 0: expected a number greater than 0",
        ),
        ("color_focal = 520", r"for 7scenes: color_focal is no option; expected perhaps color_focal_"),
        ("[camera]\nfx = 1", r"wrong.toml, for 7scenes: camera is no option"),
        ('color_rotation_rad = "1 2"', "wrong.toml, for 7scenes: color_rotation_rad = '1 2'.*expected 3"),
        ("robots = 2", "wrong.toml, for 7scenes: robots is no option"),
        ("color_focal_px: 520", r"wrong.toml: .*line 1.*expected options of a converter in TOML"),
        (b"\xff\xfe\x00", "wrong.toml: .*expected options of a converter in TOML"),
        (None, "wrong.toml: No such file or directory, expected options of a converter in TOML"),
    ],
)
def test_files_that_are_wrong_are_one_line(tmp_path: Path, content: str | bytes | None, message: str) -> None:
    file = tmp_path / "wrong.toml"
    if content is not None:
        file.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(DuagError, match=message) as caught:
        registry.convert("7scenes", tmp_path / "nothing_here" / "seq", tmp_path / "rec", options_file=file)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "rec").exists()


@pytest.mark.parametrize("option", ["robots=2", "force=true", "out=x", "src=y"])
def test_arguments_are_no_options(tmp_path: Path, option: str) -> None:
    name = option.partition("=")[0]
    with pytest.raises(DuagError, match=f"7scenes: {name} is no option of a converter"):
        registry.convert("7scenes", tmp_path, tmp_path / "rec", options=[option])


def test_the_list_of_datasets_says_what_every_option_is() -> None:
    options = [line.strip() for line in registry.describe().splitlines() if line.startswith(" ")]
    assert len(options) > 50
    assert not [line for line in options if not line.partition("  ")[2]]


def test_datasets_are_listed_without_docstrings(monkeypatch: pytest.MonkeyPatch) -> None:
    """As `python -OO` leaves them."""
    monkeypatch.setattr(seven_scenes, "__doc__", None)
    assert "7scenes: \n    --set frame_limit=0" in registry.describe()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "max_difference_s = true",
            "options.toml, for ros: max_difference_s is true or false, expected a number",
        ),
        (
            f"time_source = '{'x' * 5000}'",
            r"options.toml, for ros: time_source = 'x+ \.\.\.: expected 'header'",
        ),
    ],
)
def test_a_wrong_option_is_said_in_a_short_line(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "options.toml").write_text(text)
    with pytest.raises(DuagError, match=said) as caught:
        registry.convert("ros", tmp_path, tmp_path / "rec", options_file=tmp_path / "options.toml")
    assert len(str(caught.value)) < len(str(tmp_path)) + 300
    assert not (tmp_path / "rec").exists()
