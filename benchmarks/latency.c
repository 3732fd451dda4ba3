/* Times single calls of an exported controller; compiled together with it by `latency.py`. */
#define _POSIX_C_SOURCE 199309L
#include <time.h>

#include "nf.h"

#if NF_STATE_SIZE
static nf_state state;
#define STEP(...) nf_step(&state, __VA_ARGS__)
#else
#define STEP(...) nf_step(__VA_ARGS__)
#endif

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}

/* Nanoseconds a call of `calls` calls in a row, by two readings of the clock. */
double batch(long calls, long rows, const nf_real *qd, const nf_real *qdd, const nf_real *load,
             double *total)
{
    nf_real tau[NF_JOINTS], coefficients[NF_JOINTS * NF_COEFFICIENTS];
    const double begin = now();
    int status[NF_JOINTS];
    long call;
    for (call = 0; call < calls; ++call) {
        const long at = call % rows * NF_JOINTS;
        STEP(qd + at, qdd + at, load + at, tau, coefficients, status);
        *total += (double)tau[0];
    }
    return (now() - begin) / (double)calls;
}

/* Nanoseconds of each of `calls` calls, over `rows` samples in turn; the clock is in them. */
double latency(long calls, long rows, const nf_real *qd, const nf_real *qdd, const nf_real *load,
               double *ns)
{
    nf_real tau[NF_JOINTS], coefficients[NF_JOINTS * NF_COEFFICIENTS];
    double total = 0.0, begin;
    int status[NF_JOINTS];
    long call;
    for (call = 0; call < calls; ++call) {
        const long at = call % rows * NF_JOINTS;
        begin = now();
        STEP(qd + at, qdd + at, load + at, tau, coefficients, status);
        ns[call] = now() - begin;
        total += (double)tau[0];
    }
    return total;
}

/* The clock alone. */
void clock_alone(long calls, double *ns)
{
    long call;
    for (call = 0; call < calls; ++call) {
        const double begin = now();
        ns[call] = now() - begin;
    }
}
