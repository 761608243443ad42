"""Settings of the calibration of cameras from the recording itself."""

from pydantic import Field

from duagc.pipeline.config.base import Config


class CalibrationConfig(Config):
    """`duagc calibrate`, `duagc run --calibrate` and `duagc convert --calibrate`."""

    views: int = Field(default=56, ge=12)
    """Most views of each half of the recording."""
    min_gain: float = Field(default=0.02, ge=0.0, lt=1.0)
    """Least improvement of views that a calibration did not use: mean of features, their depth and depth images."""
    max_loss: float = Field(default=0.01, ge=0.0)
    """How much worse one of the three may get."""
    delay_sigmas: float = Field(default=2.0, ge=0.0)
    """A delay between color and depth changes time stamps if it is this many times its standard deviation.

    And this many times half of the difference between what the halves of the recording say.
    """
