{% include "numbers.c" %}

{% if network %}
{{ exponential }}
{% endif %}
{% if form == "traced" %}
/* The coefficients, written out for all joints. */
{{ schedule }}
{% elif form == "constant" %}
/* The coefficients, which do not depend on the motion. */
{{ table("constant", "COEFFICIENTS", "JOINTS") }}
{% else %}
{% include form ~ ".c" %}
{% endif %}
{% if bounded %}

/* The trained range: lowest and highest velocity, lowest and highest acceleration. */
{{ table("range", 4, "JOINTS") }}
{% endif %}
{% if limited %}

/* Limit of the output torque. */
{{ table("torque_limit", "JOINTS") }}
{% endif %}

{% if state_size %}
void nf_init(nf_state *state, const nf_real qd[NF_JOINTS], const nf_real qdd[NF_JOINTS])
{
    REAL v[NF_JOINTS], a[NF_JOINTS];
    int j;
    for (j = 0; j < NF_JOINTS; ++j) {
        const int moves = nf_finite(&qd[j]) && nf_finite(&qdd[j]);
        v[j] = moves ? {{ "nf_clamp(qd[j], NF_RANGE[0][j], NF_RANGE[1][j])" if clamped else "qd[j]" }} : 0;
        a[j] = moves ? {{ "nf_clamp(qdd[j], NF_RANGE[2][j], NF_RANGE[3][j])" if clamped else "qdd[j]" }} : 0;
    }
{% if form == "traced" %}
    nf_schedule_start(v, a, state->memory);
{% else %}
    for (j = 0; j < NF_JOINTS; ++j)
        nf_class_start(v[j], a[j], state->memory + NF_STATE_SIZE * j, j);
{% endif %}
}

{% endif %}
{% if load %}
void nf_load(
    const nf_real q[NF_JOINTS], const nf_real qd[NF_JOINTS], nf_real load[NF_JOINTS])
{{ load_of }}

{% endif %}
void nf_step(
{% if state_size %}
    nf_state *state,
{% endif %}
    const nf_real qd[NF_JOINTS], const nf_real qdd[NF_JOINTS], const nf_real load[NF_JOINTS],
    nf_real tau[NF_JOINTS], nf_real coefficients[NF_JOINTS * NF_COEFFICIENTS],
    int status[NF_JOINTS])
{
    REAL v[NF_JOINTS], a[NF_JOINTS], n[NF_JOINTS], torque[NF_JOINTS];
{% if form != "constant" %}
    REAL c[NF_COEFFICIENTS][NF_JOINTS];
{% endif %}
{% if signs %}
    REAL sign[{{ signs | length }}][NF_JOINTS];
{% endif %}
{% if by_class %}
    int known[NF_JOINTS];
{% endif %}
{% if form == "traced" and state_size %}
    nf_memory next[NF_JOINTS * NF_STATE_SIZE];
{% endif %}
{% if form == "traced" and clamped %}
    REAL within[2][NF_JOINTS];
{% endif %}
    int sound[NF_JOINTS], j, k;
{% if form in ("constant", "traced") %}
    (void)v, (void)a;
{% endif %}
    (void)n;

    /* A joint with inputs that are not finite is computed at rest, and gets NaN at the end. */
    for (j = 0; j < NF_JOINTS; ++j) {
        const int moves = nf_finite(&qd[j]) && nf_finite(&qdd[j]);
        sound[j] = moves && nf_finite(&load[j]);
        v[j] = moves ? qd[j] : 0;
        a[j] = moves ? qdd[j] : 0;
        n[j] = sound[j] ? load[j] : 0;
{% if by_class %}
        /* Without motion the memory is unchanged. */
        if (moves)
            nf_class_advance(a[j], state->memory + NF_STATE_SIZE * j, j);
        known[j] = (int)state->memory[NF_STATE_SIZE * j + 1];
{% endif %}
    }
{% if signs %}

    /* Smooth signs of the velocity. */
    for (j = 0; j < NF_JOINTS; ++j) {
{% for argument in signs %}
        sign[{{ loop.index0 }}][j] = {{ argument if array_tanh else "real_tanh(" ~ argument ~ ")" }};
{% endfor %}
    }
{% if array_tanh %}
    nf_tanh(&sign[0][0]);
{% endif %}
{% endif %}

{% if form != "constant" %}
    /* Coefficients. */
{% if form == "traced" %}
{% if clamped %}
    for (j = 0; j < NF_JOINTS; ++j) {
        within[0][j] = nf_clamp(qd[j], NF_RANGE[0][j], NF_RANGE[1][j]);
        within[1][j] = nf_clamp(qdd[j], NF_RANGE[2][j], NF_RANGE[3][j]);
    }
{% endif %}
    nf_schedule({{ "within[0], within[1]" if clamped else "qd, qdd" }}, {{ "n, state->memory, next, " if state_size }}c);
{% if state_size %}
    for (j = 0; j < NF_JOINTS; ++j)
        if ({{ "sound[j]" if loaded else "nf_finite(&qd[j]) && nf_finite(&qdd[j])" }})
            for (k = 0; k < NF_STATE_SIZE; ++k)
                state->memory[NF_STATE_SIZE * j + k] = next[NF_STATE_SIZE * j + k];
{% endif %}
{% elif network %}
    nf_network(v, a, {{ "sign[0], " if along_motion }}c);
{% else %}
    for (k = 0; k < NF_COEFFICIENTS; ++k)
        for (j = 0; j < NF_JOINTS; ++j)
            c[k][j] = NF_BY_CLASS[known[j]][k][j];
{% endif %}

{% endif %}

    /* Torque from the law, {{ law_comment }}. */
{{ law }}

    for (j = 0; j < NF_JOINTS; ++j) {
{% if bounded %}
        const int outside = v[j] < NF_RANGE[0][j] || v[j] > NF_RANGE[1][j]
            || a[j] < NF_RANGE[2][j] || a[j] > NF_RANGE[3][j];
        status[j] = outside ? NF_OUTSIDE : 0;
{% else %}
        status[j] = 0;
{% endif %}
{% if limited %}
        if (torque[j] > NF_TORQUE_LIMIT[j] || torque[j] < -NF_TORQUE_LIMIT[j]) {
            torque[j] = torque[j] > 0 ? NF_TORQUE_LIMIT[j] : -NF_TORQUE_LIMIT[j];
            status[j] += NF_SATURATED;
        }
{% endif %}
        if (sound[j] && nf_finite(&torque[j])) {
            tau[j] = torque[j];
            for (k = 0; k < NF_COEFFICIENTS; ++k)
                coefficients[NF_COEFFICIENTS * j + k] = {{ c }}[k][j];
        } else {
            status[j] = NF_NOT_FINITE;
            nf_fill_nan(tau + j, 1);
            nf_fill_nan(coefficients + NF_COEFFICIENTS * j, NF_COEFFICIENTS);
        }
    }
}
{% if filter_size %}

{% include "filter.c" %}
{% endif %}
