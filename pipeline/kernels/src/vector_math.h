// Elementary functions of sixteen lanes, from polynomials, so that no result depends on the C library.
#pragma once

#include "simd.h"

namespace KERNEL_ISA {

constexpr float LOG2_E = 1.44269504f;
constexpr float LN_2 = 0.69314718f;

// 2^t for |t| <= 126, relative error 2e-7.
inline Vec exp2(Vec t) {
    const Vec shifter(12582912.0f);  // 1.5 * 2^23: adding it rounds t to an integer kept in the low mantissa bits
    const Vec shifted = t + shifter;
    const Vec f = t - (shifted - shifter);  // in [-1/2, 1/2]
    Vec p = fma(Vec(1.3264727e-3f), f, Vec(9.671513e-3f));
    p = fma(p, f, Vec(5.5507336e-2f));
    p = fma(p, f, Vec(2.4022242e-1f));
    p = fma(p, f, Vec(6.93147e-1f));
    p = fma(p, f, Vec(1.0f));
    return scale_by_power(p, shifted);
}

// 2^t and 1 - 2^t for -126 <= t <= 0, relative error 3e-7 of both: near t = 0 the difference would keep few digits.
inline void exp2_and_rest(Vec t, Vec& power, Vec& rest) {
    const Vec shifter(12582912.0f);
    const Vec shifted = t + shifter;
    const Vec f = t - (shifted - shifter);
    Vec p = fma(Vec(1.3264727e-3f), f, Vec(9.671513e-3f));
    p = fma(p, f, Vec(5.5507336e-2f));
    p = fma(p, f, Vec(2.4022242e-1f));
    p = fma(p, f, Vec(6.93147e-1f));
    const Vec whole = scale_by_power(Vec(1.0f), shifted), part = p * f;
    power = fma(whole, part, whole);
    rest = fnma(whole, part, Vec(1.0f) - whole);
}

// e^x; x beyond +-83 counts as +-83.
inline Vec exp(Vec x) { return exp2(min(max(x * Vec(LOG2_E), Vec(-120.0f)), Vec(120.0f))); }

// log2 x for normal positive x: exponent plus the series of artanh on the mantissa, error 1e-7 absolute.
inline Vec log2(Vec x) {
    Vec m, e;
    split_exponent(x, m, e);
    const Mask large = m >= Vec(1.41421356f);  // mantissa to [1/sqrt2, sqrt2)
    m = select(large, m * Vec(0.5f), m);
    e = e + select_or_zero(large, Vec(1.0f));
    const Vec s = (m - Vec(1.0f)) / (m + Vec(1.0f)), s2 = s * s;  // ln m = 2 (s + s^3/3 + s^5/5 + ...)
    Vec p = fma(s2, Vec(1.0f / 9), Vec(1.0f / 7));
    p = fma(p, s2, Vec(1.0f / 5));
    p = fma(p, s2, Vec(1.0f / 3));
    p = fma(p, s2, Vec(1.0f));
    return fma(Vec(2.0f * LOG2_E) * s, p, e);
}

// log2(1 + x) for x >= 0, relative error 3e-7 also where x is small.
inline Vec log2_1p(Vec x) {
    const Vec s = x / (x + Vec(2.0f)), s2 = s * s;  // ln(1 + x) = 2 (s + s^3/3 + s^5/5 + ...)
    Vec p = fma(s2, Vec(1.0f / 9), Vec(1.0f / 7));
    p = fma(p, s2, Vec(1.0f / 5));
    p = fma(p, s2, Vec(1.0f / 3));
    p = fma(p, s2, Vec(1.0f));
    return select(x < Vec(0.41421356f), Vec(2.0f * LOG2_E) * s * p, log2(Vec(1.0f) + x));
}

// Divided difference of exp(2 x) between log-scales a and b, (e^2a - e^2b) / (2a - 2b), with A = e^a, B = e^b.
// Near a = b it is A B sinh(a - b)/(a - b) by its series, so equal scales need no special case.
inline Vec exp2x_divided_difference(Vec a, Vec b, Vec A, Vec B) {
    const Vec d = a - b, d2 = d * d;
    Vec series = fma(d2, Vec(1.0f / 362880), Vec(1.0f / 5040));
    series = fma(series, d2, Vec(1.0f / 120));
    series = fma(series, d2, Vec(1.0f / 6));
    series = fma(series, d2, Vec(1.0f));
    const Mask near = d2 < Vec(1.0f);
    const Vec safe = select(near, Vec(1.0f), d + d);
    return select(near, A * B * series, (A * A - B * B) / safe);
}

}  // namespace KERNEL_ISA
