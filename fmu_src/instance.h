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
    PSA_TERMINATED = 64,
    PSA_INTERMEDIATE = 128 /* between two solver steps of a communication step */
} psa_phase;

/* Kinds of calls; the table in instance.c says in which phases each is allowed. */
typedef enum {
    PSA_CALL_ANY,
    PSA_CALL_LOG,
    PSA_CALL_SETUP,
    PSA_CALL_INITIALIZE,
    PSA_CALL_INITIALIZED,
    PSA_CALL_TERMINATE,
    PSA_CALL_GET,
    PSA_CALL_SET,
    PSA_CALL_DIRECTIONAL,
    PSA_CALL_ENTER_EVENT,
    PSA_CALL_ENTER_EVENT3, /* FMI 3: from step mode too */
    PSA_CALL_EVENT_UPDATE,
    PSA_CALL_EVALUATE_DISCRETE,
    PSA_CALL_ENTER_CONTINUOUS,
    PSA_CALL_ENTER_STEP,
    PSA_CALL_SET_TIME,
    PSA_CALL_CONTINUOUS,
    PSA_CALL_READ_DERIVATIVES,
    PSA_CALL_READ_NOMINALS,
    PSA_CALL_COUNT_VECTORS,
    PSA_CALL_SET_RATES,
    PSA_CALL_READ_RATES,
    PSA_CALL_STEP,
    PSA_CALL_CANCEL,
    PSA_CALL_STATUS,
    PSA_CALL_COUNT
} psa_call;

/* What the last communication step started from, enough to repeat it bit by bit. */
typedef enum {
    PSA_NO_STEP = 0,
    PSA_STEP_KNOWN = 1,
    PSA_STEP_VARIED = 2, /* the importer changed inputs or the end within the step */
    PSA_STEP_BROKEN = 3, /* it failed */
    PSA_STEP_SAMPLED = 4 /* a sample instant fell into it */
} psa_step_kind;

/* What a model exchange was asked for at the time at which its inputs were given last. */
typedef enum { PSA_ASKED_NOTHING, PSA_ASKED_INDICATORS, PSA_ASKED_RATES } psa_asked;

typedef struct {
    psa_solver solver;
    psa_input input;
    double p[PSA_HELD + 1];
    psa_end end;  /* that the importer asked for */
    int64_t kind; /* psa_step_kind */
} psa_last_step;

/* Everything that a snapshot must hold: a plain struct without pointers. Each member has eight bytes or
   is made of such, so that no platform puts gaps between them. */
typedef struct {
    psa_solver solver; /* time and continuous states live here, in model exchange too */
    psa_input input;
    double p[PSA_HELD + 1];
    psa_last_step last;
    int64_t rate_given[PSA_NU + 1]; /* the importer gave this input's rate for the next step */
    /* The option input_line: this share of the slope between the last two values that an input was
       given goes on over a step (0: inputs are held). A step does not change what was given. In model
       exchange the last two are those that were set at different times; see follow_line. */
    double line;
    double given[PSA_NU + 1];   /* last */
    double earlier[PSA_NU + 1]; /* that the last step started with; in model exchange the ones before */
    double stride;              /* time between both; 0: there are none, or an event came after them */
    double given_at;            /* in model exchange: the time of the last */
    int64_t asked;              /* psa_asked */
    /* The parameter start_voltage; what was set by itself before the first step, and so does not follow
       it; whether the states of now are older than what they follow from. */
    double start_voltage;
    int64_t own_start[PSA_NX + 1], voltage_given, start_due;
    /* An event indicator is facing * switch + margin. Facing changes its sign at an event, so that the
       noise of an importer's solver about a held input makes no further ones. */
    double facing[PSA_NZ + 1];
    double event_margin; /* share of psa_switch_scales */
    /* Sampled states: while the present time is an instant, those in p follow from those before it and
       from the inputs of now, which an importer may still set. They are kept when time moves on. */
    double before[PSA_NS + 1];
    double next_instant; /* the first one that has not been reached */
    int64_t at_instant;
    double stop_time;
    int64_t stop_defined;
    int64_t phase;     /* psa_phase */
    int64_t interface; /* psa_interface */
} psa_state;

#define PSA_SENTENCE 512 /* bytes of the longest one that an instance says, with its end */

/* Receives a sentence. */
typedef void psa_reporter(void *owner, psa_result severity, const char *sentence);

