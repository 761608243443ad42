// What a pinhole camera sees of flat textured surfaces: renderer.py, pixel by pixel, with the bits that numpy and OpenCV give.
// Included once for each instruction set, which FLAT_ISA names; FLAT_X86: it is one of x86 with fused operations.
//
// Every operation is one of double or float in the order of renderer.py; only texels are blended by fused operations, as
// OpenCV does where the processor has them.

namespace FLAT_ISA {

inline double along(const double* c, double u, double v) { return c[0] * u + (c[1] * v + c[2]); }

template <bool DISC>
inline bool covers(const Surface& surface, double inverse, double s, double t) {
    if (DISC) {
        const double r = surface.width / 2 * inverse, x = s - r, y = t - r;
        return x * x + y * y <= r * r;
    }
    const double slack = EDGE_TOLERANCE_M * inverse;
    return (s >= -slack) & (s <= surface.width * inverse + slack) & (t >= -slack) & (t <= surface.height * inverse + slack);
}

// Four numbers: red, green, blue, and one that nobody asks for.
using Four = float __attribute__((vector_size(16)));

#if FLAT_X86
inline Four four(const uint8_t* texel) {
    int32_t bytes;
    std::memcpy(&bytes, texel, sizeof bytes);
    return _mm_cvtepi32_ps(_mm_cvtepu8_epi32(_mm_cvtsi32_si128(bytes)));
}
inline Four fused(float a, Four b, Four c) { return _mm_fmadd_ps(_mm_set1_ps(a), b, c); }
inline Four rounded(Four a) { return _mm_round_ps(a, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC); }
#else
inline Four four(const uint8_t* texel) {
    return Four{static_cast<float>(texel[0]), static_cast<float>(texel[1]), static_cast<float>(texel[2]), 0.0f};
}
inline Four fused(float a, Four b, Four c) {
    return Four{std::fmaf(a, b[0], c[0]), std::fmaf(a, b[1], c[1]), std::fmaf(a, b[2], c[2]), 0.0f};
}
inline Four rounded(Four a) { return Four{std::nearbyintf(a[0]), std::nearbyintf(a[1]), std::nearbyintf(a[2]), 0.0f}; }
#endif

// The same where some of the four are outside of the image, and black, as OpenCV has it.
inline Four color_near(const Texels& texels, float x, float y) {
    if (!(x > -1.0f && y > -1.0f && x < static_cast<float>(texels.width) && y < static_cast<float>(texels.height))) return Four{};
    const float left = std::floor(x), top = std::floor(y), a = x - left, b = y - top;
    const auto texel = [&](int right, int down) {
        const std::ptrdiff_t column = static_cast<std::ptrdiff_t>(left) + right, row = static_cast<std::ptrdiff_t>(top) + down;
        if (column < 0 || row < 0 || column >= texels.width || row >= texels.height) return Four{};
        const uint8_t* const at = texels.colors + 3 * (row * texels.width + column);
        return Four{static_cast<float>(at[0]), static_cast<float>(at[1]), static_cast<float>(at[2]), 0.0f};
    };
    const Four p = texel(0, 0), q = texel(0, 1);
    const Four above = fused(a, texel(1, 0) - p, p), below = fused(a, texel(1, 1) - q, q);
    return rounded(fused(b, below - above, above));
}

// The color between four texels, rounded. Of the byte after them nothing is kept.
inline Four color_at(const Texels& texels, float x, float y) {
    const bool inside = x >= 0.0f && y >= 0.0f && x < static_cast<float>(texels.width - 2) && y < static_cast<float>(texels.height - 1);
    if (!inside) return color_near(texels, x, y);
    const float left = std::floor(x), top = std::floor(y), a = x - left, b = y - top;
    const uint8_t* const upper = texels.colors + 3 * (static_cast<std::ptrdiff_t>(top) * texels.width + static_cast<std::ptrdiff_t>(left));
    const uint8_t* const lower = upper + 3 * texels.width;
    const Four p = four(upper), q = four(lower);
    const Four above = fused(a, four(upper + 3) - p, p), below = fused(a, four(lower + 3) - q, q);
    return rounded(fused(b, below - above, above));
}

inline void write(Four color, uint8_t* out) {
    const Four whole = rounded(color);
    for (int c = 0; c < 3; c++) out[c] = static_cast<uint8_t>(whole[c]);
}

template <bool DISC>
inline void nearest_in_window(const Surface& surface, int16_t k, const int32_t* window, std::ptrdiff_t stride, double* nearest,
                              int16_t* seen) {
    const int u0 = window[0], v0 = window[1], u1 = window[2], v1 = window[3];
    const double(*const c)[3] = surface.linear;
    for (int v = v0; v < v1; v++) {
        double constant[3];
        for (int i = 0; i < 3; i++) constant[i] = c[i][1] * v + c[i][2];
        double* __restrict const row = nearest + v * stride;
        int16_t* __restrict const of_row = seen + v * stride;
        for (int u = u0; u < u1; u++) {
            const double at = u, inverse = c[0][0] * at + constant[0], s = c[1][0] * at + constant[1], t = c[2][0] * at + constant[2];
            const bool hit = (inverse > row[u]) & covers<DISC>(surface, inverse, s, t);
            row[u] = hit ? inverse : row[u];
            of_row[u] = hit ? k : of_row[u];
        }
    }
}
static void draw_nearest(const Surface& surface, int16_t k, const int32_t* window, std::ptrdiff_t stride, double* nearest, int16_t* seen) {
    (surface.disc ? nearest_in_window<true> : nearest_in_window<false>)(surface, k, window, stride, nearest, seen);
}

// Texels of the four samples of a pixel that one flat surface fills.
struct Samples {
    float x[INSIDE], y[INSIDE];

