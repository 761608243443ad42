"""Joint optimization of keyframe poses by the images themselves.

`optimize` minimizes the sum of the photometric and point-to-plane costs of all pairs of keyframes that see the same
surfaces. The cost of a pair is expanded to a quadratic at the present poses (`registration.linearize`), and quadratics
are solved together; a registration of each pair by itself would converge to its own minimum first, and pairs with
little overlap find wrong ones. A pair is expanded again only when the motion between its keyframes has changed. The
quadratics at the answer are the factors of the robot's pose graph.

The work per keyframe is bounded however long the path is: overlaps are computed with a bounded number of earlier
keyframes, the best few become pairs, and the number of rounds is bounded. Only the sparse solution is over all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, Protocol

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.checkpoints import NO_CHECKPOINTS, Checkpoints
from duagc.pipeline.config.frontend import KeyframeConfig
from duagc.pipeline.frontend.keyframe_graph import OptimizedKeyframes, overlap, solve_pose_graph
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.registration import (
    Level,
    Outcome,
    Reference,
    ReferenceLevel,
    Registration,
    RegistrationConfig,
    RgbdPyramid,
    linearize,
)
from duagc.pipeline.registration.bearing_motion import BearingMatches, BearingMotion, motion_from_bearings
from duagc.pipeline.registration.features import Features

Ends = tuple[int, int]  # of a pair: the earlier keyframe, the later one
CONVERGED = 1e-4  # m, rad: Gauss-Newton steps shrink fast, what is left after such a one is far smaller
EXCLUDED_SIGMAS = 20.0  # by tracking, which is several of them off at times
HARDLY = 0.1  # of what tracking excludes by
UNUSABLE = (Outcome.LOW_OVERLAP, Outcome.RESIDUAL)  # weak directions carry no information and do no harm


class KeyframeView(Protocol):
    """What is kept of a keyframe in memory."""

    @property
    def reference(self) -> Reference:
        """Samples at all levels."""
        ...

    @property
    def coarsest(self) -> Level:
        """The coarsest image."""
        ...

    @property
    def features(self) -> Features:
        """Features with depth."""
        ...


Images = Callable[[int, int], RgbdPyramid]
"""The images of a keyframe, by its index and the number of levels; read again from the log when needed, so that memory
stays bounded."""


def optimize(
    T_map_keyframes: Array,
    views: Sequence[KeyframeView],
    images: Images,
    tracked: Sequence[RelativePose],
    *,
    closures: Sequence[RelativePose] = (),
    config: KeyframeConfig,
    registration: RegistrationConfig,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
    part: str = "bundle",
) -> tuple[OptimizedKeyframes, list[RelativePose]]:
    """Keyframe poses that explain the images of all overlapping keyframes best; the first keyframe stays.

    Args:
        T_map_keyframes: [k, 4, 4], start.
        views: of the k keyframes.
        images: reads the images of a keyframe.
        tracked: registrations that connect the keyframes; they are factors where the images of a pair cannot be
            compared, or no longer determine what tracking had determined.
        closures: loop closures; factors where the images of a pair cannot be compared.
        config: numbers of rounds and neighbors.
        registration: settings of the costs.
        checkpoints: of the stage.
        part: its name there.

    Returns:
        The poses, and one factor per pair of keyframes: sum of factors = the joint cost at the answer, to second order.
    """
    neighborhood, known = Neighborhood(views, config), [*tracked, *closures]
    costs = _Costs(views, images, known, config=config, registration=registration)
    rounds = partial(
        _rounds, T_map_keyframes, neighborhood, costs, known, config=config, checkpoints=checkpoints
    )
    solution, factors = rounds(part=part)
    if costs.hold_strayed(tracked):
        solution, factors = rounds(part=f"{part}.held")
    return solution, factors


def _rounds(
    T_map_keyframes: Array,
    neighborhood: Neighborhood,
    costs: _Costs,
    tracked: Sequence[RelativePose],
    *,
    config: KeyframeConfig,
    checkpoints: Checkpoints,
    part: str,
) -> tuple[OptimizedKeyframes, list[RelativePose]]:
    """Expand costs and solve, in turn, from a start."""
    solution = solve_pose_graph(T_map_keyframes, tracked, config.huber_sigmas)
    coarse_rounds = config.coarse_rounds if _is_far(T_map_keyframes, tracked, config.coarse_from) else 0
    factors = list(tracked)
    ends: list[Ends] = []
    first = 0
    if (saved := checkpoints.resume(part)) is not None:
        first, (solution, factors, ends, expanded) = saved
        costs.go_on(expanded)
    for index in range(first, config.optimization_rounds):
        T = solution.T_map_keyframe
        if index in (0, coarse_rounds, config.optimization_rounds // 2):
            ends = _in_order({(pair.i, pair.j) for pair in tracked} | set(neighborhood.pairs(T)))
        costs.expand(ends, T, level=max(0, coarse_rounds - index))
        factors = costs.factors(ends)
        solution = solve_pose_graph(T, factors, config.huber_sigmas)
        moved_m, turned_rad = se3.distance(T, solution.T_map_keyframe)
        if index > coarse_rounds and max(moved_m.max(), turned_rad.max()) < CONVERGED:
            break
        state = partial(_state, solution, factors, ends, costs)
        checkpoints.at(part, index + 1, config.optimization_rounds, state)
    return solution, factors


def _state(
    solution: OptimizedKeyframes, factors: list[RelativePose], ends: list[Ends], costs: _Costs
) -> tuple[Any, ...]:
    """From which the optimization can go on."""
    return solution, factors, ends, costs.expanded()


def _in_order(pairs: Iterable[Ends]) -> list[Ends]:
    return sorted(pairs, key=lambda pair: (pair[1], pair[0]))


def _is_far(T: Array, pairs: Sequence[RelativePose], limit: float) -> bool:
    """Whether some registration contradicts the poses by more than a limit (m, rad)."""
    found = (se3.distance(pair.T_i_j, se3.inverse(T[pair.i]) @ T[pair.j]) for pair in pairs)
    return any(max(moved_m, turned_rad) > limit for moved_m, turned_rad in found)


class _Costs:
    """The costs of pairs of keyframes as quadratics, each where it was last expanded."""

    def __init__(
        self,
        views: Sequence[KeyframeView],
        images: Images,
        tracked: Sequence[RelativePose],
        *,
        config: KeyframeConfig,
        registration: RegistrationConfig,
    ) -> None:
        self._views, self._registration = views, registration
        self._images = images
        self._min_overlap, self._ratio = 0.8 * config.optimization_overlap, config.judgment.ratio
        self._tracked = {(pair.i, pair.j): pair for pair in tracked}
        self._held: set[Ends] = set()  # pairs that keep to tracking
        self._found: dict[Ends, RelativePose | None] = {}  # None: the images cannot be compared
        self._where: dict[Ends, tuple[Array, int]] = {}  # motion and level of the last expansion
        self._exposures: dict[Ends, tuple[float, float]] = {}  # of (reference, target)
        self._by_bearings: dict[Ends, BearingMotion | None] = {}  # None: too few agree, or depth is enough

    def expanded(self) -> tuple[Any, ...]:
        """All that was expanded; `go_on` takes it."""
        return self._found, self._where, self._exposures, self._held, self._by_bearings

    def go_on(self, expanded: tuple[Any, ...]) -> None:
        """Go on from what was expanded before.

        Args:
            expanded: by other costs of the same keyframes.
        """
        self._found, self._where, self._exposures, self._held, self._by_bearings = expanded

    def factors(self, ends: Sequence[Ends]) -> list[RelativePose]:
        """The quadratics of pairs; of one that cannot be compared, the registration of tracking, if there is one.

        Args:
            ends: indices of the keyframes of every pair.
        """
        known = ({} if pair in self._held else self._found for pair in ends)
        found = (of.get(pair) or self._tracked.get(pair) for of, pair in zip(known, ends, strict=True))
        return [factor for factor in found if factor is not None]

    def hold_strayed(self, tracked: Sequence[RelativePose]) -> bool:
        """Keep to tracking, from now on, in pairs that have strayed from it; whether there are any.

        Args:
            tracked: registrations by tracking.
        """
        for pair in tracked:
            found = self._found.get((pair.i, pair.j))
            if found is not None and strayed(found, pair):
                self._held.add((pair.i, pair.j))
        return len(self._held) > 0

    def expand(self, ends: Sequence[Ends], T: Array, level: int = 0) -> None:
        """Expand the costs of pairs at the poses T, on an image level, unless that was done there before.

        Args:
            ends: indices of the keyframes of every pair.
            T: [k, 4, 4], poses in the map.
            level: of the images, 0 = finest.
        """
        ends = [pair for pair in ends if self._moved(pair, T, level)]
        results: dict[Ends, Registration] = {}
        loaded, pyramid = -1, None
        for reference, target in _in_order({*ends, *((b, a) for a, b in ends)}):
            if target != loaded:
                loaded, pyramid = target, self._images(target, level + 1)
            assert pyramid is not None
            result = self._linearized(reference, target, pyramid, T, level=level)
            if self._comparable(result):
                self._exposures[reference, target] = result.exposure
                results[reference, target] = result
        for first, second in ends:
            T_first_second = se3.inverse(T[first]) @ T[second]
            factor = _factor(
                (first, second),
                T_first_second,
                forward=results.get((first, second)),
                backward=results.get((second, first)),
            )
            self._found[first, second] = self._with_bearings(factor, T_first_second)
            self._where[first, second] = T_first_second, level

    def _with_bearings(self, factor: RelativePose | None, T_first_second: Array) -> RelativePose | None:
        """The cost of a pair and that of its features without depth, where most of the images have none."""
        if factor is None:
            return None
        ends = factor.i, factor.j
        if ends not in self._by_bearings:
            first, second = (self._views[k].features for k in ends)
            few = first.bearings.few_depths or second.bearings.few_depths
            matched = BearingMatches.of(first, second, self._ratio) if few else None
            motion = None if matched is None else motion_from_bearings(matched, [T_first_second])
            self._by_bearings[ends] = motion if motion is not None and motion.accepted else None
        motion = self._by_bearings[ends]
        if motion is None:
            return factor
        away = se3.log(se3.inverse(factor.T_i_j) @ motion.T_first_second)
        information = factor.information + motion.information
        step = np.linalg.pinv(information, rcond=1e-10, hermitian=True) @ (motion.information @ away)
        return RelativePose(*ends, factor.T_i_j @ se3.exp(step), information)

    def _moved(self, pair: Ends, T: Array, level: int) -> bool:
        if pair not in self._where or self._where[pair][1] != level:
            return True
        motion = se3.inverse(T[pair[0]]) @ T[pair[1]]
        return float(np.max(se3.distance(self._where[pair][0], motion))) >= CONVERGED

    def _linearized(
        self, reference: int, target: int, pyramid: RgbdPyramid, T: Array, *, level: int
    ) -> Registration:
        samples, config = self._views[reference].reference, self._registration
        T_reference_target = se3.inverse(T[reference]) @ T[target]
        known = self._exposures.get((reference, target))
        if known is None:
            # gain and offset first: with wrong ones the weights of the gray values are wrong
            known = linearize(samples, pyramid, T_reference_target, config=config, level=level).exposure
        return linearize(samples, pyramid, T_reference_target, known, config=config, level=level)

    def _comparable(self, result: Registration) -> bool:
        """Whether two views show enough of the same surfaces at a pose, and agree there."""
        return result.outcome not in UNUSABLE and min(result.overlap, result.view) >= self._min_overlap


def _factor(
    ends: Ends, T_first_second: Array, *, forward: Registration | None, backward: Registration | None
) -> RelativePose | None:
    """Mean of the quadratics of a pair in both directions: both are made of the same two images."""
    information, force = np.zeros((6, 6)), np.zeros(6)
    count = (forward is not None) + (backward is not None)
    if forward is not None:
        information = information + forward.information
        force = force + forward.information @ se3.log(
            se3.inverse(T_first_second) @ forward.T_reference_target
        )
    if backward is not None:
        # T_second_first moves by -Ad(T_first_second) x if T_first_second moves by x
        turned = -se3.adjoint(T_first_second)
        information = information + turned.T @ backward.information @ turned
        force = force + turned.T @ backward.information @ se3.log(
            T_first_second @ backward.T_reference_target
        )
    if count == 0:
        return None
    information, force = 0.5 * (information + information.T) / count, force / count
    step = np.linalg.pinv(information, rcond=1e-10, hermitian=True) @ force
    return RelativePose(*ends, T_first_second @ se3.exp(step), information)


def strayed(found: RelativePose, tracked: RelativePose) -> bool:
    """Whether tracking excludes where the cost of a pair has its minimum, while that cost hardly excludes tracking.

    Other pairs can pull a keyframe to where it shares little with its neighbors, whose costs then resist no more.

    Args:
        found: the cost of the pair, where it was expanded.
        tracked: the registration of the same pair by tracking.
    """
    away = se3.log(se3.inverse(found.T_i_j) @ tracked.T_i_j)
    cost, cost_by_tracking = (float(away @ each.information @ away) for each in (found, tracked))
    return cost_by_tracking > EXCLUDED_SIGMAS**2 and cost < HARDLY * cost_by_tracking


class Neighborhood:
    """Which keyframes see each other.

    Overlaps are computed only where the balls around what two views see meet, and with no more than so many of them,
    those whose balls are nearest: a robot that stays in one room makes more keyframes there than it can compare.
    """

    def __init__(self, views: Sequence[KeyframeView], config: KeyframeConfig) -> None:
        """Look at the views one by one; pairs are compared later.

        Args:
            views: of the keyframes, in their order.
            config: least overlap, and number of neighbors.
        """
        self._views, self._config = views, config
        self._centers, self._radii = np.zeros((len(views), 3)), np.zeros(len(views))  # camera frames
        for k, view in enumerate(views):
            coarsest: ReferenceLevel = view.reference.levels[-1]
            if len(coarsest):
                points = coarsest.points.astype(np.float64)
                self._centers[k] = np.median(points, axis=0)
                self._radii[k] = np.quantile(np.linalg.norm(points - self._centers[k], axis=1), 0.9)

    def pairs(self, T: Array) -> list[Ends]:
        """Pairs of keyframes whose overlap, in both directions, reaches the limit; the best few of each later one.

        Args:
            T: [k, 4, 4], poses in the map.
        """
        return [(first, second) for second in range(1, len(T)) for first in self.before(second, T)]

    def before(self, second: int, T: Array) -> list[int]:
        """Earlier keyframes that overlap with one, most overlap first; the best few.

        Args:
            second: index of the keyframe.
            T: [k, 4, 4], poses in the map.
        """
        config, views = self._config, self._views
        centers = np.einsum("nij,nj->ni", T[: second + 1, :3, :3], self._centers[: second + 1])
        centers += T[: second + 1, :3, 3]
        distance = np.linalg.norm(centers[:second] - centers[second], axis=1)
        meeting = np.flatnonzero(distance < self._radii[:second] + self._radii[second])
        nearest = meeting[np.argsort(distance[meeting], kind="stable")[: config.optimization_candidates]]
        found = []
        for first in sorted(nearest.tolist()):
            T_first_second = se3.inverse(T[first]) @ T[second]
            T_second_first = se3.inverse(T_first_second)
            share = min(
                overlap(views[first].reference.levels[-1], views[second].coarsest, T_first_second),
                overlap(views[second].reference.levels[-1], views[first].coarsest, T_second_first),
            )
            if share >= config.optimization_overlap:
                found.append((-share, -first))
        return [-first for _, first in sorted(found)[: config.optimization_neighbors]]
