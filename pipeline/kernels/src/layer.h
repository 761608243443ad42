// Depth of one layer: that of the surface which stops most of a pixel's light, where the blended depth is a mean over all of them.
#pragma once

#include "blending.h"

namespace KERNEL_ISA {

// Calls visit(splat, weight, T in front, T behind) for what the last forward pass blended in a block, front to back.
template <class Visit>
ALWAYS_INLINE inline void front_to_back(const Splat* splats, const TileItems& items, uint32_t count, const Block& block, Visit visit) {
    const Vec pixel_x = block.pixels_x(), pixel_y = block.pixels_y();
    Vec T(1.0f);
    for (uint32_t i = 0; i < count; i++) {
        const Splat& s = splats[items.positions[i]];
        Vec alpha = Whitened(s, pixel_x, pixel_y).log2_alpha(s), rest;
        alpha_and_rest(alpha, mask_of_bits(items.pixels[i]), rest);
        const Vec behind = T * rest;
        visit(s, alpha * T, T, behind);
        T = behind;
    }
}

// Mean depth by weight of the Gaussians within `tolerance` (relative) of the one behind which less than half of the light is left; 0
// where there is none.
template <DepthKind KIND>
NO_INLINE static Vec layer_of_block(const Splat* splats, const TileItems items, uint32_t count, const Block& block, float tolerance) {
    const Vec pixel_x = block.pixels_x(), pixel_y = block.pixels_y(), half(0.5f), zero(0.0f);
    Vec median(0.0f);
    front_to_back(splats, items, count, block, [&](const Splat& s, Vec, Vec before, Vec behind) ALWAYS_INLINE {
        median = select((before >= half) & (behind < half), depth_at<KIND>(s, pixel_x, pixel_y), median);
    });
    const Vec nearest = median * Vec(1.0f - tolerance), farthest = median * Vec(1.0f + tolerance);
    Vec weights(0.0f), depths(0.0f);
    front_to_back(splats, items, count, block, [&](const Splat& s, Vec weight, Vec, Vec) ALWAYS_INLINE {
        const Vec z = depth_at<KIND>(s, pixel_x, pixel_y);
        const Vec own = select_or_zero((z >= nearest) & (z <= farthest), weight);
        weights += own;
        depths = fma(own, z, depths);
    });
    return select_or_zero(zero < median, depths / max(weights, Vec(1e-8f)));
}

template <DepthKind KIND>
inline void layer_tile(Frame& frame, int index, float tolerance, float* depth) {
    const Tile tile(frame, index);
    const Splat* splats = gather_splats(frame, tile);
    TileItems items(frame, index);
    for (int b = 0; b < BLOCKS; b++) {
        const Block block(tile, b, frame.view);
        if (block.outside(frame.view)) continue;
        const uint32_t count = items.counts[b];
        write_block(depth, block, frame.view, layer_of_block<KIND>(splats, items, count, block, tolerance));
        items.skip(count);
    }
}

}  // namespace KERNEL_ISA
