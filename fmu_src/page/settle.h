/* The state at the start of a record: psa_casadi/simulation/start.py in numbers. */
#ifndef PAGE_SETTLE_H
#define PAGE_SETTLE_H

#include "model.h"

typedef struct {
    double t;
    const double *u, *rate;   /* [PSA_NU] the first inputs, and how fast they change */
    const double *p;          /* [PSA_NP] */
    const double *deviation;  /* [PSA_NX] of the memories from where they rest */
    const double *nominal;    /* [PSA_NX] */
} psa_beginning;

/* Write the state [PSA_NX]; 0, or 1 where there is no equilibrium. */
int psa_settle(const psa_beginning *at, double *x);

#endif
