"""Configuration of the exchange: links, transport, places, verification, what is sent."""

from typing import Literal

from pydantic import Field, model_validator

from pipeline.config import Config
from pipeline.consensus.config import MatchingConfig, PoseConsensusConfig, WeightKind
from pipeline.registration import RegistrationConfig


class LinkWindow(Config):
    """A stretch of time in which one robot hears another."""

    sender: str
    receiver: str
    both_ways: bool = True
    """The receiver is heard by the sender as well."""
    from_ns: int = Field(default=0, ge=0)
    """Time since the beginning of the session."""
    until_ns: int | None = Field(default=None, ge=0)
    """The link dies here; not set: never."""
    loss_probability: float | None = Field(default=None, ge=0.0, le=1.0)
    """Instead of that of all links."""


class Waypoint(Config):
    """Where the radio of a robot is at one time of the session; in between it moves straight."""

    robot: str
    time_ns: int = Field(default=0, ge=0)
    position_m: tuple[float, float, float]
    """In one frame for all robots: a part of the scenario, known to the link model and to no robot."""


class LinkConfig(Config):
    """The simulated radio between two robots."""

    enabled: bool = True
    """False: nobody talks to anybody, whatever the topology."""
    topology: Literal["full", "ring", "chain", "star", "none", "range", "listed"] = "full"
    """Who can talk to whom: laid over the robots in alphabetical order (the centre of the star is the first), by
    distance (`range`, needs range_m and waypoints), or as `windows` say (`listed`)."""
    windows: tuple[LinkWindow, ...] = ()
    """Links of topology `listed`, each with the time in which it exists."""
    range_m: float = Field(default=0.0, ge=0.0)
    """Robots farther apart do not hear each other (topology `range`)."""
    waypoints: tuple[Waypoint, ...] = ()
    """Where the robots' radios are (topology `range`); every robot needs one."""
    loss_probability: float = Field(default=0.0, ge=0.0, le=1.0)
    """Chance that a packet is lost, independent of every other packet."""
    burst_gap_ns: int = Field(default=1_000_000_000, ge=1)
    """Mean time between two bursts of loss (Gilbert-Elliott: the good state)."""
    burst_length_ns: int = Field(default=0, ge=0)
    """Mean length of a burst (the bad state); 0: there are none."""
    burst_loss_probability: float = Field(default=1.0, ge=0.0, le=1.0)
    """Chance that a packet sent during a burst is lost."""
    latency_ns: int = Field(default=20_000_000, ge=0)
    """Least time from sending to delivery."""
    jitter_ns: int = Field(default=0, ge=0)
    """Further delay, drawn evenly from 0 to this; packets that overtake each other are reordered."""
    duplicate_probability: float = Field(default=0.0, ge=0.0, le=1.0)
    """Chance that a delivered packet arrives a second time, with a delay of its own."""
    bandwidth_bytes_per_s: int = Field(default=0, ge=0)
    """A packet occupies its directed link for its size over this; 0: for no time."""
    queue_ns: int = Field(default=1_000_000_000, ge=0)
    """A packet that would wait longer than this for the link is dropped by its sender's radio."""
    budget_bytes: int = Field(default=150_000, ge=2_400)
    """Most that one robot sends to one neighbour in one round, headers included."""

    @model_validator(mode="after")
    def _consistent(self) -> "LinkConfig":
        if self.topology == "listed" and not self.windows:
            raise ValueError("exchange.link.windows is empty, expected the links of topology 'listed'")
        if self.topology == "range" and (self.range_m <= 0 or not self.waypoints):
            raise ValueError("exchange.link: topology 'range' expects range_m above 0 and waypoints")
        for window in self.windows:
            if window.sender == window.receiver:
                raise ValueError(f"exchange.link.windows: {window.sender} is linked to itself")
            if window.until_ns is not None and window.until_ns <= window.from_ns:
                raise ValueError(
                    f"exchange.link.windows: {window.sender} to {window.receiver} ends at {window.until_ns} ns, "
                    f"expected later than {window.from_ns} ns"
                )
        return self


class TransportConfig(Config):
    """Selective acknowledgement and retransmission, in rounds."""

    signatures: Literal["none", "ed25519"] = "none"
    """Sign every packet (64 bytes behind its 1200) and refuse what its sender did not sign."""
    retransmit_after_rounds: int = Field(default=4, ge=1)
    """An unacknowledged packet of a reliable message is sent again after so many rounds."""
    contact_lost_after_rounds: int = Field(default=64, ge=1)
    """A neighbour not heard for so long gets one small beacon per round and nothing else."""
    silent_after_rounds: int = Field(default=200, ge=1)
    """A neighbour not heard for so long is given up; the agent ends without it."""
    max_message_bytes: int = Field(default=1 << 28, ge=1)
    """A message that claims to be larger is refused."""
    max_open_messages: int = Field(default=4096, ge=1)
    """Incomplete messages kept per neighbour; further ones are refused until some are complete."""


