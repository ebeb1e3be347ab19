/* Runs a generated step named `stack` on a bare Cortex-M4: the memory map of MPS2 with AN386, output by
   semihosting. Each line has the bits of the output SHOWN and the ticks of the step, both as hexadecimal
   digits. The input GIVEN moves in units of SIZE. */
#include "stack.h"

#ifndef GIVEN
#define GIVEN voltage
#define SHOWN displacement
#define SIZE 1.0f
#endif

#define STEPS 600
#define CPACR (*(volatile unsigned *)0xE000ED88u)
#define SYSTICK_CONTROL (*(volatile unsigned *)0xE000E010u)
#define SYSTICK_RELOAD (*(volatile unsigned *)0xE000E014u)
#define SYSTICK_NOW (*(volatile unsigned *)0xE000E018u)

static void semihosting(int operation, const void *argument) {
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
}

static char *put(char *text, const void *number, int bytes) {
    const unsigned char *const from = number;
    for (int i = bytes - 1; i >= 0; --i) {
        *text++ = "0123456789abcdef"[from[i] >> 4];
        *text++ = "0123456789abcdef"[from[i] & 15];
    }
    return text;
}

/* Ramps, and jumps of 60 SIZE */
static void set_input(stack_input *input, int k) {
    input->GIVEN += SIZE * (k % 150 == 149 ? -60.0f : k % 100 < 70 ? 1.0f : -1.0f);
}

static void run(void) {
    SYSTICK_RELOAD = 0xFFFFFFu;
    SYSTICK_CONTROL = 5; /* on, with the processor's clock */
    stack_state state, saved;
    stack_input input = {0};
    stack_output output, again;
    stack_init(&state);
    for (int k = 0; k < STEPS; ++k) {
        char line[40], *end = line;
        set_input(&input, k);
        saved = state;
        const unsigned before = SYSTICK_NOW;
        stack_step(&state, &input, &output);
        const unsigned ticks = (before - SYSTICK_NOW) & 0xFFFFFFu;
        state = saved; /* a copy is a saved state */
        stack_step(&state, &input, &again);
        end = put(end, &again.SHOWN, sizeof again.SHOWN);
        *end++ = again.SHOWN == output.SHOWN ? ' ' : '!';
        end = put(end, &ticks, sizeof ticks);
        *end++ = '\n';
        *end = 0;
        semihosting(4, line); /* SYS_WRITE0 */
    }
    semihosting(0x18, (const void *)0x20026); /* SYS_EXIT: the program has ended */
}

/* A function of its own, so that no register of the floating-point unit is used before it is on */
static void (*volatile begin)(void);

static void reset(void) {
    CPACR |= 0xFu << 20;
    __asm__ volatile("dsb; isb");
    begin = run;
    begin();
}

static void fault(void) {
    semihosting(4, "fault\n");
    semihosting(0x18, (const void *)0x20023); /* SYS_EXIT: a failure */
}

__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    (void (*)(void))0x20010000, reset, fault, fault, fault, fault, fault,
};
