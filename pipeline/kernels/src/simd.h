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

#if !defined(KERNEL_PORTABLE) && defined(__AVX512F__)

struct Mask {
    __mmask16 bits;
};
struct Vec {
    __m512 v;
    Vec() = default;
    Vec(__m512 x) : v(x) {}
    Vec(float s) : v(_mm512_set1_ps(s)) {}
};

inline Vec load(const float* p) { return _mm512_load_ps(p); }
inline void store(float* p, Vec a) { _mm512_store_ps(p, a.v); }
inline Vec operator+(Vec a, Vec b) { return _mm512_add_ps(a.v, b.v); }
inline Vec operator-(Vec a, Vec b) { return _mm512_sub_ps(a.v, b.v); }
inline Vec operator*(Vec a, Vec b) { return _mm512_mul_ps(a.v, b.v); }
inline Vec operator/(Vec a, Vec b) { return _mm512_div_ps(a.v, b.v); }
inline Vec fma(Vec a, Vec b, Vec c) { return _mm512_fmadd_ps(a.v, b.v, c.v); }    // a b + c
inline Vec fnma(Vec a, Vec b, Vec c) { return _mm512_fnmadd_ps(a.v, b.v, c.v); }  // c - a b
inline Vec min(Vec a, Vec b) { return _mm512_min_ps(a.v, b.v); }                  // b where either is NaN
inline Vec max(Vec a, Vec b) { return _mm512_max_ps(a.v, b.v); }
inline Vec sqrt(Vec a) { return _mm512_sqrt_ps(a.v); }
inline void pin(Vec& a) { asm("" : "+v"(a.v)); }  // computed here, not later: keeps independent chains side by side
inline Mask operator>=(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
inline Mask operator<=(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LE_OQ)}; }
inline Mask operator<(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ)}; }
inline Mask operator&(Mask a, Mask b) { return {(__mmask16)(a.bits & b.bits)}; }
inline Vec select(Mask m, Vec a, Vec b) { return _mm512_mask_blend_ps(m.bits, b.v, a.v); }  // m ? a : b
inline Vec select_or_zero(Mask m, Vec a) { return _mm512_maskz_mov_ps(m.bits, a.v); }
inline uint32_t bits(Mask m) { return m.bits; }
inline Mask mask_of_bits(uint32_t b) { return {(__mmask16)b}; }
inline bool any(Mask m) { return m.bits != 0; }

// 2^n x for an integer n held in the low mantissa bits of `shifted` (see exp2)
inline Vec scale_by_power(Vec x, Vec shifted) {
    return _mm512_castsi512_ps(
        _mm512_add_epi32(_mm512_castps_si512(x.v), _mm512_slli_epi32(_mm512_castps_si512(shifted.v), 23)));
}
// x = mantissa 2^exponent with mantissa in [1, 2), for normal positive x
inline void split_exponent(Vec x, Vec& mantissa, Vec& exponent) {
    const __m512i i = _mm512_castps_si512(x.v);
    exponent = _mm512_cvtepi32_ps(_mm512_sub_epi32(_mm512_srli_epi32(i, 23), _mm512_set1_epi32(127)));
    mantissa = _mm512_castsi512_ps(
        _mm512_or_si512(_mm512_and_si512(i, _mm512_set1_epi32(0x007fffff)), _mm512_set1_epi32(0x3f800000)));
}

// Four rows of four floats, `stride` floats apart.
inline Vec load4x4(const float* p, size_t stride) {
    const __m256 top = _mm256_set_m128(_mm_loadu_ps(p + stride), _mm_loadu_ps(p));
    const __m256 bottom = _mm256_set_m128(_mm_loadu_ps(p + 3 * stride), _mm_loadu_ps(p + 2 * stride));
    return _mm512_insertf32x8(_mm512_castps256_ps512(top), bottom, 1);
}
inline void store4x4(float* p, size_t stride, Vec a) {
    _mm_storeu_ps(p, _mm512_castps512_ps128(a.v));
    _mm_storeu_ps(p + stride, _mm512_extractf32x4_ps(a.v, 1));
    _mm_storeu_ps(p + 2 * stride, _mm512_extractf32x4_ps(a.v, 2));
    _mm_storeu_ps(p + 3 * stride, _mm512_extractf32x4_ps(a.v, 3));
}
// Within every four lanes: the elements A, B, C, D.
template <int A, int B, int C, int D>
inline Vec permute4(Vec a) {
    return _mm512_permute_ps(a.v, A | B << 2 | C << 4 | D << 6);
}
// Within every four lanes: from a where bit of FROM_A, from b where bit of FROM_B, else from c.
template <int FROM_A, int FROM_B>
inline Vec merge4(Vec a, Vec b, Vec c) {
    return _mm512_mask_blend_ps(FROM_A * 0x1111, _mm512_mask_blend_ps(FROM_B * 0x1111, c.v, b.v), a.v);
}

