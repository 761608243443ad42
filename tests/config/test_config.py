"""Configuration files: round trip, overrides, and errors that name what is wrong."""

import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import get_args

import pytest

from duagc.converters.registry import DATASETS
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.batch.suite import SuiteFile
from duagc.pipeline.comparison.tolerances import Tolerance
from duagc.pipeline.config.base import Config, differing_settings, dump_config, load_config
from duagc.pipeline.config.checks import ChecksConfig
from duagc.pipeline.config.network import LinkConfig
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.experiments.rule import ExperimentFile


class Link(Config):
    """A link between two robots."""

    loss_probability: float = 0.0
    """Per packet, independent."""

    name: str = "radio"
    """What it is called."""


class Whole(Config):
    """All of it."""

    seed: int = 0
    """Of every random stream."""

    link: Link = Link()


def test_dump_and_load_round_trip(tmp_path: Path) -> None:
    config = Whole(seed=7, link=Link(loss_probability=0.25))
    text = dump_config(config)
    assert "# Per packet, independent." in text
    (tmp_path / "c.toml").write_text(text)
    assert load_config(Whole, tmp_path / "c.toml") == config


def optional_settings() -> list[tuple[type[Config], str]]:
    """Settings that may be None, of every section: of runs, checks, converters, experiments, suites and tolerances."""
    for module in DATASETS.values():
        import_module(module)
    found: list[tuple[type[Config], str]] = []
    classes: list[type[Config]] = [RunConfig, ChecksConfig, ExperimentFile, SuiteFile, Tolerance, Config]
    for kind in classes:
        classes += [
            c for c in kind.__subclasses__() if c.__module__.startswith("duagc.") and c not in classes
        ]
        found += [
            (kind, n) for n, field in kind.model_fields.items() if type(None) in get_args(field.annotation)
        ]
    return found


def test_a_setting_that_may_be_none_is_none_by_default() -> None:
    """TOML has no null: a setting that is left out has its default, so only such a None is read as it was written."""
    optional = optional_settings()
    assert len({kind for kind, _ in optional}) >= 10
    assert [f"{k.__name__}.{n}" for k, n in optional if k.model_fields[n].default is not None] == []


def test_what_is_turned_off_is_read_as_it_was_written(tmp_path: Path) -> None:
    off = ["fusion.finer=0", "exchange.verification.min_covered=1.1"]
    config = load_config(RunConfig, overrides=off)
    (tmp_path / "c.toml").write_text(dump_config(config))
    assert load_config(RunConfig, tmp_path / "c.toml") == config
    with pytest.raises(DuagError, match=r"fusion\.finer is 0\.5, expected 0 or at least 1"):
        load_config(RunConfig, overrides=["fusion.finer=0.5"])


def test_a_section_is_introduced_by_its_first_paragraph() -> None:
    class Wheel(Config):
        """What others
        are made of.

        And more.
        """

        radius_m: float = 0.1
        """Of the tire."""

    assert Wheel.summary() == "What others\nare made of."
    assert Whole.summary() == "All of it."


@pytest.mark.parametrize(
    "override",
    [
        "frontend.tracking.registration.huber_sigmas=0",
        "exchange.verification.registration.huber_sigmas=0",
        "exchange.verification.samples=70000",
        "exchange.places.features_per_keyframe=70000",
        "exchange.places.features_per_place=70000",
        "exchange.consensus.closures.sigma_floor_m=0",
        "exchange.consensus.closures.sigma_floor_rad=0",
        "frontend.tracking.equalize_from_gain=0.9",
        "frontend.tracking.max_keyframe_gain=0",
        "frontend.mapping.loss.blended.color_huber=0",
        "frontend.mapping.loss.ray_plane.depth_huber_m=0",
        "fusion.finetune.loss.blended.depth_weight=1e10",
        "frontend.mapping.seeding.opacity=1",
        "frontend.mapping.seeding.opacity=0",
        "frontend.mapping.min_opacity=1",
        "frontend.mapping.min_opacity=0",
        "frontend.mapping.contribution_color_sigma=0",
        "frontend.mapping.contribution_depth_sigma_m=0",
        "information.depth_factor_max=0",
    ],
)
def test_what_no_stage_can_compute_with_is_refused_before_it(override: str) -> None:
    """Each of these ended in a traceback or a warning of a numeric library in the middle of a run."""
    with pytest.raises(DuagError, match=f"^--set {override}: .* expected a number "):
        load_config(RunConfig, overrides=[override])


