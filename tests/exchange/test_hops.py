"""Hop counts: when a robot may say that all robots around have decided, or that all have converged."""

from types import SimpleNamespace
from typing import Any

import pytest

from duagc.pipeline.exchange.agent import WHOLE_COMPONENT, Agent

TEAM = ("alpha", "bravo", "charlie", "delta")
LINKS, REVOKED = 0b1011, 0b1000


def neighbor(hops: int, links: int = LINKS, revoked: int = REVOKED, *, decided: bool = True) -> Any:
    state = SimpleNamespace(links=links, revoked_links=revoked, alignment_hops=hops, converged_hops=hops)
    return SimpleNamespace(state=state, decided=decided, name="bravo")


class Poses:
    """A solver that has converged, or not."""

    T_world_keyframe = "agreed"

    def __init__(self, converged: bool) -> None:
        self.converged, self.refused = converged, []

    def advance(self) -> None: ...

    def messages(self) -> list[Any]:
        return []

    def refuted(self, _: str) -> bool:
        return False


def agent(*joined: Any, acknowledged: bool = True, poses: Poses | None = None) -> Any:
    """What of an agent the counts need."""
    final: list[str] = []
    self = SimpleNamespace(
        alignment=SimpleNamespace(links=LINKS, revoked=REVOKED),
        radio=SimpleNamespace(joined=list(joined)),
        neighbors=dict(enumerate(joined)),
        team=TEAM,
        alignment_hops=0,
        converged_hops=0,
        agreed=False,
        rounds_to_agreement=None,
        round=17,
        refused=SimpleNamespace(update=lambda _: None),
        loop_closing=SimpleNamespace(revokes=True),
        graph=SimpleNamespace(T_map_keyframe=["first"]),
        sharing=SimpleNamespace(offer_poses=lambda *_: None, add_poses=lambda T, first: final.append(T)),
        poses=poses,
        final=final,
        _frames=SimpleNamespace(advance=lambda: acknowledged),
        _all_agreed=lambda: False,
    )
    self._one_more_hop = lambda *given: Agent._one_more_hop(self, *given)
    return self


@pytest.mark.parametrize(
    ("joined", "expected"),
    [
        ((neighbor(2), neighbor(5)), 3),  # the least counts
        ((neighbor(9), neighbor(5, links=LINKS | 4)), 1),  # one knows other links of the team
        ((neighbor(9), neighbor(5, revoked=0)), 1),  # or other ones that do not count
        ((neighbor(9), SimpleNamespace(state=None)), 1),  # or has said nothing
        ((), WHOLE_COMPONENT),
        ((neighbor(WHOLE_COMPONENT),), WHOLE_COMPONENT),
    ],
)
def test_a_robot_is_one_hop_beyond_its_nearest_doubt(joined: tuple[Any, ...], expected: int) -> None:
    assert Agent._one_more_hop(agent(*joined), joined, lambda state: state.alignment_hops) == expected


@pytest.mark.parametrize(("hops", "expected"), [(0, 1), (2, 3), (3, WHOLE_COMPONENT)])
def test_all_have_decided_when_doubt_is_as_far_as_the_team_is_large(hops: int, expected: int) -> None:
    self = agent(neighbor(hops), neighbor(7))
    Agent._update_alignment(self)
    assert self.alignment_hops == expected


def test_nobody_counts_before_it_has_decided_and_its_neighbors_know() -> None:
    for self in (agent(neighbor(7, decided=False)), agent(neighbor(7), acknowledged=False)):
        self.alignment_hops = 3
        Agent._update_alignment(self)
        assert self.alignment_hops == 0


@pytest.mark.parametrize(("hops", "expected"), [(2, 3), (3, 4), (4, WHOLE_COMPONENT)])
def test_poses_are_final_a_round_after_all_have_converged(hops: int, expected: int) -> None:
    self = agent(neighbor(hops), poses=Poses(converged=True))
    self.alignment_hops = WHOLE_COMPONENT
    Agent._update_poses(self)
    assert self.converged_hops == expected
    assert self.agreed == (expected == WHOLE_COMPONENT)
    assert self.final == (["agreed"] if self.agreed else [])
    assert self.rounds_to_agreement == (17 if self.agreed else None)


def test_whoever_moves_again_begins_to_count_anew() -> None:
    self = agent(neighbor(4), poses=Poses(converged=False))
    self.alignment_hops, self.converged_hops = WHOLE_COMPONENT, 4
    Agent._update_poses(self)
    assert self.converged_hops == 0
    assert not self.agreed