using Wide = Vec;  // lanes that stand for Gaussians
constexpr int PARTS = 1;  // of a Vec
inline Wide part(const Vec& a, int) { return a; }
inline void set_part(Vec& a, int, Wide x) { a = x; }

#elif !defined(KERNEL_PORTABLE) && defined(__AVX2__)

struct Mask {
    __m256 a, b;
};
struct Vec {
    __m256 a, b;
    Vec() = default;
    Vec(__m256 x, __m256 y) : a(x), b(y) {}
    Vec(float s) : a(_mm256_set1_ps(s)), b(a) {}
};

inline Vec load(const float* p) { return {_mm256_load_ps(p), _mm256_load_ps(p + 8)}; }
inline void store(float* p, Vec x) {
    _mm256_store_ps(p, x.a);
    _mm256_store_ps(p + 8, x.b);
}
inline Vec operator+(Vec x, Vec y) { return {_mm256_add_ps(x.a, y.a), _mm256_add_ps(x.b, y.b)}; }
inline Vec operator-(Vec x, Vec y) { return {_mm256_sub_ps(x.a, y.a), _mm256_sub_ps(x.b, y.b)}; }
inline Vec operator*(Vec x, Vec y) { return {_mm256_mul_ps(x.a, y.a), _mm256_mul_ps(x.b, y.b)}; }
inline Vec operator/(Vec x, Vec y) { return {_mm256_div_ps(x.a, y.a), _mm256_div_ps(x.b, y.b)}; }
inline Vec fma(Vec x, Vec y, Vec z) {
    return {_mm256_fmadd_ps(x.a, y.a, z.a), _mm256_fmadd_ps(x.b, y.b, z.b)};
}
inline Vec fnma(Vec x, Vec y, Vec z) {
    return {_mm256_fnmadd_ps(x.a, y.a, z.a), _mm256_fnmadd_ps(x.b, y.b, z.b)};
}
inline Vec min(Vec x, Vec y) { return {_mm256_min_ps(x.a, y.a), _mm256_min_ps(x.b, y.b)}; }
inline Vec max(Vec x, Vec y) { return {_mm256_max_ps(x.a, y.a), _mm256_max_ps(x.b, y.b)}; }
inline Vec sqrt(Vec x) { return {_mm256_sqrt_ps(x.a), _mm256_sqrt_ps(x.b)}; }
inline void pin(Vec& x) { asm("" : "+x"(x.a), "+x"(x.b)); }
inline Mask operator>=(Vec x, Vec y) {
    return {_mm256_cmp_ps(x.a, y.a, _CMP_GE_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_GE_OQ)};
}
inline Mask operator<=(Vec x, Vec y) {
    return {_mm256_cmp_ps(x.a, y.a, _CMP_LE_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_LE_OQ)};
}
inline Mask operator<(Vec x, Vec y) {
    return {_mm256_cmp_ps(x.a, y.a, _CMP_LT_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_LT_OQ)};
}
inline Mask operator&(Mask x, Mask y) { return {_mm256_and_ps(x.a, y.a), _mm256_and_ps(x.b, y.b)}; }
inline Vec select(Mask m, Vec x, Vec y) {
    return {_mm256_blendv_ps(y.a, x.a, m.a), _mm256_blendv_ps(y.b, x.b, m.b)};
}
inline Vec select_or_zero(Mask m, Vec x) { return {_mm256_and_ps(m.a, x.a), _mm256_and_ps(m.b, x.b)}; }
inline uint32_t bits(Mask m) {
    return (uint32_t)_mm256_movemask_ps(m.a) | ((uint32_t)_mm256_movemask_ps(m.b) << 8);
}
inline Mask mask_of_bits(uint32_t b) {
    const __m256i all = _mm256_set1_epi32(static_cast<int>(b));
    const __m256i low = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128), high = _mm256_slli_epi32(low, 8);
    return {_mm256_castsi256_ps(_mm256_cmpeq_epi32(_mm256_and_si256(all, low), low)),
            _mm256_castsi256_ps(_mm256_cmpeq_epi32(_mm256_and_si256(all, high), high))};
}
inline bool any(Mask m) { return _mm256_movemask_ps(_mm256_or_ps(m.a, m.b)) != 0; }

