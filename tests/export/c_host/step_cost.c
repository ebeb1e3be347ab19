/* Times every step of the generated code `stack` and of the ordinary FMU on one voltage: the least of the
   repetitions for each step, so that what else the machine does stays out. Prints two numbers [ns] a line. */
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "fmi2Functions.h"
#include "stack.h"

enum { STEPS = 1000 };

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}

static void keep(double *least, double taken) {
    if (taken < *least) *least = taken;
}

static fmi2Component opened(const char *token) {
    static fmi2CallbackFunctions callbacks;
    fmi2Component fmu = fmi2Instantiate("cost", fmi2CoSimulation, token, "", &callbacks, fmi2False, fmi2False);
    if (!fmu || fmi2SetupExperiment(fmu, fmi2True, 1e-4, 0.0, fmi2False, 0.0) ||
        fmi2EnterInitializationMode(fmu) || fmi2ExitInitializationMode(fmu))
        exit(1);
    return fmu;
}

/* Arguments: token, repetitions, value references of voltage and displacement, then the voltages from stdin */
int main(int count, char **arguments) {
    if (count != 5) return 2;
    static double voltage[STEPS], code[STEPS], fmu_cost[STEPS];
    const unsigned input = (unsigned)atoi(arguments[3]), output = (unsigned)atoi(arguments[4]);
    double empty = 1e9;
    for (int k = 0; k < STEPS; ++k) {
        if (scanf("%lf", &voltage[k]) != 1) return 2;
        code[k] = fmu_cost[k] = 1e9;
    }
    for (int k = 0; k < 100000; ++k) {
        const double begun = now();
        keep(&empty, now() - begun);
    }
    for (int repetition = atoi(arguments[2]); repetition > 0; --repetition) {
        stack_state state;
        stack_input in = {0};
        stack_output out;
        stack_init(&state);
        fmi2Component fmu = opened(arguments[1]);
        for (int k = 0; k < STEPS; ++k) {
            double shown, begun = now();
            in.voltage = voltage[k];
            stack_step(&state, &in, &out);
            keep(&code[k], now() - begun - empty);
            begun = now();
            if (fmi2SetReal(fmu, &input, 1, &voltage[k]) ||
                fmi2DoStep(fmu, k * STACK_STEP, STACK_STEP, fmi2True) ||
                fmi2GetReal(fmu, &output, 1, &shown))
                return 1;
            keep(&fmu_cost[k], now() - begun - empty);
        }
        fmi2FreeInstance(fmu);
    }
    for (int k = 0; k < STEPS; ++k) printf("%.1f %.1f\n", code[k], fmu_cost[k]);
    return 0;
}
