/* Plays a step on voltages: in bits of the result which of them it told to be beyond the limit. */
#include "stack.h"
#if !defined(_WIN32)
__attribute__((visibility("default")))
#endif
int told(const double *voltage, int count, double *x) {
    stack_state state;
    stack_input input = {0};
    stack_output output;
    int all = 0;
    stack_init(&state);
    for (int k = 0; k < count; ++k) {
        input.voltage = voltage[k];
        all = 2 * all + stack_step(&state, &input, &output);
    }
    *x = output.displacement;
    return all;
}