inline __m256 scale_by_power(__m256 x, __m256 shifted) {
    return _mm256_castsi256_ps(
        _mm256_add_epi32(_mm256_castps_si256(x), _mm256_slli_epi32(_mm256_castps_si256(shifted), 23)));
}
inline Vec scale_by_power(Vec x, Vec shifted) {
    return {scale_by_power(x.a, shifted.a), scale_by_power(x.b, shifted.b)};
}
inline void split_exponent(__m256 x, __m256& mantissa, __m256& exponent) {
    const __m256i i = _mm256_castps_si256(x);
    exponent = _mm256_cvtepi32_ps(_mm256_sub_epi32(_mm256_srli_epi32(i, 23), _mm256_set1_epi32(127)));
    mantissa = _mm256_castsi256_ps(
        _mm256_or_si256(_mm256_and_si256(i, _mm256_set1_epi32(0x007fffff)), _mm256_set1_epi32(0x3f800000)));
}
inline void split_exponent(Vec x, Vec& mantissa, Vec& exponent) {
    split_exponent(x.a, mantissa.a, exponent.a);
    split_exponent(x.b, mantissa.b, exponent.b);
}

inline Vec load4x4(const float* p, size_t stride) {
    return {_mm256_set_m128(_mm_loadu_ps(p + stride), _mm_loadu_ps(p)),
            _mm256_set_m128(_mm_loadu_ps(p + 3 * stride), _mm_loadu_ps(p + 2 * stride))};
}
inline void store4x4(float* p, size_t stride, Vec x) {
    _mm_storeu_ps(p, _mm256_castps256_ps128(x.a));
    _mm_storeu_ps(p + stride, _mm256_extractf128_ps(x.a, 1));
    _mm_storeu_ps(p + 2 * stride, _mm256_castps256_ps128(x.b));
    _mm_storeu_ps(p + 3 * stride, _mm256_extractf128_ps(x.b, 1));
}
template <int A, int B, int C, int D>
inline Vec permute4(Vec x) {
    constexpr int order = A | B << 2 | C << 4 | D << 6;
    return {_mm256_permute_ps(x.a, order), _mm256_permute_ps(x.b, order)};
}
template <int FROM_A, int FROM_B>
inline Vec merge4(Vec x, Vec y, Vec z) {
    return {_mm256_blend_ps(_mm256_blend_ps(z.a, y.a, FROM_B * 0x11), x.a, FROM_A * 0x11),
            _mm256_blend_ps(_mm256_blend_ps(z.b, y.b, FROM_B * 0x11), x.b, FROM_A * 0x11)};
}

// Lanes that stand for Gaussians: half as many, so that their sums stay in the sixteen registers.
struct Wide {
    __m256 v;
    Wide() = default;
    Wide(__m256 x) : v(x) {}
    Wide(float s) : v(_mm256_set1_ps(s)) {}
};
constexpr int PARTS = 2;
inline Wide part(const Vec& x, int k) { return k ? x.b : x.a; }
inline void set_part(Vec& x, int k, Wide w) { (k ? x.b : x.a) = w.v; }
inline Wide operator+(Wide a, Wide b) { return _mm256_add_ps(a.v, b.v); }
inline Wide operator-(Wide a, Wide b) { return _mm256_sub_ps(a.v, b.v); }
inline Wide operator*(Wide a, Wide b) { return _mm256_mul_ps(a.v, b.v); }
inline Wide fma(Wide a, Wide b, Wide c) { return _mm256_fmadd_ps(a.v, b.v, c.v); }
inline Wide& operator+=(Wide& a, Wide b) { return a = a + b; }

