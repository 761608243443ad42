// Sixteen float lanes: one AVX-512 register, two AVX2 registers, or a compiler vector (portable).
//
// Every operation rounds the same way in all three, and sums over lanes use one fixed tree, so that a kernel
// gives the same bits on every instruction set. Include after KERNEL_ISA, the namespace of this build, is defined.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#if !defined(KERNEL_PORTABLE)
#include <immintrin.h>
#endif

namespace KERNEL_ISA {

constexpr int LANES = 16;

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
inline Mask operator>=(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
inline Mask operator<=(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LE_OQ)}; }
inline Mask operator<(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ)}; }
inline Mask operator&(Mask a, Mask b) { return {(__mmask16)(a.bits & b.bits)}; }
inline Vec select(Mask m, Vec a, Vec b) { return _mm512_mask_blend_ps(m.bits, b.v, a.v); }  // m ? a : b
inline Vec select_or_zero(Mask m, Vec a) { return _mm512_maskz_mov_ps(m.bits, a.v); }
inline uint32_t bits(Mask m) { return m.bits; }
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

// Each 128-bit part of the result holds that part's lane sums of a[0..3].
inline __m512 sum_quads(const Vec* a) {
    const __m512 s = _mm512_add_ps(_mm512_unpacklo_ps(a[0].v, a[1].v), _mm512_unpackhi_ps(a[0].v, a[1].v));
    const __m512 t = _mm512_add_ps(_mm512_unpacklo_ps(a[2].v, a[3].v), _mm512_unpackhi_ps(a[2].v, a[3].v));
    const __m512d x = _mm512_castps_pd(s), y = _mm512_castps_pd(t);
    return _mm512_add_ps(_mm512_castpd_ps(_mm512_unpacklo_pd(x, y)), _mm512_castpd_ps(_mm512_unpackhi_pd(x, y)));
}
inline __m512 sum_parts(__m512 x, __m512 y) {
    return _mm512_add_ps(_mm512_shuffle_f32x4(x, y, 0x88), _mm512_shuffle_f32x4(x, y, 0xdd));
}
// out[i] = sum of the lanes of a[i], i < 16; out 64-byte aligned
inline void store_sums16(float* out, const Vec* a) {
    const __m512 low = sum_parts(sum_quads(a), sum_quads(a + 4));
    const __m512 high = sum_parts(sum_quads(a + 8), sum_quads(a + 12));
    _mm512_store_ps(out, sum_parts(low, high));
}
// out[i] = sum of the lanes of a[i], i < 8; out 32-byte aligned
inline void store_sums8(float* out, const Vec* a) {
    const __m512 low = sum_parts(sum_quads(a), sum_quads(a + 4));
    _mm256_store_ps(out, _mm512_castps512_ps256(sum_parts(low, low)));
}

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

// The tree of the AVX-512 build: lanes within 128 bits, then the parts 0+1 and 2+3, then both halves.
inline __m256 sum_quads(__m256 a0, __m256 a1, __m256 a2, __m256 a3) {
    const __m256 s = _mm256_add_ps(_mm256_unpacklo_ps(a0, a1), _mm256_unpackhi_ps(a0, a1));
    const __m256 t = _mm256_add_ps(_mm256_unpacklo_ps(a2, a3), _mm256_unpackhi_ps(a2, a3));
    const __m256d x = _mm256_castps_pd(s), y = _mm256_castps_pd(t);
    return _mm256_add_ps(_mm256_castpd_ps(_mm256_unpacklo_pd(x, y)), _mm256_castpd_ps(_mm256_unpackhi_pd(x, y)));
}
inline __m128 sum_halves(__m256 x) { return _mm_add_ps(_mm256_castps256_ps128(x), _mm256_extractf128_ps(x, 1)); }
inline void store_sums4(float* out, const Vec* a) {
    const __m256 low = sum_quads(a[0].a, a[1].a, a[2].a, a[3].a);
    const __m256 high = sum_quads(a[0].b, a[1].b, a[2].b, a[3].b);
    _mm_store_ps(out, _mm_add_ps(sum_halves(low), sum_halves(high)));
}
inline void store_sums8(float* out, const Vec* a) {
    store_sums4(out, a);
    store_sums4(out + 4, a + 4);
}
inline void store_sums16(float* out, const Vec* a) {
    store_sums8(out, a);
    store_sums8(out + 8, a + 8);
}

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
    const Long4 step = inexact & ~word & 1;            // only an even neighbour moves
    word += (step ^ toward_zero) - toward_zero;        // -step where the true value is nearer to zero
    Double4 odd;
    std::memcpy(&odd, &word, sizeof odd);
    return __builtin_convertvector(odd, Float4);
}
inline Vec fma(Vec a, Vec b, Vec c) {
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

// The tree of the AVX-512 build.
inline float sum_lanes(Vec a) {
    float part[4];
    for (int p = 0; p < 4; p++) part[p] = (a.v[4 * p] + a.v[4 * p + 2]) + (a.v[4 * p + 1] + a.v[4 * p + 3]);
    return (part[0] + part[1]) + (part[2] + part[3]);
}
inline void store_sums8(float* out, const Vec* a) {
    for (int i = 0; i < 8; i++) out[i] = sum_lanes(a[i]);
}
inline void store_sums16(float* out, const Vec* a) {
    for (int i = 0; i < 16; i++) out[i] = sum_lanes(a[i]);
}

#endif

inline Vec& operator+=(Vec& a, Vec b) { return a = a + b; }
inline Vec operator-(Vec a) { return Vec(0.0f) - a; }

}  // namespace KERNEL_ISA
