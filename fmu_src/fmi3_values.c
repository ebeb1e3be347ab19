/* The FMI 3.0 face, continued: values and derivatives by value reference. All variables are scalars of
   type Float64. */
#include "fmi3_face.h"

/* 1 and a report if the number of values is not that of the scalars asked for. */
static int miscounted(psa_instance *core, size_t variables, size_t values) {
    if (variables == values) return 0;
    psa_say(core, PSA_ERROR,
            "%lu variables cannot exchange %lu values; all variables of this model are scalars.",
            (unsigned long)variables, (unsigned long)values);
    return 1;
}

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference vr[], size_t nvr,
                          fmi3Float64 value[], size_t nvalues) {
    ENTER(PSA_CALL_GET);
    if (miscounted(core, nvr, nvalues)) return fmi3Error;
    return psa_fmi3_status(psa_get(core, vr, nvr, value));
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference vr[], size_t nvr,
                          const fmi3Float64 value[], size_t nvalues) {
    ENTER(PSA_CALL_SET);
    if (miscounted(core, nvr, nvalues)) return fmi3Error;
    return psa_fmi3_status(psa_set(core, vr, nvr, value));
}

static fmi3Status other_type(psa_instance *core, size_t nvr, const char *name) {
    if (nvr == 0) return fmi3OK;
    return psa_fmi3_status(psa_say(core, PSA_ERROR, "%s: all variables are of type Float64.", name));
}

/* Other types are fine only where none is asked for. */
#define OTHER_TYPE(function, call, type)                                                          \
    fmi3Status function(fmi3Instance instance, const fmi3ValueReference vr[], size_t nvr,         \
                        type value[], size_t nvalues) {                                           \
        ENTER(call);                                                                              \
        (void)vr, (void)value, (void)nvalues;                                                     \
        return other_type(core, nvr, __func__);                                                   \
    }
OTHER_TYPE(fmi3GetFloat32, PSA_CALL_GET, fmi3Float32)
OTHER_TYPE(fmi3GetInt8, PSA_CALL_GET, fmi3Int8)
OTHER_TYPE(fmi3GetUInt8, PSA_CALL_GET, fmi3UInt8)
OTHER_TYPE(fmi3GetInt16, PSA_CALL_GET, fmi3Int16)
OTHER_TYPE(fmi3GetUInt16, PSA_CALL_GET, fmi3UInt16)
OTHER_TYPE(fmi3GetInt32, PSA_CALL_GET, fmi3Int32)
OTHER_TYPE(fmi3GetUInt32, PSA_CALL_GET, fmi3UInt32)
OTHER_TYPE(fmi3GetInt64, PSA_CALL_GET, fmi3Int64)
OTHER_TYPE(fmi3GetUInt64, PSA_CALL_GET, fmi3UInt64)
OTHER_TYPE(fmi3GetBoolean, PSA_CALL_GET, fmi3Boolean)
OTHER_TYPE(fmi3GetString, PSA_CALL_GET, fmi3String)
OTHER_TYPE(fmi3SetFloat32, PSA_CALL_SET, const fmi3Float32)
OTHER_TYPE(fmi3SetInt8, PSA_CALL_SET, const fmi3Int8)
OTHER_TYPE(fmi3SetUInt8, PSA_CALL_SET, const fmi3UInt8)
OTHER_TYPE(fmi3SetInt16, PSA_CALL_SET, const fmi3Int16)
OTHER_TYPE(fmi3SetUInt16, PSA_CALL_SET, const fmi3UInt16)
OTHER_TYPE(fmi3SetInt32, PSA_CALL_SET, const fmi3Int32)
OTHER_TYPE(fmi3SetUInt32, PSA_CALL_SET, const fmi3UInt32)
OTHER_TYPE(fmi3SetInt64, PSA_CALL_SET, const fmi3Int64)
OTHER_TYPE(fmi3SetUInt64, PSA_CALL_SET, const fmi3UInt64)
OTHER_TYPE(fmi3SetBoolean, PSA_CALL_SET, const fmi3Boolean)
OTHER_TYPE(fmi3SetString, PSA_CALL_SET, const fmi3String)

fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference vr[], size_t nvr,
                         size_t sizes[], fmi3Binary value[], size_t nvalues) {
    ENTER(PSA_CALL_GET);
    (void)vr, (void)sizes, (void)value, (void)nvalues;
    return other_type(core, nvr, __func__);
}

fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference vr[], size_t nvr,
                         const size_t sizes[], const fmi3Binary value[], size_t nvalues) {
    ENTER(PSA_CALL_SET);
    (void)vr, (void)sizes, (void)value, (void)nvalues;
    return other_type(core, nvr, __func__);
}

/* Dependencies do not differ between the elements of scalars. */
static fmi3Status in_the_description(psa_instance *core, const char *name) {
    return psa_fmi3_status(psa_say(core, PSA_ERROR,
                                   "%s: the dependencies are those in modelDescription.xml; none differs by"
                                   " element.",
                                   name));
}

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance instance, fmi3ValueReference vr,
                                               size_t *count) {
    ENTER(PSA_CALL_ANY);
    (void)vr, (void)count;
    return in_the_description(core, __func__);
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance instance, fmi3ValueReference dependent,
                                       size_t dependent_elements[], fmi3ValueReference independents[],
                                       size_t independent_elements[], fmi3DependencyKind kinds[],
                                       size_t count) {
    ENTER(PSA_CALL_ANY);
    (void)dependent, (void)dependent_elements, (void)independents, (void)independent_elements;
    (void)kinds, (void)count;
    return in_the_description(core, __func__);
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[],
                                        size_t nunknowns, const fmi3ValueReference knowns[],
                                        size_t nknowns, const fmi3Float64 seed[], size_t nseed,
                                        fmi3Float64 sensitivity[], size_t nsensitivity) {
    ENTER(PSA_CALL_DIRECTIONAL);
    if (miscounted(core, nknowns, nseed) || miscounted(core, nunknowns, nsensitivity)) return fmi3Error;
    return psa_fmi3_status(psa_directional_derivative(core, unknowns, nunknowns, knowns, nknowns, seed,
                                                      sensitivity));
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[],
                                    size_t nunknowns, const fmi3ValueReference knowns[],
                                    size_t nknowns, const fmi3Float64 seed[], size_t nseed,
                                    fmi3Float64 sensitivity[], size_t nsensitivity) {
    ENTER(PSA_CALL_DIRECTIONAL);
    if (miscounted(core, nunknowns, nseed) || miscounted(core, nknowns, nsensitivity)) return fmi3Error;
    return psa_fmi3_status(psa_adjoint_derivative(core, unknowns, nunknowns, knowns, nknowns, seed,
                                                  sensitivity));
}