#elif !defined(KERNEL_PORTABLE) && defined(__aarch64__)

struct Mask {
    uint32x4_t q[4];
};
struct Vec {
    float32x4_t q[4];
    Vec() = default;
    Vec(float32x4_t a, float32x4_t b, float32x4_t c, float32x4_t d) : q{a, b, c, d} {}
    Vec(float s) : q{vdupq_n_f32(s), vdupq_n_f32(s), vdupq_n_f32(s), vdupq_n_f32(s)} {}
};

// All four quarters of a Vec or a Mask.
template <class Result, class Quarter>
ALWAYS_INLINE inline Result quarters(Quarter quarter) {
    return {quarter(0), quarter(1), quarter(2), quarter(3)};
}

inline Vec load(const float* p) {
    return quarters<Vec>([&](int k) ALWAYS_INLINE { return vld1q_f32(p + 4 * k); });
}
inline void store(float* p, Vec x) {
    unrolled<4>([&](auto k) ALWAYS_INLINE { vst1q_f32(p + 4 * k, x.q[k]); });
}
inline Vec operator+(Vec x, Vec y) {
    return quarters<Vec>([&](int k) ALWAYS_INLINE { return vaddq_f32(x.q[k], y.q[k]); });
}
inline Vec operator-(Vec x, Vec y) {
    return quarters<Vec>([&](int k) ALWAYS_INLINE { return vsubq_f32(x.q[k], y.q[k]); });
}
inline Vec operator*(Vec x, Vec y) {
    return quarters<Vec>([&](int k) ALWAYS_INLINE { return vmulq_f32(x.q[k], y.q[k]); });
}
inline Vec operator/(Vec x, Vec y) {
    return quarters<Vec>([&](int k) ALWAYS_INLINE { return vdivq_f32(x.q[k], y.q[k]); });
}
inline Vec fma(Vec x, Vec y, Vec z) {
    return quarters<Vec>([&](int k) ALWAYS_INLINE { return vfmaq_f32(z.q[k], x.q[k], y.q[k]); });
}
inline Vec fnma(Vec x, Vec y, Vec z) {
    return quarters<Vec>([&](int k) ALWAYS_INLINE { return vfmsq_f32(z.q[k], x.q[k], y.q[k]); });
}
// By comparison: vminq and vmaxq return NaN where either is, and order the zeros.
inline Vec min(Vec x, Vec y) {
    return quarters<Vec>([&](int k) ALWAYS_INLINE { return vbslq_f32(vcltq_f32(x.q[k], y.q[k]), x.q[k], y.q[k]); });
}
inline Vec max(Vec x, Vec y) {
    return quarters<Vec>([&](int k) ALWAYS_INLINE { return vbslq_f32(vcgtq_f32(x.q[k], y.q[k]), x.q[k], y.q[k]); });
}
inline Vec sqrt(Vec x) {
    return quarters<Vec>([&](int k) ALWAYS_INLINE { return vsqrtq_f32(x.q[k]); });
}
inline void pin(Vec& x) { asm("" : "+w"(x.q[0]), "+w"(x.q[1]), "+w"(x.q[2]), "+w"(x.q[3])); }
inline Mask operator>=(Vec x, Vec y) {
    return quarters<Mask>([&](int k) ALWAYS_INLINE { return vcgeq_f32(x.q[k], y.q[k]); });
}
inline Mask operator<=(Vec x, Vec y) {
    return quarters<Mask>([&](int k) ALWAYS_INLINE { return vcleq_f32(x.q[k], y.q[k]); });
}
inline Mask operator<(Vec x, Vec y) {
    return quarters<Mask>([&](int k) ALWAYS_INLINE { return vcltq_f32(x.q[k], y.q[k]); });
}
inline Mask operator&(Mask x, Mask y) {
    return quarters<Mask>([&](int k) ALWAYS_INLINE { return vandq_u32(x.q[k], y.q[k]); });
}
inline Vec select(Mask m, Vec x, Vec y) {
    return quarters<Vec>([&](int k) ALWAYS_INLINE { return vbslq_f32(m.q[k], x.q[k], y.q[k]); });
}
inline Vec select_or_zero(Mask m, Vec x) {
    return quarters<Vec>([&](int k) ALWAYS_INLINE { return vreinterpretq_f32_u32(vandq_u32(m.q[k], vreinterpretq_u32_f32(x.q[k]))); });
}
// Bit k: byte k, all ones or zero.
inline uint32_t bits(uint8x16_t bytes) {
    const uint8x16_t weights = {1, 2, 4, 8, 16, 32, 64, 128, 1, 2, 4, 8, 16, 32, 64, 128};
    uint8x16_t sums = vandq_u8(bytes, weights);
    for (int i = 0; i < 3; i++) sums = vpaddq_u8(sums, sums);
    return vgetq_lane_u16(vreinterpretq_u16_u8(sums), 0);
}
// The low halves of the elements of a, then of b.
inline uint16x8_t low_halves(uint32x4_t a, uint32x4_t b) { return vuzp1q_u16(vreinterpretq_u16_u32(a), vreinterpretq_u16_u32(b)); }
inline uint8x16_t low_halves(uint16x8_t a, uint16x8_t b) { return vuzp1q_u8(vreinterpretq_u8_u16(a), vreinterpretq_u8_u16(b)); }
inline uint32_t bits(Mask m) { return bits(low_halves(low_halves(m.q[0], m.q[1]), low_halves(m.q[2], m.q[3]))); }
inline Mask mask_of_bits(uint32_t b) {
    const uint32x4_t weights = {1, 2, 4, 8};
    return quarters<Mask>([&](int k) ALWAYS_INLINE { return vtstq_u32(vdupq_n_u32(b >> 4 * k), weights); });
}
inline bool any(Mask m) { return vmaxvq_u32(vorrq_u32(vorrq_u32(m.q[0], m.q[1]), vorrq_u32(m.q[2], m.q[3]))) != 0; }

