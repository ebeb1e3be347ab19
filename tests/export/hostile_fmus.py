"""Small FMUs with foreign code that does harm, chosen by the environment when it runs."""

import zipfile
from functools import cache
from pathlib import Path

import fmpy

from psa_casadi.export.check.binaries import FUNCTIONS
from psa_casadi.files import temporary_folder
from psa_casadi.simulation.compiler import OPTIMISE, compiler_command, run_compiler

#: What the library does, and when: "MOMENT:DEED" in this variable; MOMENT is load, make or step.
DEED = "PSA_TEST_DEED"
#: A file of this name takes the number of the process when the deed is done.
PLACE = "PSA_TEST_PLACE"

_SOURCE = r"""
#define _DEFAULT_SOURCE
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#define API __attribute__((visibility("default")))

static void note(void)
{
    const char *place = getenv("PSA_TEST_PLACE");
    FILE *file = place ? fopen(place, "a") : NULL;
    if (file) { fprintf(file, "%d\n", (int)getpid()); fclose(file); }
}

static void do_deed(const char *deed)
{
    static const char text[] = "\n[\"end\"]\n{} \x1b[31m nonsense\n";
    if (!strcmp(deed, "exit")) exit(0);
    if (!strcmp(deed, "exit3")) { fprintf(stderr, "licence not found\n"); exit(3); }
    if (!strcmp(deed, "_exit")) _exit(0);
    if (!strcmp(deed, "abort")) abort();
    if (!strcmp(deed, "fault")) raise(SIGSEGV);
    if (!strcmp(deed, "hang")) { note(); for (;;) pause(); }
    if (!strcmp(deed, "child")) {
        if (fork()) _exit(0);
        note();
        for (;;) pause();
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
"""

_DESCRIPTIONS = {
    2: """<fmiModelDescription fmiVersion="2.0" modelName="h" guid="g">
<ModelExchange modelIdentifier="h"/><CoSimulation modelIdentifier="h"/><ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="y" valueReference="1" causality="output"><Real/></ScalarVariable>
</ModelVariables><ModelStructure><Outputs><Unknown index="2"/></Outputs></ModelStructure>
</fmiModelDescription>""",
    3: """<fmiModelDescription fmiVersion="3.0" modelName="h" instantiationToken="g">
<ModelExchange modelIdentifier="h"/><CoSimulation modelIdentifier="h"/><ModelVariables>
<Float64 name="u" valueReference="0" causality="input" start="0"/>
<Float64 name="y" valueReference="1" causality="output"/>
</ModelVariables><ModelStructure><Output valueReference="1"/></ModelStructure>
</fmiModelDescription>""",
}


#: The functions that do nothing.
_STUBS = "".join(
    f"API int {name}(void) {{ return 0; }}\n"
    for name in sorted(FUNCTIONS[2] | FUNCTIONS[3])
    if f"{name}(" not in _SOURCE
)


@cache
def library() -> bytes:
    """Return the library, compiled once for both versions of FMI, and never loaded here."""
    with temporary_folder() as work:
        (work / "hostile.c").write_text(_SOURCE + _STUBS, encoding="utf-8")
        flags = ("-fPIC", "-fvisibility=hidden", "-shared", "hostile.c", "-o", "hostile.lib")
        run_compiler([*compiler_command(), *OPTIMISE, *flags], work)
        return (work / "hostile.lib").read_bytes()


def hostile_fmu(path: Path, fmi: int, content: bytes | None = None) -> Path:
    """Write the FMU, with another content of its library if one is given."""
    folder = fmpy.platform_tuple if fmi == 3 else fmpy.platform
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", _DESCRIPTIONS[fmi])
        archive.writestr(f"binaries/{folder}/h{fmpy.sharedLibraryExtension}", content or library())
    return path
