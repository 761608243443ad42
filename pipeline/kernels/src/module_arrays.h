// What the parts of the Python module share: types of arrays, and the build for this processor.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <iterator>
#include <mutex>
#include <new>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "frame.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace raster {

#if defined(HAVE_AVX512)
extern const Kernels kernels_avx512;
#endif
#if defined(HAVE_AVX2)
extern const Kernels kernels_avx2;
#endif
#if defined(HAVE_NEON)
extern const Kernels kernels_neon;
#endif
extern const Kernels kernels_portable;

// The builds that this processor can run, fastest first.
static std::vector<const Kernels*> usable_kernels() {
    std::vector<const Kernels*> usable;
#if defined(HAVE_AVX512)
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512cd") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl"))
        usable.push_back(&kernels_avx512);
#endif
#if defined(HAVE_AVX2)
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2"))
        usable.push_back(&kernels_avx2);
#endif
#if defined(HAVE_NEON)
    usable.push_back(&kernels_neon);  // part of every 64-bit ARM processor
#endif
    usable.push_back(&kernels_portable);
    return usable;
}

template <class T>
using Array = nb::ndarray<T, nb::numpy, nb::c_contig, nb::device::cpu>;
using Floats = Array<float>;
using Inputs = Array<const float>;
using Bytes = Array<const uint8_t>;  // empty: not given

template <class A>
static auto data_or_null(const A& array) {
    return array.size() ? array.data() : nullptr;
}
static GaussianArrays arrays_of(const Inputs& means, const Inputs& quats, const Inputs& log_scales, const Inputs& colors,
                                const Inputs& logits) {
    return {means.shape(0), means.data(), quats.data(), log_scales.data(), colors.data(), logits.data()};
}

static const Kernels* kernels_named(const std::string& isa) {
    for (const Kernels* kernels : usable_kernels())
        if (isa == "auto" || isa == kernels->name) return kernels;
    throw std::invalid_argument("isa: " + isa + " is not available on this processor");
}

}  // namespace raster
