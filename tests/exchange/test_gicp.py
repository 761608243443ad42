"""Registration by GICP, to compare with: it needs its package, and finds a motion where there is shape."""

from __future__ import annotations

import builtins
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.exchange import VerificationConfig
from duagc.pipeline.config.packages import check_packages
from duagc.pipeline.config.registration import GicpConfig
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.exchange.place_recognition import Candidate
from duagc.pipeline.exchange.verification import Verdict, verify
from duagc.pipeline.exchange.wire.loop_closing_wire import KeyframeSample
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import Reference, RgbdPyramid
from duagc.pipeline.registration.features import extract
from duagc.pipeline.registration.gicp import register_points
from duagc.pipeline.runner import run
from tests.exchange.conftest import CAMERA, path, view


def views() -> tuple[Any, Any, Any, Any, np.ndarray]:
    """Features and pyramid of one view, sample of another, and the motion between them."""
    T = path(0.0, 2)
    seen = [view(pose) for pose in T]
    features = [extract(color, depth, CAMERA, 400) for color, depth in seen]
    pyramids = [RgbdPyramid.build(color, depth, CAMERA) for color, depth in seen]
    sample = KeyframeSample(1, features[1], Reference.sample(pyramids[1], 2000))
    return features[0], pyramids[0], sample, Candidate(0, 1, 20), se3.inverse(T[0]) @ T[1]


def test_without_its_package_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "small_gicp":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.delitem(sys.modules, "small_gicp", raising=False)
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(DuagError, match=r"small_gicp not found; pip install 'duagc\[gicp\]'"):
        register_points(np.zeros((3, 3)), np.zeros((3, 3)), np.eye(4), GicpConfig())


def test_a_run_without_it_ends_before_anything_is_read(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("duagc.pipeline.config.packages.find_spec", lambda name: None)
    config = load_config(RunConfig, None, ["exchange.verification.method=gicp"])
    with pytest.raises(DuagError, match="small_gicp not found"):
        run(tmp_path / "nowhere", tmp_path / "out", config)
    check_packages(RunConfig())


def bumpy(n: int) -> np.ndarray:
    """Points [n, 3] of a surface that fits onto itself at one place only."""
    x, y = np.random.default_rng(1).uniform(-1, 1, (2, n))
    return np.column_stack([x, y, 2 + 0.3 * np.sin(2.3 * x + 0.4) * np.cos(3.1 * y) + 0.2 * x * y])


def test_the_points_of_two_views_are_laid_onto_each_other() -> None:
    pytest.importorskip("small_gicp")
    here, other = bumpy(20_000), np.random.default_rng(2)
    T_true = se3.exp(np.array([0.08, 0.05, -0.04, 0.03, 0.05, 0.02]))
    noise = 0.002 * other.normal(size=here.shape)
    seen = se3.transform(se3.inverse(T_true), here + noise)[other.permutation(len(here))[:8000]]
    result = register_points(here, seen, np.eye(4), GicpConfig())
    assert result is not None
    assert result.overlap > 0.9
    apart_m, apart_rad = se3.distance(result.T_target_source, T_true)
    assert apart_m < 0.005
    assert apart_rad < 0.005
    sigma_m = 1 / np.sqrt(np.linalg.eigvalsh(result.information[:3, :3])[0])
    assert 1e-5 < sigma_m < 5e-3, "in meters, of a few thousand points with noise of millimeters"


@pytest.mark.parametrize("method", ["gicp", "features_gicp"])
def test_a_verdict_says_what_it_rests_on(method: Any) -> None:
    pytest.importorskip("small_gicp")
    own, pyramid, sample, candidate, _ = views()
    config = VerificationConfig(method=method, max_refinement_m=1e-9)
    found = verify(candidate, own, pyramid, sample, config=config, rng=np.random.default_rng(0))
    samples = len(sample.reference.levels[0].points)
    assert (found.matches == samples) == (method == "gicp")
    expected = Verdict.KEPT if method == "gicp" else Verdict.MOVED
    assert found.verdict is expected, "only what features gave can be left too far behind"


def test_nothing_in_common_is_refused() -> None:
    pytest.importorskip("small_gicp")
    rng = np.random.default_rng(0)
    here, far = rng.uniform(0, 1, (3000, 3)), rng.uniform(50, 51, (3000, 3))
    assert register_points(here, far, np.eye(4), GicpConfig()) is None
    assert register_points(here[:50], here, np.eye(4), GicpConfig()) is None
