// From rows of screen sums to the parameters of every Gaussian, sixteen Gaussians at a time.
#pragma once

#include "sweeps.h"

namespace KERNEL_ISA {

// Sixteen neighbors of the visible ones; the last group repeats its first.
struct Members {
    size_t first;
    int lanes;
    uint32_t ids[LANES];
    Members(const Frame& frame, size_t group) : first(group * LANES) {
        lanes = frame.visible - first < LANES ? static_cast<int>(frame.visible - first) : LANES;
        const uint32_t* order = frame.visible_ids.data() + first;
        for (int lane = 0; lane < LANES; lane++) ids[lane] = order[lane < lanes ? lane : 0];
    }
    bool side_by_side() const { return ids[LANES - 1] == ids[0] + LANES - 1; }  // in the arrays; ids ascend
};
struct Group : Members {
    const Parameters16 parameters;
    const Splat16 splat;  // projected once more: cheaper than to keep it
    Group(const Frame& frame, const GaussianArrays& gaussians, size_t group)
        : Members(frame, group), parameters(side_by_side() ? load_parameters(gaussians, ids[0]) : gather_parameters(gaussians, ids)),
          splat(project16(frame.view, parameters.mean, parameters.quat, parameters.log_scale)) {}

    // Sums of the rows of each Gaussian, in order of the rows; sums[k] holds column k.
    template <int ROW>
    void reduce(const Frame& frame, Vec* sums) const {
        const uint32_t* first_row = frame.first_row.data() + first;
        Vec totals[ROW];
        for (int lane = 0; lane < LANES; lane++) {
            const int member = lane < lanes ? lane : 0;
            const float *row = frame.rows.data() + static_cast<size_t>(first_row[member]) * ROW;
            const float* end = frame.rows.data() + static_cast<size_t>(first_row[member + 1]) * ROW;
            Vec total[ROW / LANES];
            for (Vec& part : total) part = Vec(0.0f);
            for (; row < end; row += ROW)
                for (int k = 0; k < ROW / LANES; k++) total[k] += load(row + k * LANES);
            for (int k = 0; k < ROW / LANES; k++) totals[k * LANES + lane] = total[k];
        }
        for (int k = 0; k < ROW; k += LANES) {
            transpose16(totals + k);
            for (int i = 0; i < LANES; i++) sums[k + i] = totals[k + i];
        }
    }
};

// Column k of the rows `ids` of a row-major array becomes values[k].
template <int WIDTH>
inline void scatter(const Vec* values, const Group& group, float* array) {
    alignas(64) float columns[WIDTH][LANES];
    for (int k = 0; k < WIDTH; k++) store(columns[k], values[k]);
    for (int lane = 0; lane < group.lanes; lane++)
        for (int k = 0; k < WIDTH; k++) array[static_cast<size_t>(group.ids[lane]) * WIDTH + k] = columns[k][lane];
}
// The same, added to an array of doubles.
template <int WIDTH>
inline void scatter_add(const Vec* values, const Group& group, double* array) {
    alignas(64) float columns[WIDTH][LANES];
    for (int k = 0; k < WIDTH; k++) store(columns[k], values[k]);
    for (int lane = 0; lane < group.lanes; lane++)
        for (int k = 0; k < WIDTH; k++) array[static_cast<size_t>(group.ids[lane]) * WIDTH + k] += columns[k][lane];
}

// What the derivative of a pixel by the geometry of a Gaussian is made of: by ln alpha it goes as x, y, x^2, x y, y^2 (e = (x, y)),
// and depth's own as 1, for ray_plane also as x and y. The mean moves all of them, the shape those from SHAPE_FIRST on but the last.
template <DepthKind KIND>
constexpr int SCREEN_TERMS = KIND == DepthKind::ray_plane ? 8 : 6;
constexpr int SHAPE_FIRST = 2;
template <DepthKind KIND>
constexpr int SHAPE_TERMS = SCREEN_TERMS<KIND> - SHAPE_FIRST - 1;

// Gram matrix of these terms, summed over the pixels.
template <DepthKind KIND>
struct ScreenGram {
    static constexpr int TERMS = SCREEN_TERMS<KIND>;
    Vec g[TERMS][TERMS];
    explicit ScreenGram(const Vec* s) {
        const InformationSum all[8][8] = {
            {INFO_XX, INFO_XY, INFO_XXX, INFO_XXY, INFO_XYY, INFO_ZXX, INFO_ZXY, INFO_ZX},
            {INFO_XY, INFO_YY, INFO_XXY, INFO_XYY, INFO_YYY, INFO_ZXY, INFO_ZYY, INFO_ZY},
            {INFO_XXX, INFO_XXY, INFO_XXXX, INFO_XXXY, INFO_XXYY, INFO_ZXXX, INFO_ZXXY, INFO_ZXX},
            {INFO_XXY, INFO_XYY, INFO_XXXY, INFO_XXYY, INFO_XYYY, INFO_ZXXY, INFO_ZXYY, INFO_ZXY},
            {INFO_XYY, INFO_YYY, INFO_XXYY, INFO_XYYY, INFO_YYYY, INFO_ZXYY, INFO_ZYYY, INFO_ZYY},
            {INFO_ZXX, INFO_ZXY, INFO_ZXXX, INFO_ZXXY, INFO_ZXYY, INFO_ZZXX, INFO_ZZXY, INFO_ZZX},
            {INFO_ZXY, INFO_ZYY, INFO_ZXXY, INFO_ZXYY, INFO_ZYYY, INFO_ZZXY, INFO_ZZYY, INFO_ZZY},
            {INFO_ZX, INFO_ZY, INFO_ZXX, INFO_ZXY, INFO_ZYY, INFO_ZZX, INFO_ZZY, INFO_ZZ},
        };
        const auto place = [](int term) { return term < TERMS - 1 ? term : 7; };  // the last is depth's own 1
        for (int k = 0; k < TERMS; k++)
            for (int l = 0; l < TERMS; l++) g[k][l] = s[all[place(k)][place(l)]];
    }
};

// Derivatives of the coefficients of the terms by the center in the map frame, and the cotangents Y of Sigma in own axes that
// belong to those of the shape.
template <DepthKind KIND>
struct ScreenDerivatives {
    Vec by_mean[SCREEN_TERMS<KIND>][3];
    Vec Y[SHAPE_TERMS<KIND>][6];
    ScreenDerivatives(const View& view, const Splat16& s) {
        const Vec zero(0.0f), one(1.0f);
        Vec center[3];
        auto clear = [&] { center[0] = center[1] = center[2] = zero; };
        clear();
        add_center_from_moments(s, one, zero, center);
        to_map_frame(view, center, by_mean[0]);
        clear();
        add_center_from_moments(s, zero, one, center);
        to_map_frame(view, center, by_mean[1]);
        for (int k = 0; k < 3; k++) {
            Vec Q[6], d_J[6];
            const Symmetric2 c = whitened_cotangent(k == 0 ? one : zero, k == 1 ? one : zero, k == 2 ? one : zero);
            own_axes_cotangent(s, c, Q, Y[k]);
            jacobian_cotangent(s, Q, d_J);
            clear();
            add_center_from_jacobian(s, d_J, jacobian_along_itself(s, Y[k]), center);
            to_map_frame(view, center, by_mean[2 + k]);
        }
        clear();
        if constexpr (KIND == DepthKind::ray_plane) {
            const RayDepth depth(s);
            for (int k = 0; k < 3; k++) {  // x, y, 1
                Vec own[6], d_J[6], along_J(0.0f), turn[2];
                for (int i = 0; i < 6; i++) own[i] = d_J[i] = zero;
                clear();
                depth.add_cotangents(s, k == 2 ? one : zero, k == 0 ? one : zero, k == 1 ? one : zero, own, d_J, along_J, center, turn);
                add_center_from_jacobian(s, d_J, along_J, center);
                if (k < 2) {
                    to_map_frame(view, center, by_mean[5 + k]);
                    for (int i = 0; i < 6; i++) Y[3 + k][i] = own[i];
                }
            }
        }
        center[2] += one;
        to_map_frame(view, center, by_mean[SCREEN_TERMS<KIND> - 1]);
    }
};

// sum_kl a_k G[first + k][other + l] b_l over ROWS x COLUMNS.
template <int ROWS, int COLUMNS, class Gram>
inline Vec quadratic_form(const Gram& gram, int row, int column, const Vec* a, const Vec* b) {
    Vec total(0.0f);
    for (int k = 0; k < ROWS; k++) {
        Vec inner(0.0f);
        for (int l = 0; l < COLUMNS; l++) inner = fma(gram.g[row + k][column + l], b[l], inner);
        total = fma(a[k], inner, total);
    }
    return total;
}

inline size_t group_count(const Frame& frame) { return (frame.visible + LANES - 1) / LANES; }

// ---------------------------------------------------------------- gradients

// Diagonal of the information in mean 3, quaternion 4, log-scale 3, color 3, logit 1; of_color: that of the colors.
template <DepthKind KIND>
inline void diagonal_information(const View& view, const Splat16& s, Vec transparency, const Vec* info, const Vec* of_color, Vec* diagonal) {
    constexpr int TERMS = SCREEN_TERMS<KIND>, SHAPE = SHAPE_TERMS<KIND>;
    const ScreenGram<KIND> gram(info);
    const ScreenDerivatives<KIND> derivatives(view, s);
    Vec by_quat[SHAPE][4], by_scale[SHAPE][3];
    for (int k = 0; k < SHAPE; k++) {
        quaternion_cotangent(s, derivatives.Y[k], by_quat[k]);
        log_scale_cotangent(s, derivatives.Y[k], by_scale[k]);
    }
    for (int i = 0; i < 3; i++) {
        Vec column[TERMS];
        for (int k = 0; k < TERMS; k++) column[k] = derivatives.by_mean[k][i];
        diagonal[i] = quadratic_form<TERMS, TERMS>(gram, 0, 0, column, column);
    }
    for (int i = 0; i < 4; i++) {
        Vec column[SHAPE];
        for (int k = 0; k < SHAPE; k++) column[k] = by_quat[k][i];
        diagonal[3 + i] = quadratic_form<SHAPE, SHAPE>(gram, SHAPE_FIRST, SHAPE_FIRST, column, column);
    }
    for (int i = 0; i < 3; i++) {
        Vec column[SHAPE];
        for (int k = 0; k < SHAPE; k++) column[k] = by_scale[k][i];
        diagonal[7 + i] = quadratic_form<SHAPE, SHAPE>(gram, SHAPE_FIRST, SHAPE_FIRST, column, column);
        diagonal[10 + i] = of_color[i];
    }
    diagonal[13] = transparency * transparency * info[INFO_1];
}

template <Derivatives D, DepthKind KIND>
inline void gradient_group(const Frame& frame, const GaussianArrays& gaussians, size_t index, const GradientArrays& out, double* pose) {
    const Group group(frame, gaussians, index);
    const Splat16& s = group.splat;
    Vec sums[ROW_OF<D, KIND>];
    group.reduce<ROW_OF<D, KIND>>(frame, sums);

    Vec Q[6], Y[6], d_J[6], center[3] = {Vec(0.0f), Vec(0.0f), Vec(0.0f)}, turn[2];
    own_axes_cotangent(s, whitened_cotangent(sums[SUM_WXX], sums[SUM_WXY], sums[SUM_WYY]), Q, Y);
    jacobian_cotangent(s, Q, d_J);
    Vec along_J = jacobian_along_itself(s, Y);
    if constexpr (KIND == DepthKind::ray_plane)
        RayDepth(s).add_cotangents(s, sums[SUM_Z], sums[SUM_ZX], sums[SUM_ZY], Y, d_J, along_J, center, turn);
    add_center_from_jacobian(s, d_J, along_J, center);
    add_center_from_moments(s, sums[SUM_WX], sums[SUM_WY], center);
    center[2] += sums[SUM_Z];
    if (out.pose) {
        Vec by_pose[6];
        alignas(64) float lanes[LANES];
        pose_cotangent(s, center, d_J, by_pose);
        if constexpr (KIND == DepthKind::ray_plane) add_turn_of_depth(turn, by_pose);
        for (int k = 0; k < 6; k++) {
            store(lanes, by_pose[k]);
            for (int lane = 0; lane < group.lanes; lane++) pose[k] += lanes[lane];
        }
    }
    if constexpr (D != Derivatives::POSE) {
        Vec mean[3], quat[4], log_scale[3];
        to_map_frame(frame.view, center, mean);
        quaternion_cotangent(s, Y, quat);
        log_scale_cotangent(s, Y, log_scale);
        const Vec transparency = sigmoid(-group.parameters.logit), logit = sums[SUM_W] * transparency;
        scatter<3>(mean, group, out.means);
        scatter<4>(quat, group, out.quats_wxyz);
        scatter<3>(log_scale, group, out.log_scales);
        scatter<3>(sums + SUM_R, group, out.colors);
        scatter<1>(&logit, group, out.opacity_logits);
        if constexpr (D == Derivatives::ALL_AND_SQUARES) {
            const Vec* info = sums + GRADIENT_SUMS<KIND>;
            Vec diagonal[14];
            diagonal_information<KIND>(frame.view, s, transparency, info, info + INFO_R, diagonal);
            scatter<14>(diagonal, group, out.fisher_diagonal);
        }
    }
}

// Gradients of all drawn Gaussians; the pose sums in 64 fixed chunks, in double, added in order.
template <Derivatives D, DepthKind KIND>
inline void gradients_of_parameters(Frame& frame, const GaussianArrays& gaussians, const GradientArrays& out) {
    const size_t groups = group_count(frame);
    double* parts = frame.pose_parts.need(POSE_CHUNKS * 6);
    std::memset(parts, 0, sizeof(double) * POSE_CHUNKS * 6);
#pragma omp parallel for schedule(dynamic, 1) num_threads(frame.threads) if (frame.threads > 1)
    for (int chunk = 0; chunk < POSE_CHUNKS; chunk++) {
        double pose[6] = {};
        for (size_t g = groups * chunk / POSE_CHUNKS; g < groups * (chunk + 1) / POSE_CHUNKS; g++)
            gradient_group<D, KIND>(frame, gaussians, g, out, pose);
        std::memcpy(parts + 6 * chunk, pose, sizeof pose);
    }
    if (!out.pose) return;
    for (int k = 0; k < 6; k++) {
        double total = 0;
        for (int chunk = 0; chunk < POSE_CHUNKS; chunk++) total += parts[6 * chunk + k];
        out.pose[k] = total;
    }
}

// ---------------------------------------------------------------- information

// Derivatives by vec log Sigma (xx, yy, zz, sqrt2 xy, sqrt2 xz, sqrt2 yz; map frame). By Daleckii and Krein the derivative of
// Sigma = exp(L) in the axes R of L is the Hadamard product with the divided differences of exp, so the cotangent of L is
// R (D o Y) R^T.
inline void log_covariance_cotangent(const Splat16& s, const Vec* Y, const Vec* differences, Vec* d_log) {
    Vec X[9], RX[9];
    for (int k = 0; k < 3; k++) X[4 * k] = s.scale[k] * s.scale[k] * Y[k];
    X[1] = X[3] = differences[0] * Y[3];
    X[2] = X[6] = differences[1] * Y[4];
    X[5] = X[7] = differences[2] * Y[5];
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < 3; k++)
            RX[3 * i + k] = fma(s.R[3 * i], X[k], fma(s.R[3 * i + 1], X[3 + k], s.R[3 * i + 2] * X[6 + k]));
    auto entry = [&](int i, int j) {
        return fma(RX[3 * i], s.R[3 * j], fma(RX[3 * i + 1], s.R[3 * j + 1], RX[3 * i + 2] * s.R[3 * j + 2]));
    };
    const Vec sqrt2(1.41421356f);
    d_log[0] = entry(0, 0);
    d_log[1] = entry(1, 1);
    d_log[2] = entry(2, 2);
    d_log[3] = sqrt2 * entry(0, 1);
    d_log[4] = sqrt2 * entry(0, 2);
    d_log[5] = sqrt2 * entry(1, 2);
}

