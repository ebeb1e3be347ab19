/* A whole trajectory on a given time grid, with sensitivities if wanted; used by the Python side. */
#ifndef PSA_TRAJECTORY_H
#define PSA_TRAJECTORY_H

#include "solver.h"

#if defined(_WIN32)
#define PSA_API __declspec(dllexport)
#else
#define PSA_API __attribute__((visibility("default")))
#endif

typedef struct {
    long samples;           /* number of times */
    const double *t;        /* [samples] */
    const double *u;        /* [samples][PSA_NU]: input at the times */
    int zero_order_hold;    /* 1: the input is constant between samples, 0: linear */
    const double *p;        /* [PSA_NP] */
    const double *x0;       /* [PSA_NX] */
    const double *z0;       /* [PSA_NS] sampled states before the first instant */
    const double *nominal;  /* [PSA_NX] */
    double rtol;
    double max_step;
    long steps_limit;       /* between two samples; 0: 10 million */
    long steps_most;        /* of the whole run, rejected ones too, as in exact.h; 0: no limit */
    double *x;              /* [samples][PSA_NX] or NULL */
    double *z;              /* [samples][PSA_NS] or NULL: after an instant, if there is one */
    double *y;              /* [samples][PSA_NY] or NULL */
    int count;              /* unknowns of the sensitivities, 0: none; with sampled states always 0 */
    const int *which;       /* [count] parameter index, -1: initial value */
    const double *s0;       /* [PSA_NX][count] d x0 / d theta */
    int shown;              /* outputs whose sensitivities are wanted */
    const int *outputs;     /* [shown] their indices */
    double *dy;             /* [samples][shown][count] */
    double *work;           /* (PSA_STAGES + 3) * PSA_NX * count */
    const volatile int *stop; /* NULL, or 0 until another thread ends the run */
    /* results */
    long steps, rejected, evaluations;
    double t_failed;
    int culprit;
} psa_trajectory;

/* A psa_status, or that the run was stopped, or did not begin. */
enum { PSA_STOPPED = 4, PSA_NO_MEMORY = 5 };

PSA_API int psa_run(psa_trajectory *trajectory);

#endif
