"""An experiment: question, data, configurations, and rules of decision that are written before the run.

One TOML file each, in `rules/`. The digest of its bytes goes into every result, so that a result that was made under
another rule is found out.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError

from duagc.converters.simulate.sensors.rig import Rig
from duagc.converters.simulate.settings import SimulationSettings
from duagc.pipeline.base.errors import DuagError, closest
from duagc.pipeline.base.files import parse_toml, read_text
from duagc.pipeline.config.base import Config, expected_of, load_config
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.experiments.metric_names import check_metric
from duagc.pipeline.experiments.statistics import MOST_EXACT

RULES = Path(__file__).parent / "rules"
Kind = Literal["better", "no_worse", "equivalent", "differs"]
Policy = Literal["random", "information", "least", "unseen"]
"""What chooses the legs of a steered robot: nothing; the largest, or the least gain in information; most pixels that
show nothing of its map."""


class SimulatedData(Config):
    """What is simulated for every seed; the seed draws scene, paths and noise."""

    robots: int = 2
    frames: int = 160
    """Of each robot, at 30 Hz."""
    width: int = 480
    height: int = 360
    scene: str = "room"
    """As `duagc simulate` has it, like all that follows."""
    paradigm: str = "wander"
    overlap: float = 0.6
    noise: str = "none"
    sensor: str = "rgbd"
    movers: int = 0
    masks: bool = True
    triangles: bool = False
    steering: Policy | Literal[""] = ""
    """What chooses each leg of the first robot: nothing, the largest or least gain in information, or most pixels
    that show nothing of its map; empty: it walks as the others."""

    def settings(self, seed: int) -> SimulationSettings:
        """The same as the simulator has it.

        Args:
            seed: of scene, paths and noise.
        """
        return SimulationSettings(
            robots=self.robots,
            frames=self.frames,
            scene=self.scene,
            size=(self.width, self.height),
            noise=self.noise,
            seed=seed,
            overlap=self.overlap,
            paradigm=self.paradigm,
            rig=Rig(self.sensor),
            movers=self.movers,
            masks=self.masks,
            triangles=self.triangles,
        )


class Profile(Config):
    """How much is computed."""

    seeds: tuple[int, ...]
    """Each draws a recording, and the link and all else that is random in its runs."""
    data: SimulatedData
    set: tuple[str, ...] = ()
    """Settings of all configurations, before their own."""


class RuleConfiguration(Config):
    """Settings of some runs, and what is different in what is simulated for them."""

    set: tuple[str, ...] = ()
    """`a.b=value`."""
    data: dict[str, bool | int | float | str] = Field(default_factory=dict)
    """Of the data of the profile, what these runs have different; they are run on no other recording."""


class Metric(Config):
    """A number that rules compare and tables show; its name is that in `results.parquet`, `robots.*` the mean."""

    title: str
    unit: str = ""
    scale: float = 1.0
    """Shown are values times this."""
    digits: int = Field(default=2, ge=0, le=9)
    better: Literal["more", "less"]


class RuleSide(Config):
    """One side of a comparison: a metric of a configuration, or a number."""

    configuration: str = ""
    metric: str = ""
    value: float | None = None
    """A bound that the other side is compared with; then there is neither configuration nor metric."""


class Rule(Config):
    """A claim, and what decides about it."""

    name: str
    claim: str
    kind: Kind
    """What must be shown of the mean difference. better: above the margin; no_worse: above minus the margin;
    equivalent: both within the margin, by two one-sided tests; differs: not zero."""
    first: RuleSide
    second: RuleSide
    """What the first is compared with: on the same recording, with the same seed. One of both may be a number."""
    margin: float = Field(default=0.0, ge=0.0)
    """In the unit of the metric; of `ratio`, a share: 0.05 is 5 %."""
    ratio: bool = False
    """Compare by quotients instead of differences."""
    control: bool = False
    """A claim that is known to be false: if it holds, the other verdicts of this experiment are worthless."""
    reason: str
    """Why this margin."""

    @property
    def metric(self) -> str:
        """The metric in whose unit the sides are compared."""
        return self.second.metric if self.first.value is not None else self.first.metric


class ExperimentFile(Config):
    """What stands in the file of an experiment."""

    title: str
    question: str
    claim: str
    """What the paper claims, with its number there."""
    limits: str
    """What this experiment cannot show."""
    level: float = Field(default=0.05, gt=0.0, lt=0.5)
    """Chance of one or more false "holds" among the rules, each control apart."""
    profiles: dict[Literal["small", "full"], Profile]
    configurations: dict[str, RuleConfiguration]
    metrics: dict[str, Metric]
    rules: tuple[Rule, ...]


@dataclass(frozen=True)
class Experiment:
    """An experiment that was read and checked.

    Attributes:
        name: of its file, without the ending.
        path: of its file.
        sha256: of the bytes of its file.
        file: what stands there.
    """

    name: str
    path: Path
    sha256: str
    file: ExperimentFile

    def profile(self, name: str) -> Profile:
        """How much is computed.

        Args:
            name: of the profile.

        Raises:
            DuagError: there is no such profile.
        """
        found: dict[str, Profile] = dict(self.file.profiles.items())
        if name not in found:
            raise DuagError(f"{self.path}: has no profile {name}, {closest(name, list(found), 'a profile')}")
        return found[name]


def experiment_names(folder: Path = RULES) -> list[str]:
    """Names of all experiments, in alphabetical order.

    Args:
        folder: of their files.
    """
    return sorted(path.stem for path in folder.glob("*.toml"))


def read_experiment(name: str, folder: Path = RULES) -> Experiment:
    """Read an experiment; everything that it names is looked at.

    Args:
        name: of its file, without the ending.
        folder: of the files.

    Raises:
        DuagError: there is none of this name, or it names what does not exist.
    """
    path = folder / f"{name}.toml"
    if name not in experiment_names(folder):
        raise DuagError(
            f"{name}: is no experiment, {closest(name, experiment_names(folder), 'an experiment')}"
        )
    text = read_text(path, "an experiment")
    try:
        file = ExperimentFile.model_validate(parse_toml(text, path, "an experiment"))
    except ValidationError as error:
        raise DuagError(f"{path}: {_complaint(error)}") from error
    _check(path, file)
    return Experiment(name, path, hashlib.sha256(text.encode()).hexdigest(), file)


def config_of(experiment: ExperimentFile, profile: Profile, configuration: str) -> list[str]:
    """Settings of a configuration, those of the profile first.

    Args:
        experiment: that has it.
        profile: how much is computed.
        configuration: its name.
    """
    return [*profile.set, *experiment.configurations[configuration].set]


def data_of(experiment: ExperimentFile, profile: Profile, configuration: str) -> SimulatedData:
    """What is simulated for a configuration.

    Args:
        experiment: that has it.
        profile: how much is computed.
        configuration: its name.
    """
    changed = experiment.configurations[configuration].data
    return SimulatedData.model_validate(profile.data.model_dump() | changed)


def _complaint(error: ValidationError) -> str:
    first = error.errors()[0]
    return f"{'.'.join(map(str, first['loc']))}: {expected_of(first)}"


def _check(path: Path, file: ExperimentFile) -> None:
    for name in file.metrics:
        check_metric(name, f"{path}: metrics")
    for kind, row in _doubles(file):
        raise DuagError(f"{path}: {kind}: {row} occurs twice, expected different ones")
    for rule in file.rules:
        _check_rule(f"{path}: rule {rule.name}", rule, file)
    for name, profile in file.profiles.items():
        where = f"{path}: profile {name}"
        if not profile.seeds:
            raise DuagError(f"{where}: found no seed, expected at least one")
        if len(profile.seeds) > MOST_EXACT:
            raise DuagError(
                f"{where}: found {len(profile.seeds)} seeds, expected at most {MOST_EXACT}, for the exact test"
            )
        for configuration in file.configurations:
            try:
                data = data_of(file, profile, configuration)
                for seed in profile.seeds:
                    data.settings(seed).check()
            except ValidationError as error:
                raise DuagError(
                    f"{where}: configuration {configuration}: data: {_complaint(error)}"
                ) from error
            try:
                load_config(RunConfig, None, config_of(file, profile, configuration))
            except DuagError as error:
                raise DuagError(f"{where}: configuration {configuration}: {error}") from error


def _check_rule(where: str, rule: Rule, file: ExperimentFile) -> None:
    sides = [side for side in (rule.first, rule.second) if side.value is None]
    if not sides:
        raise DuagError(f"{where}: compares two numbers, expected at least one metric")
    for side in (rule.first, rule.second):
        if side.value is not None and (side.configuration or side.metric):
            raise DuagError(f"{where}: a side has a value and a metric, expected one of both")
    for side in sides:
        check_metric(side.metric, where)
        for kind, name, known in (
            ("configuration", side.configuration, list(file.configurations)),
            ("metric", side.metric, list(file.metrics)),
        ):
            if name not in known:
                raise DuagError(
                    f"{where}: {kind} {name} is not in the file, {closest(name, known, f'a {kind}')}"
                )
    first, second = (file.metrics[side.metric] for side in (sides[0], sides[-1]))
    if (first.better, first.unit, first.scale) != (second.better, second.unit, second.scale):
        raise DuagError(
            f"{where}: compares {rule.first.metric} with {rule.second.metric}, expected metrics of one kind"
        )
    if rule.first == rule.second:
        raise DuagError(f"{where}: compares {rule.first.metric} of {rule.first.configuration} with itself")
    if rule.kind in ("no_worse", "equivalent") and not rule.margin:
        raise DuagError(f"{where}: margin is 0, expected above 0 for {rule.kind}")
    if rule.kind == "differs" and rule.margin:
        raise DuagError(f"{where}: margin is {rule.margin:g}, expected none for differs")


def _doubles(file: ExperimentFile) -> Iterator[tuple[str, Any]]:
    names = [rule.name for rule in file.rules]
    yield from (("rules", name) for name in names if names.count(name) > 1)
    for profile in file.profiles.values():
        yield from (("seeds", seed) for seed in profile.seeds if profile.seeds.count(seed) > 1)
