// The residuals of a registration at one pose, their weights and normal equations (registration.residuals, where the
// equations stand). Residuals and weights have the bits of that definition: every operation is one of float, in its
// order, none fused. Sums are of sixteen lanes of float over a batch, then of double in the order of the batches.
#pragma once

#include "registration_samples.h"

namespace KERNEL_ISA {

using namespace raster;

constexpr double MAD_TO_SIGMA = 1.4826;
constexpr int ALL_SUMS = PARAMETERS * (PARAMETERS + 1) / 2 + PARAMETERS;  // of the upper triangle, and the gradient

// --- robust scales --------------------------------------------------------------------------------------------------

// The key of given rank, 0 the smallest; the keys, below 2^31, are put into another order.
static uint32_t ranked(uint32_t* keys, size_t count, size_t rank) {
    uint32_t prefix = 0;
    for (int shift = 20; shift >= -2; shift -= 11) {  // digits of 11, 11, and 9 bits
        const int low = shift < 0 ? 0 : shift, bits = shift < 0 ? 9 : 11;
        const uint32_t mask = (1u << bits) - 1;
        uint32_t counts[1 << 11] = {};
        for (size_t i = 0; i < count; i++) counts[keys[i] >> low & mask]++;
        uint32_t digit = 0;
        while (rank >= counts[digit]) rank -= counts[digit++];
        prefix |= digit << low;
        size_t kept = 0;
        for (size_t i = 0; i < count; i++) {
            const uint32_t key = keys[i];
            keys[kept] = key;
            kept += (key >> low & mask) == digit;
        }
        count = kept;
    }
    return prefix;
}

// The median of magnitudes of every `stride`-th value, as numpy has it; values must not be empty.
static float median_magnitude(const float* values, size_t count, size_t stride, Scratch<uint32_t>& memory) {
    const size_t used = (count + stride - 1) / stride;
    uint32_t *const keys = memory.need(2 * used), *const copy = keys + used;
    uint32_t largest = 0;
    for (size_t i = 0; i < used; i++) {
        uint32_t word;
        std::memcpy(&word, values + i * stride, sizeof word);
        keys[i] = copy[i] = word & 0x7fffffffu;  // magnitudes are ordered as their bits
        largest = keys[i] > largest ? keys[i] : largest;
    }
    if (largest > 0x7f800000u) return __builtin_nanf("");
    const uint32_t upper = ranked(keys, used, used / 2);
    uint32_t lower = upper;
    if (used % 2 == 0) {
        size_t below = 0;
        uint32_t next = 0;
        for (size_t i = 0; i < used; i++) {
            below += copy[i] < upper;
            next = copy[i] < upper && copy[i] > next ? copy[i] : next;
        }
        if (below == used / 2) lower = next;
    }
    float high, low;
    std::memcpy(&high, &upper, sizeof high);
    std::memcpy(&low, &lower, sizeof low);
    return used % 2 ? high : (low + high) / 2.0f;
}

static double robust_scale(const float* residuals, size_t count, double floor, const AlignmentSettings& settings, AlignmentScratch& scratch) {
    if (!count) return floor;
    const size_t stride = count > settings.mad_from ? settings.mad_stride : 1;
    const double scale = MAD_TO_SIGMA * static_cast<double>(median_magnitude(residuals, count, stride, scratch.keys));
    return floor > scale ? floor : scale;
}

// --- weighted sums --------------------------------------------------------------------------------------------------

// Rows of a batch; behind the last one zeros up to whole vectors.
struct Rows {
    alignas(64) float jacobian[PARAMETERS][BATCH], residual[BATCH], weight[BATCH];
};
struct LaneSums {
    alignas(64) double of[ALL_SUMS][LANES];
};

template <int COUNT>
NO_INLINE static void add_products(const Rows& rows, int count, LaneSums& sums) {
    int at = 0;
    unrolled<COUNT>([&](auto i) ALWAYS_INLINE {
        constexpr int ROW = i;
        Vec products[COUNT - ROW], gradient(0.0f);
        for (Vec& product : products) product = Vec(0.0f);
        for (int k = 0; k < count; k += LANES) {
            const Vec weighted = load(rows.jacobian[ROW] + k) * load(rows.weight + k);
            unrolled<COUNT - ROW>([&](auto j) ALWAYS_INLINE { products[j] += weighted * load(rows.jacobian[ROW + j] + k); });
            gradient += weighted * load(rows.residual + k);
        }
        alignas(64) float lanes[LANES];
        const auto add = [&](Vec value) ALWAYS_INLINE {
            store(lanes, value);
            for (int lane = 0; lane < LANES; lane++) sums.of[at][lane] += static_cast<double>(lanes[lane]);
            at++;
        };
        for (const Vec& product : products) add(product);
        add(gradient);
    });
}

static void write_sums(const LaneSums& sums, int count, NormalEquations& out) {
    int at = 0;
    const auto next = [&] {
        double total = 0.0;
        for (double lane : sums.of[at]) total += lane;
        at++;
        return total;
    };
    for (int i = 0; i < count; i++) {
        for (int j = i; j < count; j++) out.H[i][j] = out.H[j][i] = next();
        out.gradient[i] = next();
    }
}

struct Tiles {
    float per_u, per_v;
};

// Over the pixels of the samples that have a flag.
static Tiles make_tiles(const Samples& all, Flag flag) {
    float u = 0.0f, v = 0.0f;  // pixels are at 1 and more
    for (size_t i = 0; i < all.of->count; i++) {
        const bool counts = (all.flags[i] & flag) != 0;
        u = counts && all[U][i] > u ? all[U][i] : u;
        v = counts && all[V][i] > v ? all[V][i] : v;
    }
    return {static_cast<float>(TILE_COLUMNS / (static_cast<double>(u) + 1.0)), static_cast<float>(TILE_ROWS / (static_cast<double>(v) + 1.0))};
}

template <int COUNT>
static void add_statistics(const Rows& rows, size_t begin, int count, const Samples& all, Tiles tiles, NormalEquations& out) {
    for (int i = 0; i < count; i++) {
        if (rows.weight[i] == 0.0f) continue;  // its pixel may lie in none of the tiles
        const float weight = rows.weight[i], force = weight * rows.residual[i];
        const double residual = rows.residual[i];
        out.weights += weight;
        out.squares += weight * (residual * residual);
        const int row = static_cast<int>(all[V][begin + i] * tiles.per_v), column = static_cast<int>(all[U][begin + i] * tiles.per_u);
        const int tile = row * TILE_COLUMNS + column;
        double* const gradient = out.tile_gradients[tile];
        for (int k = 0; k < COUNT; k++) gradient[k] += static_cast<double>(rows.jacobian[k][i] * force);
    }
}

// Runs fill(begin, count, rows) for every batch and sums what it leaves of the samples that have a flag.
template <int COUNT, class Fill>
static void sum_batches(const Samples& all, Flag flag, const Tiles* tiles, NormalEquations& out, Fill fill) {
    LaneSums sums = {};
    Rows rows;
    for (size_t begin = 0; begin < all.of->count; begin += BATCH) {
        const int count = static_cast<int>(all.of->count - begin < BATCH ? all.of->count - begin : BATCH);
        fill(begin, count, rows);
        const int32_t* const flags = all.flags + begin;
        for (int i = 0; i < count; i++) rows.weight[i] = flags[i] & flag ? rows.weight[i] : 0.0f;
        for (int i = count; i % LANES; i++) {
            for (int k = 0; k < COUNT; k++) rows.jacobian[k][i] = 0.0f;
            rows.residual[i] = rows.weight[i] = 0.0f;
        }
        add_products<COUNT>(rows, count, sums);
        if (tiles) add_statistics<COUNT>(rows, begin, count, all, *tiles, out);
    }
    write_sums(sums, COUNT, out);
}

// --- rows of depth --------------------------------------------------------------------------------------------------

// From sample `begin` on: m / sigma by v, surface x m / sigma by w.
NO_INLINE static void depth_rows(const TargetImages& image, const Samples& all, size_t begin, int count, double scale, double huber_sigmas,
                                 Rows* __restrict rows) {
    const float *mx = all[MX] + begin, *my = all[MY] + begin, *mz = all[MZ] + begin, *u = all[U] + begin, *v = all[V] + begin;
    const float *z = all[Z] + begin, *sigma = all[SIGMA] + begin, *residual = all[DEPTH_RESIDUAL] + begin;
    const float fx = image.fx, fy = image.fy, cx = image.cx, cy = image.cy;
    const float limit = static_cast<float>(huber_sigmas * scale), variance = static_cast<float>(scale * scale);
    for (int i = 0; i < count; i++) {
        const float x = ray(u[i], cx, fx) * z[i], y = ray(v[i], cy, fy) * z[i], s = sigma[i];
        rows->jacobian[0][i] = mx[i] / s, rows->jacobian[1][i] = my[i] / s, rows->jacobian[2][i] = mz[i] / s;
        rows->jacobian[3][i] = (y * mz[i] - z[i] * my[i]) / s;
        rows->jacobian[4][i] = (z[i] * mx[i] - x * mz[i]) / s;
        rows->jacobian[5][i] = (x * my[i] - y * mx[i]) / s;
        const float magnitude = __builtin_fabsf(residual[i]) / limit;
        rows->residual[i] = residual[i];
        rows->weight[i] = 1.0f / ((magnitude > 1.0f ? magnitude : 1.0f) * variance);
    }
}

// --- rows of gray values --------------------------------------------------------------------------------------------

// d gray / d q.
ALWAYS_INLINE inline void gray_by_point(float fx, float fy, float by_u, float by_v, float qx, float qy, float qz, float* d) {
    d[0] = by_u * fx / qz, d[1] = by_v * fy / qz;
    d[2] = -(d[0] * qx + d[1] * qy) / qz;
}

// The variance that the error of a sample's depth adds to its gray residual, and in the list that of those with one.
static void set_variances(const TargetImages& image, const float* T, double depth_scale, const AlignmentSettings& settings, Samples& all) {
    const SampleArrays& samples = *all.of;
    const float share = static_cast<float>(depth_scale * __builtin_sqrt(0.5));
    size_t listed = 0;
    for (size_t i = 0; i < samples.count; i++) {
        const float z = samples.points[3 * i + 2];
        const float sigma = samples.depth_sigmas ? samples.depth_sigmas[i] : model_sigma(settings, z);
        const float relative = share * sigma / z;
        float d[3];
        gray_by_point(image.fx, image.fy, all[BY_U][i], all[BY_V][i], all[QX][i], all[QY][i], all[QZ][i], d);
        const float change = d[0] * (-T[3] * relative) + d[1] * (-T[7] * relative) + d[2] * (-T[11] * relative);
        all.column[VARIANCE][i] = all.column[LIST_OF_GRAY][listed] = change * change;
        listed += all.flags[i] & HAS_GRAY ? 1 : 0;
    }
}

struct GrayWeights {
    bool known;      // whether a part of every variance is
    float variance;  // of all, or what is added to the known part
    float limit, huber_sigmas;
};

// From sample `begin` on: -d by v, -(q x d) by w, -I and -1 by gain and offset.
NO_INLINE static void gray_rows(const TargetImages& image, const Samples& all, size_t begin, int count, const GrayWeights& weights,
                                Rows* __restrict rows) {
    const float *qx = all[QX] + begin, *qy = all[QY] + begin, *qz = all[QZ] + begin, *by_u = all[BY_U] + begin, *by_v = all[BY_V] + begin;
    const float *intensity = all.of->intensities + begin, *residual = all[GRAY_RESIDUAL] + begin, *known = all[VARIANCE] + begin;
    const float fx = image.fx, fy = image.fy;
    for (int i = 0; i < count; i++) {
        float d[3];
        gray_by_point(fx, fy, by_u[i], by_v[i], qx[i], qy[i], qz[i], d);
        for (int k = 0; k < 3; k++) rows->jacobian[k][i] = -d[k];
        rows->jacobian[3][i] = -(qy[i] * d[2] - qz[i] * d[1]);
        rows->jacobian[4][i] = -(qz[i] * d[0] - qx[i] * d[2]);
        rows->jacobian[5][i] = -(qx[i] * d[1] - qy[i] * d[0]);
        rows->jacobian[6][i] = -intensity[i];
        rows->jacobian[7][i] = -1.0f;
        rows->residual[i] = residual[i];
    }
    const float variance = weights.variance, limit = weights.limit, huber_sigmas = weights.huber_sigmas;
    if (weights.known)
        for (int i = 0; i < count; i++) {
            const float own = variance + known[i];
            const float magnitude = __builtin_fabsf(residual[i]) / (huber_sigmas * __builtin_sqrtf(own));
            rows->weight[i] = 1.0f / ((magnitude > 1.0f ? magnitude : 1.0f) * own);
        }
    else
        for (int i = 0; i < count; i++) {
            const float magnitude = __builtin_fabsf(residual[i]) / limit;
            rows->weight[i] = 1.0f / ((magnitude > 1.0f ? magnitude : 1.0f) * variance);
        }
}

// --- all of a level -------------------------------------------------------------------------------------------------

static void add_statistics_of_depth(Samples& all, AlignmentScratch& scratch, AlignmentSystem& system) {
    if (!all.agreeing) return;
    double total = 0.0;
    size_t listed = 0;
    float* const depths = all.column[VARIANCE];
    for (size_t i = 0; i < all.of->count; i++) {
        const bool agrees = (all.flags[i] & AGREES) != 0;
        if (agrees) total += all[SIGMA][i];
        depths[listed] = all[Z][i];
        listed += agrees;
    }
    system.sigma_mean_m = total / static_cast<double>(listed);
    system.median_depth_m = median_magnitude(depths, listed, 1, scratch.keys);
}

// T: T_target_reference [3, 4]; level: 0 the finest.
static void align_level(const SampleArrays& samples, const TargetImages& image, int level, const float* T, const double* exposure,
                        const AlignmentSettings& settings, bool statistics, AlignmentScratch& scratch, AlignmentSystem& system) {
    system = {};
    Samples all = make_samples(samples, scratch);
    view_samples(image, T, {static_cast<float>(exposure[0]), static_cast<float>(exposure[1])}, settings, all, system);
    if (statistics) add_statistics_of_depth(all, scratch, system);

    double floor = settings.depth_scale_floor;
    for (int k = 0; k < level; k++) floor *= 4.0;
    system.depth.scale = robust_scale(all[LIST_OF_DEPTH], all.agreeing, floor, settings, scratch);
    const bool use_depth = settings.use_depth && image.has_depth;
    Tiles tiles = {};
    if (statistics) tiles = make_tiles(all, use_depth ? AGREES : HAS_GRAY);
    if (use_depth) {
        sum_batches<POSE_PARAMETERS>(all, AGREES, statistics ? &tiles : nullptr, system.depth, [&](size_t begin, int count, Rows& rows) {
            depth_rows(image, all, begin, count, system.depth.scale, settings.huber_sigmas, &rows);
        });
        system.depth.count = all.agreeing;
    }

    const double by_depth = settings.gray_floor_of_depth * system.depth.scale;
    const double gray_floor = by_depth > settings.gray_scale_floor ? by_depth : settings.gray_scale_floor;
    const double scale = system.gray.scale = robust_scale(all[LIST_OF_GRAY], all.gray, gray_floor, settings, scratch);
    if (!settings.use_gray) return;
    GrayWeights weights = {settings.gray_noise_of_depth && all.gray, static_cast<float>(scale * scale),
                           static_cast<float>(settings.huber_sigmas * scale), static_cast<float>(settings.huber_sigmas)};
    if (weights.known) {
        set_variances(image, T, system.depth.scale, settings, all);
        const double rest = scale * scale - static_cast<double>(median_magnitude(all[LIST_OF_GRAY], all.gray, 1, scratch.keys));
        const double least = gray_floor * gray_floor;
        weights.variance = static_cast<float>(rest > least ? rest : least);
    }
    sum_batches<PARAMETERS>(all, HAS_GRAY, statistics ? &tiles : nullptr, system.gray,
                            [&](size_t begin, int count, Rows& rows) { gray_rows(image, all, begin, count, weights, &rows); });
    system.gray.count = all.gray;
}

}  // namespace KERNEL_ISA
