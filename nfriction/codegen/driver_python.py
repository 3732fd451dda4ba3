"""A whole rollout in Python, for numba."""

from string import Template

from nfriction.codegen.driver import LEVELS, ONCE, STAGE, START, STEP, Pieces
from nfriction.codegen.emit import PYTHON_PRELUDE, python_function


def python_source(parts: Pieces) -> str:
    """The Python module of a rollout, for numba."""
    n = parts.joints
    known = parts.inputs | parts.hoisted
    below = {node.number: known[node.number] for node in parts.once} | parts.inputs

    def scalars(bound: dict[int, str]) -> dict[int, str]:
        # States are scalars rather than arrays: numba keeps those in registers.
        return {number: _scalar(text) for number, text in bound.items()}

    stage = [a for name in STAGE for a in (_names(name, n) if name in LEVELS else [name])]
    step = [a for name in STEP for a in (_names(name, n) if name in LEVELS else [name])]
    start = [a for name in START for a in (_names(name, n) if name in LEVELS else [name])]
    functions = [
        python_function("nf_once", ONCE, parts.once, parts.inputs, into="once"),
        python_function("nf_step", step, parts.step, scalars(below), into="step"),
        python_function("nf_stage", stage, parts.stage, scalars(known)),
        python_function("nf_start", start, parts.start, scalars(parts.inputs)),
    ]
    driver = _PYTHON_DRIVER.substitute(_python_names(parts))
    return "\n\n".join([PYTHON_PRELUDE, *functions, driver])


def _names(name: str, n: int) -> list[str]:
    return [f"{name}_{i}" for i in range(n)]


def _scalar(text: str) -> str:
    name, _, index = text.partition("[")
    return f"{name}_{index.rstrip(']')}" if name in LEVELS else text


def _python_names(parts: Pieces) -> dict[str, object]:
    """What the template needs: state updates written out joint by joint."""
    n = range(parts.joints)
    count = parts.joints

    def each(pattern: str) -> str:
        return ", ".join(pattern.replace("#", str(i)) for i in n) + ","

    def lines(pattern: str, indent: int) -> str:
        return ("\n" + " " * indent).join(pattern.replace("#", str(i)) for i in n)

    held = ", ".join([*_names("tau", count), *_names("qd_held", count), *_names("qdd_held", count)])
    return {
        "N": count,
        "NO": max(1, len(parts.once)),
        "NS": max(1, len(parts.step)),
        "held": held,
        "q": each("q_#"),
        "qd": each("qd_#"),
        "q_args": ", ".join(_names("q", count)),
        "qd_args": ", ".join(_names("qd", count)),
        "tau_args": ", ".join(_names("tau", count)),
        "initial": lines("q_# = q0[#]; qd_# = qd0[#]; q_out[#] = q_#; qd_out[#] = qd_#", 4),
        "first_tau": lines("tau_# = torque[#]", 4),
        "first_qdd": lines("qdd_out[#] = qdd_held_#", 4),
        "start_out": each("qdd_held_#"),
        "seed": lines("qdd_held_# = 0.0", 4),
        "take": lines("tau_# = torque[k * torque_step + #]; qd_held_# = qd_#", 8),
        "drive": lines(
            "qd_held_# = qd_drive[k * drive_step + #]; qdd_held_# = qdd_drive[k * drive_step + #]",
            12,
        ),
        "a1": each("a1_#"),
        "a2": each("a2_#"),
        "a3": each("a3_#"),
        "a4": each("a4_#"),
        "to2": lines("x_# = q_# + half * qd_#; v2_# = qd_# + half * a1_#", 8),
        "to3": lines("x_# = q_# + half * v2_#; v3_# = qd_# + half * a2_#", 8),
        "to4": lines("x_# = q_# + dt * v3_#; v4_# = qd_# + dt * a3_#", 8),
        "x": ", ".join(_names("x", count)),
        "v2": ", ".join(_names("v2", count)),
        "v3": ", ".join(_names("v3", count)),
        "v4": ", ".join(_names("v4", count)),
        "advance": lines(
            "q_# += sixth * (qd_# + 2.0 * (v2_# + v3_#) + v4_#); "
            "qd_# += sixth * (a1_# + 2.0 * (a2_# + a3_#) + a4_#); qdd_held_# = a1_#",
            8,
        ),
        "within": " and ".join(f"abs(qd_{i}) <= limit and q_{i} - q_{i} == 0.0" for i in n),
        "record": lines(
            "q_out[at + #] = q_#; qd_out[at + #] = qd_#; qdd_out[at + #] = qdd_held_#", 12
        ),
    }


_PYTHON_DRIVER = Template("""\
@njit(error_model="numpy", fastmath={"contract"})
def nf_candidate(
    steps, every, limit, p, q0, qd0, h, h_step, torque, torque_step,
    qd_drive, qdd_drive, drive_step, q_out, qd_out, qdd_out,
):
    once = np.empty($NO)
    step = np.empty($NS)
    $initial
    $seed
    nf_once(p, once)
    $first_tau
    $start_out = nf_start(p, $tau_args, $q_args, $qd_args)
    $first_qdd
    at = $N
    next = every
    for k in range(steps):
        dt = h[k * h_step]
        half = 0.5 * dt
        sixth = dt / 6.0
        $take
        if drive_step:
            $drive
        nf_step(p, once, $held, step)
        $a1 = nf_stage(p, once, step, $held, $q_args, $qd_args)
        $to2
        $a2 = nf_stage(p, once, step, $held, $x, $v2)
        $to3
        $a3 = nf_stage(p, once, step, $held, $x, $v3)
        $to4
        $a4 = nf_stage(p, once, step, $held, $x, $v4)
        $advance
        if not ($within):
            q_out[at:] = math.nan
            qd_out[at:] = math.nan
            qdd_out[at:] = math.nan
            return k + 1
        if k + 1 == next:
            $record
            at += $N
            next += every
    return -1


@njit(error_model="numpy", nogil=True, cache=True)
def nf_rollout(
    first, last, steps, every, limit, p, p_row, q0, qd0, h, h_row, h_step,
    torque, torque_row, torque_step, qd_drive, qdd_drive, drive_row, drive_step,
    q_out, qd_out, qdd_out, diverged,
):
    records = (steps // every + 1) * $N
    for c in range(first, last):
        diverged[c] = nf_candidate(
            steps, every, limit, p[c * p_row :], q0[c * $N :], qd0[c * $N :],
            h[c * h_row :], h_step, torque[c * torque_row :], torque_step,
            qd_drive[c * drive_row :], qdd_drive[c * drive_row :], drive_step,
            q_out[c * records : (c + 1) * records], qd_out[c * records : (c + 1) * records],
            qdd_out[c * records : (c + 1) * records],
        )
""")
