// Image pyramids and surface normals (registration.definition, the same bits: every operation is one of float, in its order).
#pragma once

#include "registration_data.h"
#include "simd.h"

namespace KERNEL_ISA {

using namespace raster;

constexpr float SAME_SURFACE = 0.05f;  // relative difference of depth up to which neighbors count as one surface

ALWAYS_INLINE inline float unit_of(float value) { return value; }
ALWAYS_INLINE inline float unit_of(uint8_t value) { return static_cast<float>(value) * static_cast<float>(1.0 / 255.0); }

template <class T>
NO_INLINE static void gray_of_color(const T* __restrict color, size_t pixels, float* __restrict gray) {
    for (size_t i = 0; i < pixels; i++)
        gray[i] = 0.299f * unit_of(color[3 * i]) + 0.587f * unit_of(color[3 * i + 1]) + 0.114f * unit_of(color[3 * i + 2]);
}

NO_INLINE static void invert_depth(const float* __restrict depth_m, const uint8_t* __restrict mask, const float* __restrict sigma, size_t pixels,
                                   float* __restrict inverse, float* __restrict known_sigma) {
    for (size_t i = 0; i < pixels; i++) {
        const bool known = (depth_m[i] > 0.0f) & (depth_m[i] <= __FLT_MAX__);
        inverse[i] = known ? 1.0f / depth_m[i] : 0.0f;
    }
    if (mask)
        for (size_t i = 0; i < pixels; i++) inverse[i] = mask[i] ? inverse[i] : 0.0f;
    if (sigma)
        for (size_t i = 0; i < pixels; i++) known_sigma[i] = inverse[i] != 0.0f ? sigma[i] : 0.0f;
}

NO_INLINE static void halve_gray(const float* __restrict top, const float* __restrict bottom, int width, float* __restrict out) {
    for (int i = 0; i < width; i++) out[i] = (top[2 * i] + top[2 * i + 1] + bottom[2 * i] + bottom[2 * i + 1]) * 0.25f;
}

ALWAYS_INLINE inline float larger(float a, float b) { return a > b ? a : b; }

// Inverse depth beyond which the nearest of four is on the same surface: within 5 %, or within what noise explains.
ALWAYS_INLINE inline float least_of_surface(float a, float b, float c, float d, float chance) {
    const float nearest = larger(larger(a, b), larger(c, d)), by_share = nearest * (1.0f - SAME_SURFACE), by_noise = nearest - chance;
    return larger(by_share < by_noise ? by_share : by_noise, 0.0f);
}

// The mean of those of the four that show the nearest surface, and how many they are.
NO_INLINE static void halve_depth(const float* __restrict top, const float* __restrict bottom, int width, float chance, float* __restrict out) {
    for (int i = 0; i < width; i++) {
        const float a = top[2 * i], b = top[2 * i + 1], c = bottom[2 * i], d = bottom[2 * i + 1];
        const float least = least_of_surface(a, b, c, d, chance);
        const float total = (a > least ? a : 0.0f) + (b > least ? b : 0.0f) + (c > least ? c : 0.0f) + (d > least ? d : 0.0f);
        const float count = (a > least ? 1.0f : 0.0f) + (b > least ? 1.0f : 0.0f) + (c > least ? 1.0f : 0.0f) + (d > least ? 1.0f : 0.0f);
        const float mean = total / larger(count, 1.0f);
        out[i] = (total > 0.0f) & (count >= 2.0f) ? mean : 0.0f;
    }
}
NO_INLINE static void halve_sigma(const float* __restrict top, const float* __restrict bottom, const float* __restrict sigma_top,
                                  const float* __restrict sigma_bottom, const float* __restrict halved, int width, float chance,
                                  float* __restrict out) {
    for (int i = 0; i < width; i++) {
        const float a = top[2 * i], b = top[2 * i + 1], c = bottom[2 * i], d = bottom[2 * i + 1];
        const float least = least_of_surface(a, b, c, d, chance);
        const float total = (a > least ? sigma_top[2 * i] : 0.0f) + (b > least ? sigma_top[2 * i + 1] : 0.0f) +
                            (c > least ? sigma_bottom[2 * i] : 0.0f) + (d > least ? sigma_bottom[2 * i + 1] : 0.0f);
        const float count = (a > least ? 1.0f : 0.0f) + (b > least ? 1.0f : 0.0f) + (c > least ? 1.0f : 0.0f) + (d > least ? 1.0f : 0.0f);
        const float mean = total / larger(count, 1.0f);
        out[i] = halved[i] != 0.0f ? mean : 0.0f;
    }
}

// Members of a block whose inverse depths differ by `chance` at most (1/m) are of one surface, as those within 5 % are.
static void halve(const LevelImages& level, float chance, const HalvedImages& out) {
    const size_t from = static_cast<size_t>(level.width), to = from / 2;
    const int width = level.width / 2;
    for (size_t row = 0; row < static_cast<size_t>(level.height / 2); row++) {
        const size_t top = 2 * row * from, bottom = top + from, at = row * to;
        halve_gray(level.gray + top, level.gray + bottom, width, out.gray + at);
        halve_depth(level.inverse_depth + top, level.inverse_depth + bottom, width, chance, out.inverse_depth + at);
        if (level.mask)
            for (size_t i = 0; i < to; i++) out.inverse_depth[at + i] = level.mask[at + i] ? out.inverse_depth[at + i] : 0.0f;
        if (out.depth_sigma)
            halve_sigma(level.inverse_depth + top, level.inverse_depth + bottom, level.depth_sigma + top, level.depth_sigma + bottom,
                        out.inverse_depth + at, width, chance, out.depth_sigma + at);
    }
}

struct Plane {
    float by_u, by_v, mean;
};

// Least-squares plane of the values in a square window; false where the window leaves the image, or holds an unknown value
// or a step.
template <int REACH>
ALWAYS_INLINE inline bool fit_plane(const LevelImages& level, int row, int column, Plane& plane) {
    constexpr int SIDE = 2 * REACH + 1;
    if (row < REACH || column < REACH || row >= level.height - REACH || column >= level.width - REACH) return false;
    const float* const center = level.inverse_depth + static_cast<size_t>(row) * static_cast<size_t>(level.width) + column;
    float lowest = *center, highest = *center, columns[SIDE] = {}, rows[SIDE] = {};
    for (int i = -REACH; i <= REACH; i++)
        for (int j = -REACH; j <= REACH; j++) {
            const float value = center[static_cast<std::ptrdiff_t>(i) * level.width + j];
            lowest = value < lowest ? value : lowest;
            highest = value > highest ? value : highest;
            columns[j + REACH] += value;
            rows[i + REACH] += value;
        }
    if (!(lowest > 0.0f) || !(highest - lowest < SAME_SURFACE * (0.5f * SIDE) * *center)) return false;
    float by_u = 0.0f, by_v = 0.0f, total = 0.0f, squares = 0.0f;
    for (int k = -REACH; k <= REACH; k++) {
        by_u += static_cast<float>(k) * columns[k + REACH];
        by_v += static_cast<float>(k) * rows[k + REACH];
        total += rows[k + REACH];
        squares += static_cast<float>(k * k);
    }
    plane = {by_u / (squares * SIDE), by_v / (squares * SIDE), total / (SIDE * SIDE)};
    return true;
}

// Normals at the pixels of a grid, zero where unknown: of the window of 5 pixels, or of 3 where that holds an edge or a hole.
static void surface_normals(const LevelImages& level, const NormalPixels& grid, float* normals) {
    for (size_t i = 0; i < grid.rows; i++)
        for (size_t j = 0; j < grid.columns; j++) {
            const int row = grid.of_row[i], column = grid.of_column[j];
            float* const out = normals + 3 * (i * grid.columns + j);
            Plane plane;
            if (!fit_plane<2>(level, row, column, plane) && !fit_plane<1>(level, row, column, plane)) {
                out[0] = out[1] = out[2] = 0.0f;
                continue;
            }
            const float x = (static_cast<float>(column) - grid.cx) / grid.fx, y = (static_cast<float>(row) - grid.cy) / grid.fy;
            const float nx = plane.by_u * grid.fx, ny = plane.by_v * grid.fy, nz = plane.mean - nx * x - ny * y;
            const float length = __builtin_sqrtf(nx * nx + ny * ny + nz * nz);
            out[0] = -nx / length, out[1] = -ny / length, out[2] = -nz / length;
        }
}

}  // namespace KERNEL_ISA
