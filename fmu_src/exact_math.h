/* Numbers or lanes of numbers (PSA_LANES of them, the compiler's vector extension), and the functions of
   them that generated code calls. A lane has the same bits as a number by itself: exp and log are written
   out here, from operations that IEEE 754 rounds correctly; all others go lane by lane to libm. */
#ifndef PSA_EXACT_MATH_H
#define PSA_EXACT_MATH_H

#if !defined(__CUDACC_RTC__) /* which has no headers; exact_kernel.cu has what it needs of them */
#include <math.h>
#include <stdint.h>
#include <string.h>
#endif

#include "exact_tables.h"

#if defined(__GNUC__)
#define APART __attribute__((noinline)) /* runs once: compiled once; not `cold`, which slows its callers */
#else
#define APART
#endif

#ifndef PSA_LANES
#define PSA_LANES 1
#endif

/* 1: for a processor of which every thread runs one set by itself, with scalars alone and without sensitivities
   (exact_kernel.cu); the text is C++, too */
#ifndef PSA_DEVICE
#define PSA_DEVICE 0
#endif
#define PSA_SENSITIVE (PSA_LANES == 1 && !PSA_DEVICE)

#if PSA_LANES == 1
typedef double real;
typedef int64_t bits;
typedef uint64_t ubits;
#define LANE(r, i) ((void)(i), (r))
#define SET_LANE(r, i, value) ((void)(i), (r) = (value))
#define REAL(c) (c)
/* Columns of sensitivities, four at a time; with lanes there are none */
#if PSA_DEVICE
typedef double column;
#define COLUMNS 1
#else
#if defined(_WIN32) && !defined(__clang__) /* gcc there does not align its stack for vectors (its bug 54412) */
typedef double column __attribute__((vector_size(32), aligned(8)));
#else
typedef double column __attribute__((vector_size(32)));
#endif
#define COLUMNS 4
#endif
#else
typedef double real __attribute__((vector_size(8 * PSA_LANES), aligned(8)));
typedef int64_t bits __attribute__((vector_size(8 * PSA_LANES), aligned(8)));
typedef uint64_t ubits __attribute__((vector_size(8 * PSA_LANES), aligned(8)));
#define LANE(r, i) ((r)[i])
#define SET_LANE(r, i, value) ((r)[i] = (value))
#define REAL(c) (c - (real){0})
typedef real column;
#define COLUMNS 1
#endif

static inline bits bits_of(real x) {
    bits b;
    memcpy(&b, &x, sizeof b);
    return b;
}

static inline real real_of(bits b) {
    real x;
    memcpy(&x, &b, sizeof x);
    return x;
}

/* a where the mask is set, else b */
static inline real choose(bits mask, real a, real b) {
#if PSA_LANES == 1
    return mask ? a : b;
#else
    return real_of((mask & bits_of(a)) | (~mask & bits_of(b)));
#endif
}

#if PSA_LANES == 1
#define MASK(condition) (-(int64_t)(condition))
#define EACH_LANE(name, call)                                                                           \
    static inline real name(real x) { return call(x); }
#else
#define MASK(condition) ((bits)(condition))
#define EACH_LANE(name, call)                                                                           \
    static inline real name(real x) {                                                                   \
        real y = x;                                                                                     \
        for (int i = 0; i < PSA_LANES; ++i) y[i] = call(x[i]);                                          \
        return y;                                                                                       \
    }
#endif

EACH_LANE(v_sqrt, sqrt)
EACH_LANE(v_sin, sin)
EACH_LANE(v_cos, cos)
EACH_LANE(v_tan, tan)
EACH_LANE(v_atan, atan)
EACH_LANE(v_tanh, tanh)

#if PSA_LANES == 1
static inline real v_fabs(real x) { return fabs(x); }
#else
static inline real v_fabs(real x) { return real_of(bits_of(x) & (bits_of(REAL(0.0)) + INT64_MAX)); }
#endif
static inline real v_fmax(real a, real b) { return choose(MASK(a < b), b, a); }
static inline real v_fmin(real a, real b) { return choose(MASK(b < a), b, a); }
static inline real v_less(real a, real b) { return choose(MASK(a < b), REAL(1.0), REAL(0.0)); }
static inline real v_less_equal(real a, real b) { return choose(MASK(a <= b), REAL(1.0), REAL(0.0)); }
static inline real v_equal(real a, real b) { return choose(MASK(a == b), REAL(1.0), REAL(0.0)); }
static inline real v_unequal(real a, real b) { return choose(MASK(a != b), REAL(1.0), REAL(0.0)); }
static inline real v_not(real a) { return choose(MASK(a == 0.0), REAL(1.0), REAL(0.0)); }
static inline real v_and(real a, real b) { return choose(MASK(a != 0.0) & MASK(b != 0.0), REAL(1.0), REAL(0.0)); }
static inline real v_or(real a, real b) { return choose(MASK(a != 0.0) | MASK(b != 0.0), REAL(1.0), REAL(0.0)); }
static inline real v_if(real condition, real x) { return choose(MASK(condition != 0.0), x, REAL(0.0)); }
static inline real v_sign(real x) { return v_less(REAL(0.0), x) - v_less(x, REAL(0.0)); }

