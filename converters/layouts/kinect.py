"""What is known of the first Kinect, for the datasets that were taken with one."""

from duagc.pipeline.recording.rolling_shutter import Readout

KINECT_READOUT = Readout(color_s=0.026, depth_s=0.0305)
"""From the first row of an image to the last: about what Ringaby and Forssén (ICCV 2011) measured, from memory. That
rows of fr1_desk are taken so is in docs/lab/2026-11-22-rolling-shutter.md."""
