// All kernels of one instruction set. Compiled once per set, with KERNEL_ISA the namespace of the build.
#include "adam.h"
#include "drawing.h"
#include "fitting.h"
#include "full_information.h"
#include "machine_peak.h"
#include "opacity.h"

namespace KERNEL_ISA {

// Calls call(kind) with the view's kind of depth as a constant.
template <class Call>
static Status by_depth_kind(const Frame& frame, Call call) {
    if (frame.view.depth == DepthKind::ray_plane) return call(std::integral_constant<DepthKind, DepthKind::ray_plane>{});
    return call(std::integral_constant<DepthKind, DepthKind::blended>{});
}

static Status forward(Frame& frame, const GaussianArrays& gaussians, const Images& images) {
    const Status status = make_lists(frame, gaussians);
    if (status != Status::ok) return status;
    if (images.layer) frame.front.need((frame.longest_list + 1) * LANES * 2 * frame.threads);
    return by_depth_kind(frame, [&](auto kind) {
        constexpr DepthKind KIND = kind;
        const int tiles = frame.tiles_x * frame.tiles_y;
        const auto draw = images.layer ? draw_tile<KIND, true> : draw_tile<KIND, false>;
#pragma omp parallel for schedule(dynamic, 4) num_threads(frame.threads) if (frame.threads > 1)
        for (int tile = 0; tile < tiles; tile++) draw(frame, tile, images);
        return Status::ok;
    });
}

// Runs a kernel over all tiles; reports the complaint about the first image before the second, whatever ran first.
template <class TileKernel>
static Status over_tiles(Frame& frame, TileKernel kernel) {
    const int tiles = frame.tiles_x * frame.tiles_y;
    int bad1 = 0, bad2 = 0, bad3 = 0;
#pragma omp parallel for schedule(dynamic, 4) num_threads(frame.threads) reduction(| : bad1, bad2, bad3) \
    if (frame.threads > 1)
    for (int tile = 0; tile < tiles; tile++) {
        const Status status = kernel(tile);
        bad1 |= status == Status::bad_first_image;
        bad2 |= status == Status::bad_second_image;
        bad3 |= status == Status::bad_third_image;
    }
    return bad1 ? Status::bad_first_image : bad2 ? Status::bad_second_image : bad3 ? Status::bad_third_image : Status::ok;
}

template <Derivatives D>
static Status backward(Frame& frame, const GaussianArrays& gaussians, const float* d_color, const float* d_depth,
                       const float* d_alpha, const GradientArrays& out) {
    return by_depth_kind(frame, [&](auto kind) {
        constexpr DepthKind KIND = kind;
        prepare_rows<ROW_OF<D, KIND>>(frame);
        const Status status = over_tiles(frame, [&](int tile) { return gradient_tile<D, KIND>(frame, tile, d_color, d_depth, d_alpha); });
        if (status == Status::ok) gradients_of_parameters<D, KIND>(frame, gaussians, out);
        return status;
    });
}
static Status backward(Frame& frame, const GaussianArrays& gaussians, const float* d_color, const float* d_depth,
                       const float* d_alpha, const GradientArrays& out) {
    const auto of = !out.means             ? backward<Derivatives::POSE>
                    : !out.fisher_diagonal ? backward<Derivatives::ALL>
                                           : backward<Derivatives::ALL_AND_SQUARES>;
    return of(frame, gaussians, d_color, d_depth, d_alpha, out);
}

static Status fisher(Frame& frame, const GaussianArrays& gaussians, const float* inv_var_color, const float* inv_var_depth,
                     const float* residual, const FisherArrays& out) {
    return by_depth_kind(frame, [&](auto kind) {
        constexpr DepthKind KIND = kind;
        prepare_rows<INFORMATION_ROW>(frame);
        const Status status =
            over_tiles(frame, [&](int tile) { return information_tile<KIND>(frame, tile, inv_var_color, inv_var_depth, residual); });
        if (status != Status::ok) return status;
        const int groups = static_cast<int>(group_count(frame));
#pragma omp parallel for schedule(dynamic, 16) num_threads(frame.threads) if (frame.threads > 1)
        for (int group = 0; group < groups; group++) information_group<KIND>(frame, gaussians, group, out);
        return status;
    });
}

static Status opacity_information(Frame& frame, const GaussianArrays& gaussians, const float* inv_var_color, const float* inv_var_depth,
                                  double* information, uint32_t* observations) {
    return by_depth_kind(frame, [&](auto kind) {
        constexpr DepthKind KIND = kind;
        prepare_rows<OPACITY_ROW>(frame);
        const Status status = over_tiles(frame, [&](int tile) { return opacity_tile<KIND>(frame, tile, inv_var_color, inv_var_depth); });
        if (status != Status::ok) return status;
        const int groups = static_cast<int>(group_count(frame));
#pragma omp parallel for schedule(static) num_threads(frame.threads) if (frame.threads > 1)
        for (int group = 0; group < groups; group++) opacity_group(frame, gaussians, group, information, observations);
        return status;
    });
}

// All cross terms, for validation: both kinds of depth take the same sums.
static Status full_fisher(Frame& frame, const GaussianArrays& gaussians, const float* inv_var_color, const float* inv_var_depth,
                          double* information) {
    return by_depth_kind(frame, [&](auto kind) {
        constexpr DepthKind KIND = kind;
        prepare_rows<FULL_ROW>(frame);
        const Status status = over_tiles(frame, [&](int tile) { return full_tile<KIND>(frame, tile, inv_var_color, inv_var_depth); });
        if (status != Status::ok) return status;
        const int groups = static_cast<int>(group_count(frame));
#pragma omp parallel for schedule(dynamic, 4) num_threads(frame.threads) if (frame.threads > 1)
        for (int group = 0; group < groups; group++) full_group<KIND>(frame, gaussians, group, information);
        return status;
    });
}

static void contributions(Frame& frame, float* weights, uint32_t* pixels) {
    prepare_rows<GRADIENT_ROW>(frame);
    over_tiles(frame, [&](int tile) {
        contribution_tile(frame, tile);
        return Status::ok;
    });
    const float* rows = frame.rows.data();
    for (size_t i = 0; i < frame.visible; i++) {
        float weight = 0.0f;
        uint32_t count = 0;
        for (uint32_t row = frame.first_row.data()[i]; row < frame.first_row.data()[i + 1]; row++) {
            weight += rows[static_cast<size_t>(row) * GRADIENT_ROW];
            count += static_cast<uint32_t>(rows[static_cast<size_t>(row) * GRADIENT_ROW + 1]);
        }
        weights[frame.visible_ids.data()[i]] = weight;
        pixels[frame.visible_ids.data()[i]] = count;
    }
}

template <Derivatives D>
static Status fit(Frame& frame, const GaussianArrays& gaussians, const Loss& loss, LossValues& values, const GradientArrays& out) {
    Status status = make_lists(frame, gaussians);
    if (status != Status::ok) return status;
    const int tiles = frame.tiles_x * frame.tiles_y;
    frame.front.need((frame.longest_list + 1) * LANES * 2 * frame.threads);
    const double* parts = frame.loss_parts.need(static_cast<size_t>(tiles) * LOSS_SUMS);
    const LossScales scales(PixelCounts(frame.view, loss.depth_m));
    status = by_depth_kind(frame, [&](auto kind) {
        constexpr DepthKind KIND = kind;
        if constexpr (D != Derivatives::NONE) prepare_rows<ROW_OF<D, KIND>>(frame);
        const Status of_tiles = over_tiles(frame, [&](int tile) { return fit_tile<D, KIND>(frame, tile, loss, scales); });
        if constexpr (D != Derivatives::NONE)
            if (of_tiles == Status::ok) gradients_of_parameters<D, KIND>(frame, gaussians, out);
        return of_tiles;
    });
    if (status != Status::ok) return status;
    double total[LOSS_SUMS] = {};
    for (int tile = 0; tile < tiles; tile++)
        for (int k = 0; k < LOSS_SUMS; k++) total[k] += parts[static_cast<size_t>(tile) * LOSS_SUMS + k];
    values = {total[0] * scales.per_color, total[1] * scales.per_depth, total[2] * scales.per_depth,
              total[3] * scales.per_color * loss.gain, total[4] * scales.per_color, total[5] * scales.per_depth};
    return Status::ok;
}
static Status fit(Frame& frame, const GaussianArrays& gaussians, const Loss& loss, LossValues& values, const GradientArrays& out) {
    const auto of = out.means ? fit<Derivatives::ALL> : out.pose ? fit<Derivatives::POSE> : fit<Derivatives::NONE>;
    return of(frame, gaussians, loss, values, out);
}

}  // namespace KERNEL_ISA

#define AS_TEXT_(name) #name
#define AS_TEXT(name) AS_TEXT_(name)

namespace raster {
extern const RegistrationKernels REGISTRATION_TABLE;
extern const Kernels KERNEL_TABLE;
const Kernels KERNEL_TABLE = {AS_TEXT(KERNEL_ISA), &REGISTRATION_TABLE, KERNEL_ISA::forward, KERNEL_ISA::backward, KERNEL_ISA::fisher,
                              KERNEL_ISA::opacity_information, KERNEL_ISA::contributions, KERNEL_ISA::full_fisher, KERNEL_ISA::fit, KERNEL_ISA::adam,
                              KERNEL_ISA::fma_rate, KERNEL_ISA::bandwidth};
}  // namespace raster
