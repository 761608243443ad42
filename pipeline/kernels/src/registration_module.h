// The part of the Python module for registration. Shapes are checked by pipeline.kernels.alignment and pipeline.kernels.pyramid,
// the only callers.
#pragma once

#include "module_arrays.h"
#include "registration_data.h"

namespace raster {

// A level as pipeline.kernels.alignment.Level has it.
class LevelArrays {
public:
    LevelArrays(const Inputs& points, const Inputs& normals, const Inputs& intensities, const Inputs& sample_sigmas, const Inputs& gray,
                const Inputs& inverse_depth, const Inputs& depth_sigma, const Inputs& target_normals, const Inputs& camera, bool has_depth)
        : kept_{points, normals, intensities, sample_sigmas, gray, inverse_depth, depth_sigma, target_normals} {
        samples = {points.shape(0), points.data(), normals.data(), intensities.data(), data_or_null(sample_sigmas)};
        const float* c = camera.data();
        image = {static_cast<int>(gray.shape(1)), static_cast<int>(gray.shape(0)), c[0], c[1], c[2], c[3], has_depth,
                 gray.data(), inverse_depth.data(), data_or_null(depth_sigma), data_or_null(target_normals)};
    }
    SampleArrays samples;
    TargetImages image;

private:
    Inputs kept_[8];
};

static AlignmentSettings alignment_settings(const Array<const double>& values) {
    const double* v = values.data();
    const auto f = [&](int k) { return static_cast<float>(v[k]); };
    return {v[0] != 0.0, v[1] != 0.0, v[2] != 0.0, f(3),  f(4),  f(5),  f(6),  f(7),  f(8), f(9), f(10),
            f(11),       v[12],       v[13],       v[14], v[15], f(16), static_cast<size_t>(v[17]), static_cast<size_t>(v[18])};
}

static void write_normal_equations(const NormalEquations& part, bool statistics, double* out) {
    out = std::copy(&part.H[0][0], &part.H[0][0] + PARAMETERS * PARAMETERS, out);
    out = std::copy(part.gradient, part.gradient + PARAMETERS, out);
    *out++ = part.scale, *out++ = static_cast<double>(part.count), *out++ = part.squares, *out++ = part.weights;
    if (!statistics) return;
    for (int k = 0; k < PARAMETERS; k++)
        for (const auto& gradient : part.tile_gradients) *out++ = gradient[k];
}
constexpr size_t EQUATIONS = PARAMETERS * PARAMETERS + PARAMETERS + 4 + PARAMETERS * ALIGNMENT_TILES;

// All of a system as one array: six numbers, then the equations of depth, and of gray values.
static void write_system(const AlignmentSystem& system, double* out) {
    *out++ = static_cast<double>(system.seen), *out++ = static_cast<double>(system.judged), *out++ = static_cast<double>(system.conflicts);
    *out++ = static_cast<double>(system.agreeing), *out++ = system.median_depth_m, *out++ = system.sigma_mean_m;
    write_normal_equations(system.depth, true, out);
    write_normal_equations(system.gray, true, out + EQUATIONS);
}

static AlignmentScratch& alignment_scratch() {
    static thread_local AlignmentScratch scratch;
    return scratch;
}

static void align_at(const std::string& isa, const LevelArrays& level, int index, const Array<const double>& T, const Array<const double>& exposure,
                     const Array<const double>& settings, const Array<double>& out) {
    const RegistrationKernels* kernels = kernels_named(isa)->registration;
    const AlignmentSettings of_alignment = alignment_settings(settings);
    const nb::gil_scoped_release unlocked;
    AlignmentSystem system;
    kernels->align_at(level.samples, level.image, index, T.data(), exposure.data(), of_alignment, true, alignment_scratch(), system);
    write_system(system, out.data());
}

// T and exposure are changed; search: minimal number of samples, tolerances, whether weights are divided by correlation. The number of steps.
static int align(const std::string& isa, const std::vector<const LevelArrays*>& levels, const std::vector<int>& iterations,
                 const Array<double>& T, const Array<double>& exposure, const Array<const double>& settings,
                 const Array<const double>& search, const Array<const double>& prior, const Array<const double>& projection,
                 const Array<double>& out) {
    if (levels.empty() || levels.size() > MOST_LEVELS || iterations.size() != levels.size())
        throw std::invalid_argument("levels: expected 1 to 16, with a number of iterations each");
    const RegistrationKernels* kernels = kernels_named(isa)->registration;
    SampleArrays samples[MOST_LEVELS];
    TargetImages images[MOST_LEVELS];
    AlignmentSearch of_search = {};
    of_search.levels = static_cast<int>(levels.size());
    for (size_t k = 0; k < levels.size(); k++) {
        samples[k] = levels[k]->samples, images[k] = levels[k]->image;
        of_search.iterations[k] = iterations[k];
    }
    of_search.min_samples = static_cast<size_t>(search.data()[0]);
    of_search.tolerance = search.data()[1], of_search.coarse_tolerance = search.data()[2];
    of_search.weights_by_correlation = search.data()[3] != 0.0;
    of_search.prior = data_or_null(prior), of_search.projection = data_or_null(projection);
    const AlignmentSettings of_alignment = alignment_settings(settings);
    const nb::gil_scoped_release unlocked;
    AlignmentState state = {};
    std::copy(T.data(), T.data() + 16, state.T);
    std::copy(exposure.data(), exposure.data() + 2, state.exposure);
    AlignmentSystem system;
    kernels->align(samples, images, of_alignment, of_search, alignment_scratch(), state, system);
    std::copy(state.T, state.T + 16, T.data());
    std::copy(state.exposure, state.exposure + 2, exposure.data());
    write_system(system, out.data());
    return state.steps;
}

static void gray_of_bytes(const std::string& isa, const Bytes& color, const Floats& gray) {
    kernels_named(isa)->registration->gray_of_bytes(color.data(), gray.size(), gray.data());
}
static void gray_of_floats(const std::string& isa, const Inputs& color, const Floats& gray) {
    kernels_named(isa)->registration->gray_of_floats(color.data(), gray.size(), gray.data());
}
static void invert_depth(const std::string& isa, const Inputs& depth_m, const Bytes& mask, const Inputs& sigma, const Floats& inverse,
                         const Floats& known_sigma) {
    kernels_named(isa)->registration->invert_depth(depth_m.data(), data_or_null(mask), data_or_null(sigma), inverse.size(), inverse.data(), known_sigma.data());
}
static void halve(const std::string& isa, const Inputs& gray, const Inputs& inverse_depth, const Inputs& sigma, const Bytes& half_mask,
                  float chance, const Floats& half_gray, const Floats& half_inverse_depth, const Floats& half_sigma) {
    const LevelImages level = {static_cast<int>(gray.shape(1)), static_cast<int>(gray.shape(0)), gray.data(), inverse_depth.data(),
                               data_or_null(sigma), data_or_null(half_mask)};
    kernels_named(isa)->registration->halve(level, chance, {half_gray.data(), half_inverse_depth.data(), data_or_null(half_sigma)});
}
static void surface_normals(const std::string& isa, const Inputs& inverse_depth, const Array<const int32_t>& rows,
                            const Array<const int32_t>& columns, const Inputs& camera, const Floats& normals) {
    const LevelImages level = {static_cast<int>(inverse_depth.shape(1)), static_cast<int>(inverse_depth.shape(0)), nullptr, inverse_depth.data(),
                               nullptr, nullptr};
    const float* c = camera.data();
    kernels_named(isa)->registration->surface_normals(level, {rows.size(), columns.size(), rows.data(), columns.data(), c[0], c[1], c[2], c[3]}, normals.data());
}

// numbers: start without a surface, fx, fy, cx, cy, limit of the squared distance in pixels, relative step of a surface.
static void move_depth(const std::string& isa, const Inputs& inverse_depth, const Inputs& nearest, const Inputs& ray_x, const Inputs& ray_y,
                       const Inputs& T_depth_color, const Inputs& T_color_depth, const Inputs& numbers, int rounds, const Floats& found,
                       const Floats& columns, const Floats& rows) {
    const float* n = numbers.data();
    MovedDepth of = {static_cast<int>(ray_x.size()), static_cast<int>(ray_y.size()), rounds, n[0], n[1], n[2], n[3], n[4], n[5], n[6], {}, {},
                     inverse_depth.data(), nearest.data(), ray_x.data(), ray_y.data()};
    std::copy(T_depth_color.data(), T_depth_color.data() + 12, of.T_depth_color);
    std::copy(T_color_depth.data(), T_color_depth.data() + 12, of.T_color_depth);
    const RegistrationKernels* kernels = kernels_named(isa)->registration;
    const nb::gil_scoped_release unlocked;
    kernels->move_depth(of, alignment_scratch().bytes, found.data(), columns.data(), rows.data());
}

using Doubles = Array<double>;
using DoubleInputs = Array<const double>;

static void draw_triangles(const std::string& isa, const DoubleInputs& pixels, const DoubleInputs& inverse, const Array<const int64_t>& triangles,
                           const Doubles& nearest, const Doubles& change) {
    const DrawnTriangles of = {static_cast<int>(nearest.shape(1)), static_cast<int>(nearest.shape(0)), triangles.shape(0), pixels.data(),
                               inverse.data(), triangles.data()};
    const RegistrationKernels* kernels = kernels_named(isa)->registration;
    const nb::gil_scoped_release unlocked;
    kernels->draw_triangles(of, nearest.data(), change.data());
}

// numbers: least depth, relative step of a surface, of a layer; fx, fy, cx, cy of the depth camera, and of the other one.
static void register_depth(const std::string& isa, const DoubleInputs& inverse, const DoubleInputs& T, const DoubleInputs& numbers, int steps,
                           const Array<int32_t>& pixels, const Doubles& depths, const Doubles& images, const Floats& depth) {
    const double* n = numbers.data();
    RegisteredDepth of = {static_cast<int>(inverse.shape(1)), static_cast<int>(inverse.shape(0)), static_cast<int>(depth.shape(1)),
                          static_cast<int>(depth.shape(0)), steps, n[0], n[1], n[2], {n[3], n[4], n[5], n[6]}, {n[7], n[8], n[9], n[10]}, {},
                          inverse.data()};
    std::copy(T.data(), T.data() + 12, of.T);
    const RegistrationKernels* kernels = kernels_named(isa)->registration;
    const nb::gil_scoped_release unlocked;
    kernels->register_depth(of, pixels.data(), depths.data(), images.data(), depth.data());
}

// numbers: baseline, relative step of a surface; fx, fy, cx, cy of the depth camera, and of the other one. memory: two rows of the depth image.
static void displace_depth(const std::string& isa, const DoubleInputs& depth, const DoubleInputs& numbers, const Doubles& memory,
                           const Doubles& displaced) {
    const double* n = numbers.data();
    const DisplacedDepth of = {static_cast<int>(depth.shape(1)), static_cast<int>(depth.shape(0)), static_cast<int>(displaced.shape(1)),
                               static_cast<int>(displaced.shape(0)), n[0], n[1], {n[2], n[3], n[4], n[5]}, {n[6], n[7], n[8], n[9]},
                               depth.data()};
    const RegistrationKernels* kernels = kernels_named(isa)->registration;
    const nb::gil_scoped_release unlocked;
    kernels->displace_depth(of, memory.data(), memory.data() + depth.shape(1), displaced.data());
}

// numbers: fx, fy, cx, cy; least depth, largest share of the depth of a gate in meters, that gate, a gate as a share of the depth,
// one of the inverse depth.
static void free_space(const std::string& isa, const DoubleInputs& points, const DoubleInputs& T_view_points, const Inputs& nearest,
                       const DoubleInputs& numbers, const Array<int8_t>& where) {
    const double* n = numbers.data();
    const JudgedPoints of = {points.shape(0), static_cast<int>(nearest.shape(1)), static_cast<int>(nearest.shape(0)), {n[0], n[1], n[2], n[3]},
                             n[4], n[5], n[6], n[7], n[8], points.data(), T_view_points.data(), nearest.data()};
    const RegistrationKernels* kernels = kernels_named(isa)->registration;
    const nb::gil_scoped_release unlocked;
    kernels->free_space(of, where.data());
}

static ImageWindows windows_of(const Inputs& image, const Inputs& weights) {
    return {image.shape(1), image.shape(0), image.shape(2), image.data(), weights.data()};
}

static void window_means(const std::string& isa, const Inputs& image, const Inputs& weights, const Floats& means) {
    const RegistrationKernels* kernels = kernels_named(isa)->registration;
    const nb::gil_scoped_release unlocked;
    kernels->window_means(windows_of(image, weights), alignment_scratch().floats, means.data());
}

// weight: empty if all count alike.
static void window_terms(const std::string& isa, const Inputs& drawn, const Inputs& seen, const Inputs& mean, const Inputs& variance,
                         const Inputs& weight, const Inputs& weights, const Doubles& sums) {
    const ComparedWindows of = {windows_of(drawn, weights), seen.data(), mean.data(), variance.data(), data_or_null(weight)};
    const RegistrationKernels* kernels = kernels_named(isa)->registration;
    const nb::gil_scoped_release unlocked;
    kernels->window_terms(of, alignment_scratch().floats, sums.data());
}

// images: drawn, alpha, seen. mask: empty if all pixels count. exposure: gain and offset by channel.
static double squared_error(const std::string& isa, const Inputs& drawn, const Inputs& alpha, const Inputs& seen, const Bytes& mask,
                            const Inputs& exposure, int left, int right) {
    const ExposedImage of = {drawn.shape(1), drawn.shape(0), static_cast<size_t>(left), static_cast<size_t>(right), drawn.data(), alpha.data(),
                             seen.data(), data_or_null(mask), exposure.data(), exposure.data() + 3};
    const RegistrationKernels* kernels = kernels_named(isa)->registration;
    const nb::gil_scoped_release unlocked;
    return kernels->squared_error(of, alignment_scratch().floats);
}

static void define_registration(nb::module_& m) {
    nb::class_<LevelArrays>(m, "LevelArrays")
        .def(nb::init<const Inputs&, const Inputs&, const Inputs&, const Inputs&, const Inputs&, const Inputs&, const Inputs&, const Inputs&,
                      const Inputs&, bool>());
    m.attr("SYSTEM_SIZE") = 6 + 2 * EQUATIONS;
    m.attr("ALIGNMENT_TILES") = nb::make_tuple(TILE_COLUMNS, TILE_ROWS);
    m.def("align_at", align_at);
    m.def("align", align);
    m.def("gray_of_bytes", gray_of_bytes);
    m.def("gray_of_floats", gray_of_floats);
    m.def("invert_depth", invert_depth);
    m.def("halve", halve);
    m.def("surface_normals", surface_normals);
    m.def("move_depth", move_depth);
    m.def("draw_triangles", draw_triangles);
    m.def("register_depth", register_depth);
    m.def("displace_depth", displace_depth);
    m.def("free_space", free_space);
    m.def("window_means", window_means);
    m.def("window_terms", window_terms);
    m.def("squared_error", squared_error);
}

}  // namespace raster
