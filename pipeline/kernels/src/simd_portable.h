// Sixteen float lanes: a vector of the compiler, which becomes SSE2, NEON or plain loops. Part of simd.h, which includes it.
#pragma once

namespace KERNEL_ISA {

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
inline Vec look_up4x4(const float* table, const uint8_t* p, size_t stride) {
    alignas(64) float lanes[LANES];
    for (size_t lane = 0; lane < LANES; lane++) lanes[lane] = table[3 * p[lane / 4 * stride + lane % 4 * 3]];
    return load(lanes);
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

}  // namespace KERNEL_ISA
