// The sweeps over a tile: rows of sums for the gradient, for information, for contributions.
#pragma once

#include "sums.h"

namespace KERNEL_ISA {

// Reads one word of every cache line, so that they are near when they are needed. Plain loads: there are machines on which
// prefetch instructions do nothing.
template <class T>
inline void touch(const T* begin, size_t count) {
    uint32_t sum = 0, word;
    for (size_t i = 0; i < count; i += 64 / sizeof(T)) {
        std::memcpy(&word, begin + i, sizeof word);
        sum += word;
    }
    asm volatile("" : : "r"(sum));
}
// Fetches what the sweep over a tile will read, while the tile before is at work.
inline void touch_items(const Frame& frame, int index) {
    if (index >= frame.tiles_x * frame.tiles_y) return;
    const TileItems items(frame, index);
    size_t count = 0;
    for (int b = 0; b < BLOCKS; b++) count += items.counts[b];
    touch(items.positions, count);
    touch(items.pixels, count);
}

// Room for the sums of a sweep.
template <int ROW>
inline void prepare_rows(Frame& frame) {
    const size_t count = (frame.one_row ? frame.visible : frame.intersection_count) * ROW;
    frame.rows.need(count);
    if (frame.one_row && count) std::memset(frame.rows.data(), 0, count * sizeof(float));
    frame.tile_rows.need(frame.longest_list * ROW * frame.threads);
}

// A tile whose blocks are walked back to front. Sums are added up near by, and written when the tile is done: rows lie far
// apart in memory, and many Gaussians of a list are hidden in the tile.
struct Sweep {
    const View& view;
    const Tile tile;
    const Splat* splats;
    float* rows;  // of the tile's list
    TileItems items;

    template <int ROW>
    static Sweep begin(Frame& frame, int index) {
        Sweep sweep(frame, Tile(frame, index), frame.tile_rows.data() + this_thread() * frame.longest_list * ROW);
        if (ROW > 0) std::memset(sweep.rows, 0, sweep.tile.count * ROW * sizeof(float));
        return sweep;
    }
    // Fetches a sixteenth of where its sums go.
    template <int ROW>
    void fetch_rows(const Frame& frame, int part) const {
        const uint32_t* places = frame.list_rows.data() + tile.first;
        for (uint32_t i = tile.count * part / BLOCKS; i < tile.count * (part + 1) / BLOCKS; i++)
            __builtin_prefetch(frame.rows.data() + static_cast<size_t>(places[i]) * ROW, 1);
    }
    template <int ROW>
    void end(Frame& frame) const {
        const uint32_t* places = frame.list_rows.data() + tile.first;
        for (uint32_t i = 0; i < tile.count; i++) {
            const float* row = rows + static_cast<size_t>(i) * ROW;
            float* out = frame.rows.data() + static_cast<size_t>(places[i]) * ROW;
            if (!frame.one_row)
                std::memcpy(out, row, ROW * sizeof(float));
            else if (any_nonzero<ROW>(row))
                add_row<ROW>(out, row);
        }
    }

private:
    Sweep(Frame& frame, const Tile& t, float* tile_rows)
        : view(frame.view), tile(t), splats(gather_splats(frame, t)), rows(tile_rows), items(frame, t.index) {}

