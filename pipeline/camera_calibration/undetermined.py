"""Why a recording cannot be calibrated."""

from duagc.pipeline.base.errors import DuagError


class UndeterminedError(DuagError):
    """The images of a recording do not determine its cameras. The recording itself is sound."""
