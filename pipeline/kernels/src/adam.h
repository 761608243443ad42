// One step of Adam (splat.optimizer.Adam, the same bits), in place: every element goes its own way.
#pragma once

#include "frame.h"
#include "simd.h"

namespace KERNEL_ISA {

using namespace raster;

constexpr size_t ADAM_ROWS = 16;  // Gaussians at a time: often none of so few was touched

// The bits of a number but its sign: zero for zeros of both signs alone.
inline uint32_t magnitude(const float* value) {
    uint32_t bits;
    __builtin_memcpy(&bits, value, sizeof bits);
    return bits << 1;
}

// Whether the view touched none of some Gaussians; most views touch few.
inline bool untouched(const AdamStep& step, size_t begin, size_t end) {
    uint32_t any = 0;
    for (size_t i = begin; i < end; i++) any |= magnitude(step.d_opacity_logits + i);
    for (size_t i = 3 * begin; i < 3 * end; i++) any |= magnitude(step.d_colors + i);
    return any == 0;
}

// Counts the step of every Gaussian that the view touched; its bias correction, or 0 if it was not touched.
inline bool count_steps(const AdamStep& step, size_t begin, size_t end, float* correction) {
    if (untouched(step, begin, end)) return false;
    bool any = false;
    for (size_t row = begin; row < end; row++) {
        const float* color = step.d_colors + 3 * row;
        const size_t at = step.row(row);
        const uint32_t gradient = magnitude(step.d_opacity_logits + row) | magnitude(color) | magnitude(color + 1) | magnitude(color + 2);
        const bool touched = gradient != 0 && (!step.chosen || step.chosen[at]);
        int32_t& count = step.steps[at];
        count += touched && count < step.longest;
        correction[row - begin] = touched ? step.corrections[count - 1] : 0.0f;
        any |= touched;
    }
    return any;
}

// splat.optimizer.sizes of a Gaussian, the same bits.
inline float size_of(const float* log_scales) {
    const float a = log_scales[0], b = log_scales[1], c = log_scales[2];
    const float larger = a > b ? a : b, smaller = a > b ? b : a;
    const float octaves = (larger + (smaller > c ? smaller : c)) * 0.72134752f;
    float whole = __builtin_floorf(octaves);
    whole = whole < -60.0f ? -60.0f : whole > 60.0f ? 60.0f : whole;
    const uint32_t bits = static_cast<uint32_t>(static_cast<int32_t>(whole) + 127) << 23;
    float power;
    __builtin_memcpy(&power, &bits, sizeof power);
    return (1.0f + (octaves - whole)) * power;
}

// Corrections of parameters whose rate is a share of the Gaussian's size.
inline void times_sizes(const AdamStep& step, size_t begin, size_t end, const float* correction, float* of_size) {
    for (size_t row = begin; row < end; row++)
        of_size[row - begin] = correction[row - begin] * size_of(step.log_scales + 3 * step.row(row));
}

// Source: Kingma and Ba, ICLR 2015, algorithm 1. A function of its own, so that the compiler sees arrays that do not overlap
// and makes vectors of the loop.
NO_INLINE static void step_elements(size_t count, const AdamConstants& constants, float rate, const float* __restrict correction,
                                    const float* __restrict value, const float* __restrict gradient, float* __restrict first,
                                    float* __restrict second, float* __restrict out) {
    const AdamConstants c = constants;
    for (size_t i = 0; i < count; i++) {
        const float g = gradient[i];
        const float m = c.beta_1 * first[i] + c.rest_1 * g;
        const float v = c.beta_2 * second[i] + c.rest_2 * (g * g);
        const float change = m / (__builtin_sqrtf(v) + c.epsilon) * rate * correction[i];
        const bool touched = correction[i] != 0.0f;
        first[i] = touched ? m : first[i];
        second[i] = touched ? v : second[i];
        out[i] = touched ? value[i] - change : value[i];
    }
}

template <size_t WIDTH>
inline void step_all(const AdamArray& array, const AdamConstants& constants, size_t begin, size_t end, const float* correction) {
    float of_element[ADAM_ROWS * WIDTH], out[ADAM_ROWS * WIDTH];
    for (size_t row = 0; row < end - begin; row++)
        for (size_t k = 0; k < WIDTH; k++) of_element[row * WIDTH + k] = correction[row];
    const size_t start = begin * WIDTH, count = (end - begin) * WIDTH;
    step_elements(count, constants, array.rate, of_element, array.values + start, array.gradients + start, array.first + start,
                  array.second + start, out);
    __builtin_memcpy(array.values + start, out, count * sizeof(float));
}

template <size_t WIDTH>
inline void step_rows(const AdamArray& array, const AdamConstants& constants, const int64_t* rows, size_t begin, size_t end,
                      const float* correction) {
    constexpr size_t MOST = ADAM_ROWS * WIDTH;
    float of_element[MOST], values[MOST], first[MOST], second[MOST], out[MOST];
    for (size_t row = begin; row < end; row++) {
        const size_t from = static_cast<size_t>(rows[row]) * WIDTH, to = (row - begin) * WIDTH;
        for (size_t k = 0; k < WIDTH; k++) {
            of_element[to + k] = correction[row - begin];
            values[to + k] = array.values[from + k];
            first[to + k] = array.first[from + k], second[to + k] = array.second[from + k];
        }
    }
    step_elements((end - begin) * WIDTH, constants, array.rate, of_element, values, array.gradients + begin * WIDTH, first, second, out);
    for (size_t row = begin; row < end; row++) {
        const size_t to = static_cast<size_t>(rows[row]) * WIDTH, from = (row - begin) * WIDTH;
        for (size_t k = 0; k < WIDTH; k++) {
            array.values[to + k] = out[from + k];
            array.first[to + k] = first[from + k], array.second[to + k] = second[from + k];
        }
    }
}

template <size_t WIDTH>
inline void step_some(const AdamArray& array, const AdamConstants& constants, const int64_t* rows, size_t begin, size_t end,
                      const float* correction) {
    if (rows)
        step_rows<WIDTH>(array, constants, rows, begin, end, correction);
    else
        step_all<WIDTH>(array, constants, begin, end, correction);
}

inline float clipped(float value, float least, float greatest) {
    return value < least ? least : value > greatest ? greatest : value;
}

// Puts what is beyond the limits there; vectors where all Gaussians are meant.
inline void limit(const AdamStep& step, const AdamLimits& limits, size_t begin, size_t end) {
    const float greatest = limits.greatest, logit = limits.largest_logit;
    if (step.rows || step.chosen) {
        for (size_t row = begin; row < end; row++) {
            const size_t at = step.row(row);
            if (step.chosen && !step.chosen[at]) continue;
            float* scales = limits.log_scales + 3 * at;
            for (size_t k = 0; k < 3; k++)
                scales[k] = clipped(scales[k], limits.least_of_each ? limits.least[3 * at + k] : limits.least[0], greatest);
            limits.opacity_logits[at] = clipped(limits.opacity_logits[at], -logit, logit);
        }
        return;
    }
    float *scales = limits.log_scales, *logits = limits.opacity_logits;
    const float *least = limits.least, least_of_all = limits.least[0];
    if (limits.least_of_each)
        for (size_t i = 3 * begin; i < 3 * end; i++) scales[i] = clipped(scales[i], least[i], greatest);
    else
        for (size_t i = 3 * begin; i < 3 * end; i++) scales[i] = clipped(scales[i], least_of_all, greatest);
    for (size_t i = begin; i < end; i++) logits[i] = clipped(logits[i], -logit, logit);
}

// What has no row in `rows` or is not chosen stays as it is.
static void adam(const AdamStep& step, const AdamLimits& limits, int threads) {
    const int groups = static_cast<int>((step.count + ADAM_ROWS - 1) / ADAM_ROWS);
#pragma omp parallel for schedule(static) num_threads(threads) if (threads > 1)
    for (int group = 0; group < groups; group++) {
        const size_t begin = static_cast<size_t>(group) * ADAM_ROWS;
        const size_t end = begin + ADAM_ROWS < step.count ? begin + ADAM_ROWS : step.count;
        float correction[ADAM_ROWS], of_size[ADAM_ROWS];
        if (count_steps(step, begin, end, correction)) {
            times_sizes(step, begin, end, correction, of_size);  // before log-scales change
            for (const AdamArray& array : step.arrays) {
                const float* factors = array.of_size ? of_size : correction;
                if (array.width == 1)
                    step_some<1>(array, step.constants, step.rows, begin, end, factors);
                else if (array.width == 3)
                    step_some<3>(array, step.constants, step.rows, begin, end, factors);
                else
                    step_some<4>(array, step.constants, step.rows, begin, end, factors);
            }
        }
        limit(step, limits, begin, end);
    }
}

}  // namespace KERNEL_ISA
