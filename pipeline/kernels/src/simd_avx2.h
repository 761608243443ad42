// Sixteen float lanes: two AVX2 registers. Part of simd.h, which includes it.
#pragma once

namespace KERNEL_ISA {

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
inline Vec look_up4x4(const float* table, const uint8_t* p, size_t stride) {
    const auto row = [&](size_t r) ALWAYS_INLINE {
        const uint8_t* v = p + r * stride;
        return _mm_setr_ps(table[3 * v[0]], table[3 * v[3]], table[3 * v[6]], table[3 * v[9]]);
    };
    return {_mm256_set_m128(row(1), row(0)), _mm256_set_m128(row(3), row(2))};
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

}  // namespace KERNEL_ISA