inline Vec scale_by_power(Vec x, Vec shifted) {
    return quarters<Vec>([&](int k) ALWAYS_INLINE {
        const uint32x4_t power = vshlq_n_u32(vreinterpretq_u32_f32(shifted.q[k]), 23);
        return vreinterpretq_f32_u32(vaddq_u32(vreinterpretq_u32_f32(x.q[k]), power));
    });
}
inline void split_exponent(Vec x, Vec& mantissa, Vec& exponent) {
    unrolled<4>([&](auto k) ALWAYS_INLINE {
        const uint32x4_t i = vreinterpretq_u32_f32(x.q[k]);
        exponent.q[k] = vcvtq_f32_s32(vsubq_s32(vreinterpretq_s32_u32(vshrq_n_u32(i, 23)), vdupq_n_s32(127)));
        mantissa.q[k] = vreinterpretq_f32_u32(vorrq_u32(vandq_u32(i, vdupq_n_u32(0x007fffff)), vdupq_n_u32(0x3f800000)));
    });
}

inline Vec load4x4(const float* p, size_t stride) {
    return quarters<Vec>([&](int k) ALWAYS_INLINE { return vld1q_f32(p + k * stride); });
}
inline void store4x4(float* p, size_t stride, Vec x) {
    unrolled<4>([&](auto k) ALWAYS_INLINE { vst1q_f32(p + k * stride, x.q[k]); });
}
template <int A, int B, int C, int D>
inline Vec permute4(Vec x) {
    return quarters<Vec>([&](int k) ALWAYS_INLINE { return float32x4_t{x.q[k][A], x.q[k][B], x.q[k][C], x.q[k][D]}; });
}
template <int SET>
inline uint32x4_t mask4() {
    return uint32x4_t{SET & 1 ? ~0u : 0, SET & 2 ? ~0u : 0, SET & 4 ? ~0u : 0, SET & 8 ? ~0u : 0};
}
template <int FROM_A, int FROM_B>
inline Vec merge4(Vec x, Vec y, Vec z) {
    return quarters<Vec>([&](int k) ALWAYS_INLINE { return vbslq_f32(mask4<FROM_A>(), x.q[k], vbslq_f32(mask4<FROM_B>(), y.q[k], z.q[k])); });
}

