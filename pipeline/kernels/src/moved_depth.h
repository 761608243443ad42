// Which point of a depth image projects to each pixel of the camera from another place (kernels.moved_depth_definition, the same bits:
// every operation is one of float, in its order, none fused).
#pragma once

#include "image_pyramid.h"
#include "registration_data.h"
#include "registration_samples.h"

namespace KERNEL_ISA {

using namespace raster;

constexpr float FARTHEST_PIXEL = 1e5f;    // of a projection: beyond is outside of every image
constexpr float NEAREST_PLANE_M = 1e-3f;  // nearer points are projected as if they were there

// Of the pixels that are looked up together: rays (x, y, 1), inverse depth, and where in the depth image it is looked up.
struct SearchBatch {
    alignas(64) float x[BATCH], y[BATCH], found[BATCH], u[BATCH], v[BATCH], there[BATCH], off[BATCH];
};

// Pixels (1) whose right, lower and lower right neighbors are on their surface.
static void smooth_pixels(const MovedDepth& of, uint8_t* smooth) {
    const size_t width = static_cast<size_t>(of.width), height = static_cast<size_t>(of.height);
    std::memset(smooth, 0, width * height);
    const float share = 1.0f + of.same_surface;
    for (size_t row = 0; row + 1 < height; row++) {
        const float *const top = of.inverse_depth + row * width, *const bottom = top + width;
        uint8_t* const out = smooth + row * width;
        for (size_t i = 0; i + 1 < width; i++) {
            const float least = smaller(smaller(top[i], top[i + 1]), smaller(bottom[i], bottom[i + 1]));
            const float most = larger(larger(top[i], top[i + 1]), larger(bottom[i], bottom[i + 1]));
            out[i] = static_cast<uint8_t>((least > 0.0f) & (most <= share * least));
        }
    }
}

ALWAYS_INLINE inline float limited(float pixel) { return pixel < -FARTHEST_PIXEL ? -FARTHEST_PIXEL : (pixel > FARTHEST_PIXEL ? FARTHEST_PIXEL : pixel); }

// Pixels of the depth image that the points project to.
NO_INLINE static void project_points(const MovedDepth& of, int count, SearchBatch* __restrict b) {
    const float(&T)[12] = of.T_depth_color;
    const float rows[3][4] = {{T[0], T[1], T[2], T[3]}, {T[4], T[5], T[6], T[7]}, {T[8], T[9], T[10], T[11]}};
    const float fx = of.fx, fy = of.fy, cx = of.cx, cy = of.cy;
    for (int i = 0; i < count; i++) {
        const float depth = 1.0f / b->found[i], x = b->x[i] / b->found[i], y = b->y[i] / b->found[i];
        const float qx = rotated(rows[0], x, y, depth) + rows[0][3];
        const float qy = rotated(rows[1], x, y, depth) + rows[1][3];
        const float qz = rotated(rows[2], x, y, depth) + rows[2][3];
        const float front = qz > NEAREST_PLANE_M ? qz : NEAREST_PLANE_M;
        b->u[i] = limited(fx * qx / front + cx), b->v[i] = limited(fy * qy / front + cy);
    }
}

// Inverse depth there: interpolated within a surface, else that of the nearest pixel; 0 where unknown.
static void look_up(const MovedDepth& of, const uint8_t* smooth, int count, SearchBatch& b) {
    const std::ptrdiff_t width = of.width;
    const float right = static_cast<float>(of.width), bottom = static_cast<float>(of.height);
    for (int i = 0; i < count; i++) {
        const float u = b.u[i], v = b.v[i];
        float there = 0.0f;
        const bool inside = (u >= 0.0f) & (u < right) & (v >= 0.0f) & (v < bottom);
        const std::ptrdiff_t corner = inside ? static_cast<int32_t>(v) * width + static_cast<int32_t>(u) : 0;
        if (inside && smooth[corner]) {
            const float* const p = of.inverse_depth + corner;
            there = bilinear(fraction(u), fraction(v), p[0], p[1], p[width], p[width + 1]);
        } else {
            const float nu = u + 0.5f, nv = v + 0.5f;
            if ((nu >= 0.0f) & (nu < right) & (nv >= 0.0f) & (nv < bottom))
                there = of.inverse_depth[static_cast<int32_t>(nv) * width + static_cast<int32_t>(nu)];
        }
        b.there[i] = there;
    }
}

// Takes the points back: their inverse depth, and how far from their pixel they are, squared, in pixels.
NO_INLINE static void take_back(const MovedDepth& of, int count, SearchBatch* __restrict b) {
    const float(&T)[12] = of.T_color_depth;
    const float rows[3][4] = {{T[0], T[1], T[2], T[3]}, {T[4], T[5], T[6], T[7]}, {T[8], T[9], T[10], T[11]}};
    const float fx = of.fx, fy = of.fy, cx = of.cx, cy = of.cy;
    for (int i = 0; i < count; i++) {
        const bool seen = b->there[i] > 0.0f;
        const float depth = 1.0f / (seen ? b->there[i] : 1.0f);
        const float x = ray(b->u[i], cx, fx) * depth, y = ray(b->v[i], cy, fy) * depth;
        const float qx = rotated(rows[0], x, y, depth) + rows[0][3];
        const float qy = rotated(rows[1], x, y, depth) + rows[1][3];
        const float qz = rotated(rows[2], x, y, depth) + rows[2][3];
        const bool front = seen & (qz > NEAREST_FRONT_M);
        const float z = front ? qz : 1.0f;
        const float off_u = (qx / z - b->x[i]) * fx, off_v = (qy / z - b->y[i]) * fy;
        const float off = off_u * off_u + off_v * off_v, inverse = 1.0f / z;
        b->off[i] = front ? off : __FLT_MAX__;
        b->found[i] = front ? inverse : b->found[i];
    }
}

static void search(const MovedDepth& of, const uint8_t* smooth, int count, SearchBatch& b) {
    for (int round = 0; round < of.rounds; round++) {
        project_points(of, count, &b);
        look_up(of, smooth, count, b);
        take_back(of, count, &b);
    }
    for (int i = 0; i < count; i++) b.found[i] = b.off[i] < of.most_off_px2 ? b.found[i] : 0.0f;
}

static void move_depth(const MovedDepth& of, Scratch<uint8_t>& memory, float* found, float* columns, float* rows) {
    const size_t width = static_cast<size_t>(of.width), height = static_cast<size_t>(of.height);
    uint8_t* const smooth = memory.need(width * height);
    smooth_pixels(of, smooth);
    SearchBatch b, again;
    int missing[BATCH];
    for (size_t row = 0; row < height; row++)
        for (size_t begin = 0; begin < width; begin += BATCH) {
            const int count = static_cast<int>(width - begin < BATCH ? width - begin : BATCH);
            const size_t at = row * width + begin;
            for (int i = 0; i < count; i++) {
                b.x[i] = of.ray_x[begin + static_cast<size_t>(i)], b.y[i] = of.ray_y[row];
                const float nearest = of.nearest[at + static_cast<size_t>(i)];
                b.found[i] = nearest > 0.0f ? nearest : of.middle;
            }
            search(of, smooth, count, b);
            int others = 0;
            for (int i = 0; i < count; i++) {
                const float nearest = of.nearest[at + static_cast<size_t>(i)], known = of.inverse_depth[at + static_cast<size_t>(i)];
                const float before = nearest > 0.0f ? nearest : of.middle, start = known > 0.0f ? known : of.middle;
                missing[others] = i;
                again.x[others] = b.x[i], again.y[others] = b.y[i], again.found[others] = start;
                others += (b.found[i] == 0.0f) & (start != before) ? 1 : 0;  // from the same start nothing else is found
            }
            search(of, smooth, others, again);
            for (int k = 0; k < others; k++) b.found[missing[k]] = again.found[k], b.u[missing[k]] = again.u[k], b.v[missing[k]] = again.v[k];
            const size_t bytes = sizeof(float) * static_cast<size_t>(count);
            std::memcpy(found + at, b.found, bytes), std::memcpy(columns + at, b.u, bytes), std::memcpy(rows + at, b.v, bytes);
        }
}

}  // namespace KERNEL_ISA
