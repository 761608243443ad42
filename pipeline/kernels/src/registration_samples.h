// The samples of a reference in the images of a target: where they fall, what is seen there, which of them agree, and
// their residuals (registration.residuals, the same bits: every operation is one of float, in its order, none fused).
//
// Nothing is moved together: a sample that does not agree keeps its place, with harmless values and, later, no weight.
#pragma once

#include "registration_data.h"
#include "simd.h"

namespace KERNEL_ISA {

using namespace raster;

constexpr int BATCH = 256;                // samples at a time: their values stay in the nearest cache
constexpr float NEAREST_FRONT_M = 0.05f;  // nearer points are not projected

// Columns of the arrays over all samples: q (point in the frame of the target), m (normal there), pixel, depth seen there, ...
enum Column { QX, QY, QZ, MX, MY, MZ, U, V, Z, BY_U, BY_V, SIGMA, DEPTH_RESIDUAL, GRAY_RESIDUAL, VARIANCE, LIST_OF_DEPTH, LIST_OF_GRAY, COLUMNS };
enum Flag : int32_t { IN_VIEW = 1, JUDGED = 2, CONFLICTS = 4, AGREES = 8, HAS_GRAY = 16 };

struct Samples {
    const SampleArrays* of;
    float* column[COLUMNS];
    int32_t* flags;
    size_t agreeing = 0, gray = 0;  // numbers, and of the residuals in the lists
    const float* operator[](Column k) const { return column[k]; }
};

static Samples make_samples(const SampleArrays& arrays, AlignmentScratch& scratch) {
    const size_t stride = (arrays.count / LANES + 2) * LANES;
    Samples all;
    all.of = &arrays;
    float* const memory = scratch.floats.need(stride * COLUMNS);
    for (int k = 0; k < COLUMNS; k++) all.column[k] = memory + stride * k;
    all.flags = scratch.indices.need(stride);
    return all;
}

struct SampleBatch {
    alignas(64) float qx[BATCH], qy[BATCH], qz[BATCH], u[BATCH], v[BATCH];
    alignas(64) int32_t flags[BATCH];
    // Around the pixel, two neighbors at a time: gray[r] at row v0 - 1 + r, in gray[1] and gray[2] first those at u0 - 1 and
    // u0, then at u0 + 1 and u0 + 2, in the others those at u0 and u0 + 1; depth[r] and sigma[r] at row v0 + r.
    alignas(64) float above[2 * BATCH], left[2][2 * BATCH], right[2][2 * BATCH], below[2 * BATCH];
    alignas(64) float depth[2][2 * BATCH], sigma[2][2 * BATCH];
    alignas(64) float value[BATCH], by_u[BATCH], by_v[BATCH], z[BATCH], noise[BATCH];
};

// One component of a rotated point.
ALWAYS_INLINE inline float rotated(const float* row, float x, float y, float z) { return row[0] * x + row[1] * y + row[2] * z; }

// Frame and pixel in the target, and whether the pixel and its neighbors lie inside; if not, the pixel is (1, 1).
NO_INLINE static void project_samples(const float* __restrict points, int count, const float* __restrict T, const TargetImages& image,
                                      SampleBatch* __restrict b) {
    const float rows[3][4] = {{T[0], T[1], T[2], T[3]}, {T[4], T[5], T[6], T[7]}, {T[8], T[9], T[10], T[11]}};
    const float fx = image.fx, fy = image.fy, cx = image.cx, cy = image.cy;
    const float right = static_cast<float>(image.width - 2), bottom = static_cast<float>(image.height - 2);
    for (int i = 0; i < count; i++) {
        const float x = points[3 * i], y = points[3 * i + 1], z = points[3 * i + 2];
        const float qx = rotated(rows[0], x, y, z) + rows[0][3];
        const float qy = rotated(rows[1], x, y, z) + rows[1][3];
        const float qz = rotated(rows[2], x, y, z) + rows[2][3];
        const float front = qz > NEAREST_FRONT_M ? qz : NEAREST_FRONT_M;
        const float u = fx * qx / front + cx, v = fy * qy / front + cy;
        const bool inside = (qz > NEAREST_FRONT_M) & (u >= 1.0f) & (u < right) & (v >= 1.0f) & (v < bottom);
        b->qx[i] = qx, b->qy[i] = qy, b->qz[i] = qz;
        b->u[i] = inside ? u : 1.0f, b->v[i] = inside ? v : 1.0f;
        b->flags[i] = inside ? IN_VIEW : 0;
    }
}

ALWAYS_INLINE inline void copy_pair(float* to, const float* from) { std::memcpy(to, from, 2 * sizeof(float)); }

static void gather_pixels(const TargetImages& image, SampleBatch& b, int count) {
    if (image.width < 4 || image.height < 4) return;  // no sample is inside
    const std::ptrdiff_t width = image.width;
    for (int i = 0; i < count; i++) {
        const std::ptrdiff_t corner = static_cast<int32_t>(b.v[i]) * width + static_cast<int32_t>(b.u[i]);
        const float *const row = image.gray + corner, *const depth = image.inverse_depth + corner;
        copy_pair(b.above + 2 * i, row - width);
        for (int r = 0; r < 2; r++) {
            copy_pair(b.left[r] + 2 * i, row + r * width - 1);
            copy_pair(b.right[r] + 2 * i, row + r * width + 1);
            copy_pair(b.depth[r] + 2 * i, depth + r * width);
        }
        copy_pair(b.below + 2 * i, row + 2 * width);
    }
    if (!image.depth_sigma) return;
    for (int i = 0; i < count; i++) {
        const float* const sigma = image.depth_sigma + static_cast<int32_t>(b.v[i]) * width + static_cast<int32_t>(b.u[i]);
        for (int r = 0; r < 2; r++) copy_pair(b.sigma[r] + 2 * i, sigma + r * width);
    }
}

ALWAYS_INLINE inline float fraction(float pixel) { return pixel - static_cast<float>(static_cast<int32_t>(pixel)); }
ALWAYS_INLINE inline float smaller(float a, float b) { return a < b ? a : b; }
ALWAYS_INLINE inline float between(float a, float from, float to) { return from + a * (to - from); }
// Between the corners top left, top right, bottom left, bottom right.
ALWAYS_INLINE inline float bilinear(float a, float b, float tl, float tr, float bl, float br) {
    return between(b, between(a, tl, tr), between(a, bl, br));
}

// Interpolates at the pixels.
NO_INLINE static void interpolate(int count, SampleBatch* __restrict b) {
    for (int i = 0; i < count; i++) {
        const float s = fraction(b->u[i]), t = fraction(b->v[i]);
        const float a1 = b->above[2 * i], a2 = b->above[2 * i + 1], d1 = b->below[2 * i], d2 = b->below[2 * i + 1];
        const float b0 = b->left[0][2 * i], b1 = b->left[0][2 * i + 1], b2 = b->right[0][2 * i], b3 = b->right[0][2 * i + 1];
        const float c0 = b->left[1][2 * i], c1 = b->left[1][2 * i + 1], c2 = b->right[1][2 * i], c3 = b->right[1][2 * i + 1];
        b->value[i] = bilinear(s, t, b1, b2, c1, c2);
        b->by_u[i] = bilinear(s, t, 0.5f * (b2 - b0), 0.5f * (b3 - b1), 0.5f * (c2 - c0), 0.5f * (c3 - c1));
        b->by_v[i] = bilinear(s, t, 0.5f * (c1 - a1), 0.5f * (c2 - a2), 0.5f * (d1 - b1), 0.5f * (d2 - b2));
    }
}

NO_INLINE static void interpolate_sigma(int count, SampleBatch* __restrict b) {
    for (int i = 0; i < count; i++)
        b->noise[i] = bilinear(fraction(b->u[i]), fraction(b->v[i]), b->sigma[0][2 * i], b->sigma[0][2 * i + 1], b->sigma[1][2 * i],
                               b->sigma[1][2 * i + 1]);
}

// Compares depths.
NO_INLINE static void judge(const TargetImages& image, const AlignmentSettings& settings, int count, SampleBatch* __restrict b) {
    if (image.has_depth)
        for (int i = 0; i < count; i++)
            b->z[i] = 1.0f / bilinear(fraction(b->u[i]), fraction(b->v[i]), b->depth[0][2 * i], b->depth[0][2 * i + 1], b->depth[1][2 * i],
                                      b->depth[1][2 * i + 1]);
    else
        std::memcpy(b->z, b->qz, sizeof b->z);
    const float gate_m = settings.depth_gate_m, gate_relative = settings.depth_gate_relative;
    const float gate_sigmas = image.depth_sigma ? settings.gate_sigmas : 0.0f, chance = settings.chance_inverse;
    for (int i = 0; i < count; i++) {
        const float tl = b->depth[0][2 * i], tr = b->depth[0][2 * i + 1], bl = b->depth[1][2 * i], br = b->depth[1][2 * i + 1];
        const float least = smaller(smaller(tl, tr), smaller(bl, br));
        const float q = b->qz[i], z = b->z[i];
        const float relative = gate_relative * q, wide = gate_sigmas * b->noise[i];
        const float gate = gate_m > relative ? gate_m : relative, limit = gate > wide ? gate : wide;
        const float off = z - q, by_chance = chance * z * q;
        const int32_t known = b->flags[i] & (least > 0.0f ? IN_VIEW : 0);  // 1 or 0
        const int32_t agrees = known & (__builtin_fabsf(off) < limit ? 1 : 0);
        // what noise alone may explain says nothing
        const int32_t decided = agrees | (__builtin_fabsf(off) < by_chance ? 0 : 1);
        const int32_t judged = known & decided & (__builtin_fabsf(z) <= __FLT_MAX__ ? 1 : 0);
        const int32_t conflicts = known & decided & (off >= limit ? 1 : 0);
        b->flags[i] += judged * JUDGED + agrees * (AGREES + HAS_GRAY) + conflicts * CONFLICTS;
    }
}

// Normals into the frame of the target.
NO_INLINE static void rotate_normals(const float* __restrict T, const float* __restrict normals, int count, float* __restrict x,
                                     float* __restrict y, float* __restrict z) {
    const float rows[3][3] = {{T[0], T[1], T[2]}, {T[4], T[5], T[6]}, {T[8], T[9], T[10]}};
    for (int i = 0; i < count; i++) {
        const float nx = normals[3 * i], ny = normals[3 * i + 1], nz = normals[3 * i + 2];
        x[i] = rotated(rows[0], nx, ny, nz), y[i] = rotated(rows[1], nx, ny, nz), z[i] = rotated(rows[2], nx, ny, nz);
    }
}

// Samples whose surface the target would see from behind do not agree: what it sees there is another one.
NO_INLINE static void compare_sides(float behind_squared, const float* __restrict mx, const float* __restrict my,
                                    const float* __restrict mz, int count, SampleBatch* __restrict b) {
    for (int i = 0; i < count; i++) {
        const float qx = b->qx[i], qy = b->qy[i], qz = b->qz[i];
        const float away = qx * mx[i] + qy * my[i] + qz * mz[i];
        const float squares = qx * qx + qy * qy + qz * qz;
        const bool behind = (away > 0.0f) & (away * away > behind_squared * squares);
        b->flags[i] &= behind ? ~(AGREES | HAS_GRAY) : ~0;
    }
}

// Samples whose normal is not that of the target at the nearest pixel do not agree.
static void compare_normals(const TargetImages& image, float min_cosine, const Samples& all, size_t begin, int count, SampleBatch& b) {
    for (int i = 0; i < count; i++) {
        if (!(b.flags[i] & AGREES)) continue;
        const size_t pixel = static_cast<size_t>(b.v[i] + 0.5f) * static_cast<size_t>(image.width) + static_cast<size_t>(b.u[i] + 0.5f);
        const float* const n = image.normals + 3 * pixel;
        const float cosine = n[0] * all[MX][begin + i] + n[1] * all[MY][begin + i] + n[2] * all[MZ][begin + i];
        if (!(cosine > min_cosine)) b.flags[i] &= ~(AGREES | HAS_GRAY);
    }
}

static void compare_gradients(float min_gradient, int count, SampleBatch& b) {
    const float least = min_gradient * min_gradient;
    for (int i = 0; i < count; i++)
        if (!(b.by_u[i] * b.by_u[i] + b.by_v[i] * b.by_v[i] >= least)) b.flags[i] &= ~HAS_GRAY;
}

ALWAYS_INLINE inline float model_sigma(const AlignmentSettings& s, float z) {
    const float beyond = z - s.sigma_nearest_m;
    return s.sigma_base_m + s.sigma_quadratic_per_m * (beyond * beyond);
}
ALWAYS_INLINE inline float ray(float pixel, float center, float focal) { return (pixel - center) / focal; }

// Noise of the depth at the samples that agree.
NO_INLINE static void set_sigmas(const TargetImages& image, const AlignmentSettings& s, const float* __restrict ours, int count,
                                 SampleBatch* __restrict b) {
    const AlignmentSettings settings = s;
    if (!image.depth_sigma)
        for (int i = 0; i < count; i++) b->noise[i] = model_sigma(settings, b->z[i]);
    else if (ours)
        for (int i = 0; i < count; i++) b->noise[i] = __builtin_sqrtf(0.5f * (b->noise[i] * b->noise[i] + ours[i] * ours[i]));
}

// Harmless values where a sample does not agree.
NO_INLINE static void clear_others(int count, SampleBatch* __restrict b) {
    for (int i = 0; i < count; i++) {
        const bool agrees = (b->flags[i] & AGREES) != 0;
        b->qx[i] = agrees ? b->qx[i] : 0.0f, b->qy[i] = agrees ? b->qy[i] : 0.0f, b->qz[i] = agrees ? b->qz[i] : 1.0f;
        b->z[i] = agrees ? b->z[i] : 1.0f, b->noise[i] = agrees ? b->noise[i] : 1.0f;
    }
}

struct Exposure {
    float gain, offset;
};

NO_INLINE static void residuals(const TargetImages& image, const Exposure exposure, int count, const float* __restrict mx,
                                const float* __restrict my, const float* __restrict mz, const float* __restrict intensities,
                                const SampleBatch* __restrict b, float* __restrict of_depth, float* __restrict of_gray) {
    const float fx = image.fx, fy = image.fy, cx = image.cx, cy = image.cy;
    for (int i = 0; i < count; i++) {
        const float z = b->z[i], x = ray(b->u[i], cx, fx) * z, y = ray(b->v[i], cy, fy) * z;
        of_depth[i] = (mx[i] * (x - b->qx[i]) + my[i] * (y - b->qy[i]) + mz[i] * (z - b->qz[i])) / b->noise[i];
        of_gray[i] = b->value[i] - (exposure.gain * intensities[i] + exposure.offset);
    }
}

// Sets the columns, the flags, and the lists of residuals of the samples that agree.
static void view_samples(const TargetImages& image, const float* T, Exposure exposure, const AlignmentSettings& settings, Samples& all,
                         AlignmentSystem& system) {
    const SampleArrays& samples = *all.of;
    SampleBatch b = {};
    for (size_t begin = 0; begin < samples.count; begin += BATCH) {
        const int count = static_cast<int>(samples.count - begin < BATCH ? samples.count - begin : BATCH);
        const auto at = [&](Column k) { return all.column[k] + begin; };
        project_samples(samples.points + 3 * begin, count, T, image, &b);
        gather_pixels(image, b, count);
        interpolate(count, &b);
        if (image.depth_sigma)
            interpolate_sigma(count, &b);
        else
            std::memset(b.noise, 0, sizeof b.noise);
        judge(image, settings, count, &b);
        rotate_normals(T, samples.normals + 3 * begin, count, at(MX), at(MY), at(MZ));
        compare_sides(settings.behind_squared, at(MX), at(MY), at(MZ), count, &b);
        if (image.normals) compare_normals(image, settings.min_normal_cosine, all, begin, count, b);
        if (settings.min_gradient > 0.0f) compare_gradients(settings.min_gradient, count, b);
        set_sigmas(image, settings, samples.depth_sigmas ? samples.depth_sigmas + begin : nullptr, count, &b);
        clear_others(count, &b);
        residuals(image, exposure, count, at(MX), at(MY), at(MZ), samples.intensities + begin, &b, at(DEPTH_RESIDUAL), at(GRAY_RESIDUAL));
        const struct {
            Column column;
            const float* values;
        } moved[] = {{QX, b.qx}, {QY, b.qy}, {QZ, b.qz}, {U, b.u}, {V, b.v}, {Z, b.z}, {BY_U, b.by_u}, {BY_V, b.by_v}, {SIGMA, b.noise}};
        for (const auto& m : moved) std::memcpy(at(m.column), m.values, sizeof(float) * static_cast<size_t>(count));
        std::memcpy(all.flags + begin, b.flags, sizeof(int32_t) * static_cast<size_t>(count));
        int seen = 0, judged = 0, conflicts = 0;
        for (int i = 0; i < count; i++) {
            seen += b.flags[i] & IN_VIEW ? 1 : 0;
            judged += b.flags[i] & JUDGED ? 1 : 0;
            conflicts += b.flags[i] & CONFLICTS ? 1 : 0;
        }
        system.seen += static_cast<size_t>(seen), system.judged += static_cast<size_t>(judged), system.conflicts += static_cast<size_t>(conflicts);
        for (int i = 0; i < count; i++) {
            all.column[LIST_OF_DEPTH][all.agreeing] = at(DEPTH_RESIDUAL)[i];
            all.column[LIST_OF_GRAY][all.gray] = at(GRAY_RESIDUAL)[i];
            all.agreeing += b.flags[i] & AGREES ? 1 : 0;
            all.gray += b.flags[i] & HAS_GRAY ? 1 : 0;
        }
    }
    system.agreeing = all.agreeing;
}

}  // namespace KERNEL_ISA