/* Called between two solver steps of a communication step. `more` is 0 at its end. Returns 1 to end the
   communication step earlier, at the time written to `end`. */
typedef int psa_update(void *owner, double time, int more, double *end);

#define PSA_DIRECTIONS 8 /* at most so many of a step's sensitivities at once */

/* One number for each variable that can be known: a direction, or a gradient. */
typedef struct {
    double t, x[PSA_NX + 1], u[PSA_NU + 1], p[PSA_HELD + 1];
    double start, option; /* start_voltage until the initialization ends; options of no effect */
} psa_knowns;

/* One number for each variable that can be unknown: a change, or a weight. */
typedef struct {
    double xdot[PSA_NX + 1], y[PSA_NY + 1], z[PSA_NZ + 1];
    double x[PSA_NX + 1]; /* states at the end of the last step */
    int through_step;     /* 1: one of them is asked for, 2: they are known, too */
} psa_unknowns;

/* Numbers of one call for derivatives, or for a settled start; nothing in here is needed after it. */
typedef struct {
    double w[PSA_DERIVATIVES_SZ_W];
    psa_knowns in, along[PSA_DIRECTIONS];
    psa_unknowns out;
    psa_solver solver;
    double moved[PSA_NX * PSA_DIRECTIONS], slope[PSA_NX * PSA_DIRECTIONS], base[PSA_NX * PSA_DIRECTIONS];
    double stage[PSA_STAGES * PSA_NX * PSA_DIRECTIONS], f[PSA_NX + 1];
} psa_calculus;

typedef struct {
    psa_state state;
    psa_work work;
    psa_calculus calculus;
    double xdot[PSA_NX + 1], y[PSA_NY + 1], z[PSA_NZ + 1]; /* valid while `fresh` */
    int fresh;
    psa_update *update; /* during a communication step; may be NULL */
    psa_end goal;       /* end of that step */
    double start_time;
    int outside_told;     /* that the instance has left what the records have shown */
    int limit_told;       /* that the voltage is limited, with a fixed step */
    int debug;            /* what only debug logging shows is reported too */
    psa_reporter *report; /* may be NULL */
    void *owner;
} psa_instance;

/* log.c: what an instance says */
/* Report a sentence (printf format) and return `result`. */
psa_result psa_say(psa_instance *instance, psa_result result, const char *format, ...);
/* The same for what only debug logging shows. */
void psa_whisper(psa_instance *instance, const char *format, ...);
/* Report a missing array: 1 if count > 0 and a pointer is NULL. */
int psa_lacks(psa_instance *instance, size_t count, const void *first, const void *second);
/* Log category of a severity, and the choice of categories: debug logging is that of the solver. */
const char *psa_log_category(psa_result severity);
psa_result psa_choose_log(psa_instance *instance, int on, size_t count, const char *const *categories);

/* instance.c: life cycle and steps */
void psa_instance_start(psa_instance *instance, psa_interface interface);
/* 1 if the call is allowed now, else 0 and a report. `instance` may be NULL. */
int psa_admit(psa_instance *instance, psa_call call, const char *name);
/* Tolerance of a solver step, from that of the trajectory. */
double psa_step_tolerance(double tolerance);
psa_result psa_setup(psa_instance *instance, int tolerance_defined, double tolerance, double start,
                     int stop_defined, double stop);
/* One communication step; `early` is set if `update`, which may be NULL, ended it before its time. */
psa_result psa_do_step(psa_instance *instance, double point, double size, psa_update *update,
                       int *early);
/* Why an instance of this name and token cannot be made, or NULL. */
const char *psa_objection(const char *name, const char *token);

/* start.c: the parameter start_voltage, until the initialization ends */
/* Bring the states to what it makes them, where they are older. */
psa_result psa_begin(psa_instance *instance);
/* Change of states and inputs by it [1/V], of those that follow it: by differences of two settled starts. */
psa_result psa_start_slope(psa_instance *instance, double *x, double *u);
/* Set it; the voltage follows it unless that was set by itself. */
void psa_start_at(psa_instance *instance, double voltage);
/* Another variable was set. */
void psa_start_changed(psa_instance *instance, const psa_variable *v);

/* sampling.c: sampled states between their instants. In co-simulation the instant at a communication
   point belongs to the step that starts there, and outputs are read as if it had happened. */
