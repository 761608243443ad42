"""Registration of RGB-D views by joint point-to-plane and photometric least squares. Arrays in, arrays out.

`register` finds the motion between a `Reference` (samples of one view: points, normals, intensities) and the
`RgbdPyramid` of another. Tracking uses it with dense references of the robot's own keyframes, closures between
robots with the about 2000 samples that a peer sent.
"""

from duagc.pipeline.config.registration import RegistrationConfig
from duagc.pipeline.registration.align import Outcome, Registration, linearize, register
from duagc.pipeline.registration.pyramid import Level, RgbdPyramid
from duagc.pipeline.registration.reference import Reference, ReferenceLevel

__all__ = [
    "Level",
    "Outcome",
    "Reference",
    "ReferenceLevel",
    "Registration",
    "RegistrationConfig",
    "RgbdPyramid",
    "linearize",
    "register",
]