    Samples(const Surface& surface, double scale, double u, double v) {
        double at[3][INSIDE];
        for (int i = 0; i < 3; i++) {
            const double* const c = surface.linear[i];
            const double center = along(c, u, v);
            for (int k = 0; k < INSIDE; k++) at[i][k] = center + (INSIDE_OFFSETS[0][k] * c[0] + INSIDE_OFFSETS[1][k] * c[1]);
        }
        for (int k = 0; k < INSIDE; k++) {
            const double z = scale / at[0][k];
            x[k] = static_cast<float>(at[1][k] * z + surface.origin_x), y[k] = static_cast<float>(at[2][k] * z + surface.origin_y);
        }
    }
    // Squared distance between neighbors, texels: the larger of both directions.
    float step2() const {
        const float across = squared(1), down = squared(2);
        return across > down ? across : down;
    }
    Four mean(const Texels& texels) const {
        Four sum = {};
        for (int k = 0; k < INSIDE; k++) sum += color_at(texels, x[k], y[k]);
        return sum * 0.25f;
    }
    // Of a coarser level.
    Four mean(const Texels& texels, int level) const {
        const float scale = std::ldexp(1.0f, -level), shift = 0.5f * scale - 0.5f;
        Four sum = {};
        for (int k = 0; k < INSIDE; k++) sum += color_at(texels, x[k] * scale + shift, y[k] * scale + shift);
        return sum * 0.25f;
    }

private:
    float squared(int k) const { return (x[k] - x[0]) * (x[k] - x[0]) + (y[k] - y[0]) * (y[k] - y[0]); }
};

// What the samples of a pixel hit: greatest inverse depth, and there s D, t D and the texel of (s, t) = (0, 0).
struct Hits {
    double nearest[BORDER] = {}, s[BORDER] = {}, t[BORDER] = {}, origin_x[BORDER] = {}, origin_y[BORDER] = {};

