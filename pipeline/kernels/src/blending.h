// Front to back: alpha blending of the Gaussians of every block.
//
// Per pixel: weight_i = alpha_i T_i with T_i = prod_{j<i} (1 - alpha_j); color = sum weight_i c_i + T_end background.
// A block walks its own list with all its pixels in registers. The alphas of a few Gaussians are computed side by side: each
// is a chain of thirty dependent operations, and one after the other they would leave the processor waiting.
#pragma once

#include "tiles.h"

namespace KERNEL_ISA {

constexpr float ALPHA_MAX = 0.999f, REST_MIN = 0.001f;  // of alpha, of 1 - alpha
constexpr float TRANSMITTANCE_MIN = 1e-4f;  // a Gaussian that would take a pixel below this closes the pixel, unblended
constexpr int ABREAST = 4;                  // Gaussians whose alpha is computed side by side

// e = M d, d = pixel - center.
struct Whitened {
    Vec x, y;
    Whitened(const Splat& s, Vec pixel_x, Vec pixel_y) {
        const Vec dx = pixel_x - Vec(s.u), dy = pixel_y - Vec(s.v);
        x = fma(Vec(s.M11), dx, Vec(s.M12) * dy);
        y = Vec(s.M22) * dy;
    }
    Vec log2_alpha(const Splat& s) const { return fnma(y, y, fnma(x, x, Vec(s.log2_opacity))); }
};

// Depth of a Gaussian at the pixels.
template <DepthKind KIND>
ALWAYS_INLINE inline Vec depth_at(const Splat& s, Vec pixel_x, Vec pixel_y) {
    if constexpr (KIND == DepthKind::ray_plane) {
        const Whitened e(s, pixel_x, pixel_y);
        return fma(Vec(s.slope_x), e.x, fma(Vec(s.slope_y), e.y, Vec(s.z)));
    } else {
        return Vec(s.z);
    }
}

// From log2 alpha, clamped alpha and 1 - alpha; where it is not seen, 0 and 1.
inline void alpha_and_rest(Vec& alpha, Mask seen, Vec& rest) {
    Vec power;
    exp2_and_rest(alpha, power, rest);
    alpha = select_or_zero(seen, min(power, Vec(ALPHA_MAX)));
    rest = select(seen, max(rest, Vec(REST_MIN)), Vec(1.0f));
}

// One block while it is blended.
struct OpenBlock {
    Vec pixel_x, pixel_y;
    Vec left;  // goes on falling after a pixel closed: whether it is closed then needs no memory
    Vec T, R, G, B, D;  // T: transmittance behind what was blended

