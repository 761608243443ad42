"""Evaluation of finished runs: the only part of the pipeline that opens ground truth."""

from duagc.pipeline.evaluation.groundtruth import check as check_ground_truth
from duagc.pipeline.evaluation.stage import evaluate

__all__ = ["check_ground_truth", "evaluate"]
