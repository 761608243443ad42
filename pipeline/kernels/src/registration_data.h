// What the registration of RGB-D views takes and gives: plain data, shared by all builds and the Python module.
#pragma once

#include "frame.h"

namespace raster {

constexpr int PARAMETERS = 8;                // of a registration: translation, rotation, gain, offset
constexpr int POSE_PARAMETERS = 6;
constexpr int MOST_LEVELS = 16;
constexpr int TILE_COLUMNS = 10, TILE_ROWS = 8;  // of the tiles over which correlated residuals are summed
constexpr int ALIGNMENT_TILES = TILE_COLUMNS * TILE_ROWS;

// Samples of one level of the reference.
struct SampleArrays {
    size_t count;
    const float *points, *normals, *intensities;  // [n, 3], [n, 3], [n]
    const float* depth_sigmas;                    // [n] or null
};

// One level of the target. Depths are inverse, 0 where unknown; pixel centers are the integers.
struct TargetImages {
    int width, height;
    float fx, fy, cx, cy;
    bool has_depth;  // if not, inverse_depth is positive where pixels may be used
    const float *gray, *inverse_depth;
    const float* depth_sigma;  // meters, or null
    const float* normals;      // [h, w, 3] or null: not compared
};

struct AlignmentSettings {
    bool use_depth, use_gray, gray_noise_of_depth;
    float depth_gate_m, depth_gate_relative, gate_sigmas, chance_inverse, behind_squared, min_normal_cosine;
    float sigma_base_m, sigma_quadratic_per_m, sigma_nearest_m;
    double depth_scale_floor, gray_scale_floor, gray_floor_of_depth, huber_sigmas;
    float min_gradient;
    size_t mad_stride, mad_from;  // every so many residuals estimate a scale, where there are more than so many
};

// Normal equations of one kind of residuals. The statistics are set if they were asked for.
struct NormalEquations {
    double H[PARAMETERS][PARAMETERS], gradient[PARAMETERS];
    double scale;
    size_t count;
    double squares, weights;                            // sums of weight * residual^2 and weight
    double tile_gradients[ALIGNMENT_TILES][PARAMETERS];
};

struct AlignmentSystem {
    NormalEquations depth, gray;
    size_t seen, judged, conflicts, agreeing;
    double median_depth_m, sigma_mean_m;  // statistics
};

// From the coarsest level to the finest. Poses are T_reference_target, row by row.
struct AlignmentSearch {
    int levels;
    int iterations[MOST_LEVELS];  // at most, by level
    size_t min_samples;
    double tolerance, coarse_tolerance;  // of steps, m and rad: smaller ones end a level
    bool weights_by_correlation;         // at the finest level
    const double* prior;       // [6, 6], information of the right tangent of the guess, or null
    const double* projection;  // [6, 6], takes a tangent to its determined part, or null
};
struct AlignmentState {
    double T[16], exposure[2];
    int steps;
};

// One resolution of a frame, [h, w] each; see registration.pyramid.
struct LevelImages {
    int width, height;
    const float *gray, *inverse_depth;
    const float* depth_sigma;  // or null
    const uint8_t* mask;       // of the half-size image; or null
};
struct HalvedImages {
    float *gray, *inverse_depth;
    float* depth_sigma;  // null where that of the level is
};

// Where normals are computed: pixels, and the camera.
struct NormalPixels {
    size_t rows, columns;              // a grid of pixels
    const int32_t *of_row, *of_column;
    float fx, fy, cx, cy;
};

// A depth image, and the camera from another place that looks for its points.
struct MovedDepth {
    int width, height, rounds;
    float middle, fx, fy, cx, cy, most_off_px2, same_surface;
    float T_depth_color[12], T_color_depth[12];
    const float *inverse_depth, *nearest;  // [h, w]
    const float *ray_x, *ray_y;            // [w], [h]
};

// Triangles of points in an image, to be drawn.
struct DrawnTriangles {
    int width, height;
    size_t count;
    const double *pixels, *inverse;  // [m, 2], [m]
    const int64_t* triangles;        // [t, 3]
};

// A depth image to be drawn from the place of another camera.
struct PinholeNumbers {
    double fx, fy, cx, cy;
};
struct RegisteredDepth {
    int width, height, onto_width, onto_height, steps;
    double nearest_m, same_surface, one_layer;
    PinholeNumbers from, onto;
    double T[12];           // rows of the pose of the depth camera in the other one
    const double* inverse;  // [h, w]
};

// A depth image to be drawn from the place of a camera that is displaced along x alone.
struct DisplacedDepth {
    int width, height, onto_width, onto_height;
    double baseline_m, same_surface;
    PinholeNumbers from, onto;
    const double* depth;  // [h, w]
};

// Points of any frame, and the view that judges where they are.
constexpr int8_t PLACE_FREE = 1, PLACE_ON_SURFACE = 0, PLACE_HIDDEN = -1, PLACE_UNKNOWN = -2;
struct JudgedPoints {
    size_t count;
    int width, height;
    PinholeNumbers camera;
    double near_m, near_gate, gate_m, gate_relative, gate_inverse;
    const double* points;         // [n, 3]
    const double* T_view_points;  // [3, 4]
    const float* nearest;         // [h, w], 1/m, 0 = unknown
};

// An image whose 11x11 windows are looked at, each but at its border.
struct ImageWindows {
    size_t width, height, channels;
    const float* image;    // [h, w, channels]
    const float* weights;  // [6] of a row of the window, from its end to the middle
};

// A drawn image, and the one that it is compared with.
struct ComparedWindows {
    ImageWindows drawn;
    const float* seen;      // as the drawn one
    const float* mean;      // [h - 10, w - 10, channels], of its windows
    const float* variance;  // of its windows
    const float* weight;    // of what is said of them; may be null
};

// A drawn image in an exposure, and the image that it is compared with, in the columns from left to right.
struct ExposedImage {
    size_t width, height, left, right;
    const float *drawn, *alpha, *seen;  // [h, w, 3], [h, w], [h, w, 3]
    const uint8_t* mask;                // [h, w], 1 where pixels count, else 0; may be null
    const float *gain, *offset;         // [3]
};

// Memory of one thread, kept between calls.
struct AlignmentScratch {
    Scratch<float> floats;
    Scratch<int32_t> indices;
    Scratch<uint32_t> keys;
    Scratch<uint8_t> bytes;
};

// One build of these kernels for one instruction set.
struct RegistrationKernels {
    // The system of one level at a pose T_reference_target [4, 4], with statistics.
    void (*align_at)(const SampleArrays&, const TargetImages&, int level, const double* T, const double* exposure, const AlignmentSettings&,
                     bool statistics, AlignmentScratch&, AlignmentSystem&);
    // From the guess in the state to the minimum, and the system there, with statistics, at the finest level.
    void (*align)(const SampleArrays*, const TargetImages*, const AlignmentSettings&, const AlignmentSearch&, AlignmentScratch&,
                  AlignmentState&, AlignmentSystem&);
    void (*gray_of_bytes)(const uint8_t* color, size_t pixels, float* gray);
    void (*gray_of_floats)(const float* color, size_t pixels, float* gray);
    // mask and sigma may be null.
    void (*invert_depth)(const float* depth_m, const uint8_t* mask, const float* sigma, size_t pixels, float* inverse, float* known_sigma);
    void (*halve)(const LevelImages&, float, const HalvedImages&);
    void (*surface_normals)(const LevelImages&, const NormalPixels&, float* normals);
    // Inverse depth [h, w] (0: unknown), and columns and rows where it was looked up.
    void (*move_depth)(const MovedDepth&, Scratch<uint8_t>&, float* found, float* columns, float* rows);
    // Inverse depth and change of depth [h, w], 0 at the beginning.
    void (*draw_triangles)(const DrawnTriangles&, double* nearest, double* change);
    // Depth [h, w]. Memory: pixels and depths for every sample, images [3, h, w].
    void (*register_depth)(const RegisteredDepth&, int32_t* pixels, double* depths, double* images, float* depth);
    // Depth [h, w]. Memory: two rows of the depth image.
    void (*displace_depth)(const DisplacedDepth&, double* inverse, double* x, double* depth);
    // [n]: one of PLACE_...
    void (*free_space)(const JudgedPoints&, int8_t* where);
    // [h - 10, w - 10, channels].
    void (*window_means)(const ImageWindows&, Scratch<float>&, float* means);
    // [2]: sums of the contrast-structure terms and of SSIM.
    void (*window_terms)(const ComparedWindows&, Scratch<float>&, double* sums);
    double (*squared_error)(const ExposedImage&, Scratch<float>&);
};

}  // namespace raster
