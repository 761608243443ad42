// Sixteen float lanes: one AVX-512 register. Part of simd.h, which includes it.
#pragma once

namespace KERNEL_ISA {

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
// table[3 v] of the bytes v of four rows of four, 3 apart within a row and `stride` from row to row.
inline Vec look_up4x4(const float* table, const uint8_t* p, size_t stride) {
    const auto row = [&](size_t r) ALWAYS_INLINE {
        const uint8_t* v = p + r * stride;
        return _mm_setr_ps(table[3 * v[0]], table[3 * v[3]], table[3 * v[6]], table[3 * v[9]]);
    };
    const __m256 top = _mm256_set_m128(row(1), row(0)), bottom = _mm256_set_m128(row(3), row(2));
    return _mm512_insertf32x8(_mm512_castps256_ps512(top), bottom, 1);
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

}  // namespace KERNEL_ISA
