"""The undisturbed run that the tests of disturbed cameras start from."""

from __future__ import annotations

import pytest

from duagc.pipeline.config.frontend import FrontendConfig, TrackingConfig
from duagc.pipeline.experiments.disturbed_tracking import Undisturbed
from duagc.pipeline.frontend.tracking import Tracker
from tests.fixtures.films import CAMERA, FRAMES, filmed

CONFIG = FrontendConfig(tracking=TrackingConfig(strides=(2, 1, 1, 1)))
STARTS = (17, 34, 50)  # frames before which a disturbance begins
START_OF_COMPARISONS = 52  # likewise, for the tests of what a pose is compared with


@pytest.fixture(scope="session")
def run() -> Undisturbed:
    return Undisturbed(Tracker(CAMERA, CONFIG), filmed(0, FRAMES), (*STARTS, START_OF_COMPARISONS))
