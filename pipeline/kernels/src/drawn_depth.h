// Depth images of one sensor drawn from the place of another (kernels.drawn_depth_definition, the same bits: every operation is
// one of double, in its order, none fused).
#pragma once

#include <cmath>

#include "registration_data.h"

namespace KERNEL_ISA {

using namespace raster;

// One side of a triangle in the image: inside where a u + b v + c >= 0; divided by the area, a barycentric coordinate.
struct Side {
    double a, b, c;
};

// Columns of a row whose pixels lie in the triangle, from first to last.
static void columns_of(const Side (&sides)[3], double row, int width, int* first, int* last) {
    double low = -HUGE_VAL, high = HUGE_VAL;
    for (const Side& side : sides) {
        const double rest = side.b * row + side.c, border = -rest / side.a;
        if (side.a > 0.0) low = border > low ? border : low;
        else if (side.a < 0.0) high = border < high ? border : high;
        else if (rest < 0.0) low = HUGE_VAL;
    }
    const double right = static_cast<double>(width), start = low - 1e-9, stop = high + 1e-9;
    *first = static_cast<int>(std::ceil(start < 0.0 ? 0.0 : (start > right ? right : start)));
    *last = static_cast<int>(std::floor(stop < -1.0 ? -1.0 : (stop > right - 1.0 ? right - 1.0 : stop)));
}

// The nearest triangle wins a pixel, the first of equals.
static void draw_triangles(const DrawnTriangles& of, double* nearest, double* change) {
    for (size_t t = 0; t < of.count; t++) {
        const int64_t* const corner = of.triangles + 3 * t;
        double u[3], v[3], inverse[3];
        for (int k = 0; k < 3; k++) u[k] = of.pixels[2 * corner[k]], v[k] = of.pixels[2 * corner[k] + 1], inverse[k] = of.inverse[corner[k]];
        Side sides[3];
        for (int k = 0; k < 3; k++) {
            const int p = (k + 1) % 3, q = (k + 2) % 3;
            const double a = v[p] - v[q], b = u[q] - u[p];
            sides[k] = {a, b, -(a * u[p] + b * v[p])};
        }
        const double area = sides[0].a * u[0] + sides[0].b * v[0] + sides[0].c;
        if (!(std::fabs(area) > 1e-9)) continue;
        for (Side& side : sides) side = {side.a / area, side.b / area, side.c / area};
        const double top = std::fmin(std::fmin(v[0], v[1]), v[2]), bottom = std::fmax(std::fmax(v[0], v[1]), v[2]);
        const double most = static_cast<double>(of.height), start = std::ceil(top), stop = std::floor(bottom);
        const int begin = static_cast<int>(start < 0.0 ? 0.0 : (start > most ? most : start));
        const int end = static_cast<int>(stop < -1.0 ? -1.0 : (stop > most - 1.0 ? most - 1.0 : stop));
        const double depths[3] = {1.0 / inverse[0], 1.0 / inverse[1], 1.0 / inverse[2]};
        const double spread = std::fmax(std::fmax(depths[0], depths[1]), depths[2]) - std::fmin(std::fmin(depths[0], depths[1]), depths[2]);
        for (int row = begin; row <= end; row++) {
            int first, last;
            columns_of(sides, static_cast<double>(row), of.width, &first, &last);
            const size_t line = static_cast<size_t>(row) * static_cast<size_t>(of.width);
            for (int column = first; column <= last; column++) {
                const double x = static_cast<double>(column), y = static_cast<double>(row);
                double found = 0.0;
                for (int k = 0; k < 3; k++) {
                    const double share = sides[k].a * x + sides[k].b * y + sides[k].c;
                    found = k ? found + share * inverse[k] : share * inverse[k];
                }
                const size_t pixel = line + static_cast<size_t>(column);
                if (found > nearest[pixel]) nearest[pixel] = found, change[pixel] = spread;
            }
        }
    }
}

// Inverse depth between the four pixels whose first is at `corner`, 0 where they are not one surface.
static double between(const RegisteredDepth& of, const double* corner, const double (&weights)[4]) {
    const double p[4] = {corner[0], corner[1], corner[of.width], corner[of.width + 1]};
    double least = p[0], most = p[0];
    for (int k = 1; k < 4; k++) least = p[k] < least ? p[k] : least, most = p[k] > most ? p[k] : most;
    if (!(least > 0.0 && most <= (1.0 + of.same_surface) * least)) return 0.0;
    return weights[0] * p[0] + weights[1] * p[1] + weights[2] * p[2] + weights[3] * p[3];
}

// The samples of the depth image that fall into the other camera's: pixels and depth there, `count` of them.
struct FallenSamples {
    int32_t* pixels;
    double* depths;
    size_t count;
};

static void fall(const RegisteredDepth& of, double u, double v, double inverse, FallenSamples& samples) {
    const double z = 1.0 / inverse, x = (u - of.from.cx) / of.from.fx * z, y = (v - of.from.cy) / of.from.fy * z;
    const double* const T = of.T;
    const double qz = T[8] * x + T[9] * y + T[10] * z + T[11];
    if (!(qz > of.nearest_m)) return;
    const double qx = T[0] * x + T[1] * y + T[2] * z + T[3], qy = T[4] * x + T[5] * y + T[6] * z + T[7];
    const double column = std::nearbyint(of.onto.fx * qx / qz + of.onto.cx), row = std::nearbyint(of.onto.fy * qy / qz + of.onto.cy);
    const double right = static_cast<double>(of.onto_width), bottom = static_cast<double>(of.onto_height);
    if (!(column >= 0.0 && column < right && row >= 0.0 && row < bottom)) return;
    samples.pixels[samples.count] = static_cast<int32_t>(row) * of.onto_width + static_cast<int32_t>(column);
    samples.depths[samples.count++] = qz;
}

// Every sample falls on one pixel, where the nearest surface wins; its samples are averaged in inverse depth.
static void register_depth(const RegisteredDepth& of, int32_t* pixels, double* depths, double* images, float* depth) {
    FallenSamples samples = {pixels, depths, 0};
    for (int j = 0; j < of.steps; j++)
        for (int i = 0; i < of.steps; i++) {
            const double a = static_cast<double>(i) / of.steps, b = static_cast<double>(j) / of.steps;
            const double weights[4] = {(1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b};
            const bool exact = i == 0 && j == 0;
            for (int row = 0; row < of.height - !exact; row++)
                for (int column = 0; column < of.width - !exact; column++) {
                    const double* const corner = of.inverse + static_cast<std::ptrdiff_t>(row) * of.width + column;
                    const double inverse = exact ? *corner : between(of, corner, weights);
                    if (inverse > 0.0) fall(of, column + a, row + b, inverse, samples);
                }
        }
    const size_t size = static_cast<size_t>(of.onto_width) * static_cast<size_t>(of.onto_height);
    double *const nearest = images, *const total = images + size, *const count = images + 2 * size;
    for (size_t pixel = 0; pixel < size; pixel++) nearest[pixel] = HUGE_VAL, total[pixel] = 0.0, count[pixel] = 0.0;
    for (size_t k = 0; k < samples.count; k++) {
        double& least = nearest[pixels[k]];
        least = depths[k] < least ? depths[k] : least;
    }
    for (size_t k = 0; k < samples.count; k++)
        if (depths[k] <= (1.0 + of.one_layer) * nearest[pixels[k]]) count[pixels[k]] += 1.0, total[pixels[k]] += 1.0 / depths[k];
    for (size_t pixel = 0; pixel < size; pixel++) depth[pixel] = count[pixel] > 0.0 ? static_cast<float>(count[pixel] / total[pixel]) : 0.0f;
}

static bool one_surface(double a, double b, double same_surface) {
    return a > 0.0 && b > 0.0 && std::fabs(a - b) <= same_surface * (a < b ? a : b);
}

// A row of the depth image between two of its own: inverse depth, 0 where there is none.
static void row_between(const DisplacedDepth& of, int near, double part, double* inverse) {
    const double *const above = of.depth + static_cast<std::ptrdiff_t>(near) * of.width, *const below = above + of.width;
    const bool inside = part >= 0.0 && part <= 1.0;
    for (int column = 0; column < of.width; column++) {
        const double upper = above[column] > 0.0 ? 1.0 / above[column] : 0.0, lower = below[column] > 0.0 ? 1.0 / below[column] : 0.0;
        const double nearest = part < 0.5 ? upper : lower;
        inverse[column] = inside && one_surface(upper, lower, of.same_surface) ? upper + part * (lower - upper) : nearest;
    }
}

static void keep_nearest(double column, double inverse, int width, double* line) {
    if (!(column >= 0.0 && column < static_cast<double>(width))) return;
    double& kept = line[static_cast<int>(column)];
    kept = inverse > kept ? inverse : kept;
}

// A row as a chain of segments between neighbors; at the border of a surface a pixel covers half its width.
static void draw_row(const DisplacedDepth& of, const double* inverse, const double* x, double* line) {
    const double half = 0.5 * (of.onto.fx / of.from.fx);
    bool joined_left = false;
    for (int k = 0; k < of.width; k++) {
        const bool joined_right = k + 1 < of.width && one_surface(inverse[k], inverse[k + 1], of.same_surface);
        if (joined_right) {
            const double left = x[k], right = x[k + 1], first = std::ceil(left), width = right > left ? right - left : 1.0;
            for (int next = 0; next < 2; next++) {  // connected neighbors are less than two columns apart
                const double column = first + next, part = (column - left) / width;
                if (column <= right) keep_nearest(column, inverse[k] + part * (inverse[k + 1] - inverse[k]), of.onto_width, line);
            }
        }
        const double nearest = std::nearbyint(x[k]);
        const bool border = nearest < x[k] ? !joined_left : !joined_right;
        if (border && std::fabs(nearest - x[k]) <= half && inverse[k] > 0.0) keep_nearest(nearest, inverse[k], of.onto_width, line);
        joined_left = joined_right;
    }
}

// Rows of the one camera are rows of the other.
static void displace_depth(const DisplacedDepth& of, double* inverse, double* x, double* depth) {
    const double zoom = of.onto.fx / of.from.fx, offset = of.onto.cx - zoom * of.from.cx, shift = of.onto.fx * of.baseline_m;
    const double most = static_cast<double>(of.height - 2);
    for (int row = 0; row < of.onto_height; row++) {
        double* const line = depth + static_cast<std::ptrdiff_t>(row) * of.onto_width;
        for (int column = 0; column < of.onto_width; column++) line[column] = 0.0;
        const double at = (static_cast<double>(row) - of.onto.cy) * (of.from.fy / of.onto.fy) + of.from.cy;
        if (!(at >= -0.5 && at <= static_cast<double>(of.height) - 0.5)) continue;
        const double start = std::floor(at), near = start < 0.0 ? 0.0 : (start > most ? most : start);
        row_between(of, static_cast<int>(near), at - near, inverse);
        for (int k = 0; k < of.width; k++) x[k] = zoom * static_cast<double>(k) + offset - shift * inverse[k];
        draw_row(of, inverse, x, line);
        for (int column = 0; column < of.onto_width; column++) line[column] = line[column] > 0.0 ? 1.0 / line[column] : 0.0;
    }
}

}  // namespace KERNEL_ISA
