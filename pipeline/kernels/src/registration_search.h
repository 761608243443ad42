// The minimum of a registration: Gauss-Newton from the coarsest level to the finest (registration.search),
// in double precision, without the mathematical library wherever it is called for every step.
#pragma once

#include "registration.h"

namespace KERNEL_ISA {

using namespace raster;

constexpr double LARGEST_STEP = 0.3;  // m, rad

struct Motion {
    double R[3][3], t[3];
};

static Motion motion_of(const double* T) {
    Motion m;
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) m.R[i][j] = T[4 * i + j];
        m.t[i] = T[4 * i + 3];
    }
    return m;
}

static Motion inverse(const Motion& m) {
    Motion out;
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) out.R[i][j] = m.R[j][i];
        out.t[i] = -(m.R[0][i] * m.t[0] + m.R[1][i] * m.t[1] + m.R[2][i] * m.t[2]);
    }
    return out;
}

static void multiply(const double a[3][3], const double b[3][3], double out[3][3]) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) out[i][j] = a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j];
}

static Motion product(const Motion& a, const Motion& b) {
    Motion out;
    multiply(a.R, b.R, out.R);
    for (int i = 0; i < 3; i++) out.t[i] = a.R[i][0] * b.t[0] + a.R[i][1] * b.t[1] + a.R[i][2] * b.t[2] + a.t[i];
    return out;
}

static void hat(const double* w, double out[3][3]) {
    const double W[3][3] = {{0.0, -w[2], w[1]}, {w[2], 0.0, -w[0]}, {-w[1], w[0], 0.0}};
    std::memcpy(out, W, sizeof W);
}

// Of a tangent (translation, rotation) of at most LARGEST_STEP in each component: there the series end at 1e-17.
static Motion exponential(const double* tangent) {
    const double *v = tangent, *w = tangent + 3, x = w[0] * w[0] + w[1] * w[1] + w[2] * w[2];
    double of_sine = 0.0, of_cosine = 0.0, of_rest = 0.0;  // sin t / t, (1 - cos t) / t^2, (t - sin t) / t^3, x = t^2
    double factorial[24] = {1.0};
    for (int k = 1; k < 24; k++) factorial[k] = factorial[k - 1] * k;
    for (int k = 9; k >= 0; k--) {
        of_sine = 1.0 / factorial[2 * k + 1] - x * of_sine;
        of_cosine = 1.0 / factorial[2 * k + 2] - x * of_cosine;
        of_rest = 1.0 / factorial[2 * k + 3] - x * of_rest;
    }
    double W[3][3], W2[3][3];
    hat(w, W);
    multiply(W, W, W2);
    Motion out;
    for (int i = 0; i < 3; i++) {
        out.t[i] = 0.0;
        for (int j = 0; j < 3; j++) {
            const double unit = i == j ? 1.0 : 0.0;
            out.R[i][j] = unit + of_sine * W[i][j] + of_cosine * W2[i][j];
            out.t[i] += (unit + of_cosine * W[i][j] + of_rest * W2[i][j]) * v[j];
        }
    }
    return out;
}

// The nearest rotation to one that is a rotation up to rounding: a step of Newton's method for the polar decomposition.
static void make_orthonormal(Motion& m) {
    double product[3][3], R[3][3];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            const double square = m.R[0][i] * m.R[0][j] + m.R[1][i] * m.R[1][j] + m.R[2][i] * m.R[2][j];
            product[i][j] = (i == j ? 1.5 : 0.0) - 0.5 * square;
        }
    multiply(m.R, product, R);
    std::memcpy(m.R, R, sizeof R);
}

// Tangent of a motion.
static void logarithm(const Motion& m, double* tangent) {
    const double(*R)[3] = m.R;
    // the unit quaternion, by its largest component
    const double squares[4] = {1.0 + R[0][0] + R[1][1] + R[2][2], 1.0 + R[0][0] - R[1][1] - R[2][2], 1.0 + R[1][1] - R[0][0] - R[2][2],
                               1.0 + R[2][2] - R[0][0] - R[1][1]};
    const double wx = R[2][1] - R[1][2], wy = R[0][2] - R[2][0], wz = R[1][0] - R[0][1];
    const double xy = R[0][1] + R[1][0], xz = R[0][2] + R[2][0], yz = R[1][2] + R[2][1];
    const double candidates[4][4] = {{squares[0], wx, wy, wz}, {wx, squares[1], xy, xz}, {wy, xy, squares[2], yz}, {wz, xz, yz, squares[3]}};
    int best = 0;
    for (int k = 1; k < 4; k++) best = squares[k] > squares[best] ? k : best;
    double q[4], length = 0.0;
    for (int k = 0; k < 4; k++) length += candidates[best][k] * candidates[best][k];
    length = __builtin_sqrt(length) * (candidates[best][0] < 0.0 ? -1.0 : 1.0);
    for (int k = 0; k < 4; k++) q[k] = candidates[best][k] / length;
    const double sine = __builtin_sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const double angle = 2.0 * __builtin_atan2(sine, q[0]), scale = sine > 1e-10 ? angle / sine : 2.0;
    double w[3], W[3][3], W2[3][3];
    for (int k = 0; k < 3; k++) w[k] = scale * q[1 + k];
    hat(w, W);
    multiply(W, W, W2);
    const double c = angle < 1e-2 ? 1.0 / 12.0 + angle * angle / 720.0 : (1.0 - 0.5 * angle * q[0] / sine) / (angle * angle);
    for (int i = 0; i < 3; i++) {
        tangent[i] = 0.0;
        for (int j = 0; j < 3; j++) tangent[i] += ((i == j ? 1.0 : 0.0) - 0.5 * W[i][j] + c * W2[i][j]) * m.t[j];
        tangent[3 + i] = w[i];
    }
}

