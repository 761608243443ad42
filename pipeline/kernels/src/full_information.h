// Information with all its cross terms, mean 3, quaternion 4, log-scale 3, color 3, logit 1, of every Gaussian: to check what
// the diagonals leave out. Written to be read, not to be fast.
#pragma once

#include "parameters.h"

namespace KERNEL_ISA {

// Behind the sums of information: of w2 times x and y, and per color channel of weight times the derivative by ln alpha times
// 1, x, y, x^2, x y, y^2.
constexpr int FULL_X = INFORMATION_ROW, FULL_Y = FULL_X + 1, FULL_COLOR = FULL_Y + 1, FULL_SUMS = FULL_COLOR + 3 * monomials(2);
constexpr int FULL_ROW = 64;
static_assert(INFORMATION_SUMS<DepthKind::ray_plane> <= INFORMATION_ROW && FULL_SUMS <= FULL_ROW, "");

template <DepthKind KIND>
NO_INLINE static void full_block(const Sweep& sweep, const Block& block, uint32_t count, const Precisions& v, Replay pass) {
    const Vec of_color = load(v.planes[0]), of_depth = load(v.planes[1]);
    const Vec pixel_x = block.pixels_x(), pixel_y = block.pixels_y();
    Vec behind[4] = {Vec(sweep.view.background[0]), Vec(sweep.view.background[1]), Vec(sweep.view.background[2]), Vec(0.0f)};
    over_batches(sweep, count, [&](const Batch& batch) ALWAYS_INLINE {
        // squares of the weight and of the derivative by ln alpha, and their products, each with its precision
        Lanes own_color, own_depth, w2, cross[4];
        Vec sums[FULL_ROW];
        for (Vec& sum : sums) sum = Vec(0.0f);
        pass.walk(batch, [&](int k, const Splat& s, Vec alpha, Vec weight) ALWAYS_INLINE {
            const Vec own[4] = {Vec(s.r), Vec(s.g), Vec(s.b), depth_at<KIND>(s, pixel_x, pixel_y)};
            const Vec weight2 = weight * weight, moving2 = if_unclamped(alpha, weight2);
            w2[k] = Vec(0.0f);
            for (int channel = 0; channel < 4; channel++) {
                const Vec gain = gain_over(behind[channel], own[channel], alpha);
                cross[channel][k] = moving2 * gain * (channel < 3 ? of_color : of_depth);
                w2[k] = fma(cross[channel][k], gain, w2[k]);
            }
            own_color[k] = weight2 * of_color;
            own_depth[k] = weight2 * of_depth;
        });
        for (Vec* lanes : {own_color, own_depth, w2, cross[0], cross[1], cross[2], cross[3]}) transpose16(lanes);
        const BatchShape shape(batch);
        for (int half = 0; half < PARTS; half++) {
            const auto numbers = [half](const Lanes& lanes) { return [&lanes, half](int p) { return part(lanes[p], half); }; };
            constexpr int OF_W2[] = {INFO_1,   FULL_X,   FULL_Y,    INFO_XX,   INFO_XY,   INFO_YY,   INFO_XXX, INFO_XXY,
                                     INFO_XYY, INFO_YYY, INFO_XXXX, INFO_XXXY, INFO_XXYY, INFO_XYYY, INFO_YYYY};
            Wide color[1], depth[1], of_w2[monomials(4)], of_channel[monomials(2)];
            sum_monomials<0>(numbers(own_color), shape, block, half, color);
            sum_monomials<0>(numbers(own_depth), shape, block, half, depth);
            sum_monomials<4>(numbers(w2), shape, block, half, of_w2);
            set_part(sums[INFO_R], half, color[0]);
            set_part(sums[INFO_ZZ], half, depth[0]);
            for (int k = 0; k < monomials(4); k++) set_part(sums[OF_W2[k]], half, of_w2[k]);
            sum_ray_depth_moments(numbers(cross[3]), numbers(own_depth), shape, block, half, sums);
            for (int channel = 0; channel < 3; channel++) {
                sum_monomials<2>(numbers(cross[channel]), shape, block, half, of_channel);
                set_parts(sums + FULL_COLOR + channel * monomials(2), half, of_channel);
            }
        }
        add_to_rows<FULL_ROW>(batch, sums, sweep.rows);
    });
}

template <DepthKind KIND>
inline Status full_tile(Frame& frame, int index, const float* inv_var_color, const float* inv_var_depth) {
    return over_precisions<FULL_ROW>(frame, index, inv_var_color, inv_var_depth, nullptr, full_block<KIND>);
}

// Gram matrix of the terms of the geometry, then of 1, which the logit moves, then of the colors.
template <DepthKind KIND>
struct FullGram {
    static constexpr int GEOMETRY = SCREEN_TERMS<KIND>, TERMS = GEOMETRY + 4;
    Vec g[TERMS][TERMS];
    explicit FullGram(const Vec* s) {
        const ScreenGram<KIND> geometry(s);
        const int with_one[8] = {FULL_X, FULL_Y, INFO_XX, INFO_XY, INFO_YY, INFO_ZX, INFO_ZY, INFO_Z1};
        for (int k = 0; k < TERMS; k++)
            for (int l = 0; l < TERMS; l++) g[k][l] = k < GEOMETRY && l < GEOMETRY ? geometry.g[k][l] : Vec(0.0f);
        for (int k = 0; k < GEOMETRY; k++) set(k, GEOMETRY, s[with_one[k < GEOMETRY - 1 ? k : 7]]);
        set(GEOMETRY, GEOMETRY, s[INFO_1]);
        for (int channel = 0; channel < 3; channel++) {
            const Vec* of_channel = s + FULL_COLOR + channel * monomials(2);
            const int color = GEOMETRY + 1 + channel;
            for (int k = 0; k < 5; k++) set(k, color, of_channel[1 + k]);  // x, y, x^2, x y, y^2
            set(GEOMETRY, color, of_channel[0]);
            set(color, color, s[INFO_R]);
        }
    }

private:
    void set(int k, int l, Vec value) { g[k][l] = g[l][k] = value; }
};

template <DepthKind KIND>
inline void full_group(const Frame& frame, const GaussianArrays& gaussians, size_t index, double* information) {
    using Gram = FullGram<KIND>;
    const Group group(frame, gaussians, index);
    const Splat16& s = group.splat;
    Vec sums[FULL_ROW];
    group.reduce<FULL_ROW>(frame, sums);

    Vec columns[14][Gram::TERMS];  // derivatives of the terms by each parameter
    for (auto& column : columns)
        for (Vec& term : column) term = Vec(0.0f);
    const ScreenDerivatives<KIND> derivatives(frame.view, s);
    for (int k = 0; k < Gram::GEOMETRY; k++)
        for (int i = 0; i < 3; i++) columns[i][k] = derivatives.by_mean[k][i];
    for (int k = 0; k < SHAPE_TERMS<KIND>; k++) {
        Vec by_quat[4], by_scale[3];
        quaternion_cotangent(s, derivatives.Y[k], by_quat);
        log_scale_cotangent(s, derivatives.Y[k], by_scale);
        for (int i = 0; i < 4; i++) columns[3 + i][SHAPE_FIRST + k] = by_quat[i];
        for (int i = 0; i < 3; i++) columns[7 + i][SHAPE_FIRST + k] = by_scale[i];
    }
    for (int i = 0; i < 3; i++) columns[10 + i][Gram::GEOMETRY + 1 + i] = Vec(1.0f);
    columns[13][Gram::GEOMETRY] = sigmoid(-group.parameters.logit);

    const Gram gram(sums);
    Vec full[14 * 14];
    for (int i = 0; i < 14; i++)
        for (int j = i; j < 14; j++)
            full[14 * i + j] = full[14 * j + i] = quadratic_form<Gram::TERMS, Gram::TERMS>(gram, 0, 0, columns[i], columns[j]);
    scatter_add<14 * 14>(full, group, information);
}

}  // namespace KERNEL_ISA
