/* Runs the binary of an FMU on the platform that this program was compiled for: no Python, no archive.

   host FMI LIBRARY TOKEN STEP FIRST LAST STATE_IN STATE_OUT INPUT OUTPUT...

   FMI is 2 or 3, TOKEN the one in modelDescription.xml, INPUT and OUTPUT are value references. Steps
   FIRST to LAST - 1 of STEP seconds are made and the outputs after each are printed. STATE_IN is a file
   to continue from and STATE_OUT one to leave the state in; a minus sign stands for none. Compiled with
   HOST_LINKED and the sources of an FMU, it runs those instead; FMI and LIBRARY are then not looked at. */
#include "host.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define MOST_OUTPUTS 16
#define MOST_BYTES (1 << 20)

static int fail(const char *what) {
    fprintf(stderr, "host: %s failed\n", what);
    return 1;
}

#if defined(HOST_LINKED)
static int open_library(const char *path) {
    (void)path;
    return 1;
}

#if HOST_LINKED == 2
#define FACE(version) ((void)(version), &host_fmi2)
#else
#define FACE(version) ((void)(version), &host_fmi3)
#endif
#else
#if defined(_WIN32)
#include <windows.h>
static HMODULE library;
#else
#include <dlfcn.h>
static void *library;
#endif

static int open_library(const char *path) {
#if defined(_WIN32)
    library = LoadLibraryA(path);
    if (!library) fprintf(stderr, "host: LoadLibrary: error %lu\n", (unsigned long)GetLastError());
#else
    library = dlopen(path, RTLD_NOW | RTLD_LOCAL);
    if (!library) fprintf(stderr, "host: %s\n", dlerror());
#endif
    return library != NULL;
}

host_function *host_find(const char *name) {
    host_function *found;
#if defined(_WIN32)
    const FARPROC address = GetProcAddress(library, name);
#else
    void *const address = dlsym(library, name);
#endif
    if (!address) {
        fprintf(stderr, "host: the library has no function %s\n", name);
        exit(3);
    }
    memcpy(&found, &address, sizeof found); /* ISO C has no cast from object to function */
    return found;
}

#define FACE(version) ((version) == 3 ? &host_fmi3 : &host_fmi2)
#endif

/* 40 V + 40 V sin at 32 steps to a period, and 15 V more from step 75 on. The sine is a rotation by
   exact multiplications and additions, so that every platform's input has the same bits. */
static double voltage(int step) {
    const double cosine = 0.98078528040323043, sine = 0.19509032201612825;
    double x = 1.0, y = 0.0;
    for (int i = 0; i < step; ++i) {
        const double turned = cosine * x - sine * y;
        y = sine * x + cosine * y;
        x = turned;
    }
    return 40.0 + 40.0 * y + (step >= 75 ? 15.0 : 0.0);
}

static int load(const host_face *face, const char *path, char *bytes) {
    FILE *const file = fopen(path, "rb");
    if (!file) return 0;
    const size_t size = fread(bytes, 1, MOST_BYTES, file);
    fclose(file);
    return face->load(bytes, size);
}

static int save(const host_face *face, const char *path, char *bytes) {
    size_t size = 0;
    if (!face->save(bytes, MOST_BYTES, &size)) return 0;
    FILE *const file = fopen(path, "wb");
    if (!file) return 0;
    const size_t written = fwrite(bytes, 1, size, file);
    return fclose(file) == 0 && written == size;
}

static int run(const host_face *face, char *arguments[], size_t outputs) {
    static char bytes[MOST_BYTES];
    const double size = strtod(arguments[0], NULL);
    const int first = atoi(arguments[1]), last = atoi(arguments[2]);
    const unsigned input = (unsigned)strtoul(arguments[5], NULL, 10);
    unsigned references[MOST_OUTPUTS];
    double values[MOST_OUTPUTS];
    for (size_t i = 0; i < outputs; ++i)
        references[i] = (unsigned)strtoul(arguments[6 + i], NULL, 10);
    if (strcmp(arguments[3], "-") && !load(face, arguments[3], bytes)) return fail("loading the state");
    for (int k = first; k < last; ++k) {
        if (!face->set(input, voltage(k))) return fail("setting the input");
        if (!face->step(k * size, size)) return fail("a step");
        if (!face->get(references, outputs, values)) return fail("reading the outputs");
        for (size_t i = 0; i < outputs; ++i)
            printf("%.17g%c", values[i], i + 1 < outputs ? ' ' : '\n');
    }
    if (strcmp(arguments[4], "-") && !save(face, arguments[4], bytes)) return fail("saving the state");
    return 0;
}

int main(int argc, char *argv[]) {
    if (argc < 11 || argc > 10 + MOST_OUTPUTS) {
        fprintf(stderr, "usage: host FMI LIBRARY TOKEN STEP FIRST LAST STATE_IN STATE_OUT INPUT OUTPUT...\n");
        return 2;
    }
    const host_face *const face = FACE(atoi(argv[1]));
    if (!open_library(argv[2])) return fail("loading the library");
    if (!face->open(argv[3])) return fail("instantiation");
    const int status = run(face, argv + 4, (size_t)(argc - 10));
    return face->close() ? status : fail("the end");
}
