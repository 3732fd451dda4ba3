/*
 * {{ safe(about.model) }}: friction of {{ joints }} joint{{ "s" if joints > 1 }}, made by nfriction {{ safe(about.version) }} (schema {{ about.schema }}).
{% if about.fit.get("usability") %}
 * Rating of the fit: {{ safe(about.fit.usability | select | join(": ")) }}.
{% endif %}
 *
 * Inputs: qd [{{ safe(about.units.qd) }}], qdd [{{ safe(about.units.qdd) }}], load [{{ safe(about.units.load) }}].
 * Outputs: tau [{{ safe(about.units.tau_f) }}], on the left side of M(q) qdd + bias(q, qd) + tau = drive; coefficients:
{% for coefficient in about.coefficients %}
 *     {{ safe(coefficient.name) }} [{{ safe(coefficient.unit) }}]
{% endfor %}
{% if drive_torques | select | list %}
 * Not in tau: constant torques of the drives in the fitted plant, to be subtracted from a command:
 *    {% for x in drive_torques %} {{ "%.3g" % x }}{% endfor %} [{{ safe(about.units.tau_f) }}]
{% endif %}
{% if gear_losses | select | list %}
 * Not in tau: shares of the transmitted torque that the gears lose in the fitted plant, which oppose qd:
 *    {% for x in gear_losses %} {{ "%.3g" % x }}{% endfor %} [-]
{% endif %}
 * Sample time: {{ "any" if about.sample_time is none else "%.9g s" % about.sample_time }}.
 * Joints, in order:
{% for name in about.joint_names or range(1, joints + 1) %}
 *     {{ safe(name) if about.joint_names else "joint %d" % name }}
{% endfor %}
 * Trained ranges:{{ " unknown, so OUTSIDE is never set" if not about.input_ranges }}
{% for name, edges in about.input_ranges | dictsort %}
 *     {{ safe(name) }}: {{ safe(edges) }}
{% endfor %}
 * Outside them (OUTSIDE): {{ safe(about.edges.outside_input_ranges) }}.
 * NaN or infinity gives NaN for that joint (NOT_FINITE), also under -ffast-math.
 * SATURATED: the torque limit.
 * Torque limit: {{ "none" if about.torque_limit is none else safe(about.torque_limit) }}.
 * Filter: {% if about.filter %}second-order low-pass, cut-off {{ "%.6g Hz, damping %.6g, sample time %.9g s" %
    (about.filter.cutoff_hz, about.filter.damping, about.filter.sample_time) }}{% else %}none{% endif %}.
 * Parameters: {{ safe(about.parameter_hash) }}.
{% for name, value in about.training_data | dictsort %}
 * Training data: {{ safe(name) }}: {{ safe(value) }}
{% endfor %}
 */

#ifndef NF_H
#define NF_H

#define NF_JOINTS {{ joints }}
#define NF_COEFFICIENTS {{ coefficients }}
#define NF_STATE_SIZE {{ state_size }}
#define NF_FILTER_SIZE {{ filter_size }}
#define NF_HAS_LOAD {{ 1 if load else 0 }}
#define NF_OUTSIDE {{ bits.outside }}
#define NF_NOT_FINITE {{ bits.not_finite }}
#define NF_SATURATED {{ bits.saturated }}

#ifdef __cplusplus
extern "C" {
#endif

typedef REAL nf_real;

{% if state_size %}
/* State of the coefficients from earlier samples{{ ", in double, as float would lose its small steps" if memory != real }}. */
typedef {{ memory }} nf_memory;
typedef struct {
    nf_memory memory[NF_JOINTS * NF_STATE_SIZE];
} nf_state;

/* Memory before the first sample, whose motion is given. */
void nf_init(nf_state *state, const nf_real qd[NF_JOINTS], const nf_real qdd[NF_JOINTS]);

{% endif %}
{% if load %}
{% if about.unit == "m" %}
/* Load of each axis, which this law reads, at its position [m] and velocity [m/s]. */
{% else %}
/* Load of each joint, which this law reads, at joint positions and velocities: the first angle from
 * upright, each further one relative to the previous link [{{ safe(about.unit) }}]. */
{% endif %}
void nf_load(
    const nf_real q[NF_JOINTS], const nf_real qd[NF_JOINTS], nf_real load[NF_JOINTS]);

{% endif %}
/* Friction torque, coefficients (joint by joint) and status bits of every joint.
 * No array may be NULL, and no output may overlap an input. */
void nf_step(
{% if state_size %}
    nf_state *state,
{% endif %}
    const nf_real qd[NF_JOINTS], const nf_real qdd[NF_JOINTS], const nf_real load[NF_JOINTS],
    nf_real tau[NF_JOINTS], nf_real coefficients[NF_JOINTS * NF_COEFFICIENTS],
    int status[NF_JOINTS]);

{% if filter_size %}
/* Two causal low-pass filters in series, each of 2 states, and the last position and velocity.
 * Positions are double, because their differences in float would lose precision. They must be
 * continuous: unwrap a single-turn encoder first, as a jump after a turn is taken for motion. */
typedef struct {
    double memory[NF_JOINTS * NF_FILTER_SIZE];
} nf_filter;

/* Filter after rest at positions q; init and reset are the same. */
void nf_filter_init(nf_filter *filter, const double q[NF_JOINTS]);
void nf_filter_reset(nf_filter *filter, const double q[NF_JOINTS]);

/* Velocity and acceleration after one more sample; call once per sample time. A position that is
 * not finite gives NaN, and so does the next one, because a velocity needs two in a row. */
void nf_filter_step(
    nf_filter *filter, const double q[NF_JOINTS], nf_real qd[NF_JOINTS], nf_real qdd[NF_JOINTS]);

{% endif %}
#ifdef __cplusplus
}
#endif

#endif
