// Bands of tile rows, one for each thread, and the Gaussians that may touch each, by depth.
#pragma once

#include "visibility.h"

namespace KERNEL_ISA {

constexpr size_t BAND_SAMPLES = 2048;
constexpr int MEMBER_WEIGHT = 4;  // what a Gaussian costs a band, in tiles that it touches

inline size_t drawn_count(const Frame& frame) {
    size_t drawn = 0;
    for (size_t chunk = 0; chunk < frame.chunks; chunk++) drawn += frame.chunk_drawn.data()[chunk];
    return drawn;
}

inline size_t tile_count(const Frame& frame, const Band& band) {
    return static_cast<size_t>(band.last - band.first + 1) * frame.tiles_x;
}

// What there is to list in each row of tiles, about, from a sample of the footprints.
inline void weigh_rows(const Frame& frame, uint64_t* weights) {
    for (int row = 0; row < frame.tiles_y; row++) weights[row] = 1;
    const uint32_t step = static_cast<uint32_t>(1 + drawn_count(frame) / BAND_SAMPLES);
    for (size_t chunk = 0; chunk < frame.chunks; chunk++)
        for (uint32_t k = 0; k < frame.chunk_drawn.data()[chunk]; k += step) {
            const uint32_t id = static_cast<uint32_t>(frame.depth_keys.data()[chunk * CHUNK + k]);
            const Footprint& f = frame.footprints.data()[id];
            const TileRange x(f.tile_columns), y(f.tile_rows);
            weights[y.first] += MEMBER_WEIGHT;
            for (int row = y.first; row <= y.last; row++) weights[row] += x.last - x.first + 2;
        }
}

// Cuts the image so that each band has about the same to list.
inline void choose_bands(Frame& frame) {
    const int rows = frame.tiles_y, count = smaller(smaller(frame.threads, MOST_BANDS), rows);
    uint64_t *weights = frame.row_weights.need(rows), total = 0, before = 0;
    frame.band_count = count;
    if (count == 1) {
        frame.bands[0].first = 0, frame.bands[0].last = rows - 1;
        return;
    }
    weigh_rows(frame, weights);
    for (int row = 0; row < rows; row++) total += weights[row];
    for (int b = 0; b < count; b++) frame.bands[b].first = rows, frame.bands[b].last = rows - 1;  // no row
    for (int row = 0; row < rows; row++) {
        Band& band = frame.bands[(before + weights[row] / 2) * count / total];
        if (band.first == rows) band.first = row;
        band.last = row;
        before += weights[row];
    }
}

// Members of the only band: all drawn Gaussians, under their own index.
inline void pick_all(const Frame& frame, Band& band) {
    const size_t count = drawn_count(frame);
    uint32_t* next_id = band.ids.need(count);
    uint64_t* next_key = band.keys.need(count);
    for (size_t chunk = 0; chunk < frame.chunks; chunk++) {
        const uint64_t* keys = frame.depth_keys.data() + chunk * CHUNK;
        for (uint32_t k = 0; k < frame.chunk_drawn.data()[chunk]; k++) {
            *next_id++ = static_cast<uint32_t>(keys[k]);
            *next_key++ = keys[k];
        }
    }
    band.member_count = count;
    band.footprints = frame.footprints.data();
    band.ranges.need(frame.chunks * CHUNK);
    band.entries.need(frame.chunks * CHUNK);
}

// Members of one of several bands: the drawn Gaussians whose box meets it, numbered anew, with footprints of their own,
// so that the thread has what it needs close by.
inline void pick_members(const Frame& frame, Band& band) {
    const size_t most = drawn_count(frame) + 1;
    uint32_t *ids = band.ids.need(most), *chunk_first = band.chunk_first.need(frame.chunks + 1);
    Footprint* footprints = band.own_footprints.need(most);
    uint64_t* member_keys = band.keys.need(most);
    size_t count = 0;
    for (size_t chunk = 0; chunk < frame.chunks; chunk++) {
        const uint64_t *key = frame.depth_keys.data() + chunk * CHUNK, *end = key + frame.chunk_drawn.data()[chunk];
        chunk_first[chunk] = static_cast<uint32_t>(count);
        for (; key < end; key++) {
            const uint32_t id = static_cast<uint32_t>(*key);
            const TileRange rows(frame.footprints.data()[id].tile_rows);
            ids[count] = id;
            footprints[count] = frame.footprints.data()[id];
            member_keys[count] = (*key & 0xffffffff00000000u) | count;
            count += (rows.first <= band.last) & (rows.last >= band.first);
        }
    }
    chunk_first[frame.chunks] = static_cast<uint32_t>(count);
    band.member_count = count;
    band.footprints = footprints;
    band.ranges.need(count);
    band.rows_above.need(count);
    band.entries.need(count);
}

// Radix sort by depth, 3 passes of 11 bits; stable, so equal depths keep the order of the arrays.
inline void sort_members(Band& band) {
    constexpr int BITS = 11, PASSES = 3, BUCKETS = 1 << BITS;
    const size_t n = band.member_count;
    uint64_t *keys = band.keys.data(), *swap = band.keys_swap.need(n);
    uint32_t* order = band.order.need(n);
    const auto bucket = [](uint64_t key, int pass) { return key >> (32 + BITS * pass) & (BUCKETS - 1); };
    uint32_t place[PASSES][BUCKETS] = {};
    for (size_t i = 0; i < n; i++)
        for (int pass = 0; pass < PASSES; pass++) place[pass][bucket(keys[i], pass)]++;
    for (auto& counts : place) {
        uint32_t start = 0;
        for (uint32_t& count : counts) {
            const uint32_t size = count;
            count = start;
            start += size;
        }
    }
    for (size_t i = 0; i < n; i++) swap[place[0][bucket(keys[i], 0)]++] = keys[i];
    for (size_t i = 0; i < n; i++) keys[place[1][bucket(swap[i], 1)]++] = swap[i];
    for (size_t i = 0; i < n; i++) order[place[2][bucket(keys[i], 2)]++] = static_cast<uint32_t>(keys[i]);
}

}  // namespace KERNEL_ISA
