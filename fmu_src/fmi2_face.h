/* What the files of the FMI 2.0 face share. A component starts with its core (see fmi2.c). */
#ifndef PSA_FMI2_FACE_H
#define PSA_FMI2_FACE_H

#include "fmi2Functions.h"
#include "instance.h"

/* Find the core and leave with an error if the call is not allowed now. */
#define ENTER(call)               \
    psa_instance *const core = c; \
    if (!psa_admit(core, call, __func__)) return fmi2Error

/* Leave a call by moving on to another state of the state machine. */
#define MOVE_TO(next) return core->state.phase = (next), fmi2OK

static inline fmi2Status psa_fmi2_status(psa_result result) {
    static const fmi2Status table[] = {fmi2OK, fmi2Warning, fmi2Discard, fmi2Error};
    return table[result];
}

#endif
