"""Settings that every test shares; they must be in place before numpy is imported."""

import os

from duagc.pipeline.base import determinism

determinism.configure_determinism()
# Threads of the kernels sleep while they wait for each other: the images of tests are so small that most of their time
# would be waiting, and a thread that waits awake counts as processor time.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

pytest_plugins = ["tests.budget"]
