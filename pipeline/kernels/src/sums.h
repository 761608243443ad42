// Back to front: what the pixels of a block say about each of its Gaussians, summed.
//
// A block is walked from its last item to its first in batches of sixteen, in two steps.
//   Replay: lanes are pixels. alpha as in front, the transmittance before each Gaussian from the one behind it, and a few
//   numbers per pixel and item.
//   Sums: lanes are Gaussians, after a transposition. The numbers times monomials of e = M (pixel - center), added up over the
//   sixteen pixels without a sum across lanes, and added to the Gaussian's row of this tile.
#pragma once

#include "blending.h"

namespace KERNEL_ISA {

constexpr int BATCH = 16;  // items

// Sums of the gradient; w: cotangent of ln alpha, (X, Y) = e; R, G, B, Z: weight times cotangent, the last two times e for
// ray_plane only.
enum GradientSum { SUM_W, SUM_WX, SUM_WY, SUM_WXX, SUM_WXY, SUM_WYY, SUM_R, SUM_G, SUM_B, SUM_Z, SUM_ZX, SUM_ZY };

// Sums of information. w2: square of the derivative by ln alpha, over channels; Z: its product with depth's own; ZZ: the
// square of that. The empirical information squares the three colors one by one; to J^T R^-1 J they are all the same, and its
// other two count by-products.
enum InformationSum {
    INFO_XX, INFO_XY, INFO_YY, INFO_XXX, INFO_XXY, INFO_XYY, INFO_YYY,
    INFO_XXXX, INFO_XXXY, INFO_XXYY, INFO_XYYY, INFO_YYYY, INFO_1,
    INFO_ZX, INFO_ZY, INFO_ZXX, INFO_ZXY, INFO_ZYY,
    INFO_R, INFO_G, INFO_B, INFO_ZZ,
    INFO_Z1, INFO_ZXXX, INFO_ZXXY, INFO_ZXYY, INFO_ZYYY, INFO_ZZX, INFO_ZZY, INFO_ZZXX, INFO_ZZXY, INFO_ZZYY,  // ray_plane only
    INFO_WEIGHT = INFO_G, INFO_RESIDUAL = INFO_B,
};

template <DepthKind KIND>
constexpr int GRADIENT_SUMS = KIND == DepthKind::ray_plane ? SUM_ZY + 1 : SUM_Z + 1;
template <DepthKind KIND>
constexpr int INFORMATION_SUMS = KIND == DepthKind::ray_plane ? INFO_ZZYY + 1 : INFO_ZZ + 1;

constexpr int GRADIENT_ROW = 16, INFORMATION_ROW = 32;  // floats; whole cache lines
template <DepthKind KIND>
constexpr int SQUARES_ROW = KIND == DepthKind::ray_plane ? 48 : 32;  // gradient, then information

// Sixteen items of a block, or fewer: then the first stands for the missing, seen by no pixel.
struct Batch {
    uint32_t first;  // of the block's items
    alignas(64) uint32_t positions[BATCH];
    alignas(32) uint16_t pixels[BATCH];
    int count;
    const Splat* splats;  // of the tile's list
    Batch(const Splat* tile_splats, const TileItems& items, uint32_t begin, uint32_t block_count)
        : first(begin), count(block_count - first < BATCH ? static_cast<int>(block_count - first) : BATCH), splats(tile_splats) {
        load_positions(items.positions + first, count, positions);
        load_words(items.pixels + first, count, pixels);
    }
    const Splat& splat(int k) const { return splats[positions[k]]; }
    int groups() const { return (count + ABREAST - 1) / ABREAST; }
};

using Lanes = Vec[BATCH];

// alpha and weight computed again. T: transmittance behind the items, then before them; it is divided by the same 1 - alpha
// that it was multiplied by in front.
struct Replay {
    Vec pixel_x, pixel_y, T;
    Replay(const Block& block, const float* end) : pixel_x(block.pixels_x()), pixel_y(block.pixels_y()), T(load(end)) {}

