// Sixteen rows of an array to one vector per column, and back.
#pragma once

#include "simd.h"

namespace KERNEL_ISA {

#if !defined(KERNEL_PORTABLE) && defined(__AVX512F__)

// Where column k of sixteen rows of three floats lies: in the first two vectors, and then with the third.
struct ColumnsOf3 {
    alignas(64) int32_t first[3][LANES], then[3][LANES];
    constexpr ColumnsOf3() : first(), then() {
        for (int k = 0; k < 3; k++)
            for (int lane = 0; lane < LANES; lane++) {
                const int place = 3 * lane + k;
                first[k][lane] = place % (2 * LANES);
                then[k][lane] = place < 2 * LANES ? lane : LANES + place % LANES;
            }
    }
};
alignas(64) static constexpr ColumnsOf3 COLUMNS_OF_3;

inline __m512i load_indices(const int32_t* p) { return _mm512_load_si512(p); }

inline void load_rows3(const float* rows, Vec* columns) {
    const __m512 a = _mm512_loadu_ps(rows), b = _mm512_loadu_ps(rows + 16), c = _mm512_loadu_ps(rows + 32);
    for (int k = 0; k < 3; k++)
        columns[k] = _mm512_permutex2var_ps(_mm512_permutex2var_ps(a, load_indices(COLUMNS_OF_3.first[k]), b),
                                            load_indices(COLUMNS_OF_3.then[k]), c);
}
// 4x4 transposes of floats within 128 bits, and of the 128-bit parts
inline __m512d low_pairs(__m512 a, __m512 b) { return _mm512_castps_pd(_mm512_unpacklo_ps(a, b)); }
inline __m512d high_pairs(__m512 a, __m512 b) { return _mm512_castps_pd(_mm512_unpackhi_ps(a, b)); }
inline void transpose_quads(__m512 a, __m512 b, __m512 c, __m512 d, __m512* out) {
    const __m512d ab_low = low_pairs(a, b), ab_high = high_pairs(a, b), cd_low = low_pairs(c, d), cd_high = high_pairs(c, d);
    out[0] = _mm512_castpd_ps(_mm512_unpacklo_pd(ab_low, cd_low));
    out[1] = _mm512_castpd_ps(_mm512_unpackhi_pd(ab_low, cd_low));
    out[2] = _mm512_castpd_ps(_mm512_unpacklo_pd(ab_high, cd_high));
    out[3] = _mm512_castpd_ps(_mm512_unpackhi_pd(ab_high, cd_high));
}
inline void transpose_parts(__m512 a, __m512 b, __m512 c, __m512 d, __m512* out) {
    const __m512 ab_even = _mm512_shuffle_f32x4(a, b, 0x88), ab_odd = _mm512_shuffle_f32x4(a, b, 0xdd);
    const __m512 cd_even = _mm512_shuffle_f32x4(c, d, 0x88), cd_odd = _mm512_shuffle_f32x4(c, d, 0xdd);
    out[0] = _mm512_shuffle_f32x4(ab_even, cd_even, 0x88);
    out[1] = _mm512_shuffle_f32x4(ab_odd, cd_odd, 0x88);
    out[2] = _mm512_shuffle_f32x4(ab_even, cd_even, 0xdd);
    out[3] = _mm512_shuffle_f32x4(ab_odd, cd_odd, 0xdd);
}
inline void load_rows4(const float* rows, Vec* columns) {
    __m512 parts[4], out[4];
    transpose_parts(_mm512_loadu_ps(rows), _mm512_loadu_ps(rows + 16), _mm512_loadu_ps(rows + 32),
                    _mm512_loadu_ps(rows + 48), parts);
    transpose_quads(parts[0], parts[1], parts[2], parts[3], out);
    for (int k = 0; k < 4; k++) columns[k] = out[k];
}
// Part p of quads[r] becomes columns 0 to 3 of row 4 p + r.
inline void transpose_quads(const Vec* columns, __m512* quads) {
    transpose_quads(columns[0].v, columns[1].v, columns[2].v, columns[3].v, quads);
}
inline void store_rows16(float* rows, const Vec* columns) {
    __m512 quads[4][4];
    for (int k = 0; k < 4; k++) transpose_quads(columns + 4 * k, quads[k]);
    for (int r = 0; r < 4; r++) {
        __m512 out[4];
        transpose_parts(quads[0][r], quads[1][r], quads[2][r], quads[3][r], out);
        for (int p = 0; p < 4; p++) _mm512_store_ps(rows + 16 * (4 * p + r), out[p]);
    }
}
inline void store_rows8(float* rows, const Vec* columns) {
    __m512 quads[2][4], out[4];
    for (int k = 0; k < 2; k++) transpose_quads(columns + 4 * k, quads[k]);
    for (int r = 0; r < 4; r += 2) {
        transpose_parts(quads[0][r], quads[1][r], quads[0][r + 1], quads[1][r + 1], out);
        for (int p = 0; p < 4; p++) _mm512_store_ps(rows + 8 * (4 * p + r), out[p]);
    }
}

// Rows become columns.
inline void transpose16(Vec* a) {
    __m512 quads[4][4];  // [k][c]: part p holds column 4 p + c of rows 4 k..
    for (int k = 0; k < 4; k++) transpose_quads(a[4 * k].v, a[4 * k + 1].v, a[4 * k + 2].v, a[4 * k + 3].v, quads[k]);
    for (int c = 0; c < 4; c++) {
        __m512 out[4];
        transpose_parts(quads[0][c], quads[1][c], quads[2][c], quads[3][c], out);
        for (int p = 0; p < 4; p++) a[4 * p + c] = out[p];
    }
}
// columns[k] = element k of sixteen rows, k < 8; row(i): where row i begins, 32-byte aligned.
template <class Row>
inline void load_columns8(Row row, Vec* columns) {
    __m512 pairs[8], low[4], high[4];  // pairs: of rows i and i + 4, i + 8 and i + 12
    for (int i = 0; i < 8; i++) {
        const int first = i / 4 * 8 + i % 4;
        pairs[i] = _mm512_insertf32x8(_mm512_castps256_ps512(_mm256_load_ps(row(first))), _mm256_load_ps(row(first + 4)), 1);
    }
    transpose_quads(pairs[0], pairs[1], pairs[2], pairs[3], low);
    transpose_quads(pairs[4], pairs[5], pairs[6], pairs[7], high);
    for (int i = 0; i < 4; i++) {
        columns[i] = _mm512_shuffle_f32x4(low[i], high[i], 0x88);
        columns[4 + i] = _mm512_shuffle_f32x4(low[i], high[i], 0xdd);
    }
}

// Appends the positions i < count at which words[i] has the bit, in order; returns how many. May write 15 beyond the
// last, and reads 15 words beyond.
inline uint32_t positions_with_bit(const uint16_t* words, uint32_t count, int bit, uint32_t* out) {
    const __m256i test = _mm256_set1_epi16(static_cast<short>(1 << bit));
    __m512i position = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    uint32_t found = 0;
    for (uint32_t i = 0; i < count; i += 16) {
        const uint32_t left = count - i, inside = left < 16 ? (1u << left) - 1 : 0xffffu;
        const __m256i word = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(words + i));
        const uint32_t hit = _mm256_test_epi16_mask(word, test) & inside;
        _mm512_storeu_si512(out + found, _mm512_maskz_compress_epi32(static_cast<__mmask16>(hit), position));
        found += static_cast<uint32_t>(__builtin_popcount(hit));
        position = _mm512_add_epi32(position, _mm512_set1_epi32(16));
    }
    return found;
}
// The first `count` of sixteen numbers, then the first of them again; reads all sixteen.
inline void load_positions(const uint32_t* numbers, int count, uint32_t* out) {
    const __mmask16 real = static_cast<__mmask16>((1u << count) - 1);
    const __m512i first = _mm512_set1_epi32(static_cast<int>(numbers[0]));
    _mm512_store_si512(out, _mm512_mask_mov_epi32(first, real, _mm512_loadu_si512(numbers)));
}
// The first `count` of sixteen words, then zeros; reads all sixteen.
inline void load_words(const uint16_t* words, int count, uint16_t* out) {
    const __mmask16 real = static_cast<__mmask16>((1u << count) - 1);
    _mm256_store_si256(reinterpret_cast<__m256i*>(out), _mm256_maskz_mov_epi16(real, _mm256_loadu_si256(reinterpret_cast<const __m256i*>(words))));
}

