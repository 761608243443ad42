// Tiles of 16x16 pixels and their sixteen blocks of 4x4: one block is one vector, its lanes row by row.
#pragma once

#include "lists.h"

#if defined(_OPENMP)
#include <omp.h>
#endif

namespace KERNEL_ISA {

struct Tile {
    int index, x, y;        // x, y: first pixel
    uint32_t first, count;  // of its list
    Tile(const Frame& frame, int tile)
        : index(tile), x(tile % frame.tiles_x * TILE), y(tile / frame.tiles_x * TILE), first(frame.tile_start.data()[tile]),
          count(frame.tile_start.data()[tile + 1] - first) {}
};

struct Block {
    int x, y;      // first pixel
    bool whole;    // all sixteen pixels lie in the image
    size_t pixel;  // index of the first pixel
    Block(const Tile& tile, int index, const View& view)
        : x(tile.x + index % 4 * 4), y(tile.y + index / 4 * 4), whole(x + 4 <= view.width && y + 4 <= view.height),
          pixel(static_cast<size_t>(y) * view.width + x) {}
    bool outside(const View& view) const { return x >= view.width || y >= view.height; }
    Vec pixels_x() const { return load(PIXEL_OF_BLOCK.x) + Vec(static_cast<float>(x)); }
    Vec pixels_y() const { return load(PIXEL_OF_BLOCK.y) + Vec(static_cast<float>(y)); }
    // Calls visit(lane, pixel) for every pixel that lies in the image.
    template <class Visit>
    void for_each(const View& view, Visit visit) const {
        for (int lane = 0; lane < LANES; lane++)
            if (x + lane % 4 < view.width && y + lane / 4 < view.height)
                visit(lane, pixel + static_cast<size_t>(lane / 4) * view.width + lane % 4);
    }
    // Pixels that lie in the image and are wanted by the mask.
    uint32_t wanted(const View& view) const {
        if (whole && !view.mask) return 0xffffu;
        uint32_t lanes = 0;
        if (whole) {
            for (int row = 0; row < 4; row++) {
                uint32_t bytes;
                std::memcpy(&bytes, view.mask + pixel + static_cast<size_t>(row) * view.width, sizeof bytes);
                bytes = (((bytes & 0x7f7f7f7fu) + 0x7f7f7f7fu) | bytes) >> 7 & 0x01010101u;  // 1 for each that is not 0
                lanes |= (bytes * 0x01020408u >> 24 & 15) << 4 * row;
            }
            return lanes;
        }
        for_each(view, [&](int lane, size_t p) { lanes |= static_cast<uint32_t>(!view.mask || view.mask[p]) << lane; });
        return lanes;
    }
};

// A block of one plane of an image [H, W]; zero outside the image.
inline Vec read_block(const float* image, const Block& block, const View& view) {
    if (block.whole) return load4x4(image + block.pixel, view.width);
    alignas(64) float pixels[LANES] = {};
    block.for_each(view, [&](int lane, size_t p) { pixels[lane] = image[p]; });
    return load(pixels);
}
inline Vec read_block_or_zero(const float* image, const Block& block, const View& view) {
    return image ? read_block(image, block, view) : Vec(0.0f);
}
inline void write_block(float* image, const Block& block, const View& view, Vec value) {
    if (block.whole) return store4x4(image + block.pixel, view.width, value);
    alignas(64) float pixels[LANES];
    store(pixels, value);
    block.for_each(view, [&](int lane, size_t p) { image[p] = pixels[lane]; });
}
// The three planes of an interleaved image [H, W, 3]. Four pixels are r g b r | g b r g | b r g b in memory.
inline void read_block_rgb(const float* image, const Block& block, const View& view, Vec* rgb) {
    if (block.whole) {
        const float* p = image + 3 * block.pixel;
        const size_t stride = 3 * static_cast<size_t>(view.width);
        const Vec a = load4x4(p, stride), b = load4x4(p + 4, stride), c = load4x4(p + 8, stride);
        rgb[0] = permute4<0, 3, 2, 1>(merge4<0b1001, 0b0100>(a, b, c));
        rgb[1] = permute4<1, 0, 3, 2>(merge4<0b0010, 0b1001>(a, b, c));
        rgb[2] = permute4<2, 1, 0, 3>(merge4<0b0100, 0b0010>(a, b, c));
        return;
    }
    alignas(64) float planes[3][LANES] = {};
    block.for_each(view, [&](int lane, size_t p) {
        for (int k = 0; k < 3; k++) planes[k][lane] = image[3 * p + k];
    });
    for (int k = 0; k < 3; k++) rgb[k] = load(planes[k]);
}
// The three planes of an image of bytes, by a table [256, 3] of what they stand for.
inline void read_block_rgb(const uint8_t* image, const float* table, const Block& block, const View& view, Vec* rgb) {
    if (block.whole) {
        const uint8_t* p = image + 3 * block.pixel;
        for (int k = 0; k < 3; k++) rgb[k] = look_up4x4(table + k, p + k, 3 * static_cast<size_t>(view.width));
        return;
    }
    alignas(64) float planes[3][LANES] = {};
    block.for_each(view, [&](int lane, size_t p) {
        for (int k = 0; k < 3; k++) planes[k][lane] = table[3 * image[3 * p + k] + k];
    });
    for (int k = 0; k < 3; k++) rgb[k] = load(planes[k]);
}
inline void write_block_rgb(float* image, const Block& block, const View& view, const Vec* rgb) {
    if (block.whole) {
        float* p = image + 3 * block.pixel;
        const size_t stride = 3 * static_cast<size_t>(view.width);
        const Vec r = permute4<0, 3, 2, 1>(rgb[0]), g = permute4<1, 0, 3, 2>(rgb[1]), b = permute4<2, 1, 0, 3>(rgb[2]);
        store4x4(p, stride, merge4<0b1001, 0b0010>(r, g, b));
        store4x4(p + 4, stride, merge4<0b0100, 0b1001>(r, g, b));
        store4x4(p + 8, stride, merge4<0b0010, 0b0100>(r, g, b));
        return;
    }
    alignas(64) float planes[3][LANES];
    for (int k = 0; k < 3; k++) store(planes[k], rgb[k]);
    block.for_each(view, [&](int lane, size_t p) {
        for (int k = 0; k < 3; k++) image[3 * p + k] = planes[k][lane];
    });
}

inline bool finite(Vec value) { return bits(value * Vec(0.0f) >= Vec(0.0f)) == 0xffffu; }
inline bool finite_not_negative(Vec value) { return bits(value >= Vec(0.0f)) == 0xffffu && finite(value); }

inline int this_thread() {
#if defined(_OPENMP)
    return omp_get_thread_num();
#else
    return 0;
#endif
}

// Copies of the splats of a tile's list, one behind the other: its blocks come back to them many times. Behind them one that
// no pixel sees.
inline const Splat* gather_splats(Frame& frame, const Tile& tile) {
    Splat* copies = frame.tile_splats.data() + this_thread() * (frame.longest_list + 1);
    const Splat* splats = frame.splats.data();
    const uint32_t* list = frame.list_splats.data() + tile.first;
    static_assert(sizeof(Splat) == LANES * sizeof(float), "");
    for (uint32_t i = 0; i < tile.count; i++) store(&copies[i].u, load(&splats[list[i]].u));
    copies[tile.count] = {};
    copies[tile.count].log2_opacity = -16.0f;
    return copies;
}

// Where what the forward pass leaves for one tile begins.
struct TileItems {
    uint32_t* positions;
    uint16_t* pixels;
    float* T;          // transmittance at the end, block after block
    uint32_t* counts;  // of the blocks
    TileItems(const Frame& frame, int tile)
        : positions(frame.item_positions.data() + frame.item_start.data()[tile]),
          pixels(frame.item_pixels.data() + frame.item_start.data()[tile]),
          T(frame.transmittance.data() + static_cast<size_t>(tile) * BLOCKS * LANES),
          counts(frame.block_items.data() + static_cast<size_t>(tile) * BLOCKS) {}
    // Steps over a block.
    void skip(uint32_t count) {
        positions += count;
        pixels += count;
    }
};

// Room for the items of all tiles: as many as candidates.
inline void prepare_items(Frame& frame) {
    const int tiles = frame.tiles_x * frame.tiles_y;
    uint32_t* start = frame.item_start.need(tiles + 1);
    const uint32_t* tile_start = frame.tile_start.data();
#pragma omp parallel for schedule(static) num_threads(frame.threads) if (frame.threads > 1)
    for (int tile = 0; tile < tiles; tile++) {
        uint32_t candidates = 0;
        for (uint32_t i = tile_start[tile]; i < tile_start[tile + 1]; i++)
            candidates += static_cast<uint32_t>(__builtin_popcount(frame.list_blocks.data()[i]));
        start[tile] = candidates;
    }
    uint32_t items = 0;
    frame.longest_list = 1;
    for (int tile = 0; tile < tiles; tile++) {
        const uint32_t candidates = start[tile], length = tile_start[tile + 1] - tile_start[tile];
        start[tile] = items;
        items += candidates + LIST_SPARE;
        if (length > frame.longest_list) frame.longest_list = length;
    }
    start[tiles] = items;
    frame.item_positions.need(items);
    frame.item_pixels.need(items);
    frame.transmittance.need(static_cast<size_t>(tiles) * BLOCKS * LANES);
    frame.block_items.need(static_cast<size_t>(tiles) * BLOCKS);
    frame.evaluated.need(tiles);
    frame.tile_splats.need((frame.longest_list + 1) * frame.threads);
}

// Which Gaussians lie where.
inline Status make_lists(Frame& frame, const GaussianArrays& gaussians) {
    if (!project_all(frame, gaussians)) return Status::bad_gaussians;
    const Status status = bin(frame);
    if (status == Status::ok) prepare_items(frame);
    return status;
}

}  // namespace KERNEL_ISA
