#define _DEFAULT_SOURCE
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#define API __attribute__((visibility("default")))

static void note(pid_t pid)
{
    const char *place = getenv("PSA_TEST_PLACE");
    FILE *file = place ? fopen(place, "a") : NULL;
    if (file) { fprintf(file, "%d\n", (int)pid); fclose(file); }
}

static void do_deed(const char *deed)
{
    static const char text[] = "\n[\"end\"]\n{} \x1b[31m nonsense\n";
    if (!strcmp(deed, "exit")) exit(0);
    if (!strcmp(deed, "exit3")) { fprintf(stderr, "licence not found\n"); exit(3); }
    if (!strcmp(deed, "_exit")) _exit(0);
    if (!strcmp(deed, "abort")) abort();
    if (!strcmp(deed, "fault")) raise(SIGSEGV);
    if (!strcmp(deed, "hang")) { note(getpid()); for (;;) pause(); }
    if (!strcmp(deed, "child")) {
        pid_t pid = fork();
        if (!pid) for (;;) pause();
        note(pid);
        _exit(0);
    }
    if (!strcmp(deed, "memory"))
        for (;;) {
            char *block = malloc(1 << 24);
            if (!block) abort();
            memset(block, 1, 1 << 24);
            usleep(30000); /* memory is looked at from time to time */
        }
    if (!strcmp(deed, "print"))
        for (int k = 0; k < 100000; ++k) { puts(text); fputs(text, stderr); }
    if (!strcmp(deed, "write") || !strcmp(deed, "forge"))
        for (int k = 0; k < 64; ++k) if (write(k, text, sizeof text - 1) < 0) continue;
    if (!strcmp(deed, "write")) _exit(0);
    if (!strcmp(deed, "close"))
        for (int k = 0; k < 64; ++k) close(k);
}

static void at(const char *moment)
{
    const char *wanted = getenv("PSA_TEST_DEED");
    const size_t length = strlen(moment);
    if (wanted && !strncmp(wanted, moment, length) && wanted[length] == ':')
        do_deed(wanted + length + 1);
}

__attribute__((constructor)) static void loaded(void) { at("load"); }
__attribute__((destructor)) static void unloaded(void) { at("leave"); }
static int instance;
API void *fmi2Instantiate(void) { at("make"); return &instance; }
API void *fmi3InstantiateCoSimulation(void) { at("make"); return &instance; }
API void *fmi3InstantiateModelExchange(void) { return &instance; }
API int fmi2GetReal(void *c, const unsigned *v, size_t n, double *x)
{ (void)c; (void)v; while (n) x[--n] = 0.0; return 0; }
API int fmi3GetFloat64(void *c, const unsigned *v, size_t n, double *x, size_t m)
{ (void)c; (void)v; (void)n; while (m) x[--m] = 0.0; return 0; }
API int fmi2DoStep(void) { at("step"); return 0; }
API int fmi3DoStep(void) { at("step"); return 0; }
