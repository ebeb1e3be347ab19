/* The start of the importer on Windows and its printing, on the universal C runtime alone: with the C
   library of MinGW-w64 the compiler would take a minute to make that library. */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>

int _configure_narrow_argv(int mode);
int main(int argc, char *argv[]);
void mainCRTStartup(void);
void __main(void);

/* Clang calls it at the begin of main, for the constructors of C++. */
void __main(void) {}

void mainCRTStartup(void) {
    _configure_narrow_argv(1);
    exit(main(*__p___argc(), *__p___argv()));
}

int fprintf(FILE *file, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    const int written = __stdio_common_vfprintf(0, file, format, NULL, arguments);
    va_end(arguments);
    return written;
}

int printf(const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    const int written = __stdio_common_vfprintf(0, stdout, format, NULL, arguments);
    va_end(arguments);
    return written;
}
