"""Renders against images: scores of one view, and means over sets of views (docs/reference/metrics.md, "Rendering")."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from threading import local
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.ahead import in_order
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.evaluation import image_metrics
from duagc.pipeline.evaluation.exposure import fitted_psnr
from duagc.pipeline.evaluation.image_metrics import SsimReference
from duagc.pipeline.evaluation.results import Absent, mean
from duagc.pipeline.geometry import masks, se3
from duagc.pipeline.geometry.exposure import Exposure
from duagc.pipeline.geometry.masks import Mask
from duagc.pipeline.kernels.squared_error_definition import ExposedRender
from duagc.pipeline.splat.gaussians import Gaussians

if TYPE_CHECKING:
    from duagc.pipeline.geometry.camera import PinholeCamera
    from duagc.pipeline.kernels import Render
    from duagc.pipeline.recording import RgbdFrame

Score = float | Absent
PSNR_CEILING_DB = 100.0  # of a render equal to its image: infinity has no place in a JSON file
MS_SSIM_MIN_SIDE_PX = 176  # the 11 px window at the fifth scale
MIN_ALPHA = 0.5
NO_LAYER = Absent("the depth of one layer was not drawn")
NO_PIXEL = Absent("the mask leaves no pixel of the image")
NO_WINDOW = Absent("no window of SSIM has usable pixels only")
NO_OTHER = Absent("no other map was drawn from this view")
NO_LPIPS = Absent("LPIPS needs the weights of a trained network, which this build does not carry")


@dataclass(frozen=True)
class ViewScore:
    """Scores of one rendered view; names and meanings as in metrics.json."""

    psnr_db: Score
    psnr_interpolated_db: Score
    psnr_moved_db: Score
    psnr_exposure_db: Score
    psnr_exposure_left_db: Score
    psnr_exposure_right_db: Score
    ssim: Score
    ms_ssim: Score
    depth_l1_m: Score
    depth_l1_exact_m: Score
    depth_l1_layer_m: Score
    depth_l1_common_m: Score
    depth_completeness: Score


class ComparedImage:
    """An image that renders are compared with; what depends on it alone is computed once."""

    def __init__(self, color: NDArray[np.uint8], mask: Mask | None = None) -> None:
        """Convert the colors to 0..1.

        Args:
            color: [h, w, 3] RGB.
            mask: bool [h, w], pixels that may be used; None: all.
        """
        self.color: NDArray[np.float32] = (color.astype(np.float64) / 255.0).astype(np.float32)
        self.mask = mask
        self.structure = SsimReference(self.color, mask)


def surface_depth(render: Render) -> NDArray[np.float32]:
    """Depth [h, w] in meters of what was rendered: blended depth / alpha where alpha >= 0.5, else 0.

    Args:
        render: with blended depth [h, w] (meters times alpha) and alpha [h, w].
    """
    covered = render.alpha >= MIN_ALPHA
    depth = np.zeros(render.alpha.shape, dtype=np.float32)
    depth[covered] = render.depth[covered] / render.alpha[covered]
    return depth


def score_view(
    render: Render,
    image: ComparedImage,
    depth_m: NDArray[np.float32],
    exact_m: Any,
    *,
    layer_m: Any = NO_LAYER,
    common: NDArray[np.bool_] | None = None,
    exposure: Exposure | None = None,
    moved: Render | None = None,
) -> ViewScore:
    """Compare a render with the image of the same pose, on the pixels that may be used.

    Args:
        render: of the map, at the pose of the frame, black background.
        image: of the frame, with its mask: the other pixels count in no score, and windows of SSIM that touch one are
            left out.
        depth_m: recorded depth [h, w], 0 where there is none.
        exact_m: exact depth [h, w] in meters, or Absent.
        layer_m: depth of one layer per pixel (`Rasterizer.forward_with_layer`), [h, w] in meters, or Absent.
        common: [h, w], pixels that the maps that this one is compared with cover, too; None: there are none.
        exposure: of the view, by frames other than it, for `psnr_interpolated_db` and `psnr_moved_db` alone. None: as
            the map.
        moved: the map as the camera saw it that moved while its shutter was open, for `psnr_moved_db` alone; None: it
            stood still.
    """
    mask = image.mask
    if mask is not None:
        depth_m = np.where(mask, depth_m, np.float32(0))
        exact_m = exact_m if isinstance(exact_m, Absent) else np.where(mask, exact_m, np.float32(0))
    l1_m, completeness = _depth(render, depth_m, "recorded")
    ssim, ms_ssim = _structure(render, image.structure, min(image.color.shape[:2]))
    psnr_db = _psnr(render, image)
    fitted = _psnr_in_fitted_exposure(render, image)
    interpolated_db = psnr_db if exposure is None else _psnr(render, image, exposure)
    return ViewScore(
        psnr_db=psnr_db,
        psnr_interpolated_db=interpolated_db,
        psnr_moved_db=interpolated_db if moved is None else _psnr(moved, image, exposure),
        psnr_exposure_db=fitted[0],
        psnr_exposure_left_db=fitted[1],
        psnr_exposure_right_db=fitted[2],
        ssim=ssim,
        ms_ssim=ms_ssim,
        depth_l1_m=l1_m,
        depth_l1_exact_m=exact_m if isinstance(exact_m, Absent) else _depth(render, exact_m, "exact")[0],
        depth_l1_layer_m=layer_m if isinstance(layer_m, Absent) else _layer(layer_m, depth_m),
        depth_l1_common_m=NO_OTHER if common is None else _common(render, depth_m, common),
        depth_completeness=completeness,
    )


def in_exposure(render: Render, exposure: Exposure | None) -> Render:
    """A render of a map, on black, in the colors of an image.

    Args:
        render: in the colors of the map.
        exposure: of the image; None: as the map.
    """
    if exposure is None:
        return render
    return replace(render, color=exposure.in_image(render.color, render.alpha))


def _psnr(render: Render, image: ComparedImage, exposure: Exposure | None = None) -> Score:
    """PSNR of a render, in an exposure if one is given."""
    if image.mask is not None and not image.mask.any():
        return NO_PIXEL
    gain, offset = image_metrics.NEITHER if exposure is None else (exposure.gain, exposure.offset)
    drawn = ExposedRender(render.color, render.alpha, gain.astype(np.float32), offset.astype(np.float32))
    return min(image_metrics.psnr_in_exposure(drawn, image.color, image.mask), PSNR_CEILING_DB)


def _psnr_in_fitted_exposure(render: Render, image: ComparedImage) -> tuple[Score, Score, Score]:
    """PSNR of the whole view, its left and its right half, each half in the exposure fitted on the other half."""
    found = fitted_psnr(render, image.color, image.mask)
    if isinstance(found, Absent):
        return found, found, found
    both, left, right = (min(value, PSNR_CEILING_DB) for value in (found.both, found.left, found.right))
    return both, left, right


def _structure(render: Render, reference: SsimReference, side_px: int) -> tuple[Score, Score]:
    """SSIM and MS-SSIM."""
    if not reference.has_windows(1):
        return NO_WINDOW, NO_WINDOW if side_px >= MS_SSIM_MIN_SIDE_PX else _too_small(side_px)
    if side_px < MS_SSIM_MIN_SIDE_PX:
        return reference.ssim(render.color), _too_small(side_px)
    if not reference.has_windows(len(image_metrics.MS_SSIM_WEIGHTS)):
        return reference.ssim(render.color), NO_WINDOW
    return reference.both(render.color)


def _too_small(side_px: int) -> Absent:
    return Absent(f"the shorter side is {side_px} px; five scales need {MS_SSIM_MIN_SIDE_PX} px")


def _layer(layer_m: NDArray[np.float32], depth_m: NDArray[np.float32]) -> Score:
    """L1 of the depth of one layer over the pixels that have both depths."""
    both = (layer_m > 0) & (depth_m > 0)
    count = np.count_nonzero(both)
    if not count:
        return Absent("no pixel has both a layer that stops half of its light and a recorded depth")
    return masks.total(np.abs(layer_m - depth_m), both) / count


def _common(render: Render, depth_m: NDArray[np.float32], common: NDArray[np.bool_]) -> Score:
    """L1 over the pixels that all compared maps cover."""
    l1_m, completeness = image_metrics.depth_error(
        render, np.where(common, depth_m, np.float32(0)), MIN_ALPHA
    )
    return l1_m if completeness > 0 else Absent("no pixel with recorded depth is covered by all maps")


def _depth(render: Render, reference_m: NDArray[np.float32], name: str) -> tuple[Score, Score]:
    """L1 over pixels that have both depths, and the share of the reference's valid pixels that are rendered."""
    if not np.any(reference_m > 0):
        absent = Absent(f"the {name} depth image has no valid pixel")
        return absent, absent
    l1_m, completeness = image_metrics.depth_error(render, reference_m, MIN_ALPHA)
    if completeness == 0.0:
        return Absent(f"no pixel has both a rendered and a {name} depth"), 0.0
    return l1_m, completeness


