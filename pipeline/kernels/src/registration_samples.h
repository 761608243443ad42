// The samples of a reference in the images of a target: where they fall, what is seen there, and which of them agree
// (registration.residuals, the same bits: every operation is one of float, in its order, none fused).
#pragma once

#include "registration_data.h"
#include "simd.h"

namespace KERNEL_ISA {

using namespace raster;

constexpr int BATCH = 256;                 // samples at a time: their values stay in the nearest cache
constexpr float NEAREST_FRONT_M = 0.05f;   // nearer points are not projected

// --- the samples of a batch that are in view ------------------------------------------------------------------------

struct Batch {
    alignas(64) float qx[BATCH], qy[BATCH], qz[BATCH], u[BATCH], v[BATCH];  // q: in the frame of the target
    alignas(64) int32_t flags[BATCH], index[BATCH];
    // Around the pixel: gray[r][c] at (v0 - 1 + r, u0 - 1 + c), the four corners unused; depth and sigma at (v0 + r, u0 + c).
    alignas(64) float gray[4][4][BATCH], depth[2][2][BATCH], sigma[2][2][BATCH];
    alignas(64) float value[BATCH], by_u[BATCH], by_v[BATCH], z[BATCH], noise[BATCH];
};

// One component of a rotated point.
ALWAYS_INLINE inline float rotated(const float* row, float x, float y, float z) { return row[0] * x + row[1] * y + row[2] * z; }

// Frame and pixel in the target, and whether the pixel and its neighbors lie inside.
NO_INLINE static void project_samples(const float* __restrict points, int count, const float* __restrict T, const TargetImages& image,
                                      Batch* __restrict c) {
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
        c->qx[i] = qx, c->qy[i] = qy, c->qz[i] = qz, c->u[i] = u, c->v[i] = v;
        c->flags[i] = (qz > NEAREST_FRONT_M) & (u >= 1.0f) & (u < right) & (v >= 1.0f) & (v < bottom);
    }
}

// Moves the samples inside to the front.
static int keep_inside(Batch& c, int count) {
    int kept = 0;
    for (int i = 0; i < count; i++) {
        c.qx[kept] = c.qx[i], c.qy[kept] = c.qy[i], c.qz[kept] = c.qz[i], c.u[kept] = c.u[i], c.v[kept] = c.v[i];
        c.index[kept] = i;
        kept += c.flags[i];
    }
    return kept;
}

static void gather_pixels(const TargetImages& image, Batch& c, int count) {
    const size_t width = static_cast<size_t>(image.width);
    for (int i = 0; i < count; i++) {
        const size_t corner = static_cast<size_t>(c.v[i]) * width + static_cast<size_t>(c.u[i]);
        const float* const row = image.gray + corner;
        for (int k = 0; k < 2; k++) {
            c.gray[0][1 + k][i] = row[k - static_cast<std::ptrdiff_t>(width)];
            c.gray[3][1 + k][i] = row[2 * width + k];
        }
        for (int k = 0; k < 4; k++) {
            c.gray[1][k][i] = row[k - 1];
            c.gray[2][k][i] = row[width + k - 1];
        }
        const float* const depth = image.inverse_depth + corner;
        for (int k = 0; k < 2; k++) c.depth[0][k][i] = depth[k], c.depth[1][k][i] = depth[width + k];
    }
    if (!image.depth_sigma) return;
    for (int i = 0; i < count; i++) {
        const float* const sigma = image.depth_sigma + static_cast<size_t>(c.v[i]) * width + static_cast<size_t>(c.u[i]);
        for (int k = 0; k < 2; k++) c.sigma[0][k][i] = sigma[k], c.sigma[1][k][i] = sigma[width + k];
    }
}

ALWAYS_INLINE inline float between(float a, float from, float to) { return from + a * (to - from); }

template <class Corner>
ALWAYS_INLINE inline float bilinear(float a, float b, Corner corner) {
    return between(b, between(a, corner(0, 0), corner(0, 1)), between(a, corner(1, 0), corner(1, 1)));
}

enum Verdict : int32_t { OFF = 0, JUDGED = 1, AGREES = 2, CONFLICTS = 4 };

