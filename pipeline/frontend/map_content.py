"""What is in a map that grows: its views and its Gaussians, and which are inserted and removed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, SupportsIndex

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.frontend.contributions import contributions
from duagc.pipeline.frontend.growing_map import GrowingMap, Indices
from duagc.pipeline.frontend.mapping_views import Image, View
from duagc.pipeline.frontend.view_selection import covisible
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.view_extent import ViewExtent
from duagc.pipeline.kernels import Rasterizer, Render
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.seeding import seed_discs, unexplained, worst_drawn


class MapContent:
    """Views and Gaussians of a map, or of a tile of one."""

    def __init__(
        self,
        camera: PinholeCamera,
        config: MappingConfig,
        *,
        depth: DepthKind,
        threads: SupportsIndex = 1,
        begun: GrowingMap | None = None,
    ) -> None:
        """Begin without a view.

        Args:
            camera: of all views.
            config: how the map is grown and optimized.
            depth: of a Gaussian at a pixel.
            threads: of the rasterizer; changes no bit of the map.
            begun: the Gaussians of a tile of the map; None: an empty map.
        """
        self.config, self.depth = config, depth
        self.cameras = (camera, camera.halved())
        self.rasterizer = Rasterizer(threads=threads)
        self._map = GrowingMap(config, threads=threads) if begun is None else begun
        self._views: list[View] = []
        self._support: list[View] = []
        self._borders: list[View] = []

    @property
    def gaussians(self) -> Gaussians:
        """The map so far, in the map frame."""
        return self._map.gaussians

    @property
    def growing_map(self) -> GrowingMap:
        """The Gaussians with all that is known of them."""
        return self._map

    @property
    def keyframe_poses(self) -> NDArray[np.float64]:
        """Poses [k, 4, 4] of the keyframes; `finalize` refines them."""
        return np.array([view.T_map_camera for view in self._views]).reshape(-1, 4, 4)

    @property
    def support_poses(self) -> NDArray[np.float64]:
        """Poses [m, 4, 4] of the supporting frames, in the order in which they were added; `finalize` refines them."""
        return np.array([view.T_map_camera for view in self._support]).reshape(-1, 4, 4)

    @property
    def border_keyframes(self) -> list[int]:
        """Indices of the keyframes of other tiles that take part, in the order in which they were added."""
        return [view.index for view in self._borders]

    def open_shutter(self, moments: Sequence[NDArray[np.float64] | None]) -> None:
        """Say where the camera is while its shutter is open.

        Args:
            moments: T_camera_moment [k, 4, 4] of keyframes, of supporting frames, and of keyframes of other tiles,
                as of `TrainingView`.
        """
        views = (*self._views, *self._support, *self._borders)
        for view, T_camera_moment in zip(views, moments, strict=True):
            view.T_camera_moment = T_camera_moment

    def state(self) -> tuple[Any, ...]:
        """The map and the poses of the views; `go_on` takes it."""
        return self._map.state(), [view.T_map_camera for view in (*self._views, *self._support)]

    def go_on(self, state: tuple[Any, ...]) -> None:
        """Go on from where another one was.

        Args:
            state: of that one, which had the views that are here now.
        """
        of_map, poses = state
        self._map.go_on(of_map)
        for view, T_map_camera in zip((*self._views, *self._support), poses, strict=True):
            view.T_map_camera = T_map_camera

    def begin(self, begun: GrowingMap) -> None:
        """Begin with other Gaussians, and the same views.

        Args:
            begun: the Gaussians of the tile.
        """
        self._map = begun

    def _seen(self, view: View) -> Gaussians:
        """What a view may see of other tiles, and all that is the tile's own."""
        return self._map.seen_with(self._guests(view)) if self._map.guests else self._map.gaussians

    def _guests(self, view: View) -> Indices:
        """Rows of the guests that a view may see, by where they and the view were when the tile was begun."""
        if view.guests is None:
            sight = ViewExtent.of(view.depth_m, self.cameras[0])
            view.guests = np.flatnonzero(sight.sees(*self._map.guests_begun, view.T_map_begun))
        return view.guests

    def _draw(self, view: View) -> Render:
        T_camera_map = se3.inverse(view.T_map_camera)
        return self.rasterizer.forward(self._seen(view), self.cameras[0], T_camera_map, depth_kind=self.depth)

    def _seed(self, view: View, share: float) -> tuple[int, int]:
        """Insert discs for what the map does not explain of a view; numbers of inserted and pruned Gaussians."""
        config = self.config
        budget = int(share * config.max_gaussians)
        color, (depth_m, sigma_m) = view.images(0)[0], view.seed_depth
        wanted = depth_m > 0  # zero where the mask forbids a pixel
        if len(self._map):
            render = self._draw(view)
            color = self._as_drawn(view, color, render)
            wanted = unexplained(render, color, depth_m, config.seeding, depth_sigma_m=sigma_m)
        new = self._discs(view, color, depth_m, wanted, budget=budget)
        excess = len(self._map) + len(new) - self._map.cap
        views = [*self._borders, *self._views]
        swept = covisible(
            views, view, config.sweep_keyframes, candidates=config.candidates, camera=self.cameras[0]
        )
        self._map.update_contributions(*self._contributions(swept))
        pruned = self._map.prune_least(excess) if excess > 0 else 0
        self._map.append(new)
        return len(new), pruned

    def _as_drawn(self, view: View, color: Image, render: Render) -> Image:
        """The view's colors; where the mask forbids a pixel, those of the render."""
        # errors are smoothed: a masked pixel must not count through its neighbors
        return color if view.mask is None else np.where(view.mask[..., None], color, render.color)

    def _discs(
        self, view: View, color: Image, depth_m: Image, wanted: NDArray[np.bool_], *, budget: int
    ) -> Gaussians:
        return seed_discs(
            color,
            depth_m,
            wanted,
            self.cameras[0],
            T_map_camera=view.T_map_camera,
            budget=budget,
            first_id=self._map.next_id,
            anchor=view.index,
            config=self.config.seeding,
        )

    def _cover(self) -> tuple[int, int]:
        """Insert discs where supporting views see what no keyframe saw; numbers of inserted and pruned Gaussians."""
        config = self.config
        if not config.support_seeds or not self._support:
            return 0, 0
        inserted = 0
        for view in self._support:
            render = self._draw(view)
            color, depth_m = view.images(0)
            thin = (depth_m > 0) & (render.alpha < config.seeding.min_alpha)
            new = self._discs(
                view, color, depth_m, thin, budget=int(config.keyframe_share * config.max_gaussians)
            )
            self._map.append(new)
            inserted += len(new)
        excess = len(self._map) - self._map.cap
        if excess <= 0:
            return inserted, 0
        views = [*self._views, *self._support, *self._borders]
        self._map.contribution = self._contributions(views)[0]
        return inserted, self._map.prune_least(excess)

    def _prune_useless(self, looked_at: Sequence[View], views: int) -> int:
        """Remove what contributes nothing to the views that are looked at, of so many; how many there were.

        What none of some views sees stays, and guests do.
        """
        found, seen = self._contributions(looked_at)
        least = self.config.min_contribution * len(looked_at) / views
        return self._map.keep((found >= least) | (~seen & (len(looked_at) < views)) | self._map.is_guest)

    def _densify(self, share: float) -> int:
        """Insert discs where keyframes are drawn worst; how many.

        `share` of the room below the cap is used. Every keyframe gets an equal part of it, in turn, and sees what
        those before it inserted; no more than an eighth of its finest cells is seeded.
        """
        room = int(share * self._map.room)
        inserted = 0
        for k, view in enumerate(self._views):
            budget = room * (k + 1) // len(self._views) - room * k // len(self._views)
            render = self._draw(view)
            color, depth_m = view.images(0)[0], view.seed_depth[0]
            color = self._as_drawn(view, color, render)
            budget = min(budget, depth_m.size // (8 * self.config.seeding.cell_sizes_px[-1] ** 2))
            wanted = worst_drawn(render, color, depth_m, count=budget, config=self.config.seeding)
            new = self._discs(view, color, depth_m, wanted, budget=budget)
            self._map.append(new)
            inserted += len(new)
        return inserted

    def _contributions(self, views: Sequence[View]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """What these views would lack of each Gaussian; and if any saw it (`contributions`)."""
        return contributions(
            self.gaussians, views, self.rasterizer, self.config, camera=self.cameras[0], depth=self.depth
        )