    // Calls visit(k, splat, alpha, weight) for the items of a batch from the last to the first.
    template <class Visit>
    ALWAYS_INLINE void walk(const Batch& batch, Visit visit) {
        for (int group = batch.groups(); group-- > 0;) {
            Vec alpha[ABREAST], inverse[ABREAST];
            unrolled<ABREAST>([&](auto k) ALWAYS_INLINE {
                const Splat& s = batch.splat(group * ABREAST + k);
                alpha[k] = Whitened(s, pixel_x, pixel_y).log2_alpha(s);
            });
            unrolled<ABREAST>([&](auto k) ALWAYS_INLINE {
                Vec rest;
                alpha_and_rest(alpha[k], mask_of_bits(batch.pixels[group * ABREAST + k]), rest);
                inverse[k] = Vec(1.0f) / rest;
                pin(alpha[k]);
                pin(inverse[k]);
            });
            unrolled<ABREAST>([&](auto back) ALWAYS_INLINE {
                constexpr int k = ABREAST - 1 - back;
                T = T * inverse[k];
                visit(group * ABREAST + k, batch.splat(group * ABREAST + k), alpha[k], alpha[k] * T);
            });
        }
    }
};
// alpha and weight as the forward pass just left them.
struct Recall {
    Memory memory;
    template <class Visit>
    ALWAYS_INLINE void walk(const Batch& batch, Visit visit) {
        for (int k = batch.count; k-- > 0;) {
            const size_t at = static_cast<size_t>(batch.first + k) * LANES;
            visit(k, batch.splat(k), load(memory.alphas + at), load(memory.weights + at));
        }
    }
};

// d channel / d ln alpha = weight (own value - what lies behind, composited); leaves in `behind` what lies behind the next.
inline Vec gain_over(Vec& behind, Vec own, Vec alpha) {
    const Vec gain = own - behind;
    behind = fma(alpha, gain, behind);
    return gain;
}
// alpha moves with the parameters only below its clamp.
inline Vec if_unclamped(Vec alpha, Vec value) { return select_or_zero(alpha < Vec(ALPHA_MAX), value); }

// ---------------------------------------------------------------- lanes are Gaussians

template <int USED, int ROW>
ALWAYS_INLINE inline void unused_sums(Vec* sums) {
    unrolled<ROW - USED>([&](auto k) ALWAYS_INLINE {
        Vec zero(0.0f);
        pin(zero);  // or the compiler calls for slow block moves
        sums[USED + k] = zero;
    });
}
// Adds sums[ROW], whose lanes are the batch's items, to the items' rows in the tile.
template <int ROW>
inline void add_to_rows(const Batch& batch, Vec* sums, float* tile_rows) {
    for (int first = 0; first < ROW; first += LANES) {
        transpose16(sums + first);
        for (int k = 0; k < batch.count; k++) {
            float* row = tile_rows + static_cast<size_t>(batch.positions[k]) * ROW + first;
            store(row, load(row) + sums[first + k]);
        }
    }
}

// Where the Gaussians of a batch lie, as the sums need it.
struct BatchShape {
    Vec columns[8];
    explicit BatchShape(const Batch& batch) {
        load_columns8([&](int k) { return &batch.splat(k).u; }, columns);
    }
};

// Calls pixel(p, x) for the four pixels of each row of the block, and then row(y): e of the pixels.
template <class Pixel, class Row>
ALWAYS_INLINE inline void over_rows(const BatchShape& shape, int half, const Block& block, Pixel pixel, Row row) {
    const Wide u = part(shape.columns[0], half), v = part(shape.columns[1], half), M11 = part(shape.columns[2], half);
    const Wide M12 = part(shape.columns[3], half), M22 = part(shape.columns[4], half);
    Wide dx[4];
    unrolled<4>([&](auto c) ALWAYS_INLINE { dx[c] = Wide(static_cast<float>(block.x + c)) - u; });
    unrolled<4>([&](auto r) ALWAYS_INLINE {
        const Wide dy = Wide(static_cast<float>(block.y + r)) - v, skew = M12 * dy;
        unrolled<4>([&](auto c) ALWAYS_INLINE { pixel(4 * r + c, fma(M11, dx[c], skew)); });
        row(M22 * dy);
    });
}

template <int COUNT>
inline void set_parts(Vec* sums, int half, const Wide (&values)[COUNT]) {
    for (int k = 0; k < COUNT; k++) set_part(sums[k], half, values[k]);
}

constexpr int monomials(int degree) { return (degree + 1) * (degree + 2) / 2; }

// totals = sums of w x^i y^j over the pixels, i + j <= DEGREE, by degree, then by j: 1, x, y, xx, xy, yy, xxx ...
template <int DEGREE, class W>
inline void sum_monomials(W w_of, const BatchShape& shape, const Block& block, int half, Wide (&totals)[monomials(DEGREE)]) {
    Wide of_row[DEGREE + 1];  // of w x^i
    for (Wide& total : totals) total = Wide(0.0f);
    for (Wide& total : of_row) total = Wide(0.0f);
    over_rows(
        shape, half, block,
        [&](int p, Wide x) ALWAYS_INLINE {
            Wide wx = w_of(p);
            of_row[0] += wx;
            unrolled<DEGREE>([&](auto i) ALWAYS_INLINE {
                of_row[i + 1] = fma(wx, x, of_row[i + 1]);
                wx = wx * x;
            });
        },
        [&](Wide y) ALWAYS_INLINE {
            unrolled<DEGREE + 1>([&](auto i) ALWAYS_INLINE {
                Wide wxy = of_row[i];
                totals[monomials(i - 1)] += wxy;
                unrolled<DEGREE - i>([&](auto j) ALWAYS_INLINE {
                    constexpr int place = monomials(i + j) + j + 1;
                    totals[place] = fma(wxy, y, totals[place]);
                    wxy = wxy * y;
                });
                of_row[i] = Wide(0.0f);
            });
        });
}

// totals[k] = sum over the pixels p of value_of(p) times planes[k][p].
template <int COUNT, class Value>
inline void sum_products(Value value_of, const float (*planes)[LANES], Wide (&totals)[COUNT]) {
    for (Wide& total : totals) total = Wide(0.0f);
    for (int p = 0; p < LANES; p++) {
        const Wide value = value_of(p);
        for (int k = 0; k < COUNT; k++) totals[k] = fma(value, Wide(planes[k][p]), totals[k]);
    }
}

// SUM_W .. SUM_WYY
inline void sum_moments(const Lanes& w_of, const BatchShape& shape, const Block& block, int half, Vec* sums) {
    const Wide zero(0.0f);
    Wide W = zero, WX = zero, WY = zero, WXX = zero, WXY = zero, WYY = zero;
    Wide s0 = zero, s1 = zero, s2 = zero;  // over a row, of w x^k
    over_rows(
        shape, half, block,
        [&](int p, Wide x) ALWAYS_INLINE {
            const Wide w = part(w_of[p], half), wx = w * x;
            s0 += w;
            s1 += wx;
            s2 = fma(wx, x, s2);
        },
        [&](Wide y) ALWAYS_INLINE {
            const Wide s0y = s0 * y;
            W += s0;
            WX += s1;
            WXX += s2;
            WY += s0y;
            WXY = fma(s1, y, WXY);
            WYY = fma(s0y, y, WYY);
            s0 = s1 = s2 = zero;
        });
    set_parts(sums, half, {W, WX, WY, WXX, WXY, WYY});
}

// INFO_XX .. INFO_1: the distinct entries of the Gram matrix of (x, y, x^2, x y, y^2), and of 1. w2_of(p): its weight.
template <class W2>
inline void sum_screen_moments(W2 w2_of, const BatchShape& shape, const Block& block, int half, Vec* sums) {
    const Wide zero(0.0f);
    Wide total[INFO_1 + 1];
    for (Wide& t : total) t = zero;
    Wide s0 = zero, s1 = zero, s2 = zero, s3 = zero, s4 = zero;  // over a row, of w2 x^k
    over_rows(
        shape, half, block,
        [&](int p, Wide x) ALWAYS_INLINE {
            const Wide w2 = w2_of(p), w2x = w2 * x, w2xx = w2x * x, w2xxx = w2xx * x;
            s0 += w2;
            s1 += w2x;
            s2 += w2xx;
            s3 += w2xxx;
            s4 = fma(w2xxx, x, s4);
        },
        [&](Wide y) ALWAYS_INLINE {
            const Wide s0y = s0 * y, s0yy = s0y * y, s0yyy = s0yy * y, s1y = s1 * y, s1yy = s1y * y, s2y = s2 * y;
            total[INFO_1] += s0;
            total[INFO_XX] += s2;
            total[INFO_XY] += s1y;
            total[INFO_YY] += s0yy;
            total[INFO_XXX] += s3;
            total[INFO_XXY] += s2y;
            total[INFO_XYY] += s1yy;
            total[INFO_YYY] += s0yyy;
            total[INFO_XXXX] += s4;
            total[INFO_XXXY] = fma(s3, y, total[INFO_XXXY]);
            total[INFO_XXYY] = fma(s2y, y, total[INFO_XXYY]);
            total[INFO_XYYY] = fma(s1yy, y, total[INFO_XYYY]);
            total[INFO_YYYY] = fma(s0yyy, y, total[INFO_YYYY]);
            s0 = s1 = s2 = s3 = s4 = zero;
        });
    set_parts(sums, half, total);
}

// INFO_ZX .. INFO_ZYY. cross_of(p): product of depth's own derivative with that by ln alpha.
template <class Cross>
inline void sum_depth_moments(Cross cross_of, const BatchShape& shape, const Block& block, int half, Vec* sums) {
    const Wide zero(0.0f);
    Wide X = zero, Y = zero, XX = zero, XY = zero, YY = zero;
    Wide s0 = zero, s1 = zero, s2 = zero;
    over_rows(
        shape, half, block,
        [&](int p, Wide x) ALWAYS_INLINE {
            const Wide cross = cross_of(p), cx = cross * x;
            s0 += cross;
            s1 += cx;
            s2 = fma(cx, x, s2);
        },
        [&](Wide y) ALWAYS_INLINE {
            const Wide s0y = s0 * y;
            X += s1;
            Y += s0y;
            XX += s2;
            XY = fma(s1, y, XY);
            YY = fma(s0y, y, YY);
            s0 = s1 = s2 = zero;
        });
    set_parts(sums + INFO_ZX, half, {X, Y, XX, XY, YY});
}

// The same for ray_plane, whose own derivative of depth goes as 1, x and y, and what the square of that needs alongside INFO_ZZ.
// cross_of(p), square_of(p): of the part that goes as 1.
template <class Cross, class Square>
inline void sum_ray_depth_moments(Cross cross_of, Square square_of, const BatchShape& shape, const Block& block, int half, Vec* sums) {
    constexpr int OF_CROSS[] = {INFO_Z1, INFO_ZX, INFO_ZY, INFO_ZXX, INFO_ZXY, INFO_ZYY, INFO_ZXXX, INFO_ZXXY, INFO_ZXYY, INFO_ZYYY};
    constexpr int OF_SQUARE[] = {INFO_ZZX, INFO_ZZY, INFO_ZZXX, INFO_ZZXY, INFO_ZZYY};
    Wide cross[monomials(3)], square[monomials(2)];
    sum_monomials<3>(cross_of, shape, block, half, cross);
    sum_monomials<2>(square_of, shape, block, half, square);
    for (int k = 0; k < monomials(3); k++) set_part(sums[OF_CROSS[k]], half, cross[k]);
    for (int k = 1; k < monomials(2); k++) set_part(sums[OF_SQUARE[k - 1]], half, square[k]);
}

}  // namespace KERNEL_ISA
