/* A word of 32 bits; the build stops if {{ real }} does not have {{ 32 * words }}. */
#if UINT_MAX == 0xFFFFFFFFUL
typedef unsigned int nf_word;
#else
typedef unsigned long nf_word;
#endif
typedef char nf_{{ real }}_has_{{ 32 * words }}_bits[
    sizeof(REAL) == {{ words }} * sizeof(nf_word) ? 1 : -1];

{% if words == 2 %}
/* Index of the word of a double that holds its exponent; it differs by byte order. */
static int nf_high(void)
{
    const double one = 1.0;
    nf_word words[2];
    memcpy(words, &one, sizeof words);
    return words[0] == 0 ? 1 : 0;
}

{% endif %}
/* From the bits, because under -ffast-math a compiler assumes every number to be finite. */
static int nf_finite(const REAL *x)
{
    nf_word words[{{ words }}];
    memcpy(words, x, sizeof words);
    return (words[{{ high }}] & {{ exponent }}UL) != {{ exponent }}UL;
}

static void nf_fill_nan(REAL *x, int count)
{
    nf_word words[{{ words }}];
    int i;
    words[{{ high }}] = {{ quiet }}UL;
{% if words == 2 %}
    words[1 - nf_high()] = 0;
{% endif %}
    for (i = 0; i < count; ++i)
        memcpy(x + i, words, sizeof words);
}
