/* What a library for Windows needs beside the functions of the universal C runtime, which Windows has:
   an entry point that does nothing, as no file here has anything to be done before main, and vsnprintf,
   which that runtime has under another name. With it the C library of MinGW-w64 is not compiled. */
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>

int __stdcall DllMainCRTStartup(void *library, unsigned long reason, void *reserved);
int __stdcall _DllMainCRTStartup(void *library, unsigned long reason, void *reserved);

int __stdcall DllMainCRTStartup(void *library, unsigned long reason, void *reserved) {
    (void)library;
    (void)reason;
    (void)reserved;
    return 1;
}

/* The name that earlier versions of the compiler look for. */
int __stdcall _DllMainCRTStartup(void *library, unsigned long reason, void *reserved) {
    return DllMainCRTStartup(library, reason, reserved);
}

/* The option 2 is the return value of C99: the length that the whole text has. */
int vsnprintf(char *text, size_t size, const char *format, va_list arguments) {
    return __stdio_common_vsprintf(2, text, size, format, NULL, arguments);
}
