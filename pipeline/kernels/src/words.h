// Eight words of 16 bits.
//
// bits_between      word i has the bits counts[8 + i] to counts[i] - 1; counts are 0 to 16, fractions are cut off
// transpose_nibbles  for each half of the words, the transpose of a 4x4 matrix of four-bit numbers
// masked            the first four words and those of `low`, the others and those of `high`
// store_nonzero     the words that are not zero, and which of tile + 0, 1, 2, 3, tile + step + 0, 1, 2, 3 they belong to;
//                   returns how many; what lies behind them, up to eight, holds anything
#pragma once

#include "simd.h"

namespace KERNEL_ISA {

#if !defined(KERNEL_PORTABLE) && defined(__AVX2__)
typedef __m128i Words8;

#if defined(__AVX512F__)
inline Words8 bits_between(Vec counts) {
    const __m512i one = _mm512_set1_epi32(1);
    const __m512i power = _mm512_sllv_epi32(one, _mm512_cvttps_epi32(counts.v));
    const __m256i below = _mm512_cvtepi32_epi16(_mm512_sub_epi32(power, one));
    return _mm_andnot_si128(_mm256_extracti128_si256(below, 1), _mm256_castsi256_si128(below));
}
#else
inline Words8 bits_between(Vec counts) {
    const __m256i one = _mm256_set1_epi32(1);
    const __m256i right = _mm256_sub_epi32(_mm256_sllv_epi32(one, _mm256_cvttps_epi32(counts.a)), one);
    const __m256i left = _mm256_sub_epi32(_mm256_sllv_epi32(one, _mm256_cvttps_epi32(counts.b)), one);
    const __m256i words = _mm256_andnot_si256(left, right);
    return _mm_packus_epi32(_mm256_castsi256_si128(words), _mm256_extracti128_si256(words, 1));
}
#endif
inline Words8 transpose_nibbles(Words8 x) {
    __m128i t = _mm_and_si128(_mm_xor_si128(x, _mm_srli_epi64(x, 12)), _mm_set1_epi64x(0x0000f0f00000f0f0));
    x = _mm_xor_si128(x, _mm_xor_si128(t, _mm_slli_epi64(t, 12)));
    t = _mm_and_si128(_mm_xor_si128(x, _mm_srli_epi64(x, 24)), _mm_set1_epi64x(0x00000000ff00ff00));
    return _mm_xor_si128(x, _mm_xor_si128(t, _mm_slli_epi64(t, 24)));
}
inline Words8 masked(Words8 x, const uint16_t* low, const uint16_t* high) {
    const __m128i first = _mm_loadl_epi64(reinterpret_cast<const __m128i*>(low));
    const __m128i second = _mm_loadl_epi64(reinterpret_cast<const __m128i*>(high));
    return _mm_and_si128(x, _mm_unpacklo_epi64(first, second));
}
#if defined(__AVX512F__)
inline uint32_t store_nonzero(Words8 x, uint32_t tile, uint32_t step, uint16_t* words, uint32_t* tiles) {
    const __mmask8 some = _mm_test_epi16_mask(x, x);
    const __m256i in_four = _mm256_add_epi32(_mm256_setr_epi32(0, 1, 2, 3, 0, 1, 2, 3), _mm256_set1_epi32(tile));
    const __m256i all = _mm256_mask_add_epi32(in_four, 0xf0, in_four, _mm256_set1_epi32(step));
    _mm256_storeu_si256(reinterpret_cast<__m256i*>(tiles), _mm256_maskz_compress_epi32(some, all));
    const __m256i wide = _mm256_maskz_compress_epi32(some, _mm256_cvtepu16_epi32(x));
    _mm_storeu_si128(reinterpret_cast<__m128i*>(words), _mm256_cvtepi32_epi16(wide));
    return __builtin_popcount(some);
}
#else
struct Compress8 {  // for every set of bits, their numbers
    alignas(32) uint32_t lanes[256][8];
    constexpr Compress8() : lanes() {
        for (int set = 0; set < 256; set++)
            for (int bit = 0, n = 0; bit < 8; bit++)
                if (set >> bit & 1) lanes[set][n++] = bit;
    }
};
alignas(64) static constexpr Compress8 COMPRESS8;
inline uint32_t store_nonzero(Words8 x, uint32_t tile, uint32_t step, uint16_t* words, uint32_t* tiles) {
    const __m256i wide = _mm256_cvtepu16_epi32(x);
    const __m256i none = _mm256_cmpeq_epi32(wide, _mm256_setzero_si256());
    const uint32_t some = 0xff & ~_mm256_movemask_ps(_mm256_castsi256_ps(none));
    const __m256i lanes = _mm256_load_si256(reinterpret_cast<const __m256i*>(COMPRESS8.lanes[some]));
    const __m256i places = _mm256_setr_epi32(0, 1, 2, 3, step, step + 1, step + 2, step + 3);
    const __m256i all = _mm256_add_epi32(_mm256_set1_epi32(tile), places);
    _mm256_storeu_si256(reinterpret_cast<__m256i*>(tiles), _mm256_permutevar8x32_epi32(all, lanes));
    const __m256i kept = _mm256_permutevar8x32_epi32(wide, lanes);
    const __m128i narrow = _mm_packus_epi32(_mm256_castsi256_si128(kept), _mm256_extracti128_si256(kept, 1));
    _mm_storeu_si128(reinterpret_cast<__m128i*>(words), narrow);
    return __builtin_popcount(some);
}
#endif

#elif !defined(KERNEL_PORTABLE) && defined(__aarch64__)
typedef uint16x8_t Words8;

inline Words8 bits_between(Vec counts) {
    const auto from = [&](int k) {  // the bits from `count` on; none from 16
        const int16x8_t count = vuzp1q_s16(vreinterpretq_s16_s32(vcvtq_s32_f32(counts.q[k])), vreinterpretq_s16_s32(vcvtq_s32_f32(counts.q[k + 1])));
        return vshlq_u16(vdupq_n_u16(0xffff), count);
    };
    return vbicq_u16(from(2), from(0));
}
inline Words8 transpose_nibbles(Words8 words) {
    uint64x2_t x = vreinterpretq_u64_u16(words);
    uint64x2_t t = vandq_u64(veorq_u64(x, vshrq_n_u64(x, 12)), vdupq_n_u64(0x0000f0f00000f0f0));
    x = veorq_u64(x, veorq_u64(t, vshlq_n_u64(t, 12)));
    t = vandq_u64(veorq_u64(x, vshrq_n_u64(x, 24)), vdupq_n_u64(0x00000000ff00ff00));
    return vreinterpretq_u16_u64(veorq_u64(x, veorq_u64(t, vshlq_n_u64(t, 24))));
}
inline Words8 masked(Words8 x, const uint16_t* low, const uint16_t* high) {
    return vandq_u16(x, vcombine_u16(vld1_u16(low), vld1_u16(high)));
}
struct Compress8 {  // for every set of bits, their numbers
    alignas(64) uint8_t lanes[256][8];
    constexpr Compress8() : lanes() {
        for (int set = 0; set < 256; set++)
            for (int bit = 0, n = 0; bit < 8; bit++)
                if (set >> bit & 1) lanes[set][n++] = static_cast<uint8_t>(bit);
    }
};
alignas(64) static constexpr Compress8 COMPRESS8;
inline uint32_t store_nonzero(Words8 x, uint32_t tile, uint32_t stride, uint16_t* words, uint32_t* tiles) {
    const uint16x8_t weights = {1, 2, 4, 8, 16, 32, 64, 128};
    const uint32_t some = vaddvq_u16(vandq_u16(vtstq_u16(x, x), weights));
    const uint16x8_t lane = vmovl_u8(vld1_u8(COMPRESS8.lanes[some]));
    const uint16x8_t bytes = vmlaq_n_u16(vdupq_n_u16(0x0100), lane, 0x0202);  // 2 lane, 2 lane + 1
    vst1q_u16(words, vreinterpretq_u16_u8(vqtbl1q_u8(vreinterpretq_u8_u16(x), vreinterpretq_u8_u16(bytes))));
    const auto tile_of = [&](uint32x4_t k) { return vmlaq_n_u32(vaddq_u32(k, vdupq_n_u32(tile)), vshrq_n_u32(k, 2), stride - 4); };
    vst1q_u32(tiles, tile_of(vmovl_u16(vget_low_u16(lane))));
    vst1q_u32(tiles + 4, tile_of(vmovl_high_u16(lane)));
    return static_cast<uint32_t>(__builtin_popcount(some));
}

#else
struct Words8 {
    uint64_t half[2];
};
inline Words8 bits_between(Vec counts) {
    uint16_t words[8];
    const auto below = [&](int i) { return (1u << static_cast<int>(counts.v[i])) - 1; };
    for (int i = 0; i < 8; i++) words[i] = static_cast<uint16_t>(below(i) & ~below(8 + i));
    Words8 r;
    std::memcpy(&r, words, sizeof r);
    return r;
}
inline Words8 transpose_nibbles(Words8 r) {
    for (uint64_t& x : r.half) {
        uint64_t t = (x ^ x >> 12) & 0x0000f0f00000f0f0u;
        x ^= t ^ t << 12;
        t = (x ^ x >> 24) & 0x00000000ff00ff00u;
        x ^= t ^ t << 24;
    }
    return r;
}
inline Words8 masked(Words8 r, const uint16_t* low, const uint16_t* high) {
    uint64_t a, b;
    std::memcpy(&a, low, sizeof a);
    std::memcpy(&b, high, sizeof b);
    return {{r.half[0] & a, r.half[1] & b}};
}
inline uint32_t store_nonzero(Words8 x, uint32_t tile, uint32_t step, uint16_t* words, uint32_t* tiles) {
    uint32_t n = 0;
    for (int i = 0; i < 8; i++) {
        const uint16_t word = static_cast<uint16_t>(x.half[i / 4] >> i % 4 * 16);
        words[n] = word, tiles[n] = tile + i % 4 + (i / 4 ? step : 0);
        n += word != 0;
    }
    return n;
}
#endif

}  // namespace KERNEL_ISA
