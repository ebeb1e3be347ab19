#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#include "instance.h"

static void say(psa_instance *instance, psa_result result, const char *format, va_list arguments) {
    char sentence[PSA_SENTENCE];
    if (!instance->report) return;
    vsnprintf(sentence, sizeof sentence, format, arguments);
    instance->report(instance->owner, result, sentence);
}

psa_result psa_say(psa_instance *instance, psa_result result, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    say(instance, result, format, arguments);
    va_end(arguments);
    return result;
}

void psa_whisper(psa_instance *instance, const char *format, ...) {
    va_list arguments;
    if (!instance->debug) return; /* to write the sentence takes a third of a microsecond */
    va_start(arguments, format);
    say(instance, PSA_FINE, format, arguments);
    va_end(arguments);
}

int psa_lacks(psa_instance *instance, size_t count, const void *first, const void *second) {
    if (count == 0 || (first && second)) return 0;
    psa_say(instance, PSA_ERROR, "An array of %lu elements is expected, but a null pointer was passed.",
            (unsigned long)count);
    return 1;
}

const char *psa_log_category(psa_result severity) {
    switch (severity) {
    case PSA_FINE: return "logSolver";
    case PSA_WARNING: return "logStatusWarning";
    case PSA_DISCARD: return "logStatusDiscard";
    default: return "logStatusError";
    }
}

psa_result psa_choose_log(psa_instance *instance, int on, size_t count, const char *const *categories) {
    int solver = count == 0;
    if (psa_lacks(instance, count, categories, categories)) return PSA_ERROR;
    for (size_t i = 0; i < count; ++i) {
        int known = 0;
        for (int result = PSA_FINE; result <= PSA_ERROR; ++result)
            known |= categories[i] && !strcmp(categories[i], psa_log_category((psa_result)result));
        if (!known)
            return psa_say(instance, PSA_ERROR, "There is no log category '%s'.",
                           categories[i] ? categories[i] : "(null)");
        solver |= !strcmp(categories[i], psa_log_category(PSA_FINE));
    }
    if (solver) instance->debug = on;
    return PSA_FINE;
}
