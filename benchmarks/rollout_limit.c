/* The limit that compiled rollouts are measured against: the triple pendulum of
   tests/codegen/mechanisms.py written by hand, with constant and with neuro-fuzzy coefficients held
   over the step. What depends on parameters alone is computed once. */
#include <math.h>
#include <string.h>

#define N 3
#define TERMS 5
#define RULES 25
#define UNITS 10

struct plant {
    double moment[N], inertia[N][N], gravity;
};

struct fuzzy { /* as the torch module stores them */
    double centre[N][2][TERMS], log_width[N][2][TERMS], rule[N][RULES][2][3];
    double unit_centre[N][UNITS][4], unit_log_width[N][UNITS], unit_out[N][UNITS][2], scale[2];
};

struct prepared {
    double slope[N][2][TERMS], sharpness[N][UNITS];
};

static void acceleration(const struct plant *p, const double *gb, const double c[N][2],
    const double *q, const double *qd, double *qdd)
{
    const double a0 = q[0], a1 = a0 + q[1], a2 = a1 + q[2];
    const double r0 = qd[0], r1 = r0 + qd[1], r2 = r1 + qd[2];
    const double rr0 = r0 * r0, rr1 = r1 * r1, rr2 = r2 * r2;
    const double m00 = p->inertia[0][0], m11 = p->inertia[1][1], m22 = p->inertia[2][2];
    const double m01 = p->inertia[0][1] * cos(a0 - a1), t01 = p->inertia[0][1] * sin(a0 - a1);
    const double m02 = p->inertia[0][2] * cos(a0 - a2), t02 = p->inertia[0][2] * sin(a0 - a2);
    const double m12 = p->inertia[1][2] * cos(a1 - a2), t12 = p->inertia[1][2] * sin(a1 - a2);
    const double f0 = c[0][0] * qd[0] + c[0][1] * fabs(0.01 * rr0 - cos(a0)) * tanh(qd[0] * 20.0);
    const double f1 = c[1][0] * qd[1] + c[1][1] * fabs(0.01 * rr1 - cos(a1)) * tanh(qd[1] * 20.0);
    const double f2 = c[2][0] * qd[2] + c[2][1] * fabs(0.01 * rr2 - cos(a2)) * tanh(qd[2] * 20.0);
    double b0 = f1 - f0 + gb[0] * sin(a0) - t01 * rr1 - t02 * rr2;
    double b1 = f2 - f1 + gb[1] * sin(a1) + t01 * rr0 - t12 * rr2;
    double b2 = -f2 + gb[2] * sin(a2) + t02 * rr0 + t12 * rr1;
    const double i0 = 1.0 / m00, l1 = m01 * i0, l2 = m02 * i0;
    const double d11 = m11 - l1 * m01, d12 = m12 - l1 * m02, d22 = m22 - l2 * m02;
    double i1, l3, x0, x1, x2;
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

static void prepare(const struct fuzzy *f, struct prepared *w)
{
    int j, k;
    for (j = 0; j < N; ++j) {
        for (k = 0; k < 2 * TERMS; ++k)
            (&w->slope[j][0][0])[k] = exp(-(&f->log_width[j][0][0])[k]);
        for (k = 0; k < UNITS; ++k) w->sharpness[j][k] = exp(f->unit_log_width[j][k]);
    }
}

static void coefficients(const struct fuzzy *f, const struct prepared *w, const double *qd,
    const double *qdd, double c[N][2])
{
    int j, k, a, b, r, u;
    for (j = 0; j < N; ++j) {
        const double x[2] = {fabs(qd[j]) * f->scale[0], qdd[j] * f->scale[1]};
        double l[2][TERMS], e[RULES], top = -HUGE_VAL, sum = 0.0, y[2] = {0.0, 0.0}, o[2];
        for (k = 0; k < 2; ++k)
            for (a = 0; a < TERMS; ++a) {
                const double z = (x[k] - f->centre[j][k][a]) * w->slope[j][k][a];
                l[k][a] = -0.5 * z * z;
            }
        for (a = 0; a < TERMS; ++a)
            for (b = 0; b < TERMS; ++b) {
                e[TERMS * a + b] = l[0][a] + l[1][b];
                if (e[TERMS * a + b] > top) top = e[TERMS * a + b];
            }
        for (r = 0; r < RULES; ++r) e[r] = exp(e[r] - top);
        for (r = 0; r < RULES; ++r) {
            sum += e[r];
            for (k = 0; k < 2; ++k)
                y[k] += e[r] * (f->rule[j][r][k][0] + f->rule[j][r][k][1] * x[0]
                    + f->rule[j][r][k][2] * x[1]);
        }
        y[0] /= sum;
        y[1] /= sum;
        o[0] = y[0];
        o[1] = y[1];
        for (u = 0; u < UNITS; ++u) {
            const double *m = f->unit_centre[j][u];
            const double d0 = x[0] - m[0], d1 = x[1] - m[1], d2 = y[0] - m[2], d3 = y[1] - m[3];
            const double g = exp(-(d0 * d0 + d1 * d1 + d2 * d2 + d3 * d3) * w->sharpness[j][u]);
            o[0] += g * f->unit_out[j][u][0];
            o[1] += g * f->unit_out[j][u][1];
        }
        for (k = 0; k < 2; ++k) c[j][k] = 0.01 * (o[k] > 20.0 ? o[k] : log1p(exp(o[k])));
    }
}

/* `fuzzy` may be null: then `log_constant` gives the coefficients. */
void limit_rollout(long steps, double dt, const struct plant *p, const double *log_constant,
    const struct fuzzy *fuzzy, const double *q0, const double *qd0, double *q_out, double *qd_out)
{
    const double half = 0.5 * dt, sixth = dt / 6.0, none[N][2] = {{0.0}};
    double q[N], qd[N], prev[N], x[N], a1[N], a2[N], a3[N], a4[N], v2[N], v3[N], v4[N];
    double c[N][2], gb[N];
    struct prepared w;
    long k;
    int i;
    memcpy(q, q0, sizeof q);
    memcpy(qd, qd0, sizeof qd);
    for (i = 0; i < N; ++i) gb[i] = p->gravity * p->moment[i];
    if (fuzzy) {
        prepare(fuzzy, &w);
        acceleration(p, gb, none, q, qd, prev);
    } else
        for (i = 0; i < 2 * N; ++i) (&c[0][0])[i] = exp(log_constant[i]);
    memcpy(q_out, q, sizeof q);
    memcpy(qd_out, qd, sizeof qd);
    for (k = 1; k <= steps; ++k) {
        if (fuzzy) coefficients(fuzzy, &w, qd, prev, c);
        acceleration(p, gb, (const double (*)[2])c, q, qd, a1);
        for (i = 0; i < N; ++i) x[i] = q[i] + half * qd[i], v2[i] = qd[i] + half * a1[i];
        acceleration(p, gb, (const double (*)[2])c, x, v2, a2);
        for (i = 0; i < N; ++i) x[i] = q[i] + half * v2[i], v3[i] = qd[i] + half * a2[i];
        acceleration(p, gb, (const double (*)[2])c, x, v3, a3);
        for (i = 0; i < N; ++i) x[i] = q[i] + dt * v3[i], v4[i] = qd[i] + dt * a3[i];
        acceleration(p, gb, (const double (*)[2])c, x, v4, a4);
        for (i = 0; i < N; ++i) {
            q[i] += sixth * (qd[i] + 2.0 * (v2[i] + v3[i]) + v4[i]);
            qd[i] += sixth * (a1[i] + 2.0 * (a2[i] + a3[i]) + a4[i]);
            prev[i] = a1[i];
        }
        memcpy(q_out + k * N, q, sizeof q);
        memcpy(qd_out + k * N, qd, sizeof qd);
    }
}
