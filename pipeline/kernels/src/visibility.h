// Which Gaussian touches which 4x4 block of which tile, in order of depth.
#pragma once

#include "projection.h"

namespace KERNEL_ISA {

constexpr uint32_t NOT_DRAWN = 0xffffffffu;

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
alignas(64) static constexpr BlockOffsets BLOCK_OF_TILE(4);   // block -> its first pixel within the tile

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
inline Parameters16 gather_parameters(const GaussianArrays& gaussians, const uint32_t* ids) {
    Parameters16 p;
    gather<3>(gaussians.means, ids, p.mean);
    gather<4>(gaussians.quats_wxyz, ids, p.quat);
    gather<3>(gaussians.log_scales, ids, p.log_scale);
    gather<1>(gaussians.opacity_logits, ids, &p.logit);
    return p;
}

constexpr float LARGEST_LOG_SCALE = 40.0f;  // of metres; the square of a scale beyond would overflow

// All numbers finite, all quaternions of a length whose square is neither 0 nor infinite.
inline bool usable(const Parameters16& p, const Vec* color) {
    const Vec zero(0.0f);
    Vec sum = p.logit * zero, norm2 = zero, largest = p.log_scale[0];
    for (int k = 0; k < 3; k++) {
        sum = sum + (p.mean[k] * zero + p.log_scale[k] * zero) + color[k] * zero;
        largest = max(p.log_scale[k], largest);
    }
    for (int k = 0; k < 4; k++) norm2 = fma(p.quat[k], p.quat[k], norm2);
    return bits((sum >= zero) & (norm2 >= Vec(1e-30f)) & (norm2 <= Vec(1e30f)) & (largest <= Vec(LARGEST_LOG_SCALE))) ==
           0xffffu;
}

// One Splat and one depth key per Gaussian; false if a parameter is not usable.
inline bool project_all(Frame& frame, const GaussianArrays& gaussians) {
    const View& view = frame.view;
    const int count = static_cast<int>(gaussians.count), groups = (count + LANES - 1) / LANES;
    Splat* splats = frame.splats_by_id.need(count);
    uint32_t* keys = frame.keys.need(count);
    int unusable = 0;
#pragma omp parallel for schedule(static) num_threads(frame.threads) reduction(+ : unusable) if (frame.threads > 1)
    for (int group = 0; group < groups; group++) {
        const int first = group * LANES, lanes = smaller(LANES, count - first);
        uint32_t ids[LANES];
        for (int lane = 0; lane < LANES; lane++) ids[lane] = first + (lane < lanes ? lane : 0);
        const Parameters16 p = gather_parameters(gaussians, ids);
        Vec color[3];
        gather<3>(gaussians.colors, ids, color);
        if (!usable(p, color)) unusable++;
        const Splat16 s = project16(view, p.mean, p.quat, p.log_scale);

        const Vec log2_opacity = log2_sigmoid(p.logit);
        // alpha >= 1/255 is an ellipse in a box of half size sqrt(2 ln(255 opacity) cov_ii)
        const Vec reach = max(log2_opacity - Vec(LOG2_ALPHA_MIN), Vec(0.0f)) * Vec(2.0f * LN_2);
        const Vec extent_x = sqrt(reach * s.cov_xx), extent_y = sqrt(reach * s.cov_yy), zero(0.0f);
        const Mask drawn = s.drawable & (log2_opacity >= Vec(LOG2_ALPHA_MIN)) & (s.u + extent_x >= zero) &
                           (s.u - extent_x <= Vec(view.width - 1.0f)) & (s.v + extent_y >= zero) &
                           (s.v - extent_y <= Vec(view.height - 1.0f));
        const uint32_t drawn_bits = bits(drawn);

        alignas(64) float field[9][LANES];
        store(field[0], s.u);
        store(field[1], s.v);
        store(field[2], s.M11);
        store(field[3], s.M12);
        store(field[4], s.M22);
        store(field[5], log2_opacity);
        store(field[6], s.z);
        store(field[7], extent_x);
        store(field[8], extent_y);
        for (int lane = 0; lane < lanes; lane++) {
            const uint32_t id = first + lane;
            if (!(drawn_bits >> lane & 1)) {
                keys[id] = NOT_DRAWN;
                continue;
            }
            const float* color = gaussians.colors + 3 * static_cast<size_t>(id);
            Splat& splat = splats[id];
            splat.u = field[0][lane];
            splat.v = field[1][lane];
            splat.M11 = field[2][lane];
            splat.M12 = field[3][lane];
            splat.M22 = field[4][lane];
            splat.log2_opacity = field[5][lane];
            splat.r = color[0];
            splat.g = color[1];
            splat.b = color[2];
            splat.z = field[6][lane];
            splat.extent_x = field[7][lane];
            splat.extent_y = field[8][lane];
            std::memcpy(&keys[id], &splat.z, sizeof(float));  // positive floats order like their bits
        }
    }
    return unusable == 0;
}

// Stable radix sort of the drawn Gaussians by depth: 3 passes of 11 bits; equal depths keep the order of the arrays.
inline void sort_by_depth(Frame& frame, size_t count) {
    constexpr int RADIX_BITS = 11, PASSES = 3, BUCKETS = 1 << RADIX_BITS;
    uint32_t* keys = frame.keys.data();
    uint32_t *keys_from = frame.keys_swap.need(count), *order_from = frame.order_swap.need(count);
    uint32_t *keys_to = keys, *order_to = frame.order.need(count);
    uint32_t histogram[PASSES][BUCKETS];
    std::memset(histogram, 0, sizeof histogram);
    size_t visible = 0;
    for (size_t i = 0; i < count; i++) {
        const uint32_t key = keys[i];
        if (key == NOT_DRAWN) continue;
        keys_from[visible] = key;
        order_from[visible++] = static_cast<uint32_t>(i);
        for (int pass = 0; pass < PASSES; pass++) histogram[pass][key >> RADIX_BITS * pass & (BUCKETS - 1)]++;
    }
    for (auto& counts : histogram) {
        uint32_t start = 0;
        for (uint32_t& bucket : counts) {
            const uint32_t size = bucket;
            bucket = start;
            start += size;
        }
    }
    for (int pass = 0; pass < PASSES; pass++) {  // an odd number of passes ends in frame.order
        for (size_t i = 0; i < visible; i++) {
            const uint32_t key = keys_from[i], place = histogram[pass][key >> RADIX_BITS * pass & (BUCKETS - 1)]++;
            keys_to[place] = key;
            order_to[place] = order_from[i];
        }
        uint32_t *keys_swap = keys_from, *order_swap = order_from;
        keys_from = keys_to, order_from = order_to, keys_to = keys_swap, order_to = order_swap;
    }
    frame.visible = visible;
}

// Bit b is set if some pixel of 4x4 block b of the tile can lie inside the ellipse alpha >= 1/255. Exact but for a
// slack of 1e-4: the minimum of |e|^2 over the box of a block's pixel centres lies on the edges nearest the centre.
struct BlockTest {
    Vec M11, M12, M22, best_x_per_y, best_y_per_x, reach;  // where |e|^2 is least along a row, along a column
    float u, v;
    explicit BlockTest(const Splat& s)
        : M11(s.M11), M12(s.M12), M22(s.M22), best_x_per_y(-s.M12 / s.M11),
          best_y_per_x(-s.M11 * s.M12 / (s.M12 * s.M12 + s.M22 * s.M22)),
          reach(s.log2_opacity - LOG2_ALPHA_MIN + 1e-4f), u(s.u), v(s.v) {}

