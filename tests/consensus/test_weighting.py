"""Kinds of weights: what each keeps of the information, and that frames do not matter."""

from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from duagc.pipeline.config.consensus import WeightKind
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.weighting import (
    UNIT_SIGMA_M,
    UNIT_SIGMA_SHAPE,
    in_world,
    self_information,
    shared_evidence,
)
from tests.fixtures.gaussian_maps import Sums, random_map
from tests.fixtures.pose_worlds import random_poses


@dataclass
class Seen(Sums):
    """Sums with the number of views."""

    observations: NDArray[Any] = None  # type: ignore[assignment]


def world(seed: int) -> tuple[Any, Seen, Any]:
    gaussians, sums, T_map_keyframe = random_map(seed)
    observations = np.random.default_rng(seed).integers(0, 9, len(gaussians))
    return gaussians, Seen(**vars(sums), observations=observations), T_map_keyframe


def told_in_map(seed: int, kind: WeightKind) -> tuple[Evidence, Seen, Any]:
    gaussians, sums, T_map_keyframe = world(seed)
    return (
        in_world(shared_evidence("alpha", gaussians, sums, T_map_keyframe, kind=kind), T_map_keyframe, kind),
        sums,
        gaussians,
    )


def test_what_each_kind_keeps() -> None:
    full, sums, gaussians = told_in_map(0, "block")
    position = {kind: told_in_map(0, kind)[0].position_information() for kind in get_args(WeightKind)}
    np.testing.assert_allclose(position["block"], full.position_information(), rtol=1e-9, atol=1e-9)
    diagonal = np.diagonal(full.position_information(), axis1=1, axis2=2)
    np.testing.assert_allclose(position["diagonal"], diagonal[:, :, None] * np.eye(3), atol=1e-9)
    np.testing.assert_allclose(
        position["scalar"], diagonal.mean(axis=1)[:, None, None] * np.eye(3), atol=1e-9
    )
    unit = np.eye(3) / UNIT_SIGMA_M**2
    counts = sums.observations[:, None, None] * unit
    np.testing.assert_allclose(position["observation_count"], counts, rtol=1e-9, atol=1e-6)
    residual = np.eye(3) / sums.deviation_m[:, None, None] ** 2
    np.testing.assert_allclose(position["residual_magnitude"], residual, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(
        position["uniform"], np.tile(unit, (len(gaussians), 1, 1)), rtol=1e-9, atol=1e-6
    )
    shape = told_in_map(0, "uniform")[0].shape_information()
    np.testing.assert_allclose(
        shape, np.tile(np.eye(6) / UNIT_SIGMA_SHAPE**2, (len(gaussians), 1, 1)), atol=1e-9
    )
    scalar = told_in_map(0, "scalar")[0]
    of_shape = np.diagonal(full.shape_information(), axis1=1, axis2=2).mean(axis=1)
    np.testing.assert_allclose(scalar.shape_information(), of_shape[:, None, None] * np.eye(6), atol=1e-9)
    of_color = full.color_information().mean(axis=1)
    np.testing.assert_allclose(scalar.color_information(), np.repeat(of_color[:, None], 3, axis=1))


@pytest.mark.parametrize("kind", get_args(WeightKind))
def test_all_but_the_diagonal_are_the_same_in_every_frame(kind: WeightKind) -> None:
    gaussians, sums, T_map_keyframe = world(1)
    T = random_poses(np.random.default_rng(2), 1)[0]
    evidence = shared_evidence("alpha", gaussians, sums, T_map_keyframe, kind=kind)
    here, there = in_world(evidence, T_map_keyframe, kind), in_world(evidence, T @ T_map_keyframe, kind)
    turned = T[:3, :3] @ here.position_information() @ T[:3, :3].T
    same = np.allclose(there.position_information(), turned, rtol=1e-9, atol=1e-7)
    assert same == (kind != "diagonal")
    np.testing.assert_allclose(
        np.trace(there.position_information(), axis1=1, axis2=2),
        np.trace(here.position_information(), axis1=1, axis2=2),
        rtol=1e-9,
    )


def test_own_splats_are_stiffer_only_where_information_counts() -> None:
    gaussians, sums, T_map_keyframe = world(3)
    stiff = self_information("alpha", gaussians, sums, T_map_keyframe, kind="block")
    same = Evidence.from_rendering("alpha", gaussians, sums, T_map_keyframe)
    np.testing.assert_array_equal(stiff.information, same.information)
    for kind in ("uniform", "scalar"):
        np.testing.assert_array_equal(
            self_information("alpha", gaussians, sums, T_map_keyframe, kind=kind).information,
            shared_evidence("alpha", gaussians, sums, T_map_keyframe, kind=kind).information,
        )


def test_what_the_sums_do_not_name_has_no_counted_weight() -> None:
    gaussians, sums, T_map_keyframe = world(4)
    half = Seen(**{k: v[::2] if isinstance(v, np.ndarray) else v for k, v in vars(sums).items()})
    missing = ~np.isin(gaussians.ids, half.ids)
    for kind in ("observation_count", "residual_magnitude", "scalar"):
        evidence = shared_evidence("alpha", gaussians, half, T_map_keyframe, kind=kind)
        assert missing.any()
        assert not evidence.information[missing].any()


@pytest.mark.parametrize("kind", get_args(WeightKind))
def test_sums_that_name_no_gaussian_give_no_weight(kind: WeightKind) -> None:
    gaussians, sums, T_map_keyframe = world(5)
    none = Seen(**{k: v[:0] if isinstance(v, np.ndarray) else v for k, v in vars(sums).items()})
    evidence = shared_evidence("alpha", gaussians, none, T_map_keyframe, kind=kind)
    assert evidence.information.any() == (kind == "uniform")
