"""The contract of metrics.json: which names it has, of which types, and that absent values carry a reason."""

from fnmatch import fnmatchcase

from duagc.pipeline.evaluation.results import reason_of

NUMBER = (int, float)
ROBOT = {
    "frames": int, "tracked": int, "keyframes": int, "gaussians": int, "gaussians_fused": int, "stated_scale": float,
    "robots_in_component": int, "frames_with_truth": int, "ate_rmse_m": NUMBER,
    "ate_rmse_m_before_consensus": NUMBER, "ate_rmse_m_keyframes": NUMBER, "ate_rmse_m_joint": NUMBER,
    "rpe_trans_m": NUMBER, "rpe_rot_rad": NUMBER, "depth_agreement_pairs": int, "depth_agreement_m": NUMBER,
    "depth_agreement_m_before_consensus": NUMBER, "depth_agreement_m_of_truth": NUMBER,
    "feature_agreement_pairs": int, "feature_agreement_px": NUMBER, "feature_agreement_px_before_consensus": NUMBER,
    "feature_agreement_px_of_truth": NUMBER,
}  # fmt: skip
VIEWS = {
    "views": int, "views_without_pose": int, "psnr_db": NUMBER, "psnr_interpolated_db": NUMBER,
    "psnr_moved_db": NUMBER,
    "psnr_exposure_db": NUMBER, "psnr_exposure_left_db": NUMBER, "psnr_exposure_right_db": NUMBER,
    "ssim": NUMBER, "ms_ssim": NUMBER, "lpips": NUMBER, "st_lpips": NUMBER,
    "depth_l1_m": NUMBER, "depth_l1_exact_m": NUMBER,
    "depth_l1_layer_m": NUMBER, "depth_l1_common_m": NUMBER, "depth_completeness": NUMBER,
}  # fmt: skip
COMPARED = {
    kind: {"held_out": VIEWS, "peers": VIEWS, "team": VIEWS}
    for kind in ("own", "own_longer", "fused", "refined")
}
CAMERA = {
    f"{value}_{channel}": NUMBER
    for value in ("gain", "offset", "sigma_gain", "sigma_offset")
    for channel in ("red", "green", "blue")
} | {"matches": int}
DEPTH_SCALE = {"depth_ratio": float, "sigma_depth_ratio": float, "depth_ratio_closures": int}
SCHEMA = {
    "schema": int,
    "robots": dict.fromkeys(
        ("alpha", "bravo"), ROBOT | {"camera": CAMERA, "depth_scale": DEPTH_SCALE, "rendering": COMPARED}
    ),
    "team": {
        "robots": int, "robots_in_largest_component": int, "ate_rmse_m": NUMBER, "ate_rmse_m_mean_of_robots": NUMBER,
        "inter_robot_loop_closures": int, "inter_robot_loop_closures_rejected": int,
    },
    "rendering": {
        **{kind: COMPARED[kind] | ({"training": VIEWS} if kind in ("own", "fused") else {}) for kind in COMPARED},
        "own_unrefined": {"held_out": VIEWS},
    },
    "calibration": dict.fromkeys(
        ("ece_paper", "ece_rank", "ece_rank_if_right", "ece_rank_shuffled", "spearman", "ause", "nll",
         "coverage_95", "nll_scaled",
         "coverage_95_scaled", "sigma_scale", "gaussians", "gaussians_without_information"),
        NUMBER,
    ),
    "pixel_calibration": {
        kind: {view_set: {"pixels": int, "pixels_without_sigma": int} | dict.fromkeys(
            ("median_error_m", "median_sigma_m", "spearman", "ece_rank", "ece_rank_if_right", "ece_rank_shuffled",
             "coverage_95", "nll", "sigma_scale", "coverage_95_scaled", "nll_scaled"), NUMBER,
        ) for view_set in ("held_out", "peers")} for kind in ("own", "refined")
    },
    "coverage": {"*": {
        "frames": int, "frames_without_pixel": int, "posed": int, "coverage": NUMBER, "submaps": int, "components": int,
    }},
    "components": {"*": {"robots": int, "posed": int, "coverage": NUMBER, "ate_rmse_m": NUMBER}},
    "exchange": {
        "sessions": int, "rounds": int, "messages": int, "packets_sent": int, "packets_dropped": int, "bytes_sent": int,
        "bytes_delivered": int, "bytes_setup": int, "bytes_per_round_per_robot_pair": NUMBER,
        "bytes_raw_alternative": int, "bytes_raw_alternative_maps_only": int, "bytes_paper_accounting": int,
        "matched_pairs": int,
    },
    "consensus": {
        "solver": str, "converged": bool, "rounds_to_tolerance": int, "gap_to_oracle_sigma": NUMBER,
        "gap_to_oracle_sigma_p99": NUMBER, "gap_to_oracle_m": NUMBER, "gap_to_oracle_rad": NUMBER,
        "rejected_matches_share": NUMBER,
    },
    "protocol": dict.fromkeys(
        ("alignment", "ate", "team_ate", "rpe", "depth_agreement", "feature_agreement",
         "initial_relative_poses", "held_out", "peers", "training", "poses",
         "exposure", "colors", "own_unrefined", "own_longer", "refined", "team", "common", "background", "psnr", "ssim",
         "ms_ssim", "depth", "calibration", "pixel_calibration", "oracle", "views"),
        str,
    ),
}  # fmt: skip


def check_against_schema(metrics: dict) -> None:
    """Exactly the names of the contract, the right type, and a reason for every null and for nothing else."""
    nulls = set()

    def walk(value, schema, path):
        if isinstance(schema, dict):
            assert isinstance(value, dict), path
            if "*" not in schema:
                assert set(value) == set(schema), path
            for key in value:
                walk(value[key], schema.get("*") or schema[key], (*path, key))
        elif value is None:
            nulls.add(".".join(path))
        else:
            assert isinstance(value, schema), path
            assert not (isinstance(value, bool) and schema is not bool), path

    walk({k: v for k, v in metrics.items() if k != "reasons"}, SCHEMA, ())
    assert all(len(reason_of(metrics["reasons"], name)) > 8 for name in nulls)
    patterns = [pattern for patterns in metrics["reasons"].values() for pattern in patterns]
    assert len(patterns) < 45 < len(nulls)  # absent values once per reason, not once per name
    for pattern in patterns:
        assert any(fnmatchcase(name, pattern) for name in nulls), pattern
