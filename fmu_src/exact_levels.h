/* The linear part's exact steps, and their derivatives, for the lengths h, h/2, h/4, ...

   L' = M L + B v + c + sum_i e_i n_i over a step of length d, with s = tau / d between 0 and 1:

       L(d) = (I + F) L(0) + a_1 v(0) + a_2 (v(d) - v(0)) + c_1 + sum_i (q_1 n_0 + q_2 n_1 + q_3 n_2)

   for v linear in s and n_i = n_0 + n_1 s + n_2 s^2, where F = exp(M d) - I and, for a column b of B, c or
   the unit matrix, b_m = (m-1)! d phi_m(M d) b. A Taylor polynomial gives them for a length on which M is
   small; each doubling of the length follows from

       F <- 2 F + F F,  b_1 <- 2 b_1 + F b_1,  b_2 <- (2 b_2 + F b_2 + b_1) / 2,
       b_3 <- (2 b_3 + F b_3 + b_1 + 2 b_2) / 4.

   F instead of exp(M d) keeps the digits of what is slow. Scaling and squaring: Higham, SIAM J. Matrix Anal.
   Appl. 26 (2005) 1179; the integrals: van Loan, IEEE Trans. Autom. Control 23 (1978) 395; derivatives by the
   product rule at every step: Al-Mohy and Higham, SIAM J. Matrix Anal. Appl. 30 (2009) 1639.

   A port that varies along a driver u as sigma u(t) has the response sigma dF/dS with M + S e_i e_u^T: another
   direction, whose derivatives by the parameters are the mixed ones. */
#ifndef PSA_EXACT_LEVELS_H
#define PSA_EXACT_LEVELS_H

#include "exact_math.h"

#if !PSA_DEVICE
#include <stdlib.h>
#endif

#define NL EX_NL
#define LINE 64 /* bytes of a cache line: a vector that lies across two is dearer */
#define NV (2 * EX_NU + 1 + 3 * EX_NPORT) /* vectors beside F: a_1, a_2, c_1, q_1, q_2, q_3 */
#define TAYLOR 12                         /* terms; enough to 1e-17 where |M d| <= 1/4 */
#define SMALL 0.25
#define DEEPEST 60 /* halvings to where M is small */

/* F and the vectors of one direction (or of none) at one length: [F | a_1 a_2 c_1 q_1 q_2 q_3], a row padded with 0 to
   whole quads */
#if PSA_DEVICE
typedef double quad;
#define QUAD 1
#else
typedef double quad __attribute__((vector_size(32), aligned(8)));
#define QUAD 4
#endif
#define QUADS ((NL + NV + QUAD - 1) / QUAD)
#define VEC(k) (NL + (k)) /* the column of a vector */

typedef struct {
    double m[NL][QUAD * QUADS];
} psa_block;

/* Rows of L by blocks of one vector, the last ones 0; with lanes a row is a vector already */
#define BLOCKS ((NL + COLUMNS - 1) / COLUMNS)
#define ROWS EX_ROWS
#if PSA_LANES == 1
typedef quad rows;
#else
typedef real rows;
#endif
#define ROWS_OF(array, b) (((rows *)(array))[b])

/* What a step of one length needs. Of its whole: F, a_1, a_2, c_1, and each port's weights of its values at the
   start, the half and the end, by columns. Of its half and its quarter: the same (a_2 over the step's whole
   change of v) for the states that are wanted inside a step, by rows. Of each chord: the response to sigma u(t)
   beyond what these weights see of it. */
#define SOME(n) ((n) > 0 ? (n) : 1)

typedef struct {
    real f[NL][ROWS], a1[SOME(EX_NU)][ROWS], a2[SOME(EX_NU)][ROWS], c[ROWS], w[SOME(EX_NPORT)][3][ROWS];
} psa_whole;

typedef struct {
    real f[NL], a1[SOME(EX_NU)], a2[SOME(EX_NU)], c, w[SOME(EX_NPORT)][3];
} psa_row;

