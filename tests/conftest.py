"""Settings that every test shares; they must be in place before numpy is imported."""

from duagc.pipeline.base import determinism

determinism.configure_determinism()

pytest_plugins = ["tests.budget"]
