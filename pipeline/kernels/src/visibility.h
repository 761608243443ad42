// Which Gaussian touches which 4x4 block of which tile, in order of depth.
//
//   project_all     every Gaussian to a Splat; a key of depth and index for the drawn ones
//   sort_by_depth   the drawn ones by depth
//   bin             lists of tiles, and rows for the sums of every Gaussian
// Nothing here depends on the number of threads: where the work is cut by it, the cut does not show in the result.
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

// ---------------------------------------------------------------- projection

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

// Sixteen neighbours in the caller's arrays; behind the last Gaussian, copies of the first of them.
struct Neighbours16 {
    Parameters16 p;
    Vec color[3];
    Neighbours16(const GaussianArrays& gaussians, size_t first) {
        if (first + LANES <= gaussians.count) {
            load_rows3(gaussians.means + 3 * first, p.mean);
            load_rows4(gaussians.quats_wxyz + 4 * first, p.quat);
            load_rows3(gaussians.log_scales + 3 * first, p.log_scale);
            load_rows3(gaussians.colors + 3 * first, color);
            p.logit = load_unaligned(gaussians.opacity_logits + first);
            return;
        }
        uint32_t ids[LANES];
        for (size_t lane = 0; lane < LANES; lane++)
            ids[lane] = static_cast<uint32_t>(first + lane < gaussians.count ? first + lane : first);
        p = gather_parameters(gaussians, ids);
        gather<3>(gaussians.colors, ids, color);
    }
};

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

// Some part of a box around the centre may lie on the screen.
inline Mask on_screen(const View& view, Vec u, Vec v, Vec extent_x, Vec extent_y) {
    const Vec zero(0.0f);
    return (u + extent_x >= zero) & (u - extent_x <= Vec(view.width - 1.0f)) & (v + extent_y >= zero) &
           (v - extent_y <= Vec(view.height - 1.0f));
}

constexpr float ALPHA_SLACK = 1e-4f;  // of log2 alpha; more than the rounding of the loops over pixels

// Writes the splats first.. and appends the keys of the drawn ones; returns how many.
__attribute__((flatten)) inline uint32_t project_group(const View& view, const Neighbours16& g, size_t first, int lanes, Splat* splats,
                                                       uint64_t* keys) {
    const Splat16 s = project16(view, g.p.mean, g.p.quat, g.p.log_scale);
    const Vec log2_opacity = log2_sigmoid(g.p.logit), zero(0.0f);
    // alpha >= 1/255 is an ellipse in a box of half size sqrt(2 ln(255 opacity) cov_ii)
    const Vec reach = max(log2_opacity - Vec(LOG2_ALPHA_MIN - ALPHA_SLACK), zero) * Vec(2.0f * LN_2);
    const Vec extent_x = sqrt(reach * s.cov_xx), extent_y = sqrt(reach * s.cov_yy);
    // C = (M^T M)^-1 up to a factor, so c = -M12 / |(M12, M22)|
    const Vec length = sqrt(fma(s.M12, s.M12, s.M22 * s.M22));
    const Mask drawn = s.drawable & (log2_opacity >= Vec(LOG2_ALPHA_MIN)) & on_screen(view, s.u, s.v, extent_x, extent_y);
    const uint32_t drawn_bits = bits(drawn) & ((1u << lanes) - 1);
    if (!drawn_bits) return 0;

    const Vec columns[16] = {s.u, s.v, s.M11, s.M12, s.M22, log2_opacity, g.color[0], g.color[1], g.color[2], s.z,
                             extent_x, extent_y, -s.M12 / length, s.M22 / length, zero, zero};
    store_rows16(reinterpret_cast<float*>(splats + first), columns);
    alignas(64) uint32_t depth_bits[LANES];  // positive floats order like their bits
    store(reinterpret_cast<float*>(depth_bits), s.z);
    uint32_t count = 0;
    for (int lane = 0; lane < LANES; lane++) {
        keys[count] = static_cast<uint64_t>(depth_bits[lane]) << 32 | (first + lane);
        count += drawn_bits >> lane & 1;
    }
    return count;
}

