/* The limit that compiled rollouts are measured against, written by hand: RK4 of three links on a
   fixed pivot, with constant viscous plus Coulomb friction, or with load-dependent friction whose
   two coefficients a neuro-fuzzy network gives, held over the step. Same formulas as nfriction;
   what depends on parameters alone is computed once, by the caller. With -DADDITION the angles
   between links come from the addition theorems: fewer sines than the torch definition asks for. */
#include <math.h>
#include <string.h>

#define N 3
#define TERMS 5
#define UNITS 10

struct rig { /* a_ij [kg m^2], g b_i [N m], l_i/g [s^2], 1/v_smooth [s/rad] */
    double coupling[N][N], gravity[N], lever[N], sharpness;
};

struct network { /* of one joint; `plane` holds slopes and constant of both outputs */
    double inverse_range, inverse_turn, lower, inverse_span, centre[2][TERMS],
        inverse_width[2][TERMS], plane[TERMS][TERMS][6], unit_centre[UNITS][4],
        unit_precision[UNITS][4], unit_out[UNITS][2], bias[2], reference[2], scale[2], roundness,
        inverse_reach;
};

static void acceleration(const struct rig *p, const double c[N][2], int loaded, const double *q,
    const double *qd, double *qdd)
{
    const double a0 = q[0], a1 = a0 + q[1], a2 = a1 + q[2];
    const double r0 = qd[0], r1 = r0 + qd[1], r2 = r1 + qd[2];
    const double rr0 = r0 * r0, rr1 = r1 * r1, rr2 = r2 * r2;
    const double s0 = sin(a0), s1 = sin(a1), s2 = sin(a2);
    const double m00 = p->coupling[0][0], m11 = p->coupling[1][1], m22 = p->coupling[2][2];
#ifdef ADDITION
    const double c0 = cos(a0), c1 = cos(a1), c2 = cos(a2);
    const double c01 = c0 * c1 + s0 * s1, s01 = s1 * c0 - c1 * s0;
    const double c12 = c1 * c2 + s1 * s2, s12 = s2 * c1 - c2 * s1;
    const double c02 = c0 * c2 + s0 * s2, s02 = s2 * c0 - c2 * s0;
#else
    const double c01 = cos(q[1]), s01 = sin(q[1]), c12 = cos(q[2]), s12 = sin(q[2]);
    const double c02 = cos(q[1] + q[2]), s02 = sin(q[1] + q[2]);
#endif
    const double m01 = p->coupling[0][1] * c01, t01 = p->coupling[0][1] * s01;
    const double m02 = p->coupling[0][2] * c02, t02 = p->coupling[0][2] * s02;
    const double m12 = p->coupling[1][2] * c12, t12 = p->coupling[1][2] * s12;
    double f[N], b0, b1, b2, i0, i1, l1, l2, l3, d11, d12, d22, x0, x1, x2;
    int j;
    for (j = 0; j < N; ++j) f[j] = c[j][1] * tanh(qd[j] * p->sharpness);
    if (loaded) {
#ifndef ADDITION
        const double c0 = cos(a0), c1 = cos(a1), c2 = cos(a2);
#endif
        f[0] *= fabs(p->lever[0] * qd[0] * qd[0] - c0);
        f[1] *= fabs(p->lever[1] * qd[1] * qd[1] - c1);
        f[2] *= fabs(p->lever[2] * qd[2] * qd[2] - c2);
    }
    for (j = 0; j < N; ++j) f[j] += c[j][0] * qd[j];
    b0 = f[1] - f[0] + p->gravity[0] * s0 + t01 * rr1 + t02 * rr2;
    b1 = f[2] - f[1] + p->gravity[1] * s1 - t01 * rr0 + t12 * rr2;
    b2 = -f[2] + p->gravity[2] * s2 - t02 * rr0 - t12 * rr1;
    i0 = 1.0 / m00;
    l1 = m01 * i0;
    l2 = m02 * i0;
    d11 = m11 - l1 * m01;
    d12 = m12 - l1 * m02;
    d22 = m22 - l2 * m02;
    b1 -= l1 * b0;
    b2 -= l2 * b0;
    i1 = 1.0 / d11;
    l3 = d12 * i1;
    b2 -= l3 * b1;
    x2 = b2 / (d22 - l3 * d12);
    x1 = (b1 - d12 * x2) * i1;
    x0 = (b0 - m01 * x1 - m02 * x2) * i0;
    qdd[0] = x0;
    qdd[1] = x1 - x0;
    qdd[2] = x2 - x1;
}

static double clamp(double x) { return x < 0.0 ? 0.0 : x > 1.0 ? 1.0 : x; }

