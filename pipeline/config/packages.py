"""Packages that some settings need, looked for before anything runs."""

from importlib.util import find_spec

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.run import RunConfig

NO_OPEN3D = "frontend.tracking.method: package open3d not found, expected what `pip install duagc` installs"
NO_GICP = "exchange.verification.method: package small_gicp not found; pip install 'duagc[gicp]'"


def check_packages(config: RunConfig) -> None:
    """Refuse settings whose package is not installed.

    Args:
        config: of a run.

    Raises:
        DuagError: names the package and what installs it.
    """
    if config.frontend.tracking.method == "open3d" and find_spec("open3d") is None:
        raise DuagError(NO_OPEN3D)
    if config.exchange.verification.method != "features" and find_spec("small_gicp") is None:
        raise DuagError(NO_GICP)
