// The Python module of the simulated room. Shapes are checked by renderer.py, the only caller, which defines what it computes.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>
#include <vector>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace nb = nanobind;
using namespace nb::literals;

template <class T>
using Array = nb::ndarray<T, nb::numpy, nb::c_contig, nb::device::cpu>;

constexpr double EDGE_TOLERANCE_M = 1e-9;
constexpr int INSIDE = 4, BORDER = 16;
constexpr double INSIDE_OFFSETS[2][INSIDE] = {{-0.25, 0.25, -0.25, 0.25}, {-0.25, -0.25, 0.25, 0.25}};
constexpr double BORDER_OFFSETS[4] = {-0.375, -0.125, 0.125, 0.375};
constexpr float FINEST_STEP2 = 4.0f;  // texels: farther apart, samples of the finest level miss something

// A flat surface in view. linear: coefficients (of u, of v, constant) of D, s D and t D; origin: texel of (s, t) = (0, 0).
struct Surface {
    const double (*linear)[3];
    double width, height, origin_x, origin_y;
    bool disc;
};

struct Surfaces {
    const double* linear;  // [n, 3, 3]
    const double* extent;  // [n, 2]
    const double* origin;  // [n, 2]
    const uint8_t* kind;   // [n]

    enum Kind : uint8_t { RECTANGLE, DISC, CURVED };
    bool flat(int k) const { return kind[k] != CURVED; }
    Surface operator[](int k) const {
        const double *size = extent + 2 * k, *texel = origin + 2 * k;
        return {reinterpret_cast<const double (*)[3]>(linear + 9 * k), size[0], size[1], texel[0], texel[1], kind[k] == DISC};
    }
};

// One level of the colors of all surfaces.
struct Texels {
    const uint8_t* colors;  // [height, width, 3]
    std::ptrdiff_t width, height;

    explicit Texels(const Array<const uint8_t>& level)
        : colors(level.data()), width(static_cast<std::ptrdiff_t>(level.shape(1))), height(static_cast<std::ptrdiff_t>(level.shape(0))) {}
};

// The functions of one instruction set; what they do is said where the module defines them.
struct Build {
    void (*nearest)(const Surface& surface, int16_t k, const int32_t* window, std::ptrdiff_t stride, double* nearest, int16_t* seen);
    void (*colors)(const Surfaces& surfaces, const int16_t* seen, int width, int height, const Texels& texels, double scale,
                   uint8_t* color, float* step2, uint8_t* left);
    void (*between)(const Surface& surface, const Texels* levels, float level, double scale, double u, double v, uint8_t* color);
};

#define FLAT_ISA portable
#define FLAT_X86 0
#include "flat_surfaces.h"
#undef FLAT_ISA
#undef FLAT_X86

// Compilers that cannot change the instruction set within a file use the portable build, whose fmaf is as exact.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define HAVE_FUSED
#pragma GCC push_options
#pragma GCC target("avx2,fma,bmi2")
#define FLAT_ISA fused
#define FLAT_X86 1
#include "flat_surfaces.h"
#undef FLAT_ISA
#pragma GCC pop_options
#endif

static const Build& build_named(const std::string& isa) {
#if defined(HAVE_FUSED)
    static const bool runs = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
    if (isa != "portable" && runs) return fused::build;
#endif
    if (isa == "fused") throw std::invalid_argument("isa: fused is not available on this processor");
    return portable::build;
}

using Reals = Array<const double>;
using Bytes = Array<const uint8_t>;
using Seen = Array<const int16_t>;

static int rows(const Seen& seen) { return static_cast<int>(seen.shape(0)); }
static int columns(const Seen& seen) { return static_cast<int>(seen.shape(1)); }

// order, windows [m], [m, 4] (u0, v0, u1, v1): surfaces that may be seen. nearest, seen [h, w] are changed.
static void nearest(const std::string& isa, const Reals& linear, const Reals& extent, const Bytes& kind, const Array<const int32_t>& order,
                    const Array<const int32_t>& windows, const Array<double>& nearest, const Array<int16_t>& seen) {
    const Surfaces surfaces = {linear.data(), extent.data(), extent.data(), kind.data()};  // where texels are is not asked
    const Build& build = build_named(isa);
    const nb::gil_scoped_release unlocked;
    for (size_t i = 0; i < order.size(); i++) {
        const int k = order.data()[i];
        build.nearest(surfaces[k], static_cast<int16_t>(k), windows.data() + 4 * i, static_cast<std::ptrdiff_t>(seen.shape(1)),
                      nearest.data(), seen.data());
    }
}

// color [h, w, 3]; step2 [h, w]: squared distance (texels) of samples where one flat surface fills a pixel, which is not drawn
// where that is above FINEST_STEP2; left [h, w]: pixels that are not drawn since curved surfaces are in them.
static void colors(const std::string& isa, const Reals& linear, const Reals& extent, const Bytes& kind, const Reals& origin, const Seen& seen,
                   const Bytes& texels, double scale, const Array<uint8_t>& color, const Array<float>& step2, const Array<uint8_t>& left) {
    const Surfaces surfaces = {linear.data(), extent.data(), origin.data(), kind.data()};
    const Build& build = build_named(isa);
    const nb::gil_scoped_release unlocked;
    build.colors(surfaces, seen.data(), columns(seen), rows(seen), Texels(texels), scale, color.data(), step2.data(), left.data());
}

// pixels, level [n]: pixels that one flat surface fills, and the levels to draw them with, below the last one.
static void colors_between(const std::string& isa, const Reals& linear, const Reals& extent, const Bytes& kind, const Reals& origin,
                           const Seen& seen, const std::vector<Bytes>& texels, double scale, const Array<const int64_t>& pixels,
                           const Array<const float>& level, const Array<uint8_t>& color) {
    const Surfaces surfaces = {linear.data(), extent.data(), origin.data(), kind.data()};
    const std::vector<Texels> levels(texels.begin(), texels.end());
    const Build& build = build_named(isa);
    const nb::gil_scoped_release unlocked;
    for (size_t i = 0; i < pixels.size(); i++) {
        const int64_t pixel = pixels.data()[i];
        build.between(surfaces[seen.data()[pixel]], levels.data(), level.data()[i], scale, static_cast<double>(pixel % columns(seen)),
                      static_cast<double>(pixel / columns(seen)), color.data() + 3 * pixel);
    }
}

// isa: "auto", "fused" or "portable", which give the same bits.
NB_MODULE(_flat_surfaces, m) {
    m.def("nearest", &nearest, "isa"_a, "linear"_a, "extent"_a, "kind"_a, "order"_a, "windows"_a, "nearest"_a, "seen"_a);
    m.def("colors", &colors, "isa"_a, "linear"_a, "extent"_a, "kind"_a, "origin"_a, "seen"_a, "texels"_a, "scale"_a, "color"_a, "step2"_a,
          "left"_a);
    m.def("colors_between", &colors_between, "isa"_a, "linear"_a, "extent"_a, "kind"_a, "origin"_a, "seen"_a, "texels"_a, "scale"_a,
          "pixels"_a, "level"_a, "color"_a);
}
