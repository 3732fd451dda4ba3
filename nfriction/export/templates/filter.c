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
        for (i = 1; i < NF_FILTER_SIZE; ++i)
            filter->memory[NF_FILTER_SIZE * j + i] = 0;
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
        /* The last position, the last velocity, and two states of each low pass. */
        double *memory = filter->memory + NF_FILTER_SIZE * j;
        const double difference = (q[j] - memory[0]) / {{ filter.sample_time }};
        const REAL given = (REAL)difference;
        memory[0] = q[j];
        /* After a missing sample there is no difference yet: the low passes wait for one. */
        if (nf_finite(&given)) {
            const double velocity = nf_low_pass(difference, memory + 2);
            const double acceleration = nf_low_pass((velocity - memory[1]) / {{ filter.sample_time }}, memory + 4);
            memory[1] = velocity;
            qd[j] = (REAL)velocity;
            qdd[j] = (REAL)acceleration;
        } else {
            nf_fill_nan(qd + j, 1);
            nf_fill_nan(qdd + j, 1);
        }
    }
}
