/* Exact steps: what a step under trial and a run are made of (exact.c). */
#ifndef PSA_EXACT_STATE_H
#define PSA_EXACT_STATE_H

#include "exact.h"
#include "exact_model.h"
#include "exact_levels.h"

#define SLOWS 0.8        /* a driver whose rate falls to less than this share of it may come to rest */
#define FAST 1e3         /* over the driver's rate: there what a state does in time is nothing */
#define GROWS 0.03       /* of the tolerance: the next step may be twice as long */
#define FAR 10.0         /* times the tolerance: more than one halving mends; the next step is a quarter */
#define TURNS 8          /* iterations for the instant at which a driver turns */
#define LOST 1e6         /* times the tolerance: an error of the finest step from which nothing can be told */
#define BENDS 0.05       /* of its way: a driver's course that bends by more is not a smooth one */
#define UNEVEN 2e-3      /* share of its way by which a driver is off the middle at the half of a step */
#define NEWTON_LIMIT 12
#define STILL 1e-9       /* of its nominal size: a driver's way along which nothing can be told */
#define MOST_UNKNOWNS (EX_NP + EX_NX)

#if PSA_DEVICE
/* Levels that a thread holds, of 24 kB; all of one length of a small model are 13 */
#define PSA_HELD ((int)(sizeof(psa_level) < 1536 ? 16 : sizeof(psa_level) < 24576 ? 24576 / sizeof(psa_level) : 1))
#endif

/* Factors of the matrices' derivatives beside L: inputs and their changes, 1, ports, chords */
#define TAIL (2 * EX_NU + 1 + 3 * EX_NPORT + EX_NCH * (1 + EX_NDRIVE + 2 * EX_NU + 3 * EX_NFEED))

enum { WHOLE, HALF, QUARTER, NODES };

/* One leg of a group's way, on which its driver does not turn, with what the derivatives need */
typedef struct {
    real begin, dt;                       /* share of the step at which it begins; its duration */
    real from[EX_NX], to[EX_NX];          /* path variables at both ends, states at both ends */
    real at[4][EX_NX];                    /* path variables and states of the four evaluations */
    real out[4][EX_GROUP_OUT];            /* slopes and their partial derivatives */
    real last[EX_NX];                     /* slopes at the end */
    real rate, way;                       /* mean rate of the driver, its way */
    real over_dt, over_way;               /* one over both, 0 where it does not last or does not move */
    int stages;                           /* 4, or 2 where the way is short */
} psa_leg;

/* A group's way: one leg, or two where the driver turns at the share `turn` of the step */
typedef struct {
    psa_leg leg[2];
    int legs;
    real w[NODES + 1], turn;              /* the driver's rate at whole, half, quarter, start */
    real share[NODES];                    /* of the leg's way at the nodes */
    int on[NODES];                        /* the leg of each node; with lanes only the first counts */
    real basis[6];                        /* Hermite's, at the turn */
    real missed;                          /* error of the driver's value there */
    int drifts;                           /* what the states do in time is told apart at the nodes */
    real drift[EX_NX], fast[EX_GROUP_OUT]; /* their slopes in time, and all slopes at a great rate */
    real rate_slopes[NODES + 1][EX_RATE_OUT];
} psa_stages;

/* Change over a step and bend inside it of a driver and of a port, and what sigma is a ratio over */
typedef struct {
    real way, bend, change, bent, over;
} psa_chord;

/* Everything of one step under trial */
typedef struct {
    const psa_level *level;
    real dt, over_dt, t[NODES];
    real v0[EX_NU + 1], v[NODES][EX_NU + 1], dv[EX_NU + 1];
    real l[ROWS], x[NODES][EX_NX];
    real port[NODES][EX_NPORT + 1];       /* values */
    real slopes[NODES][EX_NPORT + 1][EX_PORT_OUT]; /* values and partial derivatives */
    psa_chord chords[EX_NCH + 1];
    real chord[EX_NCH + 1], beyond[EX_NCH + 1][NL]; /* sigma, and the response to u(t) beyond the parabola */
    psa_stages stages[EX_NG + 1];
    real error;                           /* over the tolerance */
} psa_trial;

/* Where the lanes stand within a sample, the levels of their next steps, and which have come to an end */
typedef struct {
    long at[PSA_LANES], tried[PSA_LANES];
    int level[PSA_LANES], dead[PSA_LANES];
} psa_pace;

typedef struct {
    psa_exact *run;
    real t, x[EX_NX], port[EX_NPORT + 1], start_slopes[EX_NPORT + 1][EX_PORT_OUT];
    real p[EX_NP + 1], k[EX_NK + EX_NRATED + 1];
    real nominal[EX_NX], over_nominal[EX_NX], tolerance, over_tolerance, brief;
    psa_ladder *ladders;                  /* [lengths][lanes] */
    real *plain, *linear_slopes;          /* matrices of the linear part, their derivatives by EX_NTHETA parameters */
    double *lin, *balanced;               /* those of one lane and of the unknown parameters */
    psa_block *terms;                     /* to build a ladder with */
#if PSA_DEVICE
    psa_level held[PSA_HELD];             /* those that were asked for, each at its place */
    int held_at[PSA_HELD];                /* which of [lengths][finest + 1] they are, -1: none */
#else
    psa_level *levels;                    /* [lengths][finest + 1] */
    psa_level *mixed;                     /* of lanes whose levels differ; of one parameter's derivatives */
    const psa_level *mixed_from[PSA_LANES];
    char *ready;                          /* [lengths][finest + 1] */
    void *memory;                         /* what the pointers above are cut from */
#endif
    double scale[PSA_LANES][NL];
    int thetas;                           /* unknown parameters of the linear part: the first columns */
    int place[MOST_UNKNOWNS + 1];         /* column of each unknown */
    int tails, tail[TAIL];                /* what is not zero of the factors of the matrices' derivatives */
    int slopes_size;                      /* vectors of one block of columns in those of a level */
    column *slopes;                       /* [lengths][finest + 1][blocks of thetas][slopes_size] */
    int blocks;                           /* of columns */
    char apart[EX_NG + 1][MOST_UNKNOWNS / COLUMNS + 1]; /* blocks that a group does not feel */
    column *s, *sport, *unit;             /* [blocks][EX_NX], [blocks][EX_NPORT + 1], [blocks][EX_NP] */
    psa_trial trial;
} psa_state;

static int any(bits mask) {
    int found = 0;
    for (int lane = 0; lane < PSA_LANES; ++lane) found |= LANE(mask, lane) != 0;
    return found;
}

static void set_error(psa_trial *trial, real error) {
    /* over the tolerance; a number that is not finite counts as an infinite error */
    const bits fine = MASK(error <= 1e300);
    trial->error = v_fmax(trial->error, choose(fine, error, REAL(1e300)));
}

#endif