    template <bool DISC>
    void add(const Surface& surface, double u, double v) {
        double us[BORDER], vs[BORDER];
        for (int k = 0; k < BORDER; k++) us[k] = u + BORDER_OFFSETS[k % 4], vs[k] = v + BORDER_OFFSETS[k / 4];
        for (int k = 0; k < BORDER; k++) {
            const double inverse = along(surface.linear[0], us[k], vs[k]);
            const double at_s = along(surface.linear[1], us[k], vs[k]), at_t = along(surface.linear[2], us[k], vs[k]);
            const bool hit = (inverse > nearest[k]) & covers<DISC>(surface, inverse, at_s, at_t);
            nearest[k] = hit ? inverse : nearest[k];
            s[k] = hit ? at_s : s[k], t[k] = hit ? at_t : t[k];
            origin_x[k] = hit ? surface.origin_x : origin_x[k], origin_y[k] = hit ? surface.origin_y : origin_y[k];
        }
    }
};

// The color of a pixel next to a border: of what each of its samples hits among the surfaces around, which are sorted.
inline void draw_border(const Surfaces& surfaces, const int16_t* around, int count, const Texels& texels, double scale, double u,
                        double v, uint8_t* color) {
    Hits hits;
    for (int i = 0; i < count; i++) {
        const Surface surface = surfaces[around[i]];
        if (surface.disc) hits.add<true>(surface, u, v);
        else hits.add<false>(surface, u, v);
    }
    float x[BORDER], y[BORDER];
    for (int k = 0; k < BORDER; k++) {
        const double z = scale / (hits.nearest[k] > 0 ? hits.nearest[k] : 1.0);
        x[k] = static_cast<float>(hits.s[k] * z + hits.origin_x[k]), y[k] = static_cast<float>(hits.t[k] * z + hits.origin_y[k]);
    }
    Four sum = {};
    int found = 0;
    for (int k = 0; k < BORDER; k++)
        if (hits.nearest[k] > 0) sum += color_at(texels, x[k], y[k]), found++;
    const double samples = found ? found : 1;
    const auto mean = [&](int c) { return static_cast<float>(static_cast<double>(sum[c]) / samples); };
    write(Four{mean(0), mean(1), mean(2), 0.0f}, color);
}

// The surfaces of the nine pixels around one, each once and sorted; -1 is none.
inline int surfaces_around(const int16_t* seen, int width, int height, int u, int v, int16_t* around) {
    int count = 0;
    for (int dv = -1; dv <= 1; dv++)
        for (int du = -1; du <= 1; du++) {
            const int row = v + dv < 0 ? 0 : v + dv >= height ? height - 1 : v + dv;
            const int column = u + du < 0 ? 0 : u + du >= width ? width - 1 : u + du;
            const int16_t k = seen[static_cast<std::ptrdiff_t>(row) * width + column];
            if (k < 0) continue;
            int at = 0;
            while (at < count && around[at] < k) at++;
            if (at < count && around[at] == k) continue;
            for (int i = count++; i > at; i--) around[i] = around[i - 1];
            around[at] = k;
        }
    return count;
}

// Whether all pixels around one, as far as they are in the image, show what it shows.
inline bool alike(const int16_t* seen, int width, int height, int u, int v) {
    const int16_t* const at = seen + static_cast<std::ptrdiff_t>(v) * width + u;
    bool same = true;
    for (int dv = v > 0 ? -1 : 0; dv <= (v + 1 < height); dv++)
        for (int du = u > 0 ? -1 : 0; du <= (u + 1 < width); du++) same &= at[static_cast<std::ptrdiff_t>(dv) * width + du] == *at;
    return same;
}

static void draw_colors(const Surfaces& surfaces, const int16_t* seen, int width, int height, const Texels& texels, double scale,
                        uint8_t* color, float* step2, uint8_t* left) {
    for (int v = 0; v < height; v++)
        for (int u = 0; u < width; u++) {
            const std::ptrdiff_t pixel = static_cast<std::ptrdiff_t>(v) * width + u;
            const int16_t k = seen[pixel];
            if (alike(seen, width, height, u, v)) {
                if (k < 0) continue;
                if (left[pixel] = !surfaces.flat(k); left[pixel]) continue;
                const Samples samples(surfaces[k], scale, u, v);
                step2[pixel] = samples.step2();
                if (step2[pixel] <= FINEST_STEP2) write(samples.mean(texels), color + 3 * pixel);
                continue;
            }
            int16_t around[9];
            const int count = surfaces_around(seen, width, height, u, v, around);
            for (int i = 0; i < count; i++) left[pixel] |= !surfaces.flat(around[i]);
            if (!left[pixel]) draw_border(surfaces, around, count, texels, scale, u, v, color + 3 * pixel);
        }
}

// A pixel that one flat surface fills and that is between two levels; a whole level is the finer of them.
static void draw_between(const Surface& surface, const Texels* levels, float level, double scale, double u, double v, uint8_t* color) {
    const int finer = static_cast<int>(level);
    const float blend = level - static_cast<float>(finer);
    const Samples samples(surface, scale, u, v);
    write((1.0f - blend) * samples.mean(levels[finer], finer) + blend * samples.mean(levels[finer + 1], finer + 1), color);
}

static const Build build = {draw_nearest, draw_colors, draw_between};

}  // namespace FLAT_ISA
