/* Adapter between the plain face in fmi_data.h and the function CasADi generates in model_derivatives.c. */
#include "fmi_data.h"

#include <stddef.h>

typedef int casadi_function(const double **, double **, long long int *, double *, int);

casadi_function psa_adjoint;

int psa_model_adjoint(double t, const double *x, const double *u, const double *p,
                      const double *wxdot, const double *wy, const double *wz, double *dt,
                      double *dx, double *du, double *dp, double *w) {
    const double *arg[PSA_DERIVATIVES_SZ_ARG] = {NULL};
    double *res[PSA_DERIVATIVES_SZ_RES] = {NULL};
    long long int iw[PSA_DERIVATIVES_SZ_IW];
    arg[0] = &t;
    arg[1] = x;
    arg[2] = u;
    arg[3] = p;
    arg[4] = wxdot;
    arg[5] = wy;
    arg[6] = wz;
    res[0] = dt;
    res[1] = dx;
    res[2] = du;
    res[3] = dp;
    return psa_adjoint(arg, res, iw, w, 0);
}
