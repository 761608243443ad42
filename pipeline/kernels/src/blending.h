// The loops over pixels: alpha blending front to back, and the sweeps back to front that need its derivatives.
//
// Per pixel: weight_i = alpha_i T_i with T_i = prod_{j<i} (1 - alpha_j); colour = sum weight_i c_i + T_end background.
// Tile images are kept in block order: index 16 block + lane.
#pragma once

#include "lists.h"

namespace KERNEL_ISA {

constexpr float ALPHA_MAX = 0.999f;
constexpr float TRANSMITTANCE_MIN = 1e-4f;  // a Gaussian that would take a pixel below this closes the pixel, unblended
constexpr float NEVER = 1e30f;

struct Tile {
    int x, y;    // first pixel
    bool whole;  // all pixels lie in the image
    Tile(const Frame& frame, int index)
        : x(index % frame.tiles_x * TILE), y(index / frame.tiles_x * TILE),
          whole(x + TILE <= frame.view.width && y + TILE <= frame.view.height) {}
};

inline int block_x(int block) { return block % 4 * 4; }
inline int block_y(int block) { return block / 4 * 4; }

// Calls row(k, pixel) for every run of four pixels of a whole tile: k in block order, pixel in the image.
template <class Row>
inline void for_each_row(const Tile& tile, int width, Row row) {
    for (int block = 0; block < LANES; block++)
        for (int r = 0; r < 4; r++)
            row(block * LANES + r * 4, static_cast<size_t>(tile.y + block_y(block) + r) * width + tile.x + block_x(block));
}
// Calls pixel(k, index) for every pixel that lies in the image.
template <class Pixel>
inline void for_each_pixel(const Tile& tile, const View& view, Pixel pixel) {
    for (int k = 0; k < TILE_PIXELS; k++) {
        const int x = tile.x + block_x(k / LANES) + k % 4, y = tile.y + block_y(k / LANES) + k % LANES / 4;
        if (x < view.width && y < view.height) pixel(k, static_cast<size_t>(y) * view.width + x);
    }
}

inline void fill_tile(float* out, float value) {
    for (int k = 0; k < TILE_PIXELS; k += LANES) store(out + k, Vec(value));
}

// One plane of an image [H, W] in block order, zero outside the image.
inline void read_tile(const float* image, const Tile& tile, const View& view, float* out) {
    if (tile.whole)
        for_each_row(tile, view.width, [&](int k, size_t p) {
            for (int i = 0; i < 4; i++) out[k + i] = image[p + i];
        });
    else {
        fill_tile(out, 0.0f);
        for_each_pixel(tile, view, [&](int k, size_t p) { out[k] = image[p]; });
    }
}
inline void read_tile_or_zero(const float* image, const Tile& tile, const View& view, float* out) {
    if (image)
        read_tile(image, tile, view, out);
    else
        fill_tile(out, 0.0f);
}
// The three planes of an interleaved image [H, W, 3].
inline void read_tile_rgb(const float* image, const Tile& tile, const View& view, float* r, float* g, float* b) {
    if (tile.whole)
        for_each_row(tile, view.width, [&](int k, size_t p) {
            for (int i = 0; i < 4; i++) {
                r[k + i] = image[3 * (p + i)];
                g[k + i] = image[3 * (p + i) + 1];
                b[k + i] = image[3 * (p + i) + 2];
            }
        });
    else {
        fill_tile(r, 0.0f);
        fill_tile(g, 0.0f);
        fill_tile(b, 0.0f);
        for_each_pixel(tile, view, [&](int k, size_t p) { r[k] = image[3 * p], g[k] = image[3 * p + 1], b[k] = image[3 * p + 2]; });
    }
}
inline bool all_finite(const float* tile) {
    Vec sum(0.0f);
    for (int k = 0; k < TILE_PIXELS; k += LANES) sum = fma(load(tile + k), Vec(0.0f), sum);
    return bits(sum >= Vec(0.0f)) == 0xffffu;
}
inline bool all_finite_not_negative(const float* tile) {
    Vec least(0.0f);
    for (int k = 0; k < TILE_PIXELS; k += LANES) least = min(load(tile + k), least);
    return bits(least >= Vec(0.0f)) == 0xffffu && all_finite(tile);
}

// A splat broadcast over the lanes, relative to the pixels of one tile.
struct WideSplat {
    Vec M11, M12, M22, log2_opacity;
    float u, v;
    WideSplat(const Splat& s, const Tile& tile)
        : M11(s.M11), M12(s.M12), M22(s.M22), log2_opacity(s.log2_opacity), u(tile.x - s.u), v(tile.y - s.v) {}

