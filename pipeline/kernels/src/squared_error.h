// Squared errors of a drawn image in an exposure (kernels.squared_error_definition, the same bits: every operation is one of float, in its
// order, none fused; sums are of sixteen lanes of double).
#pragma once

#include "window_terms.h"

namespace KERNEL_ISA {

constexpr size_t COLORS = 3, PIXELS_AT_A_TIME = 256, VALUES_AT_A_TIME = COLORS * PIXELS_AT_A_TIME;

template <class T>
NO_INLINE static void each_three_times(const T* __restrict values, size_t count, float* __restrict out) {
    for (size_t i = 0; i < count; i++) out[3 * i] = out[3 * i + 1] = out[3 * i + 2] = static_cast<float>(values[i]);
}

NO_INLINE static void squares_of_row(const float* __restrict drawn, const float* __restrict alpha, const float* __restrict seen,
                                     const float* __restrict gain, const float* __restrict offset, size_t count, float* __restrict squares) {
    for (size_t j = 0; j < count; j++) {
        const float color = gain[j] * drawn[j] + offset[j] * alpha[j], bright = color > 0.0f ? color : 0.0f;
        const float error = (bright < 1.0f ? bright : 1.0f) - seen[j];
        squares[j] = error * error;
    }
}

static double squared_error(const ExposedImage& of, Scratch<float>& memory) {
    float *const gain = memory.need(5 * VALUES_AT_A_TIME), *const offset = gain + VALUES_AT_A_TIME, *const alpha = offset + VALUES_AT_A_TIME,
                *const counted = alpha + VALUES_AT_A_TIME, *const squares = counted + VALUES_AT_A_TIME;
    for (size_t j = 0; j < VALUES_AT_A_TIME; j++) gain[j] = of.gain[j % COLORS], offset[j] = of.offset[j % COLORS];
    double lanes[LANES] = {}, sum = 0.0;
    for (size_t row = 0; row < of.height; row++)
        for (size_t left = of.left; left < of.right; left += PIXELS_AT_A_TIME) {
            const size_t pixels = of.right - left < PIXELS_AT_A_TIME ? of.right - left : PIXELS_AT_A_TIME, at = row * of.width + left;
            each_three_times(of.alpha + at, pixels, alpha);
            squares_of_row(of.drawn + COLORS * at, alpha, of.seen + COLORS * at, gain, offset, COLORS * pixels, squares);
            if (of.mask) {
                each_three_times(of.mask + at, pixels, counted);
                multiply(squares, counted, COLORS * pixels, alpha);
            }
            add_lanes(of.mask ? alpha : squares, COLORS * pixels, lanes);
        }
    for (const double lane : lanes) sum += lane;
    return sum;
}

}  // namespace KERNEL_ISA