#elif !defined(KERNEL_PORTABLE) && defined(__AVX2__)

inline __m256 load_parts(const float* low, const float* high) {
    return _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(low)), _mm_loadu_ps(high), 1);
}
inline void load_rows3(const float* rows, __m256& x, __m256& y, __m256& z) {
    const __m256 a = load_parts(rows, rows + 12), b = load_parts(rows + 4, rows + 16), c = load_parts(rows + 8, rows + 20);
    const __m256 xy = _mm256_shuffle_ps(b, c, _MM_SHUFFLE(2, 1, 3, 2)), yz = _mm256_shuffle_ps(a, b, _MM_SHUFFLE(1, 0, 2, 1));
    x = _mm256_shuffle_ps(a, xy, _MM_SHUFFLE(2, 0, 3, 0));
    y = _mm256_shuffle_ps(yz, xy, _MM_SHUFFLE(3, 1, 2, 0));
    z = _mm256_shuffle_ps(yz, c, _MM_SHUFFLE(3, 0, 3, 1));
}
inline void load_rows3(const float* rows, Vec* columns) {
    load_rows3(rows, columns[0].a, columns[1].a, columns[2].a);
    load_rows3(rows + 24, columns[0].b, columns[1].b, columns[2].b);
}
// 4x4 transposes within 128 bits
inline __m256d low_pairs(__m256 a, __m256 b) { return _mm256_castps_pd(_mm256_unpacklo_ps(a, b)); }
inline __m256d high_pairs(__m256 a, __m256 b) { return _mm256_castps_pd(_mm256_unpackhi_ps(a, b)); }
inline void transpose_quads(__m256 a, __m256 b, __m256 c, __m256 d, __m256* out) {
    const __m256d ab_low = low_pairs(a, b), ab_high = high_pairs(a, b), cd_low = low_pairs(c, d), cd_high = high_pairs(c, d);
    out[0] = _mm256_castpd_ps(_mm256_unpacklo_pd(ab_low, cd_low));
    out[1] = _mm256_castpd_ps(_mm256_unpackhi_pd(ab_low, cd_low));
    out[2] = _mm256_castpd_ps(_mm256_unpacklo_pd(ab_high, cd_high));
    out[3] = _mm256_castpd_ps(_mm256_unpackhi_pd(ab_high, cd_high));
}
inline void load_rows4(const float* rows, Vec* columns) {
    __m256 low[4], high[4];
    transpose_quads(load_parts(rows, rows + 16), load_parts(rows + 4, rows + 20), load_parts(rows + 8, rows + 24),
                    load_parts(rows + 12, rows + 28), low);
    transpose_quads(load_parts(rows + 32, rows + 48), load_parts(rows + 36, rows + 52), load_parts(rows + 40, rows + 56),
                    load_parts(rows + 44, rows + 60), high);
    for (int k = 0; k < 4; k++) columns[k] = Vec(low[k], high[k]);
}
// Eight columns of eight rows, which lie `stride` floats apart.
inline void store_8x8(float* rows, int stride, const __m256* columns) {
    __m256 left[4], right[4];  // of rows r and 4 + r
    transpose_quads(columns[0], columns[1], columns[2], columns[3], left);
    transpose_quads(columns[4], columns[5], columns[6], columns[7], right);
    for (int r = 0; r < 4; r++) {
        _mm256_store_ps(rows + stride * r, _mm256_permute2f128_ps(left[r], right[r], 0x20));
        _mm256_store_ps(rows + stride * (r + 4), _mm256_permute2f128_ps(left[r], right[r], 0x31));
    }
}
inline void store_columns8(float* rows, int stride, const Vec* columns) {
    __m256 low[8], high[8];
    for (int k = 0; k < 8; k++) low[k] = columns[k].a, high[k] = columns[k].b;
    store_8x8(rows, stride, low);
    store_8x8(rows + 8 * stride, stride, high);
}
inline void store_rows8(float* rows, const Vec* columns) { store_columns8(rows, 8, columns); }
inline void store_rows16(float* rows, const Vec* columns) {
    store_columns8(rows, 16, columns);
    store_columns8(rows + 8, 16, columns + 8);
}

