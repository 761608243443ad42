"""The configuration of a run: all sections in one model."""

from typing import ClassVar

from duagc.pipeline.config.base import Config
from duagc.pipeline.config.calibration import CalibrationConfig
from duagc.pipeline.config.consensus import MapMatching
from duagc.pipeline.config.evaluation import EvaluationConfig
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.config.information import InformationConfig


class RunConfig(Config):
    """Everything that decides what a run computes."""

    LISTED: ClassVar[str] = "`duagc config show`"

    seed: int = 0
    """Seed of every random stream of the run."""

    calibration: CalibrationConfig = CalibrationConfig()
    frontend: FrontendConfig = FrontendConfig()
    information: InformationConfig = InformationConfig()
    exchange: ExchangeConfig = ExchangeConfig()
    fusion: FusionConfig = FusionConfig()
    evaluation: EvaluationConfig = EvaluationConfig()

    @property
    def thickness_floor_m(self) -> float:
        """Least standard deviation (m) of a Gaussian: the mapper's, which the other stages must know."""
        return self.frontend.mapping.seeding.thickness_m

    @property
    def matching(self) -> MapMatching:
        """`exchange.matching`, of the maps of this run."""
        return self.exchange.matching.of_maps(self.thickness_floor_m)
