// Sixteen Gaussians as one camera sees them, and the way back from screen to parameters.
//
// With J the derivative of the projection, W the rotation to the camera, R the Gaussian's axes and S its scales:
//   axes = W R,   P = J axes (2x3),   U = P S,   covariance on the screen C = U U^T + BLUR I.
// The pixel loops work in e = M d, d = pixel - center, with M^T M = C^-1 log2(e)/2, so that alpha = opacity 2^-|e|^2.
// No 3x3 covariance is ever formed; the way back needs only the symmetric Y = P^T G P, G the cotangent of C: it is the
// cotangent of Sigma in the Gaussian's own axes.
//
// Depth along the ray of a pixel: z + k^T C^-1 d with k = P S^2 a the covariance of screen position and depth, a = axes^T e_z.
#pragma once

#include "frame.h"
#include "vector_math.h"

namespace KERNEL_ISA {

using namespace raster;

constexpr float NEAR_M = 0.01f;              // Gaussians whose center is nearer are not drawn
constexpr float BLUR_PX2 = 1.0f / 12;        // low-pass added to the screen covariance: the variance of a square pixel
constexpr float FIELD_MARGIN = 1.3f;         // J is linearized no further out than this times the half field
constexpr float LARGEST_PX2 = 1e12f;         // Gaussians with more variance on the screen are not drawn
constexpr float SQRT_HALF_LOG2_E = 0.84932180f;  // sqrt(log2(e) / 2)
constexpr float LOG2_ALPHA_MIN = -7.99435344f;  // log2(1/255): fainter contributions are skipped

struct Splat16 {
    Vec x, y, z, inverse_z;          // center, camera frame
    Vec slope_x, slope_y;            // x/z, y/z
    Vec inside_x, inside_y;          // 1 where the slope of J is not clamped
    Vec quat[4], inverse_norm;       // unit quaternion wxyz, 1/length as given
    Vec R[9], axes[9];               // R(q), W R(q)
    Vec log_scale[3], scale[3];
    Vec J00, J02, J11, J12;          // J = [J00 0 J02; 0 J11 J12]
    Vec P[6];
    Vec cov_xx, cov_yy;
    Vec M11, M12, M22;               // M = [M11 M12; 0 M22], 1/px
    Vec N[6];                        // M P: the axes as e sees them
    Vec u, v;
    Mask drawable;
};

inline void rotation_of_quaternion(const Vec* q, Vec* R) {
    const Vec w = q[0], x = q[1], y = q[2], z = q[3], one(1.0f), two(2.0f);
    R[0] = one - two * (y * y + z * z);
    R[1] = two * (x * y - w * z);
    R[2] = two * (x * z + w * y);
    R[3] = two * (x * y + w * z);
    R[4] = one - two * (x * x + z * z);
    R[5] = two * (y * z - w * x);
    R[6] = two * (x * z - w * y);
    R[7] = two * (y * z + w * x);
    R[8] = one - two * (x * x + y * y);
}

// Sixteen centers: in the camera frame, as slopes x/z, y/z, on the screen.
struct CameraPoint16 {
    Vec x, y, z, inverse_z, slope_x, slope_y, u, v;
    CameraPoint16(const View& view, const Vec* mean) {
        const float *W = view.R, *t = view.t;
        x = fma(Vec(W[0]), mean[0], fma(Vec(W[1]), mean[1], fma(Vec(W[2]), mean[2], Vec(t[0]))));
        y = fma(Vec(W[3]), mean[0], fma(Vec(W[4]), mean[1], fma(Vec(W[5]), mean[2], Vec(t[1]))));
        z = fma(Vec(W[6]), mean[0], fma(Vec(W[7]), mean[1], fma(Vec(W[8]), mean[2], Vec(t[2]))));
        inverse_z = Vec(1.0f) / max(z, Vec(NEAR_M));
        slope_x = x * inverse_z;
        slope_y = y * inverse_z;
        u = fma(Vec(view.fx), slope_x, Vec(view.cx));
        v = fma(Vec(view.fy), slope_y, Vec(view.cy));
    }
};
// Where the principal point is far from the middle, as in a cut-out, up to the border that is farther from it.
inline float slope_limit(int pixels, float focal, float center) {
    const float before = center + 0.5f, after = pixels - before, border = before > after ? before : after;
    const float usual = FIELD_MARGIN * 0.5f * pixels;
    return (usual > border ? usual : border) / focal;
}

inline Splat16 project16(const View& view, const Vec* mean, const Vec* quat, const Vec* log_scale) {
    Splat16 s;
    const float* W = view.R;
    const CameraPoint16 c(view, mean);
    s.x = c.x, s.y = c.y, s.z = c.z, s.inverse_z = c.inverse_z;
    s.slope_x = c.slope_x, s.slope_y = c.slope_y, s.u = c.u, s.v = c.v;

    const Vec limit_x(slope_limit(view.width, view.fx, view.cx)), limit_y(slope_limit(view.height, view.fy, view.cy));
    const Vec clamped_x = min(max(s.slope_x, -limit_x), limit_x);
    const Vec clamped_y = min(max(s.slope_y, -limit_y), limit_y);
    s.inside_x = select_or_zero((s.slope_x >= -limit_x) & (s.slope_x <= limit_x), Vec(1.0f));
    s.inside_y = select_or_zero((s.slope_y >= -limit_y) & (s.slope_y <= limit_y), Vec(1.0f));
    s.J00 = Vec(view.fx) * s.inverse_z;
    s.J11 = Vec(view.fy) * s.inverse_z;
    s.J02 = -(s.J00 * clamped_x);
    s.J12 = -(s.J11 * clamped_y);

    const Vec norm2 = fma(quat[0], quat[0], fma(quat[1], quat[1], fma(quat[2], quat[2], quat[3] * quat[3])));
    s.inverse_norm = Vec(1.0f) / sqrt(norm2);
    for (int k = 0; k < 4; k++) s.quat[k] = quat[k] * s.inverse_norm;
    rotation_of_quaternion(s.quat, s.R);
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < 3; k++)
            s.axes[3 * i + k] = fma(Vec(W[3 * i]), s.R[k], fma(Vec(W[3 * i + 1]), s.R[3 + k], Vec(W[3 * i + 2]) * s.R[6 + k]));