// Rows and columns exchanged in a quarter of a 16x16 matrix.
inline void transpose8(__m256* a) {
    __m256 left[4], right[4];  // columns c and 4 + c of rows 0..3, of rows 4..7
    transpose_quads(a[0], a[1], a[2], a[3], left);
    transpose_quads(a[4], a[5], a[6], a[7], right);
    for (int c = 0; c < 4; c++) {
        a[c] = _mm256_permute2f128_ps(left[c], right[c], 0x20);
        a[4 + c] = _mm256_permute2f128_ps(left[c], right[c], 0x31);
    }
}
NO_INLINE static void transpose16(Vec* v) {  // it takes all sixteen registers
    __m256 quarters[4][8];
    for (int i = 0; i < 8; i++) {
        quarters[0][i] = v[i].a, quarters[1][i] = v[i].b;
        quarters[2][i] = v[8 + i].a, quarters[3][i] = v[8 + i].b;
    }
    for (auto& quarter : quarters) transpose8(quarter);
    for (int i = 0; i < 8; i++) {
        v[i] = {quarters[0][i], quarters[2][i]};
        v[8 + i] = {quarters[1][i], quarters[3][i]};
    }
}
template <class Row>
inline void load_columns8(Row row, Vec* columns) {
    __m256 low[8], high[8];
    for (int i = 0; i < 8; i++) low[i] = _mm256_load_ps(row(i)), high[i] = _mm256_load_ps(row(8 + i));
    transpose8(low);
    transpose8(high);
    for (int i = 0; i < 8; i++) columns[i] = {low[i], high[i]};
}
// The numbers of the bits that are set in a byte, in order, and then zeros.
struct BitPlaces {
    alignas(8) uint8_t of[256][8];
    constexpr BitPlaces() : of() {
        for (int word = 0; word < 256; word++)
            for (int bit = 0, found = 0; bit < 8; bit++)
                if (word >> bit & 1) of[word][found++] = static_cast<uint8_t>(bit);
    }
};
static constexpr BitPlaces BIT_PLACES;

