// What every build of the kernels and the Python module share: plain data and scratch memory, no code of the STL
// (a template compiled here with AVX-512 must never be the one that the linker picks for all builds).
#pragma once

#include <cstddef>
#include <cstdint>

namespace raster {

// Out of line on purpose, compiled for the plain machine; both throw std::bad_alloc.
void* allocate_aligned(size_t bytes);
void release_aligned(void* memory);

#if defined(__SANITIZE_ADDRESS__)  // no spare memory in which an access too far would go unseen
constexpr bool SLACK = false;
#else
constexpr bool SLACK = true;
#endif

// Growable memory, 64-byte aligned, kept between calls; growing does not keep the content unless asked to.
template <class T>
class Scratch {
public:
    Scratch() = default;
    Scratch(const Scratch&) = delete;
    ~Scratch() { release_aligned(data_); }

    __attribute__((always_inline)) T* need(size_t count) {
        if (count > capacity_) grow(count, SLACK ? count / 4 + 64 : 0, 0);
        return data_;
    }
    __attribute__((always_inline)) T* need_keeping(size_t count, size_t kept) {
        if (count > capacity_) grow(count, count / 4 + 64, kept);
        return data_;
    }
    __attribute__((always_inline)) T* data() const { return data_; }
    __attribute__((always_inline)) size_t bytes() const { return capacity_ * sizeof(T); }
    __attribute__((always_inline)) void release() {
        release_aligned(data_);
        data_ = nullptr;
        capacity_ = 0;
    }

private:
    __attribute__((always_inline)) void grow(size_t count, size_t spare, size_t kept) {
        const size_t capacity = count + spare;
        T* memory = static_cast<T*>(allocate_aligned(capacity * sizeof(T)));
        if (kept) __builtin_memcpy(memory, data_, kept * sizeof(T));
        release_aligned(data_);
        data_ = memory;
        capacity_ = capacity;
    }
    T* data_ = nullptr;
    size_t capacity_ = 0;
};

// Depth of a Gaussian at a pixel: that of its center, or its mean along the ray of the pixel.
enum class DepthKind { blended, ray_plane };

// Pinhole camera at its pose; pixel centers are the integers. R, t: T_camera_map, R row by row.
struct View {
    float R[9], t[3];
    float fx, fy, cx, cy;
    int width, height;
    float background[3];
    const uint8_t* mask = nullptr;  // [height, width], 0: not drawn; or null: all drawn
    DepthKind depth = DepthKind::blended;
};

// n Gaussians, arrays of the caller, row-major.
struct GaussianArrays {
    size_t count;
    const float *means, *quats_wxyz, *log_scales, *colors, *opacity_logits;
};

// A Gaussian on the screen, one cache line. With e = M d, M = [M11 M12; 0 M22] and d = pixel - center,
// log2 alpha = log2_opacity - |e|^2: a sum of squares, in which nothing cancels even for long needles.
struct alignas(64) Splat {
    float u, v;                // center, px
    float M11, M12, M22;       // 1/px
    float log2_opacity;
    float r, g, b, z;          // color, depth in meters
    float slope_x, slope_y;    // of the depth along e, meters; set only for ray_plane
    float spare[4];
};

// What the ellipse alpha >= 1/255 of a Gaussian covers. With X, Y half its width and height, t = dy / Y, and c the
// correlation of x and y on the screen, its sides are at dx = X (c t +- sqrt(1 - c^2) sqrt(1 - t^2)).
struct alignas(32) Footprint {
    float blocks_u, v;                 // center: in blocks of 4 px, in px
    float per_pixel;                   // 1 / Y
    float skew;                        // c
    float wide_skew, wide_upright;     // X c and X sqrt(1 - c^2), in blocks
    uint32_t tile_columns, tile_rows;  // the tiles that it may touch, a TileRange each
};

// The records of a Gaussian in one band.
struct RecordRange {
    uint32_t count, first;
};
// What a record still lacks to enter a list: index in the caller's arrays, and what leads from the record to its row, or the row.
struct ListEntry {
    uint32_t id, to_row;
};
struct RowsAndVisible {
    uint32_t rows = 0, visible = 0;
};
// Some rows of tiles: what one thread lists. The lists do not depend on how the image is cut.
struct Band {
    int first, last;                    // rows of tiles, both included
    size_t member_count = 0, record_count = 0;
    Scratch<uint32_t> ids;              // of the members, Gaussians whose box meets the band, ascending
    Scratch<Footprint> own_footprints;
    const Footprint* footprints;        // of the members: own, or all where there is only one band
    Scratch<uint32_t> chunk_first;      // first member out of every projection chunk
    Scratch<uint64_t> keys, keys_swap;  // depth above, member below
    Scratch<uint32_t> order;            // members by depth
    Scratch<RecordRange> ranges;        // per member
    Scratch<uint32_t> rows_above;       // per member, how many rows it has in the bands above
    Scratch<ListEntry> entries;         // per member
    Scratch<uint32_t> record_tiles, record_members;  // records: one Gaussian in one tile each, by depth
    Scratch<uint16_t> record_blocks;
    Scratch<uint32_t> tile_places;      // per tile of the band: number of records, then where they go
};

constexpr int TILE = 16;                   // pixels; a tile is 16 blocks of 4x4, a block is one vector
constexpr int BLOCKS = 16;                 // of a tile
constexpr int LIST_SPARE = 16;             // zeros behind the lists of tiles: readers load whole vectors
constexpr int MOST_BANDS = 64;
constexpr uint64_t MOST_INTERSECTIONS = 1u << 27;  // 1.3 GB of records, as much of lists, 8.6 GB of gradient rows
constexpr int POSE_CHUNKS = 64;

// Everything between the calls of one rasterizer.
struct Frame {
    View view;
    int threads = 1;
    size_t visible = 0, intersection_count = 0;
    int tiles_x = 0, tiles_y = 0;

