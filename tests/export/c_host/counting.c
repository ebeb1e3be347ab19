/* Counts the sentences that an FMU writes, where this stands in front of log.c. */
#include <stdarg.h>
#include <stdio.h>
__attribute__((visibility("default"))) int psa_sentences = 0;
static int counted(char *text, size_t size, const char *format, va_list arguments) {
    ++psa_sentences;
    return vsnprintf(text, size, format, arguments);
}
