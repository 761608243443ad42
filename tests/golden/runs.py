"""The golden runs: small recordings, and what they are run with. `make test` makes the smallest of them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from duagc.converters.registry import convert
from duagc.converters.simulate.team import simulate
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.runner import run

RED_KITCHEN = Path(__file__).parents[3] / "shared" / "data" / "redkitchen"
RED_KITCHEN_FRAMES = 60
RED_KITCHEN_STRIDE = 3  # so that the robots have moved far enough for several keyframes each
SCRIPT_WORKERS = 2


def _demo(recording: Path) -> None:
    simulate(recording, robots=2, frames=160, seed=0, workers=SCRIPT_WORKERS)


def _red_kitchen(recording: Path) -> None:
    """Two robots of 30 frames each, as if the folder held nothing but every third frame."""
    source = recording.with_name("redkitchen")
    source.mkdir()
    for number in range(0, RED_KITCHEN_FRAMES * RED_KITCHEN_STRIDE, RED_KITCHEN_STRIDE):
        for path in RED_KITCHEN.glob(f"frame-{number:06d}.*"):
            (source / path.name).symlink_to(path)
    convert("7scenes", source, recording, robots=2)


def _lossy(recording: Path) -> None:
    simulate(recording, robots=3, frames=32, size=(160, 120), noise="kinect", seed=5, workers=SCRIPT_WORKERS)


def _tiny(recording: Path) -> None:
    simulate(recording, robots=3, frames=16, size=(160, 120), noise="kinect", seed=5, overlap=0.9, workers=1)


@dataclass(frozen=True)
class GoldenRun:
    """One golden run.

    Attributes:
        make: writes the recording into a new folder.
        overrides: settings that differ from the defaults, `section.name=value`.
        needs: a folder without which the run cannot be made, or None.
    """

    make: Callable[[Path], None]
    overrides: tuple[str, ...] = ()
    needs: Path | None = None


RUNS = {
    "demo": GoldenRun(_demo),
    "redkitchen60": GoldenRun(_red_kitchen, needs=RED_KITCHEN),
    "lossy3": GoldenRun(_lossy, ("exchange.link.loss_probability=0.3",)),
    "tiny3": GoldenRun(
        _tiny,
        (
            "exchange.link.loss_probability=0.3",
            "exchange.max_rounds=400",
            "frontend.mapping.max_gaussians=2000",
            "frontend.mapping.iterations=6",
            "frontend.mapping.final_iterations=6",
            "frontend.mapping.final_iterations_view=0",
            "fusion.finetune.steps_per_view=2",
        ),
    ),
}


def make_run(name: str, folder: Path, workers: int = SCRIPT_WORKERS) -> Path:
    """Make the recording of a golden run and run the stages on it of which something is stored.

    Args:
        name: a key of `RUNS`.
        folder: an empty folder; gets `recording/` and `run/`.
        workers: of the run; changes no bit.
    Returns:
        The folder of the run.
    """
    golden = RUNS[name]
    golden.make(folder / "recording")
    config = load_config(RunConfig, overrides=golden.overrides)
    out = folder / "run"
    run(folder / "recording", out, config, workers=workers, until="evaluation", log=lambda line: None)
    return out