    Vec squared_distance(Vec dx, Vec dy) const {
        const Vec x = fma(M11, dx, M12 * dy), y = M22 * dy;
        return fma(x, x, y * y);
    }

    uint32_t operator()(int tile_x, int tile_y) const {
        const Vec zero(0.0f), side(3.0f);
        const Vec x0 = load(BLOCK_OF_TILE.x) + Vec(tile_x * TILE - u), x1 = x0 + side;
        const Vec y0 = load(BLOCK_OF_TILE.y) + Vec(tile_y * TILE - v), y1 = y0 + side;
        const Vec near_x = min(max(zero, x0), x1), near_y = min(max(zero, y0), y1);
        const Vec best_x = min(max(best_x_per_y * near_y, x0), x1), best_y = min(max(best_y_per_x * near_x, y0), y1);
        return bits(min(squared_distance(near_x, best_y), squared_distance(best_x, near_y)) <= reach);
    }
};

struct PixelRange {
    int first, last;  // last included; empty if last < first
};
inline PixelRange pixel_range(float centre, float extent, int size) {
    const float first = __builtin_ceilf(centre - extent), last = __builtin_floorf(centre + extent);
    return {first > 0.0f ? static_cast<int>(first) : 0,
            last < size - 1.0f ? static_cast<int>(last) : size - 1};  // both lie on the screen: drawn splats overlap it
}

// Intersections of the splats of one chunk of the depth order; returns how many.
inline size_t bin_chunk(Frame& frame, int chunk) {
    const size_t first = frame.visible * chunk / DEPTH_CHUNKS, last = frame.visible * (chunk + 1) / DEPTH_CHUNKS;
    const int tiles = frame.tiles_x * frame.tiles_y;
    const uint32_t* order = frame.order.data();
    const Splat* by_id = frame.splats_by_id.data();
    Splat* splats = frame.splats.data();
    uint32_t *counts = frame.chunk_tile_counts.data() + static_cast<size_t>(chunk) * tiles, *rows = frame.first_row.data();
    Scratch<BinRecord>& memory = frame.chunk_records[chunk];
    std::memset(counts, 0, sizeof(uint32_t) * tiles);
    size_t total = 0;
    for (size_t i = first; i < last; i++) {
        if (i + 12 < last) __builtin_prefetch(&by_id[order[i + 12]]);
        const Splat splat = splats[i] = by_id[order[i]];
        const PixelRange x = pixel_range(splat.u, splat.extent_x, frame.view.width);
        const PixelRange y = pixel_range(splat.v, splat.extent_y, frame.view.height);
        const size_t before = total;
        if (x.first <= x.last && y.first <= y.last) {
            const int tx0 = x.first / TILE, tx1 = x.last / TILE, ty0 = y.first / TILE, ty1 = y.last / TILE;
            BinRecord* records = memory.need_keeping(total + static_cast<size_t>(tx1 - tx0 + 1) * (ty1 - ty0 + 1), total);
            const BlockTest blocks_of(splat);
            for (int ty = ty0; ty <= ty1; ty++)
                for (int tx = tx0; tx <= tx1; tx++) {
                    const uint32_t blocks = blocks_of(tx, ty), tile = ty * frame.tiles_x + tx;
                    if (!blocks) continue;
                    records[total++] = {tile, blocks};
                    counts[tile]++;
                }
        }
        rows[i] = static_cast<uint32_t>(total - before);
    }
    return total;
}

// Lists of intersections per tile in order of depth. Chunks of the depth order are fixed, so every list is the same
// for any number of threads. A splat's rows are contiguous: its sums are a streaming pass in a fixed order.
inline Status bin(Frame& frame) {
    frame.tiles_x = (frame.view.width + TILE - 1) / TILE;
    frame.tiles_y = (frame.view.height + TILE - 1) / TILE;
    const int tiles = frame.tiles_x * frame.tiles_y;
    frame.splats.need(frame.visible + 1);
    uint32_t* rows = frame.first_row.need(frame.visible + 1);
    uint32_t* counts = frame.chunk_tile_counts.need(static_cast<size_t>(DEPTH_CHUNKS) * tiles);
    uint32_t* tile_start = frame.tile_start.need(tiles + 1);
    size_t chunk_size[DEPTH_CHUNKS] = {}, total = 0;
    int out_of_memory = 0;
#pragma omp parallel for schedule(dynamic, 1) num_threads(frame.threads) reduction(+ : out_of_memory) \
    if (frame.threads > 1)
    for (int chunk = 0; chunk < DEPTH_CHUNKS; chunk++) {
        try {
            chunk_size[chunk] = bin_chunk(frame, chunk);
        } catch (...) {  // an exception must not leave a parallel loop
            out_of_memory++;
        }
    }
    for (size_t size : chunk_size) total += size;
    if (out_of_memory || total > 0x7fffffffu) return Status::too_many_intersections;

    uint32_t start = 0;
    for (int tile = 0; tile < tiles; tile++) {
        tile_start[tile] = start;
        for (int chunk = 0; chunk < DEPTH_CHUNKS; chunk++) {
            uint32_t& count = counts[static_cast<size_t>(chunk) * tiles + tile];
            const uint32_t size = count;
            count = start;  // from here on: where the chunk's next intersection of this tile goes
            start += size;
        }
    }
    tile_start[tiles] = start;
    uint32_t row = 0;
    for (size_t i = 0; i < frame.visible; i++) {
        const uint32_t size = rows[i];
        rows[i] = row;
        row += size;
    }
    rows[frame.visible] = row;

    uint32_t *list_splats = frame.list_splats.need(total + LIST_SPARE), *list_rows = frame.list_rows.need(total + LIST_SPARE);
    uint16_t* list_blocks = frame.list_blocks.need(total + LIST_SPARE);
#pragma omp parallel for schedule(dynamic, 1) num_threads(frame.threads) if (frame.threads > 1)
    for (int chunk = 0; chunk < DEPTH_CHUNKS; chunk++) {
        const size_t first = frame.visible * chunk / DEPTH_CHUNKS, last = frame.visible * (chunk + 1) / DEPTH_CHUNKS;
        uint32_t* place = counts + static_cast<size_t>(chunk) * tiles;
        const BinRecord* record = frame.chunk_records[chunk].data();
        for (size_t i = first; i < last; i++)
            for (uint32_t r = rows[i]; r < rows[i + 1]; r++, record++) {
                const uint32_t p = place[record->tile]++;
                list_splats[p] = static_cast<uint32_t>(i);
                list_rows[p] = r;
                list_blocks[p] = static_cast<uint16_t>(record->blocks);
            }
    }
    for (size_t p = total; p < total + LIST_SPARE; p++) list_splats[p] = list_rows[p] = list_blocks[p] = 0;
    frame.intersection_count = total;
    return Status::ok;
}

}  // namespace KERNEL_ISA
