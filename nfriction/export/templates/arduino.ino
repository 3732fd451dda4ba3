// {{ title }} on an Arduino. Put this file, {{ name }}.c and {{ name }}.h into one folder called
// {{ name }}; write `read_position`{% if loaded %}, `read_torque`{% endif %} and `write_torque` for your board.
extern "C" {
#include "{{ name }}.h"
}
#include <Arduino.h>

// Time between calls [us].
static const unsigned long PERIOD = {{ period }};

#if NF_STATE_SIZE
static nf_state state;
#endif
#if NF_FILTER_SIZE
static nf_filter filter;
#endif
static unsigned long next_call;
// Positions of the last call.
static double q[NF_JOINTS];

// Share of the friction that is compensated: 1 drives the joint if the model is slightly too high.
static const nf_real GAIN = (nf_real)0.8;
// Velocity below which the torque fades out, against chatter near standstill [{{ unit }}/s].
static const nf_real DEAD_BAND = (nf_real)0.05;

{% if unit == "m" %}
// Position [m] of an axis; here from an analogue pin. It must be continuous.
{% else %}
// Position [{{ unit }}] of a joint, the first from upright, others relative; here from an analogue pin over one turn.
// It must be continuous: add up the turns of an encoder that wraps, or each jump gives a torque pulse.
{% endif %}
static double read_position(int joint)
{
    return analogRead(A0 + joint) * (6.283185307179586 / 1023.0);
}

// Output the torque that compensates friction [{{ torque_unit }}]; 0 where it is not reliable.
static void write_torque(int joint, nf_real tau, nf_real qd, int status)
{
    const nf_real speed = qd < 0 ? -qd : qd;
    if (status & NF_NOT_FINITE)
        tau = 0;
    tau *= GAIN * (speed < DEAD_BAND ? speed / DEAD_BAND : 1);
    analogWrite(9 + joint, (int)constrain(128 + 100 * tau, 0, 255));
}

{% if loaded %}
// Torque that the drive of a joint transmits [{{ torque_unit }}], on which this friction depends: command or current.
static nf_real read_torque(int joint)
{
    return (nf_real)((analogRead(A0 + NF_JOINTS + joint) - 512) * 0.01);
}

{% endif %}
static void read_positions()
{
    int j;
    for (j = 0; j < NF_JOINTS; ++j)
        q[j] = read_position(j);
}

void setup()
{
    read_positions();
#if NF_FILTER_SIZE
    nf_filter_init(&filter, q);
#endif
#if NF_STATE_SIZE
    nf_real rest[NF_JOINTS] = {0};
    nf_init(&state, rest, rest);
#endif
    next_call = micros();
}

void loop()
{
    static nf_real qd[NF_JOINTS], qdd[NF_JOINTS];
    nf_real load[NF_JOINTS], tau[NF_JOINTS];
    nf_real coefficients[NF_JOINTS * NF_COEFFICIENTS];
    int status[NF_JOINTS];
    int j;
    // Unsigned differences stay correct when the clock wraps.
    if ((long)(micros() - next_call) < 0)
        return;
    next_call += PERIOD;
#if NF_FILTER_SIZE
    read_positions();
    nf_filter_step(&filter, q, qd, qdd);
#else
    // For anything better than plain differences, export with the filter (--with-filter).
    for (j = 0; j < NF_JOINTS; ++j) {
        const double position = read_position(j);
        const nf_real velocity = (nf_real)((position - q[j]) * (1e6 / PERIOD));
        qdd[j] = (velocity - qd[j]) * (nf_real)(1e6 / PERIOD);
        qd[j] = velocity;
        q[j] = position;
    }
#endif
#if NF_HAS_LOAD
    nf_real at[NF_JOINTS];
    for (j = 0; j < NF_JOINTS; ++j)
        at[j] = (nf_real)q[j];
    nf_load(at, qd, load);
#else
    for (j = 0; j < NF_JOINTS; ++j)
{% if loaded %}
        load[j] = read_torque(j);
{% else %}
        load[j] = 1;  // this law does not read it, or the model file has no rig
{% endif %}
#endif
#if NF_STATE_SIZE
    nf_step(&state, qd, qdd, load, tau, coefficients, status);
#else
    nf_step(qd, qdd, load, tau, coefficients, status);
#endif
    for (j = 0; j < NF_JOINTS; ++j)
        write_torque(j, tau[j], qd[j], status[j]);
}