constexpr size_t PROJECTION_CHUNK = 32 * LANES;
inline size_t projection_chunks(size_t count) { return (count + PROJECTION_CHUNK - 1) / PROJECTION_CHUNK; }

// One Splat per Gaussian, and the keys of the drawn ones of every chunk at the beginning of its part of depth_keys_swap;
// false if a parameter is not usable.
inline bool project_all(Frame& frame, const GaussianArrays& gaussians) {
    const size_t count = gaussians.count, chunks = projection_chunks(count);
    Splat* splats = frame.splats.need(chunks * PROJECTION_CHUNK);
    uint64_t* keys = frame.depth_keys_swap.need(chunks * PROJECTION_CHUNK);
    uint32_t* drawn_of_chunk = frame.chunk_start.need(chunks + 1);
    int unusable = 0;
#pragma omp parallel for schedule(dynamic, 1) num_threads(frame.threads) reduction(+ : unusable) if (frame.threads > 1)
    for (size_t chunk = 0; chunk < chunks; chunk++) {
        const size_t begin = chunk * PROJECTION_CHUNK, end = begin + PROJECTION_CHUNK < count ? begin + PROJECTION_CHUNK : count;
        uint64_t* next = keys + begin;
        for (size_t first = begin; first < end; first += LANES) {
            const Neighbours16 g(gaussians, first);
            if (!usable(g.p, g.color)) unusable++;
            next += project_group(frame.view, g, first, static_cast<int>(end - first < LANES ? end - first : LANES), splats, next);
        }
        drawn_of_chunk[chunk] = static_cast<uint32_t>(next - (keys + begin));
    }
    return unusable == 0;
}

// ---------------------------------------------------------------- depth order

constexpr int RADIX_BITS = 11, RADIX_BUCKETS = 1 << RADIX_BITS;

// First element of part `part` of `parts` nearly equal parts of n.
inline size_t part_begin(size_t n, int part, int parts) { return n * static_cast<size_t>(part) / static_cast<size_t>(parts); }

// One stable pass of a radix sort by the bits shift..; write(place, key) takes every key to its place.
template <class Write>
inline void radix_pass(Frame& frame, const uint64_t* keys, int shift, Write write) {
    const int parts = frame.threads;
    const size_t n = frame.drawn_count;
    uint32_t* counts = frame.radix_counts.need(static_cast<size_t>(parts) * RADIX_BUCKETS);
    const auto bucket = [shift](uint64_t key) { return key >> shift & (RADIX_BUCKETS - 1); };
#pragma omp parallel for schedule(static, 1) num_threads(frame.threads) if (frame.threads > 1)
    for (int part = 0; part < parts; part++) {
        uint32_t* count = counts + static_cast<size_t>(part) * RADIX_BUCKETS;
        std::memset(count, 0, sizeof(uint32_t) * RADIX_BUCKETS);
        for (size_t i = part_begin(n, part, parts); i < part_begin(n, part + 1, parts); i++) count[bucket(keys[i])]++;
    }
    uint32_t start = 0;
    for (int b = 0; b < RADIX_BUCKETS; b++)
        for (int part = 0; part < parts; part++) {
            uint32_t& count = counts[static_cast<size_t>(part) * RADIX_BUCKETS + b];
            const uint32_t size = count;
            count = start;  // from here on: where the part's next key of this bucket goes
            start += size;
        }
#pragma omp parallel for schedule(static, 1) num_threads(frame.threads) if (frame.threads > 1)
    for (int part = 0; part < parts; part++) {
        uint32_t* place = counts + static_cast<size_t>(part) * RADIX_BUCKETS;
        for (size_t i = part_begin(n, part, parts); i < part_begin(n, part + 1, parts); i++) write(place[bucket(keys[i])]++, keys[i]);
    }
}

