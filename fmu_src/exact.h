/* A whole trajectory by exact steps of the linear part; used by the Python side. */
#ifndef PSA_EXACT_H
#define PSA_EXACT_H

#if defined(__CUDACC_RTC__)
#define PSA_EXACT_API
#elif defined(_WIN32)
#define PSA_EXACT_API __declspec(dllexport)
#else
#define PSA_EXACT_API __attribute__((visibility("default")))
#endif

typedef struct {
    long samples;          /* number of times */
    const double *t;       /* [samples] */
    const double *v;       /* [samples][nu]: input at the times */
    int zero_order_hold;   /* 1: the input is constant between samples, 0: linear */
    int lengths;           /* different steps between samples */
    const double *length;  /* [lengths] */
    const int *which_step; /* [samples - 1]: index of the step after each sample */
    int sets;              /* sets of parameters, at most PSA_LANES */
    const double *p;       /* [np][sets] */
    const double *x0;      /* [nx][sets] */
    const double *nominal; /* [nx][sets] */
    double tolerance;      /* of one step, over the nominal sizes */
    int coarsest, finest;  /* levels: a sample is divided by at least 2^coarsest, at most 2^finest */
    long steps_limit;      /* tried steps of one set; until a sample its share of them and a tenth */
    double *x;             /* [samples][nx][sets] or NULL */
    double *y;             /* [samples][ny][sets] or NULL */
    double *shown;         /* [samples][shown][sets] or NULL: outputs whose sensitivities the model has; nan from
                              where one of several sets cannot be integrated */
    int count;             /* unknowns of the sensitivities; 0 where there is more than one set */
    const int *which;      /* [count] parameter index, -1: initial value */
    const double *s0;      /* [nx][count] d x0 / d theta */
    double *dy;            /* [samples][shown][count] */
    const volatile int *stop; /* NULL, or 0 until another thread ends the run */
    /* results */
    long steps, rejected, forced; /* forced: steps of the finest level that missed the tolerance */
    double t_failed;
} psa_exact;

/* 0; 1 where a number is not finite; 2 where memory is out; 3 where too many steps were needed; 4 where the run was
   stopped */
PSA_EXACT_API int psa_run_exact(psa_exact *run);

#endif
