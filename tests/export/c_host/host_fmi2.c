/* The small importer's use of FMI 2.0: one co-simulation instance. */
#include <stdio.h>

#include "fmi2Functions.h"
#include "host.h"

static fmi2Component slave;

static void message(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                    fmi2String category, fmi2String text, ...) {
    (void)environment;
    fprintf(stderr, "%s [%d, %s] %s\n", name, (int)status, category, text);
}

static int open_slave(const char *token) {
    static fmi2CallbackFunctions callbacks;
    callbacks.logger = message;
    slave = HOST_FIND(fmi2Instantiate)("host", fmi2CoSimulation, token, "", &callbacks, fmi2False,
                                       fmi2False);
    return slave && !HOST_FIND(fmi2SetupExperiment)(slave, fmi2True, 1e-8, 0.0, fmi2False, 0.0) &&
           !HOST_FIND(fmi2EnterInitializationMode)(slave) &&
           !HOST_FIND(fmi2ExitInitializationMode)(slave);
}

static int set(unsigned input, double value) {
    return !HOST_FIND(fmi2SetReal)(slave, &input, 1, &value);
}

static int step(double point, double size) {
    return !HOST_FIND(fmi2DoStep)(slave, point, size, fmi2True);
}

static int get(const unsigned outputs[], size_t count, double values[]) {
    return !HOST_FIND(fmi2GetReal)(slave, outputs, count, values);
}

static int save(char *bytes, size_t space, size_t *size) {
    fmi2FMUstate state = NULL;
    return !HOST_FIND(fmi2GetFMUstate)(slave, &state) &&
           !HOST_FIND(fmi2SerializedFMUstateSize)(slave, state, size) && *size <= space &&
           !HOST_FIND(fmi2SerializeFMUstate)(slave, state, bytes, *size) &&
           !HOST_FIND(fmi2FreeFMUstate)(slave, &state);
}

static int load(const char *bytes, size_t size) {
    fmi2FMUstate state = NULL;
    return !HOST_FIND(fmi2DeSerializeFMUstate)(slave, bytes, size, &state) &&
           !HOST_FIND(fmi2SetFMUstate)(slave, state) && !HOST_FIND(fmi2FreeFMUstate)(slave, &state);
}

static int close_slave(void) {
    const int fine = !HOST_FIND(fmi2Terminate)(slave);
    HOST_FIND(fmi2FreeInstance)(slave);
    return fine;
}

const host_face host_fmi2 = {open_slave, set, step, get, save, load, close_slave};
