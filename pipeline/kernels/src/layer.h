// Depth of one layer: that of the surface which stops most of a pixel's light, where the blended depth is a mean over all of them.
#pragma once

#include "blending.h"

namespace KERNEL_ISA {

// Mean depth by weight of the Gaussians within `tolerance` (relative) of the one behind which less than half of the light is left; 0
// where there is none. `kept`: room for weight and depth of `count` items and three more.
template <DepthKind KIND>
NO_INLINE static Vec layer_of_block(const Splat* splats, const TileItems items, uint32_t count, const Block& block, float tolerance,
                                    float* kept) {
    const Vec pixel_x = block.pixels_x(), pixel_y = block.pixels_y(), half(0.5f), zero(0.0f);
    Vec median(0.0f), T(1.0f);
    const auto blend = [&](uint32_t first, auto visit) ALWAYS_INLINE {  // calls visit(item, weight, depth, T in front)
        Vec alpha[ABREAST], rest[ABREAST], z[ABREAST];
        unrolled<ABREAST>([&](auto k) ALWAYS_INLINE {
            const bool there = first + k < count;
            const Splat& s = splats[items.positions[there ? first + k : first]];
            alpha[k] = Whitened(s, pixel_x, pixel_y).log2_alpha(s);
            z[k] = depth_at<KIND>(s, pixel_x, pixel_y);
            alpha_and_rest(alpha[k], mask_of_bits(there ? items.pixels[first + k] : uint16_t{0}), rest[k]);
        });
        unrolled<ABREAST>([&](auto k) ALWAYS_INLINE {
            const Vec before = T;
            T = T * rest[k];
            visit(first + k, alpha[k] * before, z[k], before);
        });
    };
    uint32_t item = 0;
    for (; item < count && any(T >= half); item += ABREAST)
        blend(item, [&](uint32_t i, Vec weight, Vec z, Vec before) ALWAYS_INLINE {
            median = select((before >= half) & (T < half), z, median);
            store(kept + static_cast<size_t>(i) * 2 * LANES, weight);
            store(kept + static_cast<size_t>(i) * 2 * LANES + LANES, z);
        });
    const Vec nearest = median * Vec(1.0f - tolerance), farthest = median * Vec(1.0f + tolerance);
    Vec weights(0.0f), depths(0.0f);
    const auto add = [&](Vec weight, Vec z) ALWAYS_INLINE {
        const Vec own = select_or_zero((z >= nearest) & (z <= farthest), weight);
        weights += own;
        depths = fma(own, z, depths);
    };
    for (uint32_t i = 0; i < item; i++)
        add(load(kept + static_cast<size_t>(i) * 2 * LANES), load(kept + static_cast<size_t>(i) * 2 * LANES + LANES));
    for (; item < count; item += ABREAST) {
        if (KIND == DepthKind::blended && !any(Vec(splats[items.positions[item]].z) <= farthest)) break;  // sorted by this depth
        blend(item, [&](uint32_t, Vec weight, Vec z, Vec) ALWAYS_INLINE { add(weight, z); });
    }
    return select_or_zero(zero < median, depths / max(weights, Vec(1e-8f)));
}

template <DepthKind KIND>
inline void layer_tile(Frame& frame, int index, float tolerance, float* depth) {
    const Tile tile(frame, index);
    const Splat* splats = gather_splats(frame, tile);
    TileItems items(frame, index);
    float* kept = frame.front.data() + this_thread() * (frame.longest_list + ABREAST) * LANES * 2;
    for (int b = 0; b < BLOCKS; b++) {
        const Block block(tile, b, frame.view);
        if (block.outside(frame.view)) continue;
        const uint32_t count = items.counts[b];
        write_block(depth, block, frame.view, layer_of_block<KIND>(splats, items, count, block, tolerance, kept));
        items.skip(count);
    }
}

}  // namespace KERNEL_ISA
