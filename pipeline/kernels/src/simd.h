// Sixteen float lanes: one AVX-512 register, two AVX2 registers, four NEON registers, or a compiler vector (portable).
//
// Every operation rounds the same way in all of them, and sums over lanes use one fixed tree, so that a kernel
// gives the same bits on every instruction set. Include after KERNEL_ISA, the namespace of this build, is defined.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <utility>

#if !defined(KERNEL_PORTABLE) && defined(__aarch64__)
#include <arm_neon.h>
#elif !defined(KERNEL_PORTABLE)
#include <immintrin.h>
#endif

#define ALWAYS_INLINE __attribute__((always_inline))
#define NO_INLINE __attribute__((noinline))  // a loop of its own, with the registers to itself

namespace KERNEL_ISA {

constexpr int LANES = 16;

// step(0), ..., step(N - 1), each with its number as a constant: arrays indexed by it stay in registers.
template <class Step, int... K>
ALWAYS_INLINE inline void unrolled(Step&& step, std::integer_sequence<int, K...>) {
    (step(std::integral_constant<int, K>{}), ...);
}
template <int N, class Step>
ALWAYS_INLINE inline void unrolled(Step&& step) {
    unrolled(step, std::make_integer_sequence<int, N>{});
}

}  // namespace KERNEL_ISA

// The same functions in each; what they do is said in simd_avx512.h.
#if defined(KERNEL_PORTABLE)
#include "simd_portable.h"
#elif defined(__AVX512F__)
#include "simd_avx512.h"
#elif defined(__AVX2__)
#include "simd_avx2.h"
#elif defined(__aarch64__)
#include "simd_neon.h"
#else
#include "simd_portable.h"
#endif

namespace KERNEL_ISA {

inline Vec& operator+=(Vec& a, Vec b) { return a = a + b; }
inline Vec operator-(Vec a) { return Vec(0.0f) - a; }

}  // namespace KERNEL_ISA
