// Sixteen float lanes: four NEON registers. Part of simd.h, which includes it.
#pragma once

namespace KERNEL_ISA {

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
inline Vec look_up4x4(const float* table, const uint8_t* p, size_t stride) {
    alignas(64) float lanes[LANES];
    for (size_t lane = 0; lane < LANES; lane++) lanes[lane] = table[3 * p[lane / 4 * stride + lane % 4 * 3]];
    return load(lanes);
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

}  // namespace KERNEL_ISA