// Drawn Gaussians by depth, equal depths in the order of the arrays.
inline void sort_by_depth(Frame& frame, size_t gaussians) {
    const size_t chunks = projection_chunks(gaussians);
    uint32_t *start = frame.chunk_start.data(), total = 0;
    for (size_t chunk = 0; chunk < chunks; chunk++) {
        const uint32_t size = start[chunk];
        start[chunk] = total;
        total += size;
    }
    start[chunks] = total;
    frame.drawn_count = total;
    uint64_t *swap = frame.depth_keys_swap.data(), *keys = frame.depth_keys.need(total);
    uint32_t *drawn = frame.drawn.need(total), *order = frame.depth_order.need(total + 1);
#pragma omp parallel for schedule(static) num_threads(frame.threads) if (frame.threads > 1)
    for (size_t chunk = 0; chunk < chunks; chunk++) {  // close the gaps between the chunks
        const uint64_t* from = swap + chunk * PROJECTION_CHUNK;
        for (uint32_t i = start[chunk]; i < start[chunk + 1]; i++, from++) {
            keys[i] = *from;
            drawn[i] = static_cast<uint32_t>(*from);
        }
    }
    radix_pass(frame, keys, 32, [swap](uint32_t place, uint64_t key) { swap[place] = key; });
    radix_pass(frame, swap, 32 + RADIX_BITS, [keys](uint32_t place, uint64_t key) { keys[place] = key; });
    radix_pass(frame, keys, 32 + 2 * RADIX_BITS, [order](uint32_t place, uint64_t key) { order[place] = static_cast<uint32_t>(key); });
}

// ---------------------------------------------------------------- lists of tiles

// Per tile, which blocks have a pixel that lies in the image and is wanted by the mask. Behind the rows of tiles and below
// them lie tiles without any.
inline int wanted_stride(const Frame& frame) { return frame.tiles_x + 3; }
inline void find_wanted_blocks(Frame& frame) {
    const View& view = frame.view;
    const size_t stride = wanted_stride(frame), size = stride * (frame.tiles_y + 1);
    uint16_t* wanted = frame.wanted_blocks.need(size);
    std::memset(wanted, 0, size * sizeof(uint16_t));
    const auto wants = [&](int x0, int y0) {
        if (!view.mask) return x0 < view.width && y0 < view.height;
        uint32_t any = 0;
        for (int y = y0; y < smaller(y0 + 4, view.height); y++) {
            const uint8_t* row = view.mask + static_cast<size_t>(y) * view.width;
            for (int x = x0; x < smaller(x0 + 4, view.width); x++) any |= row[x];
        }
        return any != 0;
    };
    for (int ty = 0; ty < frame.tiles_y; ty++)
        for (int tx = 0; tx < frame.tiles_x; tx++) {
            uint32_t blocks = 0;
            if (!view.mask && (tx + 1) * TILE <= view.width && (ty + 1) * TILE <= view.height)
                blocks = 0xffff;
            else
                for (int b = 0; b < 16; b++) blocks |= static_cast<uint32_t>(wants(tx * TILE + b % 4 * 4, ty * TILE + b / 4 * 4)) << b;
            wanted[ty * stride + tx] = static_cast<uint16_t>(blocks);
        }
}

struct TileBox {
    int x0, x1, y0, y1;  // last included; empty if x1 < x0 or y1 < y0
};
inline TileBox tile_box(const View& view, const Splat& s) {
    const auto tile_of = [](float pixel, int pixels) {
        const float last = static_cast<float>(pixels - 1), inside = pixel < last ? pixel : last;
        return static_cast<int>(inside > 0.0f ? inside : 0.0f) / TILE;
    };
    return {tile_of(s.u - s.extent_x + 1.0f, view.width), tile_of(s.u + s.extent_x, view.width),  // + 1: up, if only by part of a pixel
            tile_of(s.v - s.extent_y + 1.0f, view.height), tile_of(s.v + s.extent_y, view.height)};
}

// Four tiles side by side in each of two rows of tiles, to be tested against one splat.
struct Window {
    uint32_t splat;
    uint16_t tile_x, tile_y;
    uint32_t opens;  // first window of its splat
};