    Scratch<Splat> splats;                   // by index in the caller's arrays; holds anything where not visible
    Scratch<Footprint> footprints;           // the same
    Scratch<uint64_t> depth_keys;            // depth above, index below; the drawn ones at the front of each chunk
    size_t chunks = 0;                       // of Gaussians that are projected together
    Scratch<uint32_t> chunk_drawn;           // per chunk, how many of them are drawn
    Scratch<RowsAndVisible> chunk_rows;      // per chunk, what lies before it
    Scratch<uint64_t> row_weights;           // per row of tiles, about how much there is to list
    Scratch<uint16_t> wanted_blocks;         // per tile: bit b: block b has a pixel of the image that is to be drawn
    Band bands[MOST_BANDS];
    int band_count = 0;
    Scratch<uint32_t> rows_of_id;            // by index in the caller's arrays: number of rows, then the first
    uint64_t records_found = 0;              // by all bands; too many end the search
    Scratch<uint32_t> visible_ids;           // index of those that touch a tile, ascending
    Scratch<uint32_t> first_row;             // per visible Gaussian, visible + 1: its rows of sums are contiguous, in order of tiles
    Scratch<uint32_t> tile_start;            // tiles + 1
    // Gaussians of each tile, by tile, then depth: index in `splats`, row of sums, bit b: may touch 4x4 block b.
    Scratch<uint32_t> list_splats, list_rows;
    Scratch<uint16_t> list_blocks;
    // Gaussians of each block, left by the forward pass: position in the tile's list, and which pixels it was blended in. A
    // tile's items begin at item_start, block after block.
    Scratch<uint32_t> item_start, block_items;  // tiles + 1; tiles * BLOCKS, how many
    Scratch<uint32_t> item_positions;
    Scratch<uint16_t> item_pixels;
    Scratch<float> transmittance;            // behind the last item; per tile, block after block
    Scratch<uint64_t> evaluated;             // per tile: vectors whose alpha was computed
    Scratch<Splat> tile_splats;              // per thread: the splats of one tile's list
    size_t longest_list = 0;
    Scratch<float> front;                    // per thread: alpha and weight, or weight and depth, of one block's items
    Scratch<float> tile_rows;                // per thread: sums of the Gaussians of one tile's list
    Scratch<float> rows;                     // sums: of one Gaussian in one tile each, or in all of them
    bool one_row = false;                    // of a Gaussian, for all of its tiles: one thread adds them up in their order
    Scratch<double> pose_parts, loss_parts;  // loss_parts: [tiles, LOSS_SUMS]