// Lanes that stand for Gaussians: one register, so that the eighteen sums of the information stay in the thirty-two.
struct Wide {
    float32x4_t v;
    Wide() = default;
    Wide(float32x4_t x) : v(x) {}
    Wide(float s) : v(vdupq_n_f32(s)) {}
};
constexpr int PARTS = 4;
inline Wide part(const Vec& x, int k) { return x.q[k]; }
inline void set_part(Vec& x, int k, Wide w) { x.q[k] = w.v; }
inline Wide operator+(Wide a, Wide b) { return vaddq_f32(a.v, b.v); }
inline Wide operator-(Wide a, Wide b) { return vsubq_f32(a.v, b.v); }
inline Wide operator*(Wide a, Wide b) { return vmulq_f32(a.v, b.v); }
inline Wide fma(Wide a, Wide b, Wide c) { return vfmaq_f32(c.v, a.v, b.v); }
inline Wide& operator+=(Wide& a, Wide b) { return a = a + b; }

#else  // portable: vectors of the compiler, which become SSE2, NEON or plain loops

typedef float Float16 __attribute__((vector_size(64)));
typedef int32_t Int16 __attribute__((vector_size(64)));

struct Mask {
    Int16 m;  // -1 or 0
};
struct Vec {
    Float16 v;
    Vec() = default;
    Vec(Float16 x) : v(x) {}
    Vec(float s) : v(Float16{} + s) {}
};

inline Int16 as_int(Float16 x) {
    Int16 i;
    std::memcpy(&i, &x, sizeof i);
    return i;
}
inline Float16 as_float(Int16 i) {
    Float16 x;
    std::memcpy(&x, &i, sizeof x);
    return x;
}
inline Vec load(const float* p) {
    Vec r;
    std::memcpy(&r.v, p, sizeof r.v);
    return r;
}
inline void store(float* p, Vec a) { std::memcpy(p, &a.v, sizeof a.v); }
inline Vec operator+(Vec a, Vec b) { return a.v + b.v; }
inline Vec operator-(Vec a, Vec b) { return a.v - b.v; }
inline Vec operator*(Vec a, Vec b) { return a.v * b.v; }
inline Vec operator/(Vec a, Vec b) { return a.v / b.v; }
inline Mask operator>=(Vec a, Vec b) { return {(Int16)(a.v >= b.v)}; }
inline Mask operator<=(Vec a, Vec b) { return {(Int16)(a.v <= b.v)}; }
inline Mask operator<(Vec a, Vec b) { return {(Int16)(a.v < b.v)}; }
inline Mask operator&(Mask a, Mask b) { return {a.m & b.m}; }
inline Vec select(Mask m, Vec a, Vec b) { return as_float((as_int(a.v) & m.m) | (as_int(b.v) & ~m.m)); }
inline Vec select_or_zero(Mask m, Vec a) { return as_float(as_int(a.v) & m.m); }
inline Vec min(Vec a, Vec b) { return select(a < b, a, b); }
inline Vec max(Vec a, Vec b) { return select(b < a, a, b); }
inline void pin(Vec&) {}
inline Vec sqrt(Vec a) {
    Vec r;
    for (int i = 0; i < LANES; i++) r.v[i] = __builtin_sqrtf(a.v[i]);
    return r;
}
inline uint32_t bits(Mask m) {
    uint32_t r = 0;
    for (int i = 0; i < LANES; i++) r |= (uint32_t)(m.m[i] & 1) << i;
    return r;
}
inline Mask mask_of_bits(uint32_t b) {
    Mask r;
    for (int i = 0; i < LANES; i++) r.m[i] = -static_cast<int32_t>(b >> i & 1);
    return r;
}
inline bool any(Mask m) {
    int64_t words[8], all = 0;
    std::memcpy(words, &m.m, sizeof words);
    for (int64_t w : words) all |= w;
    return all != 0;
}