@dataclass(frozen=True)
class ScoredFrame:
    """A frame that maps are rendered at and compared with.

    Attributes:
        frame: its image and depth.
        exact_depth_m: [h, w] in meters, or Absent with the reason.
        exposure: of the frame, as its robot knows it from other frames; None: as the map.
        T_camera_moment: [k, 4, 4], where the camera was while its shutter was open, as its robot knows it, seen from
            the middle; None: it stood still.
    """

    frame: RgbdFrame
    exact_depth_m: Any
    exposure: Exposure | None = None
    T_camera_moment: NDArray[np.float64] | None = None


def score_maps(
    maps: Mapping[str, tuple[Gaussians, Mapping[int, NDArray[np.float64]]]],
    camera: PinholeCamera,
    views: Iterable[ScoredFrame],
    *,
    threads: int,
    depth: DepthKind = "blended",
    compared: Sequence[str] = (),
) -> Iterator[tuple[int, dict[str, ViewScore | Absent]]]:
    """Render maps from every view and score them, in order of the views.

    Args:
        maps: by name, with the T_frame_camera [4, 4] of the views in the map's frame, by time stamp in ns; a
            map whose poses lack a view is Absent there.
        camera: of the views.
        views: what is rendered and compared.
        threads: views at a time, each with a rasterizer of one thread; changes no bit of the result.
        depth: of a Gaussian at a pixel, as the maps were made.
        compared: names of the maps whose common pixels `depth_l1_common_m` is over.
    Yields:
        Frame index and scores by the maps' names.
    """
    from duagc.pipeline.kernels import Rasterizer
    from duagc.pipeline.kernels.moving_views import draw_moving

    own = local()

    def score(view: ScoredFrame) -> tuple[int, dict[str, ViewScore | Absent]]:
        if not hasattr(own, "rasterizer"):
            own.rasterizer = Rasterizer(threads=1)
        frame, drawn = view.frame, {}
        for name, (gaussians, poses) in maps.items():
            T = poses.get(frame.stamp_ns)
            if T is not None:
                render, layer_m = own.rasterizer.forward_with_layer(
                    gaussians, camera, se3.inverse(T), depth_kind=depth
                )
                moved = None
                if view.T_camera_moment is not None:
                    passed = T @ view.T_camera_moment
                    moved = draw_moving(own.rasterizer, gaussians, camera, passed, depth_kind=depth)
                drawn[name] = render, layer_m, moved
        image = ComparedImage(frame.color, frame.mask)
        together = [drawn[name][0].alpha >= MIN_ALPHA for name in compared if name in drawn]
        common = np.logical_and.reduce(together) if len(together) > 1 else None
        scores: dict[str, ViewScore | Absent] = dict.fromkeys(
            maps, Absent("the trajectory has no pose of this frame")
        )
        for name, (render, layer_m, moved) in drawn.items():
            scores[name] = score_view(
                render,
                image,
                frame.depth,
                view.exact_depth_m,
                layer_m=layer_m,
                common=common,
                exposure=view.exposure,
                moved=moved,
            )
        return frame.index, scores

    yield from in_order(score, views, threads)


