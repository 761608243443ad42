// Every Gaussian as the camera sees it: what the loops over pixels need, what the lists of tiles need, and a key of
// depth for those that may be seen.
#pragma once

#include "projection.h"
#include "transpose.h"

namespace KERNEL_ISA {

inline int smaller(int a, int b) { return a < b ? a : b; }
inline int larger(int a, int b) { return a > b ? a : b; }

struct BlockOffsets {
    alignas(64) float x[LANES], y[LANES];
    constexpr BlockOffsets(int step) : x(), y() {
        for (int i = 0; i < LANES; i++) {
            x[i] = static_cast<float>(i % 4 * step);
            y[i] = static_cast<float>(i / 4 * step);
        }
    }
};
alignas(64) static constexpr BlockOffsets PIXEL_OF_BLOCK(1);  // lane -> pixel within its 4x4 block

// Column k of the rows `ids` of a row-major array, for all k < WIDTH.
template <int WIDTH>
inline void gather(const float* array, const uint32_t* ids, Vec* out) {
    alignas(64) float columns[WIDTH][LANES];
    for (int lane = 0; lane < LANES; lane++)
        for (int k = 0; k < WIDTH; k++) columns[k][lane] = array[static_cast<size_t>(ids[lane]) * WIDTH + k];
    for (int k = 0; k < WIDTH; k++) out[k] = load(columns[k]);
}

struct Parameters16 {
    Vec mean[3], quat[4], log_scale[3], logit;
};
inline Parameters16 load_parameters(const GaussianArrays& gaussians, size_t first) {
    Parameters16 p;
    load_rows3(gaussians.means + 3 * first, p.mean);
    load_rows4(gaussians.quats_wxyz + 4 * first, p.quat);
    load_rows3(gaussians.log_scales + 3 * first, p.log_scale);
    p.logit = load_unaligned(gaussians.opacity_logits + first);
    return p;
}
inline Parameters16 gather_parameters(const GaussianArrays& gaussians, const uint32_t* ids) {
    Parameters16 p;
    gather<3>(gaussians.means, ids, p.mean);
    gather<4>(gaussians.quats_wxyz, ids, p.quat);
    gather<3>(gaussians.log_scales, ids, p.log_scale);
    gather<1>(gaussians.opacity_logits, ids, &p.logit);
    return p;
}

// Sixteen neighbors in the caller's arrays; behind the last Gaussian, copies of the first of them.
struct Neighbors16 {
    Parameters16 p;
    Vec color[3];
    Neighbors16(const GaussianArrays& gaussians, size_t first) {
        if (first + LANES <= gaussians.count) {
            p = load_parameters(gaussians, first);
            load_rows3(gaussians.colors + 3 * first, color);
            return;
        }
        uint32_t ids[LANES];
        for (size_t lane = 0; lane < LANES; lane++)
            ids[lane] = static_cast<uint32_t>(first + lane < gaussians.count ? first + lane : first);
        p = gather_parameters(gaussians, ids);
        gather<3>(gaussians.colors, ids, color);
    }
};

constexpr float LARGEST_LOG_SCALE = 40.0f;  // of meters; the square of a scale beyond would overflow

// All numbers finite, all quaternions of a length whose square is neither 0 nor infinite.
inline bool usable(const Neighbors16& g) {
    const Vec zero(0.0f);
    Vec sum = g.p.logit * zero, norm2 = zero, largest = g.p.log_scale[0];
    for (int k = 0; k < 3; k++) {
        sum = sum + (g.p.mean[k] * zero + g.p.log_scale[k] * zero) + g.color[k] * zero;
        largest = max(g.p.log_scale[k], largest);
    }
    for (int k = 0; k < 4; k++) norm2 = fma(g.p.quat[k], g.p.quat[k], norm2);
    return bits((sum >= zero) & (norm2 >= Vec(1e-30f)) & (norm2 <= Vec(1e30f)) & (largest <= Vec(LARGEST_LOG_SCALE))) ==
           0xffffu;
}

// Some part of a box around the center may lie on the screen.
inline Mask on_screen(const View& view, Vec u, Vec v, Vec extent_x, Vec extent_y) {
    const Vec zero(0.0f);
    return (u + extent_x >= zero) & (u - extent_x <= Vec(view.width - 1.0f)) & (v + extent_y >= zero) &
           (v - extent_y <= Vec(view.height - 1.0f));
}

// At least e^x, at most 2.2 times that: without the mantissa.
inline Vec exp_bound(Vec x) {
    const Vec t = min(max(x * Vec(LOG2_E), Vec(-120.0f)), Vec(120.0f));
    return scale_by_power(Vec(1.5f), t + Vec(12582912.0f));
}

// False where a bound from center and largest scale alone keeps a Gaussian off the screen: most of a map lies elsewhere.
// |row of J| = f/z sqrt(1 + slope^2), so a variance is at most (s f/z)^2 (1 + limit^2) + blur, and alpha >= 1/255 reaches
// no further than sqrt(2 ln 255) = 3.33 standard deviations.
inline Mask may_be_seen(const View& view, const Parameters16& p) {
    const CameraPoint16 c(view, p.mean);
    const Vec largest = exp_bound(max(p.log_scale[0], max(p.log_scale[1], p.log_scale[2]))) * c.inverse_z;
    const auto bound = [&](float focal, float limit) {
        return fma(largest, Vec(3.34f * focal * __builtin_sqrtf(1.0f + limit * limit)), Vec(3.34f * 0.548f));
    };
    const Vec extent_x = bound(view.fx, slope_limit(view.width, view.fx, view.cx));
    const Vec extent_y = bound(view.fy, slope_limit(view.height, view.fy, view.cy));
    return (c.z >= Vec(NEAR_M)) & on_screen(view, c.u, c.v, extent_x, extent_y);
}

constexpr float ALPHA_SLACK = 1e-4f;  // of log2 alpha; more than the rounding of the loops over pixels

// First and last tile on one axis as one number below 2^22, in the low bits of a float.
struct TileRange {
    int first, last;
    explicit TileRange(uint32_t bits) : first(bits & 2047), last(bits >> 11 & 2047) {}
    static Vec pack(Vec first_pixel, Vec last_pixel, int pixels) {
        const Vec zero(0.0f), edge(pixels - 1.0f), per_tile(1.0f / TILE), shifter(12582912.0f);  // see exp2
        const auto tile = [&](Vec pixel, float down) {
            return (fma(min(max(pixel, zero), edge), per_tile, Vec(down)) + shifter) - shifter;
        };
        // halves are rounded to even: the first pixel of a tile must not be taken for the last one of the tile before
        return fma(tile(last_pixel, -0.499f), Vec(2048.0f), tile(first_pixel, -0.5f)) + Vec(8388608.0f);  // 2^23
    }
};

// What the ellipse covers, see Footprint. C is (M^T M)^-1 up to a factor, so its correlation is -M12 / |(M12, M22)|, and
// nothing cancels in sqrt(1 - c^2).
inline void footprint_columns(const View& view, const Splat16& s, Vec extent_x, Vec extent_y, Vec* columns) {
    const Vec one(1.0f), quarter(0.25f), per_length = one / sqrt(fma(s.M12, s.M12, s.M22 * s.M22));
    const Vec skew = -s.M12 * per_length, upright = s.M22 * per_length;
    const Vec rounding = (max(s.u, -s.u) + max(s.v, -s.v)) * Vec(1.0f / (1 << 22));  // of centers far from the screen
    columns[0] = quarter * s.u;
    columns[1] = s.v;
    columns[2] = one / extent_y;
    columns[3] = skew;
    columns[4] = quarter * (extent_x * skew);
    columns[5] = quarter * fma(extent_x, upright, rounding);
    const Vec right = extent_x + rounding, below = extent_y + rounding;
    columns[6] = TileRange::pack(s.u - right + one, s.u + right, view.width);  // + 1: up, if only by part of a pixel
    columns[7] = TileRange::pack(s.v - below + one, s.v + below, view.height);
}

// Writes the splats and footprints from `first` on, and the keys of those that are drawn; returns how many are.
template <DepthKind KIND>
inline uint32_t project_group(Frame& frame, const Neighbors16& g, size_t first, uint32_t lanes, uint64_t* keys) {
    const View& view = frame.view;
    const Splat16 s = project16(view, g.p.mean, g.p.quat, g.p.log_scale);
    const Vec log2_opacity = log2_sigmoid(g.p.logit), zero(0.0f);
    // alpha >= 1/255 is an ellipse in a box of half size sqrt(2 ln(255 opacity) cov_ii)
    const Vec reach = max(log2_opacity - Vec(LOG2_ALPHA_MIN - ALPHA_SLACK), zero) * Vec(2.0f * LN_2);
    const Vec extent_x = sqrt(reach * s.cov_xx), extent_y = sqrt(reach * s.cov_yy);
    const Mask drawn = s.drawable & (log2_opacity >= Vec(LOG2_ALPHA_MIN)) & on_screen(view, s.u, s.v, extent_x, extent_y);
    const uint32_t drawn_lanes = bits(drawn) & lanes;
    if (!drawn_lanes) return 0;

    Vec slopes[2] = {zero, zero};
    if constexpr (KIND == DepthKind::ray_plane) depth_slopes(s, slopes);
    const Vec splat[16] = {s.u, s.v, s.M11, s.M12, s.M22, log2_opacity, g.color[0], g.color[1], g.color[2], s.z,
                           slopes[0], slopes[1], zero, zero, zero, zero};
    store_rows16(reinterpret_cast<float*>(frame.splats.data() + first), splat);
    Vec footprint[8];
    footprint_columns(view, s, extent_x, extent_y, footprint);
    store_rows8(reinterpret_cast<float*>(frame.footprints.data() + first), footprint);

    alignas(64) float depth[LANES];
    store(depth, s.z);
    uint32_t count = 0;
    for (uint32_t lane = 0; lane < LANES; lane++) {
        uint32_t depth_bits;  // positive floats order like their bits
        std::memcpy(&depth_bits, depth + lane, sizeof depth_bits);
        keys[count] = static_cast<uint64_t>(depth_bits) << 32 | (first + lane);
        count += drawn_lanes >> lane & 1;
    }
    return count;
}

constexpr size_t CHUNK = 32 * LANES;  // Gaussians that are projected together

// Projects one chunk; false if a parameter is not usable. Flat, because most of a Splat16 serves only the way back.
template <DepthKind KIND>
__attribute__((flatten)) inline bool project_chunk(Frame& frame, const GaussianArrays& gaussians, size_t chunk) {
    const size_t begin = chunk * CHUNK, end = begin + CHUNK < gaussians.count ? begin + CHUNK : gaussians.count;
    uint64_t* keys = frame.depth_keys.data() + begin;
    uint32_t drawn = 0;
    bool all_usable = true;
    for (size_t first = begin; first < end; first += LANES) {
        const Neighbors16 g(gaussians, first);
        const uint32_t lanes = end - first < LANES ? (1u << (end - first)) - 1 : 0xffffu;
        all_usable &= usable(g);
        if (any(may_be_seen(frame.view, g.p))) drawn += project_group<KIND>(frame, g, first, lanes, keys + drawn);
    }
    frame.chunk_drawn.data()[chunk] = drawn;
    return all_usable;
}

// Projects all Gaussians; false if a parameter is not usable.
inline bool project_all(Frame& frame, const GaussianArrays& gaussians) {
    const size_t chunks = (gaussians.count + CHUNK - 1) / CHUNK;
    frame.chunks = chunks;
    frame.splats.need(chunks * CHUNK);
    frame.footprints.need(chunks * CHUNK);
    frame.depth_keys.need(chunks * CHUNK);
    frame.chunk_drawn.need(chunks);
    const auto project = frame.view.depth == DepthKind::ray_plane ? project_chunk<DepthKind::ray_plane> : project_chunk<DepthKind::blended>;
    int unusable = 0;
#pragma omp parallel for schedule(static, 1) num_threads(frame.threads) reduction(+ : unusable) if (frame.threads > 1)
    for (size_t chunk = 0; chunk < chunks; chunk++) unusable += !project(frame, gaussians, chunk);
    return unusable == 0;
}

}  // namespace KERNEL_ISA