// The ellipse of a splat, in units of its extents X, Y, is dx / X = c t + sqrt(1 - c^2) sqrt(1 - t^2) on its right side,
// with t = dy / Y, and the same with a minus on its left. It is convex: within a row of blocks it covers what lies
// between the largest right and the least left, at t = c and t = -c or at the edge of the row next to these.
struct SideLanes {  // eight rows of blocks: their right sides, then their left sides
    alignas(64) float row[LANES], side[LANES], round[LANES];
    constexpr SideLanes() : row(), side(), round() {
        for (int lane = 0; lane < LANES; lane++) {
            row[lane] = static_cast<float>(lane % 8 * 4);
            side[lane] = lane < 8 ? 1.0f : -1.0f;
            round[lane] = lane < 8 ? 1.0f : 0.25f;  // blocks that begin before x: x/4 + 1; that end before x: (x - 3)/4 + 1
        }
    }
};
alignas(64) static constexpr SideLanes SIDE_LANES;

// Blocks that the ellipse touches, a word for each tile of the window.
inline Words8 touched_blocks(const Splat& s, const Window& w) {
    const float per_pixel = 1.0f / s.extent_y;
    const Vec side = load(SIDE_LANES.side), skew(s.skew);
    const Vec top = fma(load(SIDE_LANES.row), Vec(per_pixel), Vec((w.tile_y * TILE - s.v) * per_pixel));
    const Vec bottom = top + Vec(3.0f * per_pixel);
    const Vec t = min(max(side * skew, top), bottom);
    const Vec half_width = sqrt(fnma(t, t, Vec(1.0f)));  // not a number outside of the ellipse
    const Vec x = fma(skew, t, Vec(s.upright) * side * half_width);
    const Vec blocks = fma(x, Vec(0.25f * s.extent_x), load(SIDE_LANES.round) + Vec(0.25f * (s.u - w.tile_x * TILE)));
    return transpose_nibbles(bits_between(min(max(blocks, Vec(0.0f)), Vec(16.0f))));
}

constexpr int WINDOWS = 256;  // tested side by side
constexpr uint32_t LARGEST_INTERSECTIONS = 1u << 27;

// Tests windows and appends what they find.
inline void list_windows(Frame& frame, const Window* windows, int count, StretchRecords& records, uint32_t* counts) {
    const Splat* splats = frame.splats.data();
    const uint16_t* wanted = frame.wanted_blocks.data();
    const uint32_t wanted_row = wanted_stride(frame), tile_row = frame.tiles_x;
    RowRange* ranges = frame.row_ranges.data();
    const size_t before = records.count;
    uint32_t* tiles = records.tiles.need_keeping(before + 8 * count, before);
    uint32_t* splat_of = records.splats.need_keeping(before + 8 * count, before);
    uint16_t* blocks = records.blocks.need_keeping(before + 8 * count, before);
    size_t total = before, opened = records.opened;
    for (int i = 0; i < count; i++) {
        const Window& w = windows[i];
        const uint16_t* want = wanted + static_cast<size_t>(w.tile_y) * wanted_row + w.tile_x;
        const Words8 touched = masked(touched_blocks(splats[w.splat], w), want, want + wanted_row);
        opened = w.opens ? total : opened;
        for (int k = 0; k < 8; k++) splat_of[total + k] = w.splat;
        total += store_nonzero(touched, w.tile_y * tile_row + w.tile_x, tile_row, blocks + total, tiles + total);
        ranges[w.splat] = {static_cast<uint32_t>(opened), static_cast<uint32_t>(total - opened)};
    }
    for (size_t r = before; r < total; r++) counts[tiles[r]]++;
    records.count = total;
    records.opened = opened;
}

// Intersections of the splats first..last of the depth order.
inline void list_stretch(Frame& frame, size_t first, size_t last, StretchRecords& records, uint32_t* counts) {
    const uint32_t* order = frame.depth_order.data();
    const Splat* splats = frame.splats.data();
    RowRange* ranges = frame.row_ranges.data();
    std::memset(counts, 0, sizeof(uint32_t) * frame.tiles_x * frame.tiles_y);
    Window windows[WINDOWS];
    int waiting = 0;
    records.count = 0;
    for (size_t i = first; i < last; i++) {
        if (i + 24 < last) __builtin_prefetch(&splats[order[i + 24]]);
        const uint32_t id = order[i];
        ranges[id] = {0, 0};
        const TileBox box = tile_box(frame.view, splats[id]);
        uint32_t opens = 1;
        for (int y = box.y0; y <= box.y1; y += 2)
            for (int x = box.x0; x <= box.x1; x += 4) {
                windows[waiting++] = {id, static_cast<uint16_t>(x), static_cast<uint16_t>(y), opens};
                opens = 0;
                if (waiting == WINDOWS) {
                    list_windows(frame, windows, waiting, records, counts);
                    waiting = 0;
                }
            }
    }
    list_windows(frame, windows, waiting, records, counts);
}

