// $TITLE on an Arduino. Put this file, $NAME.c and $HEADER into one folder that is called
// $NAME; write `read_position` and `write_torque` for your board.
extern "C" {
#include "$HEADER"
}
#include <Arduino.h>

// Time between calls [us].
static const unsigned long PERIOD = $PERIOD;

#if $PREFIX_STATE_SIZE
static $prefix_state state;
#endif
#if $PREFIX_FILTER_SIZE
static $prefix_filter filter;
#endif
static unsigned long next_call;

// Position [$UNIT] of a joint; here from an analogue pin over one turn.
static double read_position(int joint)
{
    return analogRead(A0 + joint) * (6.283185307179586 / 1023.0);
}

// Hand out the torque that compensates friction [$TORQUE_UNIT]; 0 where it is not to be trusted.
static void write_torque(int joint, $prefix_real tau, int status)
{
    if (status & $PREFIX_NOT_FINITE)
        tau = 0;
    analogWrite(9 + joint, (int)constrain(128 + 100 * tau, 0, 255));
}

static void read_positions(double *q)
{
    int j;
    for (j = 0; j < $PREFIX_JOINTS; ++j)
        q[j] = read_position(j);
}

void setup()
{
    double q[$PREFIX_JOINTS];
    read_positions(q);
#if $PREFIX_FILTER_SIZE
    $prefix_filter_init(&filter, q);
#endif
#if $PREFIX_STATE_SIZE
    $prefix_real rest[$PREFIX_JOINTS] = {0};
    $prefix_init(&state, rest, rest);
#endif
    next_call = micros();
}

void loop()
{
    static double q[$PREFIX_JOINTS];
    static $prefix_real qd[$PREFIX_JOINTS], qdd[$PREFIX_JOINTS];
    $prefix_real load[$PREFIX_JOINTS], tau[$PREFIX_JOINTS];
    $prefix_real coefficients[$PREFIX_JOINTS * $PREFIX_COEFFICIENTS];
    int status[$PREFIX_JOINTS];
    int j;
    // Unsigned differences stay right when the clock wraps.
    if ((long)(micros() - next_call) < 0)
        return;
    next_call += PERIOD;
#if $PREFIX_FILTER_SIZE
    read_positions(q);
    $prefix_filter_step(&filter, q, qd, qdd);
#else
    // Export with the filter inside for anything better than plain differences.
    for (j = 0; j < $PREFIX_JOINTS; ++j) {
        const double position = read_position(j);
        const $prefix_real velocity = ($prefix_real)((position - q[j]) * (1e6 / PERIOD));
        qdd[j] = (velocity - qd[j]) * ($prefix_real)(1e6 / PERIOD);
        qd[j] = velocity;
        q[j] = position;
    }
#endif
    for (j = 0; j < $PREFIX_JOINTS; ++j)
        load[j] = 1;
#if $PREFIX_STATE_SIZE
    $prefix_step(&state, qd, qdd, load, tau, coefficients, status);
#else
    $prefix_step(qd, qdd, load, tau, coefficients, status);
#endif
    for (j = 0; j < $PREFIX_JOINTS; ++j)
        write_torque(j, tau[j], status[j]);
}