// Solution of A x = b by elimination with partial pivoting; A is changed, b becomes x.
static void solve(double A[PARAMETERS][PARAMETERS], double* b) {
    for (int k = 0; k < PARAMETERS; k++) {
        int pivot = k;
        for (int i = k + 1; i < PARAMETERS; i++) pivot = __builtin_fabs(A[i][k]) > __builtin_fabs(A[pivot][k]) ? i : pivot;
        if (pivot != k) {
            for (int j = k; j < PARAMETERS; j++) {
                const double moved = A[k][j];
                A[k][j] = A[pivot][j], A[pivot][j] = moved;
            }
            const double moved = b[k];
            b[k] = b[pivot], b[pivot] = moved;
        }
        for (int i = k + 1; i < PARAMETERS; i++) {
            const double factor = A[i][k] / A[k][k];
            for (int j = k; j < PARAMETERS; j++) A[i][j] -= factor * A[k][j];
            b[i] -= factor * b[k];
        }
    }
    for (int i = PARAMETERS - 1; i >= 0; i--) {
        for (int j = i + 1; j < PARAMETERS; j++) b[i] -= A[i][j] * b[j];
        b[i] /= A[i][i];
    }
}

// P^T H P and P^T g, where P takes the pose's part of a step to the determined directions.
static void restrict_to(const double* projection, double H[PARAMETERS][PARAMETERS], double* g) {
    double P[PARAMETERS][PARAMETERS] = {}, HP[PARAMETERS][PARAMETERS], Pg[PARAMETERS];
    for (int i = 0; i < PARAMETERS; i++)
        for (int j = 0; j < PARAMETERS; j++)
            P[i][j] = i < POSE_PARAMETERS && j < POSE_PARAMETERS ? projection[POSE_PARAMETERS * i + j] : i == j ? 1.0 : 0.0;
    for (int i = 0; i < PARAMETERS; i++)
        for (int j = 0; j < PARAMETERS; j++) {
            HP[i][j] = 0.0;
            for (int k = 0; k < PARAMETERS; k++) HP[i][j] += H[i][k] * P[k][j];
        }
    for (int i = 0; i < PARAMETERS; i++) {
        Pg[i] = 0.0;
        for (int k = 0; k < PARAMETERS; k++) Pg[i] += P[k][i] * g[k];
        for (int j = 0; j < PARAMETERS; j++) {
            H[i][j] = 0.0;
            for (int k = 0; k < PARAMETERS; k++) H[i][j] += P[k][i] * HP[k][j];
        }
    }
    std::memcpy(g, Pg, sizeof Pg);
}

// The factor, at least 1, by which the normal matrix exceeds the information because neighboring residuals share errors: by the outer
// products of the gradients summed over tiles (registration.normal_equations).
static double correlation(const NormalEquations& part) {
    const int n = part.H[PARAMETERS - 1][PARAMETERS - 1] > 0.0 ? PARAMETERS : POSE_PARAMETERS;
    double trace = 0.0;
    for (int k = 0; k < n; k++) trace += part.H[k][k];
    double total = 0.0;
    for (int column = 0; column < n; column++) {
        double A[PARAMETERS][PARAMETERS] = {}, b[PARAMETERS] = {};
        for (int i = 0; i < PARAMETERS; i++)
            for (int j = 0; j < PARAMETERS; j++)
                A[i][j] = i < n && j < n ? part.H[i][j] + (i == j ? 1e-10 * trace / n + 1e-300 : 0.0) : i == j ? 1.0 : 0.0;
        for (int i = 0; i < n; i++)
            for (int tile = 0; tile < ALIGNMENT_TILES; tile++) b[i] += part.tile_gradients[tile][i] * part.tile_gradients[tile][column];
        solve(A, b);
        total += b[column];
    }
    return total > n ? total / n : 1.0;
}

static void divide(NormalEquations& part, double factor) {
    for (int i = 0; i < PARAMETERS; i++) {
        part.gradient[i] /= factor;
        for (int j = 0; j < PARAMETERS; j++) part.H[i][j] /= factor;
    }
}

