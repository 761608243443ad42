// What SSIM says of windows of 11x11 pixels (kernels.window_terms_definition, the same bits: every operation is one of float, in its order,
// none fused; sums are of sixteen lanes of double).
#pragma once

#include "image_pyramid.h"
#include "registration_data.h"

namespace KERNEL_ISA {

using namespace raster;

constexpr int WINDOW_PX = 11, WINDOW_HALF = WINDOW_PX / 2;
constexpr size_t STRIP = 512;  // values of a row at a time: what is computed of them stays in the cache
constexpr float SSIM_C1 = 0.0001f, SSIM_C2 = 0.0009f;

// Of eleven values, from the middle outward.
ALWAYS_INLINE inline float window_mean(const float* const (&in)[WINDOW_PX], const float* weights, size_t j) {
    float sum = weights[WINDOW_HALF] * in[WINDOW_HALF][j];
    unrolled<WINDOW_HALF>([&](auto k) ALWAYS_INLINE {
        constexpr int FROM_MIDDLE = k + 1;
        sum += weights[WINDOW_HALF - FROM_MIDDLE] * (in[WINDOW_HALF - FROM_MIDDLE][j] + in[WINDOW_HALF + FROM_MIDDLE][j]);
    });
    return sum;
}

NO_INLINE static void mean_of_eleven(const float* const (&from)[WINDOW_PX], const float* __restrict weights, size_t count,
                                     float* __restrict mean) {
    const float* const in[WINDOW_PX] = {from[0], from[1], from[2], from[3], from[4], from[5], from[6], from[7], from[8], from[9], from[10]};
    for (size_t j = 0; j < count; j++) mean[j] = window_mean(in, weights, j);
}

static void mean_along(const float* row, size_t step, const float* weights, size_t count, float* mean) {
    const float* from[WINDOW_PX];
    for (size_t k = 0; k < WINDOW_PX; k++) from[k] = row + k * step;
    mean_of_eleven(from, weights, count, mean);
}

NO_INLINE static void multiply(const float* __restrict a, const float* __restrict b, size_t count, float* __restrict product) {
    for (size_t j = 0; j < count; j++) product[j] = a[j] * b[j];
}

// Means of windows of IMAGES rows at a time: the last eleven rows of means along them are kept.
template <int IMAGES>
class MeanRows {
public:
    static constexpr size_t MEMORY = STRIP * IMAGES * WINDOW_PX;
    MeanRows(float* memory, const float* weights, size_t step) : memory_(memory), weights_(weights), step_(step) {}

    void add(size_t row, int image, const float* values, size_t count) { mean_along(values, step_, weights_, count, at(row, image)); }
    // Of the windows whose first row is given.
    void means(size_t top, int image, size_t count, float* out) const {
        const float* from[WINDOW_PX];
        for (size_t k = 0; k < WINDOW_PX; k++) from[k] = at(top + k, image);
        mean_of_eleven(from, weights_, count, out);
    }

private:
    float* at(size_t row, int image) const {
        return memory_ + (row % WINDOW_PX * IMAGES + static_cast<size_t>(image)) * STRIP;
    }
    float* memory_;
    const float* weights_;
    size_t step_;
};

static void window_means(const ImageWindows& of, Scratch<float>& memory, float* means) {
    const size_t margin = WINDOW_PX - 1, windows = (of.width - margin) * of.channels;
    MeanRows<1> rows(memory.need(MeanRows<1>::MEMORY), of.weights, of.channels);
    for (size_t left = 0; left < windows; left += STRIP) {
        const size_t count = windows - left < STRIP ? windows - left : STRIP;
        for (size_t row = 0; row < of.height; row++) {
            rows.add(row, 0, of.image + row * of.width * of.channels + left, count);
            if (row >= margin) rows.means(row - margin, 0, count, means + (row - margin) * windows + left);
        }
    }
}

NO_INLINE static void terms_of_row(const float* __restrict drawn_mean, const float* __restrict drawn_squares, const float* __restrict products,
                                   const float* __restrict seen_mean, const float* __restrict variance, size_t count,
                                   float* __restrict structure, float* __restrict similarity) {
    for (size_t j = 0; j < count; j++) {
        const float squared = drawn_mean[j] * drawn_mean[j], product = drawn_mean[j] * seen_mean[j];
        const float below = drawn_squares[j] - squared + variance[j] + SSIM_C2, above = 2.0f * (products[j] - product) + SSIM_C2;
        structure[j] = above / below;
        similarity[j] = (2.0f * product + SSIM_C1) / (squared + seen_mean[j] * seen_mean[j] + SSIM_C1) * structure[j];
    }
}

NO_INLINE static void add_lanes(const float* __restrict values, size_t count, double* __restrict lanes) {
    size_t j = 0;
    for (; j + LANES <= count; j += LANES)
        for (size_t k = 0; k < LANES; k++) lanes[k] += static_cast<double>(values[j + k]);
    for (size_t k = 0; j + k < count; k++) lanes[k] += static_cast<double>(values[j + k]);
}

static void window_terms(const ComparedWindows& of, Scratch<float>& memory, double* sums) {
    enum { MEAN, SQUARES, PRODUCTS, IMAGES };
    const size_t margin = WINDOW_PX - 1, step = of.drawn.channels, width = of.drawn.width * step, windows = width - margin * step;
    float* const kept = memory.need(MeanRows<IMAGES>::MEMORY + 6 * STRIP + margin * step);
    float *const structure = kept + MeanRows<IMAGES>::MEMORY, *const similarity = structure + STRIP, *const product = similarity + STRIP;
    float* const means[IMAGES] = {product + STRIP + margin * step, product + 2 * STRIP + margin * step, product + 3 * STRIP + margin * step};
    MeanRows<IMAGES> rows(kept, of.drawn.weights, step);
    double lanes[2][LANES] = {};
    for (size_t left = 0; left < windows; left += STRIP) {
        const size_t count = windows - left < STRIP ? windows - left : STRIP;
        for (size_t row = 0; row < of.drawn.height; row++) {
            const float *const drawn = of.drawn.image + row * width + left, *const seen = of.seen + row * width + left;
            rows.add(row, MEAN, drawn, count);
            multiply(drawn, drawn, count + margin * step, product);
            rows.add(row, SQUARES, product, count);
            multiply(drawn, seen, count + margin * step, product);
            rows.add(row, PRODUCTS, product, count);
            if (row < margin) continue;
            const size_t at = (row - margin) * windows + left;
            for (int image = 0; image < IMAGES; image++) rows.means(row - margin, image, count, means[image]);
            terms_of_row(means[MEAN], means[SQUARES], means[PRODUCTS], of.mean + at, of.variance + at, count, structure, similarity);
            if (of.weight) {
                multiply(structure, of.weight + at, count, means[MEAN]);
                multiply(similarity, of.weight + at, count, means[SQUARES]);
            }
            add_lanes(of.weight ? means[MEAN] : structure, count, lanes[0]);
            add_lanes(of.weight ? means[SQUARES] : similarity, count, lanes[1]);
        }
    }
    for (int k = 0; k < 2; k++) {
        sums[k] = 0.0;
        for (const double lane : lanes[k]) sums[k] += lane;
    }
}

}  // namespace KERNEL_ISA