def summary(scores: Sequence[ViewScore | Absent], reason_if_none: str) -> dict[str, Any]:
    """Means over the views that were rendered, in the layout of metrics.json.

    A value that is absent in every view is absent in the mean, with the reason of the first view.

    Args:
        scores: of every view; Absent where the trajectory has no pose of it.
        reason_if_none: why values are absent if no view was rendered.
    """
    rendered = [s for s in scores if not isinstance(s, Absent)]
    without = Absent(reason_if_none)
    means = {
        field.name: mean([getattr(s, field.name) for s in rendered]) if rendered else without
        for field in fields(ViewScore)
    }
    return {
        "views": len(rendered),
        "views_without_pose": len(scores) - len(rendered),
        "psnr_db": means["psnr_db"],
        "psnr_interpolated_db": means["psnr_interpolated_db"],
        "psnr_moved_db": means["psnr_moved_db"],
        "psnr_exposure_db": means["psnr_exposure_db"],
        "psnr_exposure_left_db": means["psnr_exposure_left_db"],
        "psnr_exposure_right_db": means["psnr_exposure_right_db"],
        "ssim": means["ssim"],
        "ms_ssim": means["ms_ssim"],
        "lpips": NO_LPIPS,
        "st_lpips": NO_LPIPS,
        "depth_l1_m": means["depth_l1_m"],
        "depth_l1_exact_m": means["depth_l1_exact_m"],
        "depth_l1_layer_m": means["depth_l1_layer_m"],
        "depth_l1_common_m": means["depth_l1_common_m"],
        "depth_completeness": means["depth_completeness"],
    }
