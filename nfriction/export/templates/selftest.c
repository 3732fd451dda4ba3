/* Runs the controller on the test vectors of its model; returns 0 if all of them agree. */
#include <limits.h>
#include <stdio.h>
#include <string.h>
#include "{{ name }}.h"

#define VECTORS {{ count }}
#define TORQUE_TOLERANCE {{ torque_tolerance }}
#define COEFFICIENT_TOLERANCE {{ coefficient_tolerance }}

{% include "numbers.c" %}
/* A number that is not finite, by kind: 1 NaN, 2 infinity, 3 minus infinity. */
static void broken(REAL *x, int kind)
{
    const REAL one = 1;
    unsigned char bytes[sizeof(REAL)];
    size_t i;
    if (kind == 1) {
        nf_fill_nan(x, 1);
        return;
    }
    /* All bits of the exponent set and none below: 1 has all but the highest of them. */
    memcpy(bytes, &one, sizeof bytes);
    for (i = 0; i < sizeof bytes; ++i) {
        if (bytes[i] == 0x3F)
            bytes[i] = (unsigned char)(kind == 2 ? 0x7F : 0xFF);
    }
    memcpy(x, bytes, sizeof bytes);
}

{{ arrays }}
static void read(REAL *x, const REAL *values, const unsigned char *kinds)
{
    int j;
    for (j = 0; j < NF_JOINTS; ++j) {
        x[j] = values[j];
        if (kinds[j])
            broken(x + j, kinds[j]);
    }
}

/* Whether a number is the expected one, or NaN where that is expected. */
static int agrees(const REAL *got, REAL expected, REAL tolerance, int nan)
{
    REAL difference;
    if (!nf_finite(got) || nan)
        return nan && !nf_finite(got);
    difference = *got > expected ? *got - expected : expected - *got;
    return difference <= tolerance;
}

int main(void)
{
    REAL load[NF_JOINTS], qd[NF_JOINTS], qdd[NF_JOINTS], tau[NF_JOINTS];
    REAL coefficients[NF_JOINTS * NF_COEFFICIENTS];
    int status[NF_JOINTS];
    int row, j, k, wrong = 0;
#if NF_STATE_SIZE
    nf_state state;
#endif
#if NF_FILTER_SIZE
    double q[NF_JOINTS];
    nf_filter filter;
#endif
    for (row = 0; row < VECTORS; ++row) {
        read(load, test_load[row], test_load_kind[row]);
#if NF_FILTER_SIZE
        read(tau, test_q[row], test_q_kind[row]);
        for (j = 0; j < NF_JOINTS; ++j)
            q[j] = (double)tau[j];
        if (row == 0)
            nf_filter_init(&filter, q);
        nf_filter_step(&filter, q, qd, qdd);
#else
        read(qd, test_qd[row], test_qd_kind[row]);
        read(qdd, test_qdd[row], test_qdd_kind[row]);
#endif
#if NF_STATE_SIZE
        if (row == 0) {
#if NF_FILTER_SIZE
            for (j = 0; j < NF_JOINTS; ++j)
                tau[j] = 0;
            nf_init(&state, tau, tau);
#else
            nf_init(&state, qd, qdd);
#endif
        }
        nf_step(&state, qd, qdd, load, tau, coefficients, status);
#else
        nf_step(qd, qdd, load, tau, coefficients, status);
#endif
        for (j = 0; j < NF_JOINTS; ++j) {
            const int nan = (test_status[row][j] & NF_NOT_FINITE) != 0;
            int sound = status[j] == test_status[row][j];
            sound = sound && agrees(tau + j, test_tau[row][j],
                                    TORQUE_TOLERANCE * test_torque_scale[0][j], nan);
            for (k = 0; k < NF_COEFFICIENTS; ++k) {
                const int i = j * NF_COEFFICIENTS + k;
                sound = sound && agrees(coefficients + i, test_coefficients[row][i],
                                        COEFFICIENT_TOLERANCE * test_coefficient_scale[0][k], nan);
            }
            if (!sound) {
                ++wrong;
                printf("vector %d, joint %d: wrong\n", row, j + 1);
            }
        }
    }
    printf("%d vectors, %d wrong\n", VECTORS, wrong);
    return wrong ? 1 : 0;
}
