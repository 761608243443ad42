"""Evaluation of finished runs: the only part of the pipeline that opens ground truth."""

from pipeline.evaluation.stage import evaluate

__all__ = ["evaluate"]
