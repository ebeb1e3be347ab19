/* The library of a module that has none: functions of JavaScript's `Math`, and memory that grows. */
#include <stdlib.h>

#include <math.h>

#define OF_MATH(name)                                                                            \
    __attribute__((import_module("Math"), import_name(#name))) double page_##name(double);      \
    double name(double x) { return page_##name(x); }
#define OF_MATH_2(name)                                                                          \
    __attribute__((import_module("Math"), import_name(#name))) double page_##name(double, double); \
    double name(double x, double y) { return page_##name(x, y); }

OF_MATH(sin)
OF_MATH(cos)
OF_MATH(tan)
OF_MATH(asin)
OF_MATH(acos)
OF_MATH(atan)
OF_MATH(sinh)
OF_MATH(cosh)
OF_MATH(tanh)
OF_MATH(asinh)
OF_MATH(acosh)
OF_MATH(atanh)
OF_MATH(exp)
OF_MATH(expm1)
OF_MATH(log)
OF_MATH(log1p)
OF_MATH(log10)
OF_MATH(cbrt)
OF_MATH_2(atan2)
OF_MATH_2(hypot)
OF_MATH_2(pow)

/* 2^n x, exact unless it underflows */
double ldexp(double x, int n) {
    for (; n > 1000; n -= 1000) x *= 0x1p1000;
    for (; n < -1000; n += 1000) x *= 0x1p-1000;
    const union {
        unsigned long long bits;
        double value;
    } power = {(unsigned long long)(n + 1023) << 52};
    return x * power.value;
}

#define PAGE 65536ul /* of WebAssembly's memory */
#define LINE 64ul

extern unsigned char __heap_base;
static size_t taken;

static size_t lined_up(size_t at) { return (at + LINE - 1) & ~(LINE - 1); }

size_t page_mark(void) {
    if (taken == 0) taken = lined_up((size_t)&__heap_base);
    return taken;
}

void page_release(size_t mark) { taken = mark; }

void *malloc(size_t size) {
    const size_t begin = page_mark(), have = __builtin_wasm_memory_size(0) * PAGE;
    if (size > (1ul << 31)) return NULL;
    const size_t end = lined_up(begin + size);
    if (end > have && __builtin_wasm_memory_grow(0, (end - have + PAGE - 1) / PAGE) == (size_t)-1) return NULL;
    taken = end;
    return (void *)begin;
}

void *calloc(size_t count, size_t size) {
    void *const memory = malloc(count * size);
    if (memory) __builtin_memset(memory, 0, count * size);
    return memory;
}

void free(void *memory) { (void)memory; }