    Vec U[6];
    for (int k = 0; k < 3; k++) {
        s.log_scale[k] = log_scale[k];
        s.scale[k] = exp(log_scale[k]);
        s.P[k] = fma(s.J00, s.axes[k], s.J02 * s.axes[6 + k]);
        s.P[3 + k] = fma(s.J11, s.axes[3 + k], s.J12 * s.axes[6 + k]);
        U[k] = s.P[k] * s.scale[k];
        U[3 + k] = s.P[3 + k] * s.scale[k];
    }
    const Vec xx = fma(U[0], U[0], fma(U[1], U[1], U[2] * U[2])), yy = fma(U[3], U[3], fma(U[4], U[4], U[5] * U[5]));
    const Vec xy = fma(U[0], U[3], fma(U[1], U[4], U[2] * U[5])), blur(BLUR_PX2);
    s.cov_xx = xx + blur;
    s.cov_yy = yy + blur;
    // det(U U^T + b I) = sum of the squared 2x2 minors of U + b trace + b^2: nothing cancels for needles
    const Vec m01 = U[0] * U[4] - U[1] * U[3], m02 = U[0] * U[5] - U[2] * U[3], m12 = U[1] * U[5] - U[2] * U[4];
    const Vec determinant = fma(m01, m01, fma(m02, m02, fma(m12, m12, fma(blur, xx + yy, blur * blur))));
    const Vec scale(SQRT_HALF_LOG2_E);
    s.M11 = scale * sqrt(s.cov_yy / determinant);
    s.M12 = -(xy / s.cov_yy) * s.M11;
    s.M22 = scale / sqrt(s.cov_yy);
    // N = M P. Its first row is M11 (P_xk - xy/yy P_yk), which cancels along a needle; by the minors it does not:
    // P_xk yy - P_yk xy = sum_j U_yj (P_xk U_yj - P_yk U_xj) + blur P_xk
    const Vec to_first = s.M11 / s.cov_yy;
    for (int k = 0; k < 3; k++) {
        const int i = (k + 1) % 3, j = (k + 2) % 3;
        const Vec minor_i = s.P[k] * U[3 + i] - s.P[3 + k] * U[i], minor_j = s.P[k] * U[3 + j] - s.P[3 + k] * U[j];
        s.N[k] = to_first * fma(U[3 + i], minor_i, fma(U[3 + j], minor_j, blur * s.P[k]));
        s.N[3 + k] = s.M22 * s.P[3 + k];
    }
    s.drawable = (s.z >= Vec(NEAR_M)) & (s.cov_xx <= Vec(LARGEST_PX2)) & (s.cov_yy <= Vec(LARGEST_PX2));
    return s;
}

