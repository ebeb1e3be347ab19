/* Adapter between the plain face in model.h and the functions CasADi generates in model.c. */
#include "model.h"

#include <stddef.h>

#ifndef casadi_real
#define casadi_real double
#endif
#ifndef casadi_int
#define casadi_int long long int
#endif

typedef int casadi_function(const casadi_real **, casadi_real **, casadi_int *, casadi_real *, int);

casadi_function psa_ode, psa_jacobian, psa_outputs, psa_switches;

static int call(casadi_function *function, double t, const double *x, const double *u,
                const double *p, double *first, double *second, double *w) {
    const casadi_real *arg[PSA_SZ_ARG] = {NULL};
    casadi_real *res[PSA_SZ_RES] = {NULL};
    casadi_int iw[PSA_SZ_IW];
    arg[0] = &t;
    arg[1] = x;
    arg[2] = u;
    arg[3] = p;
    res[0] = first;
    res[1] = second;
    return function(arg, res, iw, w, 0);
}

int psa_model_ode(double t, const double *x, const double *u, const double *p, double *xdot, double *w) {
    return call(psa_ode, t, x, u, p, xdot, NULL, w);
}

int psa_model_jacobian(double t, const double *x, const double *u, const double *p, double *jac, double *w) {
    return call(psa_jacobian, t, x, u, p, jac, NULL, w);
}

int psa_model_outputs(double t, const double *x, const double *u, const double *p, double *y, double *w) {
    return call(psa_outputs, t, x, u, p, y, NULL, w);
}

int psa_model_switches(double t, const double *x, const double *u, const double *p, double *z, double *w) {
    return call(psa_switches, t, x, u, p, z, NULL, w);
}

#if PSA_NS > 0
casadi_function psa_sample;

int psa_model_sample(double t, const double *x, const double *u, const double *p, double *sampled, double *w) {
    return call(psa_sample, t, x, u, p, sampled, NULL, w);
}
#else
int psa_model_sample(double t, const double *x, const double *u, const double *p, double *sampled, double *w) {
    (void)t, (void)x, (void)u, (void)p, (void)sampled, (void)w;
    return 0;
}
#endif

#ifdef PSA_WITH_SENSITIVITIES
casadi_function psa_sensitivity, psa_output_sensitivity;

int psa_model_sensitivity(double t, const double *x, const double *u, const double *p, double *jac,
                          double *param, double *w) {
    return call(psa_sensitivity, t, x, u, p, jac, param, w);
}

int psa_model_output_sensitivity(double t, const double *x, const double *u, const double *p,
                                 double *jac, double *param, double *w) {
    return call(psa_output_sensitivity, t, x, u, p, jac, param, w);
}
#endif
