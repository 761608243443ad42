// Where points are as a view saw it: in free space, on a surface, hidden (kernels.free_space_definition, the same bits: every operation is
// one of double, in its order, none fused).
#pragma once

#include "image_pyramid.h"
#include "registration_data.h"

namespace KERNEL_ISA {

using namespace raster;

// In the image of the view; else the point says nothing.
ALWAYS_INLINE inline bool is_inside(double pixel, int size) { return (pixel >= 0.0) & (pixel < static_cast<double>(size)); }

NO_INLINE static void free_space(const JudgedPoints& of, int8_t* __restrict where) {
    const double* const T = of.T_view_points;
    for (size_t i = 0; i < of.count; i++) {
        const double *const p = of.points + 3 * i, x = p[0], y = p[1], z = p[2];
        const double depth = T[8] * x + T[9] * y + T[10] * z + T[11];
        where[i] = PLACE_UNKNOWN;
        if (!(depth > of.near_m)) continue;
        const double u = __builtin_rint(of.camera.fx * (T[0] * x + T[1] * y + T[2] * z + T[3]) / depth + of.camera.cx);
        const double v = __builtin_rint(of.camera.fy * (T[4] * x + T[5] * y + T[6] * z + T[7]) / depth + of.camera.cy);
        if (!(is_inside(u, of.width) & is_inside(v, of.height))) continue;
        const float inverse = of.nearest[static_cast<size_t>(v) * static_cast<size_t>(of.width) + static_cast<size_t>(u)];
        if (!(inverse > 0.0f)) continue;
        const double known = static_cast<double>(inverse), seen = 1.0 / known, near_gate = of.near_gate * seen, gate_far = of.gate_relative * seen;
        const double gate_near = of.gate_m < near_gate ? of.gate_m : near_gate, gate = gate_near > gate_far ? gate_near : gate_far;
        const double least = 1.0 / (known + of.gate_inverse), most = known > of.gate_inverse ? 1.0 / (known - of.gate_inverse) : INFINITY;
        const double nearest = least < seen - gate ? least : seen - gate, farthest = most > seen + gate ? most : seen + gate;
        where[i] = depth < nearest ? PLACE_FREE : (depth > farthest ? PLACE_HIDDEN : PLACE_ON_SURFACE);
    }
}

}  // namespace KERNEL_ISA
