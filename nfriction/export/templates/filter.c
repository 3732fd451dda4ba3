/* The causal filter, always in double, because float is too coarse for differences of positions. */
static double nf_low_pass(double x, double s[2])
{
    const double y = {{ filter.b0 }} * x + s[0];
    s[0] = {{ filter.b1 }} * x - {{ filter.a1 }} * y + s[1];
    s[1] = {{ filter.b2 }} * x - {{ filter.a2 }} * y;
    return y;
}

void nf_filter_init(nf_filter *filter, const double q[NF_JOINTS])
{
    int j, i;
    for (j = 0; j < NF_JOINTS; ++j) {
        const REAL given = (REAL)q[j];
        for (i = 0; i < NF_FILTER_SIZE; ++i)
            filter->memory[NF_FILTER_SIZE * j + i] = 0;
        if (nf_finite(&given))
            filter->memory[NF_FILTER_SIZE * j] = q[j];
    }
}

void nf_filter_reset(nf_filter *filter, const double q[NF_JOINTS])
{
    nf_filter_init(filter, q);
}

void nf_filter_step(
    nf_filter *filter, const double q[NF_JOINTS], nf_real qd[NF_JOINTS], nf_real qdd[NF_JOINTS])
{
    int j;
    for (j = 0; j < NF_JOINTS; ++j) {
        const REAL given = (REAL)q[j];
        /* The last position, the last velocity, and two states of each low pass. */
        double *memory = filter->memory + NF_FILTER_SIZE * j;
        if (nf_finite(&given)) {
            const double velocity = nf_low_pass((q[j] - memory[0]) / {{ filter.sample_time }}, memory + 2);
            const double acceleration = nf_low_pass((velocity - memory[1]) / {{ filter.sample_time }}, memory + 4);
            memory[0] = q[j];
            memory[1] = velocity;
            qd[j] = (REAL)velocity;
            qdd[j] = (REAL)acceleration;
        } else {
            nf_fill_nan(qd + j, 1);
            nf_fill_nan(qdd + j, 1);
        }
    }
}