typedef struct {
    psa_whole whole;
    psa_row inner[2][EX_NEED]; /* half, quarter */
    real chord_f[SOME(EX_NCH)][SOME(EX_NDRIVE)][ROWS], chord_a1[SOME(EX_NCH)][SOME(EX_NU)][ROWS],
        chord_a2[SOME(EX_NCH)][SOME(EX_NU)][ROWS], chord_c[SOME(EX_NCH)][ROWS],
        chord_w[SOME(EX_NCH)][SOME(EX_NFEED)][3][ROWS]; /* of the ports that feed the driver */
} psa_level;

/* Directions: [chord or 0][parameter or 0]; the algebra in which parameters and chords square to zero */
#define BLOCK(blocks, count, chord, theta) ((blocks) + (chord) * ((count) + 1) + (theta))

/* out += a b, of a the first NL columns; out is another block */
static void multiply_add(const psa_block *a, const psa_block *b, psa_block *out) {
    for (int i = 0; i < NL; ++i) {
        quad *const sum = (quad *)out->m[i];
        for (int k = 0; k < NL; ++k) {
            const double factor = a->m[i][k];
            const quad *const row = (const quad *)b->m[k];
            if (factor != 0.0)
                for (int q = 0; q < QUADS; ++q) sum[q] += factor * row[q];
        }
    }
}

/* The pairs of directions whose product belongs to direction (chord, theta) */
static int pairs_of(int chord, int theta, int pair[4][4]) {
    int n = 0;
    for (int c = 0; c <= (chord > 0); ++c)
        for (int t = 0; t <= (theta > 0); ++t) {
            pair[n][0] = c ? chord : 0, pair[n][1] = t ? theta : 0;
            pair[n][2] = c ? 0 : chord, pair[n][3] = t ? 0 : theta;
            ++n;
        }
    return n;
}

#define A1(j) (j)
#define A2(j) (EX_NU + (j))
#define C1 (2 * EX_NU)
#define Q(order, i) (2 * EX_NU + 1 + (order) * EX_NPORT + (i))

/* M of a direction and what the vectors begin with, all times d: b_m has b d / m as its first term */
static void first_term(const double *lin, double d, int chord, int theta, psa_block *z) {
    memset(z, 0, sizeof *z);
    if (chord > 0 && theta == 0) z->m[ex_chord_row[chord - 1]][ex_chord_driver[chord - 1]] = d;
    if (chord > 0) return;
    for (int i = 0; i < NL; ++i) {
        for (int j = 0; j < NL; ++j) z->m[i][j] = lin[i * NL + j] * d;
        for (int j = 0; j < EX_NU; ++j) {
            z->m[i][VEC(A1(j))] = lin[NL * NL + i * EX_NU + j] * d;
            z->m[i][VEC(A2(j))] = lin[NL * NL + i * EX_NU + j] * d / 2.0;
        }
        z->m[i][VEC(C1)] = lin[NL * (NL + EX_NU) + i] * d;
    }
    if (theta > 0) return;
    for (int j = 0; j < EX_NPORT; ++j)
        for (int m = 0; m < 3; ++m) z->m[ex_port_row[j]][VEC(Q(m, j))] = d / (m + 1);
}

/* F and all vectors of the length d, where M d is small, by their Taylor series: a term is M d times the one before,
   over its number and m. `lin` are M, B, c and their derivatives by the parameters, each (NL * (NL + EX_NU + 1))
   numbers, row-major one after the other; z has room for three times the blocks. */
