"""A whole rollout in C."""

from string import Template

from nfriction.codegen import lanes
from nfriction.codegen.driver import ADVANCE, BEGIN, ONCE, STAGE, START, STEP, Pieces
from nfriction.codegen.emit import C_PRELUDE, c_function


def c_source(parts: Pieces) -> str:
    """The C translation unit of a rollout."""
    known = parts.inputs | parts.hoisted
    below = {n.number: known[n.number] for n in parts.once} | parts.inputs
    seldom = "NF_SELDOM static "
    functions = [
        c_function("nf_once", ONCE, {"once": parts.once}, parts.inputs, qualifier=seldom),
        c_function("nf_step", STEP, {"step": parts.step}, below, collect=True),
        c_function("nf_stage", STAGE, {"qdd": parts.stage}, known, collect=True),
        c_function("nf_start", START, {"qdd": parts.start}, parts.inputs, qualifier=seldom),
    ]
    if parts.advance:
        functions += [
            c_function("nf_begin", BEGIN, {"next": parts.begin}, parts.inputs, qualifier=seldom),
            c_function("nf_advance", ADVANCE, {"next": parts.advance}, parts.inputs),
        ]
    driver = _C_DRIVER.substitute(
        N=parts.joints,
        NO=max(1, len(parts.once)),
        NS=max(1, len(parts.step)),
        NM=max(1, len(parts.advance)),
        remember=_C_REMEMBER if parts.advance else "",
    )
    return "\n".join([C_PRELUDE, lanes.PRELUDE, _SELDOM, *functions, driver])


# These functions are long and run once a rollout: optimising them would double the compile time.
_SELDOM = """\
#if defined(__GNUC__) && !defined(__clang__)
#define NF_SELDOM __attribute__((optimize("O0")))
#else
#define NF_SELDOM
#endif
"""

# Through a second array, for a function reads its inputs to its last line.
_C_REMEMBER = """
            if (k > 0)
                nf_advance(p, held, seen, memory, advanced);
            else if (first)
                for (i = 0; i < NM; ++i) advanced[i] = first[i];
            else
                nf_begin(p, held, seen, advanced);
            for (i = 0; i < NM; ++i) memory[i] = advanced[i];"""

_C_DRIVER = Template("""\
#if defined(_WIN32)
#define NF_EXPORT __declspec(dllexport)
#else
#define NF_EXPORT
#endif
#define N $N
#define NM $NM

/* Not finite compares false, so NaN and infinity count as beyond the limit. */
static int nf_within(const double *q, const double *qd, double limit)
{
    int i;
    for (i = 0; i < N; ++i)
        if (!(fabs(qd[i]) <= limit && q[i] - q[i] == 0.0)) return 0;
    return 1;
}

/* Fills the records of one candidate; returns the step at which it diverged, or -1. */
static ptrdiff_t nf_candidate(ptrdiff_t steps, ptrdiff_t every, ptrdiff_t hold, double limit,
    const double *p, const double *q0, const double *qd0, const double *h, ptrdiff_t h_step,
    const double *torque, ptrdiff_t torque_step,
    const double *qd_drive, const double *qdd_drive, ptrdiff_t drive_step, const double *first,
    double *q_out, double *qd_out, double *qdd_out)
{
    double once[$NO], step[$NS];
    double memory[NM], advanced[NM];
    double q[N], qd[N], held[N], seen[N], prev[N], x[N], tau[N];
    double a1[N], a2[N], a3[N], a4[N], v2[N], v3[N], v4[N];
    ptrdiff_t k, next = every, renew = 0;
    int i;
    (void)first;
    for (i = 0; i < NM; ++i) memory[i] = advanced[i] = 0.0;
    for (i = 0; i < N; ++i) {
        q_out[i] = q[i] = q0[i];
        qd_out[i] = qd[i] = qd0[i];
    }
    nf_once(p, once);
    nf_start(p, torque, q, qd, prev);
    for (i = 0; i < N; ++i) qdd_out[i] = prev[i];
    q_out += N;
    qd_out += N;
    qdd_out += N;
    for (k = 0; k < steps; ++k) {
        const double dt = h[k * h_step], half = 0.5 * dt, sixth = dt / 6.0;
        for (i = 0; i < N; ++i) tau[i] = torque[k * torque_step + i];
        if (k == renew) {
            renew += hold;
            for (i = 0; i < N; ++i) {
                held[i] = drive_step ? qd_drive[k * drive_step + i] : qd[i];
                seen[i] = drive_step ? qdd_drive[k * drive_step + i] : prev[i];
            }$remember
        }
        nf_step(p, once, tau, held, seen, memory, step);
        nf_stage(p, once, step, tau, held, seen, memory, q, qd, a1);
        for (i = 0; i < N; ++i) {
            x[i] = q[i] + half * qd[i];
            v2[i] = qd[i] + half * a1[i];
        }
        nf_stage(p, once, step, tau, held, seen, memory, x, v2, a2);
        for (i = 0; i < N; ++i) {
            x[i] = q[i] + half * v2[i];
            v3[i] = qd[i] + half * a2[i];
        }
        nf_stage(p, once, step, tau, held, seen, memory, x, v3, a3);
        for (i = 0; i < N; ++i) {
            x[i] = q[i] + dt * v3[i];
            v4[i] = qd[i] + dt * a3[i];
        }
        nf_stage(p, once, step, tau, held, seen, memory, x, v4, a4);
        for (i = 0; i < N; ++i) {
            q[i] += sixth * (qd[i] + 2.0 * (v2[i] + v3[i]) + v4[i]);
            qd[i] += sixth * (a1[i] + 2.0 * (a2[i] + a3[i]) + a4[i]);
            prev[i] = a1[i];
        }
        if (!nf_within(q, qd, limit)) {
            for (; next <= steps; next += every, q_out += N, qd_out += N, qdd_out += N)
                for (i = 0; i < N; ++i)
                    q_out[i] = qd_out[i] = qdd_out[i] = HUGE_VAL - HUGE_VAL;
            return k + 1;
        }
        if (k + 1 == next) {
            for (i = 0; i < N; ++i) {
                q_out[i] = q[i];
                qd_out[i] = qd[i];
                qdd_out[i] = prev[i];
            }
            q_out += N;
            qd_out += N;
            qdd_out += N;
            next += every;
        }
    }
    return -1;
}

NF_EXPORT void nf_rollout(ptrdiff_t first, ptrdiff_t last, ptrdiff_t steps, ptrdiff_t every,
    ptrdiff_t hold, double limit, const double *p, ptrdiff_t p_row,
    const double *q0, const double *qd0, const double *h, ptrdiff_t h_row, ptrdiff_t h_step,
    const double *torque, ptrdiff_t torque_row, ptrdiff_t torque_step,
    const double *qd_drive, const double *qdd_drive, ptrdiff_t drive_row, ptrdiff_t drive_step,
    const double *memory, ptrdiff_t remembered,
    double *q_out, double *qd_out, double *qdd_out, ptrdiff_t *diverged)
{
    const ptrdiff_t records = (steps / every + 1) * N;
    ptrdiff_t c;
    for (c = first; c < last; ++c)
        diverged[c] = nf_candidate(steps, every, hold, limit, p + c * p_row,
            q0 + c * N, qd0 + c * N, h + c * h_row, h_step, torque + c * torque_row, torque_step,
            qd_drive + c * drive_row, qdd_drive + c * drive_row, drive_step,
            remembered ? memory + c * NM : NULL,
            q_out + c * records, qd_out + c * records, qdd_out + c * records);
}
""")
