#if UINT_MAX == 0xFFFFFFFFUL
typedef int nf_whole;
#else
typedef long nf_whole;
#endif
{% if words == 2 %}
typedef char nf_float_has_32_bits[sizeof(float) == sizeof(nf_word) ? 1 : -1];
{% endif %}

/* exp(x) - less for numbers <= 0, in place: x = k ln 2 + r, a polynomial in r, and 2^k from the
 * bits of a float (0 if too small for one). No branches, so that compilers vectorise it. */
static void nf_exp(REAL *x, int count, REAL less)
{
    int i;
    for (i = 0; i < count; ++i) {
        const nf_whole k = (nf_whole)(x[i] * {{ number(1.4426950408889634) }} - {{ number(0.5) }});
        const REAL t = (REAL)k;
        const REAL r = (x[i] - t * {{ number(ln2[0]) }}) - t * {{ number(ln2[1]) }}, s = r * r;
        const REAL p = {{ polynomial }};
        const nf_word bits = ((nf_word)(k + 127) & (0 - (nf_word)(k > -127))) << 23;
        float power;
        memcpy(&power, &bits, sizeof power);
        {
            const REAL scale = (REAL)power;
            x[i] = scale * (r * p) + (scale - less);
        }
    }
}

{% if signs %}
#define NF_SIGNS {{ signs }}

/* tanh(x) in place, as -e / (e + 2) with e = exp(-2 |x|) - 1; beyond |x| = 20 it is 1. */
static void nf_tanh(REAL *x)
{
    REAL e[NF_SIGNS * NF_JOINTS{{ spare(joints * signs) }}]{{ " = {0}" if spare(joints * signs) }};
    int i;
    for (i = 0; i < NF_SIGNS * NF_JOINTS; ++i)
        e[i] = nf_max(-2 * real_abs(x[i]), -40);
    nf_exp(e, NF_SIGNS * NF_JOINTS{{ spare(joints * signs) }}, 1);
    for (i = 0; i < NF_SIGNS * NF_JOINTS; ++i) {
        const REAL size = -e[i] / (e[i] + 2);
        x[i] = nf_min(nf_max(2 * x[i], -size), size);
    }
}

{% endif %}