// Upper triangle, row by row, of the 9x9 information in (mean, vec log Sigma), map frame.
template <DepthKind KIND>
inline void geometry_information(const View& view, const Splat16& s, const Vec* info, Vec* upper) {
    constexpr int TERMS = SCREEN_TERMS<KIND>, SHAPE = SHAPE_TERMS<KIND>;
    const ScreenGram<KIND> gram(info);
    const ScreenDerivatives<KIND> derivatives(view, s);
    auto difference = [&](int i, int k) {
        return exp2x_divided_difference(s.log_scale[i], s.log_scale[k], s.scale[i], s.scale[k]);
    };
    const Vec differences[3] = {difference(0, 1), difference(0, 2), difference(1, 2)};
    Vec by_log[SHAPE][6], mean[3][TERMS], log[6][SHAPE];
    for (int k = 0; k < SHAPE; k++) log_covariance_cotangent(s, derivatives.Y[k], differences, by_log[k]);
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < TERMS; k++) mean[i][k] = derivatives.by_mean[k][i];
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < SHAPE; k++) log[i][k] = by_log[k][i];
    for (int i = 0; i < 3; i++) {
        for (int j = i; j < 3; j++) *upper++ = quadratic_form<TERMS, TERMS>(gram, 0, 0, mean[i], mean[j]);
        for (int j = 0; j < 6; j++) *upper++ = quadratic_form<TERMS, SHAPE>(gram, 0, SHAPE_FIRST, mean[i], log[j]);
    }
    for (int i = 0; i < 6; i++)
        for (int j = i; j < 6; j++) *upper++ = quadratic_form<SHAPE, SHAPE>(gram, SHAPE_FIRST, SHAPE_FIRST, log[i], log[j]);
}

