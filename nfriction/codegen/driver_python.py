"""A whole rollout in Python, for numba."""

from string import Template

from nfriction.codegen import lanes_python
from nfriction.codegen.driver import ADVANCE, BEGIN, LEVELS, ONCE, STAGE, START, STEP, Pieces
from nfriction.codegen.emit import COMPILED, PYTHON_PRELUDE, python_function


def python_source(parts: Pieces) -> str:
    """The Python module of a rollout, for numba."""
    known = parts.inputs | parts.hoisted
    below = {node.number: known[node.number] for node in parts.once} | parts.inputs

    def scalars(bound: dict[int, str]) -> dict[int, str]:
        # States are scalars rather than arrays: numba keeps those in registers.
        return {number: _scalar(text) for number, text in bound.items()}

    def spread(arguments: list[str]) -> list[str]:
        return [a for name in arguments for a in _spread(name, parts)]

    once = [f"once[{i}]" for i in range(len(parts.once))]
    functions = [
        python_function("nf_once", [*ONCE, "once"], parts.once, parts.inputs, once),
        python_function("nf_start", spread(START), parts.start, scalars(parts.inputs)),
        lanes_python.function("nf_stage", spread(STAGE), parts.stage, scalars(known)),
    ]
    if parts.step:
        into = [f"step[{i}]" for i in range(len(parts.step))]
        step = lanes_python.function(
            "nf_step", [*spread(STEP), "step"], parts.step, scalars(below), into=into
        )
        functions.append(step)
    if parts.advance:
        functions += [
            python_function("nf_begin", spread(BEGIN), parts.begin, scalars(parts.inputs)),
            python_function("nf_advance", spread(ADVANCE), parts.advance, scalars(parts.inputs)),
        ]
    driver = _PYTHON_DRIVER.substitute(_python_names(parts))
    return "\n\n".join([PYTHON_PRELUDE + lanes_python.prelude(), *functions, driver])


def _names(name: str, n: int) -> list[str]:
    return [f"{name}_{i}" for i in range(n)]


def _spread(name: str, parts: Pieces) -> list[str]:
    """A state's array as the scalars that stand for it; what lives longer stays an array."""
    if name not in LEVELS:
        return [name]
    return _names(name, len(parts.advance) if name == "memory" else parts.joints)


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

    held, memory = _names("qd_held", count) + _names("qdd_held", count), _spread("memory", parts)
    acting = [*_names("tau", count), *held, *memory]
    return {
        "N": count,
        "N3": 3 * count,
        "COMPILED": COMPILED,
        "stage": ", ".join(["p", "once", "step", *acting]),
        "prepare": f"nf_step(p, once, {', '.join(acting)}, step)" if parts.step else "",
        "q": each("q_#"),
        "qd": each("qd_#"),
        "prev": each("prev_#"),
        "tau": ", ".join(_names("tau", count)),
        "q_args": ", ".join(_names("q", count)),
        "qd_args": ", ".join(_names("qd", count)),
        "initial": lines("q_# = q0[#]; qd_# = qd0[#]; q_out[#] = q_#; qd_out[#] = qd_#", 8),
        "first_qdd": lines("qdd_out[#] = prev_#", 8),
        "seed": lines("qd_held_# = qdd_held_# = 0.0", 8),
        "memory_seed": "\n        ".join(f"{name} = 0.0" for name in memory),
        "first_tau": lines("tau_# = torque[#]", 8),
        "take": lines("tau_# = torque[#]", 12),
        "hold": lines("qd_held_# = qd_#; qdd_held_# = prev_#", 16),
        "remember": _remember(", ".join(held), ", ".join(memory)) if memory else "",
        "drive": lines("qd_held_# = qd_drive[#]; qdd_held_# = qdd_drive[#]", 20),
        "a1": each("a1_#"),
        "a2": each("a2_#"),
        "a3": each("a3_#"),
        "a4": each("a4_#"),
        "to2": lines("x_# = q_# + half * qd_#; v2_# = qd_# + half * a1_#", 4),
        "to3": lines("x_# = q_# + half * v2_#; v3_# = qd_# + half * a2_#", 4),
        "to4": lines("x_# = q_# + dt * v3_#; v4_# = qd_# + dt * a3_#", 4),
        "x": ", ".join(_names("x", count)),
        "v2": ", ".join(_names("v2", count)),
        "v3": ", ".join(_names("v3", count)),
        "v4": ", ".join(_names("v4", count)),
        "q_next": each("q_# + sixth * (qd_# + 2.0 * (v2_# + v3_#) + v4_#)"),
        "qd_next": each("qd_# + sixth * (a1_# + 2.0 * (a2_# + a3_#) + a4_#)"),
        "within": " and ".join(f"abs(qd_{i}) <= limit and q_{i} - q_{i} == 0.0" for i in n),
        "record": lines("q_out[#] = q_#; qd_out[#] = qd_#; qdd_out[#] = prev_#", 16),
    }