    // e = M (pixel - centre) for the 16 pixels of a block.
    void place(int block, Vec& x, Vec& y) const {
        const Vec dx = load(PIXEL_OF_BLOCK.x) + Vec(u + block_x(block)), dy = load(PIXEL_OF_BLOCK.y) + Vec(v + block_y(block));
        x = fma(M11, dx, M12 * dy);
        y = M22 * dy;
    }
    Vec log2_alpha(Vec x, Vec y) const { return fnma(y, y, fnma(x, x, log2_opacity)); }
};

// ---------------------------------------------------------------- front to back

// Threshold that log2 alpha must reach in each pixel: open pixels 1/255, closed ones and those outside the image never.
inline void open_pixels(const Tile& tile, const View& view, float* threshold, float* stop) {
    fill_tile(threshold, tile.whole ? LOG2_ALPHA_MIN : NEVER);
    fill_tile(stop, tile.whole ? NEVER : -1.0f);
    if (!tile.whole)
        for_each_pixel(tile, view, [&](int k, size_t) { threshold[k] = LOG2_ALPHA_MIN, stop[k] = NEVER; });
}

inline void blend_tile(Frame& frame, int index, float* color, float* depth, float* alpha) {
    alignas(64) float T[TILE_PIXELS], R[TILE_PIXELS], G[TILE_PIXELS], B[TILE_PIXELS], D[TILE_PIXELS];
    alignas(64) float threshold[TILE_PIXELS];
    const Tile tile(frame, index);
    const View& view = frame.view;
    float* stop = frame.stop.data() + static_cast<size_t>(index) * TILE_PIXELS;
    open_pixels(tile, view, threshold, stop);
    fill_tile(T, 1.0f);
    fill_tile(R, 0.0f);
    fill_tile(G, 0.0f);
    fill_tile(B, 0.0f);
    fill_tile(D, 0.0f);

    const uint32_t first = frame.tile_start.data()[index], last = frame.tile_start.data()[index + 1];
    const uint32_t* list = frame.list_splats.data();
    const Splat* splats = frame.splats.data();
    uint32_t open_blocks = 0xffff;
    for (uint32_t e = first; e < last && open_blocks; e++) {
        __builtin_prefetch(&splats[list[e + 8]]);
        const Splat& splat = splats[list[e]];
        const WideSplat wide(splat, tile);
        const Vec r(splat.r), g(splat.g), b(splat.b), z(splat.z);
        uint32_t todo = frame.list_blocks.data()[e] & open_blocks;
        while (todo) {
            const int block = __builtin_ctz(todo), k = block * LANES;
            todo &= todo - 1;
            Vec x, y;
            wide.place(block, x, y);
            const Vec log2_alpha = wide.log2_alpha(x, y);
            const Mask seen = log2_alpha >= load(threshold + k);
            if (!any(seen)) continue;
            const Vec a = select_or_zero(seen, min(exp2(log2_alpha), Vec(ALPHA_MAX)));
            const Vec before = load(T + k);
            Vec weight = a * before, after = before - weight;
            const Mask closing = after < Vec(TRANSMITTANCE_MIN);
            if (__builtin_expect(any(closing), 0)) {
                const Vec raised = select(closing, Vec(NEVER), load(threshold + k));
                store(threshold + k, raised);
                store(stop + k, select(closing, Vec(static_cast<float>(e - first)), load(stop + k)));
                weight = select(closing, Vec(0.0f), weight);
                after = select(closing, before, after);
                if (!any(raised < Vec(NEVER))) open_blocks &= ~(1u << block);
            }
            store(T + k, after);
            store(R + k, fma(weight, r, load(R + k)));
            store(G + k, fma(weight, g, load(G + k)));
            store(B + k, fma(weight, b, load(B + k)));
            store(D + k, fma(weight, z, load(D + k)));
        }
    }

    const Vec back_r(view.background[0]), back_g(view.background[1]), back_b(view.background[2]);
    float* transmittance = frame.transmittance.data() + static_cast<size_t>(index) * TILE_PIXELS;
    for (int k = 0; k < TILE_PIXELS; k += LANES) {
        const Vec left = load(T + k);
        store(transmittance + k, left);
        store(R + k, fma(left, back_r, load(R + k)));
        store(G + k, fma(left, back_g, load(G + k)));
        store(B + k, fma(left, back_b, load(B + k)));
        store(T + k, Vec(1.0f) - left);
    }
    if (tile.whole)
        for_each_row(tile, view.width, [&](int k, size_t p) {
            for (int i = 0; i < 4; i++) {
                color[3 * (p + i)] = R[k + i];
                color[3 * (p + i) + 1] = G[k + i];
                color[3 * (p + i) + 2] = B[k + i];
            }
            std::memcpy(depth + p, D + k, 4 * sizeof(float));
            std::memcpy(alpha + p, T + k, 4 * sizeof(float));
        });
    else
        for_each_pixel(tile, view, [&](int k, size_t p) {
            color[3 * p] = R[k], color[3 * p + 1] = G[k], color[3 * p + 2] = B[k];
            depth[p] = D[k], alpha[p] = T[k];
        });
}

// ---------------------------------------------------------------- back to front

// What every backward sweep repeats for one block of one intersection: the same alpha as in front, and the
// transmittance before the Gaussian, from the one behind it.
struct BlockReplay {
    Vec x, y, alpha, weight;  // x, y: e
    Mask unclamped;  // alpha moves with the parameters only below ALPHA_MAX
    BlockReplay(const WideSplat& wide, int block, Vec position, const float* stop, float* T) {
        const int k = block * LANES;
        wide.place(block, x, y);
        const Vec log2_alpha = wide.log2_alpha(x, y);
        const Mask seen = (log2_alpha >= Vec(LOG2_ALPHA_MIN)) & (position < load(stop + k));
        const Vec raw = select_or_zero(seen, exp2(log2_alpha));
        alpha = min(raw, Vec(ALPHA_MAX));
        unclamped = raw < Vec(ALPHA_MAX);
        const Vec before = load(T + k) / (Vec(1.0f) - alpha);
        store(T + k, before);
        weight = alpha * before;
    }
};

// The list of one tile, walked from the last Gaussian to the first; T starts as the final transmittance.
struct TileReplay {
    const Tile tile;
    const uint32_t first, last;
    const float* stop;
    alignas(64) float T[TILE_PIXELS];
    TileReplay(const Frame& frame, int index)
        : tile(frame, index), first(frame.tile_start.data()[index]), last(frame.tile_start.data()[index + 1]),
          stop(frame.stop.data() + static_cast<size_t>(index) * TILE_PIXELS) {
        std::memcpy(T, frame.transmittance.data() + static_cast<size_t>(index) * TILE_PIXELS, sizeof T);
    }
    // Calls visit(row, splat, blocks, position in the list) from back to front.
    template <class Visit>
    void walk(const Frame& frame, Visit visit) {
        const uint32_t* list = frame.list_splats.data();
        const Splat* splats = frame.splats.data();
        for (uint32_t e = last; e-- > first;) {
            __builtin_prefetch(&splats[list[e > first + 8 ? e - 8 : first]]);
            visit(static_cast<size_t>(frame.list_rows.data()[e]), splats[list[e]], frame.list_blocks.data()[e],
                  Vec(static_cast<float>(e - first)));
        }
    }
};

// Sums of a gradient row, over the pixels of one intersection; w: cotangent of ln alpha, (X, Y) = e.
enum GradientSum { SUM_W, SUM_WX, SUM_WY, SUM_WXX, SUM_WXY, SUM_WYY, SUM_R, SUM_G, SUM_B, SUM_Z };

// Sums of an information row. w2: square of the derivative by ln alpha, over channels; Z: with depth's own.
enum InformationSum {
    INFO_XX, INFO_XY, INFO_YY, INFO_XXX, INFO_XXY, INFO_XYY, INFO_YYY,
    INFO_XXXX, INFO_XXXY, INFO_XXYY, INFO_XYYY, INFO_YYYY, INFO_1, INFO_R, INFO_G, INFO_B,
    INFO_ZX, INFO_ZY, INFO_ZXX, INFO_ZXY, INFO_ZYY, INFO_ZZ,
};

// Adds the twelve distinct monomials of the Gram matrix of (x, y, x^2, x y, y^2), and w2 itself.
inline void add_screen_moments(Vec w2, Vec x, Vec y, Vec* sums) {
    const Vec x2 = x * x, xy = x * y, y2 = y * y, w2xx = w2 * x2, w2yy = w2 * y2;
    sums[INFO_1] += w2;
    sums[INFO_XX] += w2xx;
    sums[INFO_XY] = fma(w2, xy, sums[INFO_XY]);
    sums[INFO_YY] += w2yy;
    sums[INFO_XXX] = fma(w2xx, x, sums[INFO_XXX]);
    sums[INFO_XXY] = fma(w2xx, y, sums[INFO_XXY]);
    sums[INFO_XYY] = fma(w2yy, x, sums[INFO_XYY]);
    sums[INFO_YYY] = fma(w2yy, y, sums[INFO_YYY]);
    sums[INFO_XXXX] = fma(w2xx, x2, sums[INFO_XXXX]);
    sums[INFO_XXXY] = fma(w2xx, xy, sums[INFO_XXXY]);
    sums[INFO_XXYY] = fma(w2xx, y2, sums[INFO_XXYY]);
    sums[INFO_XYYY] = fma(w2yy, xy, sums[INFO_XYYY]);
    sums[INFO_YYYY] = fma(w2yy, y2, sums[INFO_YYYY]);
}
// Adds the moments of the direct derivative of depth by z: its square, and its product with that by ln alpha.
inline void add_depth_moments(Vec cross, Vec square, Vec x, Vec y, Vec* sums) {
    const Vec cross_x = cross * x, cross_y = cross * y;
    sums[INFO_ZX] += cross_x;
    sums[INFO_ZY] += cross_y;
    sums[INFO_ZXX] = fma(cross_x, x, sums[INFO_ZXX]);
    sums[INFO_ZXY] = fma(cross_x, y, sums[INFO_ZXY]);
    sums[INFO_ZYY] = fma(cross_y, y, sums[INFO_ZYY]);
    sums[INFO_ZZ] += square;
}

// Which squared per-pixel gradients are summed beside the gradient itself. Depth enters the derivative by ln alpha in any case;
// its direct derivative by z costs six sums more, needed only where depth has a cotangent.
enum Squares { NO_SQUARES, COLOR_SQUARES, COLOR_AND_DEPTH_SQUARES };

// Gradient rows, and the information rows of the same cotangents.
template <Squares SQUARES>
inline Status gradient_tile(Frame& frame, int index, const float* d_color, const float* d_depth, const float* d_alpha) {
    alignas(64) float d_r[TILE_PIXELS], d_g[TILE_PIXELS], d_b[TILE_PIXELS], d_z[TILE_PIXELS], d_a[TILE_PIXELS];
    alignas(64) float behind[TILE_PIXELS];  // cotangent times what lies behind, composited
    TileReplay replay(frame, index);
    const View& view = frame.view;
    read_tile_rgb(d_color, replay.tile, view, d_r, d_g, d_b);
    read_tile_or_zero(d_depth, replay.tile, view, d_z);
    read_tile_or_zero(d_alpha, replay.tile, view, d_a);
    if (!(all_finite(d_r) && all_finite(d_g) && all_finite(d_b))) return Status::bad_first_image;
    if (!all_finite(d_z)) return Status::bad_second_image;
    if (!all_finite(d_a)) return Status::bad_third_image;
    const Vec back_r(view.background[0]), back_g(view.background[1]), back_b(view.background[2]);
    for (int k = 0; k < TILE_PIXELS; k += LANES)
        store(behind + k, fma(back_r, load(d_r + k), fma(back_g, load(d_g + k), back_b * load(d_b + k))));

    float *rows = frame.gradient_rows.data(), *rows16 = frame.information_rows16.data(), *rows8 = frame.information_rows8.data();
    replay.walk(frame, [&](size_t row, const Splat& splat, uint32_t blocks, Vec position) {
        if (!blocks) {
            store(rows + row * GRADIENT_SUMS, Vec(0.0f));
            if (SQUARES != NO_SQUARES) store(rows16 + row * 16, Vec(0.0f));
            if (SQUARES == COLOR_AND_DEPTH_SQUARES) std::memset(rows8 + row * 8, 0, 8 * sizeof(float));
            return;
        }
        Vec sums[GRADIENT_SUMS], info[INFORMATION_SUMS];
        for (Vec& sum : sums) sum = Vec(0.0f);
        for (Vec& sum : info) sum = Vec(0.0f);
        const WideSplat wide(splat, replay.tile);
        const Vec r(splat.r), g(splat.g), b(splat.b), z(splat.z);
        while (blocks) {
            const int block = __builtin_ctz(blocks), k = block * LANES;
            blocks &= blocks - 1;
            const BlockReplay pixel(wide, block, position, replay.stop, replay.T);
            const Vec v_r = load(d_r + k), v_g = load(d_g + k), v_b = load(d_b + k), v_z = load(d_z + k);
            const Vec own = fma(r, v_r, fma(g, v_g, fma(b, v_b, fma(z, v_z, load(d_a + k)))));
            const Vec old = load(behind + k), gain = own - old;
            store(behind + k, fma(pixel.alpha, gain, old));
            const Vec w = select_or_zero(pixel.unclamped, pixel.weight * gain);
            const Vec x = w * pixel.x, y = w * pixel.y;
            sums[SUM_W] += w;
            sums[SUM_WX] += x;
            sums[SUM_WY] += y;
            sums[SUM_WXX] = fma(x, pixel.x, sums[SUM_WXX]);
            sums[SUM_WXY] = fma(x, pixel.y, sums[SUM_WXY]);
            sums[SUM_WYY] = fma(y, pixel.y, sums[SUM_WYY]);
            sums[SUM_R] = fma(pixel.weight, v_r, sums[SUM_R]);
            sums[SUM_G] = fma(pixel.weight, v_g, sums[SUM_G]);
            sums[SUM_B] = fma(pixel.weight, v_b, sums[SUM_B]);
            sums[SUM_Z] = fma(pixel.weight, v_z, sums[SUM_Z]);
            if (SQUARES != NO_SQUARES) {
                const Vec weight2 = pixel.weight * pixel.weight;
                add_screen_moments(w * w, pixel.x, pixel.y, info);
                info[INFO_R] = fma(weight2, v_r * v_r, info[INFO_R]);
                info[INFO_G] = fma(weight2, v_g * v_g, info[INFO_G]);
                info[INFO_B] = fma(weight2, v_b * v_b, info[INFO_B]);
            }
            if (SQUARES == COLOR_AND_DEPTH_SQUARES) {
                const Vec by_z = pixel.weight * v_z;
                add_depth_moments(by_z * w, by_z * by_z, pixel.x, pixel.y, info);
            }
        }
        store_sums16(rows + row * GRADIENT_SUMS, sums);
        if (SQUARES != NO_SQUARES) store_sums16(rows16 + row * 16, info);
        if (SQUARES == COLOR_AND_DEPTH_SQUARES) store_sums8(rows8 + row * 8, info + 16);
    });
    return Status::ok;
}

// Information rows of J^T R^-1 J: each colour channel and depth has its own "behind", for their derivatives are squared
// one by one. inv_var: 1/sigma^2 per pixel, of every colour channel and of depth.
inline Status information_tile(Frame& frame, int index, const float* inv_var_color, const float* inv_var_depth) {
    alignas(64) float behind_r[TILE_PIXELS], behind_g[TILE_PIXELS], behind_b[TILE_PIXELS], behind_z[TILE_PIXELS];
    alignas(64) float weight_color[TILE_PIXELS], weight_depth[TILE_PIXELS];
    TileReplay replay(frame, index);
    const View& view = frame.view;
    read_tile(inv_var_color, replay.tile, view, weight_color);
    read_tile(inv_var_depth, replay.tile, view, weight_depth);
    if (!all_finite_not_negative(weight_color)) return Status::bad_first_image;
    if (!all_finite_not_negative(weight_depth)) return Status::bad_second_image;
    fill_tile(behind_r, view.background[0]);
    fill_tile(behind_g, view.background[1]);
    fill_tile(behind_b, view.background[2]);
    fill_tile(behind_z, 0.0f);

    float *rows16 = frame.information_rows16.data(), *rows8 = frame.information_rows8.data();
    replay.walk(frame, [&](size_t row, const Splat& splat, uint32_t blocks, Vec position) {
        if (!blocks) {
            store(rows16 + row * 16, Vec(0.0f));
            std::memset(rows8 + row * 8, 0, 8 * sizeof(float));
            return;
        }
        Vec info[INFORMATION_SUMS];
        for (Vec& sum : info) sum = Vec(0.0f);
        const WideSplat wide(splat, replay.tile);
        const Vec r(splat.r), g(splat.g), b(splat.b), z(splat.z);
        while (blocks) {
            const int block = __builtin_ctz(blocks), k = block * LANES;
            blocks &= blocks - 1;
            const BlockReplay pixel(wide, block, position, replay.stop, replay.T);
            // d channel / d ln alpha = weight (own value - composited value behind)
            auto gain_over = [&](float* behind, Vec own) {
                const Vec old = load(behind + k), gain = own - old;
                store(behind + k, fma(pixel.alpha, gain, old));
                return gain;
            };
            const Vec gain_r = gain_over(behind_r, r), gain_g = gain_over(behind_g, g), gain_b = gain_over(behind_b, b);
            const Vec gain_z = gain_over(behind_z, z);
            const Vec of_color = load(weight_color + k), of_depth = load(weight_depth + k);
            const Vec weight2 = pixel.weight * pixel.weight, moving2 = select_or_zero(pixel.unclamped, weight2);
            const Vec color2 = fma(gain_r, gain_r, fma(gain_g, gain_g, gain_b * gain_b));
            const Vec depth_gain = of_depth * gain_z;
            add_screen_moments(moving2 * fma(of_color, color2, depth_gain * gain_z), pixel.x, pixel.y, info);
            add_depth_moments(moving2 * depth_gain, of_depth * weight2, pixel.x, pixel.y, info);
            info[INFO_R] = fma(weight2, of_color, info[INFO_R]);  // the same for green and blue
        }
        store_sums16(rows16 + row * 16, info);
        store_sums8(rows8 + row * 8, info + 16);
    });
    return Status::ok;
}

// Sum of weights and number of pixels of every intersection, as a row of sixteen.
inline void contribution_tile(Frame& frame, int index) {
    TileReplay replay(frame, index);
    float* rows = frame.gradient_rows.data();
    replay.walk(frame, [&](size_t row, const Splat& splat, uint32_t blocks, Vec position) {
        Vec sums[8];
        for (Vec& sum : sums) sum = Vec(0.0f);
        const WideSplat wide(splat, replay.tile);
        while (blocks) {
            const int block = __builtin_ctz(blocks);
            blocks &= blocks - 1;
            const BlockReplay pixel(wide, block, position, replay.stop, replay.T);
            sums[0] += pixel.weight;
            sums[1] += select_or_zero(Vec(0.0f) < pixel.weight, Vec(1.0f));
        }
        store_sums8(rows + row * GRADIENT_SUMS, sums);
    });
}

}  // namespace KERNEL_ISA
