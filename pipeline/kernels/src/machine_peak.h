// What this machine does at most, to compare the kernels with: multiply-adds, and bytes of memory.
#pragma once

#include <ctime>

#include "frame.h"
#include "simd.h"

namespace KERNEL_ISA {

inline double now_s() {
    timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return static_cast<double>(t.tv_sec) + 1e-9 * static_cast<double>(t.tv_nsec);
}

// Keeps the compiler from leaving out what led to this value.
template <class T>
inline void use(T value) {
    asm volatile("" : : "m"(value));
}

// Best rate, in units of `work` per second, at which all threads finish pass(thread) together; repeated for `seconds`.
template <class Pass>
inline double best_rate(int threads, double seconds, double work, Pass pass) {
    const double end = now_s() + seconds;
    double best = 0.0, start;
    do {
        start = now_s();
#pragma omp parallel for schedule(static, 1) num_threads(threads) if (threads > 1)
        for (int thread = 0; thread < threads; thread++) pass(thread);
        const double rate = work / (now_s() - start);
        if (rate > best) best = rate;
    } while (start < end);
    return best;
}

// Independent sums: twelve registers hide a latency of 4 cycles at 3 multiply-adds per cycle.
#if !defined(KERNEL_PORTABLE)
typedef Vec Register;
#if defined(__AVX512F__)
constexpr int CHAINS = 12;
#else
constexpr int CHAINS = 6;  // of two or four registers
#endif
inline Register all(float value) { return Vec(value); }
inline Register next(Register sum, Register a, Register b) { return fma(a, b, sum); }
#else
typedef float Register __attribute__((vector_size(16)));
constexpr int CHAINS = 12;
inline Register all(float value) { return Register{} + value; }
// Not fused: the fma of this build may be an imitation, which is no measure of the machine.
inline Register next(Register sum, Register a, Register b) { return sum * a + b; }
#endif

// GFLOP/s of multiply-adds, each counted as two.
inline double fma_rate(int threads, double seconds) {
    constexpr int STEPS = 1 << 20;
    constexpr double FLOPS = 2.0 * STEPS * CHAINS * (sizeof(Register) / sizeof(float));
    return 1e-9 * best_rate(threads, seconds, FLOPS * threads, [](int thread) {
        const Register factor = all(0.999f), term = all(1e-3f);
        Register sums[CHAINS];
        for (int k = 0; k < CHAINS; k++) sums[k] = all(2.0f + k + thread);  // all different, or one would do for all
        for (int step = 0; step < STEPS; step++)
            for (Register& sum : sums) sum = next(sum, factor, term);
        for (int k = 1; k < CHAINS; k++) sums[0] = sums[0] + sums[k];
        use(sums[0]);
    });
}

// GB/s of reading, and of copying (bytes read plus bytes written), over more memory than caches hold.
inline void bandwidth(int threads, double seconds, double* read, double* copied) {
    constexpr size_t BYTES = size_t(256) << 20;
    const size_t count = BYTES / sizeof(float) / threads / (8 * LANES) * (8 * LANES);  // of one thread
    raster::Scratch<float> memory;
    float* const first = memory.need(count * threads);
    const double work = static_cast<double>(count * sizeof(float)) * threads;
    best_rate(threads, 0.0, work, [=](int thread) { std::memset(first + count * thread, 0, count * sizeof(float)); });
    *read = 1e-9 * best_rate(threads, 0.5 * seconds, work, [=](int thread) {
        const float* const from = first + count * thread;
        Vec sums[4] = {Vec(0.0f), Vec(0.0f), Vec(0.0f), Vec(0.0f)};
        for (size_t i = 0; i < count; i += 4 * LANES)
            for (int k = 0; k < 4; k++) sums[k] += load(from + i + k * LANES);
        use(sums[0] + sums[1] + sums[2] + sums[3]);
    });
    *copied = 1e-9 * best_rate(threads, 0.5 * seconds, work, [=](int thread) {
        float* const from = first + count * thread;
        std::memcpy(from + count / 2, from, count / 2 * sizeof(float));
    });
}

}  // namespace KERNEL_ISA
