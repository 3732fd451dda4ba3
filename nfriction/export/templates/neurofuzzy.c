{% set per_reach = "" if per_reach in ("1.0", "1.0f") else per_reach ~ " * " %}
/*
 * Coefficients by a neuro-fuzzy network of each joint: Gaussian sets of |qd| and of qdd, a rule for
 * every pair of them, and a head of radial units that adds a correction. The joint is the last
 * index everywhere: joints are computed in parallel. Half the scale of the coefficients is included
 * in the tables.
 */
#define NF_SETS {{ sets }}
#define NF_UNITS {{ units }}
#define NF_SEEN (2 + NF_COEFFICIENTS)
#define NF_PLANES (3 * NF_COEFFICIENTS)

/* Inputs GAIN x + SHIFT are in [-1, 1] within the trained range. */
{{ table("gain", 2, "JOINTS") }}
{{ table("shift", 2, "JOINTS") }}
{% if along_motion %}
/* The acceleration is taken along the motion: qdd tanh(RATE qd). */
{{ table("rate", "JOINTS") }}
{% endif %}
/* The membership in set s of input i is exp(-(SET_SLOPE[s][i] x + SET_SHIFT[s][i])^2). */
{{ table("set_slope", "SETS", 2, "JOINTS") }}
{{ table("set_shift", "SETS", 2, "JOINTS") }}
/* The rule of sets s of |qd| and t of qdd gives PLANE[t][s]: for every coefficient its slope in |qd|,
 * then the slopes in qdd, then the constants. */
{{ table("plane", "SETS", "SETS", "PLANES", "JOINTS") }}
/* A unit takes both inputs and the coefficients from the rules, and adds
 * UNIT_WEIGHT exp(-sum of (UNIT_SLOPE seen + UNIT_SHIFT)^2). */
{{ table("unit_slope", "SEEN", "UNITS", "JOINTS") }}
{{ table("unit_shift", "SEEN", "UNITS", "JOINTS") }}
{{ table("unit_weight", "COEFFICIENTS", "UNITS", "JOINTS") }}
/* The constant coefficients from which the network deviates. */
{{ table("reference", "COEFFICIENTS", "JOINTS") }}
/* A positive coefficient is u + sqrt(u^2 + ROUNDNESS), which is near 2 u or near 0; others are 2 u. */
{{ table("roundness", "COEFFICIENTS", "JOINTS") }}

static void nf_network(
    const REAL qd[NF_JOINTS], const REAL qdd[NF_JOINTS],
{% if along_motion %}
    const REAL sign[NF_JOINTS],
{% endif %}
    REAL c[NF_COEFFICIENTS][NF_JOINTS])
{
    REAL seen[NF_SEEN][NF_JOINTS], trust[NF_JOINTS];
    REAL membership[NF_SETS{{ " + 1" if spare(2 * sets * joints) }}][2][NF_JOINTS]{{ " = {{{0}}}" if spare(2 * sets * joints) }};
    REAL plane[NF_PLANES][NF_JOINTS];
    REAL unit[NF_UNITS{{ " + 3" if spare(units * joints) }}][NF_JOINTS]{{ " = {{0}}" if spare(units * joints) }};
    int s, i, k, j;

    /* 1. Scaled inputs within the trained range; trust falls from 1 there to 0 far outside. */
    for (j = 0; j < NF_JOINTS; ++j) {
        const REAL speed = NF_GAIN[0][j] * real_abs(qd[j]) + NF_SHIFT[0][j];
        const REAL acceleration = NF_GAIN[1][j] * ({{ "sign[j] * qdd[j]" if along_motion else "qdd[j]" }}) + NF_SHIFT[1][j];
        seen[0][j] = nf_min(nf_max(speed, -1), 1);
        seen[1][j] = nf_min(nf_max(acceleration, -1), 1);
        trust[j] = nf_square({{ per_reach }}(speed - seen[0][j]))
            + nf_square({{ per_reach }}(acceleration - seen[1][j]));
        trust[j] = nf_square(nf_max(1 - trust[j], 0));
    }

    /* 2. Memberships in the sets. */
    for (s = 0; s < NF_SETS; ++s)
        for (i = 0; i < 2; ++i)
            for (j = 0; j < NF_JOINTS; ++j)
                membership[s][i][j] =
                    -nf_square(NF_SET_SLOPE[s][i][j] * seen[i][j] + NF_SET_SHIFT[s][i][j]);
{% if deep %}
    /* Far from all sets: relative to the nearest, so that not all of them underflow. */
    for (i = 0; i < 2; ++i)
        for (j = 0; j < NF_JOINTS; ++j) {
            REAL nearest = membership[0][i][j];
            for (s = 1; s < NF_SETS; ++s)
                nearest = nf_max(nearest, membership[s][i][j]);
            for (s = 0; s < NF_SETS; ++s)
                membership[s][i][j] -= nearest;
        }
{% endif %}
    nf_exp(&membership[0][0][0], NF_SETS * 2 * NF_JOINTS{{ spare(2 * sets * joints) }}, 0);

    /* 3. Rules fire with the product of their memberships, by which their planes are weighted. */
    for (i = 0; i < NF_PLANES; ++i)
        for (j = 0; j < NF_JOINTS; ++j) {
            REAL blend = 0;
            for (s = 0; s < NF_SETS; ++s)
                blend += membership[s][0][j] * (
                    {{ sum("NF_PLANE[@][s][i][j] * membership[@][1][j]", sets, 20) }});
            plane[i][j] = blend;
        }

    /* 4. Coefficients from the rules, whose firing strengths are divided by their sum. */
    for (j = 0; j < NF_JOINTS; ++j) {
        const REAL by_qd = {{ sum("membership[@][0][j]", sets, 12) }};
        const REAL by_qdd = {{ sum("membership[@][1][j]", sets, 12) }};
        const REAL share = 1 / (by_qd * by_qdd);
        for (k = 0; k < NF_COEFFICIENTS; ++k)
            seen[2 + k][j] = share * (plane[k][j] * seen[0][j]
                + plane[NF_COEFFICIENTS + k][j] * seen[1][j] + plane[2 * NF_COEFFICIENTS + k][j]);
    }

    /* 5. The radial units; rules and units correct the reference. */
    for (s = 0; s < NF_UNITS; ++s)
        for (j = 0; j < NF_JOINTS; ++j)
            unit[s][j] = nf_max({{ least_exponent }}, -(
                {{ sum("nf_square(NF_UNIT_SLOPE[@][s][j] * seen[@][j] + NF_UNIT_SHIFT[@][s][j])", seen, 16) }}));
    nf_exp(&unit[0][0], NF_UNITS * NF_JOINTS{{ spare(units * joints) }}, 0);
    for (k = 0; k < NF_COEFFICIENTS; ++k)
        for (j = 0; j < NF_JOINTS; ++j) {
            REAL u = seen[2 + k][j];
            for (s = 0; s < NF_UNITS; ++s)
                u += NF_UNIT_WEIGHT[k][s][j] * unit[s][j];
            c[k][j] = NF_REFERENCE[k][j] + trust[j] * u;
        }

    /* 6. Coefficients, positive where physics requires it. */
{% for first, last, positive in signs_of_coefficients %}
    for (k = {{ first }}; k < {{ last }}; ++k)
        for (j = 0; j < NF_JOINTS; ++j) {
            c[k][j] += {{ "real_sqrt(nf_square(c[k][j]) + NF_ROUNDNESS[k][j])" if positive else "c[k][j]" }};
        }
{% endfor %}
}
