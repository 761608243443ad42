// Images of a view: color, blended depth and alpha; and, where it is asked for, the depth of one layer, that of the surface which stops
// most of a pixel's light, where the blended depth is a mean over all of them.
#pragma once

#include "blending.h"

namespace KERNEL_ISA {

// Mean depth by weight of the items within `tolerance` (relative) of the median one; 0 where there is none.
template <DepthKind KIND>
inline Vec layer_of_block(const LayerMemory& memory, uint32_t count, float tolerance) {
    const Vec median = *memory.median, nearest = median * Vec(1.0f - tolerance), farthest = median * Vec(1.0f + tolerance);
    Vec weights(0.0f), depths(0.0f);
    for (uint32_t i = 0; i < count; i++) {
        const Vec z = load(memory.depths + static_cast<size_t>(i) * LANES);
        const Mask inside = z <= farthest;
        if (KIND == DepthKind::blended && !any(inside)) break;  // sorted by this depth
        const Vec weight = select_or_zero(inside & (z >= nearest), load(memory.weights + static_cast<size_t>(i) * LANES));
        weights += weight;
        depths = fma(weight, z, depths);
    }
    return select_or_zero(Vec(0.0f) < median, depths / max(weights, Vec(1e-8f)));
}

template <DepthKind KIND, bool LAYERED>
inline void draw_tile(Frame& frame, int index, const Images& images) {
    const Tile tile(frame, index);
    const View& view = frame.view;
    const Splat* splats = gather_splats(frame, tile);
    const Vec background[3] = {Vec(view.background[0]), Vec(view.background[1]), Vec(view.background[2])};
    TileItems items(frame, index);
    uint64_t evaluated = 0;
    const size_t room = (frame.longest_list + 1) * LANES;
    float* kept = LAYERED ? frame.front.data() + this_thread() * room * 2 : nullptr;
    for (int b = 0; b < BLOCKS; b++) {
        const Block block(tile, b, view);
        items.counts[b] = 0;
        if (block.outside(view)) continue;
        const Mask wanted = mask_of_bits(block.wanted(view));
        Vec median(0.0f);
        const auto memory = [&] {
            if constexpr (LAYERED) return LayerMemory{kept, kept + room, &median};
            else return NoMemory();
        }();
        const TileItems blended = items;
        const OpenBlock image = blend_block<KIND>(frame, tile, splats, b, block, wanted, memory, items, evaluated);
        const Vec alpha = alpha_of(image, wanted, [&] {
            const uint32_t count = items.counts[b];
            if constexpr (LAYERED) return sum_of_kept(memory.weights, count);
            else return sum_of_blended(splats, blended, count, OpenBlock(block, wanted));
        });
        const Vec rgb[3] = {select_or_zero(wanted, fma(image.T, background[0], image.R)),
                            select_or_zero(wanted, fma(image.T, background[1], image.G)),
                            select_or_zero(wanted, fma(image.T, background[2], image.B))};
        write_block_rgb(images.color, block, view, rgb);
        write_block(images.depth, block, view, image.D);
        write_block(images.alpha, block, view, alpha);
        if constexpr (LAYERED) write_block(images.layer, block, view, layer_of_block<KIND>(memory, items.counts[b], images.tolerance));
    }
    frame.evaluated.data()[index] = evaluated;
}

}  // namespace KERNEL_ISA