// Lists of tiles in order of depth, and the rows of every Gaussian: contiguous, and in the order of the arrays, so that
// its sums are a streaming pass in a fixed order.
inline Status bin(Frame& frame) {
    frame.tiles_x = (frame.view.width + TILE - 1) / TILE;
    frame.tiles_y = (frame.view.height + TILE - 1) / TILE;
    const int tiles = frame.tiles_x * frame.tiles_y;
    const size_t drawn = frame.drawn_count;
    const int stretches = frame.threads > 1 ? smaller(4 * frame.threads, MOST_STRETCHES) : 1;
    find_wanted_blocks(frame);
    uint32_t* counts = frame.stretch_tile_counts.need(static_cast<size_t>(stretches) * tiles);
    uint32_t* tile_start = frame.tile_start.need(tiles + 1);
    uint32_t most_id = drawn ? frame.drawn.data()[drawn - 1] : 0;
    RowRange* ranges = frame.row_ranges.need(most_id + 1);
    int out_of_memory = 0;
#pragma omp parallel for schedule(dynamic, 1) num_threads(frame.threads) reduction(+ : out_of_memory) \
    if (frame.threads > 1)
    for (int k = 0; k < stretches; k++) {
        try {
            list_stretch(frame, part_begin(drawn, k, stretches), part_begin(drawn, k + 1, stretches), frame.stretches[k], counts + static_cast<size_t>(k) * tiles);
        } catch (...) {  // an exception must not leave a parallel loop
            out_of_memory++;
        }
    }
    size_t total = 0;
    for (int k = 0; k < stretches; k++) total += frame.stretches[k].count;
    if (out_of_memory || total > LARGEST_INTERSECTIONS) return Status::too_many_intersections;

    uint32_t start = 0;
    for (int tile = 0; tile < tiles; tile++) {
        tile_start[tile] = start;
        for (int k = 0; k < stretches; k++) {
            uint32_t& count = counts[static_cast<size_t>(k) * tiles + tile];
            const uint32_t size = count;
            count = start;  // from here on: where the stretch's next intersection of this tile goes
            start += size;
        }
    }
    tile_start[tiles] = start;

    uint32_t row = 0, *ids = frame.visible_ids.need(drawn + 1), *first_row = frame.first_row.need(drawn + 1);
    size_t visible = 0;
    for (size_t i = 0; i < drawn; i++) {
        const uint32_t id = frame.drawn.data()[i];
        RowRange& range = ranges[id];
        ids[visible] = id;
        first_row[visible] = row;
        visible += range.count > 0;
        range.offset = row - range.offset;  // from record to row
        row += range.count;
    }
    first_row[visible] = row;
    frame.visible = visible;

    uint32_t *list_splats = frame.list_splats.need(total + LIST_SPARE), *list_rows = frame.list_rows.need(total + LIST_SPARE);
    uint16_t* list_blocks = frame.list_blocks.need(total + LIST_SPARE);
#pragma omp parallel for schedule(dynamic, 1) num_threads(frame.threads) if (frame.threads > 1)
    for (int k = 0; k < stretches; k++) {
        uint32_t* place = counts + static_cast<size_t>(k) * tiles;
        const StretchRecords& records = frame.stretches[k];
        for (size_t r = 0; r < records.count; r++) {
            const uint32_t splat = records.splats.data()[r], p = place[records.tiles.data()[r]]++;
            list_splats[p] = splat;
            list_rows[p] = static_cast<uint32_t>(r) + ranges[splat].offset;
            list_blocks[p] = records.blocks.data()[r];
        }
    }
    for (size_t p = total; p < total + LIST_SPARE; p++) list_splats[p] = list_rows[p] = list_blocks[p] = 0;
    frame.intersection_count = total;
    return Status::ok;
}

}  // namespace KERNEL_ISA
