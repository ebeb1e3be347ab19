/* The FMI 3.0 face, continued: clocks, of which the model has none. The functions exist because
   importers look them up. */
#include "fmi3_face.h"

static fmi3Status no_clocks(psa_instance *core, size_t nvr, const char *name) {
    if (nvr == 0) return fmi3OK;
    return psa_fmi3_status(psa_say(core, PSA_ERROR, "%s: the model has no clocks.", name));
}

fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference vr[], size_t nvr,
                        fmi3Clock value[]) {
    ENTER(PSA_CALL_GET);
    (void)vr, (void)value;
    return no_clocks(core, nvr, __func__);
}

fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference vr[], size_t nvr,
                        const fmi3Clock value[]) {
    ENTER(PSA_CALL_SET);
    (void)vr, (void)value;
    return no_clocks(core, nvr, __func__);
}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance instance, const fmi3ValueReference vr[], size_t nvr,
                                  fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[]) {
    ENTER(PSA_CALL_GET);
    (void)vr, (void)intervals, (void)qualifiers;
    return no_clocks(core, nvr, __func__);
}

fmi3Status fmi3GetIntervalFraction(fmi3Instance instance, const fmi3ValueReference vr[], size_t nvr,
                                   fmi3UInt64 counters[], fmi3UInt64 resolutions[],
                                   fmi3IntervalQualifier qualifiers[]) {
    ENTER(PSA_CALL_GET);
    (void)vr, (void)counters, (void)resolutions, (void)qualifiers;
    return no_clocks(core, nvr, __func__);
}

/* Shifts in seconds, and the intervals that an importer gives. */
#define SECONDS(function, call, type)                                                             \
    fmi3Status function(fmi3Instance instance, const fmi3ValueReference vr[], size_t nvr,         \
                        type seconds[]) {                                                         \
        ENTER(call);                                                                              \
        (void)vr, (void)seconds;                                                                  \
        return no_clocks(core, nvr, __func__);                                                    \
    }
SECONDS(fmi3GetShiftDecimal, PSA_CALL_GET, fmi3Float64)
SECONDS(fmi3SetShiftDecimal, PSA_CALL_SET, const fmi3Float64)
SECONDS(fmi3SetIntervalDecimal, PSA_CALL_SET, const fmi3Float64)

/* The same as fractions. */
#define FRACTIONS(function, call, type)                                                           \
    fmi3Status function(fmi3Instance instance, const fmi3ValueReference vr[], size_t nvr,         \
                        type counters[], type resolutions[]) {                                    \
        ENTER(call);                                                                              \
        (void)vr, (void)counters, (void)resolutions;                                              \
        return no_clocks(core, nvr, __func__);                                                    \
    }
FRACTIONS(fmi3GetShiftFraction, PSA_CALL_GET, fmi3UInt64)
FRACTIONS(fmi3SetShiftFraction, PSA_CALL_SET, const fmi3UInt64)
FRACTIONS(fmi3SetIntervalFraction, PSA_CALL_SET, const fmi3UInt64)

fmi3Status fmi3ActivateModelPartition(fmi3Instance instance, fmi3ValueReference clock,
                                      fmi3Float64 time) {
    ENTER(PSA_CALL_ANY);
    (void)clock, (void)time;
    return no_clocks(core, 1, __func__);
}
