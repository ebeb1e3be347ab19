/* Adapter between the plain face in fmi_data.h and the function CasADi generates in model_derivatives.c. */
#include "fmi_data.h"

#include <stddef.h>

typedef int casadi_function(const double **, double **, long long int *, double *, int);

casadi_function psa_directional;

int psa_model_directional(double t, const double *x, const double *u, const double *p, double dt,
                          const double *dx, const double *du, const double *dp, double *dxdot,
                          double *dy, double *dz, double *w) {
    const double *arg[PSA_DERIVATIVES_SZ_ARG] = {NULL};
    double *res[PSA_DERIVATIVES_SZ_RES] = {NULL};
    long long int iw[PSA_DERIVATIVES_SZ_IW];
    arg[0] = &t;
    arg[1] = x;
    arg[2] = u;
    arg[3] = p;
    arg[4] = &dt;
    arg[5] = dx;
    arg[6] = du;
    arg[7] = dp;
    res[0] = dxdot;
    res[1] = dy;
    res[2] = dz;
    return psa_directional(arg, res, iw, w, 0);
}
