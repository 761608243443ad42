// Information of the opacity logits alone: the sums of `fisher` that are theirs, to the same bits, without the others.
#pragma once

#include "parameters.h"

namespace KERNEL_ISA {

enum OpacitySum { OPACITY_1, OPACITY_SEEN, OPACITY_ROW };  // INFO_1; 1 where a pixel of some precision saw the Gaussian

template <DepthKind KIND>
NO_INLINE static void opacity_block(const Sweep& sweep, const Block& block, uint32_t count, const Precisions& v, Replay pass) {
    const Vec of_color = load(v.planes[0]), of_depth = load(v.planes[1]);
    const Vec pixel_x = block.pixels_x(), pixel_y = block.pixels_y();
    const uint32_t used = bits(Vec(0.0f) < load(v.planes[2]));
    const float* background = sweep.view.background;
    Vec behind_r(background[0]), behind_g(background[1]), behind_b(background[2]), behind_z(0.0f);
    over_batches(sweep, count, [&](const Batch& batch) ALWAYS_INLINE {
        Lanes w2;
        pass.walk(batch, [&](int k, const Splat& s, Vec alpha, Vec weight) ALWAYS_INLINE {
            const Vec gain_r = gain_over(behind_r, Vec(s.r), alpha), gain_g = gain_over(behind_g, Vec(s.g), alpha);
            const Vec depth = depth_at<KIND>(s, pixel_x, pixel_y);
            const Vec gain_b = gain_over(behind_b, Vec(s.b), alpha), gain_z = gain_over(behind_z, depth, alpha);
            const Vec color2 = fma(gain_r, gain_r, fma(gain_g, gain_g, gain_b * gain_b)), depth_gain = of_depth * gain_z;
            w2[k] = if_unclamped(alpha, weight * weight) * fma(of_color, color2, depth_gain * gain_z);
        });
        transpose16(w2);
        Vec total(0.0f);
        for (int row = 0; row < LANES; row += 4) {  // in the order of sum_screen_moments
            Vec of_row(0.0f);
            for (int p = row; p < row + 4; p++) of_row += w2[p];
            total += of_row;
        }
        alignas(64) float totals[BATCH];
        store(totals, total);
        for (int k = 0; k < batch.count; k++) {
            float* row = sweep.rows + static_cast<size_t>(batch.positions[k]) * OPACITY_ROW;
            row[OPACITY_1] += totals[k];
            row[OPACITY_SEEN] = batch.pixels[k] & used ? 1.0f : row[OPACITY_SEEN];
        }
    });
}

template <DepthKind KIND>
inline Status opacity_tile(Frame& frame, int index, const float* inv_var_color, const float* inv_var_depth) {
    return over_precisions<OPACITY_ROW>(frame, index, inv_var_color, inv_var_depth, nullptr, opacity_block<KIND>);
}

inline void opacity_group(const Frame& frame, const GaussianArrays& gaussians, size_t index, double* information, uint32_t* observations) {
    const Members members(frame, index);
    const uint32_t* first_row = frame.first_row.data() + members.first;
    alignas(64) float sums[LANES] = {};
    for (int lane = 0; lane < members.lanes; lane++) {
        bool seen = false;
        for (uint32_t r = first_row[lane]; r < first_row[lane + 1]; r++) {
            const float* row = frame.rows.data() + static_cast<size_t>(r) * OPACITY_ROW;
            sums[lane] += row[OPACITY_1];
            seen |= row[OPACITY_SEEN] > 0.0f;
        }
        observations[members.ids[lane]] += seen;
    }
    Vec logit;
    gather<1>(gaussians.opacity_logits, members.ids, &logit);
    const Vec transparency = sigmoid(-logit);
    store(sums, transparency * transparency * load(sums));
    for (int lane = 0; lane < members.lanes; lane++) information[members.ids[lane]] += sums[lane];
}

}  // namespace KERNEL_ISA
