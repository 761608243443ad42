"""A finished run as a team for the bench of the Gaussian consensus."""

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.experiments.consensus_modes import ConsensusPlan, run_on
from duagc.pipeline.experiments.team_of_run import team_of_run
from duagc.pipeline.runs.folder import RunFolder
from tests.fixtures.fake_run import make


def test_the_matches_of_a_run_are_agreed_on_in_every_mode(tmp_path) -> None:
    run = RunFolder(make(tmp_path).run)
    team = team_of_run(run, "full")
    assert team.names == ["alpha", "bravo"]
    assert len(team.best) == 3  # the pairs of that run
    ids = run.robots["alpha"].own_map.gaussians.ids
    moved = run.robots["alpha"].own_map.gaussians.moved(
        np.array([k.T_map_camera for k in run.robots["alpha"].keyframes]),
        run.robots["alpha"].corrected.T_world_keyframe,
    )
    np.testing.assert_allclose(
        team.theta["alpha"][:, :3], moved.means[np.searchsorted(ids, [1, 3, 5])], atol=1e-6
    )
    plan = ConsensusPlan(losses=(0.0,), modes=("evidence_float64", "paper"), max_rounds=100)
    rows = {row["mode"]: row for row in run_on(team, "full", plan)["rows"]}
    assert rows["evidence_float64"]["gap_sigma"] < 1e-9
    assert rows["paper"]["gap_sigma"] < 1e-4  # float32 weights


def test_a_run_in_which_nobody_met_has_no_team(tmp_path) -> None:
    with pytest.raises(DuagError, match="no Gaussians were matched"):
        team_of_run(RunFolder(make(tmp_path, joined=False).run), "full")