inline uint32_t positions_with_bit(const uint16_t* words, uint32_t count, int bit, uint32_t* out) {
    uint32_t found = 0;
    const __m256i test = _mm256_set1_epi16(static_cast<short>(1 << bit));
    for (uint32_t i = 0; i < count; i += 16) {
        const uint32_t left = count - i, inside = left < 16 ? (1u << left) - 1 : 0xffffu;
        const __m256i word = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(words + i));
        const __m256i equal = _mm256_cmpeq_epi16(_mm256_and_si256(word, test), test);
        const __m128i bytes = _mm_packs_epi16(_mm256_castsi256_si128(equal), _mm256_extracti128_si256(equal, 1));
        const uint32_t hits = static_cast<uint32_t>(_mm_movemask_epi8(bytes)) & inside;
        for (int half = 0; half < 2; half++) {
            const uint32_t hit = hits >> 8 * half & 0xff;
            const __m128i places = _mm_loadl_epi64(reinterpret_cast<const __m128i*>(BIT_PLACES.of[hit]));
            const __m256i place = _mm256_add_epi32(_mm256_cvtepu8_epi32(places), _mm256_set1_epi32(static_cast<int>(i + 8 * half)));
            _mm256_storeu_si256(reinterpret_cast<__m256i*>(out + found), place);
            found += static_cast<uint32_t>(__builtin_popcount(hit));
        }
    }
    return found;
}
inline void load_positions(const uint32_t* numbers, int count, uint32_t* out) {
    const __m256i first = _mm256_set1_epi32(static_cast<int>(numbers[0])), last = _mm256_set1_epi32(count);
    for (int i = 0; i < 16; i += 8) {
        const __m256i number = _mm256_add_epi32(_mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7), _mm256_set1_epi32(i));
        const __m256i all = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(numbers + i));
        _mm256_store_si256(reinterpret_cast<__m256i*>(out + i), _mm256_blendv_epi8(first, all, _mm256_cmpgt_epi32(last, number)));
    }
}
inline void load_words(const uint16_t* words, int count, uint16_t* out) {
    const __m256i number = _mm256_setr_epi16(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    const __m256i real = _mm256_cmpgt_epi16(_mm256_set1_epi16(static_cast<short>(count)), number);
    _mm256_store_si256(reinterpret_cast<__m256i*>(out), _mm256_and_si256(real, _mm256_loadu_si256(reinterpret_cast<const __m256i*>(words))));
}

#elif !defined(KERNEL_PORTABLE) && defined(__aarch64__)

inline void load_rows3(const float* rows, Vec* columns) {
    for (int p = 0; p < 4; p++) {
        const float32x4x3_t part = vld3q_f32(rows + 12 * p);
        for (int k = 0; k < 3; k++) columns[k].q[p] = part.val[k];
    }
}
inline void load_rows4(const float* rows, Vec* columns) {
    for (int p = 0; p < 4; p++) {
        const float32x4x4_t part = vld4q_f32(rows + 16 * p);
        for (int k = 0; k < 4; k++) columns[k].q[p] = part.val[k];
    }
}
// 4x4 transpose
inline void transpose_quads(float32x4_t a, float32x4_t b, float32x4_t c, float32x4_t d, float32x4_t* out) {
    const float64x2_t ab_even = vreinterpretq_f64_f32(vtrn1q_f32(a, b)), ab_odd = vreinterpretq_f64_f32(vtrn2q_f32(a, b));
    const float64x2_t cd_even = vreinterpretq_f64_f32(vtrn1q_f32(c, d)), cd_odd = vreinterpretq_f64_f32(vtrn2q_f32(c, d));
    out[0] = vreinterpretq_f32_f64(vtrn1q_f64(ab_even, cd_even));
    out[1] = vreinterpretq_f32_f64(vtrn1q_f64(ab_odd, cd_odd));
    out[2] = vreinterpretq_f32_f64(vtrn2q_f64(ab_even, cd_even));
    out[3] = vreinterpretq_f32_f64(vtrn2q_f64(ab_odd, cd_odd));
}
template <int WIDTH>
inline void store_rows(float* rows, const Vec* columns) {
    for (int k = 0; k < WIDTH; k += 4)
        for (int p = 0; p < 4; p++) {
            float32x4_t out[4];
            transpose_quads(columns[k].q[p], columns[k + 1].q[p], columns[k + 2].q[p], columns[k + 3].q[p], out);
            for (int r = 0; r < 4; r++) vst1q_f32(rows + WIDTH * (4 * p + r) + k, out[r]);
        }
}
inline void store_rows8(float* rows, const Vec* columns) { store_rows<8>(rows, columns); }
inline void store_rows16(float* rows, const Vec* columns) { store_rows<16>(rows, columns); }
inline void transpose16(Vec* a) {
    Vec out[16];
    for (int k = 0; k < 4; k++)
        for (int p = 0; p < 4; p++) {
            float32x4_t quad[4];
            transpose_quads(a[4 * k].q[p], a[4 * k + 1].q[p], a[4 * k + 2].q[p], a[4 * k + 3].q[p], quad);
            for (int r = 0; r < 4; r++) out[4 * p + r].q[k] = quad[r];
        }
    for (int i = 0; i < 16; i++) a[i] = out[i];
}
template <class Row>
inline void load_columns8(Row row, Vec* columns) {
    for (int k = 0; k < 8; k += 4)
        for (int p = 0; p < 4; p++) {
            float32x4_t out[4];
            transpose_quads(vld1q_f32(row(4 * p) + k), vld1q_f32(row(4 * p + 1) + k), vld1q_f32(row(4 * p + 2) + k),
                            vld1q_f32(row(4 * p + 3) + k), out);
            for (int c = 0; c < 4; c++) columns[k + c].q[p] = out[c];
        }
}
inline uint32_t positions_with_bit(const uint16_t* words, uint32_t count, int bit, uint32_t* out) {
    uint32_t found = 0;
    const uint16x8_t test = vdupq_n_u16(static_cast<uint16_t>(1 << bit));
    for (uint32_t i = 0; i < count; i += 16) {
        const uint32_t left = count - i, inside = left < 16 ? (1u << left) - 1 : 0xffffu;
        const uint8x16_t bytes = low_halves(vtstq_u16(vld1q_u16(words + i), test), vtstq_u16(vld1q_u16(words + i + 8), test));
        for (uint32_t hit = bits(bytes) & inside; hit; hit &= hit - 1) out[found++] = i + static_cast<uint32_t>(__builtin_ctz(hit));
    }
    return found;
}
inline void load_positions(const uint32_t* numbers, int count, uint32_t* out) {
    const uint32x4_t first = vdupq_n_u32(numbers[0]), last = vdupq_n_u32(static_cast<uint32_t>(count)), lanes = {0, 1, 2, 3};
    for (uint32_t i = 0; i < 16; i += 4) {
        const uint32x4_t real = vcltq_u32(vaddq_u32(lanes, vdupq_n_u32(i)), last);
        vst1q_u32(out + i, vbslq_u32(real, vld1q_u32(numbers + i), first));
    }
}
inline void load_words(const uint16_t* words, int count, uint16_t* out) {
    const uint16x8_t last = vdupq_n_u16(static_cast<uint16_t>(count)), low = {0, 1, 2, 3, 4, 5, 6, 7}, high = vaddq_u16(low, vdupq_n_u16(8));
    vst1q_u16(out, vandq_u16(vcltq_u16(low, last), vld1q_u16(words)));
    vst1q_u16(out + 8, vandq_u16(vcltq_u16(high, last), vld1q_u16(words + 8)));
}

#else

template <int WIDTH>
inline void load_rows(const float* rows, Vec* columns) {
    for (int lane = 0; lane < LANES; lane++)
        for (int k = 0; k < WIDTH; k++) columns[k].v[lane] = rows[WIDTH * lane + k];
}
inline void load_rows3(const float* rows, Vec* columns) { load_rows<3>(rows, columns); }
inline void load_rows4(const float* rows, Vec* columns) { load_rows<4>(rows, columns); }
inline void transpose16(Vec* a) {
    Vec t[16];
    for (int i = 0; i < 16; i++)
        for (int k = 0; k < 16; k++) t[i].v[k] = a[k].v[i];
    for (int i = 0; i < 16; i++) a[i] = t[i];
}
template <class Row>
inline void load_columns8(Row row, Vec* columns) {
    for (int k = 0; k < 8; k++)
        for (int i = 0; i < LANES; i++) columns[k].v[i] = row(i)[k];
}
inline uint32_t positions_with_bit(const uint16_t* words, uint32_t count, int bit, uint32_t* out) {
    uint32_t found = 0;
    for (uint32_t i = 0; i < count; i++) {
        out[found] = i;
        found += words[i] >> bit & 1;
    }
    return found;
}
inline void load_positions(const uint32_t* numbers, int count, uint32_t* out) {
    for (int i = 0; i < 16; i++) out[i] = numbers[i < count ? i : 0];
}
inline void load_words(const uint16_t* words, int count, uint16_t* out) {
    for (int i = 0; i < 16; i++) out[i] = i < count ? words[i] : 0;
}
template <int WIDTH>
inline void store_rows(float* rows, const Vec* columns) {
    for (int lane = 0; lane < LANES; lane++)
        for (int k = 0; k < WIDTH; k++) rows[WIDTH * lane + k] = columns[k].v[lane];
}
inline void store_rows8(float* rows, const Vec* columns) { store_rows<8>(rows, columns); }
inline void store_rows16(float* rows, const Vec* columns) { store_rows<16>(rows, columns); }

#endif

inline Vec load_unaligned(const float* p) {
    Vec r;
    std::memcpy(&r, p, sizeof r);
    return r;
}

}  // namespace KERNEL_ISA