static void coefficients(const struct network *f, const double *qd, const double *qdd,
    double c[N][2])
{
    int j, k, a, b, u;
    for (j = 0; j < N; ++j, ++f) {
        const double v = qd[j] * f->inverse_range, along = qdd[j] * tanh(v * f->inverse_turn);
        const double given[2] = {fabs(v), (along - f->lower) * f->inverse_span};
        const double x[2] = {clamp(given[0]), clamp(given[1])};
        const double e0 = (given[0] - x[0]) * f->inverse_reach;
        const double e1 = (given[1] - x[1]) * f->inverse_reach;
        const double left = fmax(1.0 - e0 * e0 - e1 * e1, 0.0);
        double w[2][TERMS], plane[6] = {0.0}, y[2], o[2];
        for (k = 0; k < 2; ++k) {
            double top = -HUGE_VAL, sum = 0.0;
            for (a = 0; a < TERMS; ++a) {
                const double z = (x[k] - f->centre[k][a]) * f->inverse_width[k][a];
                w[k][a] = -0.5 * z * z;
                if (w[k][a] > top) top = w[k][a];
            }
            for (a = 0; a < TERMS; ++a) sum += w[k][a] = exp(w[k][a] - top);
            sum = 1.0 / sum;
            for (a = 0; a < TERMS; ++a) w[k][a] *= sum;
        }
        for (a = 0; a < TERMS; ++a)
            for (b = 0; b < TERMS; ++b) {
                const double strength = w[0][a] * w[1][b];
                for (k = 0; k < 6; ++k) plane[k] += strength * f->plane[a][b][k];
            }
        for (k = 0; k < 2; ++k) {
            y[k] = plane[3 * k] * x[0] + plane[3 * k + 1] * x[1] + plane[3 * k + 2];
            o[k] = y[k] + f->bias[k];
        }
        for (u = 0; u < UNITS; ++u) {
            const double *m = f->unit_centre[u], *p = f->unit_precision[u];
            const double d0 = x[0] - m[0], d1 = x[1] - m[1], d2 = y[0] - m[2], d3 = y[1] - m[3];
            const double g = exp(-(d0 * d0 * p[0] + d1 * d1 * p[1] + d2 * d2 * p[2]
                + d3 * d3 * p[3]));
            o[0] += g * f->unit_out[u][0];
            o[1] += g * f->unit_out[u][1];
        }
        for (k = 0; k < 2; ++k) {
            const double r = f->reference[k] + left * left * o[k];
            c[j][k] = f->scale[k] * (r + sqrt(r * r + f->roundness));
        }
    }
}

/* `networks` (N of them) may be null: then `constant` gives the coefficients, without load. */
void limit_rollout(long steps, double dt, const struct rig *p, const double *constant,
    const struct network *networks, const double *q0, const double *qd0, double *q_out,
    double *qd_out, double *qdd_out)
{
    const double half = 0.5 * dt, sixth = dt / 6.0, none[N][2] = {{0.0}};
    double q[N], qd[N], prev[N], x[N], a1[N], a2[N], a3[N], a4[N], v2[N], v3[N], v4[N], c[N][2];
    const int loaded = networks != 0;
    long k;
    int i;
    memcpy(q, q0, sizeof q);
    memcpy(qd, qd0, sizeof qd);
    if (!loaded) memcpy(c, constant, sizeof c);
    acceleration(p, none, loaded, q, qd, prev);
    for (k = 0; k <= steps; ++k) {
        memcpy(q_out + k * N, q, sizeof q);
        memcpy(qd_out + k * N, qd, sizeof qd);
        memcpy(qdd_out + k * N, prev, sizeof prev);
        if (k == steps) break;
        if (loaded) coefficients(networks, qd, prev, c);
        acceleration(p, (const double (*)[2])c, loaded, q, qd, a1);
        for (i = 0; i < N; ++i) x[i] = q[i] + half * qd[i], v2[i] = qd[i] + half * a1[i];
        acceleration(p, (const double (*)[2])c, loaded, x, v2, a2);
        for (i = 0; i < N; ++i) x[i] = q[i] + half * v2[i], v3[i] = qd[i] + half * a2[i];
        acceleration(p, (const double (*)[2])c, loaded, x, v3, a3);
        for (i = 0; i < N; ++i) x[i] = q[i] + dt * v3[i], v4[i] = qd[i] + dt * a3[i];
        acceleration(p, (const double (*)[2])c, loaded, x, v4, a4);
        for (i = 0; i < N; ++i) {
            q[i] += sixth * (qd[i] + 2.0 * (v2[i] + v3[i]) + v4[i]);
            qd[i] += sixth * (a1[i] + 2.0 * (a2[i] + a3[i]) + a4[i]);
            prev[i] = a1[i];
        }
    }
}