    template <int ROW>
    static void add_row(float* out, const float* row) {
        if constexpr (ROW % LANES == 0)
            for (int first = 0; first < ROW; first += LANES) store(out + first, load(out + first) + load(row + first));
        else
            for (int k = 0; k < ROW; k++) out[k] += row[k];
    }
    template <int ROW>
    static bool any_nonzero(const float* row) {
        bool zero = true;
        if constexpr (ROW % LANES == 0)
            for (int first = 0; first < ROW; first += LANES) {
                const Vec part = load(row + first);
                zero &= bits((part >= Vec(0.0f)) & (part <= Vec(0.0f))) == 0xffffu;
            }
        else
            for (int k = 0; k < ROW; k++) zero &= row[k] == 0.0f;
        return !zero;
    }
};

// Calls visit(batch) for the batches of a block from the last to the first.
template <class Visit>
ALWAYS_INLINE inline void over_batches(const Sweep& sweep, uint32_t count, Visit visit) {
    for (uint32_t first = (count - 1) / BATCH * BATCH;; first -= BATCH) {
        visit(Batch(sweep.splats, sweep.items, first, count));
        if (first == 0) return;
    }
}

// ---------------------------------------------------------------- gradient

enum class Derivatives { NONE, POSE, ALL, ALL_AND_SQUARES };  // of the pose alone; of all parameters; and their squares per pixel

template <Derivatives D, DepthKind KIND>
constexpr int ROW_OF = D == Derivatives::ALL_AND_SQUARES ? SQUARES_ROW<KIND> : GRADIENT_ROW;
template <Derivatives D, DepthKind KIND>
constexpr int SUMS_OF = D == Derivatives::ALL_AND_SQUARES ? GRADIENT_SUMS<KIND> + INFORMATION_SUMS<KIND> : GRADIENT_SUMS<KIND>;
static_assert(SUMS_OF<Derivatives::ALL_AND_SQUARES, DepthKind::blended> <= SQUARES_ROW<DepthKind::blended>, "");
static_assert(SUMS_OF<Derivatives::ALL_AND_SQUARES, DepthKind::ray_plane> <= SQUARES_ROW<DepthKind::ray_plane>, "");

// Cotangents of the images in one block; plane k of `planes`: red, green, blue, depth, alpha.
struct Cotangents {
    alignas(64) float planes[5][LANES];
};

// Squares of the gradient: the empirical information. squared: of the cotangents' planes.
template <DepthKind KIND>
inline void sum_squares(const Lanes& w_of, const Lanes& f_of, const Cotangents& v, const float (*squared)[LANES], const BatchShape& shape,
                        const Block& block, int half, Vec* sums) {
    sum_screen_moments([&](int p) ALWAYS_INLINE { return part(w_of[p], half) * part(w_of[p], half); }, shape, block, half, sums);
    const auto cross_of = [&](int p) ALWAYS_INLINE { return part(f_of[p], half) * part(w_of[p], half) * Wide(v.planes[3][p]); };
    const auto weight2_of = [&](int p) ALWAYS_INLINE { return part(f_of[p], half) * part(f_of[p], half); };
    if constexpr (KIND == DepthKind::ray_plane) {
        const auto square_of = [&](int p) ALWAYS_INLINE { return weight2_of(p) * Wide(squared[3][p]); };
        sum_ray_depth_moments(cross_of, square_of, shape, block, half, sums);
    } else {
        sum_depth_moments(cross_of, shape, block, half, sums);
    }
    Wide totals[4];
    sum_products(weight2_of, squared, totals);
    set_parts(sums + INFO_R, half, totals);
}

// A term of the loss that is a function of each Gaussian's own depth at a pixel, times its weight: none.
struct NoTermOfDepth {
    static constexpr bool ACTIVE = false;
};

// Adds to the rows of a block's items. term: see NoTermOfDepth and TermOfDepth.
template <Derivatives D, DepthKind KIND, class Pass, class Term>
NO_INLINE static void gradient_block(const Sweep& sweep, const Block& block, uint32_t count, const Cotangents& v, Pass pass, Term& term) {
    constexpr int ROW = ROW_OF<D, KIND>;
    const Vec r = load(v.planes[0]), g = load(v.planes[1]), b = load(v.planes[2]), z = load(v.planes[3]), a = load(v.planes[4]);
    const Vec pixel_x = block.pixels_x(), pixel_y = block.pixels_y();
    const float* background = sweep.view.background;
    alignas(64) float squared[4][LANES];
    if constexpr (D == Derivatives::ALL_AND_SQUARES) {
        const Vec all[4] = {r * r, g * g, b * b, z * z};
        for (int k = 0; k < 4; k++) store(squared[k], all[k]);
    }
    Vec behind = fma(Vec(background[0]), r, fma(Vec(background[1]), g, Vec(background[2]) * b));
    over_batches(sweep, count, [&](const Batch& batch) ALWAYS_INLINE {
        Lanes f, w, d;  // d: cotangent of the Gaussian's depth, where there is a term of it
        Vec sums[ROW];
        unused_sums<D == Derivatives::POSE ? SUM_R : SUMS_OF<D, KIND>, ROW>(sums);
        pass.walk(batch, [&](int k, const Splat& s, Vec alpha, Vec weight) ALWAYS_INLINE {
            const Vec depth = depth_at<KIND>(s, pixel_x, pixel_y);
            Vec own = fma(Vec(s.r), r, fma(Vec(s.g), g, fma(Vec(s.b), b, fma(depth, z, a))));
            if constexpr (Term::ACTIVE) {
                Vec slope;
                own += term.add(depth, weight, slope);
                d[k] = weight * (z + slope);
            }
            const Vec gain = gain_over(behind, own, alpha);
            w[k] = if_unclamped(alpha, weight * gain);
            f[k] = weight;
        });
        const BatchShape shape(batch);
        transpose16(w);
        for (int half = 0; half < PARTS; half++) sum_moments(w, shape, block, half, sums);
        transpose16(f);
        if constexpr (Term::ACTIVE) transpose16(d);
        for (int half = 0; half < PARTS; half++) {
            constexpr int FIRST = D == Derivatives::POSE ? SUM_Z : SUM_R;  // the pose does not move colors
            Wide totals[SUM_Z + 1 - FIRST];
            sum_products([&](int p) ALWAYS_INLINE { return part(f[p], half); }, v.planes + (FIRST - SUM_R), totals);
            set_parts(sums + FIRST, half, totals);
            if constexpr (KIND == DepthKind::ray_plane || Term::ACTIVE) {
                const auto depth_of = [&](int p) ALWAYS_INLINE {
                    if constexpr (Term::ACTIVE) return part(d[p], half);
                    else return part(f[p], half) * Wide(v.planes[3][p]);
                };
                Wide of_depth[monomials(1)];
                sum_monomials<1>(depth_of, shape, block, half, of_depth);
                if constexpr (Term::ACTIVE) set_part(sums[SUM_Z], half, of_depth[0]);
                if constexpr (KIND == DepthKind::ray_plane) {
                    set_part(sums[SUM_ZX], half, of_depth[1]);
                    set_part(sums[SUM_ZY], half, of_depth[2]);
                }
            }
            if constexpr (D == Derivatives::ALL_AND_SQUARES)
                sum_squares<KIND>(w, f, v, squared, shape, block, half, sums + GRADIENT_SUMS<KIND>);
        }
        add_to_rows<ROW>(batch, sums, sweep.rows);
    });
}

template <Derivatives D, DepthKind KIND>
inline Status gradient_tile(Frame& frame, int index, const float* d_color, const float* d_depth, const float* d_alpha) {
    touch_items(frame, index + 1);
    Sweep sweep = Sweep::begin<ROW_OF<D, KIND>>(frame, index);
    const View& view = frame.view;
    Cotangents cotangents[BLOCKS];
    bool bad[3] = {};
    for (int b = 0; b < BLOCKS; b++) {  // all at once: their cache misses then overlap
        const Block block(sweep.tile, b, view);
        if (block.outside(view)) continue;
        Vec rgb[3];
        read_block_rgb(d_color, block, view, rgb);
        const Vec z = read_block_or_zero(d_depth, block, view), a = read_block_or_zero(d_alpha, block, view);
        bad[0] |= !(finite(rgb[0]) && finite(rgb[1]) && finite(rgb[2]));
        bad[1] |= !finite(z);
        bad[2] |= !finite(a);
        for (int k = 0; k < 3; k++) store(cotangents[b].planes[k], rgb[k]);
        store(cotangents[b].planes[3], z);
        store(cotangents[b].planes[4], a);
    }
    for (int b = 0; b < BLOCKS; b++) {
        const uint32_t count = sweep.items.counts[b];
        if (!count) continue;
        const Block block(sweep.tile, b, view);
        NoTermOfDepth none;
        gradient_block<D, KIND>(sweep, block, count, cotangents[b], Replay(block, sweep.items.T + b * LANES), none);
        sweep.items.skip(count);
    }
    sweep.end<ROW_OF<D, KIND>>(frame);
    return bad[0] ? Status::bad_first_image : bad[1] ? Status::bad_second_image : bad[2] ? Status::bad_third_image : Status::ok;
}

// ---------------------------------------------------------------- information

// Precisions 1/sigma^2 of color and depth in one block, the pixels that have one, and the residual.
struct Precisions {
    alignas(64) float planes[4][LANES];  // color, depth, used, used times residual
};

// Rows of J^T R^-1 J: each color channel and depth has its own "behind", for their derivatives are squared one by one.
template <DepthKind KIND>
NO_INLINE static void information_block(const Sweep& sweep, const Block& block, uint32_t count, const Precisions& v, Replay pass) {
    const Vec of_color = load(v.planes[0]), of_depth = load(v.planes[1]);
    const Vec pixel_x = block.pixels_x(), pixel_y = block.pixels_y();
    const float* background = sweep.view.background;
    Vec behind_r(background[0]), behind_g(background[1]), behind_b(background[2]), behind_z(0.0f);
    over_batches(sweep, count, [&](const Batch& batch) ALWAYS_INLINE {
        Lanes f, w2, cross;
        Vec sums[INFORMATION_ROW];
        unused_sums<INFORMATION_SUMS<KIND>, INFORMATION_ROW>(sums);
        pass.walk(batch, [&](int k, const Splat& s, Vec alpha, Vec weight) ALWAYS_INLINE {
            const Vec gain_r = gain_over(behind_r, Vec(s.r), alpha), gain_g = gain_over(behind_g, Vec(s.g), alpha);
            const Vec depth = depth_at<KIND>(s, pixel_x, pixel_y);
            const Vec gain_b = gain_over(behind_b, Vec(s.b), alpha), gain_z = gain_over(behind_z, depth, alpha);
            const Vec color2 = fma(gain_r, gain_r, fma(gain_g, gain_g, gain_b * gain_b)), depth_gain = of_depth * gain_z;
            const Vec moving2 = if_unclamped(alpha, weight * weight);
            f[k] = weight;
            w2[k] = moving2 * fma(of_color, color2, depth_gain * gain_z);
            cross[k] = moving2 * depth_gain;
        });
        const BatchShape shape(batch);
        transpose16(w2);
        for (int half = 0; half < PARTS; half++)
            sum_screen_moments([&](int p) ALWAYS_INLINE { return part(w2[p], half); }, shape, block, half, sums);
        transpose16(cross);
        transpose16(f);
        for (int half = 0; half < PARTS; half++) {
            const auto cross_of = [&](int p) ALWAYS_INLINE { return part(cross[p], half); };
            const auto weight2_of = [&](int p) ALWAYS_INLINE { return part(f[p], half) * part(f[p], half); };
            if constexpr (KIND == DepthKind::ray_plane) {
                const auto square_of = [&](int p) ALWAYS_INLINE { return weight2_of(p) * Wide(v.planes[1][p]); };
                sum_ray_depth_moments(cross_of, square_of, shape, block, half, sums);
            } else {
                sum_depth_moments(cross_of, shape, block, half, sums);
            }
            Wide of_squares[2], of_weights[2];
            sum_products(weight2_of, v.planes, of_squares);
            sum_products([&](int p) ALWAYS_INLINE { return part(f[p], half); }, v.planes + 2, of_weights);
            set_part(sums[INFO_R], half, of_squares[0]);
            set_part(sums[INFO_ZZ], half, of_squares[1]);
            set_part(sums[INFO_WEIGHT], half, of_weights[0]);
            set_part(sums[INFO_RESIDUAL], half, of_weights[1]);
        }
        add_to_rows<INFORMATION_ROW>(batch, sums, sweep.rows);
    });
}

// Calls of_block(sweep, block, count of its items, precisions, replay) for the blocks of a tile that have items.
template <int ROW, class OfBlock>
inline Status over_precisions(Frame& frame, int index, const float* inv_var_color, const float* inv_var_depth, const float* residual,
                              OfBlock of_block) {
    touch_items(frame, index + 1);
    Sweep sweep = Sweep::begin<ROW>(frame, index);
    const View& view = frame.view;
    Precisions precisions[BLOCKS];
    bool bad[3] = {};
    for (int b = 0; b < BLOCKS; b++) {
        const Block block(sweep.tile, b, view);
        if (block.outside(view)) continue;
        const Vec color = read_block(inv_var_color, block, view), depth = read_block(inv_var_depth, block, view);
        const Vec r = read_block_or_zero(residual, block, view), zero(0.0f), used = select(zero < color + depth, Vec(1.0f), zero);
        bad[0] |= !finite_not_negative(color);
        bad[1] |= !finite_not_negative(depth);
        bad[2] |= !finite_not_negative(r);
        const Vec planes[4] = {color, depth, used, used * r};
        for (int k = 0; k < 4; k++) store(precisions[b].planes[k], planes[k]);
    }
    for (int b = 0; b < BLOCKS; b++) {
        const uint32_t count = sweep.items.counts[b];
        if (!count) continue;
        const Block block(sweep.tile, b, view);
        of_block(sweep, block, count, precisions[b], Replay(block, sweep.items.T + b * LANES));
        sweep.items.skip(count);
    }
    sweep.end<ROW>(frame);
    return bad[0] ? Status::bad_first_image : bad[1] ? Status::bad_second_image : bad[2] ? Status::bad_third_image : Status::ok;
}
template <DepthKind KIND>
inline Status information_tile(Frame& frame, int index, const float* inv_var_color, const float* inv_var_depth, const float* residual) {
    return over_precisions<INFORMATION_ROW>(frame, index, inv_var_color, inv_var_depth, residual, information_block<KIND>);
}

// ---------------------------------------------------------------- contributions

// Sum of weights and number of pixels.
NO_INLINE static void contribution_block(const Sweep& sweep, uint32_t count, Replay pass) {
    over_batches(sweep, count, [&](const Batch& batch) ALWAYS_INLINE {
        Lanes f;
        Vec sums[GRADIENT_ROW];
        unused_sums<2, GRADIENT_ROW>(sums);
        alignas(64) float pixels[BATCH];
        for (int k = 0; k < BATCH; k++) pixels[k] = static_cast<float>(__builtin_popcount(batch.pixels[k]));
        pass.walk(batch, [&](int k, const Splat&, Vec, Vec weight) ALWAYS_INLINE { f[k] = weight; });
        transpose16(f);
        sums[0] = f[0];
        for (int p = 1; p < LANES; p++) sums[0] += f[p];
        sums[1] = load(pixels);
        add_to_rows<GRADIENT_ROW>(batch, sums, sweep.rows);
    });
}

inline void contribution_tile(Frame& frame, int index) {
    touch_items(frame, index + 1);
    Sweep sweep = Sweep::begin<GRADIENT_ROW>(frame, index);
    for (int b = 0; b < BLOCKS; b++) {
        const uint32_t count = sweep.items.counts[b];
        if (!count) continue;
        const Block block(sweep.tile, b, frame.view);
        contribution_block(sweep, count, Replay(block, sweep.items.T + b * LANES));
        sweep.items.skip(count);
    }
    sweep.end<GRADIENT_ROW>(frame);
}

}  // namespace KERNEL_ISA