#if defined(__FP_FAST_FMAF)
inline Vec fma(Vec a, Vec b, Vec c) {
    Vec r;
    for (int i = 0; i < LANES; i++) r.v[i] = __builtin_fmaf(a.v[i], b.v[i], c.v[i]);
    return r;
}
#else
// Fused multiply-add without the instruction. The product of two floats is exact in double; their sum with c is
// rounded to odd there (last bit set if inexact), so that the rounding to float that follows is the only one.
typedef double Double4 __attribute__((vector_size(32)));
typedef float Float4 __attribute__((vector_size(16)));
typedef int64_t Long4 __attribute__((vector_size(32)));

inline Float4 fma_exact(Float4 a, Float4 b, Float4 c) {
    const Double4 product = __builtin_convertvector(a, Double4) * __builtin_convertvector(b, Double4);
    const Double4 addend = __builtin_convertvector(c, Double4);
    const Double4 sum = product + addend;
    const Double4 back = sum - product;
    const Double4 error = (product - (sum - back)) + (addend - back);
    Long4 word;
    std::memcpy(&word, &sum, sizeof word);
    const Long4 inexact = (Long4)(error < 0.0) | (Long4)(error > 0.0);
    const Long4 toward_zero = (Long4)(error > 0.0) ^ (Long4)(sum > 0.0);
    const Long4 step = inexact & ~word & 1;            // only an even neighbor moves
    word += (step ^ toward_zero) - toward_zero;        // -step where the true value is nearer to zero
    Double4 odd;
    std::memcpy(&odd, &word, sizeof odd);
    return __builtin_convertvector(odd, Float4);
}
// Not inlined: hundreds of instructions in hundreds of places took the compiler a minute, and ran a tenth faster.
NO_INLINE static Vec fma(const Vec& a, const Vec& b, const Vec& c) {
    Float4 x[4], y[4], z[4];
    std::memcpy(x, &a.v, sizeof x);
    std::memcpy(y, &b.v, sizeof y);
    std::memcpy(z, &c.v, sizeof z);
    for (int i = 0; i < 4; i++) x[i] = fma_exact(x[i], y[i], z[i]);
    Vec r;
    std::memcpy(&r.v, x, sizeof x);
    return r;
}
#endif
inline Vec fnma(Vec a, Vec b, Vec c) { return fma(Vec(-a.v), b, c); }

inline Vec scale_by_power(Vec x, Vec shifted) { return as_float(as_int(x.v) + (as_int(shifted.v) << 23)); }
inline void split_exponent(Vec x, Vec& mantissa, Vec& exponent) {
    const Int16 i = as_int(x.v);
    exponent = __builtin_convertvector((i >> 23) - 127, Float16);
    mantissa = as_float((i & 0x007fffff) | 0x3f800000);
}

inline Vec load4x4(const float* p, size_t stride) {
    Vec r;
    for (int i = 0; i < LANES; i++) r.v[i] = p[i / 4 * stride + i % 4];
    return r;
}
inline void store4x4(float* p, size_t stride, Vec a) {
    for (int i = 0; i < LANES; i++) p[i / 4 * stride + i % 4] = a.v[i];
}
template <int A, int B, int C, int D>
inline Vec permute4(Vec a) {
    constexpr int from[4] = {A, B, C, D};
    Vec r;
    for (int i = 0; i < LANES; i++) r.v[i] = a.v[i / 4 * 4 + from[i % 4]];
    return r;
}
template <int FROM_A, int FROM_B>
inline Vec merge4(Vec a, Vec b, Vec c) {
    Vec r;
    for (int i = 0; i < LANES; i++) r.v[i] = FROM_A >> i % 4 & 1 ? a.v[i] : FROM_B >> i % 4 & 1 ? b.v[i] : c.v[i];
    return r;
}
using Wide = Vec;
constexpr int PARTS = 1;
inline Wide part(const Vec& a, int) { return a; }
inline void set_part(Vec& a, int, Wide x) { a = x; }

#endif

inline Vec& operator+=(Vec& a, Vec b) { return a = a + b; }
inline Vec operator-(Vec a) { return Vec(0.0f) - a; }

}  // namespace KERNEL_ISA