APART static void start_blocks(int count, const double *lin, double d, psa_block *blocks, psa_block *z) {
    const size_t all = (size_t)(EX_NCH + 1) * (size_t)(count + 1);
    const int one = NL * (NL + EX_NU + 1);
    psa_block *term = z + all, *next = term + all;
    double order[QUAD * QUADS]; /* m */
    for (int k = 0; k < QUAD * QUADS; ++k) order[k] = 1.0;
    for (int j = 0; j < EX_NU; ++j) order[VEC(A2(j))] = 2.0;
    for (int j = 0; j < EX_NPORT; ++j) order[VEC(Q(1, j))] = 2.0, order[VEC(Q(2, j))] = 3.0;
    for (int c = 0; c <= EX_NCH; ++c)
        for (int t = 0; t <= count; ++t) first_term(lin + t * one, d, c, t, BLOCK(z, count, c, t));
    memcpy(term, z, all * sizeof *z);
    memcpy(blocks, z, all * sizeof *z);
    for (int k = 1; k <= TAYLOR; ++k) {
        double over[QUAD * QUADS];
        for (int q = 0; q < QUAD * QUADS; ++q) over[q] = 1.0 / (k + order[q]);
        memset(next, 0, all * sizeof *next);
        for (int c = 0; c <= EX_NCH; ++c)
            for (int t = 0; t <= count; ++t) {
                psa_block *const own = BLOCK(next, count, c, t), *const sum = BLOCK(blocks, count, c, t);
                int pair[4][4];
                for (int n = pairs_of(c, t, pair) - 1; n >= 0; --n)
                    multiply_add(BLOCK(z, count, pair[n][0], pair[n][1]), BLOCK(term, count, pair[n][2], pair[n][3]),
                                 own);
                for (int i = 0; i < NL; ++i)
                    for (int q = 0; q < QUADS; ++q) {
                        ((quad *)own->m[i])[q] *= ((const quad *)over)[q];
                        ((quad *)sum->m[i])[q] += ((const quad *)own->m[i])[q];
                    }
            }
        psa_block *const swap = term;
        term = next;
        next = swap;
    }
}

/* Twice the length, in one direction */
static void double_direction(int count, const psa_block *from, int c, int t, psa_block *to) {
    int pair[4][4];
    const psa_block *const own = BLOCK(from, count, c, t);
    for (int i = 0; i < NL; ++i)
        for (int q = 0; q < QUADS; ++q) ((quad *)to->m[i])[q] = 2.0 * ((const quad *)own->m[i])[q];
    for (int n = pairs_of(c, t, pair) - 1; n >= 0; --n)
        multiply_add(BLOCK(from, count, pair[n][0], pair[n][1]), BLOCK(from, count, pair[n][2], pair[n][3]), to);
    for (int i = 0; i < NL; ++i) {
        const double *const one = own->m[i];
        double *const two = to->m[i];
        for (int j = 0; j < EX_NU; ++j) two[VEC(A2(j))] = 0.5 * (two[VEC(A2(j))] + one[VEC(A1(j))]);
        for (int j = 0; j < EX_NPORT; ++j) {
            const double q1 = one[VEC(Q(0, j))], q2 = one[VEC(Q(1, j))];
            two[VEC(Q(2, j))] = 0.25 * (two[VEC(Q(2, j))] + q1 + 2.0 * q2);
            two[VEC(Q(1, j))] = 0.5 * (two[VEC(Q(1, j))] + q1);
        }
    }
}

/* A step length h, its halves, and what has been asked of them */
typedef struct {
    int count;          /* parameters by which it is differentiated */
    int levels;         /* levels below h that are there; of those below two at a time, in turn */
    psa_block *blocks;  /* [RUNGS(levels)][EX_NCH + 1][count + 1] */
} psa_ladder;

#define RUNGS(levels) ((levels) + 3)

#if !PSA_DEVICE
/* Zeroed memory that begins with a cache line, NULL where there is none; what is before it says what to free */
static void *lined(size_t size) {
    char *const memory = calloc(1, size + 2 * LINE);
    if (!memory) return NULL;
    char *const begin = memory + LINE + (LINE - (uintptr_t)memory % LINE) % LINE;
    memcpy(begin - sizeof memory, &memory, sizeof memory);
    return begin;
}

static void free_lined(void *begin) {
    char *memory = NULL;
    if (begin) memcpy(&memory, (char *)begin - sizeof memory, sizeof memory);
    free(memory);
}
#endif

static const psa_block *rung(const psa_ladder *ladder, int level) {
    const size_t each = (size_t)(EX_NCH + 1) * (size_t)(ladder->count + 1);
    const int below = level - ladder->levels;
    return ladder->blocks + each * (size_t)(below > 0 ? ladder->levels + 1 + below % 2 : level);
}

/* Fill a ladder; 0, or 1 where numbers are not finite. `scale` are typical sizes of the states, by which M is
   balanced; `balanced` has room for as many numbers as `lin`, `terms` for three times the blocks of a rung. */
