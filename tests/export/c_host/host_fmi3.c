/* The small importer's use of FMI 3.0: one co-simulation instance without event mode. */
#include <stdio.h>

#include "fmi3Functions.h"
#include "host.h"

static fmi3Instance slave;

static void message(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category,
                    fmi3String text) {
    (void)environment;
    fprintf(stderr, "[%d, %s] %s\n", (int)status, category, text);
}

static int open_slave(const char *token) {
    slave = HOST_FIND(fmi3InstantiateCoSimulation)("host", token, NULL, fmi3False, fmi3False, fmi3False,
                                                   fmi3False, NULL, 0, NULL, message, NULL);
    return slave &&
           !HOST_FIND(fmi3EnterInitializationMode)(slave, fmi3True, 1e-8, 0.0, fmi3False, 0.0) &&
           !HOST_FIND(fmi3ExitInitializationMode)(slave);
}

static int set(unsigned input, double value) {
    return !HOST_FIND(fmi3SetFloat64)(slave, &input, 1, &value, 1);
}

static int step(double point, double size) {
    fmi3Boolean event, terminate, early;
    double reached;
    return !HOST_FIND(fmi3DoStep)(slave, point, size, fmi3True, &event, &terminate, &early, &reached) &&
           !terminate && !early;
}

static int get(const unsigned outputs[], size_t count, double values[]) {
    return !HOST_FIND(fmi3GetFloat64)(slave, outputs, count, values, count);
}

static int save(char *bytes, size_t space, size_t *size) {
    fmi3FMUState state = NULL;
    return !HOST_FIND(fmi3GetFMUState)(slave, &state) &&
           !HOST_FIND(fmi3SerializedFMUStateSize)(slave, state, size) && *size <= space &&
           !HOST_FIND(fmi3SerializeFMUState)(slave, state, (fmi3Byte *)bytes, *size) &&
           !HOST_FIND(fmi3FreeFMUState)(slave, &state);
}

static int load(const char *bytes, size_t size) {
    fmi3FMUState state = NULL;
    return !HOST_FIND(fmi3DeserializeFMUState)(slave, (const fmi3Byte *)bytes, size, &state) &&
           !HOST_FIND(fmi3SetFMUState)(slave, state) && !HOST_FIND(fmi3FreeFMUState)(slave, &state);
}

static int close_slave(void) {
    const int fine = !HOST_FIND(fmi3Terminate)(slave);
    HOST_FIND(fmi3FreeInstance)(slave);
    return fine;
}

const host_face host_fmi3 = {open_slave, set, step, get, save, load, close_slave};
