import json

import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from duagc.pipeline.evaluation.results import (
    Absent,
    Row,
    group_reasons,
    leaves,
    mean,
    reason_of,
    split_reasons,
    unit_of,
    write_json,
    write_parquet,
)


def test_an_absent_value_becomes_null_with_its_reason():
    tree = {"team": {"ate_rmse_m": Absent("only alpha"), "robots": 1}, "robots": {"alpha": {"frames": 3}}}
    plain, reasons = split_reasons(tree)
    assert plain == {"team": {"ate_rmse_m": None, "robots": 1}, "robots": {"alpha": {"frames": 3}}}
    assert reasons == {"team.ate_rmse_m": "only alpha"}
    assert dict(leaves(plain)) == {
        ("team", "ate_rmse_m"): None,
        ("team", "robots"): 1,
        ("robots", "alpha", "frames"): 3,
    }


def test_every_reason_stands_once():
    maps = [f"robots.{robot}.{kind}" for robot in ("a", "b") for kind in ("own", "fused")]
    nulls = {f"{name}.{key}": "no peers" for name in maps for key in ("psnr", "depth")}
    nulls |= {f"{name}.lpips": "no weights" for name in (*maps, "team")}
    nulls |= {"team.psnr": "none met", "team.depth": "none met", "robots.a.ate": "no truth of a"}
    assert group_reasons(nulls, ["a", "b"]) == {
        "no weights": ["*.lpips"],
        "no peers": ["robots.*.own.*", "robots.*.fused.*"],
        "none met": ["team.*"],
        "no truth of a": ["robots.a.ate"],
    }


_WORDS = st.sampled_from(["robots", "a", "b", "own", "team", "ate", "lpips"])
_NAMES = st.lists(_WORDS, min_size=1, max_size=4).map(".".join)


@given(st.dictionaries(_NAMES, st.sampled_from(["no truth", "no peers", "no weights"]), max_size=12))
def test_a_grouped_reason_is_found_by_every_name(nulls):
    nulls = {
        n: r for n, r in nulls.items() if not any(other.startswith(f"{n}.") for other in nulls)
    }  # leaves
    grouped = group_reasons(nulls, ["a", "b"])
    assert {name: reason_of(grouped, name) for name in nulls} == nulls
    assert reason_of(grouped, "nothing.of.this.name") == ""
    assert set(grouped) == set(nulls.values())


@pytest.mark.parametrize("bad", [None, float("nan"), float("inf")])
def test_a_null_without_a_reason_is_refused(bad):
    with pytest.raises(ValueError, match=r"team\.ate_rmse_m"):
        split_reasons({"team": {"ate_rmse_m": bad}})


def test_mean_leaves_out_what_is_absent():
    assert mean([1.0, Absent("x"), 3.0]) == 2.0
    assert mean([Absent("x"), Absent("y")]) == Absent("x")
    assert isinstance(mean([]), Absent)


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("ate_rmse_m", "m"), ("ate_rmse_m_before_consensus", "m"), ("rpe_rot_rad", "rad"), ("psnr_db", "dB"),
        ("ms_ssim", "1"), ("depth_l1_exact_m", "m"), ("depth_completeness", "1"), ("bytes_sent", "B"), ("nll", "nat"),
        ("gap_to_oracle_sigma", "sigma"), ("gap_to_oracle_sigma_p99", "sigma"),
        ("gap_to_oracle_m", "m"), ("rounds", "1"), ("sigma_scale", "1"),
    ],
)  # fmt: skip
def test_units_follow_from_names(name, unit):
    assert unit_of(name) == unit


def test_files_say_the_same_and_leave_no_part_behind(tmp_path):
    write_json(tmp_path / "m.json", {"a": 1.5, "b": None})
    assert json.loads((tmp_path / "m.json").read_text()) == {"a": 1.5, "b": None}
    rows = [
        Row("robot", "alpha", "", -1, "ate_rmse_m", 0.25),
        Row("view", "alpha", "own/held_out", 4, "psnr_db", Absent("not rendered")),
    ]
    write_parquet(tmp_path / "m.parquet", rows)
    assert pq.read_table(tmp_path / "m.parquet").to_pylist() == [
        {"scope": "robot", "robot": "alpha", "view_set": None, "frame_index": None, "name": "ate_rmse_m",
         "value": 0.25, "unit": "m", "reason": None},
        {"scope": "view", "robot": "alpha", "view_set": "own/held_out", "frame_index": 4, "name": "psnr_db",
         "value": None, "unit": "dB", "reason": "not rendered"},
    ]  # fmt: skip
    assert sorted(p.name for p in tmp_path.iterdir()) == ["m.json", "m.parquet"]


def test_json_refuses_what_json_does_not_have(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "m.json", {"a": float("nan")})
    assert not (tmp_path / "m.json").exists()