APART static int build_ladder(psa_ladder *ladder, const double *lin, const double *scale, double h, double *balanced,
                              psa_block *terms) {
    const int one = NL * (NL + EX_NU + 1), count = ladder->count;
    double norm = 0.0;
    for (int i = 0; i < NL; ++i) {
        double sum = 0.0;
        for (int j = 0; j < NL; ++j) sum += fabs(lin[i * NL + j]) * scale[j] / scale[i];
        norm = fmax(norm, sum);
    }
    for (int i = 0; i < one * (count + 1); ++i)
        if (!isfinite(lin[i])) return 1;
    int depth = ladder->levels;
    while (depth < DEEPEST && !(ldexp(norm * h, -depth) <= SMALL)) ++depth;
    for (int t = 0; t <= count; ++t)
        for (int i = 0; i < NL; ++i) {
            for (int j = 0; j < NL; ++j)
                balanced[t * one + i * NL + j] = lin[t * one + i * NL + j] * scale[j] / scale[i];
            for (int j = 0; j <= EX_NU; ++j) {
                const int at = t * one + NL * NL + (j < EX_NU ? i * EX_NU + j : NL * EX_NU + i);
                balanced[at] = lin[at] / scale[i];
            }
        }
    start_blocks(count, balanced, ldexp(h, -depth), (psa_block *)rung(ladder, depth), terms);
    for (int level = depth - 1; level >= 0; --level)
        for (int c = 0; c <= EX_NCH; ++c)
            for (int t = 0; t <= count; ++t)
                double_direction(count, rung(ladder, level + 1), c, t,
                                 (psa_block *)BLOCK(rung(ladder, level), count, c, t));
    return 0;
}

/* Weights of a port's values at start, half and end in the response at the node theta of the step, from the
   vectors of the node's own length */
APART static void port_weights(const psa_block *b, int j, double theta, double out[3][NL]) {
    for (int i = 0; i < NL; ++i) {
        const double q1 = b->m[i][VEC(Q(0, j))], q2 = theta * b->m[i][VEC(Q(1, j))];
        const double q3 = theta * theta * b->m[i][VEC(Q(2, j))];
        out[0][i] = q1 - 3.0 * q2 + 2.0 * q3;
        out[1][i] = 4.0 * (q2 - q3);
        out[2][i] = 2.0 * q3 - q2;
    }
}

