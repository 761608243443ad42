"""Settings of the simulated radio links and of the transport over them."""

from typing import Literal

from pydantic import Field, model_validator

from duagc.pipeline.config.base import Config


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
    """False: no robot has a link, whatever the topology."""
    topology: Literal["full", "ring", "chain", "star", "none", "range", "listed"] = "full"
    """Who can talk to whom: laid over the robots in alphabetical order (the center of the star is the first), by
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
    """Most that one robot sends to one neighbor in one round, headers included."""

    @model_validator(mode="after")
    def _consistent(self) -> "LinkConfig":
        if self.topology == "listed" and not self.windows:
            raise ValueError("exchange.link.windows is empty, expected the links of topology 'listed'")
        if self.topology == "range" and (self.range_m <= 0 or not self.waypoints):
            raise ValueError("exchange.link: topology 'range' expects range_m above 0 and waypoints")
        for window in self.windows:
            if window.sender == window.receiver:
                raise ValueError(
                    f"exchange.link.windows: {window.sender} to {window.receiver}, expected different robots"
                )
            if window.until_ns is not None and window.until_ns <= window.from_ns:
                raise ValueError(
                    f"exchange.link.windows: {window.sender} to {window.receiver} ends at {window.until_ns} ns, "
                    f"expected later than {window.from_ns} ns"
                )
        if self.windows and self.topology != "listed":
            raise ValueError(
                f"exchange.link.windows: topology is {self.topology!r}, expected 'listed' with them"
            )
        if (self.range_m > 0 or self.waypoints) and self.topology != "range":
            raise ValueError(
                f"exchange.link: topology is {self.topology!r}, expected 'range' with range_m and waypoints"
            )
        if self.burst_loss_probability < 1.0 and not self.burst_length_ns:
            raise ValueError(
                "exchange.link.burst_length_ns is 0, expected a length with burst_loss_probability"
            )
        return self


class TransportConfig(Config):
    """Selective acknowledgement and retransmission, in rounds."""

    signatures: Literal["none", "ed25519"] = "none"
    """Sign every packet (64 bytes behind its 1200) and refuse what its sender did not sign."""
    retransmit_after_rounds: int = Field(default=4, ge=1)
    """An unacknowledged packet of a reliable message is sent again after so many rounds."""
    contact_lost_after_rounds: int = Field(default=64, ge=1)
    """A neighbor not heard for so long gets one small beacon per round and nothing else."""
    silent_after_rounds: int = Field(default=200, ge=1)
    """A neighbor not heard for so long is given up; the agent ends without it."""
    max_message_bytes: int = Field(default=1 << 28, ge=1)
    """A message that claims to be larger is refused."""
    max_open_messages: int = Field(default=4096, ge=1)
    """Incomplete messages kept per neighbor; further ones are refused until some are complete."""