// A Gauss-Newton step, slightly damped and limited in length; the largest component of its pose.
static double gauss_newton_step(const AlignmentSystem& system, const Motion& T, const Motion& guess, const AlignmentSearch& search, double* step) {
    double H[PARAMETERS][PARAMETERS], g[PARAMETERS];
    for (int i = 0; i < PARAMETERS; i++) {
        g[i] = system.depth.gradient[i] + system.gray.gradient[i];
        for (int j = 0; j < PARAMETERS; j++) H[i][j] = system.depth.H[i][j] + system.gray.H[i][j];
    }
    if (search.projection) restrict_to(search.projection, H, g);
    if (search.prior) {
        double moved[POSE_PARAMETERS];
        logarithm(product(inverse(guess), T), moved);
        for (int i = 0; i < POSE_PARAMETERS; i++) {
            double force = 0.0;
            for (int j = 0; j < POSE_PARAMETERS; j++) {
                H[i][j] += search.prior[POSE_PARAMETERS * i + j];
                force += search.prior[POSE_PARAMETERS * i + j] * moved[j];
            }
            g[i] += force;
        }
    }
    // brightness is not observable on an untextured view: a weak pull keeps the system regular
    for (int k = POSE_PARAMETERS; k < PARAMETERS; k++) H[k][k] += 1.0;
    double trace = 0.0;
    for (int k = 0; k < PARAMETERS; k++) {
        H[k][k] += 1e-6 * H[k][k];
        trace += H[k][k];
    }
    for (int k = 0; k < PARAMETERS; k++) H[k][k] += 1e-10 * trace / PARAMETERS + 1e-300;
    solve(H, g);
    for (int k = 0; k < PARAMETERS; k++) step[k] = -g[k];
    if (search.projection && !search.prior) {
        double determined[POSE_PARAMETERS];
        for (int i = 0; i < POSE_PARAMETERS; i++) {
            determined[i] = 0.0;
            for (int j = 0; j < POSE_PARAMETERS; j++) determined[i] += search.projection[POSE_PARAMETERS * i + j] * step[j];
        }
        std::memcpy(step, determined, sizeof determined);
    }
    double largest = 0.0;
    for (int k = 0; k < POSE_PARAMETERS; k++) largest = __builtin_fabs(step[k]) > largest ? __builtin_fabs(step[k]) : largest;
    if (largest > LARGEST_STEP) {
        for (int k = 0; k < PARAMETERS; k++) step[k] *= LARGEST_STEP / largest;
        return LARGEST_STEP;
    }
    return largest;
}

static void align_at(const SampleArrays& samples, const TargetImages& image, int level, const double* T, const double* exposure,
                     const AlignmentSettings& settings, bool statistics, AlignmentScratch& scratch, AlignmentSystem& system) {
    const Motion m = inverse(motion_of(T));
    float rows[12];
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) rows[4 * i + j] = static_cast<float>(m.R[i][j]);
        rows[4 * i + 3] = static_cast<float>(m.t[i]);
    }
    align_level(samples, image, level, rows, exposure, settings, statistics, scratch, system);
}

// From the guess in `state` to the minimum, and the residuals there, with statistics, at the finest level.
static void align(const SampleArrays* samples, const TargetImages* images, const AlignmentSettings& settings, const AlignmentSearch& search,
                  AlignmentScratch& scratch, AlignmentState& state, AlignmentSystem& system) {
    const Motion guess = motion_of(state.T);
    Motion T = guess;
    const auto write_pose = [&] {
        for (int i = 0; i < 3; i++) {
            for (int j = 0; j < 3; j++) state.T[4 * i + j] = T.R[i][j];
            state.T[4 * i + 3] = T.t[i];
        }
    };
    state.steps = 0;
    for (int level = search.levels - 1; level >= 0; level--)
        for (int k = 0; k < search.iterations[level]; k++) {
            const bool weighted = search.weights_by_correlation && level == 0;
            align_at(samples[level], images[level], level, state.T, state.exposure, settings, weighted, scratch, system);
            state.steps++;
            if (system.agreeing < search.min_samples) break;
            if (weighted)
                for (NormalEquations* part : {&system.depth, &system.gray}) divide(*part, correlation(*part));
            double step[PARAMETERS];
            const double largest = gauss_newton_step(system, T, guess, search, step);
            T = product(T, exponential(step));
            make_orthonormal(T);
            write_pose();
            for (int i = 0; i < 2; i++) state.exposure[i] += step[POSE_PARAMETERS + i];
            if (largest < (level == 0 ? search.tolerance : search.coarse_tolerance)) break;
        }
    align_at(samples[0], images[0], 0, state.T, state.exposure, settings, true, scratch, system);
    state.steps++;
}

}  // namespace KERNEL_ISA