inline Vec sigmoid(Vec logit) { return Vec(1.0f) / (Vec(1.0f) + exp(-logit)); }
inline Vec log2_sigmoid(Vec logit) { return -log2_1p(exp(-logit)); }

// ---------------------------------------------------------------- screen to parameters

struct Symmetric2 {
    Vec xx, xy, yy;
};

// Second moments sum w e e^T in the unit of the cotangent of C, G = M^T W M; w: cotangent of ln alpha. For
// ln alpha = -d^T C^-1 d / 2 it is C^-1 (sum w d d^T) C^-1 / 2, and C^-1 = 2 ln2 M^T M.
inline Symmetric2 whitened_cotangent(Vec w_xx, Vec w_xy, Vec w_yy) {
    const Vec factor(2.0f * LN_2 * LN_2);
    return {factor * w_xx, factor * w_xy, factor * w_yy};
}

// Adds what the first moments sum w e mean for the center in the camera frame: d ln alpha / d center = 2 ln2 M^T e.
inline void add_center_from_moments(const Splat16& s, Vec w_x, Vec w_y, Vec* d_center) {
    const Vec factor(2.0f * LN_2);
    const Vec x = factor * (s.M11 * w_x) * s.J00, y = factor * fma(s.M12, w_x, s.M22 * w_y) * s.J11;
    d_center[0] += x;
    d_center[1] += y;
    d_center[2] = fnma(x, s.slope_x, fnma(y, s.slope_y, d_center[2]));
}

// Q = W N (2x3), and Y = P^T G P = N^T Q as (00, 11, 22, 01, 02, 12). G itself is never formed: along a needle it would
// cancel as the square of length over width.
inline void own_axes_cotangent(const Splat16& s, const Symmetric2& w, Vec* Q, Vec* Y) {
    for (int k = 0; k < 3; k++) {
        Q[k] = fma(w.xx, s.N[k], w.xy * s.N[3 + k]);
        Q[3 + k] = fma(w.xy, s.N[k], w.yy * s.N[3 + k]);
    }
    auto product = [&](int i, int k) { return fma(s.N[i], Q[k], s.N[3 + i] * Q[3 + k]); };
    Y[0] = product(0, 0);
    Y[1] = product(1, 1);
    Y[2] = product(2, 2);
    Y[3] = product(0, 1);
    Y[4] = product(0, 2);
    Y[5] = product(1, 2);
}

// Cotangent of J, 2x3, from Q: covariance = P S^2 P^T, P = J axes, G P = M^T Q.
inline void jacobian_cotangent(const Splat16& s, const Vec* Q, Vec* d_J) {
    Vec d_P[6];
    for (int k = 0; k < 3; k++) {
        const Vec twice = s.scale[k] * s.scale[k] * Vec(2.0f);
        d_P[k] = s.M11 * Q[k] * twice;
        d_P[3 + k] = fma(s.M12, Q[k], s.M22 * Q[3 + k]) * twice;
    }
    for (int r = 0; r < 2; r++)
        for (int j = 0; j < 3; j++)
            d_J[3 * r + j] = fma(d_P[3 * r], s.axes[3 * j],
                                 fma(d_P[3 * r + 1], s.axes[3 * j + 1], d_P[3 * r + 2] * s.axes[3 * j + 2]));
}

// <d_J, J> = 2 tr(S^2 Y), which does not cancel.
inline Vec jacobian_along_itself(const Splat16& s, const Vec* Y) {
    Vec along_J(0.0f);
    for (int k = 0; k < 3; k++) along_J = fma(Vec(2.0f) * s.scale[k] * s.scale[k], Y[k], along_J);
    return along_J;
}

// Adds what a cotangent of J means for the center in the camera frame. All of J goes as 1/z; along_J: <d_J, J>.
inline void add_center_from_jacobian(const Splat16& s, const Vec* d_J, Vec along_J, Vec* d_center) {
    const Vec d_slope_x = -(s.J00 * d_J[2]) * s.inside_x, d_slope_y = -(s.J11 * d_J[5]) * s.inside_y;
    d_center[0] += d_slope_x * s.inverse_z;
    d_center[1] += d_slope_y * s.inverse_z;
    d_center[2] = fnma(s.inverse_z, fma(d_slope_x, s.slope_x, fma(d_slope_y, s.slope_y, along_J)), d_center[2]);
}

