"""The agent of a robot with images and a map: what a run sends into a session."""

from __future__ import annotations

from collections.abc import Sequence

from duagc.pipeline.base.recall import Recalling, computed
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.exchange.agent import Agent
from duagc.pipeline.exchange.detected_loop_closures import DetectedLoopClosures
from duagc.pipeline.exchange.knowledge import Knowledge
from duagc.pipeline.exchange.sharing import Sharing
from duagc.pipeline.runs.robot_data import RobotData


class MapAgent(Agent):
    """Detects loop closures in images, and shares the evidence of its Gaussians.

    Attributes:
        data: of this robot.
        evidence: what it shares.
    """

    def __init__(
        self,
        data: RobotData,
        team: Sequence[str],
        neighbors: Sequence[str],
        config: ExchangeConfig,
        *,
        seed: int,
        recall: Recalling = computed,
    ) -> None:
        """Start with own data only.

        Args:
            data: of this robot.
            team: names of all robots that may exist.
            neighbors: names of those that this robot has a radio link to.
            config: the same at all robots.
            seed: of this run.
            recall: slow results; they change no bit.
        """
        source = DetectedLoopClosures(data, config, seed, recall)
        self.data, self.evidence = data, Sharing(data, team, config, seed, recall=recall)
        super().__init__(
            source.database.graph,
            team,
            neighbors,
            config,
            seed=seed,
            loop_closing=source,
            sharing=self.evidence,
        )

    @property
    def knowledge(self) -> Knowledge:
        """What came from others."""
        return self.evidence.knowledge