/* Write direction t of a level into one lane; the balance is taken back */
APART static void fill_level(const psa_ladder *ladder, int level, int t, const double *scale, int lane,
                       psa_level *out) {
    const int count = ladder->count;
    static const double THETA[3] = {1.0, 0.5, 0.25};
    double w[3][NL], dw[3][NL];
    psa_whole *const whole = &out->whole;
    for (int n = 0; n < 3; ++n) {
        const psa_block *const b = BLOCK(rung(ladder, level + n), count, 0, t);
        const int rows = n == 0 ? NL : EX_NEED;
        for (int r = 0; r < rows; ++r) {
            const int i = n == 0 ? r : ex_need[r];
            psa_row *const row = n == 0 ? NULL : &out->inner[n - 1][r];
            for (int j = 0; j < NL; ++j) {
                const double value = b->m[i][j] * scale[i] / scale[j];
                if (row) SET_LANE(row->f[j], lane, value);
                else SET_LANE(whole->f[j][i], lane, value);
            }
            for (int j = 0; j < EX_NU; ++j) {
                const double one = b->m[i][VEC(A1(j))] * scale[i], two = THETA[n] * b->m[i][VEC(A2(j))] * scale[i];
                if (row) {
                    SET_LANE(row->a1[j], lane, one);
                    SET_LANE(row->a2[j], lane, two);
                } else {
                    SET_LANE(whole->a1[j][i], lane, one);
                    SET_LANE(whole->a2[j][i], lane, two);
                }
            }
            if (row) SET_LANE(row->c, lane, b->m[i][VEC(C1)] * scale[i]);
            else SET_LANE(whole->c[i], lane, b->m[i][VEC(C1)] * scale[i]);
        }
        for (int j = 0; j < EX_NPORT; ++j) {
            /* a port adds to its row in physical units: 1 is 1/scale in the balanced ones */
            const double unit = 1.0 / scale[ex_port_row[j]];
            port_weights(b, j, THETA[n], w);
            for (int q = 0; q < 3; ++q)
                for (int r = 0; r < rows; ++r) {
                    const int i = n == 0 ? r : ex_need[r];
                    const double value = w[q][i] * unit * scale[i];
                    if (n == 0) SET_LANE(whole->w[j][q][i], lane, value);
                    else SET_LANE(out->inner[n - 1][r].w[j][q], lane, value);
                }
        }
    }
    for (int c = 0; c < EX_NCH; ++c) {
        const int port = ex_chord_port[c], u = ex_chord_driver[c];
        const psa_block *const s = BLOCK(rung(ladder, level), count, c + 1, t);
        const psa_block *node[2], *base[2];
        for (int n = 0; n < 2; ++n) {
            node[n] = BLOCK(rung(ladder, level + n), count, 0, t);
            base[n] = BLOCK(rung(ladder, level + n), count, 0, 0);
        }
        /* w belongs to no direction, dw to t; u(t) at the half and the end from L, v and c alone */
        port_weights(base[0], port, 1.0, w);
        port_weights(node[0], port, 1.0, dw);
        const double unit = scale[u] / scale[ex_port_row[port]];
        for (int i = 0; i < NL; ++i) {
            for (int j = 0; j < NL; ++j) {
                double seen = j == u ? dw[0][i] + dw[1][i] + dw[2][i] : 0.0;
                seen += dw[1][i] * base[1]->m[u][j] + dw[2][i] * base[0]->m[u][j];
                if (t > 0) seen += w[1][i] * node[1]->m[u][j] + w[2][i] * node[0]->m[u][j];
                if (j < ex_reads[u])
                    SET_LANE(out->chord_f[c][j][i], lane, (s->m[i][j] - seen) * unit * scale[i] / scale[j]);
            }
            for (int j = 0; j < EX_NU; ++j) {
                double one = dw[1][i] * base[1]->m[u][VEC(A1(j))] + dw[2][i] * base[0]->m[u][VEC(A1(j))];
                double two = dw[1][i] * 0.5 * base[1]->m[u][VEC(A2(j))] + dw[2][i] * base[0]->m[u][VEC(A2(j))];
                if (t > 0) {
                    one += w[1][i] * node[1]->m[u][VEC(A1(j))] + w[2][i] * node[0]->m[u][VEC(A1(j))];
                    two += w[1][i] * 0.5 * node[1]->m[u][VEC(A2(j))] + w[2][i] * node[0]->m[u][VEC(A2(j))];
                }
                SET_LANE(out->chord_a1[c][j][i], lane, (s->m[i][VEC(A1(j))] - one) * unit * scale[i]);
                SET_LANE(out->chord_a2[c][j][i], lane, (s->m[i][VEC(A2(j))] - two) * unit * scale[i]);
            }
            double rest = dw[1][i] * base[1]->m[u][VEC(C1)] + dw[2][i] * base[0]->m[u][VEC(C1)];
            if (t > 0) rest += w[1][i] * node[1]->m[u][VEC(C1)] + w[2][i] * node[0]->m[u][VEC(C1)];
            SET_LANE(out->chord_c[c][i], lane, (s->m[i][VEC(C1)] - rest) * unit * scale[i]);
        }
        for (int k = 0; k < EX_NFEED; ++k) {
            const int j = ex_feed[c][k];
            if (j < 0) break;
            double own[3][NL], b0[3][NL], b1[3][NL], d0[3][NL], d1[3][NL];
            port_weights(s, j, 1.0, own);
            port_weights(base[0], j, 1.0, b0);
            port_weights(base[1], j, 0.5, b1);
            port_weights(node[0], j, 1.0, d0);
            port_weights(node[1], j, 0.5, d1);
            for (int q = 0; q < 3; ++q)
                for (int i = 0; i < NL; ++i) {
                    double seen = dw[1][i] * b1[q][u] + dw[2][i] * b0[q][u];
                    if (t > 0) seen += w[1][i] * d1[q][u] + w[2][i] * d0[q][u];
                    SET_LANE(out->chord_w[c][k][q][i], lane,
                             (own[q][i] - seen) * unit * scale[i] / scale[ex_port_row[j]]);
                }
        }
    }
}

#endif
