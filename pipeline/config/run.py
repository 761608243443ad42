"""The configuration of a run: all sections in one model."""

from typing import Self

from pydantic import model_validator

from duagc.pipeline.config.base import Config
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.config.information import InformationConfig


class RunConfig(Config):
    """Everything that decides what a run computes."""

    seed: int = 0
    """Seed of every random stream of the run."""

    frontend: FrontendConfig = FrontendConfig()
    information: InformationConfig = InformationConfig()
    exchange: ExchangeConfig = ExchangeConfig()
    fusion: FusionConfig = FusionConfig()

    @model_validator(mode="after")
    def _one_thickness(self) -> Self:
        """The information stage and the matching must know the floor that the map was made with."""
        floor_m = self.frontend.mapping.seeding.thickness_m
        for name, other_m in (
            ("information.thickness_floor_m", self.information.thickness_floor_m),
            ("exchange.matching.thickness_floor_m", self.exchange.matching.thickness_floor_m),
        ):
            if other_m != floor_m:
                raise ValueError(
                    f"{name} = {other_m}, expected frontend.mapping.seeding.thickness_m = {floor_m}"
                )
        return self
