// Which Gaussian touches which 4x4 block of which tile, in order of depth.
//
// The image is cut into bands of tile rows, one for each thread. A thread picks the Gaussians that may touch its band,
// sorts them by depth, tests them against the tiles and counts; once all have counted, each knows where its lists begin
// and writes them. A list depends on nothing but its tile, so the cuts do not show; and threads hardly ever write to the
// same cache line, which would cost more than all that is done with it.
#pragma once

#include "bands.h"
#include "words.h"

namespace KERNEL_ISA {

// ---------------------------------------------------------------- blocks of the image

// The blocks of one tile that have a pixel which lies in the image and is wanted by the mask.
inline uint32_t wanted_blocks(const View& view, int tile_x, int tile_y) {
    const int x0 = tile_x * TILE, y0 = tile_y * TILE;
    const int x1 = smaller(x0 + TILE, view.width), y1 = smaller(y0 + TILE, view.height);
    const bool whole = x1 - x0 == TILE && y1 - y0 == TILE;
    if (whole && !view.mask) return 0xffff;
    uint32_t blocks = 0;
    for (int y = y0; y < y1; y++) {
        const int row_of_blocks = (y - y0) / 4 * 4;
        const uint8_t* row = view.mask + static_cast<size_t>(y) * view.width;
        if (whole) {
            uint32_t quads[4];  // of pixels
            std::memcpy(quads, row + x0, sizeof quads);
            for (int b = 0; b < 4; b++) blocks |= static_cast<uint32_t>(quads[b] != 0) << (row_of_blocks + b);
        } else {
            for (int x = x0; x < x1; x++)
                blocks |= static_cast<uint32_t>(!view.mask || row[x]) << (row_of_blocks + (x - x0) / 4);
        }
    }
    return blocks;
}

// Behind each row of tiles, and below the last one, lie tiles of which nothing is wanted: windows may hang over.
constexpr int OVERHANG = 7;
inline size_t wanted_stride(const Frame& frame) { return frame.tiles_x + OVERHANG; }
inline void find_wanted_blocks(Frame& frame, const Band& band) {
    for (int y = band.first; y <= band.last; y++) {
        uint16_t* row = frame.wanted_blocks.data() + y * wanted_stride(frame);
        for (int x = 0; x < frame.tiles_x; x++) row[x] = static_cast<uint16_t>(wanted_blocks(frame.view, x, y));
        std::memset(row + frame.tiles_x, 0, OVERHANG * sizeof(uint16_t));
    }
}

// ---------------------------------------------------------------- tests

// Eight tiles to be tested against one member: 4x2, or 8x1 for wide members, so that its records come row by row
// however the image is cut.
struct Window {
    uint32_t member;
    uint16_t tile_x, tile_y;
    bool wide, opens, ends;  // opens: first window of its member; ends: the member has no row below the first
};
constexpr size_t GAUSSIANS_AHEAD = 96, RECORDS_AHEAD = 64;  // to prefetch: what memory takes to answer
constexpr int WINDOWS_IN_STEP = 4;
constexpr int WINDOWS = 64 * WINDOWS_IN_STEP;

// An ellipse is convex: within a row of blocks it covers what lies between its largest right and its least left. These
// are at t = c and t = -c, see Footprint, or at the edge of the row that is nearest to that.
struct WindowLanes {  // eight rows of sixteen blocks: their right sides, then their left sides
    alignas(64) float row[LANES], blocks[LANES], side[LANES];
    constexpr WindowLanes(bool wide) : row(), blocks(), side() {
        for (int lane = 0; lane < LANES; lane++) {
            row[lane] = static_cast<float>(lane % (wide ? 4 : 8) * 4);  // px
            side[lane] = lane < 8 ? 1.0f : -1.0f;
            // x/4 + 1 blocks begin left of x, (x - 3)/4 + 1 end left of x
            blocks[lane] = (lane < 8 ? 1.0f : 0.25f) - (wide && lane % 8 >= 4 ? 16.0f : 0.0f);
        }
    }
};
alignas(64) static constexpr WindowLanes WINDOW_LANES[2] = {false, true};

// The blocks of four windows that their ellipses touch, a word for each tile. Step by step for all four, since the steps
// of one wait for each other.
inline void touched_blocks(const Footprint* footprints, const Window* windows, Words8* touched) {
    constexpr int N = WINDOWS_IN_STEP;
    const Vec side = load(WINDOW_LANES[0].side), zero(0.0f), one(1.0f), all(16.0f);
    Vec top[N], bottom[N], t[N], width[N], x[N];
    const Footprint* f[N];
    const WindowLanes* lanes[N];
    for (int i = 0; i < N; i++) f[i] = footprints + windows[i].member, lanes[i] = WINDOW_LANES + windows[i].wide;
    for (int i = 0; i < N; i++) {
        const Vec per_pixel(f[i]->per_pixel);
        top[i] = fma(load(lanes[i]->row), per_pixel, Vec((windows[i].tile_y * TILE - f[i]->v) * f[i]->per_pixel));
    }
    for (int i = 0; i < N; i++) bottom[i] = top[i] + Vec(3.0f * f[i]->per_pixel);
    for (int i = 0; i < N; i++) t[i] = min(max(side * Vec(f[i]->skew), top[i]), bottom[i]);
    for (int i = 0; i < N; i++) width[i] = sqrt(fnma(t[i], t[i], one));  // not a number above and below the ellipse
    for (int i = 0; i < N; i++) x[i] = load(lanes[i]->blocks) + Vec(f[i]->blocks_u - windows[i].tile_x * 4);
    for (int i = 0; i < N; i++) x[i] = fma(Vec(f[i]->wide_skew), t[i], x[i]);
    for (int i = 0; i < N; i++) x[i] = fma(Vec(f[i]->wide_upright), side * width[i], x[i]);
    for (int i = 0; i < N; i++) touched[i] = bits_between(min(max(x[i], zero), all));  // max(nan, 0) is 0
    for (int i = 0; i < N; i++) touched[i] = transpose_nibbles(touched[i]);
}

// Appends what the windows find to the records of the band. `opened`: the first record of the member at hand.
inline void test_windows(Frame& frame, Band& band, const Window* windows, int count, size_t& opened_last) {
    const size_t before = band.record_count, most = before + 8 * count + RECORDS_AHEAD;
    uint32_t* tiles = band.record_tiles.need_keeping(most, before);
    uint32_t* member_of = band.record_members.need_keeping(most, before);
    uint16_t* blocks = band.record_blocks.need_keeping(most, before);
    const Footprint* footprints = band.footprints;
    RecordRange* ranges = band.ranges.data();
    const size_t stride = wanted_stride(frame);
    const uint16_t *wanted = frame.wanted_blocks.data(), *nothing = wanted + frame.tiles_y * stride;
    const uint32_t tiles_x = frame.tiles_x, first_row = band.first;
    const int last_row = band.last;
    size_t total = before, opened = opened_last;
    for (int first = 0; first < count; first += WINDOWS_IN_STEP) {
        Words8 touched[WINDOWS_IN_STEP];
        touched_blocks(footprints, windows + first, touched);
        for (int i = 0; i < WINDOWS_IN_STEP && first + i < count; i++) {
            const Window w = windows[first + i];
            const uint16_t* wanted_first = wanted + w.tile_y * stride + w.tile_x;
            const uint16_t* wanted_below = !w.ends && w.tile_y < last_row ? wanted_first + stride : nothing;
            const Words8 found = masked(touched[i], wanted_first, w.wide ? wanted_first + 4 : wanted_below);
            const uint32_t tile = (w.tile_y - first_row) * tiles_x + w.tile_x, to_second_four = w.wide ? 4 : tiles_x;
            opened = w.opens ? total : opened;
            for (int k = 0; k < 8; k++) member_of[total + k] = w.member;
            total += store_nonzero(found, tile, to_second_four, blocks + total, tiles + total);
            ranges[w.member] = {static_cast<uint32_t>(total - opened), static_cast<uint32_t>(opened)};
        }
    }
    uint32_t* counts = band.tile_places.data();
    for (size_t r = before; r < total; r++) counts[tiles[r]]++;
    band.record_count = total;
    opened_last = opened;
}

// Records of the band by depth, and the number of each tile. Ends early when all bands together have found too many.
inline void find_records(Frame& frame, Band& band) {
    const size_t tiles = tile_count(frame, band), count = band.member_count;
    std::memset(band.tile_places.need(tiles + 1), 0, tiles * sizeof(uint32_t));
    const Footprint* footprints = band.footprints;
    RecordRange* ranges = band.ranges.data();
    const uint32_t* order = band.order.data();
    Window windows[WINDOWS + WINDOWS_IN_STEP] = {};
    int waiting = 0;
    size_t opened = 0;
    band.record_count = 0;
    bool too_many = false;
    const auto test = [&](int number) {
        const size_t before = band.record_count;
        test_windows(frame, band, windows, number, opened);
        const uint64_t found = band.record_count - before;
        too_many = __atomic_add_fetch(&frame.records_found, found, __ATOMIC_RELAXED) > MOST_INTERSECTIONS;
    };
    const int first_row = band.first, last_row = band.last;
    for (size_t i = 0; i < count && !too_many; i++) {
        const uint32_t ahead = order[i + GAUSSIANS_AHEAD < count ? i + GAUSSIANS_AHEAD : i];
        __builtin_prefetch(&footprints[ahead]);
        __builtin_prefetch(&ranges[ahead], 1);
        const uint32_t member = order[i];
        const TileRange columns(footprints[member].tile_columns), rows(footprints[member].tile_rows);
        const int top = larger(rows.first, first_row), bottom = smaller(rows.last, last_row);
        const int height = bottom - top + 1, width = columns.last - columns.first + 1;
        if (0 < height && height <= 4 && 0 < width && width <= 4) {  // nearly all: one window or two
            const uint16_t x = static_cast<uint16_t>(columns.first), y = static_cast<uint16_t>(top);
            windows[waiting] = {member, x, y, false, true, height == 1};
            windows[waiting + 1] = {member, x, static_cast<uint16_t>(y + 2), false, false, height == 3};
            waiting += 1 + (height > 2);
        } else {
            ranges[member] = {0, 0};  // should it lie between two pixels
            const bool wide = width > 4;
            bool opens = true;
            for (int y = top; y <= bottom; y += wide ? 1 : 2)
                for (int x = columns.first; x <= columns.last; x += wide ? 8 : 4) {
                    const auto column = static_cast<uint16_t>(x), row = static_cast<uint16_t>(y);
                    windows[waiting++] = {member, column, row, wide, opens, y == bottom};
                    opens = false;
                    if (waiting >= WINDOWS) test(waiting), waiting = 0;
                }
        }
        if (waiting >= WINDOWS) test(waiting), waiting = 0;
    }
    test(waiting);
    std::memset(band.record_members.data() + band.record_count, 0, RECORDS_AHEAD * sizeof(uint32_t));  // to prefetch
}

// ---------------------------------------------------------------- lists

// Adds up the tiles of the Gaussians of a chunk over all bands; returns what the chunk holds.
inline RowsAndVisible count_rows(Frame& frame, size_t chunk) {
    uint32_t* rows = frame.rows_of_id.data() + chunk * CHUNK;
    std::memset(rows, 0, CHUNK * sizeof(uint32_t));
    for (int b = 0; b < frame.band_count; b++) {
        const Band& band = frame.bands[b];
        for (uint32_t j = band.chunk_first.data()[chunk]; j < band.chunk_first.data()[chunk + 1]; j++) {
            uint32_t& count = rows[band.ids.data()[j] % CHUNK];
            band.rows_above.data()[j] = count;
            count += band.ranges.data()[j].count;
        }
    }
    RowsAndVisible sum;
    for (size_t i = 0; i < CHUNK; i++) sum.rows += rows[i], sum.visible += rows[i] > 0;
    return sum;
}

// Gives rows to the Gaussians of a chunk, from `start` on.
inline void assign_rows(Frame& frame, size_t chunk, RowsAndVisible start) {
    uint32_t *rows = frame.rows_of_id.data() + chunk * CHUNK, ids[CHUNK + 1], first_row[CHUNK + 1], visible = 0;
    for (size_t i = 0; i < CHUNK; i++) {
        const uint32_t count = rows[i];
        ids[visible] = static_cast<uint32_t>(chunk * CHUNK + i);
        first_row[visible] = rows[i] = start.rows;
        visible += count > 0;
        start.rows += count;
    }
    std::memcpy(frame.visible_ids.data() + start.visible, ids, visible * sizeof(uint32_t));
    std::memcpy(frame.first_row.data() + start.visible, first_row, visible * sizeof(uint32_t));
}

// The same for all Gaussians, if there is only one band.
inline RowsAndVisible assign_rows(Frame& frame, Band& band) {
    const size_t count = band.member_count;
    uint32_t *visible_ids = frame.visible_ids.data(), *first_row = frame.first_row.data();
    const uint32_t* ids = band.ids.data();
    const RecordRange* ranges = band.ranges.data();
    ListEntry* entries = band.entries.data();
    RowsAndVisible start;
    for (size_t i = 0; i < count; i++) {
        const uint32_t id = ids[i];
        visible_ids[start.visible] = id;
        first_row[start.visible] = start.rows;
        entries[id] = {id, frame.one_row ? start.rows : start.rows - ranges[id].first};
        start.visible += ranges[id].count > 0;
        start.rows += frame.one_row ? ranges[id].count > 0 : ranges[id].count;
    }
    return start;
}

// Rows of sums for every Gaussian that touches a tile: contiguous, and in the order of the arrays, so that what follows
// is a streaming pass in a fixed order.
inline void assign_all_rows(Frame& frame) {
    const size_t most = drawn_count(frame) + 1;
    frame.visible_ids.need(most);
    frame.first_row.need(most);
    RowsAndVisible end, *starts = frame.chunk_rows.need(frame.chunks);
    frame.one_row = frame.threads == 1;
    if (frame.band_count == 1)
        end = assign_rows(frame, frame.bands[0]);
    else {
        frame.rows_of_id.need(frame.chunks * CHUNK);
#pragma omp parallel for schedule(static) num_threads(frame.threads)
        for (size_t chunk = 0; chunk < frame.chunks; chunk++) starts[chunk] = count_rows(frame, chunk);
        for (size_t chunk = 0; chunk < frame.chunks; chunk++) {
            const RowsAndVisible sum = starts[chunk];
            starts[chunk] = end;
            end = {end.rows + sum.rows, end.visible + sum.visible};
        }
#pragma omp parallel for schedule(static) num_threads(frame.threads)
        for (size_t chunk = 0; chunk < frame.chunks; chunk++)
            if (frame.chunk_drawn.data()[chunk]) assign_rows(frame, chunk, starts[chunk]);
    }
    frame.first_row.data()[end.visible] = end.rows;
    frame.visible = end.visible;
}

// What the records of a band lack, once the rows are known.
inline void complete_entries(const Frame& frame, Band& band) {
    const size_t count = band.member_count;
    const uint32_t *ids = band.ids.data(), *above = band.rows_above.data(), *row_of_id = frame.rows_of_id.data();
    const RecordRange* ranges = band.ranges.data();
    ListEntry* entries = band.entries.data();
    for (size_t i = 0; i < count; i++) entries[i] = {ids[i], row_of_id[ids[i]] + above[i] - ranges[i].first};
}

// The lists of the tiles of a band, which begin at `start`.
inline void write_lists(Frame& frame, Band& band, uint32_t start) {
    const size_t tiles = tile_count(frame, band), records = band.record_count;
    uint32_t* tile_start = frame.tile_start.data() + static_cast<size_t>(band.first) * frame.tiles_x;
    uint32_t* place = band.tile_places.data();
    for (size_t tile = 0; tile < tiles; tile++) {
        tile_start[tile] = start;
        start += place[tile];
        place[tile] = tile_start[tile];
    }
    uint32_t *splats = frame.list_splats.data(), *rows = frame.list_rows.data();
    uint16_t* blocks = frame.list_blocks.data();
    const ListEntry* entries = band.entries.data();
    const uint32_t *record_tiles = band.record_tiles.data(), *record_members = band.record_members.data();
    const uint16_t* record_blocks = band.record_blocks.data();
    for (size_t r = 0; r < records; r++) {
        __builtin_prefetch(&entries[record_members[r + RECORDS_AHEAD]]);
        const ListEntry entry = entries[record_members[r]];
        const uint32_t p = place[record_tiles[r]]++;
        splats[p] = entry.id;
        rows[p] = frame.one_row ? entry.to_row : static_cast<uint32_t>(r) + entry.to_row;
        blocks[p] = record_blocks[r];
    }
}

// Lists of all tiles in order of depth.
inline Status bin(Frame& frame) {
    frame.tiles_x = (frame.view.width + TILE - 1) / TILE;
    frame.tiles_y = (frame.view.height + TILE - 1) / TILE;
    const size_t tiles = static_cast<size_t>(frame.tiles_x) * frame.tiles_y, stride = wanted_stride(frame);
    uint16_t* wanted = frame.wanted_blocks.need(stride * (frame.tiles_y + 1));
    std::memset(wanted + stride * frame.tiles_y, 0, stride * sizeof(uint16_t));
    frame.records_found = 0;
    choose_bands(frame);
    int out_of_memory = 0;
#pragma omp parallel for schedule(static, 1) num_threads(frame.threads) reduction(+ : out_of_memory) \
    if (frame.threads > 1)
    for (int b = 0; b < frame.band_count; b++) {
        Band& band = frame.bands[b];
        try {
            find_wanted_blocks(frame, band);
            frame.band_count == 1 ? pick_all(frame, band) : pick_members(frame, band);
            sort_members(band);
            find_records(frame, band);
        } catch (...) {  // an exception must not leave a parallel loop
            out_of_memory++;
        }
    }
    const size_t total = frame.records_found;
    if (out_of_memory || total > MOST_INTERSECTIONS) {
        for (Band& band : frame.bands) {
            band.record_tiles.release();
            band.record_members.release();
            band.record_blocks.release();
        }
        return Status::too_many_intersections;
    }
    assign_all_rows(frame);

    size_t band_start[MOST_BANDS + 1] = {};
    for (int b = 0; b < frame.band_count; b++) band_start[b + 1] = band_start[b] + frame.bands[b].record_count;
    frame.tile_start.need(tiles + 1)[tiles] = static_cast<uint32_t>(total);
    frame.list_splats.need(total + LIST_SPARE);
    frame.list_rows.need(total + LIST_SPARE);
    frame.list_blocks.need(total + LIST_SPARE);
#pragma omp parallel for schedule(static, 1) num_threads(frame.threads) if (frame.threads > 1)
    for (int b = 0; b < frame.band_count; b++) {
        if (frame.band_count > 1) complete_entries(frame, frame.bands[b]);
        write_lists(frame, frame.bands[b], static_cast<uint32_t>(band_start[b]));
    }
    for (size_t p = total; p < total + LIST_SPARE; p++)
        frame.list_splats.data()[p] = frame.list_rows.data()[p] = frame.list_blocks.data()[p] = 0;
    frame.intersection_count = total;
    return Status::ok;
}

}  // namespace KERNEL_ISA
