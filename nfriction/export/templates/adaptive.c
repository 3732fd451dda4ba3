/*
 * Classes of acceleration: low, medium and high. The memory of a joint is the envelope of |qdd|,
 * which rises at once and fades slowly, and the class. A class is entered above its upper border
 * and left below its lower one; at the start their middle is the border.
 */
{{ table("middle", 2, "JOINTS") }}
{{ table("upper", 2, "JOINTS") }}
{{ table("lower", 2, "JOINTS") }}
/* Ratio of acceleration to velocity, for the envelope of a motion that starts at full speed. */
{{ table("swing_rate", "JOINTS") }}
/* Limit of the envelope: a single outlier must not keep the class for long. */
{{ table("ceiling", "JOINTS") }}
{{ table("by_class", 3, "COEFFICIENTS", "JOINTS") }}

/* The class: number of borders below an envelope. */
static int nf_above(REAL envelope, const REAL border[2][NF_JOINTS], int j)
{
    return (envelope > border[0][j]) + (envelope > border[1][j]);
}

/* Memory before the first sample. */
static void nf_class_start(REAL qd, REAL qdd, nf_memory *memory, int j)
{
    const REAL size = real_sqrt(qdd * qdd + NF_SWING_RATE[j] * qd * (NF_SWING_RATE[j] * qd));
    memory[0] = nf_min(size, NF_CEILING[j]);
    memory[1] = (REAL)nf_above(memory[0], NF_MIDDLE, j);
}

/* Memory after one more sample. */
static void nf_class_advance(REAL qdd, nf_memory *memory, int j)
{
    int known = (int)memory[1], least, most;
    memory[0] = nf_min(nf_max(real_abs(qdd), {{ fading }} * memory[0]), NF_CEILING[j]);
    least = nf_above(memory[0], NF_UPPER, j);
    most = nf_above(memory[0], NF_LOWER, j);
    known = known < least ? least : known;
    memory[1] = (REAL)(known > most ? most : known);
}