// The depth along the ray is z + g . e with g = 2 ln2 M k = 2 ln2 N S^2 a.
inline void depth_slopes(const Splat16& s, Vec* g) {
    g[0] = g[1] = Vec(0.0f);
    for (int k = 0; k < 3; k++) {
        const Vec factor = s.scale[k] * s.axes[6 + k] * Vec(2.0f * LN_2);
        g[0] = fma(s.N[k] * s.scale[k], factor, g[0]);
        g[1] = fma(s.N[3 + k] * s.scale[k], factor, g[1]);
    }
}

// What the depth along the ray adds on the way back. With q = C^-1 d and m = C^-1 k
//   d(k^T C^-1 d) = q . dk - m^T dC q - m . d(center),
// and as k and C hold the same Sigma, cotangents come in pairs, with y = P^T q = 2 ln2 N^T e and r = a - P^T m:
//   of Sigma in own axes   (y r^T + r y^T) / 2
//   of J                   q (axes S^2 r)^T - m (axes S^2 y)^T, with <d_J, J> = 2 b q . m - g . e, b the blur
//   of a turn of the camera, in which e_z turns: e_z x axes S^2 y, alongside that of J
// q = 2 ln2 M^T e, m = M^T g.
struct RayDepth {
    Vec g[2], r[3];

    explicit RayDepth(const Splat16& s) {
        depth_slopes(s, g);
        find_r(s);
    }

    // Adds the cotangents of sum f v z(pixel) except that of z itself, from Z = sum f v and (X, Y) = sum f v e.
    void add_cotangents(const Splat16& s, Vec sum, Vec sum_x, Vec sum_y, Vec* Y, Vec* d_J, Vec& along_J, Vec* d_center, Vec* turn) const {
        const Vec two_ln2(2.0f * LN_2), half(0.5f);
        const Vec q[2] = {two_ln2 * (s.M11 * sum_x), two_ln2 * fma(s.M12, sum_x, s.M22 * sum_y)};
        const Vec m[2] = {s.M11 * g[0], fma(s.M12, g[0], s.M22 * g[1])};
        Vec y[3], S2r[3], S2y[3];
        for (int k = 0; k < 3; k++) {
            const Vec scale2 = s.scale[k] * s.scale[k];
            y[k] = two_ln2 * fma(s.N[k], sum_x, s.N[3 + k] * sum_y);
            S2r[k] = scale2 * r[k];
            S2y[k] = scale2 * y[k];
            Y[k] = fma(y[k], r[k], Y[k]);
        }
        Y[3] = fma(half, fma(y[0], r[1], y[1] * r[0]), Y[3]);
        Y[4] = fma(half, fma(y[0], r[2], y[2] * r[0]), Y[4]);
        Y[5] = fma(half, fma(y[1], r[2], y[2] * r[1]), Y[5]);
        for (int j = 0; j < 3; j++) {
            const Vec of_r = in_camera(s, S2r, j), of_y = in_camera(s, S2y, j);
            d_J[j] += fnma(m[0], of_y, q[0] * of_r);
            d_J[3 + j] += fnma(m[1], of_y, q[1] * of_r);
        }
        along_J += fnma(g[0], sum_x, fnma(g[1], sum_y, Vec(2.0f * BLUR_PX2) * fma(q[0], m[0], q[1] * m[1])));
        const Vec by_u = -(sum * m[0]) * s.J00, by_v = -(sum * m[1]) * s.J11;
        d_center[0] += by_u;
        d_center[1] += by_v;
        d_center[2] = fnma(by_u, s.slope_x, fnma(by_v, s.slope_y, d_center[2]));
        turn[0] = -in_camera(s, S2y, 1);
        turn[1] = in_camera(s, S2y, 0);
    }

private:
    static Vec in_camera(const Splat16& s, const Vec* own, int row) {
        const Vec* axes = s.axes + 3 * row;
        return fma(axes[0], own[0], fma(axes[1], own[1], axes[2] * own[2]));
    }

