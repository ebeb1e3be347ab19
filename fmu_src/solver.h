/* ESDIRK4(3)6L[2]SA: six stages, order four, L-stable, stiffly accurate, with an embedded third-order
   error estimate. Kennedy and Carpenter, Appl. Numer. Math. 44 (2003) 139-181, table ARK4(3)6L[2]SA-ESDIRK.
   Hairer and Wanner's SDIRK4 was measured beside it on sampled records: three times the steps at 1e-6.
   From a tolerance of 5e-6 on, where samples or the input's changes bound the step, TR-BDF2 (three stages, order two with a
   third-order companion; Hosea and Shampine, Appl. Numer. Math. 20 (1996) 21-37) errs less at the same cost.

   Between calls the solver keeps its last slope and step size, so that cutting the time axis costs
   accuracy nothing. Everything lives in the struct: no allocation, no static state. */
#ifndef PSA_SOLVER_H
#define PSA_SOLVER_H

#include "model.h"

#define PSA_STAGES 6

typedef enum {
    PSA_OK = 0,
    PSA_STEP_TOO_SMALL = 1, /* the tolerance cannot be met: state `culprit` at time `t` */
    PSA_NOT_FINITE = 2,     /* the model returned a value that is not finite */
    PSA_TOO_MANY_STEPS = 3
} psa_status;

typedef struct {
    double t;                /* time of x [s] */
    double x[PSA_NX];        /* states, SI units */
    double nominal[PSA_NX];  /* usual size of each state; the absolute tolerance is rtol * nominal */
    double rtol;             /* relative tolerance */
    double max_step;         /* 0: no bound */
    double step;             /* step size to try next; 0: choose one */
    double slope[PSA_NX];    /* x' at t */
    double last_input[PSA_NU + 1]; /* input that `slope` belongs to */
    int slope_valid;
    int landed;              /* the last step ended at a kink */
    long steps, rejected, evaluations;
    long steps_limit;        /* of one call of psa_solver_advance; 0: 10 million */
    int culprit;             /* index of the state that failed */
    /* work */
    double stage_x[PSA_STAGES][PSA_NX], stage_k[PSA_STAGES][PSA_NX], stage_t[PSA_STAGES];
    double jac[PSA_NX * PSA_NX], lu[PSA_NX * PSA_NX], weight[PSA_NX];
    int pivot[PSA_NX];
    double lu_factor_h; /* h * gamma that `lu` was made for */
    double contraction; /* theta / (1 - theta) of the last Newton iterations */
} psa_solver;

/* Input that is linear in time: u(t) = value + rate * (t - origin). */
typedef struct {
    double origin;
    double value[PSA_NU + 1];
    double rate[PSA_NU + 1];
} psa_input;

/* Sensitivities of the states with respect to `count` unknowns, carried along (may be NULL).
   which[j] is the index of a parameter, or -1 for an initial value. All arrays belong to the caller. */
typedef struct {
    int count;
    const int *which;
    double *s;       /* [PSA_NX][count]: dx/dtheta */
    double *slope;   /* [PSA_NX][count]: d(x')/dtheta at t */
    double *stage;   /* [PSA_STAGES][PSA_NX][count]: work */
    double *base;    /* [PSA_NX][count]: work */
    int slope_valid;
} psa_sensitivities;

void psa_solver_start(psa_solver *solver, double t, const double *x, const double *nominal,
                      double rtol);
/* Forget slope and factorisation: after a change of states or parameters from outside. */
void psa_solver_invalidate(psa_solver *solver);
psa_status psa_solver_advance(psa_solver *solver, double t_end, const psa_input *input,
                              const double *p, psa_sensitivities *sens);
/* The input at time t. */
void psa_input_at(const psa_input *input, double t, double *u);

#endif
