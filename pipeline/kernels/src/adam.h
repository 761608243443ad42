// One step of Adam (splat.optimizer.Adam, the same bits), in place: every element goes its own way.
#pragma once

#include "frame.h"
#include "simd.h"

namespace KERNEL_ISA {

using namespace raster;

constexpr size_t ADAM_ROWS = 16;  // Gaussians at a time: often none of so few was touched
constexpr size_t ADAM_SPAN = 256;  // rows out of which those that were touched are taken

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

// Counts the step of a Gaussian that the view touched; its bias correction, or 0 if it was not touched.
inline float count_step(const AdamStep& step, size_t row) {
    const size_t at = step.row(row);
    const float* color = step.d_colors + 3 * row;
    const uint32_t gradient = magnitude(step.d_opacity_logits + row) | magnitude(color) | magnitude(color + 1) | magnitude(color + 2);
    if (gradient == 0 || (step.chosen && !step.chosen[at])) return 0.0f;
    int32_t& count = step.steps[at];
    count += count < step.longest;
    return step.corrections[count - 1];
}

// The same of some Gaussians; whether any was touched.
inline bool count_steps(const AdamStep& step, size_t begin, size_t end, float* correction) {
    if (untouched(step, begin, end)) return false;
    bool any = false;
    for (size_t row = begin; row < end; row++) {
        correction[row - begin] = count_step(step, row);
        any |= correction[row - begin] != 0.0f;
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
inline void step_array(const AdamArray& array, const AdamConstants& constants, size_t begin, size_t end, const float* correction) {
    float of_element[ADAM_ROWS * WIDTH], out[ADAM_ROWS * WIDTH];
    for (size_t row = 0; row < end - begin; row++)
        for (size_t k = 0; k < WIDTH; k++) of_element[row * WIDTH + k] = correction[row];
    const size_t start = begin * WIDTH, count = (end - begin) * WIDTH;
    step_elements(count, constants, array.rate, of_element, array.values + start, array.gradients + start, array.first + start,
                  array.second + start, out);
    __builtin_memcpy(array.values + start, out, count * sizeof(float));
}

// A step of Gaussians that follow each other.
inline void step_all(const AdamStep& step, size_t begin, size_t end) {
    float correction[ADAM_ROWS], of_size[ADAM_ROWS];
    if (!count_steps(step, begin, end, correction)) return;
    for (size_t row = begin; row < end; row++)  // before log-scales change
        of_size[row - begin] = correction[row - begin] * size_of(step.log_scales + 3 * row);
    for (const AdamArray& array : step.arrays) {
        const float* factors = array.of_size ? of_size : correction;
        if (array.width == 1)
            step_array<1>(array, step.constants, begin, end, factors);
        else if (array.width == 3)
            step_array<3>(array, step.constants, begin, end, factors);
        else
            step_array<4>(array, step.constants, begin, end, factors);
    }
}

// Gaussians of some rows that the view touched: about one in four.
struct TouchedRows {
    size_t count = 0;
    size_t row[ADAM_ROWS], at[ADAM_ROWS];  // where its gradients are, and where it is
    float correction[ADAM_ROWS];
};

template <size_t WIDTH>
inline void step_touched(const AdamArray& array, const AdamConstants& constants, const TouchedRows& touched, const float* correction) {
    constexpr size_t MOST = ADAM_ROWS * WIDTH;
    float of_element[MOST], values[MOST], gradients[MOST], first[MOST], second[MOST], out[MOST];
    for (size_t i = 0; i < touched.count; i++) {
        const size_t from = touched.at[i] * WIDTH, row = touched.row[i] * WIDTH, to = i * WIDTH;
        for (size_t k = 0; k < WIDTH; k++) {
            of_element[to + k] = correction[i];
            values[to + k] = array.values[from + k], gradients[to + k] = array.gradients[row + k];
            first[to + k] = array.first[from + k], second[to + k] = array.second[from + k];
        }
    }
    step_elements(touched.count * WIDTH, constants, array.rate, of_element, values, gradients, first, second, out);
    for (size_t i = 0; i < touched.count; i++) {
        const size_t to = touched.at[i] * WIDTH, from = i * WIDTH;
        for (size_t k = 0; k < WIDTH; k++) {
            array.values[to + k] = out[from + k];
            array.first[to + k] = first[from + k], array.second[to + k] = second[from + k];
        }
    }
}

inline void step_touched(const AdamStep& step, const TouchedRows& touched) {
    float of_size[ADAM_ROWS];
    for (size_t i = 0; i < touched.count; i++)  // before log-scales change
        of_size[i] = touched.correction[i] * size_of(step.log_scales + 3 * touched.at[i]);
    for (const AdamArray& array : step.arrays) {
        const float* factors = array.of_size ? of_size : touched.correction;
        if (array.width == 1)
            step_touched<1>(array, step.constants, touched, factors);
        else if (array.width == 3)
            step_touched<3>(array, step.constants, touched, factors);
        else
            step_touched<4>(array, step.constants, touched, factors);
    }
}

// A step of the Gaussians of some rows.
inline void step_rows(const AdamStep& step, size_t begin, size_t end) {
    TouchedRows touched;
    for (size_t row = begin; row < end; row++) {
        const float correction = count_step(step, row);
        if (correction == 0.0f) continue;
        touched.row[touched.count] = row, touched.at[touched.count] = step.row(row), touched.correction[touched.count] = correction;
        if (++touched.count < ADAM_ROWS) continue;
        step_touched(step, touched);
        touched.count = 0;
    }
    if (touched.count) step_touched(step, touched);
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
    const size_t rows = step.rows ? ADAM_SPAN : ADAM_ROWS;
    const int groups = static_cast<int>((step.count + rows - 1) / rows);
#pragma omp parallel for schedule(static) num_threads(threads) if (threads > 1)
    for (int group = 0; group < groups; group++) {
        const size_t begin = static_cast<size_t>(group) * rows;
        const size_t end = begin + rows < step.count ? begin + rows : step.count;
        if (step.rows)
            step_rows(step, begin, end);
        else
            step_all(step, begin, end);
        limit(step, limits, begin, end);
    }
}

}  // namespace KERNEL_ISA