    // r is a small difference if the Gaussian is flat or long. With U = P S and b the blur
    //   S r = (1 - U^T C^-1 U) S a = (1 + U^T U / b)^-1 S a = (b^2 + b sum_u (|u|^2 - u u^T) + n n^T) S a / det C,
    // u the two rows of U and n their cross product; n . S a = det(J, e_z) s0 s1 s2, and division by S leaves cross products
    // of J_x, J_y and e_z in own axes.
    void find_r(const Splat16& s) {
        const Vec blur(BLUR_PX2), area = s.J00 * s.J11, to_unit = Vec(2.0f * LN_2) * (s.M11 * s.M22);  // 1 / sqrt(det C)
        Vec a_Px[3], a_Py[3];  // a x P_x, a x P_y
        for (int k = 0; k < 3; k++) {
            a_Px[k] = s.J00 * s.axes[3 + k];
            a_Py[k] = -(s.J11 * s.axes[k]);
        }
        for (int k = 0; k < 3; k++) {
            const int i = (k + 1) % 3, j = (k + 2) % 3;
            const Vec of_i = s.scale[i] * s.scale[i] * fma(s.P[i], a_Px[j], s.P[3 + i] * a_Py[j]);
            const Vec of_j = s.scale[j] * s.scale[j] * fma(s.P[j], a_Px[i], s.P[3 + j] * a_Py[i]);
            const Vec blurred = blur * fma(blur, s.axes[6 + k], of_i - of_j);
            const Vec normal = fma(area, s.axes[6 + k], fnma(s.J02 * s.J11, s.axes[k], -(s.J00 * s.J12 * s.axes[3 + k])));  // P_x x P_y
            const Vec face = to_unit * (s.scale[i] * s.scale[j]);
            r[k] = fma(face * normal, face * area, to_unit * blurred * to_unit);
        }
    }
};

// W^T d: a cotangent of the center from the camera frame to the map frame.
inline void to_map_frame(const View& view, const Vec* d_center, Vec* d_mean) {
    const float* W = view.R;
    for (int k = 0; k < 3; k++)
        d_mean[k] = fma(Vec(W[k]), d_center[0], fma(Vec(W[3 + k]), d_center[1], Vec(W[6 + k]) * d_center[2]));
}

// Cotangents of the log-scales: 2 s_k^2 Y_kk.
inline void log_scale_cotangent(const Splat16& s, const Vec* Y, Vec* d_log_scale) {
    for (int k = 0; k < 3; k++) d_log_scale[k] = Vec(2.0f) * s.scale[k] * s.scale[k] * Y[k];
}

// Cotangent of the quaternion as given. A turn w about the Gaussian's own axes changes Sigma by Y_ik (s_k^2 - s_i^2),
// and w = 2 vec(conj(q) dq).
inline void quaternion_cotangent(const Splat16& s, const Vec* Y, Vec* d_quat) {
    // s_i^2 - s_k^2 by the divided difference, which knows nearly equal scales apart
    auto turn = [&](int i, int k) {
        const Vec *l = s.log_scale, eight(8.0f);
        return eight * ((l[i] - l[k]) * exp2x_divided_difference(l[i], l[k], s.scale[i], s.scale[k])) * s.inverse_norm;
    };
    const Vec x = Y[5] * turn(1, 2), y = Y[4] * turn(2, 0), z = Y[3] * turn(0, 1);
    const Vec *q = s.quat;
    d_quat[0] = -fma(q[1], x, fma(q[2], y, q[3] * z));
    d_quat[1] = fma(q[0], x, q[2] * z - q[3] * y);
    d_quat[2] = fma(q[0], y, q[3] * x - q[1] * z);
    d_quat[3] = fma(q[0], z, q[1] * y - q[2] * x);
}

// Cotangent of the right tangent (translation, rotation) of T_map_camera: the camera frame sees p' = p - v - w x p
// and axes' = axes - w x axes.
inline void pose_cotangent(const Splat16& s, const Vec* d_center, const Vec* d_J, Vec* d_pose) {
    const Vec *g = d_center, n02 = s.J00 * d_J[2], n20 = fma(s.J02, d_J[0], s.J12 * d_J[3]);
    const Vec n12 = s.J11 * d_J[5], n21 = fma(s.J02, d_J[1], s.J12 * d_J[4]);
    const Vec n10 = s.J11 * d_J[3], n01 = s.J00 * d_J[1];
    for (int k = 0; k < 3; k++) d_pose[k] = -g[k];
    d_pose[3] = (s.z * g[1] - s.y * g[2]) + (n12 - n21);
    d_pose[4] = (s.x * g[2] - s.z * g[0]) + (n20 - n02);
    d_pose[5] = (s.y * g[0] - s.x * g[1]) + (n01 - n10);
}
// Adds the turn of e_z, which only the depth along the ray sees.
inline void add_turn_of_depth(const Vec* turn, Vec* d_pose) {
    d_pose[3] += turn[0];
    d_pose[4] += turn[1];
}

}  // namespace KERNEL_ISA