    size_t bytes() const {  // held between calls
        size_t total = 0;
        const auto add = [&](const auto&... memory) { total += (memory.bytes() + ...); };
        add(splats, footprints, depth_keys, chunk_drawn, chunk_rows, row_weights, wanted_blocks, rows_of_id, visible_ids, first_row, tile_start,
            list_splats, list_rows, list_blocks, item_start, block_items, item_positions, item_pixels, transmittance, evaluated, tile_splats,
            front, tile_rows, rows, pose_parts, loss_parts);
        for (const Band& band : bands)
            add(band.ids, band.own_footprints, band.chunk_first, band.keys, band.keys_swap, band.order, band.ranges, band.rows_above,
                band.entries, band.record_tiles, band.record_members, band.record_blocks, band.tile_places);
        return total;
    }
};

struct GradientArrays {
    float *means, *quats_wxyz, *log_scales, *colors, *opacity_logits;  // or all null: only the pose
    float* fisher_diagonal;  // [n, 14] or null
    double* pose;            // [6] or null
};

struct FisherArrays {
    double *geometry, *color, *opacity;  // [n, 45], [n, 3], [n], added to, as the others
    double *weight, *residual;           // [n]
    double* diagonal;                    // [n, 14] or null
    uint32_t* observations;              // [n]
};

// The loss of a view against the measured color [h, w, 3] and depth [h, w], meters, 0 where there is none.
struct Loss {
    const float *color, *depth_m;
    const uint8_t* bytes;    // [h, w, 3], the image in the place of color, which is null
    const float* of_bytes;   // [256, 3], color by value of a channel
    const float* certainty;  // factor of the residuals of depth, per pixel; null: 1
    float color_huber, depth_weight, depth_huber_m, alpha_weight, surface_weight;
    float gain, offset;  // of the exposure: the image is about gain * rendered + offset
    float closing;       // light below which a pixel closes early; 0: as images are drawn
};
constexpr int LOSS_SUMS = 6;  // color, depth, missing alpha, derivatives by ln gain and by offset, surface
struct LossValues {
    double color, depth, missing_alpha, by_log_gain, by_offset, surface;  // means over their pixels
};

// One step of Adam, in place: all parameters of one kind.
struct AdamArray {
    float* values;           // [n, width], as the moments
    const float* gradients;  // [count, width]
    float *first, *second;   // moments
    float rate;
    size_t width;            // 1, 3 or 4
    bool of_size;            // the rate is a share of the Gaussian's size
};
struct AdamConstants {
    float beta_1, rest_1, beta_2, rest_2, epsilon;  // rest = 1 - beta
};
struct AdamStep {
    size_t count;
    const int64_t* rows;    // [count], each once: the Gaussians that have gradients; null: all n
    const uint8_t* chosen;  // [n], which may change; null: all
    AdamArray arrays[5];
    AdamConstants constants;
    const float* log_scales;                   // [n, 3], before the step
    const float *d_colors, *d_opacity_logits;  // zero where the view did not touch a Gaussian
    int32_t* steps;                            // [n], those taken so far, at most `longest`
    const float* corrections;                  // [longest], of the bias after 1, 2, ... steps
    int32_t longest;

    size_t row(size_t at) const { return rows ? static_cast<size_t>(rows[at]) : at; }
};
struct AdamLimits {
    float *log_scales, *opacity_logits;  // [n, 3], [n]
    const float* least;                  // of the log-scales: of each Gaussian [n, 3], or one
    bool least_of_each;
    float greatest, largest_logit;
};

enum class Status { ok, bad_gaussians, bad_first_image, bad_second_image, bad_third_image, too_many_intersections };

// What a view is drawn into. layer: null: not wanted; tolerance: of its depth, relative.
struct Images {
    float *color, *depth, *alpha, *layer;
    float tolerance;
};

struct RegistrationKernels;  // registration_data.h

// One build of the kernels for one instruction set.
struct Kernels {
    const char* name;
    const RegistrationKernels* registration;
    // Images other than color may be null in the backward pass: zero.
    Status (*forward)(Frame&, const GaussianArrays&, const Images&);
    Status (*backward)(Frame&, const GaussianArrays&, const float* d_color, const float* d_depth,
                       const float* d_alpha, const GradientArrays&);
    // residual may be null.
    Status (*fisher)(Frame&, const GaussianArrays&, const float* inv_var_color, const float* inv_var_depth, const float* residual,
                     const FisherArrays&);
    // information, observations: [n], added to
    Status (*opacity_information)(Frame&, const GaussianArrays&, const float* inv_var_color, const float* inv_var_depth,
                                  double* information, uint32_t* observations);
    void (*contributions)(Frame&, float* weights, uint32_t* pixels);
    // information: [n, 14, 14]
    Status (*full_fisher)(Frame&, const GaussianArrays&, const float* inv_var_color, const float* inv_var_depth, double* information);
    Status (*fit)(Frame&, const GaussianArrays&, const Loss&, LossValues&, const GradientArrays&);
    void (*adam)(const AdamStep&, const AdamLimits&, int threads);
    double (*fma_rate)(int threads, double seconds);                              // of the machine, GFLOP/s
    void (*bandwidth)(int threads, double seconds, double* read, double* copied);  // GB/s
};

}  // namespace raster