template <DepthKind KIND>
inline void information_group(const Frame& frame, const GaussianArrays& gaussians, size_t index, const FisherArrays& out) {
    const Group group(frame, gaussians, index);
    Vec info[INFORMATION_ROW], upper[45];
    group.reduce<INFORMATION_ROW>(frame, info);
    geometry_information<KIND>(frame.view, group.splat, info, upper);
    const Vec transparency = sigmoid(-group.parameters.logit), opacity = transparency * transparency * info[INFO_1];
    const Vec color[3] = {info[INFO_R], info[INFO_R], info[INFO_R]};
    scatter_add<45>(upper, group, out.geometry);
    scatter_add<3>(color, group, out.color);
    scatter_add<1>(&opacity, group, out.opacity);
    scatter_add<1>(info + INFO_WEIGHT, group, out.weight);
    scatter_add<1>(info + INFO_RESIDUAL, group, out.residual);
    if (out.diagonal) {
        Vec diagonal[14];
        diagonal_information<KIND>(frame.view, group.splat, transparency, info, color, diagonal);
        scatter_add<14>(diagonal, group, out.diagonal);
    }
    const uint32_t observed = bits(Vec(0.0f) < info[INFO_R] + info[INFO_ZZ]);
    for (int lane = 0; lane < group.lanes; lane++) out.observations[group.ids[lane]] += observed >> lane & 1;
}

}  // namespace KERNEL_ISA
