// All kernels of one instruction set. Compiled once per set, with KERNEL_ISA the namespace of the build.
#include "parameters.h"

namespace KERNEL_ISA {

static Status forward(Frame& frame, const GaussianArrays& gaussians, float* color, float* depth, float* alpha) {
    if (!project_all(frame, gaussians)) return Status::bad_gaussians;
    const Status status = bin(frame);
    if (status != Status::ok) return status;
    const int tiles = frame.tiles_x * frame.tiles_y;
    frame.transmittance.need(static_cast<size_t>(tiles) * TILE_PIXELS);
    frame.stop.need(static_cast<size_t>(tiles) * TILE_PIXELS);
#pragma omp parallel for schedule(dynamic, 4) num_threads(frame.threads) if (frame.threads > 1)
    for (int tile = 0; tile < tiles; tile++) blend_tile(frame, tile, color, depth, alpha);
    return Status::ok;
}

template <Squares S>
struct Constant {
    static constexpr Squares value = S;
};

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

static Status backward(Frame& frame, const GaussianArrays& gaussians, const float* d_color, const float* d_depth,
                       const float* d_alpha, const GradientArrays& out) {
    frame.gradient_rows.need(frame.intersection_count * GRADIENT_SUMS);
    if (out.fisher_diagonal) {
        frame.information_rows16.need(frame.intersection_count * 16);
        if (d_depth) frame.information_rows8.need(frame.intersection_count * 8);
    }
    const auto run = [&](auto squares) {
        return over_tiles(frame, [&](int tile) {
            return gradient_tile<decltype(squares)::value>(frame, tile, d_color, d_depth, d_alpha);
        });
    };
    const Status status = !out.fisher_diagonal ? run(Constant<NO_SQUARES>())
                          : d_depth            ? run(Constant<COLOR_AND_DEPTH_SQUARES>())
                                               : run(Constant<COLOR_SQUARES>());
    if (status == Status::ok) gradients_of_parameters(frame, gaussians, d_depth != nullptr, out);
    return status;
}

static Status fisher(Frame& frame, const GaussianArrays& gaussians, const float* inv_var_color, const float* inv_var_depth,
                     const FisherArrays& out) {
    frame.information_rows16.need(frame.intersection_count * 16);
    frame.information_rows8.need(frame.intersection_count * 8);
    const Status status =
        over_tiles(frame, [&](int tile) { return information_tile(frame, tile, inv_var_color, inv_var_depth); });
    if (status != Status::ok) return status;
    const int groups = static_cast<int>(group_count(frame));
#pragma omp parallel for schedule(dynamic, 16) num_threads(frame.threads) if (frame.threads > 1)
    for (int group = 0; group < groups; group++) information_group(frame, gaussians, group, out);
    return status;
}

static void contributions(Frame& frame, float* weights, uint32_t* pixels) {
    frame.gradient_rows.need(frame.intersection_count * GRADIENT_SUMS);
    over_tiles(frame, [&](int tile) {
        contribution_tile(frame, tile);
        return Status::ok;
    });
    const float* rows = frame.gradient_rows.data();
    for (size_t i = 0; i < frame.visible; i++) {
        float weight = 0.0f;
        uint32_t count = 0;
        for (uint32_t row = frame.first_row.data()[i]; row < frame.first_row.data()[i + 1]; row++) {
            weight += rows[static_cast<size_t>(row) * GRADIENT_SUMS];
            count += static_cast<uint32_t>(rows[static_cast<size_t>(row) * GRADIENT_SUMS + 1]);
        }
        weights[frame.visible_ids.data()[i]] = weight;
        pixels[frame.visible_ids.data()[i]] = count;
    }
}

}  // namespace KERNEL_ISA

#define AS_TEXT_(name) #name
#define AS_TEXT(name) AS_TEXT_(name)

namespace raster {
extern const Kernels KERNEL_TABLE;
const Kernels KERNEL_TABLE = {AS_TEXT(KERNEL_ISA), KERNEL_ISA::forward, KERNEL_ISA::backward, KERNEL_ISA::fisher,
                              KERNEL_ISA::contributions};
}  // namespace raster
