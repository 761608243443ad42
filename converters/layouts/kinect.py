"""What is known of the first Kinect, for the datasets that were taken with one."""

from duagc.pipeline.recording.rolling_shutter import COLOR_READOUT_KEY, DEPTH_READOUT_KEY

COLOR_READOUT_S, DEPTH_READOUT_S = 0.026, 0.0305
"""From the first row of an image to the last: about what Ringaby and Forssén (ICCV 2011) measured, from memory. That
rows of fr1_desk are taken so is in docs/lab/2026-11-22-rolling-shutter.md."""


def kinect_readout() -> dict[str, str]:
    """What a log says about the readout of its images."""
    return {COLOR_READOUT_KEY: repr(COLOR_READOUT_S), DEPTH_READOUT_KEY: repr(DEPTH_READOUT_S)}


def no_readout() -> dict[str, str]:
    """The same of images whose rows are all read at once."""
    return dict.fromkeys((COLOR_READOUT_KEY, DEPTH_READOUT_KEY), "0")
