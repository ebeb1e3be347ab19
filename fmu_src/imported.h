/* What the Python side gives `imported.c` of an FMU: its functions, variables and their sizes. */
#ifndef PSA_IMPORTED_H
#define PSA_IMPORTED_H

#include <stddef.h>

#if defined(_WIN32)
#define PSA_API __declspec(dllexport)
#else
#define PSA_API __attribute__((visibility("default")))
#endif

/* Step of a central difference over the size of what moves: cbrt(2^-52). */
#define PSA_STEP 6.055454452393343e-06

typedef struct {
    int version; /* 2 or 3: that of FMI */
    int (*set_time)(void *, double);
    int (*set_states)(void *, const double *, size_t);
    int (*get_rates)(void *, double *, size_t);
    int (*set_real2)(void *, const unsigned *, size_t, const double *);
    int (*set_real3)(void *, const unsigned *, size_t, const double *, size_t);
    int (*get_real2)(void *, const unsigned *, size_t, double *);
    int (*get_real3)(void *, const unsigned *, size_t, double *, size_t);
    /* fmi2GetDirectionalDerivative or fmi3GetDirectionalDerivative; NULL without it */
    int (*slope2)(void *, const unsigned *, size_t, const unsigned *, size_t, const double *,
                  double *);
    int (*slope3)(void *, const unsigned *, size_t, const unsigned *, size_t, const double *, size_t,
                  double *, size_t);
    /* returns the instance of a slot and a place, initialised with the parameters; NULL if it fails */
    void *(*prepare)(int slot, int place, const double *p);
    const unsigned *inputs; /* value references of the inputs */
    const unsigned *shown;  /* of the rates, then of the outputs */
    const unsigned *known;  /* of the states, then of the inputs */
    const double *sizes;    /* usual sizes of states, inputs and parameters */
} psa_imported;

PSA_API void psa_import(const psa_imported *given);

#endif
