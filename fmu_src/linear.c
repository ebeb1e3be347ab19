#include "linear.h"

#include <math.h>

int psa_lu_factor(int n, double *a, int *pivot) {
    for (int k = 0; k < n; ++k) {
        int best = k;
        for (int i = k + 1; i < n; ++i)
            if (fabs(a[i + k * n]) > fabs(a[best + k * n])) best = i;
        pivot[k] = best;
        if (!(fabs(a[best + k * n]) > 0.0)) return 1;
        if (best != k)
            for (int j = 0; j < n; ++j) {
                const double swap = a[k + j * n];
                a[k + j * n] = a[best + j * n];
                a[best + j * n] = swap;
            }
        for (int i = k + 1; i < n; ++i) a[i + k * n] /= a[k + k * n];
        for (int j = k + 1; j < n; ++j) {
            const double factor = a[k + j * n];
            if (factor != 0.0)
                for (int i = k + 1; i < n; ++i) a[i + j * n] -= a[i + k * n] * factor;
        }
    }
    return 0;
}

void psa_lu_solve(int n, const double *lu, const int *pivot, double *b) {
    for (int k = 0; k < n; ++k) {
        const double value = b[pivot[k]];
        b[pivot[k]] = b[k];
        b[k] = value;
    }
    for (int k = 0; k < n; ++k)
        if (b[k] != 0.0)
            for (int i = k + 1; i < n; ++i) b[i] -= lu[i + k * n] * b[k];
    for (int k = n - 1; k >= 0; --k) {
        b[k] /= lu[k + k * n];
        for (int i = 0; i < k; ++i) b[i] -= lu[i + k * n] * b[k];
    }
}

void psa_axpy(int count, double factor, const double *x, double *y) {
    for (int i = 0; i < count; ++i) y[i] += factor * x[i];
}

void psa_lu_solve_many(int n, const double *lu, const int *pivot, int count, double *b) {
    for (int k = 0; k < n; ++k)
        if (pivot[k] != k)
            for (int c = 0; c < count; ++c) {
                const double value = b[pivot[k] * count + c];
                b[pivot[k] * count + c] = b[k * count + c];
                b[k * count + c] = value;
            }
    for (int k = 0; k < n; ++k)
        for (int i = k + 1; i < n; ++i)
            if (lu[i + k * n] != 0.0) psa_axpy(count, -lu[i + k * n], b + k * count, b + i * count);
    for (int k = n - 1; k >= 0; --k) {
        const double inverse = 1.0 / lu[k + k * n];
        for (int c = 0; c < count; ++c) b[k * count + c] *= inverse;
        for (int i = 0; i < k; ++i)
            if (lu[i + k * n] != 0.0) psa_axpy(count, -lu[i + k * n], b + k * count, b + i * count);
    }
}