/* The entries of a table for whole numbers from 0 on */
static inline real look_up(const double *table, int stride, bits at) {
    real found = REAL(0.0);
    for (int i = 0; i < PSA_LANES; ++i) SET_LANE(found, i, table[stride * LANE(at, i)]);
    return found;
}

/* exp(x) to one unit in the last place, between -708 and 709, where it ends: x = n ln 2 / 128 + r, with
   |r| <= ln(2)/256, 2^(n/128) from a table (Tang, ACM Trans. Math. Softw. 15 (1989) 144). */
static inline real v_exp(real x) {
    const double shift = 6755399441055744.0; /* 1.5 * 2^52: what is added to it is rounded to integers */
    const real y = v_fmin(v_fmax(x, REAL(-708.0)), REAL(709.0));
    const real shifted = y * 0x1.71547652b82fep7 + shift;
    const real n = shifted - shift;
    const real r = (y - n * 0x1.62e42fee00000p-8) - n * 0x1.a39ef35793c76p-40;
    const bits whole = bits_of(shifted) - bits_of(REAL(shift));
    const real power = look_up(EXP_TABLE, 1, whole & ((1 << TABLE_BITS) - 1));
    const bits octave = (bits)((ubits)(whole >> TABLE_BITS) << 52);
    const real scale = real_of(bits_of(power) + octave);
    const real r2 = r * r;
    const real p = (r + r2 * (0.5 + r * (1.0 / 6.0))) + r2 * r2 * (1.0 / 24.0 + r * (1.0 / 120.0));
    return scale + scale * p;
}

/* log(x) within 2^-52 and its own last place, for normal x > 0, not a number elsewhere: x = 2^k m, m c = 1 + r
   with 1/c and log(c) from a table (Tang, ACM Trans. Math. Softw. 16 (1990) 378). What is good enough for powers;
   next to 1, where v_log keeps its digits, this one does not. */
static inline real v_log_of_base(real x) {
    const int64_t half = 0x3FE6A09E667F3BCDLL; /* the bits of sqrt(1/2) */
    const bits b = bits_of(x), beyond = b - half, e = beyond >> 52;
    const bits at = (beyond >> (52 - TABLE_BITS)) & ((1 << TABLE_BITS) - 1);
    const real m = real_of(b - (bits)((ubits)e << 52)); /* between sqrt(1/2) and sqrt(2) */
    const real r = m * look_up(LOG_TABLE[0], 2, at) - 1.0, r2 = r * r;
#if PSA_LANES == 1
    const real k = (real)e;
#else
    const real k = __builtin_convertvector(e, real);
#endif
    const real p = (r + r2 * (r * (1.0 / 3.0) - 0.5)) + r2 * r2 * ((r * 0.2 - 0.25) - r2 * (1.0 / 6.0));
    const real y = (k * 6.93147180559945309417e-01 + look_up(LOG_TABLE[0] + 1, 2, at)) + p;
    return choose(MASK(x > 0.0), y, REAL(NAN));
}

/* log(x) to one unit in the last place for normal x > 0, not a number elsewhere: the algorithm of
   fdlibm's e_log.c (Sun Microsystems 1993). */
static inline real v_log(real x) {
    const int64_t half = 0x3FE6A09E667F3BCDLL; /* the bits of sqrt(1/2) */
    const bits b = bits_of(x), e = (b - half) >> 52;
    const real m = real_of(b - (bits)((ubits)e << 52)); /* between sqrt(1/2) and sqrt(2) */
#if PSA_LANES == 1
    const real k = (real)e;
#else
    const real k = __builtin_convertvector(e, real);
#endif
    const real f = m - 1.0, s = f / (2.0 + f), z = s * s, w = z * z;
    const real odd = z * (6.666666666666735130e-01 +
                          w * (2.857142874366239149e-01 +
                               w * (1.818357216161805012e-01 + w * 1.479819860511658591e-01)));
    const real even = w * (3.999999999940941908e-01 +
                           w * (2.222219843214978396e-01 + w * 1.531383769920937332e-01));
    const real square = 0.5 * f * f;
    const real y = k * 6.93147180369123816490e-01 -
                   ((square - (s * (square + (odd + even)) + k * 1.90821492927058770002e-10)) - f);
    return choose(MASK(x > 0.0), y, REAL(NAN));
}

#endif
