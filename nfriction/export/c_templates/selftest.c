/* Runs the controller over the test vectors of its model; returns 0 where all of them agree. */
#include <limits.h>
#include <stdio.h>
#include <string.h>
#include "$HEADER"

#define VECTORS $COUNT
#define TORQUE_TOLERANCE $TORQUE_TOLERANCE
#define COEFFICIENT_TOLERANCE $COEFFICIENT_TOLERANCE

$BITS
/* What stands for a number that is not finite: 1 NaN, 2 infinity, 3 minus infinity. */
static void broken($REAL *x, int kind)
{
    const $REAL one = 1;
    unsigned char bytes[sizeof($REAL)];
    size_t i;
    if (kind == 1) {
        test_fill_nan(x, 1);
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

$ARRAYS
static void read($REAL *x, const $REAL *values, const unsigned char *kinds)
{
    int j;
    for (j = 0; j < $PREFIX_JOINTS; ++j) {
        x[j] = values[j];
        if (kinds[j])
            broken(x + j, kinds[j]);
    }
}

/* Whether a number is the expected one, or NaN where that is expected. */
static int agrees(const $REAL *got, $REAL expected, $REAL tolerance, int nan)
{
    $REAL difference;
    if (!test_finite(got) || nan)
        return nan && !test_finite(got);
    difference = *got > expected ? *got - expected : expected - *got;
    return difference <= tolerance;
}

int main(void)
{
    $REAL load[$PREFIX_JOINTS], qd[$PREFIX_JOINTS], qdd[$PREFIX_JOINTS], tau[$PREFIX_JOINTS];
    $REAL coefficients[$PREFIX_JOINTS * $PREFIX_COEFFICIENTS];
    int status[$PREFIX_JOINTS];
    int row, j, k, wrong = 0;
#if $PREFIX_STATE_SIZE
    $prefix_state state;
#endif
#if $PREFIX_FILTER_SIZE
    double q[$PREFIX_JOINTS];
    $prefix_filter filter;
#endif
    for (row = 0; row < VECTORS; ++row) {
        read(load, test_load[row], test_load_kind[row]);
#if $PREFIX_FILTER_SIZE
        read(tau, test_q[row], test_q_kind[row]);
        for (j = 0; j < $PREFIX_JOINTS; ++j)
            q[j] = (double)tau[j];
        if (row == 0)
            $prefix_filter_init(&filter, q);
        $prefix_filter_step(&filter, q, qd, qdd);
#else
        read(qd, test_qd[row], test_qd_kind[row]);
        read(qdd, test_qdd[row], test_qdd_kind[row]);
#endif
#if $PREFIX_STATE_SIZE
        if (row == 0) {
#if $PREFIX_FILTER_SIZE
            for (j = 0; j < $PREFIX_JOINTS; ++j)
                tau[j] = 0;
            $prefix_init(&state, tau, tau);
#else
            $prefix_init(&state, qd, qdd);
#endif
        }
        $prefix_step(&state, qd, qdd, load, tau, coefficients, status);
#else
        $prefix_step(qd, qdd, load, tau, coefficients, status);
#endif
        for (j = 0; j < $PREFIX_JOINTS; ++j) {
            const int nan = (test_status[row][j] & $PREFIX_NOT_FINITE) != 0;
            int sound = status[j] == test_status[row][j];
            sound = sound && agrees(tau + j, test_tau[row][j],
                                    TORQUE_TOLERANCE * test_torque_scale[j], nan);
            for (k = 0; k < $PREFIX_COEFFICIENTS; ++k) {
                const int i = j * $PREFIX_COEFFICIENTS + k;
                sound = sound && agrees(coefficients + i, test_coefficients[row][i],
                                        COEFFICIENT_TOLERANCE * test_coefficient_scale[k], nan);
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