/* 1 and a report if a double cannot count sample periods up to a time. */
int psa_beyond_counting(psa_instance *instance, double time, double period);
/* The present time is where the instance starts; the period may have changed. */
void psa_schedule(psa_instance *instance);
/* The present time is an instant if the next one has been reached. */
void psa_arrive(psa_instance *instance);
/* Put the sampled states to their values after an instant at the present time, if it is one. */
psa_result psa_sample_now(psa_instance *instance);
/* Time moves on from here. */
psa_result psa_leave_instant(psa_instance *instance);
/* An instant within a communication step. */
psa_result psa_sample_within(psa_instance *instance);
/* Enter event mode, or continuous-time mode. */
void psa_enter_event(psa_instance *instance);
psa_result psa_enter_continuous(psa_instance *instance);
/* 1 and the time of the next instant, or 0 if the model has none. */
int psa_next_event(const psa_instance *instance, double *time);

/* values.c: variables by value reference, vectors of model exchange, rates */
/* The variable of a value reference, or NULL and a report. */
const psa_variable *psa_variable_of(psa_instance *instance, unsigned vr);
/* Evaluate derivatives, outputs and indicators at the present time, states, inputs and parameters. */
psa_result psa_refresh(psa_instance *instance);
psa_result psa_get(psa_instance *instance, const unsigned *vr, size_t count, double *value);
psa_result psa_set(psa_instance *instance, const unsigned *vr, size_t count, const double *value);
psa_result psa_set_time(psa_instance *instance, double time);
psa_result psa_set_states(psa_instance *instance, const double *x, size_t count);
psa_result psa_get_states(psa_instance *instance, double *x, size_t count);
psa_result psa_get_derivatives(psa_instance *instance, double *xdot, size_t count);
psa_result psa_get_indicators(psa_instance *instance, double *z, size_t count);
/* The event update: switches that have passed their margin face the other way from now on. */
psa_result psa_update_events(psa_instance *instance);
psa_result psa_get_nominals(psa_instance *instance, double *nominal, size_t count);
psa_result psa_set_input_rates(psa_instance *instance, const unsigned *vr, size_t count,
                               const int *order, const double *rate);
psa_result psa_get_output_rates(psa_instance *instance, const unsigned *vr, size_t count,
                                const int *order, double *rate);

/* validity.c: say, once, that inputs u, their rates (may be NULL) or the time since the start are outside
   of what the records behind the model have shown */
void psa_watch_range(psa_instance *instance, const double *u, const double *rate);

/* derivatives.c: products of a matrix of derivatives with a seed. What is unknown decides which matrix:

   - an output, a derivative or an event indicator: its partial derivatives at the present time, states,
     inputs and parameters, in both interfaces. That is the meaning FMI gives to these functions;
   - a state, in co-simulation only (FMI knows no such pair): its sensitivity through the last
     communication step. Then a known state is the one at the start of the step, a known input the one
     held over it (its rate stays), a known parameter that of the step, a known time that of its start at
     the same length. The discrete equations of the solver are differentiated at the steps it took, so
     the result is exact for the numbers it returned. Before any step, that of a step of no length.

   Chained, the two give the sensitivity of outputs through a step. */
psa_result psa_directional_derivative(psa_instance *instance, const unsigned *unknown,
                                      size_t unknowns, const unsigned *known, size_t knowns,
                                      const double *seed, double *sensitivity);
psa_result psa_adjoint_derivative(psa_instance *instance, const unsigned *unknown, size_t unknowns,
                                  const unsigned *known, size_t knowns, const double *seed,
                                  double *sensitivity);

/* step_derivatives.c */
/* Change of the states at the end of the last communication step along each direction: moved is
   [PSA_NX][count]. */
psa_result psa_step_sensitivity(psa_instance *instance, int count, const psa_knowns *directions,
                                double *moved);

/* snapshot_fault.c: why bytes that look like a state cannot be one, or NULL: which part is impossible.
   Nothing in a state without a fault crashes a call or keeps it busy. */
const char *psa_state_fault(const psa_state *state);

/* snapshot.c: the state of an instance, in memory and as bytes */
psa_result psa_snapshot_take(psa_instance *instance, void **snapshot);
psa_result psa_snapshot_restore(psa_instance *instance, const void *snapshot);
void psa_snapshot_release(void **snapshot);
size_t psa_snapshot_size(void);
psa_result psa_snapshot_write(psa_instance *instance, const void *snapshot, void *bytes, size_t size);
psa_result psa_snapshot_read(psa_instance *instance, const void *bytes, size_t size, void **snapshot);

#endif
