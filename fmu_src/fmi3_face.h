/* What the files of the FMI 3.0 face share. A component starts with its core (see fmi3.c). */
#ifndef PSA_FMI3_FACE_H
#define PSA_FMI3_FACE_H

/* the standard's headers declare two callbacks without a prototype */
#if defined(__GNUC__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wstrict-prototypes"
#endif
#include "fmi3Functions.h"
#if defined(__GNUC__)
#pragma GCC diagnostic pop
#endif
#include "instance.h"

typedef struct {
    psa_instance core; /* first, so that a component is a core too */
    fmi3LogMessageCallback logger;
    fmi3IntermediateUpdateCallback update;
    fmi3InstanceEnvironment environment;
    int event_mode_used, early_return_allowed;
    char name[]; /* copy of the instance name */
} psa_component3;

/* Find the core and leave with an error if the call is not allowed now. */
#define ENTER(call)                      \
    psa_instance *const core = instance; \
    if (!psa_admit(core, call, __func__)) return fmi3Error

/* Leave a call by moving on to another state of the state machine. */
#define MOVE_TO(next) return core->state.phase = (next), fmi3OK

static inline fmi3Status psa_fmi3_status(psa_result result) {
    static const fmi3Status table[] = {fmi3OK, fmi3Warning, fmi3Discard, fmi3Error};
    return table[result];
}

#endif