def _remember(held: str, memory: str) -> str:
    count = memory.count(",") + 1
    given = f"{memory}, = " + ", ".join(f"given[{i}]" for i in range(count))
    return f"""
                if k > 0:
                    {memory}, = nf_advance(p, {held}, {memory})
                elif remembered:
                    given = moved(memory, c * {count})
                    {given},
                else:
                    {memory}, = nf_begin(p, {held})"""


_PYTHON_DRIVER = Template("""\
@straight($N3)
def nf_rk4(dt, $stage, $q_args, $qd_args):
    half = 0.5 * dt
    sixth = dt / 6.0
    $a1 = nf_stage.within($stage, $q_args, $qd_args)
    $to2
    $a2 = nf_stage.within($stage, $x, $v2)
    $to3
    $a3 = nf_stage.within($stage, $x, $v3)
    $to4
    $a4 = nf_stage.within($stage, $x, $v4)
    return ($q_next $qd_next $a1)


@njit(
    void(
        REALS, REALS, COUNT, COUNT, COUNT, COUNT, COUNT, REAL, REALS, COUNT,
        REALS, REALS, REALS, COUNT, COUNT, REALS, COUNT, COUNT,
        REALS, REALS, COUNT, COUNT, REALS, COUNT, REALS, REALS, REALS, COUNTS,
    ),
    $COMPILED,
)
def nf_rollout(
    once, step, first, last, steps, every, hold, limit, all_p, p_row,
    all_q0, all_qd0, all_h, h_row, h_step, all_torque, torque_row, torque_step,
    all_qd_drive, all_qdd_drive, drive_row, drive_step, memory, remembered,
    all_q_out, all_qd_out, all_qdd_out, diverged,
):
    records = (steps // every + 1) * $N
    for c in range(first, last):
        p = moved(all_p, c * p_row)
        q0 = moved(all_q0, c * $N)
        qd0 = moved(all_qd0, c * $N)
        h = moved(all_h, c * h_row)
        torque = moved(all_torque, c * torque_row)
        qd_drive = moved(all_qd_drive, c * drive_row)
        qdd_drive = moved(all_qdd_drive, c * drive_row)
        q_out = moved(all_q_out, c * records)
        qd_out = moved(all_qd_out, c * records)
        qdd_out = moved(all_qdd_out, c * records)
        diverged[c] = -1
        $initial
        $seed
        $first_tau
        nf_once(p, once)
        $prev = nf_start(p, $tau, $q_args, $qd_args)
        $first_qdd
        next = every
        renew = 0
        $memory_seed
        for k in range(steps):
            $take
            if k == renew:
                renew += hold
                $hold
                if drive_step:
                    $drive$remember
            $prepare
            $q $qd $prev = nf_rk4(h[k * h_step], $stage, $q_args, $qd_args)
            torque = moved(torque, torque_step)
            qd_drive = moved(qd_drive, drive_step)
            qdd_drive = moved(qdd_drive, drive_step)
            if not ($within):
                for i in range($N, records - k // every * $N):
                    q_out[i] = qd_out[i] = qdd_out[i] = math.nan
                diverged[c] = k + 1
                break
            if k + 1 == next:
                q_out = moved(q_out, $N)
                qd_out = moved(qd_out, $N)
                qdd_out = moved(qdd_out, $N)
                $record
                next += every
""")
