/* One instance of the model behind an FMI face: its life cycle, values, steps and snapshots. Knows no
   FMI header, so that the FMI 2 and FMI 3 faces stay thin. Nothing is static and mutable, nothing is
   allocated here after the face has allocated the instance, except snapshots that an importer asks for. */
#ifndef PSA_INSTANCE_H
#define PSA_INSTANCE_H

#include <stddef.h>

#include "fmi_data.h"
#include "solver.h"

typedef enum { PSA_FINE = 0, PSA_WARNING = 1, PSA_DISCARD = 2, PSA_ERROR = 3 } psa_result;

typedef enum { PSA_MODEL_EXCHANGE = 0, PSA_CO_SIMULATION = 1 } psa_interface;

/* States of the FMI state machine; bits, so that a set of them is a mask. */
typedef enum {
    PSA_INSTANTIATED = 1,
    PSA_INITIALIZATION = 2,
    PSA_EVENT = 4,
    PSA_CONTINUOUS = 8,
    PSA_STEP_COMPLETE = 16,
    PSA_STEP_FAILED = 32,
    PSA_TERMINATED = 64
} psa_phase;

/* Kinds of calls; the table in instance.c says in which phases each is allowed. */
typedef enum {
    PSA_CALL_ANY,
    PSA_CALL_SETUP,
    PSA_CALL_INITIALIZE,
    PSA_CALL_INITIALIZED,
    PSA_CALL_TERMINATE,
    PSA_CALL_GET,
    PSA_CALL_SET,
    PSA_CALL_DIRECTIONAL,
    PSA_CALL_ENTER_EVENT,
    PSA_CALL_EVENT_UPDATE,
    PSA_CALL_SET_TIME,
    PSA_CALL_CONTINUOUS,
    PSA_CALL_READ_DERIVATIVES,
    PSA_CALL_READ_NOMINALS,
    PSA_CALL_SET_RATES,
    PSA_CALL_READ_RATES,
    PSA_CALL_STEP,
    PSA_CALL_CANCEL,
    PSA_CALL_STATUS,
    PSA_CALL_COUNT
} psa_call;

/* Everything that a snapshot must hold: a plain struct without pointers. */
typedef struct {
    psa_solver solver; /* time and continuous states live here, in model exchange too */
    psa_input input;
    double p[PSA_NP + 1];
    int rate_given[PSA_NU + 1]; /* the importer gave this input's rate for the next step */
    double stop_time;
    int stop_defined;
    int phase;     /* psa_phase */
    int interface; /* psa_interface */
} psa_state;

/* Receives a sentence; `detail` is 1 for what only debug logging shows. */
typedef void psa_reporter(void *owner, psa_result severity, int detail, const char *sentence);

typedef struct {
    psa_state state;
    double xdot[PSA_NX + 1], y[PSA_NY + 1]; /* valid while `fresh` */
    int fresh;
    psa_reporter *report; /* may be NULL */
    void *owner;
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *memory);
} psa_instance;

/* instance.c: life cycle and steps */
void psa_instance_start(psa_instance *instance, psa_interface interface);
/* 1 if the call is allowed now, else 0 and a report. `instance` may be NULL. */
int psa_admit(psa_instance *instance, psa_call call, const char *name);
/* Report a sentence (printf format) and return `result`. */
psa_result psa_say(psa_instance *instance, psa_result result, const char *format, ...);
/* Report a missing array: 1 if count > 0 and a pointer is NULL. */
int psa_lacks(psa_instance *instance, size_t count, const void *first, const void *second);
psa_result psa_setup(psa_instance *instance, int tolerance_defined, double tolerance, double start,
                     int stop_defined, double stop);
psa_result psa_do_step(psa_instance *instance, double point, double size);

/* values.c: variables by value reference, vectors of model exchange, derivatives */
psa_result psa_get(psa_instance *instance, const unsigned *vr, size_t count, double *value);
psa_result psa_set(psa_instance *instance, const unsigned *vr, size_t count, const double *value);
psa_result psa_set_time(psa_instance *instance, double time);
psa_result psa_set_states(psa_instance *instance, const double *x, size_t count);
psa_result psa_get_states(psa_instance *instance, double *x, size_t count);
psa_result psa_get_derivatives(psa_instance *instance, double *xdot, size_t count);
psa_result psa_get_nominals(psa_instance *instance, double *nominal, size_t count);
psa_result psa_set_input_rates(psa_instance *instance, const unsigned *vr, size_t count,
                               const int *order, const double *rate);
psa_result psa_get_output_rates(psa_instance *instance, const unsigned *vr, size_t count,
                                const int *order, double *rate);
psa_result psa_directional_derivative(psa_instance *instance, const unsigned *unknown,
                                      size_t unknowns, const unsigned *known, size_t knowns,
                                      const double *seed, double *sensitivity);

/* snapshot.c: the state of an instance, in memory and as bytes */
psa_result psa_snapshot_take(psa_instance *instance, void **snapshot);
psa_result psa_snapshot_restore(psa_instance *instance, const void *snapshot);
void psa_snapshot_release(psa_instance *instance, void **snapshot);
size_t psa_snapshot_size(void);
psa_result psa_snapshot_write(psa_instance *instance, const void *snapshot, char *bytes, size_t size);
psa_result psa_snapshot_read(psa_instance *instance, const char *bytes, size_t size, void **snapshot);

#endif
