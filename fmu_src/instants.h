/* Sample instants: the times k * period for whole numbers k, on the absolute time axis. */
#ifndef PSA_INSTANTS_H
#define PSA_INSTANTS_H

/* 1 if a double tells the instants near t apart; what follows takes for granted that it does. */
int psa_countable(double t, double period);
/* 1 if t is an instant, or differs from one by no more than the rounding of communication points. */
int psa_at_instant(double t, double period);
/* The first instant after t, other than the one that t is. */
double psa_instant_after(double t, double period);
/* 1 if t is at an instant, but for rounding, or after it. */
int psa_reached(double t, double instant, double period);
/* Put the sampled states at the end of p to their values after an instant at t; 0, or 1 if the model
   cannot be evaluated there. w is for psa_model_sample. */
int psa_take_sample(double t, const double *x, const double *u, double *p, double *w);

#endif
