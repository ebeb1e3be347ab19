/* Dense linear algebra for matrices of a few rows, column-major. */
#ifndef PSA_LINEAR_H
#define PSA_LINEAR_H

/* LU factorisation with partial pivoting, in place; returns 0, or 1 if the matrix is singular. */
int psa_lu_factor(int n, double *a, int *pivot);
/* Solve with the factors, in place. */
void psa_lu_solve(int n, const double *lu, const int *pivot, double *b);
/* The same for `count` right-hand sides at once, row-major [n][count]; zeros of the factors cost nothing. */
void psa_lu_solve_many(int n, const double *lu, const int *pivot, int count, double *b);
/* y += factor * x over `count` numbers */
void psa_axpy(int count, double factor, const double *x, double *y);

#endif
