// Forward, loss and backward of one view in one pass over the tiles: what a block just blended is still near when its
// derivatives are taken, and no image is written or read back.
//
// Per pixel, with h the Huber function of slope 1 in its tail: h(e^a color + b - measured color), and where a depth z was
// measured h(depth - alpha z), 1 - alpha, and the sum over Gaussians of weight h(z_i - z) with z_i the depth of each; every term a
// mean over its pixels (splat.losses.rgbd_loss, but for the last). Residuals of depth are multiplied by the pixel's certainty.
// With loss.closing the Gaussian that takes a pixel's light below it stops all that is left: fewer pairs, about the same image.
#pragma once

#include "parameters.h"

namespace KERNEL_ISA {

// slope = clip(r / delta, -1, 1), value = slope (r - delta slope / 2)
struct Huber {
    Vec slope, value;
    Huber(Vec residual, float delta)
        : slope(max(min(residual * Vec(1.0f / delta), Vec(1.0f)), Vec(-1.0f))), value(slope * fnma(Vec(0.5f * delta), slope, residual)) {}
};

// Pixels that count for the color, and for the depth.
struct PixelCounts {
    size_t color = 0, depth = 0;
    PixelCounts(const View& view, const float* depth_image) {
        const size_t pixels = static_cast<size_t>(view.width) * view.height;
        for (size_t i = 0; i < pixels; i++) {
            const bool wanted = !view.mask || view.mask[i];
            color += wanted;
            depth += wanted && depth_image[i] > 0.0f;
        }
    }
};

struct LossScales {
    float per_color, per_depth;  // 1 / number of terms
    LossScales(const PixelCounts& counts)
        : per_color(1.0f / static_cast<float>(counts.color ? 3 * counts.color : 1)),
          per_depth(1.0f / static_cast<float>(counts.depth ? counts.depth : 1)) {}
};

// The measured images in one block.
struct Measured {
    alignas(64) float planes[5][LANES];  // red, green, blue, depth, certainty
};

// Sums of the loss's terms over a tile, in lanes.
struct LossLanes {
    Vec color{0.0f}, depth{0.0f}, missing{0.0f}, by_gain{0.0f}, by_offset{0.0f}, surface{0.0f};
    void store_sums(double* out) const {
        const Vec* all[LOSS_SUMS] = {&color, &depth, &missing, &by_gain, &by_offset, &surface};
        for (int k = 0; k < LOSS_SUMS; k++) {
            alignas(64) float lanes[LANES];
            store(lanes, *all[k]);
            out[k] = 0.0;
            for (float lane : lanes) out[k] += lane;
        }
    }
};

// Cotangents of a block's images, whose loss is added to `sums`.
// weights: of the `count` items of the block.
inline Cotangents loss_of_block(const OpenBlock& image, const Vec* rgb, const Measured& measured, Mask wanted, const float* weights,
                                uint32_t count, const Loss& loss, const LossScales& scales, LossLanes& sums) {
    Cotangents v;
    const Vec gain(loss.gain), zero(0.0f);
    for (int k = 0; k < 3; k++) {
        const Huber h(fma(gain, rgb[k], Vec(loss.offset)) - load(measured.planes[k]), loss.color_huber);
        const Vec slope = select_or_zero(wanted, h.slope);
        sums.color += select_or_zero(wanted, h.value);
        sums.by_gain = fma(slope, rgb[k], sums.by_gain);
        sums.by_offset += slope;
        store(v.planes[k], slope * Vec(loss.gain * scales.per_color));
    }
    const Vec z = load(measured.planes[3]);
    const Mask has_depth = wanted & (zero < z);
    const Vec alpha = alpha_of(image, has_depth, [&] { return sum_of_kept(weights, count); });
    const Vec certainty = load(measured.planes[4]);
    const Huber h(fnma(alpha, z, image.D) * certainty, loss.depth_huber_m);
    const Vec by_depth = select_or_zero(has_depth, h.slope * Vec(loss.depth_weight * scales.per_depth) * certainty);
    sums.depth += select_or_zero(has_depth, h.value);
    sums.missing += select_or_zero(has_depth, image.T);
    store(v.planes[3], by_depth);
    store(v.planes[4], fnma(by_depth, z, -select_or_zero(has_depth, Vec(loss.alpha_weight * scales.per_depth))));
    return v;
}

// Huber loss of each Gaussian's own depth, by its weight.
struct TermOfDepth {
    static constexpr bool ACTIVE = true;
    Vec z, certainty, scale, sum{0.0f};  // scale: 0 where no depth was measured; sum: of the loss, before its weight
    float huber_m;
    TermOfDepth(const Measured& measured, Mask wanted, const Loss& loss, const LossScales& scales)
        : z(load(measured.planes[3])), certainty(load(measured.planes[4])),
          scale(select_or_zero(wanted & (Vec(0.0f) < z), Vec(loss.surface_weight * scales.per_depth))), huber_m(loss.depth_huber_m) {}
    // Value of the term per weight, and its slope by the depth.
    ALWAYS_INLINE Vec add(Vec depth, Vec weight, Vec& slope) {
        const Huber h((depth - z) * certainty, huber_m);
        slope = scale * certainty * h.slope;
        sum = fma(weight, h.value, sum);
        return scale * h.value;
    }
};

// Fetches a sixteenth of what the next tile will read, while this one is at work.
inline void fetch_ahead(const Frame& frame, int index, int part, const Loss& loss) {
    if (index >= frame.tiles_x * frame.tiles_y) return;
    const Tile tile(frame, index);
    const uint32_t* list = frame.list_splats.data() + tile.first;
    for (uint32_t i = tile.count * part / BLOCKS; i < tile.count * (part + 1) / BLOCKS; i++) __builtin_prefetch(frame.splats.data() + list[i]);
    const int y = tile.y + part, right = smaller(tile.x + TILE, frame.view.width);
    if (y >= frame.view.height) return;
    const size_t begin = static_cast<size_t>(y) * frame.view.width + tile.x, end = begin + (right - tile.x);
    const auto fetch = [](const float* from, const float* to) {
        for (; from < to; from += 64 / sizeof(float)) __builtin_prefetch(from);
        __builtin_prefetch(to - 1);
    };
    if (loss.color) fetch(loss.color + 3 * begin, loss.color + 3 * end);
    else __builtin_prefetch(loss.bytes + 3 * begin);
    fetch(loss.depth_m + begin, loss.depth_m + end);
    if (loss.certainty) fetch(loss.certainty + begin, loss.certainty + end);
}

// Sums a term of depth over the items of a block, from the last to the first.
template <DepthKind KIND, class Term>
inline void sum_term(const Sweep& sweep, const Block& block, uint32_t count, const Memory& memory, Term& term) {
    const Vec pixel_x = block.pixels_x(), pixel_y = block.pixels_y();
    for (uint32_t k = count; k-- > 0;) {
        Vec slope;
        const Vec depth = depth_at<KIND>(sweep.splats[sweep.items.positions[k]], pixel_x, pixel_y);
        term.add(depth, load(memory.weights + static_cast<size_t>(k) * LANES), slope);
    }
}
// What a block says about its Gaussians and adds to a term of depth.
template <Derivatives D, DepthKind KIND, class Term>
inline void sweep_block(const Sweep& sweep, const Block& block, uint32_t count, const Cotangents& v, const Memory& memory, Term& term) {
    if constexpr (D != Derivatives::NONE) gradient_block<D, KIND>(sweep, block, count, v, Recall{memory}, term);
    else if constexpr (Term::ACTIVE) sum_term<KIND>(sweep, block, count, memory, term);
}

template <Derivatives D, DepthKind KIND>
inline Status fit_tile(Frame& frame, int index, const Loss& loss, const LossScales& scales) {
    Sweep sweep = Sweep::begin<D == Derivatives::NONE ? 0 : ROW_OF<D, KIND>>(frame, index);
    const View& view = frame.view;
    Measured measured[BLOCKS];
    bool bad[3] = {};
    for (int b = 0; b < BLOCKS; b++) {
        const Block block(sweep.tile, b, view);
        if (block.outside(view)) continue;
        Vec rgb[3] = {Vec(0.0f), Vec(0.0f), Vec(0.0f)};
        if (loss.color) read_block_rgb(loss.color, block, view, rgb);
        else if (block.wanted(view)) read_block_rgb(loss.bytes, loss.of_bytes, block, view, rgb);
        const Vec z = read_block(loss.depth_m, block, view);
        bad[0] |= !(finite(rgb[0]) && finite(rgb[1]) && finite(rgb[2]));
        bad[1] |= !finite_not_negative(z);
        for (int k = 0; k < 3; k++) store(measured[b].planes[k], rgb[k]);
        store(measured[b].planes[3], z);
        const Vec certainty = loss.certainty ? read_block(loss.certainty, block, view) : Vec(1.0f);
        bad[2] |= !finite_not_negative(certainty);
        store(measured[b].planes[4], certainty);
    }
    const Vec background[3] = {Vec(view.background[0]), Vec(view.background[1]), Vec(view.background[2])};
    const size_t kept = (frame.longest_list + 1) * LANES;  // one more is written before it is known that it was not blended
    float* front = frame.front.data() + this_thread() * 2 * kept;
    const Memory memory = {front, front + kept};
    LossLanes sums;
    uint64_t evaluated = 0;
    for (int b = 0; b < BLOCKS; b++) {
        fetch_ahead(frame, index + 1, b, loss);
        if constexpr (D != Derivatives::NONE) sweep.template fetch_rows<ROW_OF<D, KIND>>(frame, b);
        const Block block(sweep.tile, b, view);
        sweep.items.counts[b] = 0;
        if (block.outside(view)) continue;
        const Mask wanted = mask_of_bits(block.wanted(view));
        if (!any(wanted)) {
            store(sweep.items.T + b * LANES, Vec(1.0f));
            continue;
        }
        TileItems next = sweep.items;
        const OpenBlock image =
            loss.closing > TRANSMITTANCE_MIN
                ? blend_block<KIND>(frame, sweep.tile, sweep.splats, b, block, wanted, ClosingMemory(memory, loss.closing), next, evaluated)
                : blend_block<KIND>(frame, sweep.tile, sweep.splats, b, block, wanted, memory, next, evaluated);
        const Vec rgb[3] = {fma(image.T, background[0], image.R), fma(image.T, background[1], image.G),
                            fma(image.T, background[2], image.B)};
        const Cotangents v = loss_of_block(image, rgb, measured[b], wanted, memory.weights, next.counts[b], loss, scales, sums);
        if (next.counts[b]) {
            if (loss.surface_weight > 0.0f) {
                TermOfDepth term(measured[b], wanted, loss, scales);
                sweep_block<D, KIND>(sweep, block, next.counts[b], v, memory, term);
                sums.surface += select_or_zero(Vec(0.0f) < term.scale, term.sum);
            } else {
                NoTermOfDepth none;
                sweep_block<D, KIND>(sweep, block, next.counts[b], v, memory, none);
            }
        }
        sweep.items = next;
    }
    if constexpr (D != Derivatives::NONE) sweep.template end<ROW_OF<D, KIND>>(frame);
    frame.evaluated.data()[index] = evaluated;
    sums.store_sums(frame.loss_parts.data() + static_cast<size_t>(index) * LOSS_SUMS);
    return bad[0] ? Status::bad_first_image : bad[1] ? Status::bad_second_image : bad[2] ? Status::bad_third_image : Status::ok;
}

}  // namespace KERNEL_ISA