def test_a_number_for_a_list_is_refused_in_words_of_toml() -> None:
    with pytest.raises(DuagError, match=r"strides = 3: expected a list in brackets, such as \[1, 2\]"):
        load_config(RunConfig, overrides=["frontend.tracking.strides=3"])


def test_overrides_win_over_the_file(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text("seed = 3\n[link]\nloss_probability = 0.5\n")
    config = load_config(Whole, tmp_path / "c.toml", ["link.loss_probability=0.75", "link.name=wire"])
    assert config == Whole(seed=3, link=Link(loss_probability=0.75, name="wire"))


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("link.los=1", "link.los is not a known setting, expected one of loss_probability, name; see"),
        (
            "link.loss_probabilty=1",
            "link.loss_probabilty is not a known setting, expected perhaps link.loss_probability;",
        ),
        ("lnk.name=1", "lnk is not a known setting, expected perhaps link;"),
        (
            "loss_probability=1",
            "loss_probability is not a known setting, expected perhaps link.loss_probability;",
        ),
        ("link.loss_probability=much", "link.loss_probability = 'much'"),
        ("seed", "expected section.name=value"),
        ("seed.x=1", "seed = {'x': 1}"),
        ("seed=true", "--set seed=true: seed is true or false, expected a number"),
        ("link={loss_probability = false}", "link.loss_probability is true or false, expected a number"),
        pytest.param("seed=" + 400 * "9", "seed is 1.00000e+400, expected at most 4.61169e+18", id="large"),
        pytest.param("seed=-" + 400 * "9", "seed is -1.00000e+400, expected 0 or more", id="small"),
        pytest.param("seed=" + 5000 * "9", "holds a number of more than 4300 digits", id="long"),
    ],
)
def test_errors_name_the_setting(override: str, expected: str) -> None:
    with pytest.raises(DuagError) as caught:
        load_config(Whole, overrides=[override])
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_wrong_is_in_the_file_or_in_an_override(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text("seed = 3\n[link]\nloss_probability = 'much'\n")
    with pytest.raises(DuagError, match=f"^{path}: link.loss_probability = 'much'"):
        load_config(Whole, path, ["seed=4"])
    with pytest.raises(DuagError, match=r"^--set link.loss_probability=most: link.loss_probability = 'most'"):
        load_config(Whole, path, ["link.loss_probability=most"])
    with pytest.raises(DuagError, match=r"^--set lnk.name=a: lnk is not a known setting"):
        load_config(Whole, overrides=["lnk.name=a", "seed=4"])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("frontend = 3", "frontend = 3: expected a section of settings"),
        (
            '[[exchange.link.windows]]\nsender = "a"\nreceivers = "b"',
            "exchange.link.windows.0.receivers is not a known setting, "
            "expected perhaps exchange.link.windows.0.receiver;",
        ),
        (
            '[[exchange.link.windows]]\nsender = "a"',
            "exchange.link.windows.0.receiver is missing, expected a value",
        ),
        (
            "max_gaussians = 3",
            "max_gaussians is not a known setting, expected perhaps frontend.tracking.rendering.max_gaussians or "
            "frontend.mapping.max_gaussians;",
        ),
        (
            "[exchange.verification.gicp]\ndistances_m = [0.1, true]",
            "exchange.verification.gicp.distances_m.1 is true or false, expected a number",
        ),
        ('"exchange.link.loss_probability" = 0.3', '"exchange.link.loss_probability" is not a known setting'),
        ('[exchange]\n"" = 1', 'exchange."" is not a known setting'),
        (
            "seed = 1\nseed = 2\n",
            "not valid TOML: a key comes twice, or is a value and a section (at line 2, column 9): seed = 2",
        ),
        (
            "seed = 1\nseed = 2",
            "not valid TOML: a key comes twice, or is a value and a section (at end of document): seed = 2",
        ),
        (
            "seed: 1",
            "not valid TOML: Expected '=' after a key in a key/value pair (at line 1, column 5): seed: 1, expected a",
        ),
    ],
)
def test_a_file_that_is_wrong_is_said_in_words_of_its_settings(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "c.toml"
    path.write_text(text)
    with pytest.raises(DuagError) as caught:
        load_config(RunConfig, path)
    assert str(caught.value).startswith(f"{path}: {said}")


@pytest.mark.parametrize("text", [f"{5000 * 'x'} = 1", f"seed = '{5000 * 'x'}'"], ids=["key", "value"])
def test_a_message_repeats_no_more_of_a_text_than_finds_it_again(tmp_path: Path, text: str) -> None:
    path = tmp_path / "c.toml"
    path.write_text(text)
    with pytest.raises(DuagError) as caught:
        load_config(RunConfig, path)
    assert "xxx" in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 300


def names(model: type[Config], prefix: str = "") -> Iterator[str]:
    """Dotted names of all settings of a configuration."""
    for name, field in model.model_fields.items():
        section = field.annotation
        if isinstance(section, type) and issubclass(section, Config):
            yield from names(section, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"


@pytest.mark.parametrize("value", ["no_such_thing", "-1", "[]", "nan", "{}", "1e300"])
def test_a_wrong_value_of_any_setting_is_said_alike(value: str) -> None:
    """With the override that says it, the setting as it is written, what was found and what was expected."""
    refused = 0
    for name in names(RunConfig):
        try:
            load_config(RunConfig, overrides=[f"{name}={value}"])
        except DuagError as error:
            refused += 1
            said, override = str(error), f"--set {name}={value}: "
            assert said.startswith(override), said
            if not name.startswith(("exchange.link.", "exchange.injection.")):  # also judged together
                assert re.match(
                    rf"{re.escape(name)}(\.\d+)? (= .*:|is .*,) expected ", said[len(override) :]
                ), said
    assert refused > 100 or value in ("[]",), refused


@pytest.mark.parametrize(
    ("link", "expected"),
    [
        ({"windows": ({"sender": "a", "receiver": "b"},)}, "topology is 'full', expected 'listed'"),
        ({"range_m": 2.0}, "topology is 'full', expected 'range'"),
        ({"burst_loss_probability": 0.9}, "burst_length_ns is 0, expected a length"),
    ],
)
def test_a_link_has_no_setting_that_does_nothing(link: dict, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        LinkConfig(**link)


def test_broken_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    for text in ("seed = = 3", "seed = " + 5000 * "9", "seed = " + 5000 * "["):
        path.write_text(text)
        with pytest.raises(DuagError, match=r"c\.toml: not valid TOML.*, expected a TOML configuration"):
            load_config(Whole, path)
    with pytest.raises(DuagError, match=r"absent\.toml"):
        load_config(Whole, tmp_path / "absent.toml")


def test_a_run_has_one_thickness_floor() -> None:
    config = load_config(
        RunConfig, overrides=["frontend.mapping.seeding.thickness_m=0.002", "exchange.matching.radius_m=0.03"]
    )
    assert config.thickness_floor_m == config.matching.thickness_floor_m == 0.002
    assert config.matching.model_dump(exclude={"thickness_floor_m"}) == config.exchange.matching.model_dump()
    for other in ("information.thickness_floor_m", "exchange.matching.thickness_floor_m"):
        with pytest.raises(DuagError, match=f"{other} is not a known setting"):
            load_config(RunConfig, overrides=[f"{other}=0.002"])


def test_settings_that_differ_are_named_with_both_values() -> None:
    first, second = Whole(seed=7), Whole(link=Link(name="wire"))
    assert differing_settings(first, second) == [("seed", 7, 0), ("link.name", "radio", "wire")]
    assert differing_settings(first, first) == []


@pytest.mark.parametrize("mu", ["[0.0, 300.0]", "[300.0, 1e-5]", "[-1.0, 300.0]"])
def test_a_schedule_grows_from_above_zero(mu: str) -> None:
    with pytest.raises(DuagError, match=r"consensus\.robust_mu is .*, expected 0 < first <= last"):
        load_config(RunConfig, overrides=[f"exchange.consensus.robust_mu={mu}"])
    same = load_config(RunConfig, overrides=["exchange.consensus.robust_mu=[1.0, 1.0]"])
    assert same.exchange.consensus.robust_mu == (1.0, 1.0)
