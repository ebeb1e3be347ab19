/* ESDIRK4(3)6L[2]SA: six stages, order four, L-stable, stiffly accurate, with an embedded third-order
   error estimate. Kennedy and Carpenter, Appl. Numer. Math. 44 (2003) 139-181, table ARK4(3)6L[2]SA-ESDIRK.
   Hairer and Wanner's SDIRK4 was measured beside it on sampled records: three times the steps at 1e-6.
   From a tolerance of 5e-6 on, where samples or the input's changes bound the step, TR-BDF2 (three
   stages, order two with a third-order companion; Hosea and Shampine, Appl. Numer. Math. 20 (1996)
   21-37) errs less at the same cost.

   Between calls the solver keeps its last slope and step size, so that cutting the time axis costs
   accuracy nothing. Everything lives in the struct: no allocation, no static state. */
#ifndef PSA_SOLVER_H
#define PSA_SOLVER_H

#include <stdint.h>

#include "model.h"

#define PSA_STAGES 6

typedef enum {
    PSA_OK = 0,
    PSA_STEP_TOO_SMALL = 1, /* the tolerance cannot be met: state `culprit` at time `t` */
    PSA_NOT_FINITE = 2,     /* the model returned a value that is not finite */
    PSA_TOO_MANY_STEPS = 3
} psa_status;

/* What the solver remembers between calls: enough to go on with the same bits. Only numbers of eight
   bytes, so that the struct has the same bytes on every platform of the same byte order. */
typedef struct {
    double t;                /* time of x [s]: origin + since, rounded */
    double origin, since;    /* a communication point, and the time from it: far from 0 only `since` is
                                fine enough for the steps */
    double x[PSA_NX];        /* states, SI units */
    double nominal[PSA_NX];  /* usual size of each state; the absolute tolerance is rtol * nominal */
    double rtol;             /* relative tolerance */
    double max_step;         /* 0: no bound */
    double step;             /* step size to try next; 0: choose one */
    double slope[PSA_NX];    /* x' at t */
    double last_input[PSA_NU + 1]; /* input that `slope` belongs to */
    double contraction;      /* theta / (1 - theta) of the last Newton iterations */
    int64_t slope_valid;
    int64_t landed;          /* the last step ended at a kink */
    int64_t steps, rejected, evaluations;
    int64_t steps_limit;     /* of one call of psa_solver_advance; 0: 10 million */
    int64_t culprit;         /* index of the state that failed */
} psa_solver;

/* Numbers of one step; nothing in here is needed after it. They are not on the stack, which is small in
   threads of some importers: no function here takes more than a page of it. */
typedef struct {
    double stage_x[PSA_STAGES][PSA_NX], stage_k[PSA_STAGES][PSA_NX], stage_t[PSA_STAGES];
    double jac[PSA_NX * PSA_NX], lu[PSA_NX * PSA_NX], weight[PSA_NX];
    double x[PSA_NX], base[PSA_NX], f[PSA_NX], error[PSA_NX], w[PSA_SZ_W];
    int pivot[PSA_NX];
    double lu_factor_h; /* h * gamma that `lu` was made for */
} psa_work;

/* Input that is linear in time: u = value + rate * (since - begin), on the solver's clock. */
typedef struct {
    double begin;
    double value[PSA_NU + 1];
    double rate[PSA_NU + 1];
} psa_input;

/* Where an advance ends: on the solver's clock, and the time that it is called. */
typedef struct {
    double since, t;
} psa_end;

/* Sensitivities of the states with respect to `count` unknowns, carried along (may be NULL). All arrays
   belong to the caller. */
typedef struct psa_sensitivities psa_sensitivities;
struct psa_sensitivities {
    int count;
    /* Fill df/dx (column-major) and df/dtheta at constant x, [PSA_NX][count]; 0, or 1 on failure. w is
       for functions of the model. */
    int (*differentiate)(const psa_sensitivities *sens, double t, const double *x, const double *u,
                         const double *p, double *jac, double *forcing, double *w);
    void *owner;            /* of the caller, for `differentiate` */
    double *s;              /* [PSA_NX][count]: dx/dtheta */
    double *slope;          /* [PSA_NX][count]: d(x')/dtheta at t */
    double *stage;          /* [PSA_STAGES][PSA_NX][count]: work */
    double *base;           /* [PSA_NX][count]: work */
    int slope_valid;
};

/* Who wants to hear of each accepted step (may be NULL): it may change the input from this time on and
   bring the end of the advance nearer. */
typedef struct {
    void (*accepted)(void *owner, psa_end *end);
    void *owner;
} psa_watch;

void psa_solver_start(psa_solver *solver, double t, const double *x, const double *nominal,
                      double rtol);
/* Set the clock: the time is t, and `since` counts from it. */
void psa_solver_move(psa_solver *solver, double t);
/* Forget the slope: after a change of states or parameters from outside. */
void psa_solver_invalidate(psa_solver *solver);
psa_status psa_solver_advance(psa_solver *solver, psa_work *work, psa_end end,
                              const psa_input *input, const double *p, psa_sensitivities *sens,
                              const psa_watch *watch);
/* The input at a time of the solver's clock. */
void psa_input_at(const psa_input *input, double since, double *u);

#endif