class PlacesConfig(Config):
    """Place descriptors and candidates for closures."""

    features_per_place: int = Field(default=80, ge=4)
    """Descriptors of one keyframe that a neighbour gets to recognise the place (128 bytes each)."""
    features_per_keyframe: int = Field(default=400, ge=4)
    """Descriptors with 3-D points of one keyframe, for verification."""
    ratio: float = Field(default=0.8, gt=0.0, lt=1.0)
    """Nearest over second-nearest distance below which a match counts."""
    min_score: int = Field(default=8, ge=1)
    """Matches from which a pair of keyframes is a candidate."""
    candidates_per_keyframe: int = Field(default=3, ge=1)
    """Best candidates tried for each keyframe of the neighbour."""
    max_requested_keyframes: int = Field(default=24, ge=1)
    """Most keyframes whose sample is requested from one neighbour."""
    keyframes_per_request: int = Field(default=6, ge=1)
    """Keyframes asked for at once; what came of them decides about the next."""
    worth_nats: float = Field(default=1.0, ge=0.0)
    """Least information about the two robots that a sample must promise, in nats; 0: all that the budget allows."""


class PeerRegistrationConfig(RegistrationConfig):
    """Registration of two robots' views, whose cameras may differ."""

    max_gain: float = 4.0
    """The gain must lie between 1 / max_gain and max_gain. A covered lens, which less would find out, has no features
    that agree on a motion."""


class VerificationConfig(Config):
    """From a candidate to a closure: RANSAC over 3-D matches, then registration."""

    hypotheses: int = Field(default=500, ge=1)
    """Three-point hypotheses per candidate."""
    inlier_m: float = Field(default=0.05, gt=0.0)
    """Distance below which a match agrees with a hypothesis, at one metre of depth; grows with depth."""
    min_inliers: int = Field(default=12, ge=4)
    """Matches that must agree."""
    min_inlier_share: float = Field(default=0.25, ge=0.0, le=1.0)
    """Share of the matches that must agree."""
    samples: int = Field(default=2000, ge=50)
    """Points with normal and intensity of the neighbour's keyframe used by the registration."""
    max_refinement_m: float = Field(default=0.15, gt=0.0)
    """Largest translation by which the registration may change what RANSAC found."""
    registration: PeerRegistrationConfig = PeerRegistrationConfig()
    """The registration itself."""
    max_refinement_rad: float = Field(default=0.10, gt=0.0)
    """Largest rotation by which the registration may change what RANSAC found."""


class InjectionConfig(Config):
    """Faults made on purpose; all off unless asked for."""

    false_closures: float = Field(default=0.0, ge=0.0, lt=1.0)
    """Share of false ones among all closures of a pair of robots that found any."""
    false_closure_m: float = Field(default=3.0, gt=0.0)
    """Largest coordinate of the translation of a false closure; its rotation is any."""
    false_matches: float = Field(default=0.0, ge=0.0, le=1.0)
    """Share of the matched Gaussians of a pair of robots whose partners are exchanged."""
    pose_dropouts: float = Field(default=0.0, ge=0.0, lt=1.0)
    """Chance that a robot says nothing of its poses to a neighbour in a round."""


class ExchangeConfig(Config):
    """One session of the team."""

    period_ns: int = Field(default=100_000_000, ge=1)
    """Length of one round."""
    max_rounds: int = Field(default=3000, ge=1)
    """The session ends here, whatever has been agreed."""
    solver: Literal["admm", "elimination"] = "admm"
    """Of the poses. admm: relaxed edge-ADMM, a few poses per round and link; elimination: exact steps along a tree of
    robots, matrices in few rounds."""
    elimination_wire: Literal["float32", "float64"] = "float64"
    """Precision of the matrices of elimination on the wire."""
    coverage: Literal["all", "overlap"] = "all"
    """Send every Gaussian to everybody, or only those in space that the receiver's keyframes saw."""
    evidence_wire: Literal["compact", "float32", "float64"] = "compact"
    """100 bytes per Gaussian, rounded far below its uncertainty, or 188, or 364 bytes and not rounded at all."""
    weights: WeightKind = "block"
    """How sure a robot says it is of a Gaussian: its information, or one of the simpler kinds to compare with
    (`docs/consensus.md`)."""
    evidence_order: Literal["gain", "paper"] = "gain"
    """Which Gaussians go first: those that promise the receiver most information per byte, or by the paper's (4)."""
    overlap_voxel_m: float = Field(default=0.25, gt=0.0)
    """Edge of the voxels that say which space a robot saw (coverage = overlap)."""
    link: LinkConfig = LinkConfig()
    transport: TransportConfig = TransportConfig()
    places: PlacesConfig = PlacesConfig()
    verification: VerificationConfig = VerificationConfig()
    consensus: PoseConsensusConfig = PoseConsensusConfig()
    matching: MatchingConfig = MatchingConfig()
    injection: InjectionConfig = InjectionConfig()