    OpenBlock(const Block& block, Mask wanted)
        : pixel_x(block.pixels_x()), pixel_y(block.pixels_y()), left(select_or_zero(wanted, Vec(1.0f))), T(1.0f), R(0.0f), G(0.0f), B(0.0f),
          D(0.0f) {}
    bool open(Vec least) const { return any(left >= least); }
};

// alpha and weight of a block's items, for a sweep that follows at once.
struct Memory {
    static constexpr bool CLOSES = false, LAYERED = false;
    float *alphas, *weights;
    float least() const { return TRANSMITTANCE_MIN; }
    void keep(uint32_t item, Vec alpha, Vec weight) const {
        store(alphas + static_cast<size_t>(item) * LANES, alpha);
        store(weights + static_cast<size_t>(item) * LANES, weight);
    }
};
struct NoMemory {
    static constexpr bool CLOSES = false, LAYERED = false;
    float least() const { return TRANSMITTANCE_MIN; }
    void keep(uint32_t, Vec, Vec) const {}
};
// As Memory, where the Gaussian that takes a pixel below `closing` stops all of its light: it is blended with an alpha of 1.
struct ClosingMemory : Memory {
    static constexpr bool CLOSES = true;
    float closing;
    ClosingMemory(const Memory& memory, float least) : Memory(memory), closing(least) {}
    float least() const { return closing; }
};
// Weight and depth of a block's items, and the depth of the one behind which less than half of the light is left, 0 where there is none.
struct LayerMemory {
    static constexpr bool CLOSES = false, LAYERED = true;
    float *weights, *depths;
    Vec* median;
    float least() const { return TRANSMITTANCE_MIN; }
    void keep(uint32_t item, Vec, Vec weight) const { store(weights + static_cast<size_t>(item) * LANES, weight); }
    void keep_depth(uint32_t item, Vec z, Mask passes_half) const {
        store(depths + static_cast<size_t>(item) * LANES, z);
        *median = select(passes_half, z, *median);
    }
};

// Blends the next N candidates; keeps those that were blended.
template <DepthKind KIND, int N, class Kept>
ALWAYS_INLINE inline uint32_t blend_some(const Splat* splats, const uint32_t* candidates, const TileItems& items, uint32_t kept,
                                         const Kept& memory, OpenBlock& block) {
    uint32_t position[N];
    Vec alpha[N], rest[N], depth[N];  // rest: 1 - alpha
    Mask seen[N];
    unrolled<N>([&](auto k) ALWAYS_INLINE {
        position[k] = candidates[k];
        const Splat& s = splats[position[k]];
        alpha[k] = Whitened(s, block.pixel_x, block.pixel_y).log2_alpha(s);
        if constexpr (KIND == DepthKind::ray_plane) depth[k] = depth_at<KIND>(s, block.pixel_x, block.pixel_y);
    });
    unrolled<N>([&](auto k) ALWAYS_INLINE {
        seen[k] = alpha[k] >= Vec(LOG2_ALPHA_MIN);
        alpha_and_rest(alpha[k], seen[k], rest[k]);
        pin(alpha[k]);
        pin(rest[k]);
    });
    block.left = max(block.left, Vec(1e-8f));  // far from denormal numbers
    unrolled<N>([&](auto k) ALWAYS_INLINE {
        const Splat& s = splats[position[k]];
        const Vec before = block.left, least(memory.least());
        Vec weight_if_open = alpha[k] * before;
        block.left = before * rest[k];
        Mask blended;
        if constexpr (Kept::CLOSES) {
            blended = (before >= least) & seen[k];
            const Mask stays_open = block.left >= least;
            weight_if_open = select(stays_open, weight_if_open, before);
            alpha[k] = select(stays_open, alpha[k], Vec(1.0f));
        } else {
            blended = (block.left >= least) & seen[k];
            block.T = select(blended, block.left, block.T);
        }
        const Vec weight = select_or_zero(blended, weight_if_open);
        block.R = fma(weight, Vec(s.r), block.R);
        block.G = fma(weight, Vec(s.g), block.G);
        block.B = fma(weight, Vec(s.b), block.B);
        block.D = fma(weight, KIND == DepthKind::ray_plane ? depth[k] : Vec(s.z), block.D);  // z is not kept in a register
        memory.keep(kept, select_or_zero(blended, alpha[k]), weight);
        if constexpr (Kept::LAYERED)
            memory.keep_depth(kept, KIND == DepthKind::ray_plane ? depth[k] : Vec(s.z),
                              blended & (before >= Vec(0.5f)) & (block.left < Vec(0.5f)));
        const uint32_t pixels = bits(blended);
        items.positions[kept] = position[k];
        items.pixels[kept] = static_cast<uint16_t>(pixels);
        kept += pixels != 0;
    });
    return kept;
}

// Blends the candidates of one block, which stand at the beginning of `items`; keeps those that were blended, in place.
// Returns how many, and in `evaluated` how many it looked at. The last few are filled up with `unseen`.
template <DepthKind KIND, class Kept>
NO_INLINE static uint32_t blend_candidates(const Splat* splats, const TileItems items, uint32_t count, uint32_t unseen, const Kept memory,
                                           OpenBlock& result, uint64_t& evaluated) {
    OpenBlock block = result;
    const Vec least(memory.least());
    uint32_t kept = 0, i = 0;
    static_assert(ABREAST <= LIST_SPARE, "");
    for (uint32_t k = count; k % ABREAST; k++) items.positions[k] = unseen;
    for (; i < count && block.open(least); i += ABREAST)
        kept = blend_some<KIND, ABREAST>(splats, items.positions + i, items, kept, memory, block);
    evaluated += i < count ? i : count;
    if constexpr (Kept::CLOSES)  // an open pixel blended all that it saw, and nothing is left of a closed one
        block.T = select(Vec(0.0f) < result.left, select_or_zero(block.left >= least, block.left), block.T);
    result = block;
    return kept;
}

// Blends block b of a tile and steps over its items.
template <DepthKind KIND, class Kept>
inline OpenBlock blend_block(const Frame& frame, const Tile& tile, const Splat* splats, int b, const Block& block, Mask wanted,
                             const Kept& memory, TileItems& items, uint64_t& evaluated) {
    OpenBlock image(block, wanted);
    const uint32_t count = positions_with_bit(frame.list_blocks.data() + tile.first, tile.count, b, items.positions);
    items.counts[b] = blend_candidates<KIND>(splats, items, count, tile.count, memory, image, evaluated);
    store(items.T + b * LANES, image.T);
    items.skip(items.counts[b]);
    return image;
}

// 1 - T of a block that was blended. Where little is covered few digits of that are left: there it is what `sum_of_weights` returns.
template <class SumOfWeights>
ALWAYS_INLINE inline Vec alpha_of(const OpenBlock& image, Mask wanted, SumOfWeights sum_of_weights) {
    const Vec alpha = Vec(1.0f) - image.T;
    const Mask little = wanted & (alpha < Vec(0.5f));
    return any(little) ? select(little, sum_of_weights(), alpha) : alpha;
}
// The sum, front to back, of the weights of a block's items: of those that a memory kept, or by blending once more, in the same pixels,
// what was blended: a Gaussian that only closed pixels is no item, so light does not say here which pixels are closed.
inline Vec sum_of_kept(const float* weights, uint32_t count) {
    Vec sum(0.0f);
    for (uint32_t k = 0; k < count; k++) sum += load(weights + static_cast<size_t>(k) * LANES);
    return sum;
}
inline Vec sum_of_blended(const Splat* splats, const TileItems items, uint32_t count, const OpenBlock& block) {
    Vec sum(0.0f), left = block.left;
    for (uint32_t first = 0; first < count; first += ABREAST) {
        Vec alpha[ABREAST], rest[ABREAST];
        unrolled<ABREAST>([&](auto k) ALWAYS_INLINE {
            const uint32_t item = first + k < count ? first + k : first;
            const Splat& s = splats[items.positions[item]];
            alpha[k] = Whitened(s, block.pixel_x, block.pixel_y).log2_alpha(s);
            alpha_and_rest(alpha[k], mask_of_bits(item == first + k ? items.pixels[item] : 0u), rest[k]);
            pin(alpha[k]);
            pin(rest[k]);
        });
        unrolled<ABREAST>([&](auto k) ALWAYS_INLINE {
            sum += alpha[k] * left;
            left = left * rest[k];
        });
    }
    return sum;
}

}  // namespace KERNEL_ISA
