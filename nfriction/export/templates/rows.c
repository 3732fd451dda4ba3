/* Runs a controller over rows of samples, for comparison with its model. */
#include "{{ name }}.c"

void run_rows(long rows, const double *const *in, double *tau, double *coefficients, int *status);

void run_rows(long rows, const double *const *in, double *tau, double *coefficients, int *status)
{
    nf_real x[3][NF_JOINTS], t[NF_JOINTS], c[NF_JOINTS * NF_COEFFICIENTS];
    long row;
    int j;
#if NF_STATE_SIZE
    nf_state state;
#endif
#if NF_FILTER_SIZE
    nf_filter filter;
    double q[NF_JOINTS];
#endif
    for (row = 0; row < rows; ++row) {
#if NF_FILTER_SIZE
        for (j = 0; j < NF_JOINTS; ++j) {
            q[j] = in[0][row * NF_JOINTS + j];
            x[2][j] = (nf_real)in[1][row * NF_JOINTS + j];
            t[j] = 0;
        }
        if (row == 0)
            nf_filter_init(&filter, q);
        nf_filter_step(&filter, q, x[0], x[1]);
#else
        int i;
        for (i = 0; i < 3; ++i)
            for (j = 0; j < NF_JOINTS; ++j)
                x[i][j] = (nf_real)in[i][row * NF_JOINTS + j];
#endif
#if NF_STATE_SIZE
        if (row == 0)
            nf_init(&state, {{ first }});
        nf_step(&state, x[0], x[1], x[2], t, c, status + row * NF_JOINTS);
#else
        nf_step(x[0], x[1], x[2], t, c, status + row * NF_JOINTS);
#endif
        for (j = 0; j < NF_JOINTS; ++j)
            tau[row * NF_JOINTS + j] = (double)t[j];
        for (j = 0; j < NF_JOINTS * NF_COEFFICIENTS; ++j)
            coefficients[row * NF_JOINTS * NF_COEFFICIENTS + j] = (double)c[j];
    }
}