// Interpolates at the pixels, and compares depths: a Verdict for each sample.
NO_INLINE static void interpolate(const TargetImages& image, const AlignmentSettings& settings, int count, Batch* __restrict c) {
    const bool has_depth = image.has_depth, has_sigma = image.depth_sigma != nullptr;
    const float gate_m = settings.depth_gate_m, gate_relative = settings.depth_gate_relative, gate_sigmas = settings.gate_sigmas;
    if (has_sigma)
        for (int i = 0; i < count; i++) {
            const float a = c->u[i] - static_cast<float>(static_cast<int32_t>(c->u[i]));
            const float b = c->v[i] - static_cast<float>(static_cast<int32_t>(c->v[i]));
            c->noise[i] = bilinear(a, b, [&](int r, int k) ALWAYS_INLINE { return c->sigma[r][k][i]; });
        }
    else
        for (int i = 0; i < count; i++) c->noise[i] = 0.0f;
    for (int i = 0; i < count; i++) {
        const float a = c->u[i] - static_cast<float>(static_cast<int32_t>(c->u[i]));
        const float b = c->v[i] - static_cast<float>(static_cast<int32_t>(c->v[i]));
        c->value[i] = bilinear(a, b, [&](int r, int k) ALWAYS_INLINE { return c->gray[1 + r][1 + k][i]; });
        c->by_u[i] = bilinear(a, b, [&](int r, int k) ALWAYS_INLINE { return 0.5f * (c->gray[1 + r][2 + k][i] - c->gray[1 + r][k][i]); });
        c->by_v[i] = bilinear(a, b, [&](int r, int k) ALWAYS_INLINE { return 0.5f * (c->gray[2 + r][1 + k][i] - c->gray[r][1 + k][i]); });
    }
    for (int i = 0; i < count; i++) {
        const float a = c->u[i] - static_cast<float>(static_cast<int32_t>(c->u[i]));
        const float b = c->v[i] - static_cast<float>(static_cast<int32_t>(c->v[i]));
        const float inverse = bilinear(a, b, [&](int r, int k) ALWAYS_INLINE { return c->depth[r][k][i]; });
        const bool known = (c->depth[0][0][i] > 0.0f) & (c->depth[0][1][i] > 0.0f) & (c->depth[1][0][i] > 0.0f) & (c->depth[1][1][i] > 0.0f);
        const float q = c->qz[i], z = has_depth ? 1.0f / inverse : q;
        const float relative = gate_relative * q, wide = gate_sigmas * c->noise[i];
        const float gate = gate_m > relative ? gate_m : relative, limit = gate > wide ? gate : wide;
        const float off = z - q;
        const bool judged = known & (__builtin_fabsf(z) <= __FLT_MAX__);
        c->z[i] = z;
        c->flags[i] = (judged ? JUDGED : OFF) | (known & (__builtin_fabsf(off) < limit) ? AGREES : OFF) | (known & (off >= limit) ? CONFLICTS : OFF);
    }
}

// --- the samples that agree, of all batches --------------------------------------------------------------------------

// Columns of the arrays: q, m (normal in the frame of the target), pixel, depth, gray value with its derivatives, ...
enum Column { QX, QY, QZ, MX, MY, MZ, U, V, Z, GRAY, BY_U, BY_V, SIGMA, INTENSITY, DEPTH_RESIDUAL, GRAY_RESIDUAL, VARIANCE, COLUMNS };

struct Agreeing {
    float* column[COLUMNS];
    int32_t* index;  // of the sample
    size_t count = 0;
    const float* operator[](Column k) const { return column[k]; }
};

static Agreeing make_agreeing(AlignmentScratch& scratch, size_t most) {
    const size_t stride = (most / LANES + 2) * LANES;
    Agreeing all;
    float* const memory = scratch.floats.need(stride * COLUMNS);
    for (int k = 0; k < COLUMNS; k++) all.column[k] = memory + stride * k;
    all.index = scratch.indices.need(stride);
    return all;
}

static bool normals_agree(const SampleArrays& samples, size_t sample, const TargetImages& image, const float* T, float u, float v,
                          float min_cosine) {
    const size_t pixel = static_cast<size_t>(v + 0.5f) * static_cast<size_t>(image.width) + static_cast<size_t>(u + 0.5f);
    const float *const there = image.normals + 3 * pixel, *const n = samples.normals + 3 * sample;
    const float mx = rotated(T, n[0], n[1], n[2]), my = rotated(T + 4, n[0], n[1], n[2]), mz = rotated(T + 8, n[0], n[1], n[2]);
    return there[0] * mx + there[1] * my + there[2] * mz > min_cosine;
}

static void keep_agreeing(const SampleArrays& samples, size_t begin, const TargetImages& image, const float* T,
                          const AlignmentSettings& settings, const Batch& c, int count, Agreeing& all) {
    size_t n = all.count;
    for (int i = 0; i < count; i++) {
        const size_t sample = begin + static_cast<size_t>(c.index[i]);
        const float values[] = {c.qx[i], c.qy[i], c.qz[i]};
        for (int k = 0; k < 3; k++) {
            all.column[QX + k][n] = values[k];
            all.column[MX + k][n] = samples.normals[3 * sample + k];
        }
        all.column[U][n] = c.u[i], all.column[V][n] = c.v[i], all.column[Z][n] = c.z[i], all.column[SIGMA][n] = c.noise[i];
        all.column[GRAY][n] = c.value[i], all.column[BY_U][n] = c.by_u[i], all.column[BY_V][n] = c.by_v[i];
        all.column[INTENSITY][n] = samples.intensities[sample];
        all.index[n] = static_cast<int32_t>(sample);
        bool agrees = (c.flags[i] & AGREES) != 0;
        if (agrees && image.normals) agrees = normals_agree(samples, sample, image, T, c.u[i], c.v[i], settings.min_normal_cosine);
        n += agrees;
    }
    all.count = n;
}

static void find_agreeing(const SampleArrays& samples, const TargetImages& image, const float* T, const AlignmentSettings& settings,
                          Agreeing& all, AlignmentSystem& system) {
    Batch c;
    for (size_t begin = 0; begin < samples.count; begin += BATCH) {
        const int count = static_cast<int>(samples.count - begin < BATCH ? samples.count - begin : BATCH);
        project_samples(samples.points + 3 * begin, count, T, image, &c);
        const int seen = keep_inside(c, count);
        gather_pixels(image, c, seen);
        interpolate(image, settings, seen, &c);
        for (int i = 0; i < seen; i++) {
            system.judged += c.flags[i] & JUDGED;
            system.conflicts += c.flags[i] / CONFLICTS;
        }
        system.seen += static_cast<size_t>(seen);
        keep_agreeing(samples, begin, image, T, settings, c, seen, all);
    }
    system.agreeing = all.count;
}

}  // namespace KERNEL_ISA
